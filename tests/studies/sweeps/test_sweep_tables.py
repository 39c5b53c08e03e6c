"""Tables and reports of sweeps on made-up results: every printed number is read back."""

import re
import shutil
import warnings
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console

import studies
from campaigns.mutations import sweep_folder
from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine import design, results
from studies.engine.columns import axis_variables, case_variables, label_of
from studies.engine.fidelity import Agreement
from studies.engine.results import SweepData, metric_values
from studies.errors import ResolutionWarning, StudyError
from studies.results.labelled import Variable
from studies.show.listing import Rows, print_rows
from studies.show.pages import card, page
from studies.show.report import Drawing
from studies.single.run import Simulation
from studies.space.indices import elementary_effects, sobol_indices
from studies.space.table import build_table
from studies.study.margin import GUESSED
from studies.sweeps.documents import best_document
from studies.sweeps.dry_run import axis_rows
from studies.sweeps.environments import environments_text
from studies.sweeps.explore import _figure
from studies.sweeps.plots import MOST_LISTS, _scale_ordinate, front
from studies.sweeps.run import make_plan
from studies.sweeps.say import report_of
from studies.sweeps.sensitivity import analyse, failure_causes
from studies.sweeps.show import (
    best_cases,
    case_parts,
    case_rows,
    cause_rows,
    counted_text,
    label,
    margin_warning,
    ranked_cases,
    requirement,
    status_rows,
    uncontrolled_text,
    unranked_text,
)
from tests.pages import tables_of, text_of
from tests.studies.test_cli import run
from tests.sweeps import small_spec

GAINS = [0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8]


def made_up(axes, codes=None, sections=None, **arrays):
    """A sweep of these axes with these results; the others are missing."""
    spec = small_spec(axes if "axes" in axes else {"axes": axes}, **(sections or {}))
    table = build_table(spec)
    arrays["status"] = np.zeros(len(table), int) if codes is None else np.array(codes)
    variables = case_variables(table)
    for name, values in arrays.items():
        dims, unit, *_ = label_of(name)
        variables[name] = Variable(np.array(values), ("case", *dims), unit, name)
    sizes = {d: n for x in variables.values() for d, n in zip(x.dims, x.data.shape, strict=True)}
    return SweepData(variables | axis_variables(spec.study, sizes), {}, spec, table)


def of_links(values):
    """(n, 3) with the values for the worst link, which is another one for each case."""
    values = np.asarray(values, float)
    found = np.outer(values, [0.5, 0.4, 0.3])
    found[np.arange(len(values)), np.arange(len(values)) % 3] = values
    return found


def of_stations(values):
    """(n, 3, 3) with the values at the worst station of the worst link."""
    return of_links(values)[:, :, None] * np.array([0.9, 1.0, 0.8])


RMS = np.array([5.0, 3.0, 8.0, 1.0, 2.0, 7.0, 4.0, 6.0]) * 1e-6
MARGINS = np.array([9.0, 8.0, 7.0, 1.5, 5.0, 64.0, 3.0, 2.0])
VOLTS = np.array([10.0, 20.0, 30.0, 40.0, 50.0, 60.0, 70.0, 80.0])
SETTLING = np.array([4.0, 3.0, 2.0, 1.0, 0.0, 6.0, 14.9, 7.0]) * 1e-3
DAMPING = np.stack([np.linspace(0.1, 0.2, 8), np.linspace(0.02, 0.01, 8)], axis=1)


def usual(**changes):
    whole = {
        "residual_rms": of_stations(RMS),
        "peak_voltage": of_links(VOLTS),
        "settling_time": of_links(SETTLING),
        "gain_margin": MARGINS,
        "damping_ratio": DAMPING,
        "command_end": np.full(8, 0.01),
        "bad_time": np.zeros(8),
    }
    return made_up({"gain": GAINS}, **(whole | changes))


# --- the best cases -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("by", "subject_to", "wanted"),
    [
        ("residual_rms", "", [3, 4, 1, 6, 0, 7, 5, 2]),
        ("-residual_rms", "", [2, 5, 7, 0, 6, 1, 4, 3]),
        ("gain_margin", "", [5, 0, 1, 2, 4, 6, 7, 3]),  # the largest first
        ("-gain_margin", "", [3, 7, 6, 4, 2, 1, 0, 5]),
        ("damping_ratio[controlled_mode=1]", "", [7, 6, 5, 4, 3, 2, 1, 0]),
        ("damping_ratio", "", [0, 1, 2, 3, 4, 5, 6, 7]),  # the least damped mode counts
        ("residual_rms", "gain_margin >= 2", [4, 1, 6, 0, 7, 5, 2]),
        ("residual_rms", "gain_margin > 2", [4, 1, 6, 0, 5, 2]),
        ("residual_rms", "gain <= 0.4 and peak_voltage != 20", [3, 0, 2]),
        ("peak_voltage[link=1]", "gain > 0.55", [6, 5, 7]),  # 70, 30, 40 V
        ("residual_rms[link=2][station=3]", "gain < 0.35", [1, 0, 2]),  # 2.4, 1.6, 2.56 um
    ],
)
def test_best_cases_come_in_their_order(by, subject_to, wanted):
    data = usual()
    if "[link=" in by:  # as the arrays say
        name, (link, station) = by.partition("[")[0], (1, 2) if "station" in by else (0, None)
        array = data[name][:, link] if station is None else data[name][:, link, station]
        wanted = sorted(wanted, key=lambda k: array[k])
    assert ranked_cases(data, by, subject_to).tolist() == wanted
    assert ranked_cases(data, by, subject_to, 2).tolist() == wanted[:2]


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("disk_margin", "largest"),
        ("phase_margin", "largest"),
        ("delay_margin", "largest"),
        ("sensitivity_peak", "smallest"),
    ],
)
def test_the_best_of_margins_are_the_largest_and_of_peaks_the_smallest(name, wanted):
    rising = [3, 7, 6, 4, 2, 1, 0, 5]
    best = ranked_cases(usual(**{name: MARGINS}), name).tolist()
    assert best == (rising if wanted == "smallest" else rising[::-1])


def test_cases_without_the_number_are_never_best():
    """Not finite, or not ok: also where more are asked for than have it."""
    rms = of_stations(RMS)
    rms[3], rms[4, :, :], rms[1, 0, 0] = np.nan, np.inf, np.nan
    codes = np.zeros(8, int)
    codes[[6, 7]] = status.SATURATED, -1
    data = usual(codes=codes, residual_rms=rms)
    for by, wanted in (("residual_rms", [1, 0, 5, 2]), ("-residual_rms", [2, 5, 0, 1])):
        assert ranked_cases(data, by, count=20).tolist() == wanted
        assert ranked_cases(data, by, "gain > 0.15", count=20).tolist() == [k for k in wanted if k]
    with pytest.raises(StudyError, match="no case with status ok meets it"):
        ranked_cases(data, "residual_rms", "gain < 0.05")
    with pytest.raises(StudyError, match="no case with status ok has this metric"):
        ranked_cases(usual(residual_rms=np.full_like(rms, np.nan)), "residual_rms")


def test_a_condition_on_a_missing_number_is_not_met():
    volts = of_links(VOLTS)
    volts[[0, 4]] = np.nan
    data = usual(peak_voltage=volts)
    assert ranked_cases(data, "residual_rms", "peak_voltage < 45").tolist() == [3, 1, 2]
    assert ranked_cases(data, "residual_rms", "not peak_voltage < 45").tolist() == [6, 7, 5]
    assert ranked_cases(data, "residual_rms", "peak_voltage != 20").tolist() == [3, 6, 7, 5, 2]


def test_only_controlled_links_count():
    data = made_up(
        {"link_subsets": ["1", "1+3"]}, residual_rms=np.ones((2, 3, 3)) * [[1], [9], [2]]
    )
    np.testing.assert_array_equal(metric_values(data, "residual_rms"), [2, 2])
    np.testing.assert_array_equal(metric_values(data, "residual_rms[link=2]"), [9, 9])
    assert counted_text(data, "residual_rms") == "largest of links 1 and 3 and all stations"


def test_a_table_of_cases_shows_each_number_in_its_unit():
    data = usual()
    found = case_rows(data, np.arange(8), ["residual_rms", "settling_time"])
    assert found.heads == [
        "case",
        "id",
        "control.gain_factor",
        "residual_rms [µm]",
        "settling_time [ms]",
        "peak_voltage [V]",
        "damping_ratio[controlled_mode=1]",
        "gain_margin",
    ]
    settled = ["4", "3", "2", "1", "0", "not within 15", "not within 15", "not within 15"]
    margins = ["9", "8", "7", "1.5", "5", "> 64", "3", "2"]
    assert found.rows == [
        [
            str(k),
            str(data["case_id"][k])[:8],
            f"{GAINS[k]:.4g}",
            f"{1e6 * RMS[k]:.4g}",
            settled[k],
            f"{VOLTS[k]:.4g}",
            f"{DAMPING[k, 0]:.4g}",
            margins[k],
        ]
        for k in range(8)
    ]


def test_settling_is_watched_to_the_end_of_each_case_s_own_run():
    axes = {"run.duration": [0.025, 0.04]}
    settled = np.full((2, 3), 14.9e-3)
    data = made_up(axes, settling_time=settled, command_end=np.full(2, 0.01))
    rows = case_rows(data, np.arange(2), ["settling_time"]).rows
    assert [row[3] for row in rows] == ["not within 15", "14.9"]
    np.testing.assert_allclose(_figure(data, "settling_time").value, [np.nan, 14.9])  # [ms]


def test_what_varies_has_its_unit():
    axes = {"drive.kp": [1e4, 2e4], "placement": {"kind": "same", "candidates": 4}}
    data = made_up(axes, residual_rms=np.ones((8, 3, 3)))
    heads = case_rows(data, np.arange(8), ["residual_rms"]).heads
    assert heads[2:] == ["drive.kp [N/m]", "patches.centers [m]", "residual_rms [µm]"]


HEADS = ["case", "id", "patches.centers [m]", "residual_rms [µm]", "drive.pulse_force[0] [N]"]
LISTING = Rows(
    HEADS,
    [
        [str(k), 8 * str(k), f"[{k}.04851, {k}.1161, {k}.1432]", f"{k}.815e-05", "7"]
        for k in range(7)
    ],
)


@pytest.mark.parametrize("width", [150, 90, 75, 60, 45])
def test_no_text_of_a_table_is_cut(capsys, width):
    """Rows stand side by side where they would be too wide."""
    print_rows(LISTING, Console(width=width, markup=False, highlight=False))
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= width and "…" not in text
    columns, is_turned = {}, "case ┃ id" not in text
    for table in text.split("┏")[1:]:
        lines = [[x.strip() for x in re.split("[│┃]", line)[1:-1]] for line in table.splitlines()]
        lines = [line for line in lines if line]
        if is_turned:  # a new row begins with its heading, which may go on in the next line
            starts = [k for k, line in enumerate(lines) if line[0][:4] in {x[:4] for x in HEADS}]
            parts = [lines[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]
            for part in parts:
                head, *texts = ("".join(x).replace(" ", "") for x in zip(*part, strict=True))
                columns.setdefault(head, []).extend(texts)
        else:
            for head, *texts in zip(*_joined(lines), strict=True):
                columns[head.replace(" ", "")] = [x.replace(" ", "") for x in texts]
    wanted = zip(HEADS, *LISTING.rows, strict=True)
    assert columns == {x.replace(" ", ""): [y.replace(" ", "") for y in xs] for x, *xs in wanted}


def _joined(lines):
    """Rows of a table from its lines: each begins where the number of its case stands."""
    starts = [0, *(k for k, line in enumerate(lines) if line[0].isdigit())]
    parts = [lines[a:b] for a, b in zip(starts, [*starts[1:], None], strict=True)]
    return [["".join(cell) for cell in zip(*part, strict=True)] for part in parts]


def test_every_unit_is_shown_as_its_multiple():
    shown = {"m": (1e6, "µm"), "s": (1e3, "ms"), "m; m; rad": (1e6, "µm")}
    rng = np.random.default_rng(1)
    for name, metric in METRICS.items():
        if name == "settling_time" or "spectrum_point" in metric.dims:
            continue
        sizes = {"link": 3, "station": 3, "mode": 3, "controlled_mode": 3}
        shape = [sizes.get(d, 3) for d in metric.dims]
        values = rng.uniform(1e-6, 2e-6, (2, *shape))
        data = made_up({"gain": [0.5, 1.0]}, **{name: values})
        factor, unit = shown.get(metric.unit, (1, metric.unit))
        heading = name if metric.unit == "1" else f"{name} [{unit}]"
        found = case_rows(data, np.arange(2), [name])
        at = found.heads.index(heading)
        cells = [float(row[at]) for row in found.rows]
        counted = values[:, :2] if "pose_axis" in metric.dims else values  # not the angle
        np.testing.assert_allclose(cells, factor * counted.reshape(2, -1).max(axis=1), rtol=1e-3)
        assert label(data, name) == heading
    angle = made_up({"gain": [0.5, 1.0]}, pose_error_peak=rng.uniform(0.001, 0.002, (2, 3)))
    assert label(angle, "pose_error_peak[2]") == "pose_error_peak[2] [rad]"
    assert counted_text(angle, "pose_error_peak") == "largest of x and y"


def test_small_margins_are_counted():
    data = usual()
    assert margin_warning(data, np.array([0, 1, 7])) == ""
    said = margin_warning(data, np.array([0, 3, 7]))
    assert said.startswith("CAUTION: 1 of these 3 cases have a gain margin below 2 (smallest 1.5);")
    said = margin_warning(data, np.array([3]))
    assert said.startswith("CAUTION: this case has a gain margin below 2 (smallest 1.5);")
    assert requirement(data, "residual_rms") == "gain_margin >= 2"
    low = usual(gain_margin=np.full(8, 1.999))
    assert requirement(low, "residual_rms") == ""
    at_it = usual(gain_margin=np.full(8, 2.0))
    assert requirement(at_it, "residual_rms") == "gain_margin >= 2"
    assert margin_warning(at_it, np.arange(8)) == ""


def test_cases_that_cannot_be_ranked_are_counted():
    margin = np.array([3.0, np.nan, np.nan, 2.5, 2.5, np.nan, 4.0, 4.0])
    data = usual(codes=[0, 0, 0, 5, 5, 3, 0, 0], gain_margin=margin)
    text = unranked_text(data, "gain_margin")
    assert text == "2 cases of 5 with status ok without gain_margin: not ranked"
    cases = ranked_cases(data, "gain_margin")
    assert best_document(data, "gain_margin", cases).warnings[-1] == text
    assert unranked_text(data, "residual_rms") == ""


def test_margins_are_shown_with_what_they_leave_out():
    data, shown = usual(), []
    without = {x: y for x, y in data.variables.items() if x != "gain_margin"}
    for variables in (data.variables, without, usual(gain_margin=np.full(8, np.nan)).variables):
        parts = case_parts(replace(data, variables=variables), np.array([0]), "residual_rms")
        shown.append(GUESSED in [x for x in parts if isinstance(x, str)])
    assert shown == [True, False, False]


# --- failures -------------------------------------------------------------------------------------


def test_statuses_are_counted():
    data = usual(codes=[0, 0, 0, 5, 5, 3, -1, -1])
    assert status_rows(data).rows == [
        ["ok", "3", "37.5"],
        ["actuators saturated too often", "2", "25.0"],
        ["not run yet", "2", "25.0"],
        ["diverged: bending beyond a tenth of the link", "1", "12.5"],
    ]


def ends(part):
    return part.share, part.where


def test_rates_of_failure_are_those_of_the_lowest_and_highest_quarter():
    """Of 8 cases the first 3 (up to 0.275) and the last 3 (from 0.625), since ends count."""
    axes = {"method": "zip", "axes": {"gain": GAINS, "drive.kd": [1, 2, 3, 4, 5, 6, 7, 80.0]}}
    codes = [0, 0, 0, 4, 0, 0, 4, 4]
    found = {cause.name: cause for cause in failure_causes(made_up(axes, codes))}
    one, other = found["control.gain_factor"], found["drive.kd"]
    assert ends(one.low) == (0.0, "<= 0.275") and ends(one.high) == (1.0, ">= 0.625")
    assert ends(other.low) == (0.0, "<= 2.75") and ends(other.high) == (1.0, ">= 6.25")
    # distributions: failed at 0.4, 0.7, 0.8, ok at the five others; apart most at 0.6
    assert one.distance == pytest.approx(1 - 1 / 3)
    assert one.p_value == pytest.approx(2 * 8 / 56)  # exact: 2 x 8 of the 56 orders are as far
    row = next(x for x in cause_rows(made_up(axes, codes)).rows if x[0] == "control.gain_factor")
    assert row == ["control.gain_factor", "0.67", "0.3", "0 % (<= 0.275)", "100 % (>= 0.625)"]


def test_rates_of_failure_with_unequal_quarters():
    codes = [4, 0, 4, 0, 0, 0, 4, 0]
    (one,) = failure_causes(made_up({"gain": GAINS}, codes))
    assert ends(one.low) == (0.5, "<= 0.275") and ends(one.high) == (0.5, ">= 0.625")
    codes = [4, 4, 4, 0, 0, 4, 4, 0]
    (one,) = failure_causes(made_up({"gain": GAINS}, codes))
    assert ends(one.low) == (1.0, "<= 0.275") and ends(one.high) == (0.5, ">= 0.625")


def test_choices_name_their_best_and_worst():
    axes = {"method": "zip", "axes": {"shaper": ["zv"] * 3 + ["ei"] * 4 + ["none"], "gain": GAINS}}
    codes = [4, 4, 0, 0, 0, 4, 0, 0]
    found = {cause.name: cause for cause in failure_causes(made_up(axes, codes))}["shaper.kind"]
    assert ends(found.low) == (0.0, "none") and ends(found.high) == (2 / 3, "zv")
    # half the sum of |2/3 - 1/5|, |1/3 - 3/5|, |0 - 1/5|
    assert found.distance == pytest.approx((7 / 15 + 4 / 15 + 3 / 15) / 2)


def test_cases_that_have_not_run_are_neither():
    codes = [4, 4, 0, 0, 0, -1, -1, -2]
    (one,) = failure_causes(made_up({"gain": GAINS}, codes))
    assert (
        ends(one.low) == (1.0, "<= 0.2") and ends(one.high) == (0.0, ">= 0.4") and one.distance == 1
    )
    assert failure_causes(usual()) == [] and failure_causes(usual(codes=[4] * 8)) == []
    assert failure_causes(usual(codes=[4, 4, -1, -1, -1, -1, -1, -1])) == []


# --- sensitivity ----------------------------------------------------------------------------------

FACTORS = {
    "drive.kd": {"from": 0.0, "to": 100.0},
    "gain": {"from": 0.1, "to": 1.0},
    "drive.kp": {"from": 1e4, "to": 4e4},
}


def designed(method, count):
    """A sweep of a design of a curved metric with products u w and v w, and its points."""
    sweep = {"method": method, "count": count, "axes": FACTORS}
    table = build_table(small_spec(sweep))
    names = "drive.kd", "control.gain_factor", "drive.kp"
    low, span = (0.0, 0.1, 1e4), (100.0, 0.9, 3e4)
    points = np.stack(
        [(table.columns[n] - a) / b for n, a, b in zip(names, low, span, strict=True)], axis=1
    )
    u, v, w = points.T
    value = u * (1 + w) + 6 * (u - 0.5) ** 2 + 5 * v + 3 * w * (1 + v)
    return made_up(sweep, residual_rms=value[:, None, None] * np.ones((1, 3, 3))), points, value


def test_indices_of_a_sweep_are_printed_in_order():
    data, points, value = designed("saltelli", 64)
    found = analyse(data, "residual_rms")
    wanted = sobol_indices(value[data.table.origin], 3)
    names = list(FACTORS)
    order = np.argsort(-wanted.total)
    assert (
        [row[0] for row in found.rows]
        == [names[k] for k in order]
        == ["gain", "drive.kp", names[0]]
    )
    assert found.heads == ("factor", "first", "95 %", "total", "95 %")
    for row, k in zip(found.rows, order, strict=True):
        assert row[1] == f"{wanted.first[k]:.3f}" and row[3] == f"{wanted.total[k]:.3f}"
        for cell, (low, high) in (
            (row[2], wanted.first_interval[k]),
            (row[4], wanted.total_interval[k]),
        ):
            assert cell == f"{low:.3f} to {high:.3f}"
    main = np.array([1.5**2 + 12 * 36 / 180, 6.5**2, 5.0**2]) / 12  # closed form
    both = np.array([1, 9, 10]) / 144
    total = (main + both) / (main.sum() + both.sum() / 2)
    np.testing.assert_allclose(wanted.total, total, atol=0.06)
    assert found.n_left_out == 0 and found.what == "base points"


def test_effects_of_a_sweep_are_printed_in_order():
    data, points, value = designed("morris", 12)
    value[7] = np.nan
    data.variables["residual_rms"].data[7] = np.nan
    found = analyse(data, "residual_rms")
    every = data.table.origin  # points that a design visits twice run once
    wanted = elementary_effects(points[every], value[every])
    names, order = list(FACTORS), np.argsort(-wanted.mean_size)
    assert found.heads == ("factor", "mean |effect|", "mean effect", "deviation", "effects used")
    assert found.rows == tuple(
        (
            names[k],
            f"{wanted.mean_size[k]:.4g}",
            f"{wanted.mean[k]:.4g}",
            f"{wanted.deviation[k]:.4g}",
            str(wanted.n_used[k]),
        )
        for k in order
    )
    assert found.n_left_out >= 1 and found.what == "effects"
    assert sum(int(row[4]) for row in found.rows) == 36 - found.n_left_out


# --- commands -------------------------------------------------------------------------------------


def cells(text):
    """Rows of the tables that a command prints."""
    rows = [[cell.strip() for cell in re.split("[│┃]", row)[1:-1]] for row in text.splitlines()]
    return [row for row in rows if row]


@pytest.fixture
def printed(capsys, monkeypatch):
    def command(data, *arguments):
        monkeypatch.setattr(results, "read_sweep", lambda *_: data)
        code, text, err = run(capsys, *arguments)
        assert (code, err) == (0, "")
        return text

    return command


# --- the baseline without control -----------------------------------------------------------------


def with_baseline(data, code=0, step=1e-9):
    """The same sweep, whose baseline without control has 5.5 µm on link 2, less on the others."""
    rms = np.outer([5.0, 5.5, 4.0], [0.9, 1.0, 0.8]) * 1e-6
    baseline = {
        "status": Variable(np.array(code), (), "1", "status"),
        "adc_step": Variable(step * np.array([1.0, 1.2, 1.1]), ("link",), "m", "step"),
    }
    if code == 0:
        baseline["residual_rms"] = Variable(rms, ("link", "station"), "m", "rms")
    return replace(data, baseline=baseline)


def test_cases_worse_than_no_control_are_marked(printed):
    data = with_baseline(usual())
    cases = ranked_cases(data, "residual_rms")
    marked = [row[3] for row in case_rows(data, cases, ["residual_rms"]).rows]
    assert marked == ["1", "2", "3", "4", "5", "6 *", "7 *", "8 *"]
    told = "residual_rms of the baseline without control: 5.5 µm"
    note = "*: worse than the baseline without control, 5.5 µm"
    text = printed(data, "best", "DIR", "--by", "residual_rms")
    assert f"{told}\n" in text and f"{note}\n" in text
    text = printed(data, "best", "DIR", "--by", "residual_rms", "--count", "5")
    assert f"{told}\n" in text and note not in text
    assert f"{told}\n" in printed(data, "show", "DIR")
    text = text_of(page(report_of(data)))
    assert f"; {told}." in text.partition("## ")[0] and f"\n{note}" in text
    assert "without control" not in printed(data, "best", "DIR", "--by", "gain_margin")
    for by, value in (("residual_rms[link=3]", "4 µm"), ("residual_rms[0][2]", "4 µm")):
        assert f"control: {value}" in uncontrolled_text(data, by)
    one = with_baseline(usual(codes=[4, 4, 0, 4, 4, 0, 4, 0]))
    assert uncontrolled_text(one, "residual_rms") == f"{told}; no case is below it"
    lost = with_baseline(usual(), status.NON_FINITE)
    assert uncontrolled_text(lost, "residual_rms").endswith(f": {status.REASONS[4]}")


def test_equal_to_no_control_is_not_worse():
    """Another program rounds differently."""
    rms = of_stations(np.array([5.5e-6 * (1 + 1e-12), *RMS[1:]]))
    data = with_baseline(usual(residual_rms=rms))
    found = {row[0]: row[3] for row in case_rows(data, np.arange(8), ["residual_rms"]).rows}
    assert found["0"] == "5.5" and found["7"] == "6 *"


def test_only_controlled_links_count_without_control():
    control = {"control": {"links": [True, False, True]}}
    data = made_up({"gain": GAINS}, residual_rms=of_stations(RMS), sections=control)
    assert "control: 5 µm" in uncontrolled_text(with_baseline(data), "residual_rms")


def test_deflections_below_one_adc_step_are_not_ranked_in_silence(printed):
    data = with_baseline(usual(), step=2.5e-6)
    text = "residual_rms of 2 of these 8 cases are below one ADC step of 2.5 µm: the controller"
    with pytest.warns(ResolutionWarning, match=text):
        best_cases(data, "residual_rms")
    with pytest.warns(ResolutionWarning, match="of these 8 cases are below one ADC step of 3 µm"):
        best_cases(data, "residual_rms[link=2]")  # whose step is larger
    assert text in printed(data, "best", "DIR", "--by", "residual_rms")
    shown = text.replace("2 of these 8 cases are", "1 of these 7 cases is")  # of the safe ones
    assert shown in printed(data, "show", "DIR")
    assert text_of(page(report_of(data))).partition("## ")[0].count(shown) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for by in ("-residual_rms", "gain_margin", "peak_voltage", "settling_time"):
            best_cases(data, by, count=6)
        best_cases(with_baseline(usual()), "residual_rms")
        best_cases(usual(), "residual_rms")


def test_each_case_has_the_step_of_its_own_converter():
    rms = of_stations(np.array([1e-6, 1e-6]))
    data = with_baseline(made_up({"electronics.adc_bits": [4, 12]}, residual_rms=rms), step=1e-8)
    text = "1 of these 2 cases is below one ADC step of 2.56 µm"
    with pytest.warns(ResolutionWarning, match=text):
        best_cases(data, "residual_rms")


def test_other_windows_are_not_compared_with_the_baseline_s():
    rms = of_stations(np.array([6e-6, 7e-6]))
    data = with_baseline(made_up({"metrics.residual_delay": [0.0, 0.01]}, residual_rms=rms))
    assert uncontrolled_text(data, "residual_rms") == ""
    rows = case_rows(data, np.arange(2), ["residual_rms"]).rows
    assert [row[3] for row in rows] == ["6", "7"]


def test_show_prints_statuses_and_the_best(printed):
    data = usual(codes=[0, 0, 0, 0, 0, 0, 4, 5])
    text = printed(data, "show", "DIR")
    assert "small: 8 cases, control.gain_factor\n" in text
    best = case_rows(data, ranked_cases(data, "residual_rms", "gain_margin >= 2"), ["residual_rms"])
    assert [row[0] for row in best.rows] == ["4", "1", "0", "5", "2"]
    causes = cause_rows(data)
    endings = status_rows(data)
    assert cells(text) == [
        *(endings.heads, *endings.rows),
        *(best.heads, *best.rows),
        *(causes.heads, *causes.rows),
    ]
    assert (
        "best cases by residual_rms, smallest first, largest of all links and all stations, of"
        in text
    )
    assert "and all stations, of those with gain_margin >= 2:" in text


def test_show_lists_the_failed(printed):
    data = usual(codes=[0, 0, 0, 0, 3, 0, 5, -1], bad_time=np.arange(8) * 1e-3)
    found = cells(printed(data, "show", "DIR", "--failed"))
    ids = [str(x)[:8] for x in data["case_id"]]
    assert found[:3] == [
        ["case", "id", "status", "from [s]", "control.gain_factor"],
        ["4", ids[4], "diverged: bending beyond a tenth of the link", "0.004", "0.5"],
        ["6", ids[6], "actuators saturated too often", "", "0.7"],  # it finished
    ]


@pytest.mark.parametrize(
    ("arguments", "by", "wanted"),
    [
        (("--by", "residual_rms", "--count", "3"), "residual_rms", [3, 4, 1]),
        (("--by", "-peak_voltage", "--count", "2"), "peak_voltage", [6, 5]),
        (("--by", "gain_margin", "--subject-to", "gain < 0.45"), "gain_margin", [0, 1, 2, 3]),
        (
            ("--by", "residual_rms", "--subject-to", "gain_margin >= 3"),
            "residual_rms",
            [4, 1, 6, 0, 5, 2],
        ),
    ],
)
def test_best_prints_its_rows(printed, arguments, by, wanted):
    data = usual(codes=[0, 0, 0, 0, 0, 0, 0, 4])
    text = printed(data, "best", "DIR", *arguments)
    table = case_rows(data, np.array(wanted), [by])
    assert cells(text) == [table.heads, *table.rows]
    is_large = ("-" in arguments[1]) != (by == "gain_margin")
    assert f"by {by}, {'largest' if is_large else 'smallest'} first, " in text
    assert ("CAUTION: " in text) == (3 in wanted) and "left out: 1 non-finite number" in text


@pytest.mark.parametrize(("method", "count"), [("morris", 12), ("saltelli", 16)])
def test_sensitivity_prints_its_rows(printed, method, count):
    data, _, _ = designed(method, count)
    found = analyse(data, "residual_rms")
    text = printed(data, "sensitivity", "DIR")
    assert cells(text) == [list(found.heads), *map(list, found.rows)]
    assert f"residual_rms [µm], {len(data.table.origin)} rows of a {method} design" in text


@pytest.mark.parametrize(("margins", "scale"), [(MARGINS, "log"), (MARGINS.clip(max=9), "linear")])
def test_margins_over_decades_have_a_logarithmic_axis(margins, scale):
    (ax, *_) = front(usual(gain_margin=margins), "residual_rms").axes
    assert ax.get_xscale() == scale


def test_the_front_joins_what_has_more_margin_or_less_vibration():
    (ax, *_) = front(usual(), "residual_rms").axes
    assert ax.lines[0].get_xdata().tolist() == [64.0, 9.0, 8.0, 5.0, 1.5]
    assert np.all(np.diff(ax.lines[0].get_ydata()) < 0)


def test_an_outlier_of_many_cases_is_counted_instead_of_shown():
    value = np.linspace(1.0, 2.0, 100)
    for last, top, title in ((2.0, 2.05, ""), (9.0, 2.29, "1 above 2.29 not shown")):
        value[-1] = last
        ax = Figure().add_subplot()
        ax.plot(value)
        _scale_ordinate(ax, value)
        assert ax.get_ylim()[1] == pytest.approx(top, abs=0.01)
        assert ax.get_title(loc="right") == title


# --- the report -----------------------------------------------------------------------------------


def test_the_head_of_a_report_says_what_the_data_say():
    data = usual(codes=[0, 0, 0, 0, 0, 0, 0, 4])
    text = text_of(page(report_of(data)))
    head = text.partition("## ")[0]
    ranked = "best cases by residual_rms, smallest first, largest of all links and all stations"
    assert f"Which of 8 cases of control.gain_factor are the {ranked}, of those with" in head
    assert "7 of 8 cases ended ok (1: non-finite number)." in head
    # of 5, 3, 8, 1, 2, 7, 4 um the median is 4 and the mean 4.286
    assert "the median of the ok cases is 4 µm." in head
    assert "case 4 with 2 µm (control.gain_factor = 0.5), gain margin 5 (14.0 dB);" in head
    assert '--by "residual_rms" --subject-to "gain_margin >= 2"' in head
    assert "studies simulate DIR --case 4 " in head and "studies certify DIR --case 4 " in head
    first = "Regardless of the margin, case 3 comes first, with 1 µm at a margin of 1.5 (3.5 dB)."
    assert first in text
    assert "by only" not in head and "CAUTION" not in text


def test_the_tables_of_a_report_are_those_of_the_data():
    data = usual(codes=[0, 0, 0, 0, 0, 0, 0, 4])
    found = tables_of(page(report_of(data)))
    best = case_rows(data, np.array([4, 1, 6, 0, 5, 2]), ["residual_rms"])
    wanted = {
        "Best cases by residual_rms": best,
        "How the cases ended": status_rows(data),
        "What varied": axis_rows(data.table),
        "What the failures depend on": cause_rows(data),
    }
    assert set(found) == set(wanted)
    for name, (heads, rows) in wanted.items():
        (columns,) = found[name]
        assert list(columns) == heads and [*map(list, zip(*columns.values(), strict=True))] == rows
    assert axis_rows(data.table).rows == [["control.gain_factor", "1", "8", "0.1", "0.8"]]


def test_a_report_names_what_does_not_tell_cases_apart():
    rms = of_stations(1e-6 * (1 + 1e-3 * np.arange(8)))
    text = text_of(page(report_of(usual(residual_rms=rms))))
    # seven cases have a margin of 2, without the fourth
    assert "**The 7 best differ by only 0.7 %: residual_rms does not distinguish them; rank" in text
    wide = text_of(page(report_of(usual(residual_rms=rms**30))))
    assert "differ by only" not in wide


def test_a_report_warns_where_no_margin_is_enough():
    data = usual(gain_margin=np.linspace(1.1, 1.8, 8))
    text = text_of(page(report_of(data)))
    assert "**CAUTION: 8 of these 8 cases have a gain margin below 2 (smallest 1.1);" in text
    assert "case 3 with 1 µm (control.gain_factor = 0.4), gain margin 1.4 (2.9 dB);" in text
    ranked = "best cases by residual_rms, smallest first, largest of all links and all stations?"
    assert "Regardless" not in text and ranked in text


def test_a_report_names_links_that_no_case_controls():
    rms = np.ones((2, 3, 3)) * 1e-6 * np.array([[[2.0], [5.0], [1.0]], [[1.0], [7.0], [3.0]]])
    data = made_up({"link_subsets": ["1", "1+3"]}, residual_rms=rms)
    head = text_of(page(report_of(data))).partition("## ")[0]
    assert "case 0 with 2 µm (link_subsets = 1); link 2, which no case controls: 5 µm;" in head
    assert "largest of links 1 and 3 and all stations" in head


def test_a_card_shows_the_first_cases_of_the_report():
    html = card(report_of(usual()))
    rows = case_rows(usual(), np.array([4, 1, 6, 0, 7, 5]), ["residual_rms"]).rows
    (table,) = tables_of(f'<main>{html}<h2 id="versions">')[""]
    assert [*map(list, zip(*table.values(), strict=True))] == rows
    assert "Best by residual_rms: case 4 with 2 µm" in html and html.count("data:image") == 1


@pytest.mark.parametrize("count", [MOST_LISTS, MOST_LISTS + 1])
def test_a_report_lacks_figures_that_have_nothing_to_draw_over(count):
    """Each list of placements of all links is another one."""
    axes = {"axes": {"placement": {"kind": "per_link"}}, "method": "random", "count": count}
    data = made_up(axes, residual_rms=of_stations(np.arange(1.0, count + 1)))
    drawn = [part.name for part in report_of(data).parts if isinstance(part, Drawing)]
    assert drawn == ["machine", "cases"][: 2 - (count > MOST_LISTS)]
    same = usual(gain_margin=np.full(8, 3.0))
    assert [x.name for x in report_of(same).parts if isinstance(x, Drawing)] == ["machine", "cases"]


def test_blocks_within_blocks_are_told():
    moved = {"method": "zip", "axes": {"drive.kp": [1e4, 2e4], "load.mass": [0.0, 0.1]}}
    axes = {"gain": [k / 20 for k in range(1, 17)]}
    data = made_up({"axes": axes, "blocks": [moved]}, residual_rms=np.ones((32, 3, 3)))
    text = text_of(page(report_of(data)))
    assert "\nEvery combination of:\n" in text and ": 0.05, 0.1, " in text
    assert " 0.55, 0.6, ... (16 values).\n" in text
    assert "\n- Side by side `drive.kp`: 10000.0, 20000.0; `load.mass`: 0.0, 0.1.\n" in text


@pytest.mark.parametrize(("correlation", "is_poor"), [(0.9, False), (0.5, True)])
def test_a_report_says_how_well_the_linear_model_ranks(correlation, is_poor):
    data = made_up({"axes": {"gain": GAINS}, "fidelity": "linear"}, residual_rms=of_stations(RMS))
    agreed = Agreement("residual_rms", 8, correlation, 2)
    head = text_of(page(report_of(data, agreed=agreed))).partition("**Question:**")[0]
    assert "**All runs are of the linear model** (`sweep.fidelity`); check the best cases" in head
    assert agreed.text in head and ("**too little to rank by**" in head) == is_poor


def test_ties_keep_the_order_of_the_cases():
    data = usual(residual_rms=np.ones((8, 3, 3)))
    assert ranked_cases(data, "residual_rms").tolist() == list(range(8))
    assert ranked_cases(data, "-residual_rms").tolist() == list(range(8))


# --- names of entries, heads, and notes -----------------------------------------------------------


@pytest.mark.parametrize(
    ("sweep", "words"),
    [
        ({"by": "residual_rms[link=9]"}, r"sweep.by: .* \[link=1 to 3\]"),
        ({"by": "residual_rms[link=0]"}, r"sweep.by: .* \[link=1 to 3\], \[station=1 or more\]"),
        ({"by": "residual_rms[3]"}, r"sweep.by: .* residual_rms\[0 to 2\]\[0 or more\]"),
    ],
)
def test_an_entry_that_no_case_has_is_refused_as_the_file_is_read(sweep, words):
    with pytest.raises(StudyError, match=words):
        small_spec({"axes": {"gain": GAINS}, **sweep})


@pytest.mark.parametrize(
    "sweep",
    [
        {"by": "residual_modal_rms[mode=4]"},
        {"subject_to": "peak_voltage[link=4] < 1"},
    ],
)
def test_an_entry_that_no_case_has_is_refused_before_a_case_runs(sweep):
    """Where its number varies, as soon as the cases are known."""
    with pytest.raises(StudyError, match="mode=1 to 3|link=1 to 3"):
        make_plan(small_spec({"axes": {"plant_modes": [2, 3]}, **sweep}))


def test_a_ranking_by_an_axis_has_a_head_without_cases():
    data = usual()
    assert counted_text(data, "gain") == counted_text(data, "control.gain_factor") == ""
    assert counted_text(data, "residual_rms").startswith("largest of")


def test_repeats_are_no_environments():
    axes = {"gain": GAINS[:2], "load.mass": [0.0, 0.1, 0.2]}
    for repeats, words in (
        (1, "of its 3 environments (load.mass);"),
        (2, "of its 6 cases, environments (load.mass) times 2 repeats;"),
    ):
        sweep = {"axes": axes, "environments": ["load.mass"], "repeats": repeats}
        assert words in environments_text(made_up(sweep))


def test_a_sweep_without_a_finished_case_says_so(tmp_path, capsys):
    """Not that single precision lacks its metrics."""
    _, folder = sweep_folder(tmp_path)
    shutil.rmtree(folder / "chunks")
    code, _, text = run(capsys, "plot", folder)
    assert code == 2 and "no case has finished" in text and "float32" not in text


def test_what_of_a_folder_is_not_shown_is_said(tmp_path, capsys):
    """By every command that reads it, and by `load` as a warning and an attribute."""
    _, folder = sweep_folder(tmp_path)
    file, chunk = folder / "sweep.json", next((folder / "chunks").glob("*.h5"))
    (chunk.parent / "000007-0123456789abcdef.h5").write_bytes(b"x")
    file.write_text(re.sub(r'("gain": \[\s*)0.1', r"\g<1>0.2", file.read_text()))
    words = "2 finished cases in this folder are not of this sweep"
    damaged = "1 of the files in .* are damaged .000007-0123456789abcdef.h5."
    for command in (("show",), ("best", "--by", "residual_rms"), ("plot",)):
        code, _, text = run(capsys, command[0], folder, *command[1:])
        assert code == 0 and words in text and re.search(damaged, text)
    with pytest.warns(UserWarning, match="finished cases|damaged"):
        loaded = studies.load(folder).data
    assert words in loaded.attrs["notes"] and re.search(damaged, loaded.attrs["notes"])
    with pytest.warns(UserWarning, match="not of this sweep"):
        studies.load(folder).table()


def test_a_replay_differs_in_any_number_that_was_kept(monkeypatch):
    """Metrics, margins, conditions: within what is allowed; NaN is nothing to compare with."""
    kept = {"gain_margin": 2.0, "disk_margin": 0.5, "residual_rms": [[1.0, np.nan]], "bad_time": 0}
    kept = {name: np.array(value, float) for name, value in kept.items()}
    numbers = dict(kept)
    monkeypatch.setattr(design, "_numbers", lambda run, names: numbers)
    run = SimpleNamespace(status=0)
    assert Simulation(run, 0, design.deviations(run, kept)).agrees
    for name, factor in (("gain_margin", 1.03), ("residual_rms", 2.0), ("disk_margin", np.nan)):
        numbers[name] = factor * kept[name]
        again = Simulation(run, 0, design.deviations(run, kept))
        assert not again.agrees and any(f"{name} differs by" in note for note in again.notes)
        numbers[name] = kept[name]
    numbers["bad_time"] = np.array(1e-3)
    assert not Simulation(run, 0, design.deviations(run, kept)).agrees
    numbers |= {"bad_time": kept["bad_time"], "gain_margin": 1.01 * kept["gain_margin"]}
    assert Simulation(run, 0, design.deviations(run, kept)).agrees
    assert not Simulation(run, 3, {}).agrees
