"""Frequency response of the sampled loop: plant, controller, and the loops that they close.

A sampler sees the sum of the plant's responses at s_n = j omega + 2 pi j n/T. Links couple only
through the pose, so each response is a sum over the modes of each link and a system of three
equations for the pose (docs/theory.md, "Margins by frequency response"). The sum over n is
complete: the images that are not evaluated follow a power law, whose sum is known.

All responses are complex, of commands [V] to sampled sensor voltages [V], link by link, patch by
patch, for any law; those of forces on the joints [N] and of chord deflections [m] are beside them.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from jaxmodel.axial import axial_force, chord_slopes
from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.controller import Controller
from jaxmodel.delay import LONGEST, command_change, true_delay
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.dynamics import mass_matrix, platform_mass
from jaxmodel.electronics import FASTEST
from jaxmodel.estimator import responses
from jaxmodel.kinematics import close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.loop import Loop
from jaxmodel.notch import notch_response
from jaxmodel.parameters import Array
from jaxmodel.plant import Plant

#: Images on either side that are evaluated, and those of them from which the rest is extrapolated.
IMAGES, ANCHORS = 12, (12, 10, 8)
#: Images on either side that make a response good to 1e-4, for searches.
FEW = 2
#: Images beyond `IMAGES` whose power law is summed term by term.
_SUMMED = 500


class PlantResponse(NamedTuple):
    """The machine about rest, in normal coordinates of each link (modal masses 1)."""

    mass: Array  # of the pose with straight links, (3, 3)
    damping: Array  # of the drive in the pose, (3, 3)
    stiffness: Array  # (3, 3)
    square: Array  # omega^2 of the modes of a link with held ends [1/s2], (3, R)
    decay: Array  # 2 zeta omega [1/s], (3, R)
    enter: Array  # generalised force on the pose per modal acceleration, (3, 3, R)
    leave: Array  # inertia force on a mode per pose acceleration, (3, 3, R)
    sensor: Array  # sensor volts per modal coordinate, (3, K, R)
    actuator: Array  # modal force per actuator volt, (3, R, K)
    direct: Array  # sensor volts per actuator volt by modes that are left out, (3, K, K)
    deflection: Array  # from the chord at the stations per modal coordinate, (3, S, R)
    direct_deflection: Array  # the same per actuator volt by modes that are left out, (3, S, K)
    slide: Array  # of the actuated joints per motion of the pose, (3, 3)
    period: Array  # T [s], ()
    antialias: Array  # [rad/s], ()
    highpass: Array | None  # of the patches [rad/s], None if there is none, ()
    lag: Array | None  # of the amplifiers [s], None if there are none, ()
    delay: Array | None  # from sample to command [samples], None: one, ()

    @property
    def late(self) -> Array:
        """The same, also where it is one."""
        return jnp.ones(()) if self.delay is None else self.delay


def plant_response(structure: Structure, case: Case, loop: Loop, pose: Array) -> PlantResponse:
    """Collect what responses of the plant read.

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers.
        loop: of the case, from `prepare`.
        pose: where to linearise, at rest under the steady load [m, m, rad], (3,).

    Returns:
        PlantResponse; a sampled drive acts in it by its `drive_gains`.
    """
    plant, drive, electronics = loop.plant, loop.drive, case.electronics
    pose = jnp.asarray(pose, loop.omega.dtype)
    still = jnp.zeros_like(pose)

    def rates(pose_rate: Array) -> tuple[Array, Array]:
        chain = close_chain(plant, pose, pose_rate)
        return chain.rho_rate, chain.beta_rate

    to_rho, to_beta = jax.jacfwd(rates)(still)  # (3 links, 3)
    chain = close_chain(plant, pose, still)
    platform = mass_matrix(platform_mass(plant, chain.turn))
    swing = -plant.tip_mass * chain.chord * chain.sine
    mass = platform + sum(
        jnp.einsum("i,ip,iq->pq", *terms)
        for terms in (
            (plant.slider_link_mass, to_rho, to_rho),
            (plant.inertia, to_beta, to_beta),
            (swing, to_rho, to_beta),
            (swing, to_beta, to_rho),
        )
    )
    at_c, at_b, inertia = _from_chord(plant)
    leave = to_beta[:, :, None] * at_c[:, None] - (
        (chain.sine[:, None] * to_rho)[:, :, None] * at_b[:, None]
    )
    gains = drive_gains(DRIVES[structure.drive], drive)
    slope = gains.rate + drive.viscous_friction
    if structure.has_friction:
        slope = slope + drive.coulomb_friction / drive.friction_speed
    stiffness = jnp.einsum("i,ip,iq->pq", gains.position, to_rho, to_rho)
    modal_mass = plant.modal_mass[:, None]
    springs = None
    if structure.has_wrench:
        held = jnp.linalg.solve(to_rho.T, -case.load.wrench)
        curved = jax.hessian(lambda x: jnp.sum(held * close_chain(plant, x, still).rho))(pose)
        stiffness = stiffness - curved
        axial = axial_force(plant, pose, still, still, case.load.wrench)
        springs = axial[:, None, None] * chord_slopes(plant)
    modes = _normal_modes(plant, inertia, springs)
    leave = leave / modal_mass[:, None]
    decay = plant.damping / modal_mass
    sensor, actuator, deflection = loop.sensor, loop.actuator, loop.deflection_at
    if modes.shape is not None:
        leave, sensor, deflection = (
            jnp.einsum("ipr,irs->ips", x, modes.shape) for x in (leave, sensor, deflection)
        )
        actuator = jnp.einsum("irk,irs->isk", actuator, modes.shape)
        decay = jnp.einsum("irs,ir,irs->is", modes.shape, decay, modes.shape)
    enter = leave * modal_mass[:, None]
    if not structure.is_coupled:
        enter = jnp.zeros_like(enter)
    left_out, n = loop.left_out, structure.n_patches
    shape = (len(deflection), deflection.shape[1], n)
    direct = jnp.zeros((len(deflection), n, n), mass.dtype)
    return PlantResponse(
        mass=mass,
        damping=jnp.einsum("i,ip,iq->pq", slope, to_rho, to_rho),
        stiffness=stiffness,
        square=modes.square,
        decay=decay,
        enter=enter,
        leave=leave,
        sensor=sensor,
        actuator=actuator,
        direct=direct if left_out is None else left_out.sensor,
        deflection=deflection,
        direct_deflection=jnp.zeros(shape, mass.dtype) if left_out is None else left_out.deflection,
        slide=to_rho,
        period=jnp.asarray(electronics.period),
        antialias=jnp.asarray(electronics.antialias),
        highpass=electronics.sensor_highpass if structure.has_sensor_highpass else None,
        lag=electronics.amplifier_lag if structure.has_amplifier else None,
        delay=true_delay(electronics) if structure.has_delay else None,
    )


def _from_chord(plant: Plant) -> tuple[Array, Array, Array | None]:
    """c, b and the modal inertia matrix of deflections from the chord.

    The platform holds the far ends, so sliders and chords follow the pose alone. Where a mode moves
    its end by tau_j, the frame is turned by -tau_j q_j/L against the chord:
    c - tau J0/L, b - tau e/L and m I + tau tau^t J0/L^2 - (tau c^t + c tau^t)/L.

    Returns:
        c [kg m], (3, R); b [kg], (3, R); inertia [kg], (3, R, R), None: m I.
    """
    if plant.tip is None:
        return plant.c, plant.b, None
    turn = plant.tip / plant.length[:, None]
    c = plant.c - plant.inertia[:, None] * turn
    b = plant.b - plant.tip_mass[:, None] * plant.tip
    mixed = turn[:, :, None] * (c + plant.c)[:, None]
    eye = plant.modal_mass[:, None, None] * jnp.eye(turn.shape[1])
    return c, b, eye - (mixed + jnp.swapaxes(mixed, 1, 2)) / 2


class _NormalModes(NamedTuple):
    """Of each link between held ends."""

    square: Array  # omega^2 [1/s2], (3, R)
    shape: Array | None  # in modal coordinates, of modal mass m, (3, R, R); None: themselves


def _normal_modes(plant: Plant, inertia: Array | None, springs: Array | None) -> _NormalModes:
    """Modes of (modal inertia, stiffness with `springs` of axial forces [N/m], (3, R, R))."""
    mass = plant.modal_mass[:, None]
    if inertia is None and (springs is None or plant.mixed_shortening is None):
        diagonal = 0.0 if springs is None else jnp.einsum("irr->ir", springs)
        return _NormalModes((plant.stiffness + diagonal) / mass, None)
    eye = jnp.eye(plant.stiffness.shape[1])
    stiffness = plant.stiffness[:, :, None] * eye + (0.0 if springs is None else springs)
    if inertia is None:
        return _NormalModes(*jnp.linalg.eigh(stiffness / mass[:, None]))
    half = jnp.linalg.inv(jnp.linalg.cholesky(inertia / mass[:, None]))
    square, shape = jnp.linalg.eigh(
        jnp.einsum("ijr,irs,iks->ijk", half, stiffness / mass[:, None], half)
    )
    return _NormalModes(square, jnp.einsum("ikr,iks->irs", half, shape))


# --- the spectrum's images ------------------------------------------------------------------------


@cache
def tail_weights() -> tuple[np.ndarray, np.ndarray]:
    """What the images beyond `IMAGES` add to the weights of those at `ANCHORS`.

    They are sums of powers of 1/n: pairs f(n) + f(-n) of even ones from n^-4, pairs f(n) - f(-n) of
    odd ones from n^-3, since hold and anti-alias filter fall as n^-3 or faster.

    Returns:
        Factors of cos(2 pi n tau) and of -j sin(2 pi n tau), n = `IMAGES` + 1.., (.., I) each.
    """
    anchors = np.array(ANCHORS, float)[:, None]
    beyond = np.arange(IMAGES + 1, IMAGES + 1 + _SUMMED)[:, None]
    even, odd = (
        beyond**-powers @ np.linalg.inv(anchors**-powers)
        for powers in (np.array([4.0, 6.0, 8.0]), np.array([3.0, 5.0, 7.0]))
    )
    places = np.array(ANCHORS)
    whole = np.zeros((2, _SUMMED, 2 * IMAGES + 1))
    whole[:, :, IMAGES + places] = even, odd
    whole[:, :, IMAGES - places] = even, -odd
    return whole[0], whole[1]


def image_weights(delay: Array) -> Array:
    """Weights of the responses at s_n, n = -`IMAGES`.. `IMAGES`, whose sum a sampler sees, (I,).

    A delay of tau samples turns image n by -2 pi n tau, beside the -omega T tau of all.

    Args:
        delay: tau [samples], ().
    """
    even, odd = tail_weights()
    beyond = np.arange(IMAGES + 1, IMAGES + 1 + _SUMMED)
    turn = 2 * np.pi * jnp.asarray(delay)
    weights = jnp.exp(-1j * turn * np.arange(-IMAGES, IMAGES + 1))
    return weights + jnp.cos(turn * beyond) @ even - 1j * (jnp.sin(turn * beyond) @ odd)


class Images(NamedTuple):
    """Responses at s_n before they are summed, complex, (I, outputs, inputs) each."""

    sensed: Array  # sensor volts per held command [V/V], (I, 3 K, 3 K)
    disturbed: Array  # sensor volts per held force on an actuated joint [V/N], (I, 3 K, 3)
    bent: Array  # chord deflections by the plant's modes per held command [m/V], (I, 3 S, 3 K)
    pushed: Array  # the same per held force on an actuated joint [m/N], (I, 3 S, 3)


def plant_images(plant: PlantResponse, omega: Array, order: np.ndarray) -> Images:
    """Responses of the plant at s_n, without any delay.

    A mode moves by q = (a u - s^2 l X)/(s^2 + 2 zeta omega s + omega^2), the pose by
    Z X = J' F - s^2 sum e q with its dynamic stiffness Z.

    Args:
        plant: of the machine.
        omega: above 0 [rad/s], ().
        order: numbers n of the images, (I,).

    Returns:
        Images.
    """
    period, corner = plant.period, plant.antialias
    s = 1j * (omega + 2 * np.pi / period * order)
    s2 = s * s
    held = (1 - jnp.exp(-1j * omega * period)) / (s * period)
    seen = corner**2 / (s2 + np.sqrt(2.0) * corner * s + corner**2)
    if plant.highpass is not None:
        seen = seen * s / (s + plant.highpass)
    driven = held if plant.lag is None else held / (1 + s * plant.lag)
    mobile = 1 / (s2[:, None, None] + s[:, None, None] * plant.decay + plant.square)  # (I, 3, R)

    def through(one: Array, other: Array) -> Array:
        return jnp.einsum("iar,nir,ibr->niab", one, mobile, other)

    act = jnp.swapaxes(plant.actuator, 1, 2)
    coupled = jnp.sum(through(plant.enter, plant.leave), axis=1)
    at = (slice(None), None, None)
    stiffness = s2[at] * plant.mass + s[at] * plant.damping + plant.stiffness
    compliance = _inverse(stiffness - (s2 * s2)[at] * coupled)
    entering = s2[at] * _side_by_side(through(plant.enter, act))  # (I, 3, 3 K)

    def outputs(rows: Array, direct: Array, gain: Array) -> tuple[Array, Array]:
        """By commands and by forces, for outputs that are rows over the modes."""
        leaving = s2[at] * _stacked(through(rows, plant.leave)) @ compliance  # (I, 3 m, 3)
        own = _block_diagonal(through(rows, act) + direct)
        by_force = leaving @ (plant.slide.T + 0j)
        return (gain * driven)[at] * (own + leaving @ entering), -(gain * held)[at] * by_force

    sensed, disturbed = outputs(plant.sensor, plant.direct, seen)
    return Images(sensed, disturbed, *outputs(plant.deflection, jnp.zeros(()), jnp.ones_like(s)))


def _inverse(matrix: Array) -> Array:
    """Of matrices (..., n, n), n = 2 or 3."""
    if matrix.shape[-1] == 2:
        (a, b), (c, d) = ((matrix[..., i, j] for j in range(2)) for i in range(2))
        turned = jnp.stack([jnp.stack([d, -b], axis=-1), jnp.stack([-c, a], axis=-1)], axis=-2)
        return turned / (a * d - b * c)[..., None, None]
    rows = [matrix[..., k, :] for k in range(3)]
    columns = [jnp.cross(rows[k - 2], rows[k - 1]) for k in range(3)]
    determinant = jnp.sum(rows[0] * columns[0], axis=-1)
    return jnp.stack(columns, axis=-1) / determinant[..., None, None]


def _stacked(blocks: Array) -> Array:
    """Blocks of the links above each other, (..., 3, m, p) to (..., 3 m, p)."""
    return jnp.reshape(blocks, (*blocks.shape[:-3], -1, blocks.shape[-1]))


def _side_by_side(blocks: Array) -> Array:
    """(..., 3, p, m) to (..., p, 3 m)."""
    moved = jnp.swapaxes(blocks, -3, -2)
    return jnp.reshape(moved, (*moved.shape[:-2], -1))


def _block_diagonal(blocks: Array) -> Array:
    """(..., G, m, p) to (..., G m, G p)."""
    groups, m, p = blocks.shape[-3:]
    whole = blocks[..., :, :, None, :] * np.eye(groups)[:, None, :, None]
    return jnp.reshape(whole, (*blocks.shape[:-3], groups * m, groups * p))


# --- controller and loop --------------------------------------------------------------------------


def controller_response(controller: Controller, z: Array) -> Array:
    """K(z): commands [V] per sampled sensor voltage [V], complex, (3 K, 3 K).

    Where channels of a law act one at a time, all act. Compensation of the feed-through D, of
    which the controller subtracts the part of its own last command, is inside:
    K = (I + F D/z)^-1 F, F the feedback.

    Args:
        controller: coefficients.
        z: e^(j omega T), ().
    """
    feedback, through = controller.feedback, controller.feedthrough
    notch = controller.notch
    passed = jnp.ones(len(through)) if notch is None else notch_response(notch, z)
    if isinstance(feedback, Channels):
        rate, value = responses(feedback.estimator, z)
        force = feedback.velocity_gain * rate
        if feedback.position_gain is not None:
            force = force + feedback.position_gain * value
        blocks = -jnp.einsum("ikc,ic,icl->ikl", feedback.synthesizer, force, feedback.filter)
    else:
        eye = np.eye(feedback.state.shape[-1])
        state = jnp.linalg.solve(z * eye - feedback.state, feedback.enter + 0j)
        blocks = jnp.einsum("gmnb,gnbk->gmk", feedback.leave + 0j, state) + feedback.direct
        if len(blocks) == 1:
            through = _block_diagonal(through)[None]
    of_sensors = jnp.reshape(jnp.repeat(passed, controller.feedthrough.shape[1]), (len(blocks), -1))
    blocks = blocks * of_sensors[:, None]
    eye = np.eye(blocks.shape[-1])
    return _block_diagonal(jnp.linalg.solve(eye + blocks @ (through / z), blocks))


class SampledLoopResponse(NamedTuple):
    """A sampled loop in the frequency domain."""

    plant: PlantResponse
    controller: Controller


def response_of_loop(
    structure: Structure, case: Case, loop: Loop, pose: Array
) -> SampledLoopResponse:
    """The loop of a prepared case; arguments as for `plant_response`."""
    return SampledLoopResponse(plant_response(structure, case, loop, pose), loop.controller)


def command_gain(response: SampledLoopResponse, omega: Array, delay: Array | None = None) -> Array:
    """L(e^(j omega T)) = -K P where the commands are: I + L is the return difference, (3 K, 3 K).

    P has the hold, computing delay, amplifier, links and pose, patches, anti-alias
    filter and sampler.

    Args:
        response: of the loop.
        omega: above 0 and up to pi/T [rad/s], ().
        delay: more delay [samples], (); None: none.
    """
    plant, order = response.plant, np.arange(-IMAGES, IMAGES + 1)
    late = plant.late if delay is None else plant.late + delay
    turned = image_weights(late) * jnp.exp(-1j * omega * plant.period * late)
    sensed = jnp.einsum("n,nab->ab", turned, plant_images(plant, omega, order).sensed)
    return -controller_response(response.controller, jnp.exp(1j * omega * plant.period)) @ sensed


class ClosedLoop(NamedTuple):
    """Responses of the closed loop, complex."""

    sensitivity: Array  # S = (I + L)^-1 of the commands [1], (3 K, 3 K)
    control_effort: Array  # commands per disturbance of the sensor voltages, S K [1], (3 K, 3 K)
    disturbance_deflection: (
        Array  # chord deflections per force on an actuated joint [m/N], (3 S, 3)
    )


def close_loop(response: SampledLoopResponse, omega: Array, is_exact: bool = True) -> ClosedLoop:
    """Responses of the closed loop; forces are held over a sample, deflections sampled.

    Args:
        response: of the loop.
        omega: above 0 and up to pi/T [rad/s], ().
        is_exact: all images; otherwise `FEW`, for searches.
    """
    plant = response.plant
    most = IMAGES if is_exact else FEW
    order = np.arange(-most, most + 1)
    images = plant_images(plant, omega, order)
    z = jnp.exp(1j * omega * plant.period)

    def sampled(parts: Array, delay: Array) -> Array:
        turned = image_weights(delay) if is_exact else jnp.exp(-2j * np.pi * delay * order)
        return jnp.einsum("n,nab->ab", turned * z**-delay, parts)

    now, late = jnp.zeros(()), plant.late
    gain = controller_response(response.controller, z)
    sensitivity = jnp.linalg.inv(np.eye(len(gain)) - gain @ sampled(images.sensed, late))
    effort = sensitivity @ gain
    # modes that are left out bend at once with the voltage on the actuators
    bent = sampled(images.bent, late) + _present(plant, z) * _block_diagonal(
        plant.direct_deflection
    )
    deflection = sampled(images.pushed, now) + bent @ effort @ sampled(images.disturbed, now)
    return ClosedLoop(sensitivity, effort, deflection)


def _present(plant: PlantResponse, z: Array) -> Array:
    """Voltage on an actuator at a sampling instant per command [1], complex, ()."""
    change = command_change(plant.late)
    order = np.arange(LONGEST + 1)
    before, after = (jnp.sum(x * z**-order) for x in (change.before, change.after))
    if plant.lag is None:
        return jnp.where(change.share > 0, before, after)
    left = jnp.exp(-plant.period / jnp.maximum(plant.lag, plant.period / FASTEST))
    kept = left ** (1 - change.share)  # of what the first command had reached
    return ((kept - left) * before + (1 - kept) * after) / (z - left)
