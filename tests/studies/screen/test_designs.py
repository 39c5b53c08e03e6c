"""`studies screen`: tallies, designs made shard by shard, and going on after interruptions."""

import html
import re
import shutil
import threading
import tomllib
import warnings
from shlex import quote
from unittest import mock

import jax
import numpy as np
import pytest

from jaxmodel import status
from studies.cli import main
from studies.engine.fidelity import Agreement
from studies.engine.results import metric_values, read_sweep
from studies.engine.runs import run_uncontrolled
from studies.errors import StudyError
from studies.results.labelled import Variable
from studies.screen import say, selection, shards
from studies.screen.local import LocalScreener
from studies.screen.run import run_screen
from studies.screen.say import margin_rows, quantile_rows, summary_lines, write_screen_report
from studies.screen.selection import select
from studies.screen.shards import axis_columns, screen_of
from studies.screen.stored import BEST, TALLY, best_sweep, read_tally, write_tally
from studies.screen.tally import (
    LEFT_OUT,
    Tally,
    divided,
    merged,
    nothing,
    quantile,
    tally_of,
)
from studies.space.spec import load_sweep
from studies.space.table import build_table
from studies.store import read_store, write_store
from studies.sweeps.run import run_sweep
from tests.bare import parse_sweep
from tests.pages import text_of
from tests.sweeps import narrow_blocks, small, small_spec

#: Placements and gains; some leave the links or saturate. Programs are those of `test_screen`.
AXES = {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 3.0, "scale": "log"}}
SWEEP = {
    "method": "random",
    "count": 128,
    "axes": AXES,
    "where": "gain < 2.5",
    "by": "residual_rms[link=2][station=2]",
    "metrics": ["residual_rms"],
}
SPEC = small_spec(SWEEP)
KEEP = 12


@pytest.fixture(scope="module", autouse=True)
def narrow():
    with narrow_blocks():
        yield


def screened(out, spec=SPEC, screener=None, shard_size=32, keep=KEEP, margin=0.0, **more):
    screen = screen_of(spec, keep=keep, margin=margin, shard_size=shard_size, **more)
    return run_screen(screen, out, is_quiet=True, screener=screener)


def assert_same(first: Tally, second: Tally):
    for name, array in first._asdict().items():
        other = getattr(second, name)
        if name == "value":
            np.testing.assert_allclose(array, other, rtol=1e-12)
        else:
            np.testing.assert_array_equal(array, other)


# --- tallies --------------------------------------------------------------------------------------


def random_designs(count, seed=0):
    rng = np.random.default_rng(seed)
    columns = {"x": rng.random(count), "kind": rng.integers(0, 3, count).astype(float)}
    code = np.where(rng.random(count) < 0.1, status.SATURATED, status.OK)
    value = 10 ** rng.normal(-6, 1, count) * (1 + columns["x"])
    value[rng.random(count) < 0.05] = np.nan
    return np.arange(count), code, value, columns


@pytest.mark.parametrize("is_largest", [False, True])
def test_tallies_merge_in_any_order(is_largest):
    row, code, value, columns = random_designs(3000)
    # ties, some of them kept: of equal ones, the earliest
    value[500:580] = np.nanquantile(value, 0.99 if is_largest else 0.01)
    axes = divided(columns)

    def part(chosen):
        some = {name: x[chosen] for name, x in columns.items()}
        return tally_of(row[chosen], code[chosen], value[chosen], some, axes, 50, is_largest)

    whole = part(row)
    for seed in range(5):
        rng = np.random.default_rng(seed)
        total = nothing(axes)
        for chosen in np.array_split(rng.permutation(row), rng.integers(2, 40)):
            total = merged(part(chosen), total, 50, is_largest)
        for first, second in zip(total, whole, strict=True):
            np.testing.assert_array_equal(first, second)
    fine = row[(code == status.OK) & np.isfinite(value)]
    order = fine[np.argsort(-value[fine] if is_largest else value[fine], kind="stable")]
    np.testing.assert_array_equal(whole.row, order[:50])
    assert whole.n_designs == 3000 and whole.sketch[0].sum() == len(fine)


def test_quantiles_are_exact_within_one_per_cent():
    row, code, value, columns = random_designs(20_000)
    code[:] = status.OK
    value = np.abs(np.nan_to_num(value, nan=1e-6))
    axes = divided(columns)
    tally = tally_of(row, code, value, columns, axes, 10, False)
    for share in (0.001, 0.1, 0.5, 0.9, 0.999):
        exact = np.quantile(value, share, method="inverted_cdf")
        assert abs(quantile(tally.sketch[0], share) / exact - 1) <= 0.0101
        smooth = quantile(tally.sketch[0], share, is_smooth=True)
        assert abs(smooth / exact - 1) <= (0.003 if 0.01 < share < 0.99 else 0.0201)
    for k, kind in enumerate((0.0, 1.0, 2.0)):  # intervals of an axis are designs of their own
        chosen = value[columns["kind"] == kind]
        exact = np.quantile(chosen, 0.5, method="inverted_cdf")
        counts = tally.sketch[axes.part(axes.names.index("kind"))][k]
        assert counts.sum() == len(chosen)
        assert abs(quantile(counts, 0.5) / exact - 1) <= 0.0101
    assert np.isnan(quantile(np.zeros(10, int), 0.5))
    for factor, expected in ((0, 0), (-1, 0), (1e30, np.inf)):
        beyond = tally_of(row, code, factor * value, columns, axes, 10, False)
        assert quantile(beyond.sketch[0], 0.5) == expected


def test_texts_count_for_themselves():
    """Those that none of the designs tried at first has, for nobody."""
    kind = np.array(["zv", "ei", "ei", "none", "zvd", "zv"])
    axes = divided({"kind": kind[:3]})
    assert axes.labels[0].tolist() == ["ei", "zv"]
    value, code = np.full(6, 1e-6), np.zeros(6, int)
    tally = tally_of(np.arange(6), code, value, {"kind": kind}, axes, 10, False)
    assert tally.sketch[axes.part(0)].sum(axis=1).tolist() == [2, 2]
    assert tally.sketch[0].sum() == 6


# --- designs --------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["random", "sobol", "latin_hypercube"])
def test_designs_made_in_parts_are_those_of_the_whole(method):
    sweep = {"method": method, "count": 1000, "axes": AXES}
    if method == "latin_hypercube":
        sweep["size"] = 250
    inner = {"method": "random", "count": 7, "axes": {"emc_exponent": {"from": 0.0, "to": 1.0}}}
    spec = small_spec(sweep | {"blocks": [inner]})
    table = build_table(spec)
    assert len(table) == 7000
    for first, stop in ((4000, 4700), (0, 300), (6990, 7000), (301, 302)):  # back and forth
        part = build_table(spec, np.arange(first, stop))
        np.testing.assert_array_equal(part.case_id, table.case_id[first:stop])
        np.testing.assert_array_equal(part.seed, table.seed[first:stop])
        np.testing.assert_array_equal(part.row, np.arange(first, stop))


def test_a_billion_designs_are_made_anywhere():
    sweep = {"method": "random", "count": 10**12, "axes": AXES}
    rows = np.arange(10**12 - 100, 10**12)
    table = build_table(small_spec(sweep), rows)
    assert len(table) == 100
    ends = np.array([7, 10**6, 10**12 - 1])  # as far apart as the best ones may be
    scattered = build_table(small_spec(sweep), ends)
    np.testing.assert_array_equal(scattered.row, ends)
    assert scattered.case_id[-1] == table.case_id[-1]
    with pytest.raises(StudyError, match=r"1e\+12 cases; allowed: up to 10000000. studies screen"):
        build_table(small_spec(sweep))
    with pytest.raises(StudyError, match="up to 1073741824 Sobol points"):
        build_table(small_spec(sweep | {"method": "sobol"}), rows)


# --- screens --------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A screen without interruption."""
    out = tmp_path_factory.mktemp("screen") / "whole"
    return out, screened(out)


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    """The sweep of all designs by the linear model."""
    out = tmp_path_factory.mktemp("sweep") / "all"
    run_sweep(small_spec(SWEEP | {"fidelity": "linear"}), out, is_quiet=True)
    return read_sweep(out)


def test_a_screen_has_the_values_of_a_sweep_by_the_linear_model(swept, tmp_path):
    done, data = screened(tmp_path / "screen", keep=128), swept
    value = dict(zip(data.table.row.tolist(), metric_values(data, SWEEP["by"]), strict=True))
    # the sweep judges stability as well, which a screen does not: unstable ones are kept here
    stable = set(data.table.row[data["status"] == status.OK].tolist())
    kept = done.tally.row.tolist()
    assert done.n_kept == len(kept)
    assert stable <= set(kept) and len(stable) > 64
    np.testing.assert_allclose(done.tally.value, [value[row] for row in kept], rtol=1e-9)
    assert np.all(np.diff(done.tally.value) >= 0)
    endings = done.tally.endings
    assert endings[LEFT_OUT] == data.table.n_dropped > 0
    assert endings[status.OK] == len(kept) and done.tally.n_designs == 128
    saturated = set(data.table.row[data["status"] == status.SATURATED].tolist())
    assert saturated and not saturated & set(kept)
    assert endings[status.SATURATED] == 128 - len(kept) - endings[LEFT_OUT]


@pytest.mark.parametrize("count", [128, pytest.param(1024, marks=pytest.mark.long)])
def test_many_designs_side_by_side_are_as_few(tmp_path, count):
    """As large screens run them; jaxlib 0.11.2 by itself gives NaN where many are prepared."""
    spec = small_spec(SWEEP | {"count": count})
    few = screened(tmp_path / "few", spec, keep=count)
    with mock.patch.object(shards, "LANES", 512):  # programs are kept by their sizes
        many = screened(tmp_path / "many", spec, shard_size=count, keep=count)
    order = [np.argsort(done.tally.row) for done in (many, few)]
    rows, values = (
        [getattr(x.tally, name)[k] for x, k in zip((many, few), order, strict=True)]
        for name in ("row", "value")
    )
    assert len(rows[0]) > count / 2
    np.testing.assert_array_equal(*rows)
    np.testing.assert_allclose(*values, rtol=1e-9)
    np.testing.assert_array_equal(many.tally.endings, few.tally.endings)


def test_copies_of_good_designs_displace_no_others(tmp_path):
    gains = np.linspace(0.3, 1.0, 8).tolist()
    axes = {"patches.centers": [[0.05, 0.1, 0.15]], "gain": gains}  # as in AXES: one program
    spec = small_spec(SWEEP | {"count": 64, "axes": axes})
    with mock.patch.object(shards, "CANDIDATES", 20):  # of no program
        done = screened(tmp_path / "screen", spec, keep=8)
    assert done.n_kept == 8
    assert done.tally.endings[status.OK] <= 16  # a copy in each shard
    assert done.tally.endings[LEFT_OUT] == 64 - done.tally.endings[:LEFT_OUT].sum()


def test_a_shard_without_designs_is_counted(tmp_path):
    done = screened(
        tmp_path / "screen", small_spec(SWEEP | {"where": "gain < 0.13"}), shard_size=16
    )
    assert done.tally.n_designs == 128 > done.tally.endings[LEFT_OUT] > 96


def test_designs_that_repeat_others_are_kept_once(tmp_path):
    cases = [{"control.gain_factor": gain} for gain in (0.5, 0.7, 0.5, 0.5)]
    spec = small_spec({"method": "list", "cases": cases, "by": SWEEP["by"]})
    done = screened(tmp_path / "screen", spec)
    assert done.tally.endings[status.OK] == 2
    kept = load_sweep(tmp_path / "screen" / BEST)
    assert sorted(build_table(kept).columns["control.gain_factor"]) == [0.5, 0.7]
    assert done.n_kept == 2


def test_designs_behind_a_repeated_one_keep_their_values():
    """Shards do not see each other's designs, so a tally may hold the same one twice."""
    cases = [{"control.gain_factor": gain} for gain in (0.5, 0.7, 0.5)]
    screen = screen_of(small_spec({"method": "list", "cases": cases, "by": SWEEP["by"]}), margin=0)
    tally = nothing(screen.axes)._replace(
        row=np.array([2, 0, 1]), value=np.array([1e-6, 1e-6, 2e-6])
    )
    with mock.patch.object(selection, "_margins", lambda _, table: np.full(len(table), 2.0)):
        found = select(screen, tally, threading.Event())
    assert found.table.columns["control.gain_factor"].tolist() == [0.5, 0.7]
    assert found.kept_value.tolist() == [1e-6, 2e-6]


def test_kept_designs_are_a_sweep_with_the_same_ids(whole):
    out, done = whole
    spec = load_sweep(out / BEST)
    rows = done.tally.row[:KEEP]
    expected = build_table(SPEC, np.sort(rows))
    place = {int(row): k for k, row in enumerate(expected.row)}
    order = [place[row] for row in rows.tolist()]
    table = build_table(spec)
    np.testing.assert_array_equal(table.case_id, expected.case_id[order])
    np.testing.assert_array_equal(table.seed, expected.seed[order])
    assert spec.sweep.fidelity == "full"


def test_kept_designs_of_a_linear_sweep_run_in_the_full_model():
    spec = small_spec(SWEEP | {"fidelity": "linear"})
    written = tomllib.loads(best_sweep(screen_of(spec), build_table(spec, np.arange(2))))
    assert parse_sweep(written).sweep.fidelity == "full"


def test_kept_designs_have_the_margins_of_the_sweep(whole, swept):
    _, done = whole
    margin = done.selection.margin
    place = np.searchsorted(swept.table.row, done.tally.row[:KEEP])
    np.testing.assert_allclose(margin, swept["gain_margin"][place], rtol=1e-9)
    judged = f"{KEEP} candidates judged, best first: {np.sum(margin < 1)} unstable"
    assert judged in summary_lines(done)


def test_designs_with_the_margin_asked_for_are_kept(whole, swept, tmp_path):
    """The best of all that have it, as a sweep of all designs finds them; nothing runs again."""
    _, done = whole
    data, out = swept, tmp_path / "out"
    value = metric_values(data, SWEEP["by"])
    shutil.copytree(whole[0], out)  # whatever the margins
    for margin in (1.0, 2.5, 4.0):
        is_wanted = (data["gain_margin"] >= margin) & (data["status"] == status.OK)
        order = np.flatnonzero(is_wanted)[np.argsort(value[is_wanted])][:KEEP]
        found = screened(out, screener=Stopped(0), margin=margin)
        assert found.selection.kept.row.tolist() == data.table.row[order].tolist()
        written = build_table(load_sweep(out / BEST)).case_id
        assert written.tolist() == data.table.case_id[order].tolist()
        assert f"with a gain margin of at least {margin:g}" in summary_lines(found)[1]
        assert_same(found.tally, done.tally)
    assert len(order) == KEEP  # enough have even the largest one


def test_nothing_is_kept_where_no_design_has_the_margin(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    assert (tmp_path / BEST).exists()
    none = screened(tmp_path, margin=60.0)
    assert none.n_kept == 0 and not (tmp_path / BEST).exists()
    assert "none has a gain margin of at least 60 (largest: " in summary_lines(none)[-3]
    write_screen_report(tmp_path, none)
    text = text_of((tmp_path / "report.html").read_text())
    assert "None of these is kept: they lack the margin." in text
    assert "**Next steps:** ask for less with `--resume --margin`, or narrow the axes." in text


def test_the_same_links_count_for_all_designs(tmp_path):
    """Designs that control other links are in other shards, and yet compare."""
    gain = {"from": 0.1, "to": 1.0, "count": 8}
    links = [[True, False, False], [False, True, False]]
    sweep = {
        "method": "grid",
        "axes": {"control.links": links, "gain": gain},
        "by": "residual_rms",
        "metrics": ["residual_rms"],
        "fidelity": "linear",
    }
    done = screened(tmp_path / "out", small_spec(sweep), shard_size=8)
    assert done.screen.spec.sweep.links == (1, 2)
    write_screen_report(tmp_path / "out", done)
    assert "largest of links 1 and 2 and all stations" in text_of(
        (tmp_path / "out" / "report.html").read_text()
    )
    run_sweep(small_spec(sweep), tmp_path / "sweep", is_quiet=True)
    data = read_sweep(tmp_path / "sweep")
    whole = metric_values(data, "residual_rms")
    value = dict(zip(data.table.row.tolist(), whole, strict=True))
    expected = [value[row] for row in done.tally.row.tolist()]
    np.testing.assert_allclose(done.tally.value, expected, rtol=1e-9)
    # so that those that are kept compare when they are run alone
    assert load_sweep(tmp_path / "out" / BEST).sweep.links == (1, 2)
    alone = sweep | {"axes": {"control.links": links[:1], "gain": gain}, "links": [1, 2]}
    run_sweep(small_spec(alone), tmp_path / "alone", is_quiet=True)
    some = metric_values(read_sweep(tmp_path / "alone"), "residual_rms")
    np.testing.assert_allclose(some, whole[: len(some)], rtol=1e-9)


def test_links_that_a_machine_lacks_are_refused():
    for links in ([4], [0], [1, 1]):
        with pytest.raises(StudyError, match="sweep.links = .*allowed: each of 1, 2, 3 once"):
            small_spec(SWEEP | {"links": links})


KINDS, MASSES = ["sampled", "none"], [0.0, 0.1]


def of_kinds(out, margin):
    """Designs with and without a sampled loop, and their report."""
    axes = {"control.feedback": KINDS, "load.mass": MASSES}
    sweep = {"method": "grid", "axes": axes, "metrics": ["residual_rms"], "by": SWEEP["by"]}
    done = screened(out, small_spec(sweep), margin=margin)
    write_screen_report(out, done)
    return done, text_of((out / "report.html").read_text())


def test_designs_without_a_sampled_loop_need_no_margin(tmp_path):
    """Nothing in them can go unstable; they are kept with the others, and counted."""
    done, text = of_kinds(tmp_path, 1.0)
    fields = done.selection.kept.fields["control.feedback"].tolist()
    assert sorted(fields) == ["none", "none", "sampled", "sampled"]
    margin = done.selection.margin[done.selection.is_kept]
    assert np.isnan(margin[np.array(fields) == "none"]).all()
    assert "2 without a sampled loop" in " ".join(summary_lines(done))
    assert "nan" not in text and "--subject-to" not in text and "| none |" in text
    none, _ = of_kinds(tmp_path, 60.0)
    assert none.selection.kept.fields["control.feedback"].tolist() == ["none", "none"]


def test_margins_below_one_have_no_negative_counts(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "out")
    done = screened(tmp_path / "out", margin=0.5)
    lines = " ".join(summary_lines(done))
    assert "candidates judged, best first: " in lines and "more below that margin" not in lines


def test_candidates_that_end_before_enough_are_found_are_told(whole, monkeypatch):
    _, done = whole
    monkeypatch.setattr(say, "CANDIDATES", len(done.tally.row))
    few = done._replace(screen=done.screen._replace(margin=60.0, keep=1000))
    for is_kept in (done.selection.is_kept, np.zeros(KEEP, bool)):
        told = few._replace(selection=done.selection._replace(is_kept=is_kept))
        assert "judges no more than its best" in " ".join(summary_lines(told))


def test_what_tells_of_older_designs_goes_first(whole, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(whole[0], out)
    (out / "report.html").write_text("of other designs")
    screened(out, keep=3)
    assert not (out / "report.html").exists()  # the command writes it anew
    (out / BEST).unlink()
    (out / BEST).mkdir()
    with pytest.raises(StudyError, match="best.toml: cannot remove it"):
        screened(out, margin=60.0)


class Stopped(LocalScreener):
    """Ends after some shards, as if it had been killed."""

    def __init__(self, count):
        self._count = count

    def tallies(self, work):
        for k, answer in enumerate(super().tallies(work)):
            if k == self._count:
                raise StudyError("killed")
            yield answer


def test_an_interrupted_screen_goes_on(whole, tmp_path):
    _, done = whole
    out = tmp_path / "out"
    for count in (1, 2):
        with pytest.raises(StudyError, match="killed"):
            screened(out, screener=Stopped(count))
    is_done, _ = read_tally(out, done.screen)
    assert is_done.tolist() == [True, True, True, False]
    resumed = screened(out)
    assert_same(resumed.tally, done.tally)
    assert sorted(path.name for path in out.iterdir()) == sorted(
        [".lock", BEST, TALLY, "screen.json"]
    )
    more = screened(out, keep=KEEP + 1)  # chosen among the candidates: nothing runs again
    assert more.selection.kept.row.tolist() == done.tally.row[: KEEP + 1].tolist()
    by = "residual_rms[link=1][station=2]"
    with pytest.raises(StudyError, match="was begun with another --by"):
        screened(out, by=by)


class Lossy(LocalScreener):
    """Gives a shard up."""

    def tallies(self, work):
        for shard, tally in super().tallies(work):
            yield shard, "its workers died" if shard == 2 else tally


def test_a_lost_shard_is_said_and_retried(whole, tmp_path):
    _, done = whole
    lossy = screened(tmp_path / "out", screener=Lossy())
    assert lossy.lost == {2: "its workers died"}
    assert lossy.tally.n_designs == 128 - 32
    assert_same(screened(tmp_path / "out").tally, done.tally)


def test_ctrl_c_keeps_what_is_finished(whole, tmp_path, monkeypatch):
    out, stop = tmp_path / "out", threading.Event()

    class Pressed(LocalScreener):
        def tallies(self, work):
            for answer in super().tallies(work):
                yield answer
                work.stop.set()

    done = screened(out, screener=Pressed())
    assert done.is_interrupted and done.is_done.sum() == 1
    assert not (out / BEST).exists() and not stop.is_set()
    assert_same(screened(out).tally, whole[1].tally)


def test_damaged_tallies_are_refused(whole, tmp_path):
    out, done = whole
    good, attributes = read_store(out / TALLY)

    def changed(name, data):
        stored = {name: Variable(x.data, x.dims, x.units, x.long_name) for name, x in good.items()}
        stored[name] = stored[name]._replace(data=data)
        write_store(tmp_path / TALLY, stored, attributes)
        with pytest.raises(StudyError, match="damaged"):
            read_tally(tmp_path, done.screen)

    changed("endings", good["endings"].data + 1)
    changed("row", good["row"].data + 10_000)
    changed("sketch", -good["sketch"].data)
    changed("value", good["value"].data * 1.01)
    changed("is_done", np.zeros(4, np.int8))
    (tmp_path / TALLY).write_bytes((out / TALLY).read_bytes()[:3000])
    with pytest.raises(StudyError, match=r"remove it and begin again"):
        read_tally(tmp_path, done.screen)
    other = done.screen._replace(by="residual_rms[link=1][station=2]")
    write_tally(tmp_path, other, done.is_done, done.tally)  # of the same shape, from elsewhere
    with pytest.raises(StudyError, match="not what was written for this screen"):
        read_tally(tmp_path, done.screen)
    write_tally(tmp_path, done.screen, done.is_done, done.tally)
    assert_same(read_tally(tmp_path, done.screen)[1], done.tally)


@pytest.mark.long  # in short: of the linear model
def test_full_model_of_the_same_designs(whole, tmp_path):
    """The true best ones, without a table of all cases."""
    full = screened(tmp_path / "full", fidelity="full")
    assert full.tally.n_designs == 128
    common = np.intersect1d(full.tally.row[:KEEP], whole[1].tally.row[:KEEP])
    assert len(common) >= 0.8 * KEEP
    assert not np.array_equal(full.tally.value, whole[1].tally.value)


def test_what_a_screen_cannot_do_is_refused():
    for more, message in (
        ({"repeats": 2}, "sweep.repeats = 2"),
        ({"environments": ["gain"]}, "sweep.environments"),
        ({"screen": {"keep": 0.5}}, "sweep.screen"),
        ({"method": "morris", "count": 4, "where": ""}, "sweep.method = 'morris'"),
        ({"where": "gain > 99"}, "true for none"),
    ):
        with pytest.raises(StudyError, match=message):
            screen_of(parse_sweep(small(SWEEP | more)))
    with pytest.raises(StudyError, match="structural_rms"):
        screen_of(SPEC, by="structral_rms")
    with pytest.raises(StudyError, match="allowed"):
        screen_of(SPEC, by="residual_rms[link=4]")
    for more, message in (
        ({"keep": 0}, "--keep = 0"),
        ({"keep": 100_001}, "--keep = 100001; allowed: 1 to 100000"),
        ({"margin": -1.0}, "--margin = -1.0; allowed: 0 to less than 64"),
        ({"margin": 64.0}, "--margin = 64.0"),
        ({"margin": float("nan")}, "--margin = nan"),
    ):
        with pytest.raises(StudyError, match=message):
            screen_of(SPEC, **more)
    with jax.enable_x64(False), pytest.raises(StudyError, match="--by = 'residual_rms'.*float32"):
        screen_of(SPEC, by="residual_rms")


def test_sizes_of_shards():
    """An interruption loses little of a screen of any size."""
    for count, size in ((100, 2**14), (10**6, 2**14), (3 * 10**6, 2**16), (10**9, 2**18)):
        assert screen_of(small_spec(SWEEP | {"count": count})).shard_size == size


def test_slow_axes_of_a_grid_are_seen():
    gains = {"from": 0.1, "to": 5.0, "count": 100}
    inner = {f"control.velocity_gain[{k}]": gains for k in range(2)}
    grid = {"method": "grid", "axes": {"control.modes": [2, 1]} | inner}
    screen = screen_of(small_spec(grid | {"where": "control.velocity_gain[0] > 4"}))
    assert screen.axes.names == ("control.modes", *inner)
    assert [len(centers) for centers in screen.axes.centers] == [2, 18, 20]  # 18 above 4
    assert screen.axes.centers[0].tolist() == [1, 2] and screen.axes.bounds[0].tolist() == [1.5]
    screen_of(small_spec(grid), by="residual_modal_rms[mode=2]")


def test_grids_inside_random_points_are_seen():
    gains = {"from": 0.1, "to": 5.0, "count": 5000}
    block = {"method": "grid", "axes": {"control.velocity_gain[0]": gains}}
    sweep = {"method": "random", "count": 10**8, "axes": {"load.mass": {"from": 0.1, "to": 0.2}}}
    axes = screen_of(small_spec(sweep | {"blocks": [block]})).axes
    assert axes.names == ("load.mass", "control.velocity_gain[0]")
    assert [len(centers) for centers in axes.centers] == [20, 20]


def test_too_many_designs_are_refused_before_any_runs():
    fine = {"from": 0.1, "to": 0.2, "count": 10**5}
    grid = {f"control.velocity_gain[{k}]": fine for k in range(3)}
    with pytest.raises(StudyError, match=r"1e\+15 designs; allowed: up to 1e\+12"):
        screen_of(small_spec({"method": "grid", "axes": grid}))
    with pytest.raises(StudyError, match="sweep.count = 1073741825; allowed: up to 1073741824"):
        screen_of(small_spec({"method": "sobol", "count": 2**30 + 1, "axes": AXES}))


def test_report_of_axes_of_text(tmp_path):
    done, text = of_kinds(tmp_path, 0.0)
    axes, tally = done.screen.axes, done.tally
    assert axes.names == ("control.feedback", "load.mass")
    assert axes.labels[0].tolist() == sorted(KINDS) and not len(axes.labels[1])
    # each kind's two values are where they belong
    for label, counts in zip(axes.labels[0], tally.sketch[axes.part(0)], strict=True):
        values = tally.value[[KINDS[row // len(MASSES)] == label for row in tally.row]]
        assert counts.sum() == len(values) == 2
        for value, share in zip(np.sort(values), (0.5, 1.0), strict=True):
            np.testing.assert_allclose(quantile(counts, share), value, rtol=0.02)
    kind = KINDS[tally.row[0] // len(MASSES)]
    assert re.search(
        rf"\| control\.feedback \|.*\| 0 \| {tally.row[0]} \|[^\n]*\| {kind} \|", text, re.DOTALL
    )
    assert (tmp_path / "influence.png").exists()


def test_the_report_tells_what_margin_costs(whole, tmp_path):
    """The table holds what is kept, under the numbers in best.toml."""
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    done = screened(tmp_path, SPEC, margin=2.5)
    selection = done.selection
    write_screen_report(tmp_path, done)
    text = text_of((tmp_path / "report.html").read_text())
    assert f"a sweep of all {KEEP} designs that were kept" in text
    for case, row in enumerate(selection.kept.row[:3]):
        assert re.search(rf"^\| *{case} \| *{row} \|", text, re.MULTILINE)
    costs = margin_rows(done).rows
    assert [f"| {' | '.join(row)} |" in re.sub(" +", " ", text) for row in costs]
    best = [float(value.split()[0]) for _, _, value in costs]
    assert best == sorted(best) and costs[0][0] == "0" and len(costs) >= 5
    count = {least: int(number) for least, number, _ in costs}
    assert count["3"] == np.sum(selection.margin >= 3)
    assert "gain_margin >= 2.5" in html.unescape(text)


def test_ends_of_axes_are_pointed_out(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    done = screened(tmp_path, keep=128)
    selection, axes, name = done.selection, done.screen.axes, "control.gain_factor"
    gain = axis_columns(selection.table)[name]
    order, interval = np.argsort(gain), axes.interval(axes.names.index(name), gain)

    def told(chosen):
        is_kept = np.isin(np.arange(len(gain)), chosen)
        lines = summary_lines(done._replace(selection=selection._replace(is_kept=is_kept)))
        return [line for line in lines if "widen" in line]

    assert not told(order)
    (lower,) = told(np.flatnonzero(interval == 0))
    assert f"the lower end of {name}" in lower and "upper" not in lower
    assert not told(order[len(order) // 3 : len(order) // 2])


def test_nothing_is_kept_where_no_design_ends_well(tmp_path, capsys):
    from studies.study.template import toml_text

    file, out = tmp_path / "sweep.toml", tmp_path / "out"
    axes = AXES | {"gain": {"from": 500.0, "to": 1000.0}}
    file.write_text(toml_text(small(SWEEP | {"count": 8, "where": "", "axes": axes})))
    main(["screen", str(file), "--out", str(out)])
    text = capsys.readouterr().out
    assert "no design ended well; nothing is kept" in text and BEST not in text
    assert BEST not in text_of((out / "report.html").read_text())
    assert sorted(path.name for path in out.iterdir() if path.suffix) == sorted(
        ["report.html", "screen.json", TALLY]
    )


def test_a_report_of_values_that_a_log_scale_lacks(whole, tmp_path):
    """Negative values and zeros have no figures; where the largest are the best, so are shares."""
    _, done = whole
    sketch = np.zeros_like(done.tally.sketch)
    sketch[:, 0] = done.tally.sketch.sum(axis=1)
    tally = done.tally._replace(value=done.tally.value - 1, sketch=sketch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        write_screen_report(tmp_path, done._replace(tally=tally))
    assert not list(tmp_path.glob("*.png"))
    assert summary_lines(done._replace(tally=tally))[1].endswith(
        "median of those that are ok: 0 µm or less"
    )
    done = done._replace(tally=done.tally._replace(sketch=2 * done.tally.sketch))  # enough for 1 %
    largest = done._replace(
        screen=done.screen._replace(by=f"-{done.screen.by}"),
        tally=done.tally._replace(value=done.tally.value[::-1]),
    )
    assert [share for share, _ in quantile_rows(largest).rows] == ["1 %", "10 %", "50 %", "90 %"]
    least, most = quantile_rows(done).rows, quantile_rows(largest).rows
    assert least[-1][1].replace("less", "more") == most[1][1]  # 90 % are below, 10 % above


def test_designs_without_a_value_are_counted(whole):
    """Such as by a mode that they lack; they are ok, but nothing ranks them."""
    _, done = whole
    without = done._replace(tally=done.tally._replace(sketch=0 * done.tally.sketch))
    count = done.tally.endings[status.OK]
    assert f"{count} of those that are ok have no finite" in summary_lines(without)[1]
    assert "no finite" not in "".join(summary_lines(done))


def test_report_says_what_was_found(whole):
    out, done = whole
    write_screen_report(out, done)
    text = text_of((out / "report.html").read_text())
    assert "128 designs" in text and "actuators saturated" in text and "best.toml" in text
    lines = summary_lines(done)
    assert lines[1].startswith(f"the best {KEEP} by residual_rms[link=2][station=2]")
    alone = run_uncontrolled(SPEC.study, is_linear=True).result.metrics.residual_rms[1, 1]
    assert done.uncontrolled == pytest.approx(float(alone), rel=1e-9)
    assert lines[-2].startswith("residual_rms[link=2][station=2] of the baseline without control")
    assert re.fullmatch(r"\d+ random designs by .* 1.00, 5 of the best 5 in common", lines[-1])
    value = done.selection.value
    for free, told in (
        (0.9 * value[0], "; no design that is kept is below it"),
        (np.mean(value[[3, 4]]), f"; {KEEP - 4} kept are not below it"),
        (1.1 * value[-1], ""),
    ):
        line = summary_lines(done._replace(uncontrolled=free, agreement=None))[-1]
        assert line.partition(", by the linear model: ")[2].partition("µm")[2] == told
    assert {"values.png", "influence.png"} <= {path.name for path in out.iterdir()}


def test_a_metric_that_the_linear_model_ranks_otherwise_is_refused(tmp_path, monkeypatch):
    poor = Agreement("structural_peak", 32, 0.53, 4)
    monkeypatch.setattr("studies.screen.run.agreement", lambda *_: poor)
    with pytest.raises(StudyError, match="structural_peak 0.53, .* screen with --fidelity full"):
        screened(tmp_path / "out")
    screened(tmp_path / "full", fidelity="full")  # nothing to compare


def test_the_command(tmp_path, capsys):
    from studies.study.template import toml_text

    file, out = tmp_path / "sweep.toml", tmp_path / "it's a screen"
    file.write_text(toml_text(small(SWEEP | {"count": 32})))
    main(["screen", str(file), "--out", str(out), "--keep", "5"])
    text = capsys.readouterr().out
    again = f"studies sweep {quote(str(out / BEST))} --out DIR"
    assert "the best 5 with a gain margin of at least 2 by" in text and again in text
    with pytest.raises(StudyError, match="holds a screen.*studies sweep '.*best.toml'"):
        read_sweep(out)
    assert again in html.unescape((out / "report.html").read_text())
    with pytest.raises(SystemExit) as ended:
        main(["screen", str(file), "--out", str(out), "--keep", "5"])
    assert ended.value.code == 2
    assert "holds a screen already; add --resume" in capsys.readouterr().err
    main(["screen", str(file), "--out", str(out), "--keep", "5", "--resume", "--quiet"])
