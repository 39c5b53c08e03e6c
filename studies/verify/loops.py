"""The digital loop of the study: margins, a run beside its linear loop, the exported C code."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.laws import LAWS
from jaxmodel.linear import resting
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import LoopMatrices, loop_matrices
from studies.engine.controller import check_codable, fixed_controller
from studies.engine.margins import judge_loops
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.export.c_floating import floating_source
from studies.export.compiler import find_compiler
from studies.export.verify import reference_run, verify_floating
from studies.study.spec import Study
from studies.verify.rows import Assumption, largest

#: Modal coordinate of mode 1 of link 1 at the start: linear to one part in 10^5 [m].
_SMALL = 1e-7
#: Samples of a released machine.
_RELEASED = 300
#: What a pole may leave the unit circle by: the drive's without springs are on it [1].
_GROWTH = 1e-5


def check_loops(study: Study) -> list[Assumption]:
    """Margins, release, exported C; left out where nothing is sampled."""
    if study.control.feedback != "sampled":
        return [_left_out(name, "control.feedback is not sampled") for name in _NAMES]
    return [_margins(study), _release(study), _exported(study)]


#: Of the exported controller.
_NAME = "verified"
_NAMES = (
    "gain margin by frequency response",
    "runs of the closed loop",
    "exported C controller",
)


def _left_out(name: str, reason: str) -> Assumption:
    return Assumption(
        assumption=name, against="-", source="-", difference=0.0, allowed=0.0, left_out=reason
    )


def _margins(study: Study) -> Assumption:
    """Of sweeps, by the return difference, and of `simulate`, by eigenvalues."""
    structure, case = check_run(study)
    one = jax.tree.map(lambda x: np.asarray(x)[None], case)
    found = judge_loops(structure, one).gain_margin[0]
    wanted = loop_report(structure, case, case.path.waypoints[0], structure.n_controlled)
    return Assumption(
        assumption=_NAMES[0],
        against="eigenvalues of the transition matrix over a sample",
        source="MacFarlane and Postlethwaite 1977",
        difference=abs(found / wanted.gain_margin - 1) if wanted.gain_margin else float(found > 0),
        allowed=5e-3,
        note=f"margin {wanted.gain_margin:.4g}",
    )


@kept_jit(static_argnums=0)
def _linear(structure: Structure, case: Case) -> tuple[LoopMatrices, Any]:
    """The loop at the first way-point, and the volts of the sensors per modal coordinate."""
    loop = prepare(structure, case).loop
    pose = jnp.asarray(case.path.waypoints[0])
    matrices = loop_matrices(structure, case, loop, loop.controller, pose, resting(structure, case))
    return matrices, loop.sensor


def _why_not_linear(study: Study) -> str:
    """Why a release is not the linear loop's alone, "" if it is."""
    if study.electronics.sensor_highpass_hz > 0 or study.electronics.amplifier_hz > 0:
        return "its start in the electronics is not defined"
    if np.any(study.load.wrench):
        return "the machine starts bent by load.wrench"
    if study.drive.coulomb_friction > 0 or study.machine.joint_friction > 0:
        return "friction is not linear"
    return "the control law switches" if LAWS[study.control.law].is_switching else ""


def _release(study: Study) -> Assumption:
    """A machine at rest with one bent link, simulated, beside powers of its transition matrix."""
    electronics = study.electronics
    if reason := _why_not_linear(study):
        return _left_out(_NAMES[1], reason)
    released = study.change(
        run__duration=_RELEASED / electronics.sample_rate_hz,
        run__smooth=True,
        electronics__adc_bits=32,
        electronics__adc_noise=0.0,
        drive__ripple=0.0,
        drive__pulse_force=(0.0,) * study.n_links,
        load__pulse=(0.0,) * study.n_pose,
        motion__waypoints=study.motion.waypoints[:1],
        motion__dwell=0.0,
        motion__move_time=0.1,
        shaper__kind="none",
        metrics__residual_delay=0.0,
        metrics__residual_length=100 / electronics.sample_rate_hz,
        initial__modal=((_SMALL,), *((),) * (study.n_links - 1)),
        initial__load_deflection=(0.0,) * study.n_links,
    )
    run = run_study(released, has_loop=False)
    structure, record = run.structure, run.result.record
    assert record is not None
    matrices, sensor = jax.tree.map(
        np.asarray, _linear(structure._replace(n_steps=1, substeps=1), run.case)
    )
    transition = matrices.open + matrices.feedback
    first, count = 2 * structure.n_pose, structure.n_coordinates
    modes = structure.n_links * count
    if np.abs(np.linalg.eigvals(transition)).max() > 1 + _GROWTH:
        return _left_out(_NAMES[1], "the loop is unstable: the run ends at limits, not its powers")
    state = np.zeros(len(transition))
    state[first] = _SMALL  # and the filters settled on it
    settled = sensor[0, :, 0] * _SMALL
    after = first + 2 * modes + structure.n_motors
    state[after : after + settled.size] = settled
    states = [state]
    for _ in range(_RELEASED - 1):
        states.append(transition @ states[-1])
    wanted = np.array(states)[:, first : first + modes]
    wanted = wanted.reshape(_RELEASED, structure.n_links, count)[..., : structure.n_modes]
    found = np.asarray(record.modal_coordinate)
    return Assumption(
        assumption=_NAMES[1],
        against=f"powers of the transition matrix, {_RELEASED} samples after a release",
        source="Franklin, Powell and Workman 1998",
        difference=largest(found, wanted),
        allowed=2e-3,
    )


def _exported(study: Study) -> Assumption:
    """C compiled on this machine, against the controller in JAX: hard inputs, and in the loop."""
    try:
        compiler = find_compiler()
        check_codable(study)
        exported = fixed_controller(study)
    except StudyError as error:
        return _left_out(_NAMES[2], str(error))
    if not compiler:
        return _left_out(_NAMES[2], "there is no C compiler")
    source = floating_source(exported, _NAME, ["studies verify"])
    try:
        result = verify_floating(exported, reference_run(exported), source, _NAME, compiler)
    except StudyError as error:  # it does not compile: this row's fault, not that of those above
        return _exported_row("strict C99", np.inf, str(error))
    failed = [check for check in result.checks if not check.is_met]
    against = f"the controller in JAX: {len(result.checks)} comparisons, double and single"
    note = "; ".join(f"{check.what}: {check.found}" for check in failed)
    return _exported_row(against, float(len(failed)), note)


def _exported_row(against: str, difference: float, note: str) -> Assumption:
    return Assumption(
        assumption=_NAMES[2],
        against=against,
        source="ISO/IEC 9899:1999",
        difference=difference,
        allowed=0.0,
        note=note,
    )
