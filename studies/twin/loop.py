"""The twin's closed loop: steps of Exudyn, analogue electronics, samples of a controller.

A command that changes at a sample jumps in the middle of two steps of an implicit integrator, which
reads forces at their ends only. There it gets the mean of both commands, which makes held inputs
exact to second order in the step: without it they would be late by half a step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.twin.electronics import SensorFilter
from studies.twin.machine import MachineData
from studies.twin.multibody import DEFAULT, Model, Settings, build_model
from studies.twin.plan import TwinPlan
from studies.twin.reading import Reader

#: Maps voltages at the ADC's input of a sample (n, K) [V] to actuator voltages of the next [V].
Law = Callable[[np.ndarray], np.ndarray]

#: Of Newton's method, on increments of coordinates [m, rad].
TOLERANCE = 1e-11
#: Spectral radius at infinity of the generalised-alpha method [1].
SPECTRAL_RADIUS = 0.9


class TwinRun(NamedTuple):
    """Signals at the sampling instants."""

    time: np.ndarray  # [s], (N,)
    deflection: np.ndarray  # of mid-span from the chord [m], (N, n)
    pose: np.ndarray  # of the platform's reference point [m, m, rad], (N, 3) or (N, 2)
    sensor: np.ndarray  # of the patches [V], (N, n, K)
    filtered: np.ndarray  # behind the anti-alias filter [V], (N, n, K)
    voltage: np.ndarray  # command during the sample [V], (N, n, K)


class _DriveForces:
    """Motors, friction and disturbance along the paths of the joints B, see `jaxmodel.drive`."""

    def __init__(self, plan: TwinPlan) -> None:
        self.is_moving = False  # False: held at the start, without disturbance
        self._step, self._last = plan.step, len(plan.rho) - 1
        # lists, which are several times faster to index than arrays
        self._rho, self._rate, self._forward, self._jolt = (
            x.tolist() for x in (plan.rho, plan.rho_rate, plan.feedforward, _at_ends(plan))
        )
        count = plan.rho.shape[1]
        self._drive = [np.broadcast_to(getattr(plan.drive, x), count).tolist() for x in _DRIVE]

    def __call__(self, i: int, time: float, position: float, speed: float) -> float:
        k = min(round(time / self._step), self._last) if self.is_moving else 0
        jolt = self._jolt[k][i] if self.is_moving else 0.0
        kp, kd, limit, dry, creep, viscous = (x[i] for x in self._drive)
        motor = kp * (self._rho[k][i] - position) + kd * (self._rate[k][i] - speed)
        motor = min(max(motor + self._forward[k][i], -limit), limit)
        rub = dry * math.tanh(speed / creep) if dry else 0.0
        return float(motor + jolt - viscous * speed - rub)


_DRIVE = ("kp", "kd", "force_limit", "coulomb_friction", "friction_speed", "viscous_friction")


def _at_ends(plan: TwinPlan) -> np.ndarray:
    """The disturbance at all instants, the mean of both where it jumps, (instants, n)."""
    fine = np.repeat(plan.disturbance, plan.n_steps, axis=0)
    fine = np.concatenate([fine, fine[-1:]])
    jumps = slice(plan.n_steps, -1, plan.n_steps)
    fine[jumps] = (plan.disturbance[1:] + plan.disturbance[:-1]) / 2
    return fine


def run_twin(
    machine: MachineData,
    plan: TwinPlan,
    law: Law | None,
    settings: Settings = DEFAULT,
    kick: np.ndarray | None = None,
    is_exact: bool = False,
) -> TwinRun:
    """Run the loop.

    Args:
        machine: the machine.
        plan: what acts on it.
        law: the controller; None: no voltage at all.
        settings: resolution.
        kick: voltages of the first sample [V], (n, K); default: none.
        is_exact: leave out the ADC's rounding, range and noise, for a loop that is linear.

    Raises:
        StudyError: Exudyn is missing, or its solver fails.
    """
    force = _DriveForces(plan)
    model = build_model(machine, plan.pose, force, settings)
    stepper = _Stepper(model, machine, plan, law, kick, is_exact)
    if np.any(plan.steady_wrench):
        _settle(model, plan, stepper)
    force.is_moving = True
    _solve(model, plan, stepper)
    return stepper.result()


class _Stepper:
    """What happens between the steps of Exudyn."""

    def __init__(
        self,
        model: Model,
        machine: MachineData,
        plan: TwinPlan,
        law: Law | None,
        kick: np.ndarray | None,
        is_exact: bool,
    ) -> None:
        shape = (len(machine.links), len(machine.links[0].sensor_ends))
        self.model, self.plan, self.law, self.is_exact = model, plan, law, is_exact
        self.reader = Reader(model, machine)
        self.filter = SensorFilter(plan.electronics, plan.step, shape)
        self.now = np.zeros(shape) if kick is None else kick
        self.next = np.zeros(shape)
        self.applied = np.zeros(shape)  # behind the amplifiers, at the start of the sample
        self.rows: list[tuple[np.ndarray, ...]] = []
        self.error: BaseException | None = None

    def after_step(self, _: Any, time: float) -> bool:
        """Called by Exudyn at the start and after each step; what fails is raised later."""
        try:
            self._advance(round(time / self.plan.step))
        except BaseException as error:
            self.error = error
            raise
        return True

    def _advance(self, k: int) -> None:
        self.reader.read()
        seen = self.reader.voltages()
        if k == 0:
            self.filter.settle(seen)
        filtered = self.filter.advance(seen) if k else self.filter.present
        sample, part = divmod(k, self.plan.n_steps)
        if part == 0 and sample < self.plan.n_samples:
            self._sample(sample, seen, filtered)
        self._put_loads(*divmod(k + 1, self.plan.n_steps))

    def _sample(self, sample: int, seen: np.ndarray, filtered: np.ndarray) -> None:
        if sample > 0:
            self.applied = self._behind_amplifier(self.plan.n_steps)
            self.now = self.next
        if self.law is not None:
            self.next = self.law(self._converted(sample, filtered))
        else:
            self.next = np.zeros_like(self.now)
        reader = self.reader
        self.rows.append(
            (reader.deflection(), reader.pose(), seen, filtered.copy(), self.now.copy())
        )

    def _converted(self, sample: int, filtered: np.ndarray) -> np.ndarray:
        own, noise = self.plan.electronics, self.plan.noise
        level = own.adc_gain * filtered + own.adc_bias
        if self.is_exact:
            return level
        if noise is not None:
            level = level + own.adc_noise * noise[sample]
        return np.clip(np.round(level / own.adc_step), 0.0, own.adc_top) * own.adc_step

    def _behind_amplifier(self, part: int) -> np.ndarray:
        """Voltages on the actuators this many steps into the sample [V]."""
        lag = self.plan.electronics.lag
        if lag == 0:
            return self.now
        left = math.exp(-part * self.plan.step / lag)
        return self.now + left * (self.applied - self.now)

    def _put_loads(self, sample: int, part: int) -> None:
        """Loads at the end of the coming step."""
        lag, plan = self.plan.electronics.lag, self.plan
        if lag > 0:
            self.reader.put_voltages(self._behind_amplifier(part or plan.n_steps))
        elif part == 0:
            self.reader.put_voltages((self.now + self.next) / 2)
        elif part == 1:
            self.reader.put_voltages(self.now)
        if part <= 1 and np.any(plan.wrench):
            own = plan.wrench[min(sample, plan.n_samples - 1)]
            before = plan.wrench[sample - 1] if part == 0 else own
            self.reader.put_wrench((own + before) / 2)

    def result(self) -> TwinRun:
        time = self.plan.electronics.period * np.arange(len(self.rows))
        return TwinRun(time, *(np.stack(x) for x in zip(*self.rows, strict=True)))


def _settle(model: Model, plan: TwinPlan, stepper: _Stepper) -> None:
    """Static equilibrium with the steady load, as the state at the start."""
    settings = model.exudyn.SimulationSettings()
    settings.solution.file.write = False
    settings.solution.sensors.active = False
    newton = settings.staticSolver.newton
    newton.residualMode = 1
    newton.relativeTolerance = newton.absoluteTolerance = TOLERANCE
    stepper.reader.put_wrench(plan.steady_wrench)
    _quietly(model, stepper, lambda: model.system.SolveStatic(settings, updateInitialValues=True))


def _solve(model: Model, plan: TwinPlan, stepper: _Stepper) -> None:
    exudyn = model.exudyn
    settings = exudyn.SimulationSettings()
    settings.solution.file.write = False
    settings.solution.sensors.active = False
    settings.linearSolver.solverType = exudyn.LinearSolverType.EigenSparse
    integration = settings.timeIntegration
    integration.numberOfSteps = plan.n_samples * plan.n_steps
    integration.endTime = integration.numberOfSteps * plan.step
    integration.adaptiveStep = integration.automaticStepSize = False
    integration.generalizedAlpha.spectralRadius = SPECTRAL_RADIUS
    newton = integration.newton
    newton.useModifiedNewton = True
    newton.residualMode = 1  # increments: the residual of stiff links ends in rounding
    newton.relativeTolerance = newton.absoluteTolerance = TOLERANCE
    model.system.SetPostStepUserFunction(stepper.after_step)
    _quietly(model, stepper, lambda: model.system.SolveDynamic(settings))


def _quietly(model: Model, stepper: _Stepper, solve: Callable[[], Any]) -> None:
    """Run a solver without its messages; its failure becomes one sentence."""
    model.exudyn.config.printToConsole = False
    try:
        solve()
    except Exception as error:
        if stepper.error is not None:
            raise stepper.error from None
        reason = str(error).strip().splitlines()[0]
        raise StudyError(f"studies twin: Exudyn's solver stopped: {reason}") from None
    finally:
        model.exudyn.config.printToConsole = True
