"""A study's first move made fast: what is left of it tells controllers apart."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.engine.frame import frame_of
from studies.engine.runs import run_study, run_uncontrolled
from studies.study.spec import Study
from studies.study.window import residual_delay

#: The move has the acceleration of a move of this length in this time.
FAST = (0.01, 0.03)  # [m], [s]
#: Length of the residual window [s].
WINDOW = 0.15
#: Vibration under control from which a motion tells controllers apart, in ADC steps [1].
LEAST_STEPS = 1.0
#: Sections that a fast move changes.
SECTIONS = ("motion", "shaper", "metrics", "run")


class TellingMotion(NamedTuple):
    """A study whose vibration a controller can measure."""

    study: Study
    text: str  # why it is not its own motion, "" if it is


def make_fast(study: Study) -> Study:
    """The same with only its first move, at the acceleration of `FAST`, without shaper."""
    points = study.motion.waypoints[:2]
    distance = float(np.hypot(*np.subtract(points[-1], points[0])[:2]))
    time = study.motion.move_time
    time = time if isinstance(time, float) else time[0]
    if distance > 0:
        time = max(FAST[1] * np.sqrt(distance / FAST[0]), 1e-3)
    moving = time if len(points) > 1 else 0.0
    fast = study.change(
        motion__waypoints=points,
        motion__move_time=float(time),
        motion__dwell=0.0,
        shaper__kind="none",
        metrics__residual_length=WINDOW,
    )
    return fast.change(run__duration=moving + residual_delay(fast) + WINDOW + 0.01)


def find_motion(study: Study) -> TellingMotion:
    """The study's own motion, or its first move made fast.

    The latter where the study's own controller, or none if that does not get through it, leaves so
    little that better ones would differ by what they cannot measure.

    Args:
        study: any that runs.

    Raises:
        StudyError: it cannot run.
    """
    run = run_study(study, has_record=False, has_loop=False)
    if run.status not in status.FINISHED:
        run = run_uncontrolled(study)
    step = float(frame_of(run.structure, run.case).adc_step.max())
    left = float(np.max(run.result.metrics.residual_rms))
    if left >= LEAST_STEPS * step:
        return TellingMotion(study, "")
    text = (
        f"its own motion leaves {1e6 * left:.3g} µm rms, and one ADC step is {1e6 * step:.3g} µm: "
        "controllers are compared by its first move, fast and unshaped"
    )
    return TellingMotion(make_fast(study), text)


def with_own_motion(changed: Study, study: Study) -> Study:
    """A study that came from a fast move of another one, with the other's motion again."""
    own = {name: getattr(study, name) for name in ("title", *SECTIONS)}
    return changed.model_copy(update=own)
