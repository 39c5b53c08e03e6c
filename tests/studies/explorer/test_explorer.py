"""Explorers: what a page holds, which cases it shows and reruns, how it behaves in a browser."""

import json
import os
import re
from base64 import b64encode
from hashlib import sha256
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from studies.engine.front import pareto_front
from studies.errors import StudyError
from studies.explorer import replays
from studies.explorer.page import explorer_page, write_explorer
from studies.explorer.replays import exaggeration, replayed, rows_to_replay
from studies.explorer.table import MOST_CASES, Column, ExplorerTable, shown_rows, text_column
from studies.extensions import VARIABLE, options
from studies.show.skeleton import Skeleton
from tests.bare import paper_study
from tests.browser import opened
from tests.pages import TITLE, about, unpacked
from tests.studies.test_cli import refused

UNSTABLE = 3


def table_of(n, seed=0):
    """Cases with two parameters, a text, a metric and a margin; those without margin failed."""
    rng = np.random.default_rng(seed)
    gain, kp = rng.random(n), rng.random(n)
    margin = np.exp(3 * (gain - 0.3))
    status = np.where(margin < 1, UNSTABLE, 0)
    residual = np.where(status, np.nan, np.exp(2 * kp - gain))
    laws = np.array(["pole_placement", "emc"])[(kp > 0.5).astype(int)]
    return ExplorerTable(
        title="cases",
        noun="case",
        columns=(
            Column("gain", "", gain, is_parameter=True),
            Column("drive.kp", "N/m", kp, is_parameter=True),
            text_column("control.law", laws, is_parameter=True),
            Column("residual_rms", "µm", residual, is_log=True, better="smallest"),
            Column("gain_margin", "", margin, is_log=True, better="largest"),
        ),
        status=status,
        reasons={0: "ok", UNSTABLE: "unstable"},
        names=tuple(map(str, range(n))),
        rank="residual_rms",
        baseline={"residual_rms": 9.0},
    )


def test_a_page_holds_its_numbers():
    table = table_of(50)
    data, numbers = unpacked(explorer_page(table))
    for column, kept in zip(table.columns, data["columns"], strict=True):
        np.testing.assert_allclose(numbers(kept["value"]), column.value, rtol=1e-6)
    assert data["columns"][2]["labels"] == list(dict.fromkeys(table.columns[2].labels))
    assert data["columns"][data["rank"]]["name"] == "residual_rms"
    assert [x["baseline"] for x in data["columns"]] == [None, None, None, 9.0, None]
    np.testing.assert_array_equal(numbers(data["status"]), table.status)


def test_a_page_begins_with_its_question_and_its_outcome():
    table = table_of(50)._replace(about={"varied": "gain"}, conditions={"gain_margin": 2.0})
    n_failed = int(np.sum(table.status != 0))
    assert about(explorer_page(table)) == {
        "varied": "gain",
        "cases": f"50 cases: {50 - n_failed} ok, {n_failed} unstable",
        "ranked": "by residual_rms, smallest first; selected at first: gain_margin ≥ 2",
    }


@pytest.mark.parametrize(
    ("peak", "factor"), [(1e-3, 20), (0.04, 0.4), (1.7e-8, 9e5), (1.5e-8, 0), (0.0, 0)]
)
def test_bending_too_small_to_see_is_not_drawn(peak, factor):
    """A fifth of a metre bends by 16 mm in drawings."""
    assert exaggeration(peak, 0.2) == pytest.approx(factor)


def bent_run(peak):
    """A run of 0.2 s whose reference trajectory ends after 0.1 s and whose links bend so much."""
    time = np.linspace(0, 0.2, 201)
    record = SimpleNamespace(time=time, pose=np.zeros(201), modal_coordinate=np.zeros(201))
    result = SimpleNamespace(record=record, command_end=0.1)
    bent = np.full((201, 3), -peak)
    return SimpleNamespace(result=result, study=paper_study(), bent=bent)


def test_replays_are_counted_as_they_are_done():
    def invalid(row):
        raise StudyError("it cannot run alone")

    done = []
    assert replayed([4, 7, 9], invalid, lambda *count: done.append(count)) == ()
    assert done == [(1, 3), (2, 3), (3, 3)]


def test_a_case_and_its_baseline_are_drawn_by_the_larger_bending_from_the_end_of_the_move():
    still = Skeleton(np.zeros((1, 3, 2, 2)), *2 * [np.zeros((1, 3, 2))], np.zeros((1, 3, 9, 2)))
    with mock.patch.multiple(
        replays,  # of no program
        run_study=lambda *_, **__: bent_run(1e-4),
        uncontrolled_twin=lambda _: bent_run(1.6e-3),
        chord_deflection=lambda run: run.bent,
        skeleton=lambda *_: still,
    ):
        (case,) = replayed([7], lambda _: None, lambda *_: None)
    assert case.row == 7 and case.exaggeration == 10  # 16 mm of 0.2 m
    assert [x.deflection[0, 0] for x in case.motions] == pytest.approx([-100, -1600])
    assert (case.time[0], case.time[-1]) == pytest.approx((-100, 100))
    assert (case.frame_time[0], case.frame_time[-1]) == pytest.approx((-100, 50), abs=1)


def test_a_command_names_the_files_that_were_loaded(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    names = [str(tmp_path / "my laws.py"), str(tmp_path / "more.py")]
    monkeypatch.setenv(VARIABLE, os.pathsep.join(names))
    assert options() == "--with 'my laws.py' --with more.py "
    monkeypatch.delenv(VARIABLE)
    assert options() == ""


def test_a_page_stands_alone_and_runs_its_own_script_only():
    page = explorer_page(table_of(5)._replace(title=TITLE, names=tuple(["</script><b>"] * 5)))
    policy = re.search('http-equiv="Content-Security-Policy" content="([^"]*)"', page)[1]
    script = re.search("<script>(.*)</script>", page, re.DOTALL)[1]
    digest = b64encode(sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none';") and f"script-src 'sha256-{digest}'" in policy
    assert page.count("<script") == 3 and page.count("</script>") == 3
    assert not re.search(r'(src|href)="', page) and "&lt;script&gt;alert(1)" in page
    assert unpacked(page)[0]["names"][0] == "</script><b>"


def test_of_too_many_cases_the_best_and_a_spread_are_shown():
    table = table_of(3 * MOST_CASES)
    rows = shown_rows(table)
    assert 0.95 * MOST_CASES < len(rows) <= MOST_CASES and len(set(rows)) == len(rows)
    assert set(table.order[:1000]) <= set(rows)
    failed = table.status[rows] != 0
    assert 0.5 < failed.mean() / (table.status != 0).mean() < 1.5
    page = explorer_page(table)
    assert f"{len(rows):,} of {3 * MOST_CASES:,} cases" in page
    data, numbers = unpacked(page)
    shown = [int(name) for name in data["names"]]  # each beside the numbers of its own case
    kept = numbers(data["columns"][0]["value"])
    np.testing.assert_allclose(kept, table.columns[0].value[shown], rtol=1e-6)
    assert "the best by residual_rms" not in explorer_page(table_of(100))


def test_cases_that_failed_come_last_whatever_their_figures():
    """Saturated ones have figures, too."""
    table = table_of(50)
    failed = table.status != 0
    residual = np.where(failed, 1e-3, table.column("residual_rms").value)
    order = table._replace(
        columns=(Column("residual_rms", "µm", residual, better="smallest"),)
    ).order
    assert failed[order].tolist() == sorted(failed)
    assert np.all(np.diff(residual[order[: np.sum(~failed)]]) >= 0)


@pytest.mark.parametrize("seed", range(5))
def test_the_best_case_within_any_limits_is_replayed(seed):
    rng = np.random.default_rng(seed)
    figures = rng.random((300, 3)).round(2)
    figures[:, 0] = 2 - figures[:, 1] * figures[:, 2] + 0.1 * figures[:, 0]
    order = np.argsort(figures[:, 0], kind="stable")
    rows = rows_to_replay(order, figures, 10_000)
    for limits in rng.random((50, 2)):
        kept = order[np.all(figures[order, 1:] <= limits, axis=1)]
        if len(kept):
            best = figures[kept[0], 0]
            assert any(
                figures[row, 0] == best and np.all(figures[row, 1:] <= limits) for row in rows
            )
    few = rows_to_replay(order, figures, 24)
    assert len(few) <= 24 and few[0] == order[0] and len(set(few)) == len(few)


def test_a_front_is_what_nothing_beats():
    """Beside ties, equal rows and missing figures."""
    rng = np.random.default_rng(1)
    figures = rng.integers(0, 12, (200, 3)).astype(float)
    figures[::7, 2] = np.nan
    known = np.where(np.isnan(figures), np.inf, figures)
    is_beaten = [np.any(np.all(known <= x, axis=1) & np.any(known < x, axis=1)) for x in known]
    wanted = np.unique(known[~np.array(is_beaten)], axis=0)
    front = pareto_front(figures)
    np.testing.assert_array_equal(np.unique(known[front], axis=0), wanted)
    assert 1 < len(front) == len(wanted) and np.all(np.diff(known[front, 0]) >= 0)


def test_rows_without_a_figure_displace_no_other():
    rng = np.random.default_rng(0)
    figures = rng.random((400, 3))
    figures[::2, 1] = np.nan  # such as the margin of loops without feedback
    order = np.argsort(figures[:, 0], kind="stable")
    whole = [row for row in order if not np.isnan(figures[row]).any()]
    front = rows_to_replay(np.array(whole), figures, 10_000)[:5]
    assert set(front) <= set(rows_to_replay(order, figures, 10_000))
    rows = rows_to_replay(order, figures, 24)
    assert np.isnan(figures[rows]).any(axis=1).mean() < 0.5
    assert rows_to_replay(order[:0], figures) == []


def test_values_that_a_page_cannot_hold_are_missing_and_named():
    table = table_of(4)
    value = np.array([1e-60, 1e-3, 1.0, 1e300])
    page = explorer_page(
        table._replace(columns=(*table.columns, Column("tiny", "", value, is_log=True)))
    )
    data, numbers = unpacked(page)
    shown = numbers(data["columns"][-1]["value"])
    assert np.isnan(shown[[0, 3]]).all() and np.isfinite(shown[1:3]).all()
    assert "Some values of tiny are too large or too small" in page


def test_a_case_is_named_in_each_part_of_its_command(tmp_path):
    table = table_of(30)._replace(command=("replay 'a {}' --case ", " --out case-", ".h5"))
    path = tmp_path / "explorer.html"
    path.write_text(explorer_page(table), encoding="utf-8")
    with opened(path, tmp_path, 1280) as tab:
        tab.evaluate(READY)
        best = table.order[0]
        code = tab.evaluate("document.querySelector('[data-part=hint] code').textContent")
        assert code == f"replay 'a {{}}' --case {best} --out case-{best}.h5"
        first, second = (
            f"""(() => {{ const s = document.querySelector("#conditions select");
            s.value = "{k}"; s.dispatchEvent(new Event("change")); }})()"""
            for k in (0, 1)
        )
        for script in (first, second):
            tab.evaluate(script)
            seen = at_rest(tab)
        assert seen["conditions"] == 2 and tab.errors == []


SEEN = """({
  count: document.getElementById("count").textContent,
  rows: [...document.querySelectorAll("#cases tbody tr")].map((x) => x.cells[0].textContent),
  conditions: document.querySelectorAll("#conditions li").length,
  chosen: document.querySelector("[data-part=name]").textContent,
  front: document.querySelector(".scatter p").textContent,
  over: document.documentElement.scrollWidth - innerWidth,
})"""
READY = """new Promise((done) => {
  const look = () => document.body?.dataset.isReady === "" ? done() : setTimeout(look, 20);
  look();
})"""


def corner(tab, element):
    """Where an element begins in the window, after it has been scrolled to its middle [px]."""
    box = f"document.querySelector({json.dumps(element)})"
    tab.evaluate(f"{box}.scrollIntoView({{block: 'center'}})")
    return tab.evaluate(f"(({{left, top}}) => [left, top])({box}.getBoundingClientRect())")


def dragged(tab, element, start, end):
    """What is seen after a drag from one place of an element to another."""
    left, top = corner(tab, element)
    tab.drag((left + start[0], top + start[1]), (left + end[0], top + end[1]))
    return at_rest(tab)


def at_rest(tab):
    """What is seen once it stays the same."""
    before, seen = None, tab.evaluate(SEEN)
    while before != seen:
        tab.settle()
        before, seen = seen, tab.evaluate(SEEN)
    return seen


@pytest.mark.parametrize("width", [1280, 390])
def test_brushing_changes_what_is_shown(tmp_path, width):
    table = table_of(400)
    path = tmp_path / "explorer.html"
    path.write_text(explorer_page(table), encoding="utf-8")
    with opened(path, tmp_path, width) as tab:
        tab.evaluate(READY)
        first = at_rest(tab)
        parallel, scatter = "#parallel canvas", ".scatter canvas"
        brushed = dragged(tab, parallel, (52, 60), (52, 160))
        released = dragged(tab, parallel, (52, 200), (52, 200))
        both = dragged(tab, scatter, (70, 40), (200, 250))
        tab.evaluate("document.querySelector('[name=clear]').click()")
        tab.evaluate("document.querySelector('[name=failures]').click()")
        without_failures = at_rest(tab)
        tab.evaluate("document.querySelector('#cases tbody tr:nth-child(3)').click()")
        third = tab.evaluate(SEEN)
        assert tab.errors == [] and third["over"] <= 0
        widths = tab.evaluate(
            "[...document.querySelectorAll('#cases th')].map((x) => x.offsetWidth)"
        )
        assert max(widths[1:5]) < (160 if width > 700 else 90)  # of numbers
    order, ok = table.order, np.flatnonzero(table.status == 0)
    assert first["count"].startswith("400 of 400 cases selected") and first["conditions"] == 0
    assert first["rows"] == [str(k) for k in order[:25]] and first["chosen"] == f"case {order[0]}"
    # pixels of the axis, from its upper end at 46 to its lower one at 286
    gain = table.column("gain").value
    inner, outer = (
        [
            str(k)
            for k in order
            if abs((286 - 110) - (gain[k] - gain.min()) / np.ptp(gain) * (286 - 46)) <= 50 + slack
        ]
        for slack in (-1, 1)  # the window's pixels may lie between those of the page
    )
    count = int(brushed["count"].split()[0])
    assert len(inner) <= count <= len(outer) < 300 and brushed["conditions"] == 1
    assert set(brushed["rows"]) <= set(outer)
    assert brushed["rows"] == [k for k in outer if k in brushed["rows"]]  # the best come first
    assert {**released, "chosen": ""} == {**first, "chosen": ""}  # the chosen case stays
    assert both["conditions"] == 2 and both["count"] != first["count"]
    assert without_failures["count"] == f"{len(ok)} of 400 cases selected"
    assert "Pareto front" in without_failures["front"]
    assert third["chosen"] == f"case {order[2]}"


def test_a_folder_without_results_is_refused(capsys, tmp_path):
    assert "no results of a sweep, a tuning, a fit or an atlas" in refused(
        capsys, "explore", tmp_path
    )


def test_a_table_that_cannot_be_filled_leaves_no_page(tmp_path):
    def fill(folder, on_progress):
        raise StudyError("no case has run")

    with pytest.raises(StudyError, match="no case has run"):
        write_explorer(tmp_path, fill)
    assert list(tmp_path.iterdir()) == []
