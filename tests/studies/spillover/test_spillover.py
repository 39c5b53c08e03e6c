"""Spillover certificates and control laws: known designs, closed forms, and the nonlinear run."""

import json
import re
from types import SimpleNamespace
from unittest import mock

import jax
import jsonschema
import numpy as np
import pytest
import scipy.linalg
import xarray

from jaxmodel import status
from jaxmodel.channels import strongest
from jaxmodel.controller import (
    ControllerState,
    controller_step,
    linear_parts,
    rest_controller,
)
from jaxmodel.electronics import measurement_chain
from jaxmodel.laws.lqr import optimal_gains
from jaxmodel.laws.ppf import HIGHEST_RATIO, design_position_filter
from studies.documents import schema
from studies.engine.controller import fixed_controller
from studies.engine.fast_motion import FAST, WINDOW, make_fast
from studies.engine.runs import run_study
from studies.engine.stability import LoopFigures, loop_report
from studies.errors import StudyError
from studies.results.breaking import BreakingChange, ChangedNumber
from studies.results.labelled import document
from studies.show import figures
from studies.space.machines import BOX, TOLERANCES
from studies.spillover import ModelMismatch, certificate, certify, patch_lengths
from studies.spillover import run as spillover_run
from studies.spillover.fast_move import run_fast_move
from studies.spillover.plants import LoopBuilder, all_plants, pad_channels
from studies.spillover.proofs import AllModes, Proofs, ProvenBox
from studies.spillover.say import _largest
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.template import study_template
from studies.study.window import residual_delay
from tests.bare import paper_study
from tests.canonical import MACHINE, study_of
from tests.pages import parsed, text_of
from tests.studies.test_cli import refused, run

#: What runs need; certificates have plants of their own.
STUDY = study_of(MACHINE)
#: The paper's gains with a plain difference for the velocity, on truncated plants: known to be
#: unstable.
DIFFERENCE = {
    "control__gain_factor": 1.0,
    "electronics__estimator": "difference",
    "electronics__antialias_hz": 1000.0,
    "control__velocity_gain": (3.1, 3.1, 3.1),
    "link__static_correction": False,
}
SAME = {"bases": ("pinned_pinned",), "mismatches": (ModelMismatch(),)}
#: Where the default design has its smallest margin of all plants.
HARD = {"bases": ("pinned_pinned",), "mismatches": patch_lengths((0.8,)), "sizes": (8, 9)}


def certified(changes, **plants):
    return certify(STUDY.change(**changes), **plants)


@pytest.fixture(scope="module")
def difference():
    return certified(DIFFERENCE, sizes=(6, 7), **SAME)


# --- certificates ---------------------------------------------------------------------------------


def test_the_certificate_fails_what_is_known_to_be_unstable(difference):
    assert not difference.is_passed and difference.fails_from == 7
    np.testing.assert_array_equal(difference.passes.ravel(), [True, False])
    # numbers found elsewhere
    np.testing.assert_allclose(difference.gain_margin.ravel(), [5.97, 0.19], rtol=0.03)
    assert difference.spectral_radius[0, 0, 1] > 1.1
    broken_by = difference.broken_by[difference.worst]
    assert broken_by.startswith("mode 7 of link") and broken_by.endswith("(5605 Hz)")
    assert difference.least_damping[difference.worst] < 0
    assert difference.least_damped[difference.worst].startswith("mode 7 of link")


def test_verdicts_of_the_ladder_of_gains():
    """A quarter and a half of the paper's gains pass; the whole does not."""
    found = {f: certified({"control__gain_factor": f}, **HARD) for f in (0.5, 1.0, 2.0)}
    assert [one.is_passed for one in found.values()] == [True, True, False]
    worst = [one.gain_margin[one.worst] for one in found.values()]
    # the same loops, so margins go as 1/f
    np.testing.assert_allclose(np.array(worst) * list(found), 2 * worst[2], rtol=2e-4)
    paper = found[2.0]
    assert paper.fails_from == 8 and np.all(paper.spectral_radius < 1)
    # at 1.2 kHz, where the modes above are springs
    wanted = r"a controller's filter at 1\d\d\d Hz, fed by modes 7\+9 of link 2 \(5605, 9265 Hz\)"
    assert re.fullmatch(wanted, paper.broken_by[paper.worst])
    # eight modes say nearly what nine do; truncated, they say what was found elsewhere
    np.testing.assert_allclose(paper.gain_margin[0, 0], 1.441, rtol=0.025)
    truncated = certified({"control__gain_factor": 2.0, "link__static_correction": False}, **HARD)
    np.testing.assert_allclose(truncated.gain_margin[truncated.worst], 1.249, atol=2e-3)


def test_a_required_margin_decides():
    strict = certified({}, margin=3.0, **HARD)
    assert not strict.is_passed and strict.required_margin == 3.0
    with pytest.raises(StudyError, match="--margin = 1.0; allowed: more than 1"):
        certified({}, margin=1.0, **HARD)


def test_margins_and_damping_are_those_of_the_loop_report():
    one = certified({}, sizes=(3, 8), **SAME)
    structure = build_structure(STUDY)
    home = np.array(STUDY.motion.waypoints[0])
    report = loop_report(structure, as_arrays(build_case(STUDY)), home, n_modes=3)
    np.testing.assert_allclose(one.gain_margin[0, 0, 0], report.gain_margin, rtol=2e-4)
    np.testing.assert_allclose(one.spectral_radius[0, 0, 0], report.spectral_radius, rtol=1e-9)
    for own, wanted in (
        (one.damping_ratio, report.damping_ratio),
        (one.frequency, report.frequency_hz),
    ):
        own = np.sort(own[0, 0, 0, :3], axis=1)
        np.testing.assert_allclose(own, np.sort(wanted, axis=1), rtol=1e-6)
    # and, truncated with eight modes, those computed elsewhere
    one = certified({"link__static_correction": False}, sizes=(8,), **SAME)
    np.testing.assert_allclose(20 * np.log10(one.gain_margin[0, 0, 0]), 12.9, atol=0.1)
    zeta = one.damping_ratio[0, 0, 0].min(axis=1)
    np.testing.assert_allclose(zeta[:3], [0.248, 0.028, 0.011], atol=1e-3)
    # modes above half the sample rate keep their true frequency
    np.testing.assert_allclose(one.frequency[0, 0, 0, 7].mean(), 64 * 114.4, rtol=0.01)
    np.testing.assert_allclose(zeta[7], 0.01, rtol=0.01)


def test_longer_actuators_give_damping():
    lengths = patch_lengths((1.0, 1.25))  # sensors first
    found = certified({}, sizes=(3,), bases=("pinned_pinned",), mismatches=lengths)
    first = found.damping_ratio[0, :, 0, 0].min(axis=1)
    assert np.all(first[1::2] > 1.05 * first[::2])
    # the plant sees the true length, the controller divides by what it believes: 1.2 times q^_1
    seen = np.abs(found.observation[0, 0, 0, 0, 0]), np.abs(found.actuation[0, :2, 0, 0, 0])
    np.testing.assert_allclose(seen[0], 1, atol=1e-9)
    ratio = np.sin(np.pi * 0.0375 / 2 / 0.2) / np.sin(np.pi * 0.03 / 2 / 0.2)
    np.testing.assert_allclose(seen[1], [1, ratio], rtol=1e-9)


def test_leakage_of_the_papers_filter():
    """In its own basis and on pinned-pinned plants: the numbers known beforehand."""
    changes = {"control__basis": "pinned_free"}
    found = certified(
        changes, sizes=(8,), bases=("pinned_free", "pinned_pinned"), mismatches=(ModelMismatch(),)
    )
    own, other = found.observation[:, 0, 0, 0]
    np.testing.assert_allclose(own[:3], [1, 0, 0], atol=1e-9)
    np.testing.assert_allclose(own[3:6], [0.21, 1.29, 10.4], atol=0.04)
    np.testing.assert_allclose(other[4:7], [-1.1, 6.5, 41], rtol=0.02)
    np.testing.assert_allclose(other[[3, 7]], 0, atol=1e-9)
    np.testing.assert_allclose(found.actuation[0, 0, 0, :3], np.eye(3), atol=1e-9)


def test_the_largest_leakage_is_named_by_its_modes_and_plant():
    """Of plants with one number of modes."""
    leakage = np.zeros((2, 2, 3, 2, 4))
    leakage[1, 0, 2, 1, 3], leakage[0, 1] = -0.7, np.nan
    variants = np.array([["a", "b"], ["c", "d"]])[..., None]
    found = _largest(SimpleNamespace(n_controlled=2, variants=variants), leakage)
    assert found == (0.7, 6, 2, "c")


def test_plants_that_do_not_exist_are_left_out():
    centers = (0.05, 0.085, 0.15)
    found = certify(
        STUDY.change(patches__centers=centers),
        sizes=(3,),
        bases=SAME["bases"],
        mismatches=patch_lengths((1.0, 1.25)),
    )
    np.testing.assert_array_equal(found.exists[0, :, 0], [True, False] * 2)
    assert np.all(np.isnan(found.gain_margin[~found.exists])) and found.broken_by[0, 1, 0] == ""
    assert found.notes[0] == "left out: sensors x 1, actuators x 1.25: patches overlap"
    assert len(found.notes) == 2
    locked = STUDY.change(drive__locked=True, motion__waypoints=STUDY.motion.waypoints[:1])
    builder = LoopBuilder(fixed_controller(STUDY)._replace(study=locked))
    plants = all_plants(("pinned_free", "loaded"), (ModelMismatch(),), (3,)).ravel()
    assert "locked" in builder.fault(plants[0]) and builder.fault(plants[1]) == ""


@pytest.mark.long  # in short: plants with other bases, and what is known to be unstable
def test_links_that_are_softer_and_joints_with_inertia():
    """As if the study said so, the controller's coefficients staying as they are."""
    true = (
        ModelMismatch(frequency=0.9),
        ModelMismatch(joint_inertia=1.1e-5),
        ModelMismatch(joint_inertia=0.0),
    )
    found = certified({}, sizes=(12,), bases=("pinned_pinned", "loaded"), mismatches=true)
    # the last one is what the study says
    np.testing.assert_array_equal(found.exists[..., 0], [[True, False], [True, True]])
    assert found.notes == (
        "left out: pinned_pinned: it has no rotary inertia of 1.1e-05 kg m2 at the joints",
    )
    law, home = fixed_controller(STUDY).controller, np.array(STUDY.motion.waypoints[0])
    other = {
        (0, 0): {"link__stiffness_factor": 0.81},
        (1, 1): {"link__basis": "loaded", "link__joint_inertia_c": 1.1e-5},
    }
    for at, changes in other.items():
        study = STUDY.change(link__modes=12, **changes)
        structure, case = build_structure(study), as_arrays(build_case(study))
        report = loop_report(structure, case, home, law=law)
        np.testing.assert_allclose(found.gain_margin[at][0], report.gain_margin, rtol=2e-4)
        np.testing.assert_allclose(
            np.sort(found.frequency[at][0, :3], axis=1),
            np.sort(report.frequency_hz, axis=1),
            rtol=1e-6,
        )


def test_plants_that_buckle_by_themselves_are_left_out():
    """103 N of compression: links of 90 % of the frequency hold 81 % of 115 N."""
    study = STUDY.change(load__wrench=(0.0, 0.0, -18.5))
    true = (ModelMismatch(), ModelMismatch(frequency=0.9))
    found = certify(study, sizes=(3,), bases=SAME["bases"], mismatches=true)
    assert found.notes == (
        "left out: pinned_pinned, frequencies x 0.9: it buckles without control",
    )
    np.testing.assert_array_equal(found.exists[0, :, 0], [True, False])
    with pytest.raises(StudyError, match="no plant to judge on: .*buckles"):
        certify(study, sizes=(3,), bases=SAME["bases"], mismatches=true[1:])


def test_damping_stands_beside_that_without_control():
    ratios = ((0.005,), (0.01,), (0.02,))
    changes = {"link__damping_ratio": ratios, "link__damping_law": "stiffness"}
    found = certified(changes, sizes=(3,), **SAME)
    free = found.free_damping_ratio[0, 0, 0, :2]
    np.testing.assert_allclose(np.sort(free[1]), [0.02, 0.04, 0.08], rtol=0.03)
    assert np.all(np.sort(found.damping_ratio[0, 0, 0, 0]) > 5 * np.sort(free[0]))


# --- laws -----------------------------------------------------------------------------------------


def test_optimal_gains_solve_the_riccati_equation():
    for omega, weight in ((719.0, 2e-5), (6468.0, 1e-3), (50.0, 1e-7)):
        a = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
        b, state = np.array([[0.0], [1.0]]), np.diag([omega**2, 1.0])
        solution = scipy.linalg.solve_continuous_are(a, b, state, np.array([[weight]]))
        gains = optimal_gains(omega, weight)
        found = [gains.position, gains.velocity]
        np.testing.assert_allclose(found, (b.T @ solution / weight)[0], rtol=1e-6)


def test_optimal_gains_keep_their_digits_where_control_is_expensive():
    # k_p = 1/(2 R) and k_d = sqrt(2/R), but for shares of 1/(R omega^2)
    gains = jax.jit(optimal_gains)(1000.0, 1e10)
    np.testing.assert_allclose(
        [gains.position, gains.velocity], [0.5e-10, 2**0.5 * 1e-5], rtol=1e-9
    )


def test_position_filter_is_its_continuous_formula_at_its_own_frequency():
    omega = 2 * np.pi * np.array([[114.4, 457.6, 1029.5]] * 3)
    electronics, zeta = as_arrays(build_case(STUDY)).electronics, 0.5
    period = electronics.period
    filters = jax.jit(design_position_filter)(omega, zeta, electronics)
    filters = jax.tree.map(np.asarray, filters)
    d1, d2 = filters.estimator.denominator

    def response(at):
        z = np.exp(-1j * at * period)
        n0, n1, n2 = filters.estimator.position
        return (n0 + n1 * z + n2 * z * z) / (1 + d1 * z + d2 * z * z)

    corner = filters.corner
    np.testing.assert_allclose(response(corner), 1 / (2j * zeta), rtol=1e-9)
    np.testing.assert_allclose(response(0 * corner), 1, rtol=1e-9)
    # with the chain it lags by 90 degrees, as far as a corner of three times omega allows
    whole = np.asarray(measurement_chain(omega, electronics)) * response(omega)
    lag = -np.degrees(np.angle(whole))[0]
    np.testing.assert_allclose(lag[:1], 90, atol=1)
    np.testing.assert_allclose(corner[0, 2], HIGHEST_RATIO * omega[0, 2], rtol=1e-9)
    np.testing.assert_allclose(filters.damping, -whole.imag / omega, rtol=1e-9)


@pytest.fixture(scope="module")
def switching():
    """Modified IMSC with the default design's gains."""
    return fixed_controller(STUDY.change(control__law="modified_imsc")).controller


def stepped(law, n_samples=40):
    """Commands of a controller on random sensor voltages, and the states it went through."""
    random = np.random.default_rng(1)
    law = jax.tree.map(np.asarray, law)
    state, commands, states = rest_controller(law), [], []
    step = jax.jit(controller_step, static_argnames="is_smooth")
    for voltage in random.normal(size=(n_samples, 3, 3)):
        states.append(state)
        state, info = step(law, state, voltage, is_smooth=True)
        commands.append(np.asarray(info.command))
    return np.array(commands), states


def test_modified_control_of_one_mode_is_plain_control(switching):
    law = switching
    one = np.arange(3) == 0
    gain, rival = law.feedback.velocity_gain, law.feedback.rival_omega
    channels = law.feedback._replace(velocity_gain=one * gain, rival_omega=one * rival)
    alone = law._replace(feedback=channels)
    plain = law._replace(feedback=channels._replace(rival_omega=None))
    found, _ = stepped(alone)
    np.testing.assert_allclose(found, stepped(plain)[0], atol=1e-12)
    assert np.abs(found).max() > 0


def test_modified_control_acts_on_one_mode_of_a_link_at_a_time(switching):
    law = switching
    commands, _ = stepped(law)
    # as if forces of one column only
    force = np.linalg.solve(np.asarray(law.feedback.synthesizer)[None], commands[..., None])[..., 0]
    size = np.abs(force) / np.abs(force).max(axis=2, keepdims=True)
    assert np.all(np.sort(size, axis=2)[..., :2] < 1e-9)
    acting = np.argmax(size, axis=2)
    assert len(np.unique(acting)) > 1 and np.any(acting[:, 0] != acting[:, 1])


def test_the_strongest_is_that_of_highest_energy_and_others_are_no_rivals():
    omega = np.array([[1.0, 2.0, 3.0], [1.0, 0.0, 3.0], [0.0, 0.0, 0.0]])
    value = np.array([[1.0, 0.1, 0.2], [1.0, 9.0, 0.1], [1.0, 2.0, 3.0]])
    rate = np.array([[0.0, 1.1, 0.1], [0.0, 0.0, 0.1], [0.0, 0.0, 0.0]])
    wanted = [[0, 1, 0], [1, 1, 0], [1, 1, 1]]
    np.testing.assert_array_equal(strongest(omega, value, rate), wanted)


def test_parts_of_the_modified_law_are_its_channels(switching):
    parts = linear_parts(switching)
    whole = switching.feedback.velocity_gain
    np.testing.assert_allclose(sum(part.feedback.velocity_gain for _, part in parts), whole)
    assert [modes.start for modes, _ in parts] == [0, 1, 2]
    assert len(linear_parts(fixed_controller(STUDY).controller)) == 1


def test_what_breaks_a_modified_law_is_its_mode_of_least_margin(switching):
    """Of modes that are judged one by one: margin and words are of the same one."""
    none = np.full((3, 3), np.nan)
    figures = [
        LoopFigures(margin, 0.9, breaking=text, frequency_hz=none, damping_ratio=none)
        for margin, text in ((3.0, "first"), (1.5, "second"), (2.0, "third"))
    ]
    loop = SimpleNamespace(is_open_loop_stable=True, mode_poles=np.full((3, 3), -1.0 + 100.0j))
    builder = SimpleNamespace(loop=lambda *_: loop)
    design = SimpleNamespace(controller=switching, n_patches=3)
    one = np.full((1, 1, 1), "", object)
    with mock.patch.object(certificate, "judge_loop", lambda *_: figures.pop(0)):
        found = certificate._judge_plants(design, builder, one, one)[0, 0, 0]
    assert (found.figures.gain_margin, found.breaking) == (1.5, "second")


def test_idle_channels_change_nothing():
    controller = fixed_controller(STUDY).controller
    whole = controller.feedback
    channels = whole._replace(
        filter=whole.filter[:, :2],
        estimator=jax.tree.map(lambda x: x[:, :2], whole.estimator),
        velocity_gain=whole.velocity_gain[:, :2],
        position_gain=whole.position_gain[:, :2],
        synthesizer=whole.synthesizer[:, :, :2],
    )
    plain = controller._replace(feedback=channels)
    wide = pad_channels(plain, 3)
    state = rest_controller(plain)
    more = rest_controller(wide)
    step = jax.jit(controller_step)
    for voltage in np.random.default_rng(2).normal(size=(20, 3, 3)):
        state, info = step(plain, state, voltage)
        more, wider = step(wide, more, voltage)
        np.testing.assert_allclose(wider.command, info.command, atol=1e-12)
    assert isinstance(more, ControllerState) and more.feedback.first.shape == (3, 3)


# --- the fast move, and the command ---------------------------------------------------------------


@pytest.fixture(scope="module")
def move():
    """Of the default study, which waits until vibration has decayed."""
    long = paper_study().change(link__modes=3, motion__waypoints=STUDY.motion.waypoints)
    return run_fast_move(long)


def test_the_fast_move_is_a_run_with_and_without_control(move):
    for k, study in enumerate((move.study, move.study.uncontrolled())):
        metrics = run_study(study, has_record=False, has_loop=False).result.metrics
        np.testing.assert_allclose(
            move.residual_rms[k], metrics.residual_rms.max(axis=1), rtol=1e-9
        )
    assert np.all(move.status == status.OK)
    assert np.all(move.residual_rms[0] < 0.1 * move.residual_rms[1])


def test_the_fast_move_has_the_acceleration_of_its_own():
    long = STUDY.change(motion__waypoints=((0.0, 0.0, 0.5), (0.0, 0.02, 0.5), (0.01, 0.0, 0.5)))
    fast = make_fast(long.change(shaper__kind="zv", motion__dwell=0.1))
    assert len(fast.motion.waypoints) == 2 and fast.shaper.kind == "none"
    assert fast.motion.move_time == pytest.approx(FAST[1] * 2**0.5)
    still = make_fast(STUDY.change(motion__waypoints=STUDY.motion.waypoints[:1]))
    assert still.run.duration == pytest.approx(residual_delay(still) + WINDOW + 0.01)


#: As if it were found; `tests/studies/engine/test_breaking.py` looks for real ones.
CHANGE = BreakingChange(
    distance=2.5,
    change=None,
    parts=(
        ChangedNumber("delay", "delay 0.5 samples late", 2.0),
        ChangedNumber("E of link 1", "E of link 1 -7.2 %", -1.5),
    ),
    breaking="mode 3 of link 1 (958 Hz)",
    tolerances=TOLERANCES._asdict(),
)


@pytest.fixture
def few(move):
    """A command that looks at few plants, for no change, and has a fast move.

    What is replaced here is part of no program: they are kept.
    """
    plants = {"bases": ("pinned_pinned",), "mismatches": patch_lengths((0.8, 1.0)), "sizes": (3, 9)}
    with mock.patch.multiple(
        spillover_run,
        smallest_change=lambda design, units: CHANGE.replace(tolerances=units._asdict()),
        certify=lambda study, margin, bases: certify(study, margin, **plants),
        run_fast_move=lambda study: move,
    ):
        yield


@pytest.fixture
def undrawn():
    """Figures are not drawn."""
    with mock.patch.object(
        figures,
        "save",
        lambda _, out, name, __: (out / f"{name}.png").write_bytes(b"-"),
    ):
        yield


def write(folder, **changes):
    path = folder / "design.toml"
    path.write_text(study_template(STUDY.change(**changes)))
    return path


@pytest.mark.usefixtures("few")
def test_command_passes_a_design_and_writes_everything(capsys, tmp_path, move):
    design, out = write(tmp_path), tmp_path / "deep" / "out"
    code, text, _ = run(
        capsys, "certify", design, "--out", out, "--pdf", "--tolerance", "patch=5e-4"
    )
    assert code == 0 and "passed: gain margin 2.88, 2 required" in text
    assert CHANGE.text in text
    drawn = [
        f"{name}.{kind}"
        for name in ("machine", "margins", "damping", "leakage")
        for kind in ("png", "pdf")
    ]
    files = {"report.html", "certificate.json", "spillover.h5", *drawn}
    assert {path.name for path in out.iterdir()} == files | {".lock", "request.json", "parts"}
    assert (out / "damping.pdf").read_bytes()[:5] == b"%PDF-"
    report = text_of((out / "report.html").read_text(encoding="utf-8"))
    assert ": spillover certificate passed\n" in report
    assert "**Result:** Passed: gain margin 2.88, 2 required" in report
    assert "Smallest margin: 2.88 (9.2 dB)" in report
    assert all(f"![{name}]" in report for name in ("margins", "damping", "leakage"))
    assert "Not covered" in report
    page = parsed((out / "report.html").read_text())
    assert len(page.images) == 4 and page.title.endswith("spillover certificate passed")
    data = json.loads((out / "certificate.json").read_text())
    jsonschema.validate(data, schema("certify"))
    assert data["is_passed"] and len(data["plants"]) == 8
    assert data["fast_move"]["residual_rms"] == move.residual_rms.tolist()
    assert "| delay | 0.5 samples late | +2.00 |" in report and "patch 0.0005 m," in report
    units = TOLERANCES._replace(patch=5e-4)._asdict()
    assert data["smallest_change"] == document(CHANGE) | {"tolerances": units}
    assert all(plant["passes"] for plant in data["plants"])
    with xarray.open_dataset(out / "spillover.h5") as store:
        margin = store.gain_margin.sel(basis="pinned_pinned", plant_modes=9)
        assert float(margin.min()) == pytest.approx(data["smallest_margin"])
        np.testing.assert_array_equal(store.residual_rms.sel(control="off"), move.residual_rms[1])


@pytest.mark.usefixtures("few", "undrawn")
def test_another_design_s_certificate_is_left_alone(capsys, tmp_path):
    out = tmp_path / "out"
    run(capsys, "certify", write(tmp_path), "--out", out)
    kept = (out / "certificate.json").read_bytes()
    for changes, *more in (
        ({"control__gain_factor": 0.1},),
        ({}, "--margin", 3),
        ({}, "--prove"),
        ({}, "--tolerance", "patch=0"),
    ):
        arguments = ("certify", write(tmp_path, **changes), "--out", out, *more)
        assert "holds a certificate already" in refused(capsys, *arguments)
        assert "was begun with another input" in refused(capsys, *arguments, "--resume")
    assert (out / "certificate.json").read_bytes() == kept


@pytest.mark.usefixtures("few", "undrawn")
def test_a_certificate_goes_on_where_it_was_interrupted(capsys, tmp_path):
    """Also that of a design whose ratios come from its own run; nothing is judged twice."""
    design, out = write(tmp_path, control__ratio_source="own_run"), tmp_path / "out"
    arguments = ("certify", design, "--out", out)
    with mock.patch.object(spillover_run, "run_fast_move", side_effect=KeyboardInterrupt):
        code, _, said = run(capsys, *arguments)
    words = " ".join(map(str, arguments))
    assert code == 130 and f"finished work is safe; continue with: studies {words} --resume" in said
    assert not (out / "certificate.json").exists()
    whole = tmp_path / "whole"
    code, text, _ = run(capsys, "certify", design, "--out", whole)
    forbidden = mock.Mock(side_effect=AssertionError("once more"))
    with mock.patch.multiple(spillover_run, certify=forbidden, smallest_change=forbidden):
        assert run(capsys, *arguments, "--resume")[0] == code
    with mock.patch.object(spillover_run, "run_fast_move", forbidden):  # once it has ended, too
        assert run(capsys, *arguments, "--resume")[0] == code
    for name in ("certificate.json", "spillover.h5"):
        assert (out / name).read_bytes() == (whole / name).read_bytes()


@pytest.mark.usefixtures("few", "undrawn")
def test_command_fails_a_design(capsys, tmp_path):
    design, out = write(tmp_path, **DIFFERENCE), tmp_path / "out"
    with mock.patch.object(spillover_run, "run_fast_move", side_effect=StudyError("not today")):
        code, text, _ = run(capsys, "certify", design, "--out", out, "--margin", "1.5")
    assert code == 1 and "failed by mode" in text and "unstable" in text
    assert "no fast move: not today" in text
    report = text_of((out / "report.html").read_text(encoding="utf-8"))
    assert "**Failed by mode" in report and "## The fast move" not in report
    assert "| no |" in report and "No fast move: not today" in report
    data = json.loads((out / "certificate.json").read_text())
    jsonschema.validate(data, schema("certify"))
    assert not data["is_passed"]


@pytest.mark.usefixtures("few", "undrawn")
def test_command_fails_a_design_with_an_unstable_machine_in_its_box(capsys, tmp_path):
    box = ProvenBox(BOX, 1.0, True, 12, cells=0, seconds=0.0, unstable=(0.95, 1.0, 0.1))
    proofs, out = Proofs(AllModes(3.5, 3.7, 12), box), tmp_path / "out"
    with mock.patch.object(spillover_run, "prove", lambda _: proofs):
        code, text, _ = run(capsys, "certify", write(tmp_path), "--out", out, "--prove")
    assert code == 1 and "passed" not in text
    wanted = "failed by an unstable machine in the box: stiffness x 0.95, 1 sample of extra delay"
    assert wanted in text and "on the plants: gain margin 2.88, 2 required" in text
    assert not json.loads((out / "certificate.json").read_text())["is_passed"]


@pytest.mark.usefixtures("few", "undrawn")
def test_a_certificate_is_written_whole_or_not_at_all(capsys, tmp_path):
    design, out = write(tmp_path), tmp_path / "out"
    run(capsys, "certify", design, "--out", out)
    (out / "report.html").unlink()
    (out / "report.html").mkdir(parents=True)
    (out / ".unfinished-killed").mkdir()
    (out / "certificate.json").unlink()
    said = run(capsys, "certify", design, "--out", out, "--resume")[2]
    assert (
        said.startswith("studies: ") and "report.html: cannot write there, it is a folder" in said
    )
    assert not (out / "certificate.json").exists() and not (out / ".unfinished-killed").exists()


@pytest.mark.parametrize(
    ("study", "more", "message"),
    [
        ({"control__feedback": "ideal"}, (), "control.feedback = 'ideal'; allowed: 'sampled'"),
        ({"control__links": (False,) * 3}, (), "at least one link"),
        ({"control__gain_factor": 0.0}, (), "at least one is not zero"),
        ({}, ("--margin", "0.5"), "--margin = 0.5; allowed: more than 1"),
        ({}, ("--case", "3"), "leave --case out"),
    ],
)
def test_what_cannot_be_judged_is_refused_in_words(capsys, tmp_path, study, more, message):
    design = write(tmp_path, **study)
    said = refused(capsys, "certify", design, "--out", tmp_path / "out", *more)
    assert message in said and not (tmp_path / "out").exists()
