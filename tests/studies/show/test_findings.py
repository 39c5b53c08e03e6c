"""Reports of certificates and tunings on made-up findings: every number against its source."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from jaxmodel import status
from studies.results.document import json_text
from studies.results.labelled import plain
from studies.show.pages import page
from studies.space.machines import ModelMismatch
from studies.spillover.certificate import Certificate
from studies.spillover.fast_move import ControlEffect
from studies.spillover.plants import PlantVariant
from studies.spillover.say import residual_text, say
from studies.study.margin import margin_in_db
from studies.tuning.audit import Disagreement
from studies.tuning.check import JudgedDesign, OwnRun, patch_centers
from studies.tuning.findings import TuneFindings
from studies.tuning.loop_figures import DesignFigures
from studies.tuning.optimise import begin
from studies.tuning.say import say as say_tuning
from studies.tuning.spec import parse_tuning
from tests.bare import paper_study
from tests.pages import tables_of, text_of
from tests.studies.show.test_reports import assert_cells
from tests.tunings import GAIN, SMALL

# --- certificates ---------------------------------------------------------------------------------

STUDY = paper_study().change(
    title="this", control__modes=2, control__gain_factor=0.4, control__links=(True, False, True)
)
BASES, SIZES = ("pinned_pinned", "pinned_free"), (2, 5)
MISMATCHES = (
    ModelMismatch(),
    ModelMismatch(1.25, 0.8),
    ModelMismatch(frequency=0.9, joint_inertia=2e-6),
)


def certificate(required=2.0, **changes):
    """Two bases, three mismatches, two sizes; one plant does not exist."""
    rng = np.random.default_rng(3)
    shape, largest = (2, 3, 2), SIZES[-1]
    plants = np.empty(shape, object)
    for b, d, n in np.ndindex(shape):
        plants[b, d, n] = PlantVariant(BASES[b], SIZES[n], MISMATCHES[d])
    exists = np.ones(shape, bool)
    exists[1, 2, 0] = False
    modes = (*shape, largest, 3)
    frequency, damping = rng.uniform(100, 900, modes), rng.uniform(0.02, 0.3, modes)
    free = rng.uniform(0.008, 0.02, modes)
    for x in (frequency, damping, free):
        x[:, :, 0, SIZES[0] :] = np.nan
        x[~exists] = np.nan
    values = {
        "study": STUDY,
        "required_margin": required,
        "n_controlled": 2,
        "variants": plants,
        "exists": exists,
        "spectral_radius": np.where(exists, rng.uniform(0.9, 0.99, shape), np.nan),
        "gain_margin": np.where(exists, rng.uniform(2.5, 9, shape), np.nan),
        "frequency": frequency,
        "damping_ratio": damping,
        "free_damping_ratio": free,
        "least_damped": np.array([f"weak {k}" for k in range(12)]).reshape(shape),
        "broken_by": np.array([f"breaks {k}" for k in range(12)]).reshape(shape),
        "observation": rng.normal(size=(2, 3, 3, 2, largest)),
        "actuation": rng.normal(size=(2, 3, 3, largest, 2)),
        "notes": ("left out: something",),
    }
    return Certificate(**(values | changes))


def fast_move(**changes):
    rms = 1e-6 * np.array([[1.5, 2.5, 0.5], [30.0, 20.0, 40.0]])
    return ControlEffect(STUDY, rms, np.array([status.OK, status.OK])).replace(**changes)


def certificate_page(found):
    return page(say(found))


def test_a_certificate_s_table_of_plants():
    found = certificate()
    (table,) = tables_of(certificate_page(found))["Margins and damping"]
    assert list(table) == [
        "basis",
        "model mismatch",
        "gain margin",
        "with 2 modes",
        "broken by",
        "smallest damping ratio",
        "least damped",
        "passes",
    ]
    order = [(b, d) for b in range(2) for d in range(3)]
    assert table["basis"] == [BASES[b] for b, _ in order]
    words = (
        "as modelled",
        "sensors x 1.25, actuators x 0.8",
        "frequencies x 0.9, J_C = 2e-06 kg m2",
    )
    assert table["model mismatch"] == [words[d] for _, d in order]
    assert_cells(table["gain margin"], found.gain_margin[:, :, 1].ravel(), 3)
    assert_cells(table["with 2 modes"][:5], found.gain_margin[:, :, 0].ravel()[:5], 3)
    assert table["with 2 modes"][5] == "-"  # there is no such plant
    assert table["broken by"] == found.broken_by[:, :, 1].ravel().tolist()
    assert table["least damped"] == found.least_damped[:, :, 1].ravel().tolist()
    least = found.damping_ratio[:, :, 1].reshape(6, -1).min(axis=1)
    assert_cells(table["smallest damping ratio"], least, 3)
    assert table["passes"] == ["yes"] * 6


def test_a_certificate_s_table_of_leakage():
    found = certificate()
    html = certificate_page(found)
    text = text_of(html)
    (table,) = tables_of(html)["Observation and control spillover"]
    size = np.abs(found.observation).max(axis=(1, 2))
    assert table["basis"] == [BASES[0]] * 2 + [BASES[1]] * 2
    assert table["estimate"] == ["q^1", "q^2"] * 2
    assert list(table)[2:] == ["mode 3", "mode 4", "mode 5"]
    for r in (2, 3, 4):
        assert_cells(table[f"mode {r + 1}"], size[:, :, r].ravel(), 2)
    seen, pushed = np.abs(found.observation[..., 2:]), np.abs(found.actuation[:, :, :, 2:])
    b, d, _, j, r = np.unravel_index(np.argmax(seen), seen.shape)
    words = " ".join(text.split())
    worst = f"Worst: mode {r + 3} in q^{j + 1}, {seen.max():.3g} ({BASES[b]}, {MISMATCHES[d]})."
    assert worst in words
    b, d, _, r, j = np.unravel_index(np.argmax(pushed), pushed.shape)
    assert f"up to {pushed.max():.3g} of itself (mode {j + 1} on mode {r + 3}, {BASES[b]})" in words


def test_a_certificate_s_table_of_the_fast_move():
    html = certificate_page(certificate(fast_move=fast_move()))
    (table,) = tables_of(html)["The fast move"]
    assert table["control"] == ["on", "off"] and table["run"] == ["ok", "ok"]
    assert table["residual rms by link [µm]"] == ["1.5 / 2.5 / 0.5", "30 / 20 / 40"]


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({}, "2.5 µm rms on its worst link, 40 without control, -93.8 %"),
        (
            {"status": np.array([status.SATURATED, status.OK])},
            "-93.8 % (run with control: actuators saturated too often)",
        ),
        (
            {"residual_rms": 1e-6 * np.array([[50.0, 1, 1], [40.0, 1, 1]])},
            "50 µm rms on its worst link, 40 without control, +25 %",
        ),
        (
            {"residual_rms": 1e-6 * np.array([[1.0, 1, 1], [0.0, 0, 0]])},
            "1 µm rms on its worst link, 0 without control",
        ),
        (
            {
                "residual_rms": np.array([[np.nan] * 3, [1e-6] * 3]),
                "status": np.array([status.NON_FINITE, status.OK]),
            },
            "no figure (run with control: ",
        ),
    ],
)
def test_a_certificate_says_what_control_leaves(changes, sentence):
    """In the result, in JSON, and in capitals where it makes things worse."""
    found = certificate(fast_move=fast_move(**changes))
    text = residual_text(found)
    assert sentence in text
    is_worse = bool(found.fast_move.worst[0] > found.fast_move.worst[1])
    assert text.startswith("CONTROL MAKES IT WORSE: ") == is_worse
    words = " ".join(text_of(certificate_page(found)).split())
    assert text[1:] in words[: words.index("**Question:**")]
    kept = json.loads(json_text(found))["fast_move"]
    assert kept["residual_rms"] == plain(found.fast_move.residual_rms)


def test_a_certificate_without_a_fast_move_says_nothing_of_it():
    found = certificate()
    assert residual_text(found) == "" and json.loads(json_text(found))["fast_move"] is None
    assert "The fast move" not in certificate_page(found)


def test_a_certificate_s_sentences():
    found = certificate()
    margin = np.nanmin(found.gain_margin)
    words = text_of(certificate_page(found))
    at = found.variants[np.unravel_index(np.nanargmin(found.gain_margin), found.gain_margin.shape)]
    free = found.free_damping_ratio
    last = found.gain_margin[:, :, 1]
    change = np.nanmax(np.abs(found.gain_margin[:, :, 0] / last - 1))
    shown = margin_in_db(margin, 3)
    for part in (
        "# this: spillover certificate passed",
        f"**Result:** Passed: gain margin {margin:.3g}, 2 required; first to go unstable beyond "
        f"it: {found.broken_by[found.worst]}.",
        "This: is its controller stable on 11 plants that differ",
        "11 of 11 plants pass (1 more left out, see below)",
        "basis pinned_pinned, 2 controlled modes per link on links 1+3, gain factor 0.4,",
        f"Smallest margin: {shown}, on {at.basis}, {at.n_modes} modes per link, {at.mismatch}.",
        f"Margins with 2 and 5 modes differ by up to {100 * change:.2g} %.",
        f"(without control: {np.nanmin(free):.3g} to {np.nanmax(free):.3g})",
        "`studies export DESIGN --target c",
    ):
        assert part in words, part


@pytest.mark.parametrize("required", [2.0, 2.75, 3.0])
def test_a_margin_equal_to_the_required_one_passes(required):
    margin = certificate().gain_margin
    margin[margin < 3.5] = 3.5
    margin[0, 1, 1] = required
    found = certificate(required, gain_margin=margin)
    assert found.is_passed and found.passes.sum() == 11 and found.fails_from == 0
    assert found.worst == (0, 1, 1)
    margin[0, 1, 1] = np.nextafter(required, 0)
    found = certificate(required, gain_margin=margin)
    assert not found.is_passed and found.passes.sum() == 10 and found.fails_from == 5
    margin[1, 0] = 1.5
    assert certificate(required, gain_margin=margin).fails_from == 2


def test_an_unstable_plant_fails_whatever_its_margin():
    radius = certificate().spectral_radius
    radius[1, 0, 0] = 1 + 1e-5
    found = certificate(spectral_radius=radius)
    assert not found.is_passed and found.fails_from == 2
    table = tables_of(certificate_page(found))["Margins and damping"][0]
    assert table["passes"] == ["yes"] * 3 + ["no"] + ["yes"] * 2


def test_a_certificate_names_the_uncontrolled_mode_that_control_makes_worst():
    """Of existing plants and modes beyond the controlled ones, in the first lines and in JSON."""
    found = certificate()
    first = text_of(certificate_page(found)).partition("**Question:**")[0]
    assert found.spillover is None and "ontrol spillover" not in first
    assert json.loads(json_text(found))["spillover"] is None
    zeta = found.damping_ratio.copy()
    zeta[0, 2, 1, 3, 1] = 0.8 * found.free_damping_ratio[0, 2, 1, 3, 1]
    zeta[1, 1, 1, 4, 2] = 0.5 * found.free_damping_ratio[1, 1, 1, 4, 2]  # the worst
    zeta[1, 0, 1, 1, 0] = 0.1 * found.free_damping_ratio[1, 0, 1, 1, 0]  # controlled
    worse = found.replace(damping_ratio=zeta)
    at = worse.spillover
    plant = found.variants[1, 1, 1]
    assert (at.mode, at.basis, at.n_modes) == (5, plant.basis, plant.n_modes)
    assert at.mismatch == str(plant.mismatch)
    assert at.damping_ratio == zeta[1, 1, 1, 4, 2]
    assert at.free_damping == found.free_damping_ratio[1, 1, 1, 4, 2]
    text = text_of(certificate_page(worse))
    sentence = (
        f"Control spillover: mode 5, which is not controlled, has a damping ratio of "
        f"{at.damping_ratio:.2g} instead of {at.free_damping:.2g} without control"
    )
    assert sentence in text[: text.index("**Question:**")]
    kept = json.loads(json_text(worse))["spillover"]
    assert kept["mode"] == 5 and kept["damping_ratio"] == pytest.approx(at.damping_ratio)
    assert kept["free_damping"] == pytest.approx(at.free_damping)
    assert (kept["basis"], kept["n_modes"]) == (at.basis, 5)


def test_a_failed_certificate_says_what_would_pass():
    margin = certificate().gain_margin
    margin[1, 1, 0] = 1.5
    found = certificate(gain_margin=margin)
    assert found.verdict == "failed by breaks 8: gain margin 1.5, 2 required"
    words = text_of(certificate_page(found))
    assert "with its gains scaled by 0.75 the controller would pass" in words
    assert "`control.gain_factor = 0.3`" in words and "10 of 11 plants pass" in words
    margin[1, 1, 0] = 0
    words = text_of(certificate_page(certificate(gain_margin=margin)))
    assert "no gain passes: choose another basis or velocity estimator, or another law" in words
    passed = certificate().verdict
    at = certificate().worst
    assert passed == (
        f"passed: gain margin {certificate().gain_margin[at]:.3g}, 2 required; first to go "
        f"unstable beyond it: {certificate().broken_by[at]}"
    )


def test_a_certificate_s_document_has_every_number():
    found = certificate(fast_move=fast_move())
    data = json.loads(json_text(found))
    assert data["required_margin"] == 2 and data["is_passed"] and data["fails_from"] == 0
    assert data["smallest_margin"] == np.nanmin(found.gain_margin)
    assert data["verdict"] == found.verdict and data["notes"] == list(found.notes)
    assert data["title"] == "this" and data["study"] == STUDY.model_dump(mode="json")
    wanted = []
    for at in np.ndindex(found.exists.shape):
        if not found.exists[at]:
            continue
        true = found.variants[at].mismatch
        wanted.append(
            {
                "basis": found.variants[at].basis,
                "plant_modes": found.variants[at].n_modes,
                "mismatch": str(true),
                "sensor_factor": true.sensor,
                "actuator_factor": true.actuator,
                "frequency_factor": true.frequency,
                "joint_inertia_c": [true.joint_inertia or 0.0] * 3,
                "passes": True,
                "spectral_radius": found.spectral_radius[at],
                "gain_margin": found.gain_margin[at],
                "broken_by": found.broken_by[at],
                "least_damped": found.least_damped[at],
                "frequency": plain(found.frequency[at]),
                "damping_ratio": plain(found.damping_ratio[at]),
                "free_damping_ratio": plain(found.free_damping_ratio[at]),
            }
        )
    assert data["plants"] == wanted
    move = found.fast_move
    assert data["fast_move"] == {
        "residual_rms": move.residual_rms.tolist(),
        "status": [status.OK, status.OK],
        "control": ["on", "off"],
        "move_time": move.move_time,
        "ended": ["ok", "ok"],
    }


# --- tunings --------------------------------------------------------------------------------------

MOVES, MACHINES = 2, 3


def tuned():
    """A tuning of two families on two moves, and what it found: all numbers differ."""
    spec = parse_tuning(
        {
            **SMALL,
            "tune": {
                "free": GAIN | {"drive.kp": {"from": 1e4, "to": 4e4}},
                "families": {"gains": {"free": ["control.gain_factor"]}, "all": {}},
                "starts": 1,
                "iterations": 20,
                "limits": {"peak_voltage": 30.0, "gain_margin": 1.5},
                "scenarios": {
                    "count": 1,
                    "check": MACHINES,
                    "each": {"motion.move_time": [0.03, 0.035]},
                    "spread": {"link.youngs_modulus": 5.0},
                },
            },
        }
    )
    at = begin(spec, SimpleNamespace(linear=None))
    at = at._replace(
        iteration=np.array(20),
        best_objective=np.array([0.5, 0.25]),
        best_limits=np.array([[-0.2, -0.3], [-0.01, -0.5]]),
        best_place=np.array([[0.25, 0.5], [0.5, 1.0]]),
        best_peaks=np.array([[24.0, 0.0], [29.7, 0.0]]),
    )
    rng = np.random.default_rng(6)

    def judged(size, loop):
        n = MOVES * MACHINES
        metrics = {
            "residual_rms": size * 1e-6 * rng.uniform(1, 9, n),
            "peak_voltage": rng.uniform(10, 90, n),
            "settling_time": 1e-3 * rng.uniform(1, 9, n),
        }
        own = {
            "residual_rms": size * 1e-6 * rng.uniform(1, 9),
            "peak_voltage": rng.uniform(10, 90),
            "settling_time": 1e-3 * rng.uniform(1, 9),
        }
        return JudgedDesign(
            objective=size * rng.uniform(0.9, 1.1, n),
            metrics=metrics,
            status=np.array([0] * (n - 1) + [status.SATURATED]),
            watched=np.full(n, 0.03),
            loop=loop,
            own_run=OwnRun(size * rng.uniform(0.9, 1.1), own, status.OK, 0.03),
            tuned_loop={"gain_margin": np.array([loop.gain_margin])},
            fresh_loop={"gain_margin": loop.gain_margin - np.array([0.25, 0.5, 0.125])},
        )

    loops = (
        DesignFigures(3.125, 71.25, 0.875, 0.5),
        DesignFigures(2.625, 81.5, 0.75, 0.625),
        DesignFigures(2.375, 91.75, 0.125, 0.375),
    )
    own, *designs = (judged(s, x) for s, x in zip((1.0, 0.5, 0.25), loops, strict=True))
    audited = [
        Disagreement("drive.kp", "all", 0, "objective", 1.0, 1.0, 2.5e-7),
        Disagreement("control.gain_factor", "all", 1, "peak_voltage", 1.0, 1.0, 1.5e-6),
    ]
    nothing = np.full(2, np.nan)
    found = TuneFindings(
        spec=spec,
        at=at,
        baseline=own,
        judged=designs,
        audited=audited,
        linear=nothing,
        residual=nothing,
        searched=None,
        run_time=0.1,
        runs=20,
    )
    html = page(say_tuning(found))
    return spec, found, tables_of(html), text_of(html)


NAMES = ("residual_rms", "settling_time", "peak_voltage")
HEADS = {"residual_rms": "residual_rms [µm]", "settling_time": "settling_time [ms]"}
HEADS["peak_voltage"] = "peak_voltage [V]"
FACTOR = {"residual_rms": 1e6, "settling_time": 1e3, "peak_voltage": 1.0}


def test_a_tuning_s_table_of_the_own_machine():
    _, found, tables, _ = tuned()
    (table,) = tables["On the nominal machine"]
    designs = [found.baseline, *found.judged]
    assert table["design"] == ["baseline", "gains", "all"]
    assert table["file"] == ["study.toml", "tuned_gains.toml", "tuned_all.toml"]
    assert table["objective"] == [f"{x.own_run.objective:.4f}" for x in designs]
    for name in NAMES:
        assert_cells(table[HEADS[name]], [FACTOR[name] * x.own_run.metrics[name] for x in designs])
    assert_cells(table["gain margin"], [x.loop.gain_margin for x in designs])
    assert_cells(table["slowest decay [1/s]"], [x.loop.slowest_decay for x in designs])
    assert_cells(table["spillover"], [x.loop.spillover for x in designs])
    assert table["status"] == ["ok"] * 3 and len(table) == 10


def test_a_tuning_s_table_of_fresh_machines():
    _, found, tables, _ = tuned()
    (table,) = tables["On fresh machines"]
    designs = [found.baseline, *found.judged]
    assert table["objective, mean"] == [f"{x.objective.mean():.4f}" for x in designs]
    assert table["objective, worst"] == [f"{x.objective.max():.4f}" for x in designs]
    for name in NAMES:
        assert_cells(table[HEADS[name]], [FACTOR[name] * x.metrics[name].max() for x in designs])
    assert table["statuses"] == ["5 ok, 1 actuators saturated too often"] * 3
    assert_cells(table["gain margin"], [x.loop.gain_margin - 0.5 for x in designs])  # the worst one


def test_a_tuning_s_table_of_changes_has_each_move_s_own():
    _, found, tables, _ = tuned()
    (table,) = tables["Change relative to the baseline"]
    assert table["design"] == ["gains", "gains", "all", "all"]
    assert table["move"] == ["motion.move_time = 0.03", "motion.move_time = 0.035"] * 2
    parts = [slice(0, 3), slice(3, 6)]

    def change(after, before=1.0):
        return f"{100 * (after / before - 1):+.1f} %"

    wanted = [change(x.objective[part].mean()) for x in found.judged for part in parts]
    assert table["objective"] == wanted and len(set(wanted)) == 4
    for name in NAMES:
        assert table[name] == [
            change(x.metrics[name][part].mean(), found.baseline.metrics[name][part].mean())
            for x in found.judged
            for part in parts
        ]


def test_a_tuning_s_limits_and_numbers():
    _, _, tables, text = tuned()
    words = " ".join(text.split())
    (table,) = tables["Limits on the scenarios of the tuning"]
    assert table["design"] == ["gains", "gains", "all", "all"]
    assert table["limit"] == ["peak_voltage at most 30", "gain_margin at least 1.5"] * 2
    # 2.625/1.5 = 1.75 and 2.375/1.5 = 1.583
    assert table["left"] == ["20.00 %", "75.00 %", "1.00 %", "58.33 %"]
    assert table["state"] == ["inactive", "inactive", "active", "inactive"]
    for part in (
        "Those of the loop: on the nominal machine, the only one of the tuning.",
        "worst disagreement is 1.5e-06 (of peak_voltage by control.gain_factor), below 0.0001.",
        "Ended after all 20 iterations",
    ):
        assert part in words, part
    (table,) = tables["Parameters"]
    assert table["parameter"] == ["control.gain_factor", "drive.kp"]
    assert table["bounds"] == ["0.05 to 2", "10000 to 40000"]
    assert table["baseline"] == ["1", "2e+04"]
    # a quarter of the way on a logarithmic scale; the middle, and the end of a linear one
    assert table["gains"] == [f"{0.05 * 40**0.25:.4g}", "-"]
    assert table["all"] == [f"{0.05 * 40**0.5:.4g}", "4e+04*"]


def test_placements_are_shown_in_millimetres_along_each_link():
    """Not as the numbers from 0 to 1 that the descent moves."""
    spec = parse_tuning(
        {**SMALL, "tune": {"free": {"placement": {"kind": "per_link"}}, "starts": 1}}
    )
    _, found, *_ = tuned()
    place = np.full((1, len(spec.free.names)), 0.5)
    at = found.at._replace(
        best_objective=np.ones(1),
        best_limits=np.zeros((1, 0)),
        best_place=place,
        best_peaks=np.zeros((1, 0)),
    )
    audited = [Disagreement("placement[2][0]", "tuned", 0, "objective", 1.0, 1.0, 0.0)]
    found = replace(
        found,
        spec=spec,
        at=at,
        judged=found.judged[:1],
        audited=audited,
        linear=np.full(1, np.nan),
        residual=np.full(1, np.nan),
    )
    html = page(say_tuning(found))
    text = text_of(html)
    (table,) = tables_of(html)["Parameters"]
    centers = 1e3 * patch_centers(spec, spec.moving[0], place[0])
    assert table["design"] == ["baseline", "tuned"]
    for i, row in enumerate(centers):
        assert table[f"centres on link {i + 1} [mm]"][1] == ", ".join(f"{x:.1f}" for x in row)
        assert 0 < row.min() < row.max() < 200
    assert "placement[" not in text and "(of objective by placement)," in text


def test_a_tuning_s_summary_and_recommendation():
    spec, found, _, text = tuned()
    head = " ".join(text.split("## ")[0].split())
    one, own = found.judged[1], found.baseline

    def change(name):
        return f"{100 * (one.own_run.metrics[name] / own.own_run.metrics[name] - 1):+.3g} %"

    for part in (
        f"**Result:** The best design is all: residual_rms {change('residual_rms')} "
        f"({1e6 * one.own_run.metrics['residual_rms']:.4g} instead of "
        f"{1e6 * own.own_run.metrics['residual_rms']:.4g} µm), ",
        f"settling_time {change('settling_time')} (",
        f"peak_voltage {change('peak_voltage')} ({one.own_run.metrics['peak_voltage']:.4g} "
        f"instead of {own.own_run.metrics['peak_voltage']:.4g} V)",
        "gain_margin 2.38 (7.5 dB) instead of 3.12 (9.9 dB) on the nominal machine",
        "slowest_decay +28.8 % (91.8 instead of 71.2 1/s)",
        "spillover -85.7 % (0.125 instead of 0.875)",
        "`studies simulate tuned_all.toml",
    ):
        assert part in head, part
    better, worse = head.partition("**Question:**")[0].split(" but ")  # what is worse comes last
    assert "residual_rms" in better and "slowest_decay" in better and "gain_margin" in worse
    assert say_tuning(found).result[1:] == [
        f"design {name}: {x.objective.mean():.4f} of the baseline's objective on 3 fresh machines, "
        f"worst {x.objective.max():.4f}; on the worst of them gain_margin "
        f"{x.loop.gain_margin - 0.5:.4g}{stop}"
        for name, x, stop in zip(
            ("gains", "all"), found.judged, ("", "; stopped by peak_voltage"), strict=True
        )
    ]
    assert found._repr_html_().count("data:image/png;base64,") == 1
    alone = spec.tune.scenarios.model_copy(update={"spread": {}, "machines": {}})
    spec = spec._replace(tune=spec.tune.model_copy(update={"scenarios": alone}))
    _, first, *_, last = say_tuning(replace(found, spec=spec)).result
    assert "on 3 runs of the nominal machine" in first and "nothing of robustness" in last
