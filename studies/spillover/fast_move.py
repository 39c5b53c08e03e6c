"""A fast move of the nominal machine with the design's controller and without control."""

from __future__ import annotations

import jax
import numpy as np

from jaxmodel.case import Case, Structure, uncontrolled
from jaxmodel.simulate import RunResult, simulate
from studies.engine.fast_motion import make_fast
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.results.labelled import Labelled, derived, labelled, unwritten
from studies.study.labels import STATUS_LABEL, describe
from studies.study.spec import Study


class ControlEffect(Labelled):
    """Residual vibration after the fast move; first with control, then without."""

    study: Study = unwritten()  # the design's first move made fast
    residual_rms: np.ndarray = labelled("m", "worst station after the fast move", "control", "link")
    status: np.ndarray[tuple[int], np.dtype[np.int_]] = labelled(
        *STATUS_LABEL[:2], "control", flags=STATUS_LABEL[2]
    )
    control: tuple[str, ...] = labelled(
        "1", "of the links, in the fast move", "control", default=("on", "off")
    )

    @derived("", "of the fast move [s]; null: from the initial state, without a move")
    def move_time(self) -> float | None:
        motion = self.study.motion
        assert isinstance(motion.move_time, float)
        return motion.move_time if len(motion.waypoints) > 1 else None

    @derived("", "how the runs ended, in words")
    def ended(self) -> list[str]:
        return [describe(int(code)) for code in self.status]

    @property
    def worst(self) -> np.ndarray:
        """Of the links [m], (2,); NaN where a run did not finish."""
        return np.asarray(self.residual_rms.max(axis=1))


def run_fast_move(study: Study) -> ControlEffect:
    """Run a design's first move made fast, nonlinear, with and without control.

    Args:
        study: the design; its ratios are given.

    Raises:
        StudyError: the fast move cannot run.
    """
    fast = make_fast(study)
    structure, case = check_run(fast)
    both = jax.tree.map(lambda *x: np.stack(x), case, uncontrolled(case))
    result = _simulate(structure._replace(metrics=("residual_rms",)), both)
    return ControlEffect(
        study=fast,
        residual_rms=np.asarray(result.metrics.residual_rms).max(axis=2),
        status=np.asarray(result.status),
    )


@kept_jit(static_argnums=0)
def _simulate(structure: Structure, cases: Case) -> RunResult:
    return jax.vmap(lambda case: simulate(structure, case))(cases)
