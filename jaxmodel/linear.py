"""Linearisation at a pose: frequencies, damping, mode shapes, frequency response.

The state is x = (X, X', q, q'), flattened, about the machine at that pose with straight links, at
rest or in motion; the drive supplies the forces that sustain it, and axial forces change the
stiffness of the links. Matrices come from forward-mode differentiation of the loop's own plant;
`jaxmodel.sampled_loop` adds electronics and controller.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.axial import axial_force, held_coordinates
from jaxmodel.case import MOTOR_ORDER, Case, Structure
from jaxmodel.checks import check_shape
from jaxmodel.drive import Reference, motor_force, settled_motors, slider_force
from jaxmodel.drives import DRIVES
from jaxmodel.dynamics import inverse_dynamics, kinetic_energy, modal_chain
from jaxmodel.kinematics import close_chain, path_status
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.loop import Loop, PlantState, plant_rates
from jaxmodel.parameters import Array, Complex, Num
from jaxmodel.piezo import placement_faults
from jaxmodel.plant import Plant


class LinearPlant(NamedTuple):
    """x' = A x + B_voltage V_a + B_force F; outputs are rows that multiply x, or V_a.

    States of motors that follow late come last in x.
    """

    state: Num[Array, "n n"]  # A [1/s and mixed], n = 2 (pose + links Q)
    voltage: Num[Array, "n links*K"]  # B_voltage
    force: Num[Array, "n links"]  # B_force, disturbance on the actuated joints
    deflection: Num[Array, "links*S n"]  # chord deflection at the stations [m]
    sensor: Num[Array, "links*K n"]  # voltages of the sensors, open-circuit [V]
    # what the actuators' voltages add at once to both, by the modes that are left out
    direct_deflection: Num[Array, "links*S links*K"]  # [m/V]
    direct_sensor: Num[Array, "links*K links*K"]  # [V/V]
    # what a sampled drive reads: positions of the joints [m], then their speeds [m/s]
    slider: Num[Array, "2*links n"] | None = None
    # B of commands to motors that follow late; None: as force
    motor: Num[Array, "n links"] | None = None


def flatten(state: PlantState) -> Array:
    """x = (X, X', q, q', motors) as a vector."""
    late = () if state.motor is None else (state.motor,)
    return jnp.concatenate([jnp.ravel(jnp.asarray(part)) for part in (*state[:4], *late)])


def unflatten(x: Array, structure: Structure) -> PlantState:
    """Inverse of `flatten`."""
    n, links = structure.n_pose, structure.n_links
    first = 2 * n + 2 * links * structure.n_coordinates
    modes = jnp.reshape(x[2 * n : first], (2, links, structure.n_coordinates))
    motor = jnp.reshape(x[first:], (-1, links)) if structure.has_drive_lag else None
    return PlantState(x[:n], x[n : 2 * n], modes[0], modes[1], motor=motor)


class Moment(NamedTuple):
    """An instant of a motion under load."""

    rate: Num[Array, "pose"]  # X' [m/s, m/s, rad/s]
    acceleration: Num[Array, "pose"]  # X'' [m/s2, m/s2, rad/s2]
    wrench: Num[Array, "pose"]  # on the platform [N, N, N m]


def resting(structure: Structure, case: Case) -> Moment | None:
    """The machine at rest under the case's steady load; None without load."""
    if not structure.has_wrench:
        return None
    still = jnp.zeros_like(jnp.asarray(case.load.wrench))
    return Moment(still, still, case.load.wrench)


@compiled("structure", "is_held")
def linearise(
    structure: Structure,
    loop: Loop,
    pose: Num[Array, "pose"],
    moment: Moment | None = None,
    is_held: bool = False,
) -> LinearPlant:
    """Linear plant at a pose; with ideal feedback in `structure` its loop is closed in A.

    Args:
        structure: static choices.
        loop: constants of the case.
        pose: (x, y, phi) [m, m, rad].
        moment: motion and load there, taken as lasting; None: at rest without load.
        is_held: leave out the feedback of the drives, whose force is held; otherwise a
            sampled drive acts by its `drive_gains`, in continuous time.

    Returns:
        LinearPlant.

    Example:
        >>> structure, case = paper_case({"link.modes": 2, "control.feedback": "none"})
        >>> linearise(structure, prepare(structure, case).loop, jnp.array(HOME)).state.shape
        (24, 24)
    """
    check_shape("pose", pose, (structure.n_pose,))
    # friction counts as nothing here: it damps small motion most, the safe side
    loop = loop._replace(plant=loop.plant._replace(joint_friction=None))
    pose = jnp.asarray(pose, loop.omega.dtype)
    still = jnp.zeros_like(pose)
    rate = still if moment is None else jnp.asarray(moment.rate, pose.dtype)
    chain = close_chain(loop.plant, pose, rate)
    zero = jnp.zeros_like(loop.plant.stiffness)
    held_q = zero
    if loop.plant.stretch is not None and moment is not None:
        force = axial_force(loop.plant, pose, rate, moment.acceleration, moment.wrench)
        held_q = held_coordinates(loop.plant, force)
        chain = modal_chain(loop.plant, pose, rate, held_q, zero)
    rest = flatten(PlantState(pose, rate, held_q, zero, motor=settled_motors(structure, still)))
    has_feedforward = (
        structure.has_drive_lag or DRIVES[structure.drive].has_feedforward or structure.has_wrench
    )
    reference = Reference(
        rho=chain.rho,
        rho_rate=chain.rho_rate,
        feedforward=still if has_feedforward else None,
        disturbance=still,
        held=still if is_held else None,
    )
    if moment is not None:
        held = inverse_dynamics(loop.plant, pose, rate, moment.acceleration, moment.wrench)
        smooth = structure._replace(is_smooth=True)
        motors = motor_force(smooth, loop.drive, reference, chain.rho, chain.rho_rate)
        drive_force = slider_force(smooth, loop.drive, reference, motors, chain.rho_rate)
        reference = reference._replace(disturbance=held - drive_force, wrench=moment.wrench)

    def derivative(x: Array, voltage: Array, force: Array, command: Array) -> Array:
        at = unflatten(x, structure)
        pushed = reference._replace(disturbance=reference.disturbance + force)
        if structure.has_drive_lag:
            pushed = pushed._replace(feedforward=command)
        rates = plant_rates(
            structure, loop, at, pushed, jnp.reshape(voltage, (structure.n_links, -1))
        )
        moves = rates.acceleration
        return flatten(
            PlantState(at.pose_rate, moves.pose, at.q_rate, moves.modal, motor=rates.motor)
        )

    def slider(x: Array) -> Array:
        at = unflatten(x, structure)
        if structure.is_coupled:
            moved = modal_chain(loop.plant, at.pose, at.pose_rate, at.q, at.q_rate)
        else:
            moved = close_chain(loop.plant, at.pose, at.pose_rate)
        return jnp.concatenate([moved.rho, moved.rho_rate])

    n_links = structure.n_links
    n_voltages = structure.n_sensors
    inputs = (0, 1, 2, 3) if structure.has_drive_lag else (0, 1, 2)
    a, b_voltage, b_force, *b_command = jax.jacfwd(derivative, inputs)(
        rest, jnp.zeros((n_voltages,), rest.dtype), still, still
    )
    direct_deflection = jnp.zeros((n_links * loop.deflection_at.shape[1], n_voltages), rest.dtype)
    direct_sensor = jnp.zeros((n_links * loop.sensor.shape[1], n_voltages), rest.dtype)
    if loop.left_out is not None:
        direct_deflection = _diagonal(loop.left_out.deflection)
        direct_sensor = _diagonal(loop.left_out.sensor)
    return LinearPlant(
        state=a,
        voltage=b_voltage,
        force=b_force,
        deflection=_rows(loop.deflection_at, structure),
        sensor=_rows(loop.sensor, structure),
        direct_deflection=direct_deflection,
        direct_sensor=direct_sensor,
        slider=jax.jacfwd(slider)(rest) if is_held else None,
        motor=b_command[0] if b_command else None,
    )


def _rows(matrix: Array, structure: Structure) -> Array:
    """Per-link outputs of q, (3, m, R), as rows over x."""
    rates = structure.n_links * structure.n_coordinates + structure.n_motors
    return jnp.pad(_diagonal(matrix), ((0, 0), (2 * structure.n_pose, rates)))


def _diagonal(matrix: Array) -> Array:
    """Blocks of the links, (3, m, n), on a diagonal, (3 m, 3 n)."""
    links, m, n = matrix.shape
    return jnp.einsum("imr,il->imlr", matrix, jnp.eye(links)).reshape(links * m, links * n)


def places_and_rates(plant: LinearPlant) -> tuple[np.ndarray, np.ndarray]:
    """Where (X, q) and (X', q') are in x."""
    pose = plant.force.shape[1]  # as many joints as pose coordinates
    first, modes = 2 * pose, (plant.state.shape[0] - n_motors(plant)) // 2 - pose
    return (
        np.r_[0:pose, first : first + modes],
        np.r_[pose:first, first + modes : first + 2 * modes],
    )


def mechanical(plant: LinearPlant) -> Array:
    """A with rows and columns in the order (X, q, X', q') and, if they are late, motors."""
    size = plant.state.shape[0]
    index = np.r_[(*places_and_rates(plant), slice(size - n_motors(plant), size))]
    return plant.state[np.ix_(index, index)]


def n_motors(plant: LinearPlant) -> int:
    """States of motors that follow late."""
    return 0 if plant.motor is None else MOTOR_ORDER * int(plant.motor.shape[1])


def mass_and_stiffness(loop: Loop, pose: Array, plant: LinearPlant) -> tuple[Array, Array]:
    """Mass and stiffness matrix in (X, q): M x'' + K x = 0 without damping.

    Args:
        loop: constants of the case.
        pose: (x, y, phi) [m, m, rad], (3,).
        plant: of `linearise`, there.

    Returns:
        (M, K): [kg and mixed] and [N/m and mixed], symmetric, (m, m) with m = 3 + 3 R.
    """
    rest = jnp.zeros_like(loop.plant.stiffness)
    count = len(pose)
    size = count + rest.size

    def energy(rates: Array) -> Array:
        pose_rate, q_rate = rates[:count], rates[count:].reshape(rest.shape)
        chain = modal_chain(loop.plant, pose, pose_rate, rest, q_rate)
        return kinetic_energy(loop.plant, chain, pose_rate, rest, q_rate)

    mass = jax.hessian(energy)(jnp.zeros(size, rest.dtype))
    state = mechanical(plant)
    by_place, last = state[size : 2 * size, :size], 2 * size
    if plant.motor is not None:  # at rest motors have followed
        followed = jnp.linalg.solve(state[last:, last:], state[last:, :size])
        by_place = by_place - state[size:last, last:] @ followed
    stiffness = -mass @ by_place
    return mass, (stiffness + stiffness.T) / 2


class NaturalModes(NamedTuple):
    """Natural modes, ascending in frequency."""

    frequency: Num[np.ndarray, "m"]  # |lambda|/2 pi [Hz]
    damping_ratio: Num[np.ndarray, "m"]  # [1]
    # (X, q) part of the eigenvectors, largest entry 1, one per column
    shape: Num[np.ndarray, "m m"]


def natural_modes(plant: LinearPlant) -> NaturalModes:
    """Frequencies, damping ratios and shapes of the assembled machine (on the host).

    An undamped machine is solved as lambda^2 of the position block, which keeps rigid modes at
    zero. Otherwise the 2 m poles are paired: conjugates, and a slow real pole with a fast one of
    similar shape. For these, frequency means sqrt(lambda_1 lambda_2) and the damping ratio is 1 or
    more (1 where the slow one is zero: held only by damping). Poles of motors that follow late are
    left out.

    Example:
        >>> structure, case = paper_case({"link.modes": 2, "control.feedback": "none"})
        >>> plant = linearise(structure, prepare(structure, case).loop, jnp.array(HOME))
        >>> bool(natural_modes(plant).frequency[0] > 0)
        True
    """
    a, late = np.asarray(mechanical(plant)), n_motors(plant)
    m = (a.shape[0] - late) // 2
    if not np.any(a[m:, m:]):
        value, vector = np.linalg.eig(a[m:, :m])
        # motion of the pose without any spring is a zero eigenvalue with rounding on top
        omega = np.sqrt(np.maximum(-value.real, 0.0))
        order = np.argsort(omega)
        # of a pair of equal modes that rounding has split off the axis, both parts are modes
        shape = np.where(np.imag(value) < 0, vector.imag, vector.real)[:, order]
        return NaturalModes(omega[order] / (2 * np.pi), np.zeros(m), _scaled(shape))
    value, vector = np.linalg.eig(a)
    # a pair that rounding has split off the real axis by less than this is real
    is_real = np.abs(value.imag) <= 1e-9 * np.abs(value).max()
    upper = np.flatnonzero(~is_real & (value.imag > 0))
    real = np.flatnonzero(is_real)
    if late:  # a real pole and a pair of each motor, in which motors take part most, are no modes
        part = np.abs(np.linalg.inv(vector).T * vector)[2 * m :].sum(axis=0)
        upper, real = (x[np.argsort(part[x])][: -late // MOTOR_ORDER] for x in (upper, real))
        real = real[: len(real) // 2 * 2]
    real = _paired(real[np.argsort(np.abs(value[real]))], value, vector[:m])
    omega = list(np.abs(value[upper]))
    zeta = list(-value[upper].real / np.abs(value[upper]))
    column = list(upper)
    for one, two in zip(real[0::2], real[1::2], strict=True):
        product = max(abs(value[one].real * value[two].real), 0.0)
        root = np.sqrt(product)
        omega.append(root)
        zeta.append(-(value[one].real + value[two].real) / (2 * root) if root > 0 else 1.0)
        column.append(two)
    order = np.argsort(omega)
    shape = _scaled(vector[:m, np.array(column)[order]])
    return NaturalModes(np.array(omega)[order] / (2 * np.pi), np.array(zeta)[order], shape)


def _paired(real: np.ndarray, value: np.ndarray, shape: np.ndarray) -> np.ndarray:
    """Real poles in ascending size, reordered so that neighbouring pairs belong to one oscillator.

    Both poles of an overdamped oscillator move the machine in nearly the same shape.
    """
    slow, fast = real[: len(real) // 2], list(real[len(real) // 2 :])
    unit = shape / np.linalg.norm(shape, axis=0)
    order = []
    for one in slow:
        similarity = [abs(np.vdot(unit[:, one], unit[:, two])) for two in fast]
        order += [one, fast.pop(int(np.argmax(similarity)))]
    return np.array(order, int)


def _scaled(shape: np.ndarray) -> np.ndarray:
    peak = shape[np.argmax(np.abs(shape), axis=0), np.arange(shape.shape[1])]
    return shape / np.where(peak == 0, 1.0, peak)


def frequency_response(
    plant: LinearPlant,
    output: Num[Array, "p n"],
    source: Num[Array, "n m"],
    frequency: Num[Array, "f"],
) -> Complex[Array, "f p m"]:
    """Response output (j omega - A)^-1 source.

    Args:
        plant: linear plant.
        output: rows over x, such as `plant.deflection`.
        source: columns, such as `plant.force`.
        frequency: [Hz].

    Returns:
        Of each frequency, from each column to each row, in their units.

    Example:
        >>> structure, case = paper_case({"link.modes": 2, "control.feedback": "none"})
        >>> plant = linearise(structure, prepare(structure, case).loop, jnp.array(HOME))
        >>> frequency_response(plant, plant.deflection[:1], plant.force[:, :1], [90.0]).shape
        (1, 1, 1)
    """
    eye = jnp.eye(plant.state.shape[0])

    def at(f: Array) -> Array:
        return output @ jnp.linalg.solve(2j * jnp.pi * f * eye - plant.state, source + 0j)

    return jax.vmap(at)(jnp.asarray(frequency))


def known_pose(plant: Plant, case: Case, pose: Any) -> Array:
    """A pose, or NaN, and with it all that follows, where no machine can be.

    Out of reach, singular, or with patches that overlap or leave their link.

    Args:
        plant: the machine.
        case: its numbers.
        pose: of the platform, (p,).
    """
    pose = jnp.asarray(pose, plant.length.dtype)
    is_off, is_overlapping = placement_faults(case.machine.patches, plant.length)
    is_fine = (path_status(plant, pose[None])[0] == status.OK) & ~is_off & ~is_overlapping
    return jnp.where(is_fine, pose, jnp.nan)
