"""The twin's gain margin, by growth, and the damping of its first modes, by decay.

The machine rests, gets a pulse of small voltages, and rings. Controllers with larger gains are
exported with a larger `control.gain_factor`; converters do not round, so that the loop is linear.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from studies.fitting.realisation import ringing_poles
from studies.results.labelled import Labelled, labelled, told
from studies.study.spec import Study
from studies.twin.law import exported_law
from studies.twin.loop import TwinRun, run_twin
from studies.twin.machine import MachineData
from studies.twin.multibody import DEFAULT, Settings
from studies.twin.plan import TwinPlan, resting

#: Voltage of the pulse, on every actuator with a sign of its own, for one sample [V]: for decay,
#: and, so that what grows stays far below the actuators' limits, for growth.
PULSE, SMALL_PULSE = 10.0, 0.5
#: How long a run rings [s]; those that confirm a margin, at least, and at most.
RINGING, CONFIRMING, LONGEST = 0.12, 0.16, 0.5
#: They last until what grows or decays has done so by this exponent, or longer: by then other poles
#: of nearly its frequency no longer beat with it [1].
GROWN = 0.75
#: Singular values of the signals below this share of the largest are noise: for all poles, and for
#: those that are left late [1].
ALL, LATE = 1e-8, 1e-6
#: Voltages up to this share of their limit count as small [1], and the fewest samples to look at.
LINEAR, FEWEST = 0.2, 150
#: Factors of the first two runs, over the predicted margin, and how much further others go [1].
NEAR, STRIDE = 0.015, 1.05
#: Margins are confirmed by growth and decay at this distance [1].
CONFIRMED = 0.01
#: Runs that look for a factor that grows, or decays, before giving up; and where to stop [1].
MOST_RUNS, HIGHEST = 8, 50.0


class GrowthMargin(Labelled):
    """Where the loop begins to grow."""

    margin: float = labelled("1", "factor on all gains; null: not found")
    frequency: float = labelled("Hz", "of what grows")
    is_confirmed: bool = told("growth was seen 1 % beyond it, decay 1 % below")
    runs: int = told("that it took")


def ring(
    study: Study,
    machine: MachineData,
    plan: TwinPlan,
    factor: float,
    settings: Settings = DEFAULT,
    duration: float = RINGING,
    pulse: float = PULSE,
) -> TwinRun:
    """A free response of the loop after a pulse of voltages.

    Args:
        study: with the controller.
        machine: its machine.
        plan: of its motion, for the pose and the electronics.
        factor: on all gains, not 0 [1].
        settings: resolution.
        duration: [s].
        pulse: on every actuator, with a sign of its own [V].
    """
    shape = (len(machine.links), len(machine.links[0].sensor_ends))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], shape)
    at_rest = resting(plan, duration)
    with exported_law(study, factor) as law:
        return run_twin(machine, at_rest, law, settings, kick=pulse * signs, is_exact=True)


def poles_of(run: TwinRun, period: float) -> np.ndarray:
    """Poles s of a free response with positive frequency [rad/s], by amplitude."""
    signals = run.sensor[2:].reshape(len(run.time) - 2, -1)
    depth = min(300, len(signals) // 4)
    poles = np.log(ringing_poles(signals, depth, ALL)) / period
    return poles[poles.imag > 0]


def first_modes(run: TwinRun, period: float, expected: np.ndarray) -> np.ndarray:
    """The poles in a response that are nearest to expected ones.

    Args:
        run: from `ring`.
        period: of a sample [s].
        expected: poles [rad/s], (n,).

    Returns:
        poles [rad/s], (n,).
    """
    poles = poles_of(run, period)
    row, column = linear_sum_assignment(np.abs(expected[:, None] - poles))
    return poles[column[np.argsort(row)]]


class _Search:
    """Runs with larger and larger gains."""

    def __init__(
        self, study: Study, machine: MachineData, plan: TwinPlan, settings: Settings
    ) -> None:
        self._arguments = study, machine, plan
        self._settings, self._period = settings, plan.electronics.period
        self.runs = 0

    def ring(self, factor: float, duration: float = RINGING) -> TwinRun:
        self.runs += 1
        return ring(*self._arguments, factor, self._settings, duration, SMALL_PULSE)

    def pole(self, factor: float, near: complex | None) -> complex:
        """The pole that is left at the end of a run, or the one nearest to another."""
        run = self.ring(factor)
        last = self._last_linear(run)
        late = run.sensor[last // 3 : last].reshape(-1, run.sensor[0].size)
        ranked = ringing_poles(late, min(100, len(late) // 4), LATE)
        poles = np.log(ranked) / self._period
        poles = poles[poles.imag > 0]
        return complex(poles[0 if near is None else np.abs(poles - near).argmin()])

    def _last_linear(self, run: TwinRun) -> int:
        """Number of samples before voltages come near their limit, which would bound what grows."""
        limit = self._arguments[0].electronics.voltage_limit
        large = np.flatnonzero(np.abs(run.voltage).max(axis=(1, 2)) > LINEAR * limit)
        return max(int(large[0]) if len(large) else len(run.time), FEWEST)

    def is_growing(self, factor: float, duration: float) -> bool:
        """Whether voltages are larger in the last quarter of a run than in the one before."""
        run = self.ring(factor, duration)
        voltage = run.voltage[: self._last_linear(run)]
        quarter = len(voltage) // 4
        last, before = voltage[-quarter:], voltage[-2 * quarter : -quarter]
        return bool(np.sum(last**2) > np.sum(before**2))


def margin_by_growth(
    study: Study,
    machine: MachineData,
    plan: TwinPlan,
    predicted: float,
    settings: Settings = DEFAULT,
) -> GrowthMargin:
    """Common factor on all gains at which the twin's loop begins to grow.

    Two runs near the predicted margin give the rates of growth of the critical pole; where the line
    through them crosses zero is the margin, and one run on each side of it confirms it.

    Args:
        study: with the controller.
        machine: its machine.
        plan: of its motion.
        predicted: margin by the study's own linearised loop [1].
        settings: resolution.
    """
    search = _Search(study, machine, plan, settings)
    nothing = GrowthMargin(np.nan, np.nan, is_confirmed=False, runs=0)
    if not 0 < predicted < HIGHEST:
        return nothing
    high = predicted * (1 + NEAR)
    above = search.pole(high, None)
    while above.real <= 0:
        if search.runs == MOST_RUNS:
            return nothing.replace(runs=search.runs)
        high *= STRIDE
        above = search.pole(high, None)
    low = min(predicted * (1 - NEAR), high / STRIDE**0.5)
    below = search.pole(low, above)
    while below.real >= 0:
        if search.runs == 2 * MOST_RUNS:
            return nothing.replace(runs=search.runs)
        high, above = low, below
        low /= STRIDE
        below = search.pole(low, above)
    margin = low + (high - low) * below.real / (below.real - above.real)
    rate = CONFIRMED * margin * (above.real - below.real) / (high - low)
    duration = float(np.clip(GROWN / rate, CONFIRMING, LONGEST))
    beyond, within = (margin * (1 + x) for x in (CONFIRMED, -CONFIRMED))
    is_confirmed = search.is_growing(beyond, duration) and not search.is_growing(within, duration)
    return GrowthMargin(
        margin=float(margin),
        frequency=float(above.imag / (2 * np.pi)),
        is_confirmed=is_confirmed,
        runs=search.runs,
    )
