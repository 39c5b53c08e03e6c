"""Reports on made-up findings: every table is read back by its heading, every number compared."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.metrics import METRICS, Metrics, Sizes
from jaxmodel.simulate import RunResult
from studies.engine.runs import Run
from studies.engine.stability import LoopFigures
from studies.show.pages import page
from studies.show.units import READABLE, headed, number, readable, settling_text
from studies.show.words import control_text
from studies.single.run import Simulation
from studies.single.say import say
from studies.study.cases import build_case, build_structure
from studies.study.margin import GUESSED, caution, margin_in_db, margin_text
from tests.bare import paper_study
from tests.pages import tables_of, text_of

#: Numbers that no other number of a report equals.
RNG = np.random.default_rng(11)


def assert_cells(cells, values, digits=4):
    """Cells show these numbers with so many digits."""
    assert cells == [f"{x:.{digits}g}" for x in values]


# --- units ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("unit", "factor", "shown"),
    [
        ("m", 1e6, "µm"),
        ("s", 1e3, "ms"),
        ("m; m; rad", 1e6, "µm; µm; µrad"),
        ("Pa", 1e-9, "GPa"),
        ("V", 1, "V"),
        ("1", 1, "1"),
        ("N", 1, "N"),
    ],
)
def test_units_that_reports_show(unit, factor, shown):
    assert readable(unit) == (factor, shown)
    assert number(1.23456 / factor, unit) == "1.235"
    assert headed("x", unit) == ("x" if unit == "1" else f"x [{shown}]")


def test_these_are_all_units_that_are_shown_otherwise():
    assert set(READABLE) == {"m", "s", "m; m; rad", "Pa"}


@pytest.mark.parametrize(
    ("seconds", "watched", "text"),
    [
        (0.0, 0.05, "0"),
        (0.0123, 0.05, "12.3"),
        (0.0399, 0.05, "39.9"),
        (0.0401, 0.05, "not within 50"),
        (0.05, 0.05, "not within 50"),
        (0.0, 0.005, "0"),
        (0.001, 0.005, "not within 5"),
    ],
)
def test_settled_is_what_stays_in_the_band_for_a_hundredth_of_a_second(seconds, watched, text):
    assert settling_text(seconds, watched) == text


@pytest.mark.parametrize(
    ("margin", "text", "words"),
    [
        (0.0, "0", "UNSTABLE LOOP: the linearised sampled loop grows by itself, however small"),
        (0.5, "0.5", "Lower the gains below 0.5 of these."),
        (0.9999, "0.9999", "UNSTABLE LOOP"),
        (1.0, "1", "CAUTION: a gain margin of 1; below 2 a machine may go unstable."),
        (1.999, "1.999", "CAUTION"),
        (2.0, "2", ""),
        (63.99, "63.99", ""),
        (64.0, "> 64", ""),
    ],
)
def test_words_of_a_margin(margin, text, words):
    assert margin_text(margin) == text
    assert words in caution(margin) and bool(caution(margin)) == bool(words)


@pytest.mark.parametrize(
    ("margin", "text"),
    [(3.7, "3.7 (11.4 dB)"), (0.5, "0.5 (-6.0 dB)"), (0.0, "0"), (99.0, "> 64 (36.1 dB)")],
)
def test_a_margin_as_a_factor_and_in_decibels(margin, text):
    assert margin_in_db(margin) == text


@pytest.mark.parametrize(
    ("links", "words"),
    [
        ((True, False, True), " on links 1, 3, sampled feedback, "),
        ((False, True, False), " on link 2, sampled feedback, "),
        ((False, False, False), "no link controlled"),
    ],
)
def test_links_that_are_controlled_are_counted_from_one(links, words):
    assert words in control_text(paper_study().change(control__links=links))


# --- one run --------------------------------------------------------------------------------------

STUDY = paper_study().change(
    title="this",
    run__duration=0.5,
    link__modes=4,
    link__thickness=(2e-3, 2.1e-3, 1.9e-3),
    control__modes=2,
    metrics__stations=(0.2, 0.5, 0.875),
    metrics__residual_length=0.123,
    metrics__residual_delay=0.045,
    metrics__settling_band=2.5e-6,
    electronics__voltage_limit=91.0,
    drive__force_limit=77.0,
)
SIZES = Sizes(n_stations=3, n_modes=4, n_controlled=2, n_frequencies=9, n_links=3, n_pose=3)


def made_up_run(size=1.0, margin=3.25, code=status.OK, **changes):
    """A run whose numbers are all different."""
    axes = SIZES.axes
    values = {}
    for name, metric in METRICS.items():
        shape = [axes[d] for d in metric.dims]
        values[name] = size * 10.0 ** RNG.uniform(-6, -4) * RNG.uniform(1, 9, shape)
    values["peak_voltage"] = size * RNG.uniform(10, 90, 3)
    values["peak_force"] = RNG.uniform(10, 70, 3)
    values["peak_tension"], values["peak_compression"] = RNG.uniform(1, 9, (2, 3))
    values["settling_time"] = np.array([0.01234, 0.395, 0.0])
    for name in ("saturated", "clipped", "motor_saturated"):
        values[f"{name}_fraction"] = np.array(RNG.uniform(0.001, 0.01))
    signs = RNG.choice([-1.0, 1.0], (20, 1, 1))
    record = SimpleNamespace(
        chord_deflection_stations=1e-5 * RNG.uniform(1, 9, (20, 3, 3)) * signs,
        pose_error=1e-4 * RNG.uniform(1, 9, (20, 3)) * signs[:, 0],
    )
    result = RunResult(
        metrics=Metrics(values | changes),
        status=np.array(code),
        bad_time=np.array(0.0),
        command_end=np.array(0.1),
        sensor_condition=np.ones(3),
        actuator_condition=np.ones(3),
        singularity_distance=np.array(0.5),
        record=record,
    )
    loop = LoopFigures(
        spectral_radius=0.987654,
        gain_margin=margin,
        frequency_hz=RNG.uniform(100, 900, (2, 3)),
        damping_ratio=RNG.uniform(0.01, 0.3, (2, 3)),
        breaking_frequency=1199.25,
        breaking="mode 5 of link 2 (2861 Hz)",
    )
    motion = LoopFigures(
        time=np.array([0.0, 0.1, 0.2]),
        axial_force=RNG.uniform(-9, 9, (3, 3)),
        gain_margin=np.array([3.125, 2.875, 3.375]),
    )
    return Run(
        study=STUDY,
        structure=build_structure(STUDY),
        case=build_case(STUDY),
        result=result,
        loop=loop,
        motion=motion,
        status=code,
    )


class Told(Simulation):
    """A run that its sweep has something to say of."""

    notes = ("a note",)


def page_of(run, twin=None):
    """The page of a run and of the same without control."""
    found = Told(run, name="mine.toml")
    found.__dict__["free"] = twin
    return page(say(found))


@pytest.fixture(scope="module")
def one_run():
    run, twin = made_up_run(), made_up_run(7.0)
    return run, twin, page_of(run, twin)


def test_tables_of_a_run_show_its_numbers(one_run):
    run, twin, text = one_run
    m, record = run.result.metrics, run.result.record
    tables = tables_of(text)
    assert set(tables) == {"Links", "Platform", "Control loop"}
    ((links,), (platform,), (loop,)) = tables.values()
    assert list(links) == [
        "link",
        "residual rms [µm]",
        "residual rms without control [µm]",
        "residual peak [µm]",
        "peak of the run [µm]",
        "settling time [ms]",
        "peak voltage [V]",
        "peak motor force [N]",
    ]
    assert links["link"] == ["1", "2", "3"]
    assert_cells(links["residual rms [µm]"], 1e6 * m.residual_rms.max(axis=1))
    without = twin.result.metrics.residual_rms.max(axis=1)
    assert_cells(links["residual rms without control [µm]"], 1e6 * without)
    assert_cells(links["residual peak [µm]"], 1e6 * m.residual_peak.max(axis=1))
    bent = np.abs(record.chord_deflection_stations).max(axis=(0, 2))
    assert_cells(links["peak of the run [µm]"], 1e6 * bent)
    assert links["settling time [ms]"] == ["12.34", "not within 400", "0"]
    assert_cells(links["peak voltage [V]"], m.peak_voltage)
    assert_cells(links["peak motor force [N]"], m.peak_force)

    assert list(platform) == [
        "",
        "largest of the run",
        "rms in the residual window",
        "stretch of the links",
    ]
    assert platform[""] == ["x [µm]", "y [µm]", "φ [µrad]"]
    assert_cells(platform["largest of the run"], 1e6 * np.abs(record.pose_error).max(axis=0))
    assert_cells(platform["rms in the residual window"], 1e6 * m.pose_error_rms)
    assert_cells(platform["stretch of the links"], 1e6 * m.stretch_error_peak)

    assert list(loop) == ["order", "frequencies [Hz]", "damping ratios [1]"]
    assert loop["order"] == ["1", "2"]
    for k in range(2):
        frequency = ", ".join(f"{x:.2f}" for x in run.loop.frequency_hz[k])
        damping = ", ".join(f"{x:.4f}" for x in run.loop.damping_ratio[k])
        assert loop["frequencies [Hz]"][k] == frequency
        assert loop["damping ratios [1]"][k] == damping


def test_sentences_of_a_run_show_its_numbers(one_run):
    run, twin, text = one_run
    m, words = run.result.metrics, text_of(text)
    rms = m.residual_rms.max(axis=1)
    worst = int(np.argmax(rms))
    without = 1e6 * twin.result.metrics.residual_rms.max(axis=1)[worst]
    settled = ["12.34", "not within 400", "0"][worst]
    force, planned = run.motion.axial_force, run.motion.gain_margin
    error = run.result.record.pose_error
    buckling = np.pi**2 * 70e9 * 0.01 * np.array([2e-3, 2.1e-3, 1.9e-3]) ** 3 / 12 / 0.2**2
    for part in (
        GUESSED,
        f"**Result:** Status: **ok**. Residual {1e6 * rms[worst]:.4g} µm rms on link {worst + 1}, "
        f"the worst ({without:.4g} without control, "
        f"{100 * (1e6 * rms[worst] / without - 1):+.3g} %), gain margin 3.25 (10.2 dB): ",
        f"Settling time {settled} ms ({settled} without control). Peak voltage "
        f"{m.peak_voltage.max():.4g} of 91 V. The platform leaves the reference trajectory by at "
        f"most {1e6 * np.linalg.norm(error[:, :2], axis=1).max():.4g} µm and "
        f"{1e6 * abs(error[:, 2]).max():.4g} µrad.",
        "the largest of the stations at 20, 50, 87.5 % of the link.",
        "Residual window: 123 ms, from 45 ms after the reference trajectory at 100 ms.",
        f"at the centres of the pairs: {1e6 * m.patch_strain_peak.max():.4g} µm/m of 400 µm/m",
        "stays within 2.5 µm; the run ends 400 ms after it.",
        f"Largest tension in a link {m.peak_tension.max():.4g} N, largest compression "
        f"{m.peak_compression.max():.4g} N (a bare link buckles at {buckling[2]:.4g} N, link 3 as "
        "the first one)",
        f"Samples with an actuator at its limit: {100 * m.saturated_fraction:.3g} %; with a "
        f"clipped ADC channel: {100 * m.clipped_fraction:.3g} %; with a motor at its limit of 77 "
        f"N: {100 * m.motor_saturated_fraction:.3g} %.",
        "with 12 plant modes per link (the run has 4): gain margin 3.25 (10.2 dB), the factor by "
        "which the loop gain (`control.gain_factor`) can still grow; "
        "beyond it goes unstable: mode 5 of link 2 (2861 Hz); spectral radius 0.987654",
        f"CAUTION: {100 * m.clipped_fraction:.2g} % of the samples have an ADC channel clipped; "
        f"{100 * m.saturated_fraction:.2g} % of the samples have an actuator at its limit; ",
        f"({force.min():.3g} to {force.max():.3g} N), the margin goes from "
        f"{planned.min():.4g} ({20 * np.log10(planned.min()):.1f} dB) to {planned.max():.4g} ",
        "A note.",
        "`studies certify mine.toml --out certificate`",
    ):
        assert part in words, part


@pytest.mark.parametrize(
    ("run", "twin", "verdict", "words"),
    [
        ({"margin": 1.75}, 7.0, "too little margin", "lower `control.gain_factor`"),
        ({"margin": 2.0}, 7.0, "control works", "`studies certify"),
        ({"size": 7.0}, 0.7, "**control makes it worse**", "lower `control.gain_factor`, or leave"),
        ({}, 1e-4, "hardly anything to suppress", "less than 2.5 µm is left"),
        ({}, None, "not compared with a run without control", "`studies certify"),
    ],
)
def test_what_a_run_means_and_what_is_recommended_next(run, twin, verdict, words):
    one = made_up_run(**run)
    other = None if twin is None else made_up_run(twin)
    rms = 1e-5 * np.arange(1.0, 10.0).reshape(3, 3)
    one.result.metrics["residual_rms"] = rms * run.get("size", 1.0)
    if other is not None:
        other.result.metrics["residual_rms"] = rms * twin
    html = page_of(one, other)
    text = text_of(html)
    assert f" dB): {verdict}" in text.splitlines()[2]
    assert words in text.partition("**Next steps:**")[2].partition("![")[0]
    has_twin = "residual rms without control [µm]" in tables_of(html)["Links"][0]
    assert has_twin == (twin is not None)
    assert ("**CAUTION: a gain margin" in text) == ("margin" in run and run["margin"] < 2)


@pytest.mark.parametrize(
    ("before", "words"),
    [
        (0.0125, "control works, but the link settles 6 % later than without control."),
        (0.0132, "control works."),
    ],
)
def test_the_first_line_says_where_control_delays_settling(before, words):
    rms = 1e-5 * np.ones((3, 3))
    run, free = (made_up_run(1.0, 3.25, residual_rms=k * rms) for k in (1, 2))
    run.result.metrics["settling_time"] = np.full(3, 0.01325)
    free.result.metrics["settling_time"] = np.full(3, before)
    first = text_of(page_of(run, free)).splitlines()[2]
    said = "**Result:** Status: **ok**. Residual 10 µm rms on link 1, the worst (20 without"
    assert first.startswith(said)
    assert f"control, -50 %), gain margin 3.25 (10.2 dB): {words}" in first


def test_a_run_that_stopped_says_when():
    nothing = jax.tree.map(lambda x: np.full_like(x, np.nan), made_up_run().result.metrics)
    run = made_up_run(code=status.DIVERGED)
    run = run._replace(
        result=run.result._replace(metrics=nothing, bad_time=np.array(0.1875)),
        loop=None,
        motion=None,
    )
    text = text_of(page_of(run))
    assert "**Result:** Status: **diverged: bending beyond a" in text
    assert "The run stopped at 187.5 ms." in text.partition("**Question:**")[0]
    assert "esidual 0" not in text and "gain margin" not in text
    assert GUESSED not in text
