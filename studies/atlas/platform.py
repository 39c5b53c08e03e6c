"""Rigid and elastic: sources of the platform's error, and its response to forces.

Drive error is the error of the same drive on the same machine with rigid links; the rest of the
flexible machine's error is vibration error (the paper's figures 5, 6, 8, 10 show the sum).
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure, with_ratio
from jaxmodel.kinematics import close_chain
from jaxmodel.linear import resting
from jaxmodel.numbers import signed_power
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, LoopMatrices, loop_matrices
from studies.atlas.subsets import link_label, long_enough, setting_label
from studies.engine.batches import run_batches
from studies.engine.eigenvalues import eigenvalues
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.runs import resolved_study
from studies.results.labelled import Labelled, derived, labelled, unwritten
from studies.study.labels import POSE_UNITS
from studies.study.spec import Study
from studies.study.window import residual_delay

#: Controlled links of the paper's cases.
LINK_SETS = ((False, False, False), (True, False, False), (True, True, False), (True, True, True))
#: The same in short: "none", "1", "1+2", "1+2+3".
LINK_LABELS = tuple(link_label(sum(1 << i for i in range(3) if links[i])) for links in LINK_SETS)
#: Move time [s] and shaper of the runs: the paper's, and a fast move without shaper.
SETTINGS = ((0.1, "ei"), (0.05, "none"))
#: Forces of `Responses`, in order.
SOURCES = (
    "slider 1 [N]",
    "slider 2 [N]",
    "slider 3 [N]",
    "platform x [N]",
    "platform y [N]",
    "platform turn [N m]",
)
#: Their effects, in order.
OUTPUTS = ("link 1 [m]", "link 2 [m]", "link 3 [m]", "x [m]", "y [m]", "phi [rad]")


_SERIES = ("time", "pose_axis")


class PlatformError(Labelled):
    """Leading axis: SETTINGS; second one of `vibration`: LINK_SETS."""

    time: np.ndarray = labelled("s", "time", "time")
    command_end: np.ndarray = labelled("s", "end of the shaped reference trajectory", "run")
    window: np.ndarray = unwritten()  # whether a sample is in the residual window, (s, T)
    drive: np.ndarray = labelled(
        POSE_UNITS, "pose error with rigid links", "run", *_SERIES, file_name="drive_error"
    )
    vibration: np.ndarray = labelled(
        POSE_UNITS,
        "pose error beyond that of rigid links",
        "run",
        "run_links",
        *_SERIES,
        file_name="vibration_error",
    )
    pose: np.ndarray = unwritten()  # of the platform [m, m, rad], (s, 4, T, 3)
    modal: np.ndarray = unwritten()  # modal coordinates of the plant [m], (s, 4, T, 3, R)

    @derived("1", "move, shaper", "run")
    def run(self) -> list[str]:
        return [setting_label(s) for s in SETTINGS]

    @derived("1", "controlled links", "run_links")
    def run_links(self) -> list[str]:
        return list(LINK_LABELS)

    def rms(self, error: np.ndarray) -> np.ndarray:
        """Root mean square of an error (s, ..., T, 3) over the window, (s, ..., 3)."""
        total = np.einsum("s...ta,st->s...a", error**2, self.window)
        count = self.window.sum(axis=-1).reshape(len(total), *(1,) * (error.ndim - 2))
        return np.sqrt(total / count)


def platform_error(study: Study, say: Callable[[str], object] = lambda _: None) -> PlatformError:
    """Run the paper's choices of links, and the machine with rigid links, with trajectories.

    Args:
        study: the design; move time, shaper and links are replaced.
        say: called with what is done next.

    Raises:
        StudyError: as `check_run`.
    """
    study = long_enough(study, SETTINGS)
    moved = [study.change(motion__move_time=t, shaper__kind=kind) for t, kind in SETTINGS]
    built = [check_run(one) for one in moved]
    structure = built[0][0]._replace(substeps=max(x.substeps for x, _ in built))
    first = [x for _, case in built for x in (_with_links(case, LINK_SETS[0]), _rigid(case))]
    quiet = run_batches(structure, first, say)
    cases = []
    for k, (_, case) in enumerate(built):
        if study.control.ratio_source == "own_run":
            own = signed_power(quiet.metrics.energy_ratio[2 * k], study.control.ratio_exponent)
            case = with_ratio(case, own)
        cases += [_with_links(case, links) for links in LINK_SETS[1:]]
    active = run_batches(structure, cases, say)
    assert quiet.record is not None and active.record is not None
    count = len(SETTINGS)

    def join(name: str) -> np.ndarray:
        off = getattr(quiet.record, name)[::2, None]
        on = getattr(active.record, name)
        return np.concatenate([off, on.reshape(count, len(LINK_SETS) - 1, *on.shape[1:])], axis=1)

    drive, time = quiet.record.pose_error[1::2], quiet.record.time[0]
    end = np.asarray(quiet.command_end[::2])
    tick = 0.5 / study.electronics.sample_rate_hz
    delay = np.array([residual_delay(one) for one in moved])
    since = time - (end + delay)[:, None]
    window = (since > -tick) & (since < study.metrics.residual_length - tick)
    return PlatformError(
        time=time,
        command_end=end,
        window=window,
        drive=drive,
        vibration=join("pose_error") - drive[:, None],
        pose=join("pose"),
        modal=join("modal_coordinate"),
    )


def _rigid(case: Case) -> Case:
    """The same machine with rigid links: disabled modes couple to nothing."""
    return case._replace(n_modes=0 * case.n_modes)


def _with_links(case: Case, links: tuple[bool, ...]) -> Case:
    mask = jnp.asarray(links, case.control.link_mask.dtype)
    return case._replace(control=case.control._replace(link_mask=mask))


#: Axes of responses.
_RESPONSE = ("run_links", "response_frequency", "output", "source")


class Responses(Labelled):
    """Linearised sampled loop: effects of forces held over a sample."""

    frequency: np.ndarray = labelled(
        "Hz", "of the responses", "response_frequency", file_name="response_frequency"
    )
    # complex, by LINK_SETS, OUTPUTS and SOURCES; NaN if unstable, (4, F, 6, 6)
    value: np.ndarray = unwritten()
    # spectral radius of the sampled loop at the design's gains [1], (4,)
    radius: np.ndarray = unwritten()

    @derived("m/N and alike", "magnitude of the response of the sampled loop", *_RESPONSE)
    def response_size(self) -> np.ndarray:
        return np.abs(self.value)

    @derived("rad", "its phase", *_RESPONSE)
    def response_phase(self) -> np.ndarray:
        return np.angle(self.value)

    @property
    def is_stable(self) -> np.ndarray:
        """By LINK_SETS, (4,)."""
        return self.radius <= 1 + RADIUS_TOLERANCE


def responses(study: Study, frequency: np.ndarray) -> Responses:
    """Frequency responses from forces on sliders and platform to links (mid-span) and platform.

    A force on the platform acts like the slider forces J^-T W, J the Jacobian of the sliders'
    positions by the pose: exact where links do not bend at C (Y_j(L) = 0), else NaN.

    Args:
        study: the design, linearised at the first pose of its path.
        frequency: [Hz], below half the sample rate, (F,).

    Raises:
        StudyError: as `check_run`.
    """
    study = resolved_study(study).change(metrics__stations=(0.5,))
    structure, case = check_run(study)
    structure = structure._replace(n_steps=1, substeps=1, n_frequencies=1, has_noise=False)
    pose = jnp.asarray(study.motion.waypoints[0], case.electronics.period.dtype)
    value, radius = [], []
    for links in LINK_SETS:
        matrices, jacobian = _linear(structure, _with_links(case, links), pose)
        transition = np.asarray(matrices.open + matrices.feedback)
        radius.append(np.abs(eigenvalues(transition)).max())
        response = _response(
            matrices, transition, jacobian, frequency / study.electronics.sample_rate_hz
        )
        value.append(response if radius[-1] <= 1 + RADIUS_TOLERANCE else np.nan * response)
    return Responses(frequency, np.stack(value), np.array(radius))


@kept_jit(static_argnums=0)
def _linear(structure: Structure, case: Case, pose: Array) -> tuple[LoopMatrices, Array]:
    """Loop at a pose, and d rho/d X there, (3, 3); NaN where a force at C bends the link."""
    loop = prepare(structure, case).loop
    plant = loop.plant
    jacobian = jax.jacfwd(lambda at: close_chain(plant, at, jnp.zeros_like(at)).rho)(pose)
    exact = jacobian if plant.tip is None else jnp.nan * jacobian
    at_rest = resting(structure, case)
    return loop_matrices(structure, case, loop, loop.controller, pose, at_rest), exact


def _response(
    matrices: LoopMatrices, transition: np.ndarray, jacobian: Array, share: np.ndarray
) -> np.ndarray:
    """C (z - M)^-1 B for frequencies as shares of the sample rate, (F, 6, 6)."""
    force = np.asarray(matrices.force)
    jacobian = np.asarray(jacobian)
    platform = force @ (np.linalg.inv(jacobian).T if np.isfinite(jacobian).all() else jacobian)
    source = np.concatenate([force, platform], axis=1)
    pose = np.eye(3, len(transition))
    output = np.concatenate([np.asarray(matrices.deflection), pose])
    points = np.exp(2j * np.pi * share)
    return np.stack(
        [output @ np.linalg.solve(z * np.eye(len(transition)) - transition, source) for z in points]
    )
