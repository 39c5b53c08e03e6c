"""Sweeps that keep their best designs: tallies, designs made shard by shard, and going on."""

import html
import json
import re
import shutil
import warnings
from unittest import mock

import jax
import numpy as np
import pytest

from jaxmodel import status
from studies.cli import main
from studies.engine.fidelity import Agreement
from studies.engine.folder import BASELINE, MANIFEST, RESULTS, SCREEN, finished_cases
from studies.engine.results import metric_values, read_sweep
from studies.errors import StudyError
from studies.job import working
from studies.results.labelled import Variable
from studies.screen import selection, shards
from studies.screen.local import tallies_here
from studies.screen.run import PHASES, choose, run_screen
from studies.screen.selection import select
from studies.screen.shards import axis_columns, screen_of
from studies.screen.stored import TALLY, best_sweep, read_tally, write_tally
from studies.screen.tally import (
    LEFT_OUT,
    Tally,
    divided,
    merged,
    nothing,
    quantile,
    tally_of,
)
from studies.show.pages import page
from studies.space.table import build_table
from studies.store import read_store, write_store
from studies.study.template import toml_text
from studies.sweeps import run as sweeps_run
from studies.sweeps import screened as told
from studies.sweeps.run import make_plan
from studies.sweeps.say import report_of, say, write_sweep_report
from studies.sweeps.screened import margin_rows, screen_lines, with_screen
from studies.sweeps.show import ranked_cases, recommended
from tests.bare import parse_sweep
from tests.jobs import quiet_job
from tests.pages import text_of
from tests.sweeps import HOME_PHI, narrow_blocks, run_sweep, small, small_spec

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


def kept(sweep=SWEEP, **more):
    """A sweep that keeps its best designs by the linear model, whatever their margins."""
    return small_spec({"fidelity": "linear", "keep": KEEP, "margin": 0.0} | sweep | more)


def screened(out, sweep=SWEEP, tallies=tallies_here, shard_size=32, **more):
    """What a sweep finds before it runs the best by the full model."""
    screen = screen_of(kept(sweep, **more), shard_size)
    with working("sweep", out, None, PHASES, resume=True, progress=False) as job:
        found = run_screen(screen, job, tallies)
        return choose(found, screen.spec.sweep.keep, job)


def run(spec, out, resume=False):
    """The whole sweep, in shards of 32 designs."""
    with mock.patch.object(shards, "SHARD", (32, 32)):
        return run_sweep(spec, out, resume)


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
    with pytest.raises(StudyError, match=r"1e\+12 cases; allowed: up to 10000000; sweep.keep"):
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
    run_sweep(small_spec(SWEEP | {"fidelity": "linear"}), out)
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
    few = screened(tmp_path / "few", count=count, keep=count)
    with mock.patch.object(shards, "LANES", 512):  # programs are kept by their sizes
        many = screened(tmp_path / "many", shard_size=count, count=count, keep=count)
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
    with mock.patch.object(shards, "CANDIDATES", 20):  # of no program
        done = screened(tmp_path / "screen", count=64, axes=axes, keep=8)
    assert done.n_kept == 8
    assert done.tally.endings[status.OK] <= 16  # a copy in each shard
    assert done.tally.endings[LEFT_OUT] == 64 - done.tally.endings[:LEFT_OUT].sum()


def test_a_shard_without_designs_is_counted(tmp_path):
    done = screened(tmp_path / "screen", shard_size=16, where="gain < 0.13")
    assert done.tally.n_designs == 128 > done.tally.endings[LEFT_OUT] > 96


def test_designs_that_repeat_others_are_kept_once(tmp_path):
    cases = [{"control.gain_factor": gain} for gain in (0.5, 0.7, 0.5, 0.5)]
    done = screened(tmp_path / "screen", {"method": "list", "cases": cases, "by": SWEEP["by"]})
    assert done.tally.endings[status.OK] == 2
    assert sorted(done.selection.kept.columns["control.gain_factor"]) == [0.5, 0.7]
    assert done.n_kept == 2


def test_designs_behind_a_repeated_one_keep_their_values():
    """Shards do not see each other's designs, so a tally may hold the same one twice."""
    cases = [{"control.gain_factor": gain} for gain in (0.5, 0.7, 0.5)]
    screen = screen_of(kept({"method": "list", "cases": cases, "by": SWEEP["by"]}))
    tally = nothing(screen.axes)._replace(
        row=np.array([2, 0, 1]), value=np.array([1e-6, 1e-6, 2e-6])
    )
    made_up = mock.patch.object(selection, "_margins", lambda _, table: np.full(len(table), 2.0))
    with made_up:
        job = quiet_job(None, PHASES)
        job.begin("margins")
        found = select(screen, tally, 2, job)
    assert found.table.columns["control.gain_factor"].tolist() == [0.5, 0.7]
    assert found.kept_value.tolist() == [1e-6, 2e-6]


def test_kept_designs_are_a_sweep_by_the_full_model_with_the_same_ids(whole):
    _, done = whole
    spec = best_sweep(done.screen, done.selection.kept)
    rows = done.tally.row[:KEEP]
    expected = build_table(SPEC, np.sort(rows))
    place = {int(row): k for k, row in enumerate(expected.row)}
    order = [place[row] for row in rows.tolist()]
    table = build_table(spec)
    np.testing.assert_array_equal(table.case_id, expected.case_id[order])
    np.testing.assert_array_equal(table.seed, expected.seed[order])
    assert spec.sweep.fidelity == "full" and not spec.sweep.keep
    assert parse_sweep(json.loads(json.dumps(spec.data))).sweep == spec.sweep


def test_kept_designs_have_the_margins_of_the_sweep(whole, swept):
    _, done = whole
    margin = done.selection.margin
    place = np.searchsorted(swept.table.row, done.tally.row[:KEEP])
    np.testing.assert_allclose(margin, swept["gain_margin"][place], rtol=1e-9)
    judged = f"{KEEP} candidates judged, best first: {np.sum(margin < 1)} unstable"
    assert judged in screen_lines(done)


def test_designs_with_the_margin_asked_for_are_kept(whole, swept, tmp_path):
    """The best of all that have it, as a sweep of all designs finds them; nothing runs again."""
    _, done = whole
    data, out = swept, tmp_path / "out"
    value = metric_values(data, SWEEP["by"])
    shutil.copytree(whole[0], out)  # whatever the margins
    for margin in (1.0, 2.5, 4.0):
        is_wanted = (data["gain_margin"] >= margin) & (data["status"] == status.OK)
        order = np.flatnonzero(is_wanted)[np.argsort(value[is_wanted])][:KEEP]
        found = screened(out, tallies=stopped_after(0), margin=margin)
        assert found.selection.kept.row.tolist() == data.table.row[order].tolist()
        assert f"with a gain margin of at least {margin:g}" in screen_lines(found)[1]
        assert_same(found.tally, done.tally)
    assert len(order) == KEEP  # enough have even the largest one


def test_no_design_that_has_the_margin_is_a_fault(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    words = r"sweep.margin = 60: none of \d+ candidates has it \(largest: .*ask for less"
    with pytest.raises(StudyError, match=words):
        screened(tmp_path, margin=60.0)
    assert screened(tmp_path).n_kept == KEEP


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
    done = screened(tmp_path / "out", sweep, shard_size=8)
    assert done.screen.spec.sweep.links == (1, 2)
    assert "largest of links 1 and 2 and all stations" in told._question(done.screen)
    run_sweep(small_spec(sweep), tmp_path / "sweep")
    data = read_sweep(tmp_path / "sweep")
    whole = metric_values(data, "residual_rms")
    value = dict(zip(data.table.row.tolist(), whole, strict=True))
    expected = [value[row] for row in done.tally.row.tolist()]
    np.testing.assert_allclose(done.tally.value, expected, rtol=1e-9)
    # so that those that are kept compare when they are run alone
    assert best_sweep(done.screen, done.selection.kept).sweep.links == (1, 2)
    alone = sweep | {"axes": {"control.links": links[:1], "gain": gain}, "links": [1, 2]}
    run_sweep(small_spec(alone), tmp_path / "alone")
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
    done = run(kept(sweep, margin=margin), out)
    write_sweep_report(done)
    return done, text_of((out / "report.html").read_text())


def test_designs_without_a_sampled_loop_need_no_margin(tmp_path):
    """Nothing in them can go unstable; they are kept with the others, and counted."""
    done, text = of_kinds(tmp_path / "some", 1.0)
    found = done.screen.selection
    fields = found.kept.fields["control.feedback"].tolist()
    assert sorted(fields) == ["none", "none", "sampled", "sampled"]
    assert np.isnan(found.margin[found.is_kept][np.array(fields) == "none"]).all()
    assert "2 without a sampled loop" in " ".join(screen_lines(done.screen))
    assert "nan" not in text
    none, _ = of_kinds(tmp_path / "none", 60.0)
    assert none.found.table.fields["control.feedback"].tolist() == ["none", "none"]


def test_margins_below_one_have_no_negative_counts(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path / "out")
    done = screened(tmp_path / "out", margin=0.5)
    lines = " ".join(screen_lines(done))
    assert "candidates judged, best first: " in lines and "more below that margin" not in lines


def test_candidates_that_end_before_enough_are_found_are_told(whole, monkeypatch):
    _, done = whole
    monkeypatch.setattr(told, "CANDIDATES", len(done.tally.row))
    asked = screen_of(kept(keep=1000, margin=60.0), 32)
    assert "no more than the best" in " ".join(screen_lines(done._replace(screen=asked)))


def stopped_after(count):
    """Ends after some shards, as if it had been killed."""

    def tallies(work):
        for k, answer in enumerate(tallies_here(work)):
            if k == count:
                raise StudyError("killed")
            yield answer

    return tallies


def test_an_interrupted_screen_goes_on(whole, tmp_path):
    _, done = whole
    out = tmp_path / "out"
    for count in (1, 2):
        with pytest.raises(StudyError, match="killed"):
            screened(out, tallies=stopped_after(count))
    is_done, _ = read_tally(out, done.screen)
    assert is_done.tolist() == [True, True, True, False]
    resumed = screened(out)
    assert_same(resumed.tally, done.tally)
    assert sorted(path.name for path in out.iterdir()) == sorted([".lock", TALLY, SCREEN])
    more = screened(out, keep=KEEP + 1)  # chosen among the candidates: nothing runs again
    assert more.selection.kept.row.tolist() == done.tally.row[: KEEP + 1].tolist()
    with pytest.raises(StudyError, match="was begun with another sweep"):
        screened(out, by="residual_rms[link=1][station=2]")


def lossy_tallies(work):
    """Gives a shard up."""
    for shard, tally in tallies_here(work):
        yield shard, "its workers died" if shard == 2 else tally


def test_a_lost_shard_is_said_and_retried(whole, tmp_path):
    _, done = whole
    lossy = screened(tmp_path / "out", tallies=lossy_tallies)
    assert lossy.lost == {2: "its workers died"}
    assert lossy.tally.n_designs == 128 - 32
    assert_same(screened(tmp_path / "out").tally, done.tally)


def test_ctrl_c_keeps_what_is_finished(whole, tmp_path):
    out = tmp_path / "out"

    def pressed(work):
        for answer in tallies_here(work):
            yield answer
            work.stop.set()

    with pytest.raises(KeyboardInterrupt, match="^32 of 128 designs are safe$"):
        screened(out, tallies=pressed)
    assert read_tally(out, whole[1].screen)[0].sum() == 1
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
    other = screen_of(kept(by="residual_rms[link=1][station=2]"), 32)
    write_tally(tmp_path, other, done.is_done, done.tally)  # of the same shape, from elsewhere
    with pytest.raises(StudyError, match="not what was written for these designs"):
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


def test_what_cannot_be_kept_is_refused():
    for more, message in (
        ({"repeats": 2}, "sweep.repeats = 2; allowed: 1 with sweep.keep"),
        ({"environments": ["gain"]}, "sweep.environments"),
        ({"method": "morris", "count": 4}, "sweep.keep = 12; allowed: 0 with method morris"),
        ({"keep": -1}, "sweep.keep = -1"),
        ({"keep": 100_001}, "sweep.keep = 100001; allowed: .* 100000"),
        ({"margin": -1.0}, "sweep.margin = -1.0; allowed: .*0.* 64"),
        ({"margin": 64.0}, "sweep.margin = 64.0"),
        ({"margin": float("nan")}, "sweep.margin = nan"),
        ({"keep": 0, "margin": 1.0}, "sweep.margin = 1.0; allowed: none without sweep.keep"),
        ({"by": "structral_rms"}, "structural_rms"),
        ({"by": "residual_rms[link=4]"}, "sweep.by: .*allowed"),
        ({"by": "plant_energy"}, "sweep.by = 'plant_energy'; allowed: one of sweep.metrics"),
        ({"keep": 0, "by": "-residual_rms"}, "sweep.by: '-residual_rms'"),
        ({"screen": {"keep": 0.5}}, "sweep.screen = .*: unknown field; .*keep"),
    ):
        with pytest.raises(StudyError, match=message):
            kept(**more)
    for more, message in (
        ({"where": "gain > 99"}, "true for none"),
        ({"subject_to": "gain_margn > 2"}, "did you mean 'gain_margin'?"),
        ({"subject_to": "foo > 2"}, "foo"),
        ({"subject_to": "residual_rms[link=7] < 1"}, r"link=1 to 3\]"),
        ({"subject_to": "plant_energy < 1"}, "sweep.metrics does not keep it"),
    ):
        with pytest.raises(StudyError, match=message) as fault:
            screen_of(kept(**more))
        assert "\n" not in str(fault.value)
        with pytest.raises(StudyError, match=message):
            make_plan(kept(**more))
    with jax.enable_x64(False), pytest.raises(StudyError, match="sweep.metrics = .*float32"):
        screen_of(kept())


def test_sizes_of_shards():
    """An interruption loses little of a screen of any size."""
    for count, size in ((100, 2**14), (10**6, 2**14), (3 * 10**6, 2**16), (10**9, 2**18)):
        assert screen_of(kept(count=count)).shard_size == size


def test_slow_axes_of_a_grid_are_seen():
    gains = {"from": 0.1, "to": 5.0, "count": 100}
    inner = {f"control.velocity_gain[{k}]": gains for k in range(2)}
    grid = {"method": "grid", "axes": {"control.modes": [2, 1]} | inner}
    screen = screen_of(kept(grid, where="control.velocity_gain[0] > 4"))
    assert screen.axes.names == ("control.modes", *inner)
    assert [len(centers) for centers in screen.axes.centers] == [2, 18, 20]  # 18 above 4
    assert screen.axes.centers[0].tolist() == [1, 2] and screen.axes.bounds[0].tolist() == [1.5]
    screen_of(kept(grid, by="residual_modal_rms[mode=2]"))


def test_grids_inside_random_points_are_seen():
    gains = {"from": 0.1, "to": 5.0, "count": 5000}
    block = {"method": "grid", "axes": {"control.velocity_gain[0]": gains}}
    sweep = {"method": "random", "count": 10**8, "axes": {"load.mass": {"from": 0.1, "to": 0.2}}}
    axes = screen_of(kept(sweep, blocks=[block])).axes
    assert axes.names == ("load.mass", "control.velocity_gain[0]")
    assert [len(centers) for centers in axes.centers] == [20, 20]


def test_too_many_designs_are_refused_before_any_runs():
    fine = {"from": 0.1, "to": 0.2, "count": 10**5}
    grid = {f"control.velocity_gain[{k}]": fine for k in range(3)}
    with pytest.raises(StudyError, match=r"1e\+15 designs; allowed: up to 1e\+12"):
        screen_of(kept({"method": "grid", "axes": grid}))
    with pytest.raises(StudyError, match="sweep.count = 1073741825; allowed: up to 1073741824"):
        screen_of(kept({"method": "sobol", "count": 2**30 + 1, "axes": AXES}))


def test_report_of_axes_of_text(tmp_path):
    outcome, text = of_kinds(tmp_path, 0.0)
    done = outcome.screen
    axes, tally = done.screen.axes, done.tally
    assert axes.names == ("control.feedback", "load.mass")
    assert axes.labels[0].tolist() == sorted(KINDS) and not len(axes.labels[1])
    # each kind's two values are where they belong
    for label, counts in zip(axes.labels[0], tally.sketch[axes.part(0)], strict=True):
        values = tally.value[[KINDS[row // len(MASSES)] == label for row in tally.row]]
        assert counts.sum() == len(values) == 2
        for value, share in zip(np.sort(values), (0.5, 1.0), strict=True):
            np.testing.assert_allclose(quantile(counts, share), value, rtol=0.02)
    assert "control.feedback" in text
    assert (tmp_path / "influence.png").exists()


def test_the_report_tells_what_margin_costs(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    done = screened(tmp_path, margin=2.5)
    costs = margin_rows(done).rows
    best = [float(value.split()[0]) for _, _, value in costs]
    assert best == sorted(best) and costs[0][0] == "0" and len(costs) >= 5
    count = {least: int(number) for least, number, _ in costs}
    assert count["3"] == np.sum(done.selection.margin >= 3)


def test_ends_of_axes_are_pointed_out(whole, tmp_path):
    shutil.copytree(whole[0], tmp_path, dirs_exist_ok=True)
    done = screened(tmp_path, keep=128)
    selection, axes, name = done.selection, done.screen.axes, "control.gain_factor"
    gain = axis_columns(selection.table)[name]
    order, interval = np.argsort(gain), axes.interval(axes.names.index(name), gain)

    def told(chosen):
        is_kept = np.isin(np.arange(len(gain)), chosen)
        lines = screen_lines(done._replace(selection=selection._replace(is_kept=is_kept)))
        return [line for line in lines if "widen" in line]

    assert not told(order)
    (lower,) = told(np.flatnonzero(interval == 0))
    assert f"the lower end of {name}" in lower and "upper" not in lower
    assert not told(order[len(order) // 3 : len(order) // 2])


def test_no_design_that_ends_well_is_a_fault(tmp_path):
    axes = AXES | {"gain": {"from": 500.0, "to": 1000.0}}
    with pytest.raises(StudyError, match=r"sweep.keep: none of 8 designs to keep: \d \w+"):
        screened(tmp_path, count=8, where="", axes=axes)
    assert sorted(path.name for path in tmp_path.iterdir()) == [".lock", TALLY, SCREEN]


def test_a_report_of_values_that_a_log_scale_lacks(whole, swept):
    """Negative values and zeros have no figures; where the largest are the best, so is the rest."""
    _, done = whole
    sketch = np.zeros_like(done.tally.sketch)
    sketch[:, 0] = done.tally.sketch.sum(axis=1)
    tally = done.tally._replace(value=done.tally.value - 1, sketch=sketch)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        report = with_screen(report_of(swept), done._replace(tally=tally, agreement=None), swept)
    assert not {"values", "influence"} & {getattr(x, "name", "") for x in report.parts}
    assert screen_lines(done._replace(tally=tally))[1].endswith(
        "median of those that are ok: 0 µm or less"
    )


def test_designs_without_a_value_are_counted(whole):
    """Such as by a mode that they lack; they are ok, but nothing ranks them."""
    _, done = whole
    without = done._replace(tally=done.tally._replace(sketch=0 * done.tally.sketch))
    count = done.tally.endings[status.OK]
    assert f"{count} of those that are ok have no finite" in screen_lines(without)[1]
    assert "no finite" not in "".join(screen_lines(done))


def test_a_metric_that_the_linear_model_ranks_otherwise_is_refused(tmp_path, monkeypatch):
    poor = Agreement("structural_peak", 32, 0.53, 4)
    monkeypatch.setattr("studies.screen.run.agreement", lambda *_: poor)
    with pytest.raises(StudyError, match='structural_peak 0.53, .* fidelity = "full"'):
        screened(tmp_path / "out")
    screened(tmp_path / "full", fidelity="full")  # nothing to compare


# --- the designs that are kept --------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A sweep that keeps some of its designs."""
    out = tmp_path_factory.mktemp("kept") / "sweep"
    return out, run(kept(), out)


@pytest.fixture(scope="module")
def full(tmp_path_factory):
    """The sweep of all designs by the full model."""
    out = tmp_path_factory.mktemp("full") / "all"
    run_sweep(SPEC, out)
    return read_sweep(out)


def of_ids(data, name):
    """What a sweep says of each of its cases, by their ids."""
    return dict(zip(np.array(data["case_id"], "S16").tolist(), data[name], strict=True))


def test_the_best_designs_are_a_sweep_of_the_full_model(finished, whole, full):
    out, done = finished
    assert done.n_run == done.n_cases == KEEP and not done.lost_text
    data = read_sweep(out)
    expected = whole[1].selection.kept.case_id
    assert np.array(data["case_id"], "S16").tolist() == expected.tolist()
    for name in ("status", "residual_rms", "gain_margin"):
        wanted = of_ids(full, name)
        np.testing.assert_allclose(data[name], [wanted[x] for x in expected.tolist()], rtol=1e-9)
    assert sorted(path.name for path in out.iterdir() if path.suffix in (".h5", ".json")) == sorted(
        [BASELINE, RESULTS, MANIFEST, SCREEN, TALLY]
    )
    assert run(kept(), out, True).n_run == 0


def test_the_report_tells_of_all_designs(finished):
    out, done = finished
    write_sweep_report(done)
    text = text_of((out / "report.html").read_text())
    assert "128 designs" in text and "actuators saturated" in text and "Best by" in text
    assert f"The best {KEEP} by residual_rms[link=2][station=2] of the linear model" in text
    assert "keep = 12" in say(done).files["Sweep file"]
    assert {"values.png", "influence.png"} <= {path.name for path in out.iterdir()}
    lines = say(done).result
    assert re.fullmatch(r"\d+ random designs by .* 1.00, \d of the best \d in common", lines[-2])
    assert re.fullmatch(r"\d+ kept designs by .*: rank correlation of residual_rms.*", lines[-1])
    assert page(say(done))


def test_a_sweep_that_was_stopped_anywhere_goes_on(finished, tmp_path, monkeypatch):
    """While designs are reduced or chosen, or the best run."""
    out, data = tmp_path / "out", read_sweep(finished[0])

    def stopped(owner, name):
        def once(*given, **more):
            raise StudyError("killed")

        with monkeypatch.context() as patch, pytest.raises(StudyError, match="killed"):
            patch.setattr(owner, name, once)
            run(kept(), out, out.exists())

    stopped(sweeps_run, "tallies_here")
    stopped(sweeps_run, "choose")
    with pytest.raises(StudyError, match="not yet run the designs to keep; go on with --resume"):
        read_sweep(out)
    stopped(sweeps_run, "best_sweep")
    stopped(sweeps_run.SweepFolder, "write_chunk")
    assert not len(finished_cases(out).case_id)
    stopped(sweeps_run, "merge")
    assert len(finished_cases(out).case_id) == KEEP
    done = run(kept(), out, True)
    assert done.n_cases == KEEP
    for name in ("case_id", "status", "residual_rms", "gain_margin"):
        np.testing.assert_array_equal(read_sweep(out)[name], data[name])


def test_what_has_run_stays_where_others_are_kept(finished, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(finished[0], out)
    before = set(finished_cases(out).case_id.tolist())
    more = run(kept(keep=KEEP + 4), out, True)
    assert more.n_run == 4 and more.n_cases == KEEP + 4
    safe = run(kept(margin=4.0), out, True)
    found = safe.screen.selection.kept.case_id
    assert safe.found.table.case_id[:KEEP].tolist() == found.tolist()
    assert before <= set(safe.found.table.case_id.tolist()) and safe.n_run < KEEP
    assert (read_sweep(out)["status"] >= 0).all()
    fewer = run(kept(keep=3), out, True)
    assert fewer.n_run == 0 and fewer.n_cases == safe.n_cases


#: What a condition can ask for besides: small where the metric is, so that the best lack it.
ENDS = "residual_rms[link=1][station=1]"


def test_a_condition_sends_the_sweep_further_down(tmp_path, full):
    value = metric_values(full, ENDS)[full["status"] == status.OK]
    limit = float(np.nanquantile(value, 0.6))
    done = run(kept(subject_to=f"{ENDS} > {limit}"), tmp_path / "s")
    found = read_sweep(tmp_path / "s")
    is_met = (found["status"] == status.OK) & (metric_values(found, ENDS) > limit)
    assert is_met.sum() >= KEEP < found.n_cases == done.n_run
    best = recommended(found, SWEEP["by"])
    assert is_met[best].all() and not is_met[ranked_cases(found, SWEEP["by"])].all()
    write_sweep_report(done)
    text = html.unescape(text_of((tmp_path / "s" / "report.html").read_text()))
    assert f'--subject-to "{ENDS} > {limit} and gain_margin >= 2"' in text
    assert f"do {KEEP} of them meet {ENDS} > {limit}" in text
    everything = run(kept(subject_to=f"{ENDS} < 0"), tmp_path / "none")  # runs all there are
    assert everything.n_cases == everything.screen.tally.endings[status.OK]


def test_the_plan_of_many_designs_makes_few_of_them(capsys, tmp_path):
    plan = make_plan(kept(count=10**9, where=""))
    assert len(plan.table) <= shards.TRIED
    found = [(group.structure.is_linear, group.is_judged) for group in plan.groups]
    assert found == [(True, False), (False, True)]
    assert [plan.n_cases(group) for group in plan.groups] == [10**9, KEEP]
    file = tmp_path / "sweep.toml"
    file.write_text(toml_text(small(SWEEP | {"count": 40, "keep": 5, "fidelity": "linear"})))
    main(["sweep", str(file), "--dry-run"])
    text = " ".join(capsys.readouterr().out.split())
    assert "40 designs in 1 shard (0 already computed) by the linear model" in text
    assert "the best 5 with a gain margin of at least 2 by the full one" in text


def test_the_command(tmp_path, capsys):
    file, out = tmp_path / "sweep.toml", tmp_path / "it's a sweep"
    keep = {"count": 32, "fidelity": "linear", "keep": 5}
    file.write_text(toml_text(small(SWEEP | keep)))
    main(["sweep", str(file), "--out", str(out)])
    text = capsys.readouterr().out
    assert "the best 5 with a gain margin of at least 2 by" in text and "5 cases in" in text
    with pytest.raises(SystemExit) as ended:
        main(["sweep", str(file), "--out", str(out)])
    assert ended.value.code == 2
    assert "holds a sweep already; add --resume" in capsys.readouterr().err
    main(["sweep", str(file), "--out", str(out), "--resume", "--no-progress", "--report"])
    main(["best", str(out), "--by", "residual_rms"])
    assert "gain_margin" in capsys.readouterr().out


@pytest.mark.long
@pytest.mark.parametrize(
    ("motion", "drive"),
    [
        (
            {"waypoints": [[0.0, 0.0, HOME_PHI]]},
            {"pulse_force": [20.0, -10.0, 5.0], "pulse_start": 0.002, "pulse_length": 0.002},
        ),
        ({"waypoints": [[0.0, 0.0, HOME_PHI], [0.0, 0.01, HOME_PHI]], "move_time": 0.03}, {}),
    ],
    ids=["blow", "10 mm in 0.03 s"],
)
def test_ninety_of_the_best_hundred_are_kept(tmp_path, motion, drive):
    """Of 20,000 placements and gains run in full, among the best 1000 of the linear model."""
    sweep = {
        "method": "sobol",
        "count": 20000,
        "metrics": ["residual_rms"],
        "axes": {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 2.0}},
    }
    data = {
        "run": {"duration": 0.15},
        "link": {"modes": 8},
        "shaper": {"kind": "none"},
        "metrics": {"residual_delay": 0.02, "residual_length": 0.09},
        "motion": motion,
        "drive": drive,
    }
    run_sweep(parse_sweep(data | {"sweep": sweep}), tmp_path / "full")
    full = read_sweep(tmp_path / "full")
    value = metric_values(full, "residual_rms")
    for least in (1, 2):
        keep = {"keep": 1000, "margin": float(least), "fidelity": "linear"}
        out = tmp_path / f"kept{least}"
        run_sweep(parse_sweep(data | {"sweep": sweep | keep}), out)
        rows = np.flatnonzero((full["status"] == status.OK) & (full["gain_margin"] >= least))
        best = full["case_id"][rows[np.argsort(value[rows])][:100]]
        found = np.isin(best, read_sweep(out)["case_id"]).sum()
        print(f"gain margin {least} or more: {found} of the best 100 are kept")
        assert found >= 90
