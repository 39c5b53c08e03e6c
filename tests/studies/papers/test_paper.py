"""The paper's study end to end on a short run, and the tables and numbers it reports."""

import csv
import json
import re
from types import SimpleNamespace
from typing import NamedTuple
from unittest import mock

import jax
import jsonschema
import numpy as np
import pytest
import xarray
from matplotlib.figure import Figure

from studies.atlas import atlas_sweep, read_subsets
from studies.cli import main
from studies.documents import schema
from studies.engine.preflight import check_run
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.papers import run as papers
from studies.papers.zhang_2016 import card as paper
from studies.papers.zhang_2016 import cases as paper_cases
from studies.papers.zhang_2016 import claims, say, tables
from studies.papers.zhang_2016 import context as report_context
from studies.papers.zhang_2016 import figures as paper_figures
from studies.papers.zhang_2016.cases import ALL, MOVES, OFF, ONE, SHAPERS, TWO, run_cases
from studies.papers.zhang_2016.claims import CLAIMS, LEFT_OPEN
from studies.papers.zhang_2016.context import Context, Machines
from studies.papers.zhang_2016.measures import measure
from studies.show.figures import comparison
from studies.show.report import Drawing
from studies.show.units import span
from studies.store import read_store
from studies.study.labels import describe
from studies.study.printed import TABLE_1
from tests.bare import paper_study
from tests.jobs import quiet_job
from tests.pages import text_of
from tests.sweeps import run_sweep

#: Figures that are written; the others are only drawn.
FIGURES = ("fig03", "shapers")
#: Cases outside the grid that the short run leaves out: another program, or much the same.
LEFT_OUT = ("ideal", "paper-gains-own-ratios", "paper-ratios", "paper-preset", "difference")


def short_study():
    """One move, few modes, 0.2 s."""
    home = paper_study().motion.waypoints[0]
    return paper_study().change(
        run__duration=0.2,
        metrics__residual_length=0.015,
        link__modes=3,
        motion__waypoints=(home, (home[0], 0.01, home[2])),
    )


def is_short(case):
    """Of the moves and shapers that are not compared, three modes with all links or none do."""
    is_one = case.modes == 3 and case.links in (OFF, ALL)
    return case.name not in LEFT_OUT and (case.is_compared or is_one)


def other_machine():
    """Stands for the fitted machine: softer, with less gain; the program is the same."""
    return short_study().change(link__youngs_modulus=6e10, control__gain_factor=0.2)


class Short(NamedTuple):
    folder: object
    machines: Machines
    printed: str

    @property
    def runs(self):
        return self.machines.nominal.runs

    @property
    def measures(self):
        return self.machines.nominal.measures


@pytest.fixture(scope="module")
def short(tmp_path_factory):
    folder = tmp_path_factory.mktemp("paper")
    cases = list(filter(is_short, paper_cases.paper_cases()))
    few = {name: paper_figures.PAPER_FIGURES[name] for name in FIGURES}
    with (  # what is replaced is part of no program: they are kept
        mock.patch.object(paper_cases, "JUDGED", ()),
        mock.patch.object(say, "PAPER_FIGURES", few),
    ):
        machines = paper.evaluate(other_machine(), short_study(), cases, quiet_job(folder))
        result = papers.examined(card_of(machines), quiet_job(folder, papers.PHASES))
    return Short(folder, machines, "\n".join([*result.report().result, *result.told()]))


def card_of(machines):
    """The card with runs that are there already."""
    return paper.CARD._replace(run=lambda _: paper.result_of(machines))


def test_folder_holds_whole_files_and_nothing_else(short):
    names = sorted(file.name for file in short.folder.iterdir())
    figures = [f"{name}.png" for name in FIGURES]
    data = ["fitted.h5", "nominal.h5", "comparison.csv", "runs.csv", "claims.json"]
    assert names == sorted([*figures, *data, "machine.png", "report.html", "parts"])
    assert (short.folder / "fig03.png").read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"


def test_a_resumed_card_runs_nothing_twice(short, monkeypatch):
    monkeypatch.setattr(paper, "run_cases", None)
    cases = list(filter(is_short, paper_cases.paper_cases()))
    again = paper.evaluate(other_machine(), short_study(), cases, quiet_job(short.folder))
    assert [x.runs.cases for x in again] == [x.runs.cases for x in short.machines]
    jax.tree.map(
        np.testing.assert_array_equal,
        [(x.runs.result, x.measures) for x in again],
        [(x.runs.result, x.measures) for x in short.machines],
    )


def test_status_of_every_case_is_written(short):
    with (short.folder / "runs.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    named = [(row["machine"], row["case"], row["status"]) for row in rows]
    assert named == [
        (context.name, case.name, describe(int(code)))
        for context in short.machines
        for case, code in zip(context.runs.cases, context.runs.status, strict=True)
    ]


def test_outcome_of_every_claim_is_printed_and_kept(short):
    found = json.loads((short.folder / "claims.json").read_text(encoding="utf-8"))
    jsonschema.validate(found, schema("paper"))
    assert [one["claim"]["text"] for one in found["claims"]] == [x.text for x in CLAIMS]
    assert {claim["outcome"] for claim in found["claims"]} == {"holds", "fails"}
    page = text_of((short.folder / "report.html").read_text(encoding="utf-8"))
    for claim in found["claims"]:
        assert claim["found"] in page
    assert found["left_open"] == list(LEFT_OPEN) and all(x[1:] in page for x in LEFT_OPEN)
    assert str(short.folder / "report.html") in short.printed and "data" in short.printed


@pytest.mark.filterwarnings("error")
def test_data_open_in_xarray_and_agree_with_the_runs(short):
    with xarray.open_dataset(short.folder / "nominal.h5", engine="h5netcdf") as data:
        assert list(data["case"].values) == [case.name for case in short.runs.cases]
        for name in data.variables:
            assert data[name].attrs["long_name"] and data[name].attrs["units"]
        one = data.sel(case="fast-none-2modes-links12")
        assert one["controlled_links"] == "1+2" and one["status_text"] == "ok"
        # a case that separates two modes has no third one
        third = one["controlled_coordinate"].sel(controlled_mode=3)
        assert np.isnan(third).all() and not np.isnan(one["chord_deflection"]).any()
        middle = one["chord_deflection_stations"].sel(station=0.5, method="nearest")
        np.testing.assert_array_equal(one["chord_deflection"], middle)


def test_batched_case_equals_its_own_run(short):
    """Vmap, mode mask and padding change nothing: a two-mode case as a two-mode study alone."""
    k = short.runs.where(move="fast", shaper="none", modes=2, links=ALL)
    case = short.runs.cases[k]
    study = paper_cases.case_study(short.runs.study, case, short.runs.ratio[k])
    study = study.change(control__modes=2)
    alone = run_study(study, has_record=False, has_loop=False).result.metrics
    for name in ("residual_rms", "peak_voltage", "pose_error_rms"):
        batched = getattr(short.runs.result.metrics, name)[k]
        np.testing.assert_allclose(batched, getattr(alone, name), rtol=1e-6)


def test_controlled_cases_take_ratios_of_their_uncontrolled_counterpart(short):
    """(24) by hand for three modes; the comparison cases of section 5 control mode 1 only."""
    runs = short.runs
    off = runs.where(move="paper", shaper="none", modes=3, links=OFF)
    on = runs.where(move="paper", shaper="none", modes=3, links=ALL)
    energy = runs.result.metrics.modal_energy[off]
    omega = runs.frame.modal_omega
    by_hand = energy / energy[:, :1] * omega[:, :1] / omega
    np.testing.assert_allclose(runs.ratio[on], by_hand, rtol=1e-12)
    first = runs.where(modes=2, links=paper_cases.ONE)
    np.testing.assert_array_equal(runs.ratio[first], [[1, 0, 0]] * 3)
    assert not runs.ratio[off].any()
    two = runs.where(modes=2, links=ALL)
    np.testing.assert_array_equal(runs.ratio[two, :, 1], [0.312, 0.412, 0.355])
    assert not runs.ratio[two, :, 2].any()


def test_cases_scale_the_machine_s_own_gains(short):
    """A case multiplies the machine's gains, and keeps its damping unless it has its own."""
    fitted, case = paper_cases.fitted_study(), short.runs.cases[0]
    study = paper_cases.case_study(fitted, case._replace(gain_factor=2.0))
    assert study.control.gain_factor == 2 * fitted.control.gain_factor
    assert study.link.damping_ratio == fitted.link.damping_ratio
    assert study.control.velocity_gain == fitted.control.velocity_gain
    damped = paper_cases.case_study(fitted, case._replace(damping_ratio=0.05))
    assert damped.link.damping_ratio == 0.05


def test_fitted_machine_runs_the_compared_cases_alone(short):
    fitted, nominal = short.machines
    assert len(fitted.runs.cases) == 8 and all(case.is_compared for case in fitted.runs.cases)
    assert [case for case in nominal.runs.cases if case.is_compared] == fitted.runs.cases
    # sqrt(60/70) of the frequencies, and a fifth of the gain
    np.testing.assert_allclose(fitted.runs.link_hz / nominal.runs.link_hz, (6 / 7) ** 0.5, 1e-6)
    voltage = [c.runs.result.metrics.peak_voltage[c.compared(2, ALL)] for c in short.machines]
    assert (voltage[0] < 0.5 * voltage[1]).all()


def test_fitted_machine_has_the_measured_frequencies():
    """Links 1 and 3 have them; link 2 is stiffer."""
    hz = paper_cases.link_hz(*check_run(paper_cases.fitted_study()))[:, :2]
    apart = np.sort(np.abs(hz - np.array(tables.FREQUENCIES)), axis=0)
    assert apart[0].max() < 0.2 and apart[1].max() < 0.7


def test_both_frequencies_of_the_paper_are_those_of_one_link():
    near, far = np.array([92.5, 241.3]), np.array([95.0, 250.0])
    for hz, is_met in (([near, far], True), ([(near[0], far[1]), (far[0], near[1])], False)):
        runs = SimpleNamespace(link_hz=np.array(hz))
        assert claims._frequencies(SimpleNamespace(runs=runs))[0] is is_met


@pytest.mark.long  # in short: its frequencies, and Table 1 of another machine in the report
def test_fitted_machine_has_the_reductions_and_settling_times(monkeypatch):
    """As docs/paper-measured.md says of runs whose converters round."""
    monkeypatch.setattr(paper_cases, "JUDGED", ())
    cases = [case for case in paper_cases.paper_cases() if case.is_compared]
    runs = run_cases(paper_cases.fitted_study(), cases, lambda *_: None)
    fitted = Context("fitted machine", runs, measure(runs))
    for _, links, mode, printed in tables.printed_changes():
        change = tables.amplitude_change(fitted, links, mode)
        np.testing.assert_allclose(change, printed, atol={1: 2.5, 2: 4.7}[mode])
    held, free = (fitted.measures.settling[fitted.compared(2, x)] for x in (ALL, OFF))
    assert (held > 0.06).all() and (held < 0.09).all() and (held < 0.8 * free).all()
    assert (free > 0.1).all() and (free < 0.14).all()


@pytest.mark.long  # in short: a batched case equals its own run
def test_atlas_has_the_numbers_of_the_paper_s_cases(tmp_path, monkeypatch):
    """The subsets of the atlas go through the engine of sweeps, the paper's cases do not."""
    monkeypatch.setattr(paper_cases, "JUDGED", ())
    cases = [x for x in paper_cases.paper_cases() if x.modes == 3 and not x.is_extra]
    runs = run_cases(short_study(), cases, lambda *_: None)
    residual = measure(runs).residual
    study = runs.study.change(control__ratio_source="own_run")
    settings = tuple((time, shaper) for time in MOVES.values() for shaper in SHAPERS)
    run_sweep(atlas_sweep(study, settings), tmp_path / "runs")
    seen = read_subsets(tmp_path / "runs").whole_links()
    for place, (time, shaper) in enumerate(settings):
        move = next(name for name, value in MOVES.items() if value == time)
        for links in (OFF, ONE, TWO, ALL):
            k = runs.where(move=move, shaper=shaper, modes=3, links=links)
            subset = sum(1 << i for i in range(3) if links[i])
            metrics = runs.result.metrics
            np.testing.assert_allclose(
                seen.station[place, subset], metrics.residual_rms[k], rtol=1e-6
            )
            np.testing.assert_allclose(
                seen.pose[place, subset], metrics.pose_error_rms[k], rtol=1e-6
            )
            np.testing.assert_allclose(seen.station[place, subset, :, 1], residual[k], rtol=1e-6)
            assert residual[k].min() > 0


def test_control_acts_where_it_is_and_off_means_off(short):
    metrics = short.runs.result.metrics
    for k, case in enumerate(short.runs.cases):
        np.testing.assert_array_equal(metrics.peak_voltage[k] > 0, case.links)
    off = short.runs.where(move="fast", shaper="none", modes=3, links=OFF)
    on = short.runs.where(move="fast", shaper="none", modes=3, links=ALL)
    assert (short.measures.residual[on] < 0.1 * short.measures.residual[off]).all()


def test_spectrum_of_a_known_oscillation(short):
    """A sine of amplitude a: PSD at its frequency is a^2/2 over the Hann window's 1.5/T."""
    runs = short.runs
    record = runs.result.record
    time, amplitude = record.time[0], 2e-6
    frequency = 25 / (time.size * (time[1] - time[0]))  # on the grid, 125 Hz, near mode 1
    wave = np.broadcast_to(
        amplitude * np.sin(2 * np.pi * frequency * time)[:, None, None], (time.size, 3, 3)
    )
    coordinate = np.broadcast_to(wave, record.controlled_coordinate.shape)
    changed = record._replace(controlled_coordinate=coordinate)
    found = measure(runs._replace(result=runs.result._replace(record=changed)))
    expected = amplitude**2 / 2 * 0.2 / 1.5
    np.testing.assert_allclose(found.spectral_density[:, :, 0].max(-1), expected, rtol=1e-6)


def test_settling_of_a_known_decay(short):
    """x = exp(-t'/tau) after the move: below 5 % after tau ln 20."""
    runs = short.runs
    record, end = runs.result.record, np.asarray(runs.result.command_end)
    after = np.maximum(record.time - end[:, None], 0.0)
    tau, peak = 0.03, 1e-6
    shape = record.chord_deflection_stations.shape
    decay = np.broadcast_to((peak * np.exp(-after / tau))[..., None, None], shape)
    changed = runs.result._replace(record=record._replace(chord_deflection_stations=decay))
    found = measure(runs._replace(result=changed))
    np.testing.assert_allclose(found.settling, tau * np.log(20), atol=1.1e-4)


def test_report_holds_the_papers_numbers_and_those_of_the_run(short):
    text = text_of((short.folder / "report.html").read_text(encoding="utf-8"))
    for value in ("0.345", "0.412", "-44.97 %", "-43.23 %", "-52.21 %", "0.07 s", "241.3"):
        assert value in text
    cells = ["mode 1, first two: link 1", "-43.62 %"]
    for context in short.machines:
        density = context.runs.result.metrics.spectral_density[:, 0, 0].max(axis=-1)
        off, on = (context.compared(2, links) for links in (OFF, TWO))
        cells.append(f"{100 * ((density[on] / density[off]) ** 0.5 - 1):+.1f} %")
    assert f"| {' | '.join(cells)} |" in text
    assert text.splitlines()[2].startswith("**Result:**")
    assert re.search(r"by a factor of [\d.]+ on the paper's move and of [\d.]+ on the faster", text)
    assert "`fig06`, `fig08` and `fig10` show the error from 75 to 200 ms after it." in text
    for name in FIGURES:
        assert f"![{name}]" in text
    rows = [line for line in text.splitlines() if line.startswith("|")]
    assert len(rows) > 51
    assert any(row.startswith("| first two: x, y, φ | by more than -50 % |") for row in rows)


def test_settling_times_of_the_result_are_those_of_its_table(short):
    fitted = short.machines.fitted
    settling = 1e-3 * np.arange(fitted.measures.settling.size).reshape(-1, 3)
    made_up = fitted._replace(measures=fitted.measures._replace(settling=settling))
    off, on = tables.settling_rows(Machines(made_up, made_up))[:2]
    result = say._agreement(made_up)
    for row, times in ((off, result["free"]), (on, result["held"])):
        assert row[2] == ", ".join(f"{time:.0f}" for time in times)


def test_every_figure_stands_beside_its_table(short):
    report = paper.result_of(short.machines).report()
    drawn = [part.name for part in report.parts if isinstance(part, Drawing)]
    assert sorted(drawn) == sorted(["machine", *paper_figures.PAPER_FIGURES])


def test_table_1_percentages_are_the_papers():
    """The constants against the percentages printed in the paper's table."""
    percent = [[100 * (v / row[0] - 1) for v in row[1:]] for row in TABLE_1]
    printed = [[-44.97, -43.62, -42.30], [-42.92, -43.23, -1.50], [-42.32, -1.84, 0.92]]
    np.testing.assert_allclose(percent, printed, atol=0.006)


def test_formatting():
    assert report_context.change(0.5, 2.0) == "-75.0 %"
    assert report_context.change(1.0, 0.0) == "-"
    assert span([0.1, 0.1]) == "0.1"


def test_every_figure_has_units_on_its_axes(short):
    for _, draw in paper_figures.PAPER_FIGURES.values():
        drawn = draw(short.machines)
        assert all(ax.has_data() for ax in drawn.axes)
        labels = [ax.get_xlabel() for ax in drawn.axes if ax.get_xlabel()]
        labels += [ax.get_ylabel() for ax in drawn.axes if ax.get_ylabel()]
        # three rows over two columns: three ordinates, two abscissas
        assert len(labels) >= 4 and all("[" in label and "]" in label for label in labels)
        assert not any("[p" in label for label in labels)


def test_plot_functions_take_an_axes_or_make_one():
    time = np.linspace(0, 1, 5)
    ax = Figure().subplots()
    assert comparison(time, time, 2 * time, "x [m]", ax) is ax
    own = comparison(time, time, 2 * time, "x [m]")
    np.testing.assert_array_equal(own.lines[1].get_ydata(), 2 * time)


@pytest.mark.parametrize("place", ["file", "below a file"])
def test_refuses_a_bad_folder_before_any_work(tmp_path, capsys, place):
    file = tmp_path / "taken"
    file.write_text("mine")
    target = file if place == "file" else file / "below"
    with pytest.raises(SystemExit) as stop:
        main(["paper", "zhang_2016", "--out", str(target)])
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1 and "--out" in message and "folder" in message
    assert file.read_text() == "mine"


def test_failure_while_writing_leaves_old_files_whole(short, tmp_path, monkeypatch):
    """A figure that cannot be written: the earlier report stays, nothing half-written appears."""
    (tmp_path / "report.html").write_text("old")

    def fail(*_):
        raise OSError("disk full")

    monkeypatch.setattr(papers, "write_report", fail)
    with pytest.raises(StudyError, match="disk full"):
        papers.examined(card_of(short.machines), quiet_job(tmp_path, papers.PHASES))
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]
    assert (tmp_path / "report.html").read_text() == "old"


def test_stored_metrics_are_the_runs(short):
    stored, attributes = read_store(short.folder / "nominal.h5")
    metrics = short.runs.result.metrics
    np.testing.assert_array_equal(stored["residual_rms"].data, metrics.residual_rms)
    assert stored["residual_rms"].dims == ("case", "link", "station")
    assert "waypoints" in attributes["study"]
