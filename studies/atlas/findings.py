"""Everything the atlas found, in the form its figures and report read."""

from __future__ import annotations

import numpy as np

from studies.atlas.platform import PlatformError, Responses, platform_error, responses
from studies.atlas.subsets import Subsets, beyond_first, setting_label
from studies.atlas.workspace import Map, PoseModes, map_workspace, natural_modes_at
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.job import Job
from studies.result import Result
from studies.results.labelled import Labelled, derived, labelled, told, unwritten
from studies.study.labels import POSE_UNITS
from studies.study.spec import Study

#: The pose near the border is at least this far from a singularity [rad].
NEAR = np.radians(5.0)
#: Of the responses [Hz].
FREQUENCY = np.linspace(2.0, 600.0, 300)
#: Points around each resonance, in half-widths [1].
_ROUND = np.linspace(-3.0, 3.0, 13)


class AtlasFindings(Labelled, Result):
    """What the atlas found."""

    study: Study = unwritten()
    choices: Subsets = unwritten()  # of links, (settings, C, 8)
    subsets: Subsets | None = unwritten()  # of modes, where they matter, (settings, 2^(3C))
    platform: PlatformError = told("what is left of control")
    responses: Responses = told("of the linearised loop")
    map: Map = told("of the workspace")
    # the first of the path, and one near the border, (2, 3)
    poses: np.ndarray = labelled(
        POSE_UNITS, "pose", "mode_pose", "pose_axis", file_name="pose_of_modes"
    )
    modes: PoseModes = unwritten()  # at these poses
    adc_step: np.ndarray = unwritten()  # of one ADC step, in the deflection of mode 1 [m], (3,)
    dropped: tuple[str, ...] = unwritten()  # settings left out, and why

    FILES = ", data, figures and animation in the same folder"

    @derived("Hz", "at these poses", "mode_pose", "natural_mode")
    def mode_frequency(self) -> np.ndarray:
        return self.modes.frequency

    @derived(
        "m; m; rad; m ...",
        "pose and modal coordinates, largest entry 1",
        "mode_pose",
        "coordinate",
        "natural_mode",
    )
    def mode_shape(self) -> np.ndarray:
        return self.modes.shape

    @property
    def links(self) -> Subsets:
        """Choices of links with all their modes, (settings, 8)."""
        return self.choices.whole_links()

    @derived(
        "1",
        "largest change that modes 2 and up make, share of the uncontrolled mean square",
        "setting",
    )
    def beyond_first(self) -> np.ndarray:
        return beyond_first(self.choices, self.adc_step)

    def labels(self, subsets: Subsets) -> list[str]:
        """Settings in words, with † if a link's uncontrolled residual is below an ADC step."""
        free = dict(zip(self.choices.setting, self.links.link[:, 0], strict=True))
        return [
            setting_label(x) + (" †" if (free[x] < self.adc_step).any() else "")
            for x in subsets.setting
        ]


def adc_step(study: Study) -> np.ndarray:
    """What one ADC step is in the deflection of mode 1 [m], (3,)."""
    return np.asarray(frame_of(*check_run(study)).adc_step)


def evaluate_atlas(
    study: Study, choices: Subsets, subsets: Subsets | None, dropped: list[str], job: Job
) -> AtlasFindings:
    """All of the atlas except the runs of the subsets.

    Args:
        study: the design.
        choices: of links, from `read_subsets`.
        subsets: of modes; None where they do not matter.
        dropped: settings left out, and why.
        job: whose phase says what is done.

    Raises:
        StudyError: as `check_run`.
    """
    runs = job.part("platform", lambda: platform_error(study, job.say))
    job.say("frequency responses")
    own = natural_modes_at(study, [study.motion.waypoints[0]]).frequency[0]
    linear = job.part("responses", lambda: responses(study, _frequencies(study, own)))
    job.say("natural modes over the workspace")
    chart = job.part("workspace", lambda: map_workspace(study))
    poses = np.stack([np.array(study.motion.waypoints[0]), _far_pose(chart)])
    modes = natural_modes_at(study, poses)
    return AtlasFindings(
        study=study,
        choices=choices,
        subsets=subsets,
        platform=runs,
        responses=linear,
        map=chart,
        poses=poses,
        modes=modes,
        adc_step=adc_step(study),
        dropped=tuple(dropped),
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
