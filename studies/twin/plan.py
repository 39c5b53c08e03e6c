"""What acts on the twin from outside, on the grid of its time steps, and its electronics' numbers.

References, disturbances and noise are the study's: shaped path, drive's feed-forward and seeded
noise come from the same functions as in a run, evaluated at the end of each step of the twin.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Drive, Structure
from jaxmodel.drives import DRIVES
from jaxmodel.drives.pd import PD
from jaxmodel.simulate import begin
from studies.engine.programs import kept_jit
from studies.errors import field_error
from studies.twin.multibody import STEP, Settings


class SignalPath(NamedTuple):
    """Analogue and converter data."""

    period: float  # of a sample [s]
    antialias: float  # corner [rad/s]
    highpass: float  # corner of a patch into its amplifier's input [rad/s]; 0: none
    lag: float  # time constant of the actuators' amplifiers [s]; 0: none
    adc_gain: float  # [1]
    adc_bias: float  # [V]
    adc_step: float  # [V]
    adc_top: float  # highest code [1]
    adc_noise: float  # rms at the ADC's input [V]


class TwinPlan(NamedTuple):
    """A run of N samples with s steps each, T = N s + 1 instants; n links, p pose coordinates."""

    n_samples: int
    n_steps: int  # of the twin in a sample, s
    pose: np.ndarray  # at the start, (x, y, phi) or (x, y) [m, m, rad], (p,)
    rho: np.ndarray  # reference of the drives [m], (T, n)
    rho_rate: np.ndarray  # [m/s], (T, n)
    feedforward: np.ndarray  # of the drives [N], (T, n)
    disturbance: np.ndarray  # force along the paths, held over a sample [N], (N, n)
    wrench: np.ndarray  # on the platform, held over a sample [N, N, N m], (N, p)
    steady_wrench: np.ndarray  # with which it is in equilibrium at the start, (p,)
    noise: np.ndarray | None  # of the ADC, standard normal, (N, n, K)
    command_end: float  # when the shaped reference trajectory ends [s]
    drive: Drive  # NumPy arrays
    electronics: SignalPath

    @property
    def step(self) -> float:
        """Length of a step [s]."""
        return self.electronics.period / self.n_steps


def plan_run(structure: Structure, case: Case, settings: Settings, after: float) -> TwinPlan:
    """TwinPlan of a case's motion.

    Args:
        structure: static choices, feedback "sampled".
        case: the numbers.
        settings: resolution.
        after: how long the run goes on after the reference trajectory [s].

    Raises:
        StudyError: the twin has no such drive.
    """
    law = DRIVES[structure.drive]
    if law.force is not PD.force:
        raise field_error("drive.kind", law.name, "'pd' or 'computed_torque', which the twin knows")
    period = float(np.asarray(case.electronics.period))
    n_steps = settings.n_steps or 2 * max(round(period / (2 * STEP)), 1)
    begun = _begin(structure._replace(substeps=n_steps // 2), case)
    inputs, outline, loop = jax.tree.map(np.asarray, (begun.inputs, begun.outline, begun.loop))
    end = float(outline.command_end)
    count = min(round((end + after) / period) + 1, structure.n_steps)
    wrench = inputs.wrench if inputs.wrench is not None else np.zeros((count, structure.n_pose))
    noise = inputs.adc_noise
    return TwinPlan(
        n_samples=count,
        n_steps=n_steps,
        pose=np.asarray(begun.state.plant.pose),
        rho=_instants(inputs.rho, count),
        rho_rate=_instants(inputs.rho_rate, count),
        feedforward=(
            np.zeros((count * n_steps + 1, structure.n_links))
            if inputs.feedforward is None
            else _instants(inputs.feedforward, count)
        ),
        disturbance=inputs.disturbance[:count],
        wrench=wrench[:count],
        steady_wrench=np.asarray(case.load.wrench, float),
        noise=None if noise is None else noise[:count],
        command_end=end,
        drive=loop.drive,
        electronics=_electronics(case, loop.controller),
    )


_begin = kept_jit(static_argnums=0)(begin)


def _instants(x: np.ndarray, count: int) -> np.ndarray:
    """From the points of each sample, (N, s + 1, n), to all instants, (count s + 1, n)."""
    return np.concatenate([x[:count, :-1].reshape(-1, x.shape[-1]), x[count - 1, -1:]])


def _electronics(case: Case, controller: object) -> SignalPath:
    own = {name: float(np.asarray(getattr(controller, name))) for name in _CONVERTER}
    electronics = case.electronics
    return SignalPath(
        period=float(np.asarray(electronics.period)),
        antialias=float(np.asarray(electronics.antialias)),
        highpass=float(np.asarray(electronics.sensor_highpass)),
        lag=float(np.asarray(electronics.amplifier_lag)),
        **own,
    )


_CONVERTER = ("adc_gain", "adc_bias", "adc_step", "adc_top", "adc_noise")


def resting(plan: TwinPlan, duration: float) -> TwinPlan:
    """The machine of a plan held where it starts, without disturbances and noise.

    Args:
        plan: of a motion.
        duration: [s].
    """
    count = round(duration / plan.electronics.period)
    instants = count * plan.n_steps + 1
    still = np.zeros((instants, plan.rho.shape[1]))
    return plan._replace(
        n_samples=count,
        rho=np.broadcast_to(plan.rho[0], still.shape),
        rho_rate=still,
        feedforward=np.broadcast_to(plan.feedforward[0], still.shape),
        disturbance=still[:count],
        wrench=np.broadcast_to(plan.steady_wrench, (count, len(plan.steady_wrench))),
        noise=None,
        command_end=0.0,
    )
