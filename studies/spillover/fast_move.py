"""A fast move of the nominal machine with the design's controller and without control."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure, uncontrolled
from jaxmodel.simulate import Result, simulate
from studies.engine.fast_motion import make_fast
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.study.spec import Study


class ControlEffect(NamedTuple):
    """Residual vibration after the fast move; first with control, then without."""

    study: Study  # the design's first move made fast
    residual_rms: np.ndarray  # worst station of each link [m], (2, 3)
    status: np.ndarray  # of the runs, codes of `jaxmodel.status`, (2,)

    @property
    def move_time(self) -> float | None:
        """[s]; None: from the initial state, without a move."""
        motion = self.study.motion
        assert isinstance(motion.move_time, float)
        return motion.move_time if len(motion.waypoints) > 1 else None

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
def _simulate(structure: Structure, cases: Case) -> Result:
    return jax.vmap(lambda case: simulate(structure, case))(cases)
