"""One study, one run, and the judgement of its loop.

`run_study` is what `studies simulate` and `studies paper` call.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure, uncontrolled, with_ratio
from jaxmodel.loop_figures import MARGINS
from jaxmodel.numbers import signed_power
from jaxmodel.simulate import RunResult, simulate
from studies.engine.poles import PoleReport, pole_report, tracked_modes
from studies.engine.preflight import check_run
from studies.engine.programs import drop_programs, kept_jit
from studies.engine.robustness import judge_robustness
from studies.engine.stability import LoopFigures, run_report
from studies.study.cases import as_numpy
from studies.study.spec import Study
from studies.threads import serial_blas

_simulate = kept_jit(static_argnums=(0, 2))(simulate)


class Run(NamedTuple):
    """A finished run."""

    study: Study
    structure: Structure
    case: Case  # NumPy arrays
    result: RunResult  # NumPy arrays
    status: int  # code of `jaxmodel.status`; UNSTABLE and UNJUDGED come from the linearised loop
    loop: LoopFigures | None = None  # of its linearised sampled loop, if that is judged
    motion: LoopFigures | None = None  # with the forces of the motion, (k,)
    poles: PoleReport | None = None  # specified and obtained, where gains follow from poles


def run_study(
    study: Study, has_record: bool = True, has_loop: bool = True, has_margins: bool = False
) -> Run:
    """Run one study after checking what can be checked beforehand.

    Args:
        study: what to run.
        has_record: keep trajectories.
        has_loop: also judge the linearised sampled loop (takes seconds).
        has_margins: also by disk, phase and delay margin (seconds the first time).

    Raises:
        StudyError: pose out of reach, singular path, motion longer than the run, stiff feedback.
    """
    drop_programs()
    with serial_blas():
        return _run_and_judge(study, has_record, has_loop, has_margins)


def _run_and_judge(study: Study, has_record: bool, has_loop: bool, has_margins: bool) -> Run:
    structure, case = check_run(study)
    if study.control.ratio_source == "own_run":
        case = with_ratio(case, _own_ratio(study, structure, case, has_record))
    run = _run(study, structure, case, has_record)
    if not has_loop or structure.feedback != "sampled":
        return run
    try:
        home, n_tracked = np.array(study.motion.waypoints[0], float), tracked_modes(structure)
        loop, motion = run_report(structure, case, home, n_tracked)
        has_poles = run.status != status.UNPLACEABLE
        poles = pole_report(structure, case, loop) if has_poles else None
        if has_margins:
            loop = loop._replace(robustness=_margins(structure, case, loop))
    except np.linalg.LinAlgError:  # a non-finite entry
        return run._replace(status=judged_status(run.status, None))
    code = judged_status(run.status, loop)
    return run._replace(status=code, loop=loop, motion=motion, poles=poles)


def _run(study: Study, structure: Structure, case: Case, has_record: bool) -> Run:
    """Run a case without judging its loop."""
    result = as_numpy(_simulate(structure, case, has_record))
    code = int(result.status)
    return Run(study=study, structure=structure, case=as_numpy(case), result=result, status=code)


def _margins(structure: Structure, case: Case, loop: LoopFigures) -> dict[str, np.ndarray]:
    """Disk, phase and delay margin of a run's loop, () each."""
    one = jax.tree.map(lambda x: np.asarray(x)[None], case)
    judged = judge_robustness(structure, one, MARGINS, np.array([loop.gain_margin]))
    return {name: value[0] for name, value in judged.items()}


def _own_ratio(study: Study, structure: Structure, case: Case, has_record: bool) -> np.ndarray:
    """Ratios (24) of the same case's uncontrolled run, (3, C); has_record: as the run after it."""
    ratio = _simulate(structure, uncontrolled(case), has_record).metrics.energy_ratio
    return signed_power(ratio, study.control.ratio_exponent)


def resolved_study(study: Study) -> Study:
    """The same study with explicit EMC ratios, so that no run is needed to find them.

    Raises:
        StudyError: as `run_study`.
    """
    if study.control.ratio_source == "given":
        return study
    ratio = _own_ratio(study, *check_run(study), False)
    return study.change(
        control__ratios=ratio, control__ratio_source="given", control__ratio_exponent=1.0
    )


def uncontrolled_twin(run: Run) -> Run | None:
    """The same run with no link controlled, with trajectories; None if none is anyway."""
    if not run.study.is_controlled:
        return None
    return _run(run.study, run.structure, uncontrolled(run.case), True)


def run_uncontrolled(study: Study, is_linear: bool = False) -> Run:
    """The run of a study with no link controlled, without trajectories.

    Args:
        study: what to run.
        is_linear: by the linear model.

    Raises:
        StudyError: as `run_study`.
    """
    study = study.uncontrolled()
    structure, case = check_run(study)
    return _run(study, structure._replace(is_linear=is_linear), case, False)


def judged_status(code: int, loop: LoopFigures | None) -> int:
    """Status of a run whose loop was judged, None: without success, if nothing else stopped it."""
    if code not in status.FINISHED or (loop is not None and loop.is_stable):
        return code
    return status.UNJUDGED if loop is None else status.UNSTABLE
