"""The linearised sampled loop: exact discretisation, spectral radius, modal damping, gain margin.

Stability is judged here, never from a run: saturation keeps an unstable loop bounded. The plant
with electronics, and a drive in continuous time, is discretised exactly for held commands; the
controller is the loop's own `controller_step`, which is linear without rounding and limits, and a
sampled drive is the loop's own `drive_step` at rest.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.checks import check_shape
from jaxmodel.controller import Controller, controller_step, rest_controller, with_gains
from jaxmodel.delay import LONGEST, command_change, true_delay
from jaxmodel.drive import Reference, drive_step
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveState, resting_drive
from jaxmodel.electronics import FASTEST
from jaxmodel.exponential import exponential
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.linear import LinearPlant, Moment, known_pose, linearise, resting
from jaxmodel.loop import Loop
from jaxmodel.parameters import Array, Int, Num
from jaxmodel.prepare import prepare

#: A spectral radius this far above 1 is unstable; free rigid modes sit at 1 up to rounding.
RADIUS_TOLERANCE = 1e-7


class LoopMatrices(NamedTuple):
    """Closed-loop transition matrix over one sample: open + factor * feedback.

    The state is (X, X', q, q', electronics, controller, sampled drive).
    """

    open: Num[Array, "n n"]  # all gains zero
    feedback: Num[Array, "n n"]  # what the gains add
    plant: Num[Array, "m m"]  # A of the continuous uncontrolled plant with drive, for its poles
    force: Num[Array, "n links"]  # response to forces on the joints held over the sample
    motor: Num[Array, "n links"]  # the same to commands of the motors
    deflection: Num[Array, "links*S n"]  # chord deflection at the stations [m], rows
    # response of a sampled drive's state to the reference of the joints, positions [m], then
    # speeds [m/s]; None: the drive acts in continuous time
    reference: Num[Array, "n 2*links"] | None = None

    def state_space(self, factor: Array = 1.0) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D per sample, from forces on the actuated joints to chord deflections.

        factor: on all gains.
        """
        direct = jnp.zeros((len(self.deflection), self.force.shape[1]), self.force.dtype)
        return self.open + factor * self.feedback, self.force, self.deflection, direct


@compiled("structure")
def closed_loop(
    structure: Structure,
    case: Case,
    pose: Num[Array, "pose"],
    law: Controller | None = None,
    moment: Moment | None = None,
) -> LoopMatrices:
    """Transition matrix of plant, filters, delay and controller per sample; differentiable.

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers; its gains belong to factor 1.
        pose: where to linearise [m, m, rad].
        law: controller to judge instead of the case's own, for instance with rounded coefficients.
        moment: motion and load at that pose; None: at rest under the case's steady load.

    Returns:
        LoopMatrices; NaN where the pose is out of reach or singular, or patches overlap or leave
        their link.

    Example:
        >>> structure, case = paper_case({"link.modes": 2})
        >>> A, B, C, D = closed_loop(structure, case, HOME).state_space()
        >>> bool(abs(jnp.linalg.eigvals(A)).max() < 1)
        True
    """
    check_shape("pose", pose, (structure.n_pose,))
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    loop = prepare(smooth, case).loop
    pose = known_pose(loop.plant, case, pose)
    law = loop.controller if law is None else law
    moment = resting(structure, case) if moment is None else moment
    return loop_matrices(structure, case, loop, law, pose, moment)


def loop_matrices(
    structure: Structure,
    case: Case,
    loop: Loop,
    law: Controller,
    pose: Array,
    moment: Moment | None,
) -> LoopMatrices:
    """`closed_loop` of a prepared case; moment None: at rest without load."""
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    drive = DRIVES[structure.drive]
    plant = linearise(smooth, loop, pose, moment, drive.is_sampled)
    analogue = analogue_plant(smooth, plant, case)
    exact = _over_a_sample(smooth, analogue, case)
    step = _Step(
        structure=smooth,
        case=case,
        loop=loop,
        law=law,
        plant=plant,
        filtered=analogue.filtered,
        exact=exact,
    )
    no_reference = jnp.zeros((2 * structure.n_links,), analogue.state.dtype)
    rest, unpack = step.rest()
    n = len(exact.held)
    start = jnp.concatenate([jnp.zeros((n,), analogue.state.dtype), rest])
    jacobian = jax.jacfwd(step.advance)
    without = jacobian(start, 0.0, no_reference)

    def deflected(x: Array) -> Array:
        if analogue.voltage is not None:
            voltage = x[analogue.voltage]
        else:
            commands = jnp.ravel(unpack(x[n:])[0].voltage)
            voltage = exact.present @ jnp.concatenate([x[:n], commands])
        bent = plant.deflection @ x[: plant.deflection.shape[1]]
        return bent + plant.direct_deflection @ voltage

    return LoopMatrices(
        open=without,
        feedback=jacobian(start, 1.0, no_reference) - without,
        plant=linearise(smooth, loop, pose, moment).state if drive.is_sampled else plant.state,
        force=jnp.pad(exact.force[:, -structure.n_links :], ((0, start.size - n), (0, 0))),
        motor=jnp.pad(exact.force[:, : structure.n_links], ((0, start.size - n), (0, 0))),
        deflection=jax.jacfwd(deflected)(start),
        reference=jax.jacfwd(step.advance, 2)(start, 0.0, no_reference)
        if drive.is_sampled
        else None,
    )


class _Step(NamedTuple):
    """What a closed loop does over one sample."""

    structure: Structure
    case: Case
    loop: Loop
    law: Controller
    plant: LinearPlant
    filtered: slice  # of the state: what the converters see
    exact: _Sampled

    def rest(self) -> tuple[Array, Callable[[Array], Any]]:
        """State of controller and drive at rest, and the function that unpacks such a state."""
        from jax.flatten_util import ravel_pytree

        still = jnp.zeros((self.structure.n_links,), self.exact.held.dtype)
        return ravel_pytree(
            (rest_controller(self.law), resting_drive(DRIVES[self.structure.drive], still))
        )

    def advance(self, x: Array, factor: Array | float, reference: Array) -> Array:
        """Next state, with all gains times a factor and the reference of a sampled drive, (6,)."""
        from jax.flatten_util import ravel_pytree

        n = len(self.exact.held)
        before, servo = self.rest()[1](x[n:])
        filtered = jnp.reshape(x[self.filtered], before.voltage.shape)
        law = with_gains(self.law, factor)
        after, _ = controller_step(law, before, filtered, None, True)
        moved = _moved(self.exact, jnp.concatenate([x[:n], jnp.ravel(before.voltage)]), servo)
        if self.exact.newest is not None:
            moved = moved + self.exact.newest @ jnp.ravel(after.voltage)
        servo = _next_drive(self.structure, self.case, self.loop, self.plant, x, servo, reference)
        return jnp.concatenate([moved, ravel_pytree((after, servo))[0]])


def _moved(exact: _Sampled, inputs: Array, servo: DriveState | None) -> Array:
    """Analogue state one sample later, from state and voltages, and the force of the drive."""
    moved = exact.held @ inputs
    return moved if servo is None else moved + exact.force[:, : len(servo.force)] @ servo.force


def _next_drive(
    structure: Structure,
    case: Case,
    loop: Loop,
    plant: LinearPlant,
    x: Array,
    servo: DriveState | None,
    reference: Array,
) -> DriveState | None:
    """Next state of a sampled drive; x begins with the plant's state, all are deviations."""
    if servo is None:
        return None
    assert plant.slider is not None
    seen, still = plant.slider @ x[: plant.slider.shape[1]], jnp.zeros_like(servo.force)
    n = structure.n_links
    wanted = Reference(reference[:n], reference[n:], None, still)
    return drive_step(
        structure._replace(is_linear=True),
        loop.drive,
        case.electronics.period,
        servo,
        wanted,
        seen[:n],
        seen[n:],
        servo.force,
    )


def delayed_loop(
    structure: Structure, case: Case, pose: Array, law: Controller, delay: Array
) -> Array:
    """Transition matrix of the closed loop whose commands come later still, (m, m).

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers.
        pose: where to linearise, at rest under the steady load [m, m, rad], (3,).
        law: controller.
        delay: beyond that of the case, which with it is at most `delay.LONGEST` [samples], ().
    """
    electronics = case.electronics
    electronics = electronics._replace(unmodelled_delay=electronics.unmodelled_delay + delay)
    later = case._replace(electronics=electronics)
    matrices = closed_loop(structure._replace(has_delay=True), later, pose, law)
    return matrices.open + matrices.feedback


class DelayedParts(NamedTuple):
    """What the transition of a closed loop over a sample is made of, as far as its delay matters.

    The state begins with that of plant and electronics, then commands on their way, u_(k-2) to
    u_(k-LONGEST).
    """

    matrix: Num[Array, "m m"]  # transition, 0 for plant and electronics
    state: Num[Array, "n n"]  # A of plant and electronics
    enters: Num[Array, "n links*(K+1)"]  # B of commands and motors' commands
    commands: Int[Array, "links*K"]  # place of every command u_(k-1) in the state
    forces: Int[Array, "links"] | None  # place of the forces that a sampled drive holds


def delayed_parts(structure: Structure, case: Case, loop: Loop, pose: Array) -> DelayedParts:
    """Parts of a loop that can be given any delay.

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers.
        loop: of the case, from `prepare`.
        pose: where to linearise, at rest under the steady load [m, m, rad], (3,).
    """
    smooth, drive = structure._replace(has_delay=True, is_smooth=True), DRIVES[structure.drive]
    plant = linearise(smooth, loop, pose, resting(smooth, case), drive.is_sampled)
    analogue = analogue_plant(smooth, plant, case)
    count, n_sensors, dtype = len(analogue.state), structure.n_sensors, analogue.state.dtype
    below = jnp.pad(_queue(n_sensors, dtype), ((count, 0), (count, 0)))
    unmoved = jnp.zeros((len(below), structure.n_links), dtype)
    exact = _Sampled(held=below, newest=None, force=unmoved, present=unmoved)
    step = _Step(
        structure=smooth,
        case=case,
        loop=loop,
        law=loop.controller,
        plant=plant,
        filtered=analogue.filtered,
        exact=exact,
    )
    rest, unpack = step.rest()
    n = len(below)
    places, servo = unpack(jnp.arange(n, n + rest.size, dtype=dtype))
    start = jnp.concatenate([jnp.zeros((n,), dtype), rest])
    return DelayedParts(
        matrix=jax.jacfwd(step.advance)(start, 1.0, jnp.zeros((2 * structure.n_links,), dtype)),
        state=analogue.state,
        enters=analogue.enters[:, : n_sensors + structure.n_links],
        commands=jnp.ravel(places.voltage).astype(int),
        forces=None if servo is None else servo.force.astype(int),
    )


class SampledPlant(NamedTuple):
    """What a controller acts on: x[k+1] = A x[k] + B u[k], y[k] = C x[k], over one sample.

    u are commands of the actuators [V], y what the converters see [V], link by link, patch by
    patch. Hold, amplifiers, anti-alias filter and the sample of computing delay are part of it; the
    state is that of `LoopMatrices` without its controller, then a sampled drive, and last the
    commands that are held.
    """

    state: Num[Array, "n n"]  # A
    enter: Num[Array, "n links*K"]  # B
    leave: Num[Array, "links*K n"]  # C


def sampled_plant(structure: Structure, case: Case, pose: Array) -> SampledPlant:
    """The plant that a controller designed elsewhere acts on, at rest under the steady load.

    Args:
        structure: static choices.
        case: the numbers.
        pose: where to linearise [m, m, rad], (3,).

    Returns:
        SampledPlant.
    """
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    loop, drive = prepare(smooth, case).loop, DRIVES[structure.drive]
    plant = linearise(smooth, loop, pose, resting(structure, case), drive.is_sampled)
    analogue = analogue_plant(smooth, plant, case)
    exact = _over_a_sample(smooth, analogue, case)
    from jax.flatten_util import ravel_pytree

    n, n_sensors = len(exact.held), structure.n_sensors
    no_reference = jnp.zeros((2 * structure.n_links,), exact.held.dtype)
    rest, unpack = ravel_pytree(resting_drive(drive, no_reference[: structure.n_links]))
    m = n + rest.size
    eye = jnp.eye(n_sensors, dtype=exact.held.dtype)

    def advance(x: Array) -> Array:
        servo = unpack(x[n:m])
        moved = _moved(exact, jnp.concatenate([x[:n], x[m:]]), servo)
        servo = _next_drive(smooth, case, loop, plant, x, servo, no_reference)
        return jnp.concatenate([moved, ravel_pytree(servo)[0]])

    held = jax.jacfwd(advance)(jnp.zeros((m + n_sensors,), eye.dtype))
    enter = jnp.pad(eye, ((m, 0), (0, 0)))
    return SampledPlant(
        state=jnp.pad(held, ((0, n_sensors), (0, 0))),
        enter=enter if exact.newest is None else enter.at[:n].set(exact.newest),
        leave=jnp.zeros((n_sensors, m + n_sensors), eye.dtype).at[:, analogue.filtered].set(eye),
    )


class AnaloguePlant(NamedTuple):
    """Plant and electronics between two samples."""

    state: Num[Array, "n n"]  # A
    # B of commands, of motors' commands and, where these are late, of forces on the joints
    enters: Num[Array, "n links*(K+1)"] | Num[Array, "n links*(K+2)"]
    filtered: slice  # of the state: what the converters see
    voltage: slice | None  # of the state: on the actuators; None: the command itself


class _Sampled(NamedTuple):
    """Exact over a sample; commands on their way are part of the state, u_(k-2) first."""

    held: Num[Array, "n n+links*K"]  # by the state and u_(k-1)
    newest: Num[Array, "n links*K"] | None  # by u_k, if its delay can be below a sample
    force: Num[Array, "n _"]  # by motors' commands, then forces on the joints, held over the sample
    present: Num[Array, "links*K n+links*K"]  # command on the actuators, of state and u_(k-1)


def _over_a_sample(structure: Structure, analogue: AnaloguePlant, case: Case) -> _Sampled:
    """Transition of plant and electronics from sample to sample."""
    period, n_sensors = case.electronics.period, structure.n_sensors
    eye = jnp.eye(n_sensors, dtype=analogue.state.dtype)
    if not structure.has_delay:
        exact = _held_transition(analogue, period)
        n = len(exact)
        held, force = exact[:, : n + n_sensors], exact[:, n + n_sensors :]
        return _Sampled(held, None, force, jnp.pad(eye, ((0, 0), (n, 0))))
    change = command_change(true_delay(case.electronics))
    first, second = (
        _held_transition(analogue, share * period) for share in (change.share, 1 - change.share)
    )
    n = len(first)
    whole = second[:, :n] @ first
    force = whole[:, n + n_sensors :] + second[:, n + n_sensors :]
    newest, last, *older = (
        a * whole[:, n : n + n_sensors] + b * second[:, n : n + n_sensors]
        for a, b in zip(change.before, change.after, strict=True)
    )
    queue = _queue(n_sensors, eye.dtype)
    below = jnp.pad(queue, ((0, 0), (n, 0)))
    above = jnp.concatenate([whole[:, :n], *older, last], axis=1)
    present = jnp.concatenate([share * eye for share in (*change.before[2:], change.before[1])], 1)
    ahead = ((0, len(queue)), (0, 0))
    return _Sampled(
        held=jnp.concatenate([above, below]),
        newest=jnp.pad(newest, ahead),
        force=jnp.pad(force, ahead),
        present=jnp.pad(present, ((0, 0), (n, 0))),
    )


def _queue(n_sensors: int, dtype: Any) -> Array:
    """Commands on their way one sample later, by them and u_(k-1): that enters as u_(k-2)."""
    queue = jnp.eye((LONGEST - 1) * n_sensors, LONGEST * n_sensors, -n_sensors, dtype)
    return queue.at[:n_sensors, -n_sensors:].set(jnp.eye(n_sensors, dtype=dtype))


def _held_transition(analogue: AnaloguePlant, period: Array) -> Array:
    """Exact transition over a time with held commands and forces, (n, n + 3 K + 3)."""
    n, n_inputs = analogue.enters.shape
    held = jnp.zeros((n + n_inputs,) * 2, analogue.state.dtype)
    held = held.at[:n, :n].set(analogue.state).at[:n, n:].set(analogue.enters)
    return exponential(held, period)[:n]


def analogue_plant(structure: Structure, plant: LinearPlant, case: Case) -> AnaloguePlant:
    """The plant with filters and, if present, drained patches and amplifiers.

    All filters are equal, so it does not matter whether modes are filtered before or after they
    are summed, and there are fewer sensors than modes.
    """
    electronics, n_plant = case.electronics, plant.state.shape[0]
    n_sensors = structure.n_sensors
    blocks = ["z", "z_rate"]
    if structure.has_sensor_highpass:
        blocks.append("s")
    if structure.has_amplifier:
        blocks.append("voltage")
    begins = n_plant + n_sensors * np.arange(len(blocks) + 1)
    at = {name: slice(*ends) for name, *ends in zip(blocks, begins, begins[1:], strict=False)}
    n, eye, corner = begins[-1], jnp.eye(n_sensors), electronics.antialias

    state = jnp.zeros((n, n), plant.state.dtype).at[:n_plant, :n_plant].set(plant.state)
    state = state.at[at["z"], at["z_rate"]].set(eye)
    state = state.at[at["z_rate"], :n_plant].set(corner**2 * plant.sensor)
    state = state.at[at["z_rate"], at["z"]].set(-(corner**2) * eye)
    state = state.at[at["z_rate"], at["z_rate"]].set(-jnp.sqrt(2.0) * corner * eye)
    highpass = electronics.sensor_highpass
    if "s" in at:
        state = state.at[at["z_rate"], at["s"]].set(-(corner**2) * eye)
        state = state.at[at["s"], :n_plant].set(highpass * plant.sensor)
        state = state.at[at["s"], at["s"]].set(-highpass * eye)
    commands = jnp.zeros((n, n_sensors), state.dtype)
    if "voltage" in at:
        # a batch can contain cases without an amplifier
        shortest = electronics.period / FASTEST
        rate = 1 / jnp.maximum(electronics.amplifier_lag, shortest)
        state = state.at[:n_plant, at["voltage"]].set(plant.voltage)
        state = state.at[at["z_rate"], at["voltage"]].set(corner**2 * plant.direct_sensor)
        if "s" in at:
            state = state.at[at["s"], at["voltage"]].set(highpass * plant.direct_sensor)
        state = state.at[at["voltage"], at["voltage"]].set(-rate * eye)
        commands = commands.at[at["voltage"]].set(rate * eye)
    else:
        commands = commands.at[:n_plant].set(plant.voltage)
        commands = commands.at[at["z_rate"]].set(corner**2 * plant.direct_sensor)
        if "s" in at:
            commands = commands.at[at["s"]].set(highpass * plant.direct_sensor)
    forces = plant.force
    if plant.motor is not None:
        forces = jnp.concatenate([plant.motor, forces], axis=1)
    forces = jnp.pad(forces, ((0, n - n_plant), (0, 0)))
    return AnaloguePlant(
        state=state,
        enters=jnp.concatenate([commands, forces], axis=1),
        filtered=at["z"],
        voltage=at.get("voltage"),
    )


#: Squarings of `slowest_decay`: motions whose decay per sample differs by 1e-8 are resolved.
SQUARINGS = 32
#: Motions that can share the largest modulus (a pair for each link, and as many again).
SHARED = 8


def slowest_decay(transition: Array, period: Array) -> Array:
    """Decay rate -ln(rho)/T of the slowest motion, rho the spectral radius; negative if unstable.

    By repeated squaring, rho = lim |M^n|^(1/n), with the norm taken out each time: batched
    anywhere, which eigenvalues of unsymmetric matrices are not. The remainder of M^n spans the
    slowest motions; with bases Y of them and Z of their left counterparts the derivative is
    d ln(rho) = Re tr((Z'MY)^+ Z' dM Y)/r, r their number.

    Args:
        transition: M of x_(k+1) = M x_k, (n, n).
        period: T [s], ().

    Returns:
        [1/s], ().
    """
    value, weight = jax.lax.stop_gradient(_log_radius(jax.lax.stop_gradient(transition)))
    slope = jnp.sum(weight * transition)
    return -(value + slope - jax.lax.stop_gradient(slope)) / period


def _log_radius(matrix: Array) -> tuple[Array, Array]:
    """ln(rho) and its derivative by the matrix, (n, n)."""
    scale = _balancing(matrix)
    balanced = matrix * scale / scale[:, None]

    def square(power: Array, _: None) -> tuple[Array, None]:
        power = power / jnp.sqrt(jnp.sum(power * power))
        return power @ power, None

    power, _ = jax.lax.scan(square, balanced, None, length=SQUARINGS)
    n = matrix.shape[0]
    looks = np.random.default_rng(0).normal(size=(2, n, min(SHARED, n)))
    right, left = power @ looks[0], power.T @ looks[1]
    right, left = (x / jnp.sqrt(jnp.sum(x * x)) for x in (right, left))
    inner, moved = left.T @ right, left.T @ balanced @ right
    inverse = jnp.linalg.pinv(moved, rtol=1e-6)
    count = jnp.round(jnp.trace(inverse @ moved))
    # on the space that is left M^-1 is inner inverse; elsewhere 1 instead of 0, for the determinant
    rest = jnp.eye(inner.shape[0], dtype=matrix.dtype) - moved @ inverse
    value = -jnp.linalg.slogdet(inner @ inverse + rest)[1] / count
    weight = (right @ inverse @ left.T).T / count
    return value, weight * scale / scale[:, None]


def _balancing(matrix: Array) -> Array:
    """Factors d for which rows and columns of M_ij d_j/d_i have nearly equal size, (n,)."""
    size, scale = jnp.abs(matrix), jnp.ones(matrix.shape[0], matrix.dtype)
    for _ in range(12):
        now = size * scale / scale[:, None]
        row, column = jnp.sum(now, axis=1), jnp.sum(now, axis=0)
        scale = scale * jnp.where((row > 0) & (column > 0), (row / column) ** 0.25, 1.0)
    return scale


#: Doublings of `summed_squares`: 8192 samples.
DOUBLINGS = 13


class Summed(NamedTuple):
    """sum over k of M^k S M'^k, as share * exp(log_size) lest it overflow."""

    share: Num[Array, "n n"]  # trace 1
    log_size: Num[Array, ""]


def summed_squares(matrix: Array, start: Array) -> Summed:
    """Sum of M^k S M'^k over 8192 samples by doubling; differentiable, also if M is unstable.

    With S = x x' it gives the energy of what comes after x, tr(C . C'); transposed, with S = C'C,
    the energy from all starts (the Gramians of linear systems).

    Args:
        matrix: M, (n, n).
        start: S, symmetric, not negative, (n, n).
    """

    def double(carried: tuple[Any, ...], _: None) -> tuple[tuple[Any, ...], None]:
        power, log_power, total, log_total = carried
        size = jnp.sqrt(jnp.sum(power * power))
        power, log_power = power / size, log_power + jnp.log(size)
        # both terms of total + power total power', without the factor that could overflow
        most = jnp.maximum(log_power, 0.0)
        later = jnp.exp(2 * (log_power - most)) * (power @ total @ power.T)
        total = jnp.exp(-2 * most) * total + later
        trace = jnp.trace(total)
        log_total = log_total + 2 * most + jnp.log(trace)
        return (power @ power, 2 * log_power, total / trace, log_total), None

    zero, trace = jnp.zeros((), matrix.dtype), jnp.trace(start)
    first = matrix, zero, start / trace, jnp.log(trace)
    (*_, share, log_size), _ = jax.lax.scan(double, first, None, length=DOUBLINGS)
    return Summed(share, log_size)


def spillover(structure: Structure, case: Case, matrices: LoopMatrices) -> Array:
    """How much control prolongs the ringing of modes it is not meant to damp [1], ().

    A mode is excited by an impulse, and sum (j^2 q_j)^2 over all uncontrolled modes is accumulated
    until the vibration has died out, with and without control; the result is the largest ratio over
    all uncontrolled modes. For an uncoupled mode it is the damping ratio without control over that
    with control; 1: no effect.

    Args:
        structure: static choices.
        case: the numbers.
        matrices: from `closed_loop`.
    """
    modes, n = structure.n_modes, structure.n_controlled
    control = case.control
    on = jnp.asarray(control.link_mask)[:, None] * control.mode_mask
    on = on * (jnp.arange(n) < control.n_active)
    is_left = 1.0 - jnp.pad(on, ((0, 0), (0, modes - n)))
    is_left = is_left * (jnp.arange(modes) < case.n_modes)
    is_left = jnp.ravel(jnp.pad(is_left, ((0, 0), (0, structure.n_coordinates - modes))))
    # omega of mode j grows as j^2; fixed weights, so that derivatives are of the loop alone
    order = jnp.arange(1.0, structure.n_coordinates + 1)
    weight = is_left * jnp.tile(order**4, structure.n_links)
    first = 2 * structure.n_pose
    last = first + is_left.size

    def ringing(transition: Array) -> tuple[Array, Summed]:
        outputs = jnp.zeros(transition.shape[0], transition.dtype).at[first:last].set(weight)
        gramian = summed_squares(jax.lax.stop_gradient(transition).T, jnp.diag(outputs))
        return jnp.diagonal(gramian.share)[first:last], gramian

    # the plant's states and those of a sampled drive; electronics do not act back on them
    size = matrices.open.shape[0]
    drive = resting_drive(DRIVES[structure.drive], jnp.zeros((structure.n_links,)))
    count = sum(x.size for x in jax.tree.leaves(drive))
    kept = np.r_[0 : 2 * last - first + structure.n_motors, size - count : size]
    plant = matrices.open[np.ix_(kept, kept)]
    loop = matrices.open + matrices.feedback
    (free_energy, free), (energy, closed) = ringing(plant), ringing(loop)
    ratio = jnp.where(is_left > 0, energy / jnp.where(is_left > 0, free_energy, 1.0), 0.0)
    mode = jnp.argmax(ratio)
    log_size = jnp.minimum(closed.log_size - free.log_size, 50.0)
    value = jax.lax.stop_gradient(ratio[mode] * jnp.exp(log_size))
    slope = _energy_slope(loop, closed, first + mode) - _energy_slope(plant, free, first + mode)
    return value * (1 + slope - jax.lax.stop_gradient(slope))


def _energy_slope(matrix: Array, gramian: Summed, entry: Array) -> Array:
    """An expression with the derivative of ln(Q_jj), Q the solution of Q = M'QM + C'C, ().

    With P = M P M' + e_j e_j' that derivative is tr(2 P M'Q dM)/Q_jj: no need to differentiate
    the doubling. The outputs C are constants.
    """
    fixed = jax.lax.stop_gradient(matrix)
    start = jnp.zeros(matrix.shape[0], matrix.dtype).at[entry].set(1.0)
    reached = summed_squares(fixed, jnp.outer(start, start))
    weight = 2 * gramian.share @ fixed @ reached.share / gramian.share[entry, entry]
    weight = weight * jnp.exp(jnp.minimum(reached.log_size, 50.0))
    return jnp.sum(jax.lax.stop_gradient(weight) * matrix)
