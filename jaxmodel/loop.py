"""One sample of the closed loop: the function every executor compiles.

`step(structure, loop, state, inputs) -> (state, record)`: controller, plant (ETDRK4), metrics and
status, elementwise arithmetic on short arrays only. A case that fails keeps its last good state
and its first status code. Shapes: structure first, lanes last (see `jaxmodel.plant`).
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

from jaxmodel import metrics, status
from jaxmodel.actuation import Acting, act, acting_now
from jaxmodel.axial import stretch_error
from jaxmodel.case import Drive, Structure
from jaxmodel.controller import Controller, ControllerState, controller_step, soft_limit
from jaxmodel.drive import Reference, drive_step, late_force, motor_force, slider_force
from jaxmodel.drives.contract import DriveState
from jaxmodel.dynamics import Accelerations, accelerations, modal_chain, shortening_row
from jaxmodel.electronics import Amplifier, observed
from jaxmodel.hysteresis import Hysteresis
from jaxmodel.integrator import Exponential
from jaxmodel.joints import rub
from jaxmodel.kinematics import Chain, chain_status, close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.plant import Plant

#: Chord deflection beyond this fraction of the link counts as diverged [1].
DIVERGED_DEFLECTION = 0.1
#: So does a pose error beyond this [m or rad].
DIVERGED_POSE = 0.5


class Loop(NamedTuple):
    """Everything `step` reads that stays constant over a run."""

    plant: Plant
    omega: Num[Array, "links R"]  # plant modes [rad/s]
    exponential: Exponential
    plant_step: Num[Array, ""]  # length of one plant step [s]
    amplifier: Amplifier | None  # None: commands are on the actuators at once
    sensor: Num[Array, "links K Q"]  # V_s of a modal coordinate, lambda_s Phi_s^t [V/m]
    actuator: Num[Array, "links Q K"]  # modal acceleration of a voltage, lambda_a Phi_a/m [m/s2/V]
    deflection_at: Num[Array, "links S Q"]  # chord deflection at the stations [1]
    controller: Controller
    # voltage of q' [V s/m] and q [V/m]
    ideal: tuple[Num[Array, "links K Q"], Num[Array, "links K Q"] | None] | None
    observer: Num[Array, "links C Q"]  # controlled modes of true deflection, filter x sensor [1]
    modal_omega: Num[Array, "links C"]  # frequencies of the controller's modes [rad/s]
    rotation: tuple[Num[Array, "links C F"], Num[Array, "links C F"]]  # of F phasors per sample
    drive: Drive
    axial_compliance: Num[Array, "links"]  # L/(E A) of the links [m/N]
    left_out: LeftOut | None  # static response of the modes left out; None: truncated model
    settling_band: Num[Array, ""]  # [m]
    delayed: Delayed | None = None  # None: commands are held from sample to sample, one later
    hysteresis: Hysteresis | None = None  # of the actuators; None: they are linear
    rest: Rest | None = None  # about which the linear model is taken; None: the full model
    # elongations' omega^2 [1/s2] and decay [1/s] in `exponential`, less the links' own; None: none
    split: tuple[Num[Array, "links"], Num[Array, "links"]] | None = None
    strain: tuple[Array, Array] | None = None  # `Sample.strain` of q [1/m] and of voltages [1/V]


def coordinate_omega(loop: Loop) -> Array:
    """Frequencies of a link's coordinates [rad/s]: its modes, then its elongation if it has one."""
    if loop.split is None:
        return loop.omega
    plant = loop.plant
    own = jnp.sqrt(loop.split[0] + plant.stiffness[:, -1] / plant.modal_mass)
    return jnp.concatenate([loop.omega, own[:, None]], axis=1)


class Delayed(NamedTuple):
    """Commands that change within samples; the loop's own plant steps are those after it."""

    before: Num[Array, "J"]  # 1 for the command u_(k-j) until the change, else 0
    after: Num[Array, "J"]  # the same from the change on
    # plant steps until the change
    exponential: Exponential
    plant_step: Num[Array, ""]  # [s]
    amplifier: Amplifier | None
    passage: Num[Array, "5 5"] | None


class LeftOut(NamedTuple):
    """What actuators do at once, by the modes that the plant leaves out (`jaxmodel.static`)."""

    sensor: Num[Array, "links K K"]  # D, sensor voltages [V/V]
    deflection: Num[Array, "links S K"]  # from the chord at the stations [m/V]
    passage: Num[Array, "5 5"] | None  # of `electronics.voltage_passage`; None: nothing is sampled


class Rest(NamedTuple):
    """The machine at rest."""

    pose: Num[Array, "pose"]  # [m, m, rad]
    reference: Reference  # what holds it there


class PlantState(NamedTuple):
    """Mechanism, modes and analogue electronics (None if absent).

    All patches and filters are equal, so modal coordinates are filtered instead of voltages; so
    are the actuators' voltages, to which sensors answer by the modes that are left out.
    """

    pose: Num[Array, "pose"]  # [m, m, rad]
    pose_rate: Num[Array, "pose"]
    q: Num[Array, "links Q"]  # [m]
    q_rate: Num[Array, "links Q"]  # [m/s]
    z: Num[Array, "links Q"] | None = None  # anti-alias filtered q - s [m]
    z_rate: Num[Array, "links Q"] | None = None  # [m/s]
    s: Num[Array, "links Q"] | None = None  # slow part of q, which the amplifiers' inputs drain [m]
    voltage: Num[Array, "links K"] | None = None  # on the actuators, behind their amplifiers [V]
    # the actuators' voltages as modes that are left out show them to the sensors
    direct_z: Num[Array, "links K"] | None = None  # anti-alias filtered [V]
    direct_z_rate: Num[Array, "links K"] | None = None  # [V/s]
    direct_s: Num[Array, "links K"] | None = None  # drained by the amplifiers' inputs [V]
    commands: Num[Array, "waiting links K"] | None = None  # on their way, u_(k-2), u_(k-3), .. [V]
    plays: Num[Array, "N links K"] | None = None  # of the actuators' hysteresis [V]
    motor: Num[Array, "links n"] | None = None  # of motors that follow late, see `drive.LAG` [N]


class State(NamedTuple):
    """What is carried from sample to sample."""

    plant: PlantState
    controller: ControllerState
    totals: metrics.Totals
    status: Num[Array, ""]  # code of `jaxmodel.status`, as a float
    bad_time: Num[Array, ""]  # when the status appeared [s], 0 while OK
    drive: DriveState | None = None  # None: the drive is not sampled


class Inputs(NamedTuple):
    """External inputs of one sample, at P = 2 substeps + 1 points from start to end."""

    rho: Num[Array, "P links"]  # desired actuated coordinate [m]
    rho_rate: Num[Array, "P links"]  # [m/s]
    feedforward: Num[Array, "P links"] | None  # [N]
    pose: Num[Array, "pose"]  # desired pose at the start [m, m, rad]
    disturbance: Num[Array, "links"]  # drive force held over the sample [N]
    wrench: Num[Array, "pose"] | None  # on the platform, held over the sample [N, N, N m]
    adc_noise: Num[Array, "links K"] | None  # standard normal
    window: metrics.Window


class Record(NamedTuple):
    """Signals at the sampling instant, for trajectories."""

    time: Num[Array, ""]  # [s]
    pose: Num[Array, "pose"]
    pose_error: Num[Array, "pose"]  # against the shaped reference
    slider: Num[Array, "links"]  # rho [m]
    modal_coordinate: Num[Array, "links R"]  # plant q [m]
    controlled_coordinate: Num[Array, "links C"]  # controller's modes, noise-free [m]
    chord_deflection_stations: Num[Array, "links S"]  # [m]
    sensor_voltage: Num[Array, "links K"]  # raw V_s [V]
    actuator_voltage: Num[Array, "links K"]  # command of this sample [V]
    slider_force: Num[Array, "links"]  # of the motors [N]


class Rates(NamedTuple):
    """One evaluation of the continuous plant."""

    chain: Chain
    acceleration: Accelerations
    motor: Num[Array, "links n"] | None  # of `PlantState.motor` [N/s]


def plant_rates(
    structure: Structure, loop: Loop, state: PlantState, reference: Reference, voltage: Array
) -> Rates:
    """Evaluate the continuous plant with drive (and ideal feedback) at one instant.

    Args:
        structure: static choices.
        loop: constants.
        state: pose and modes.
        reference: for the drive.
        voltage: on the actuators [V], (3, K); ignored with ideal feedback.

    Returns:
        Rates.
    """
    if structure.is_coupled:
        chain = modal_chain(loop.plant, state.pose, state.pose_rate, state.q, state.q_rate)
    else:
        chain = close_chain(loop.plant, state.pose, state.pose_rate)
    command = motor_force(structure, loop.drive, reference, chain.rho, chain.rho_rate)
    motors, motor_rate = late_force(loop.drive, command, state.motor)
    force = slider_force(structure, loop.drive, reference, motors, chain.rho_rate)
    if structure.feedback == "ideal":
        voltage = ideal_voltage(structure, loop, state.q, state.q_rate)
    piezo, torque = jnp.sum(loop.actuator * voltage[:, None], axis=2), None
    wrench = reference.wrench
    if loop.plant.joint_friction is not None:
        moving = state.pose_rate, state.q_rate
        pushed = rub(loop.plant, chain, moving, force, piezo, wrench)
        # without coupling only the links feel it
        force, piezo, wrench, torque = (
            pushed if structure.is_coupled else (force, pushed[1], wrench, None)
        )
    forces = force, piezo, wrench
    rates = accelerations(loop.plant, chain, *state[1:4], *forces, structure.is_coupled, torque)
    return Rates(chain, rates, motor_rate)


def linear_rates(
    structure: Structure, loop: Loop, state: PlantState, reference: Reference, voltage: Array
) -> Rates:
    """`plant_rates` to first order about `loop.rest`, and axial forces that stiffen the links.

    That product of force and bending is kept because fast moves make it the largest one: without it
    the controlled residual vibration of 10 mm in 0.03 s is 18 % off, with it 1 to 2 %. There are no
    limits, and nothing else is quadratic.
    """
    rest = loop.rest
    assert rest is not None
    zero = jax.tree.map(jnp.zeros_like, (state, voltage))
    still = zero[0]._replace(pose=jnp.broadcast_to(rest.pose, state.pose.shape))
    if still.motor is not None and rest.reference.feedforward is not None:
        still = still._replace(motor=still.motor + rest.reference.feedforward)
    held = jax.tree.map(lambda x, at: jnp.broadcast_to(at, x.shape), reference, rest.reference)
    away = jax.tree.map(jnp.subtract, (state, reference), (still, held))
    value, change = jax.jvp(
        partial(plant_rates, structure, loop), (still, held, zero[1]), (*away, voltage)
    )
    rates: Rates = jax.tree.map(jnp.add, value, change)
    if loop.plant.shortening is None:
        return rates
    force = change.acceleration.axial / loop.plant.modal_mass
    stiffer = shortening_row(loop.plant, state.q) * force[:, None]
    coupling, modal = (x - stiffer for x in (rates.acceleration.coupling, rates.acceleration.modal))
    return rates._replace(acceleration=rates.acceleration._replace(coupling=coupling, modal=modal))


def _split_rates(
    structure: Structure, loop: Loop, state: PlantState, reference: Reference, voltage: Array
) -> Rates:
    """Rates whose `coupling` leaves out the oscillators of `Loop.exponential`."""
    model = plant_rates if loop.rest is None else linear_rates
    rates = model(structure, loop, state, reference, voltage)
    if loop.split is None:
        return rates
    coupling, (square, decay) = rates.acceleration.coupling, loop.split
    more = coupling[:, -1] + square * state.q[:, -1] + decay * state.q_rate[:, -1]
    coupling = jnp.concatenate([coupling[:, :-1], more[:, None]], axis=1)
    return rates._replace(acceleration=rates.acceleration._replace(coupling=coupling))


def ideal_voltage(structure: Structure, loop: Loop, q: Array, q_rate: Array) -> Array:
    """Actuator voltages [V] of continuous feedback (20) from noise-free sensors, (3, K)."""
    assert loop.ideal is not None
    on_rate, on_position = loop.ideal
    voltage = jnp.sum(on_rate * q_rate[:, None], axis=2)
    if on_position is not None:
        voltage = voltage + jnp.sum(on_position * q[:, None], axis=2)
    return soft_limit(voltage, loop.controller.voltage_limit, structure.is_smooth)


def plant_step(
    structure: Structure,
    loop: Loop,
    state: PlantState,
    references: tuple[Reference, Reference, Reference],
    voltage: Array,
) -> tuple[PlantState, Rates]:
    """One ETDRK4 step of the plant (RK4 for the pose, whose linear part is zero).

    Args:
        structure: static choices.
        loop: constants.
        state: at the start.
        references: at start, middle and end of the step.
        voltage: command held over the step [V], (3, K).

    Returns:
        (state at the end, rates at the start).
    """
    acting = act(loop.amplifier, loop.hysteresis, state.voltage, state.plays, voltage)
    volts = acting.course
    h, coefficients = loop.plant_step, loop.exponential
    e, f = coefficients.half, coefficients.half_force
    start, middle, end = references

    # traced once, called four times
    rates = jax.jit(partial(_split_rates, structure, loop))

    def course(at: PlantState, now: Rates) -> tuple[Array, tuple[Any, ...]]:
        """Push on the modes, and slopes of all else."""
        return now.acceleration.coupling, (at.pose_rate, now.acceleration.pose, now.motor)

    def stage(
        origin: PlantState, x: tuple[Any, ...], slope: tuple[Any, ...], length: Array, push: Array
    ) -> PlantState:
        """exp(A h/2) on the modes of `origin`, Euler from x along `slope` for the pose."""
        moved = [None if y is None else y + length * k for y, k in zip(x, slope, strict=True)]
        return state._replace(
            pose=moved[0],
            pose_rate=moved[1],
            motor=moved[2],
            q=e[0, 0] * origin.q + e[0, 1] * origin.q_rate + f[0] * push,
            q_rate=e[1, 0] * origin.q + e[1, 1] * origin.q_rate + f[1] * push,
        )

    x = (state.pose, state.pose_rate, state.motor)
    first = rates(state, start, volts[0])
    n1, slope1 = course(state, first)
    a = stage(state, x, slope1, h / 2, n1)
    second = rates(a, middle, volts[1])
    n2, slope2 = course(a, second)
    b = stage(state, x, slope2, h / 2, n2)
    third = rates(b, middle, volts[1])
    n3, slope3 = course(b, third)
    c = stage(a, x, slope3, h, 2 * n3 - n1)
    fourth = rates(c, end, volts[2])
    n4, slope4 = course(c, fourth)

    def combine(k: int) -> Array:
        return slope1[k] + 2 * (slope2[k] + slope3[k]) + slope4[k]

    full, weight = coefficients.full, coefficients.full_force
    old = (state.q, state.q_rate, state.z, state.z_rate, state.s)

    def mode(row: int) -> Array | None:
        if old[row] is None:
            return None
        forced = weight[0, row] * n1 + weight[1, row] * (n2 + n3) + weight[2, row] * n4
        read = (old[k] if k in _READS[row] else None for k in range(len(old)))
        return forced + sum(full[row, k] * x for k, x in enumerate(read) if x is not None)

    after = PlantState(
        pose=state.pose + h / 6 * combine(0),
        pose_rate=state.pose_rate + h / 6 * combine(1),
        q=mode(0),
        q_rate=mode(1),
        z=mode(2),
        z_rate=mode(3),
        s=mode(4),
        voltage=acting.voltage,
        commands=state.commands,
        plays=acting.plays,
        motor=None if state.motor is None else state.motor + h / 6 * combine(2),
        **_passed(loop, state, acting),
    )
    return after, first


#: Which of them each of (q, q', z, z', s) reads: electronics do not act back on a mode.
_READS = ((0, 1), (0, 1), (0, 1, 2, 3, 4), (0, 1, 2, 3, 4), (0, 1, 4))


def _passed(loop: Loop, state: PlantState, acting: Acting) -> dict[str, Array]:
    """`direct_z`, `direct_z_rate` and `direct_s` at the end of a step with a held command."""
    if loop.left_out is None or loop.left_out.passage is None:
        return {}
    assert state.direct_z is not None and state.direct_z_rate is not None
    before = (state.direct_z, state.direct_z_rate, state.direct_s, acting.remainder, acting.held)
    passage, names = loop.left_out.passage, ("direct_z", "direct_z_rate", "direct_s")
    return {
        name: sum(
            (passage[row, k] * x for k, x in enumerate(before) if x is not None),
            start=jnp.zeros_like(acting.held),
        )
        for row, name in enumerate(names)
        if before[row] is not None
    }


def step(structure: Structure, loop: Loop, state: State, inputs: Inputs) -> tuple[State, Record]:
    """One sample of the closed loop.

    The controller samples first; its command reaches the actuators one sample later, or after the
    delay of `Loop.delayed`.

    Args:
        structure: static choices.
        loop: constants of the case.
        state: at the sampling instant.
        inputs: of this sample.

    Returns:
        (state at the next instant, Record of this one).

    Example:
        >>> structure, case = paper_case({"link.modes": 2})
        >>> loop, inputs, state, _ = begin(structure, case)
        >>> state, record = step(structure, loop, state, jax.tree.map(lambda x: x[0], inputs))
    """
    voltage, clipped = state.controller.voltage, jnp.zeros_like(state.status)
    after = state.controller
    if structure.feedback == "sampled":
        after, info = controller_step(
            loop.controller,
            after,
            filtered_voltage(loop, state.plant),
            inputs.adc_noise,
            structure.is_smooth,
        )
        clipped = jnp.max(jnp.max(info.is_clipped, axis=1), axis=0)
    elif structure.feedback == "ideal":
        voltage = ideal_voltage(structure, loop, state.plant.q, state.plant.q_rate)
    return advance(structure, loop, state, inputs, voltage, after, clipped)


def filtered_voltage(loop: Loop, plant: PlantState) -> Array:
    """Sensor voltages behind the anti-alias filter [V], (3, K)."""
    assert plant.z is not None
    if plant.direct_z is None or loop.left_out is None:
        return jnp.sum(loop.sensor * plant.z[:, None], axis=2)
    return observed(loop.sensor, loop.left_out.sensor, plant.z, plant.direct_z)


def advance(
    structure: Structure,
    loop: Loop,
    state: State,
    inputs: Inputs,
    voltage: Array,
    after: ControllerState,
    clipped: Array,
) -> tuple[State, Record]:
    """One sample without the controller: plant, metrics and status.

    Args:
        structure: static choices.
        loop: constants of the case.
        state: at the sampling instant.
        inputs: of this sample.
        voltage: last command of the controller [V], (3, K).
        after: the controller's next state.
        clipped: 1 if an ADC channel clips, else 0, ().

    Returns:
        (state at the next instant, Record of this one).
    """
    plant = state.plant
    held = None if state.drive is None else state.drive.force
    if loop.delayed is None:
        next_plant, rates = _advance_plant(structure, loop, plant, inputs, voltage, held)
    else:
        voltage, next_plant, rates = _advance_delayed(
            structure, loop, loop.delayed, plant, inputs, (after.voltage, voltage), held
        )
    reference, chain = _reference(inputs, 0, held), rates.chain
    command = motor_force(structure, loop.drive, reference, chain.rho, chain.rho_rate)
    motors, _ = late_force(loop.drive, command, plant.motor)
    present = acting_now(loop.hysteresis, plant.voltage, plant.plays, voltage)
    sample = _sample(loop, plant, inputs, voltage, present, clipped, (command, motors), rates)
    fixed = metrics.Fixed(loop.omega, loop.modal_omega, loop.rotation, loop.settling_band)
    totals = metrics.accumulate(state.totals, metrics.Instant(sample, inputs.window, fixed))
    record = Record(
        time=inputs.window.time,
        pose=plant.pose,
        pose_error=sample.pose_error,
        slider=chain.rho,
        modal_coordinate=_modes(loop, plant.q),
        controlled_coordinate=sample.modal,
        chord_deflection_stations=sample.deflection,
        sensor_voltage=_raw_voltage(loop, plant, present),
        actuator_voltage=voltage,
        slider_force=motors,
    )
    proposed = State(
        plant=next_plant,
        controller=after,
        totals=totals,
        status=state.status,
        bad_time=state.bad_time,
        drive=_next_drive(structure, loop, state.drive, reference, chain, command),
    )
    return _freeze_if_bad(structure, loop, state, proposed, chain, inputs), record


def _next_drive(
    structure: Structure,
    loop: Loop,
    state: DriveState | None,
    reference: Reference,
    chain: Chain,
    motors: Array,
) -> DriveState | None:
    """Next state of a sampled drive, which like the controller samples before the plant moves."""
    if state is None:
        return None
    applied = motors if reference.feedforward is None else motors - reference.feedforward
    return drive_step(
        structure,
        loop.drive,
        structure.substeps * loop.plant_step,
        state,
        reference,
        chain.rho,
        chain.rho_rate,
        state.force if structure.is_linear else applied,
    )


def deflection(loop: Loop, q: Array, voltage: Array) -> Array:
    """Deflection from the chord at the stations [m], (3, S).

    Args:
        loop: constants of the case.
        q: modal coordinates [m], (3, R).
        voltage: on the actuators [V], (3, K).
    """
    if loop.left_out is None:
        return jnp.sum(loop.deflection_at * q[:, None], axis=2)
    return observed(loop.deflection_at, loop.left_out.deflection, q, voltage)


def _modes(loop: Loop, q: Array) -> Array:
    """Coordinates of the modes alone, (3, R)."""
    return q if loop.plant.stretch is None else q[:, :-1]


def _raw_voltage(loop: Loop, plant: PlantState, voltage: Array) -> Array:
    """Sensor voltages before the anti-alias filter [V], (3, K)."""
    q = plant.q if plant.s is None else plant.q - plant.s
    if loop.left_out is None:
        return jnp.sum(loop.sensor * q[:, None], axis=2)
    held = voltage if plant.direct_s is None else voltage - plant.direct_s
    return observed(loop.sensor, loop.left_out.sensor, q, held)


def _reference(inputs: Inputs, point: int, held: Array | None) -> Reference:
    return Reference(
        rho=inputs.rho[point],
        rho_rate=inputs.rho_rate[point],
        feedforward=None if inputs.feedforward is None else inputs.feedforward[point],
        disturbance=inputs.disturbance,
        wrench=inputs.wrench,
        held=held,
    )


def _advance_plant(
    structure: Structure,
    loop: Loop,
    plant: PlantState,
    inputs: Inputs,
    voltage: Array,
    held: Array | None,
) -> tuple[PlantState, Rates]:
    """All plant steps of one sample; held inputs stay constant. Returns the rates at its start."""
    if structure.substeps == 1:
        start, middle, end = (_reference(inputs, k, held) for k in range(3))
        return plant_step(structure, loop, plant, (start, middle, end), voltage)

    def part(x: Array | None) -> Array | None:
        if x is None:
            return None
        return jnp.stack([x[0:-2:2], x[1::2], x[2::2]], axis=1)

    def body(at: PlantState, points: tuple[Any, ...]) -> tuple[PlantState, Rates]:
        rho, rho_rate, forward = points
        start, middle, end = (
            Reference(
                rho=rho[k],
                rho_rate=rho_rate[k],
                feedforward=None if forward is None else forward[k],
                disturbance=inputs.disturbance,
                wrench=inputs.wrench,
                held=held,
            )
            for k in range(3)
        )
        return plant_step(structure, loop, at, (start, middle, end), voltage)

    points = (part(inputs.rho), part(inputs.rho_rate), part(inputs.feedforward))
    last, rates = jax.lax.scan(body, plant, points)
    return last, jax.tree.map(lambda x: x[0], rates)


def _advance_delayed(
    structure: Structure,
    loop: Loop,
    delayed: Delayed,
    plant: PlantState,
    inputs: Inputs,
    newest: tuple[Array, Array],
    held: Array | None,
) -> tuple[Array, PlantState, Rates]:
    """A sample in which the command changes.

    Returns:
        (command on the actuators at its start [V], (3, K); plant at its end, rates at its start).
    """
    assert plant.commands is not None
    older = [plant.commands[j] for j in range(plant.commands.shape[0])]
    first, second = (
        sum(share[j] * u for j, u in enumerate((*newest, *older)))
        for share in (delayed.before, delayed.after)
    )
    left_out = loop.left_out
    start = loop._replace(
        exponential=delayed.exponential,
        plant_step=delayed.plant_step,
        amplifier=delayed.amplifier,
        left_out=None if left_out is None else left_out._replace(passage=delayed.passage),
    )
    cut = 2 * structure.substeps
    until, then = (
        inputs._replace(
            rho=inputs.rho[part],
            rho_rate=inputs.rho_rate[part],
            feedforward=None if inputs.feedforward is None else inputs.feedforward[part],
        )
        for part in (slice(0, cut + 1), slice(cut, None))
    )
    changed, rates = _advance_plant(structure, start, plant, until, first, held)
    last, _ = _advance_plant(structure, loop, changed, then, second, held)
    present = jnp.where(delayed.plant_step > 0, first, second)
    return present, last._replace(commands=jnp.stack([newest[1], *older[:-1]])), rates


def _sample(
    loop: Loop,
    plant: PlantState,
    inputs: Inputs,
    voltage: Array,
    present: Array,
    clipped: Array,
    forces: tuple[Array, Array],
    rates: Rates,
) -> metrics.Sample:
    limit = loop.controller.voltage_limit * (1 - 1e-9)
    highest = jnp.max(jnp.max(jnp.abs(voltage), axis=1), axis=0)
    axial = rates.acceleration.axial
    is_full = jnp.any(jnp.abs(forces[0]) >= loop.drive.force_limit * (1 - 1e-9), axis=0)
    return metrics.Sample(
        deflection=deflection(loop, plant.q, present),
        q=_modes(loop, plant.q),
        q_rate=_modes(loop, plant.q_rate),
        modal=jnp.sum(loop.observer * plant.q[:, None], axis=2),
        modal_rate=jnp.sum(loop.observer * plant.q_rate[:, None], axis=2),
        pose_error=plant.pose - inputs.pose,
        voltage=voltage,
        is_saturated=jnp.where(highest >= limit, 1.0, 0.0).astype(voltage.dtype),
        is_clipped=clipped,
        motor_force=forces[1],
        is_motor_saturated=jnp.where(is_full, 1.0, 0.0).astype(voltage.dtype),
        axial_force=axial,
        stretch_error=stretch_error(rates.chain, loop.axial_compliance * axial),
        strain=None if loop.strain is None else observed(*loop.strain, plant.q, present),
    )


def _freeze_if_bad(
    structure: Structure, loop: Loop, old: State, new: State, chain: Chain, inputs: Inputs
) -> State:
    """Keep `old` from the first bad sample on."""
    plant = new.plant
    deflection = jnp.max(jnp.abs(jnp.sum(loop.deflection_at * plant.q[:, None], axis=2)), axis=1)
    is_wild = jnp.any(deflection > DIVERGED_DEFLECTION * loop.plant.length, axis=0)
    is_wild = is_wild | jnp.any(jnp.abs(plant.pose - inputs.pose) > DIVERGED_POSE, axis=0)
    total = jnp.sum(plant.pose + plant.pose_rate, axis=0)
    total = total + jnp.sum(jnp.sum(plant.q + plant.q_rate, axis=1), axis=0)
    total = total + jnp.sum(jnp.sum(new.controller.voltage, axis=1), axis=0)
    for part in jax.tree.leaves(new.drive):
        total = total + jnp.sum(part, axis=0)
    is_finite = jnp.abs(total) < jnp.inf  # false for NaN too
    # a linear machine's reach has no end
    code = chain_status(loop.plant, chain) if loop.rest is None else jnp.zeros_like(old.status)
    code = jnp.where((code == status.OK) & is_wild, float(status.DIVERGED), code)
    code = jnp.where(is_finite, code, float(status.NON_FINITE)).astype(old.status.dtype)
    is_first = (old.status == status.OK) & (code != status.OK)
    kept = jnp.where(old.status == status.OK, code, old.status)
    is_good = kept == status.OK
    chosen: State = jax.tree.map(lambda a, b: jnp.where(is_good, a, b), new, old)
    return chosen._replace(
        status=kept, bad_time=jnp.where(is_first, inputs.window.time, old.bad_time)
    )
