"""Everything the atlas found, in the form its figures and report read."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.atlas.platform import PlatformError, Responses, platform_error, responses
from studies.atlas.subsets import Subsets, setting_label
from studies.atlas.workspace import Map, PoseModes, map_workspace, natural_modes_at
from studies.engine.batches import ProgressCallback
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.study.spec import Study

#: The pose near the border is at least this far from a singularity [rad].
NEAR = np.radians(5.0)
#: Of the responses [Hz].
FREQUENCY = np.linspace(2.0, 600.0, 300)
#: Points around each resonance, in half-widths [1].
_ROUND = np.linspace(-3.0, 3.0, 13)


class AtlasFindings(NamedTuple):
    """What the atlas found."""

    study: Study
    subsets: Subsets
    platform: PlatformError
    responses: Responses
    map: Map
    poses: np.ndarray  # the first of the path, and one near the border [m, m, rad], (2, 3)
    modes: PoseModes  # at these poses
    adc_step: np.ndarray  # of one ADC step, in the deflection of mode 1 [m], (3,)

    def setting(self, k: int) -> str:
        """A setting in words, with † if a link's uncontrolled residual is below an ADC step."""
        is_small = (self.subsets.link[k, 0] < self.adc_step).any()
        return setting_label(self.subsets.setting[k]) + (" †" if is_small else "")


def evaluate_atlas(study: Study, subsets: Subsets, on_progress: ProgressCallback) -> AtlasFindings:
    """All of the atlas except the runs of the subsets.

    Args:
        study: the design.
        subsets: from `read_subsets`.
        on_progress: called with progress messages.

    Raises:
        StudyError: as `check_run`.
    """
    runs = platform_error(study, on_progress)
    on_progress("frequency responses", 0.0)
    own = natural_modes_at(study, [study.motion.waypoints[0]]).frequency[0]
    linear = responses(study, _frequencies(study, own))
    on_progress("natural modes over the workspace", 0.0)
    chart = map_workspace(study)
    poses = np.stack([np.array(study.motion.waypoints[0]), _far_pose(chart)])
    modes = natural_modes_at(study, poses)
    step = frame_of(*check_run(study)).adc_step
    return AtlasFindings(
        study=study,
        subsets=subsets,
        platform=runs,
        responses=linear,
        map=chart,
        poses=poses,
        modes=modes,
        adc_step=step,
    )


def _frequencies(study: Study, own: np.ndarray) -> np.ndarray:
    """FREQUENCY with enough points round each natural frequency, below half the sample rate."""
    width = max(study.link.first_damping, 1e-5)
    fine = (own[:, None] * (1 + width * _ROUND)).ravel()
    every = np.unique(np.concatenate([FREQUENCY, fine[fine <= FREQUENCY[-1]]]))
    return every[(every > 0) & (every < 0.45 * study.electronics.sample_rate_hz)]


def _far_pose(chart: Map) -> np.ndarray:
    """The pose whose links differ most, not too close to a singularity, at the path's own turn."""
    spread = np.where(chart.margin >= NEAR, chart.spread, -1.0)
    turn = int(np.argmin(np.abs(chart.phi - np.median(chart.phi))))
    row, column = np.unravel_index(int(np.argmax(spread[turn])), spread[turn].shape)
    return np.array([chart.x[column], chart.y[row], chart.phi[turn]])
