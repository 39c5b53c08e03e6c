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
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.axial import axial_force, chord_slopes, held_coordinates
from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.controller import Controller
from jaxmodel.delay import LONGEST, command_change, true_delay
from jaxmodel.drive import late_response
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.dynamics import mass_matrix, platform_mass
from jaxmodel.electronics import FASTEST
from jaxmodel.estimator import responses
from jaxmodel.kinematics import Bend, Chain, close_chain
from jaxmodel.lazy import jax, jnp
from jaxmodel.loop import Loop
from jaxmodel.notch import notch_response
from jaxmodel.parameters import Array, Complex, Num
from jaxmodel.plant import Plant

#: Images on either side that are evaluated, and those of them from which the rest is extrapolated.
IMAGES, ANCHORS = 12, (12, 10, 8)
#: Images on either side that make a response good to 1e-4, for searches.
FEW = 2
#: Images beyond `IMAGES` whose power law is summed term by term.
_SUMMED = 500


class PlantResponse(NamedTuple):
    """The machine about rest, in normal coordinates of each link (modal masses 1).

    P ports of a link: the pose, and its elongation if links lengthen. They move its modes by two
    motions: that of its chord's angle, and that of its near joint across it.
    """

    mass: Num[Array, "pose pose"]  # of the pose with straight links
    damping: Num[Array, "pose pose"]  # of the drive in the pose
    stiffness: Num[Array, "pose pose"]
    # mass [kg], damping [N s/m] and stiffness [N/m] between a link's elongation and (pose,
    # elongation); None: links keep their length, and ports are those of the pose
    longer: tuple[Num[Array, "links pose+1"], ...] | None
    square: Num[Array, "links R"]  # omega^2 of the modes of a link with held ends [1/s2]
    decay: Num[Array, "links R"]  # 2 zeta omega [1/s]
    port: Num[Array, "links 2 P"]  # these two per motion of each port [rad/m and 1]
    enter: Num[Array, "links 2 R"]  # generalised force on the two per modal acceleration
    leave: Num[Array, "links 2 R"]  # inertia force on a mode per acceleration of the two
    push: Num[Array, "links K"]  # force on an elongation per actuator volt [N/V]; None likewise
    read: Num[Array, "links K"]  # sensor volts per elongation [V/m]; None likewise
    sensor: Num[Array, "links K R"]  # sensor volts per modal coordinate
    actuator: Num[Array, "links R K"]  # modal force per actuator volt
    direct: Num[Array, "links K K"]  # sensor volts per actuator volt by modes that are left out
    deflection: Num[Array, "links S R"]  # from the chord at the stations per modal coordinate
    # the same per actuator volt by modes that are left out
    direct_deflection: Num[Array, "links S K"]
    slide: Num[Array, "links P"]  # of the actuated joints per motion of the pose
    # of motors that follow late: position and rate gains of their drives [N/m] and [N s/m],
    # which damping and stiffness have as if they did not, and lag [s]; None: they do not
    servo: tuple[Num[Array, "links"], Num[Array, "links"], Num[Array, ""]] | None
    period: Num[Array, ""]  # T [s]
    antialias: Num[Array, ""]  # [rad/s]
    highpass: Num[Array, ""] | None  # of the patches [rad/s], None if there is none
    lag: Num[Array, ""] | None  # of the amplifiers [s], None if there are none
    delay: Num[Array, ""] | None  # from sample to command [samples], None: one

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
    still, n = jnp.zeros_like(pose), len(pose)
    axial, longer = None, plant.stretch
    if structure.has_wrench:
        axial = axial_force(plant, pose, still, still, case.load.wrench)
    rest = pose
    if longer is not None:
        held = jnp.zeros_like(longer) if axial is None else held_coordinates(plant, axial)[:, -1]
        rest = jnp.concatenate([pose, longer * held])

    def moving(at: Array, rate: Array) -> Chain:
        """The chain of straight links for (pose, elongations)."""
        bend = None if longer is None else Bend(shortening=-at[n:], shortening_rate=-rate[n:])
        return close_chain(plant, at[:n], rate[:n], bend)

    def rates(rate: Array) -> tuple[Array, Array]:
        chain = moving(rest, rate)
        return chain.rho_rate, chain.beta_rate

    chain = moving(rest, 0 * rest)
    to_rho, to_beta = (_ports(x, n) for x in jax.jacfwd(rates)(0 * rest))  # (3 links, P)
    platform = mass_matrix(platform_mass(plant, chain.turn))
    swing = -plant.tip_mass * chain.chord * chain.sine
    terms = [
        (plant.slider_link_mass, to_rho, to_rho),
        (plant.inertia, to_beta, to_beta),
        (swing, to_rho, to_beta),
        (swing, to_beta, to_rho),
    ]
    gains = drive_gains(DRIVES[structure.drive], drive)
    slope = gains.rate + drive.viscous_friction
    if structure.has_friction:
        slope = slope + drive.coulomb_friction / drive.friction_speed
    damping, stiffness = _by_ports(slope, to_rho, to_rho), _by_ports(gains.position, to_rho, to_rho)
    if axial is not None:
        held = jnp.linalg.solve(to_rho[:, :n].T, -case.load.wrench)
        curved = jax.jacfwd(jax.jacrev(lambda x: held * moving(x, 0 * x).rho))(rest)
        by_row = jnp.swapaxes(_ports(jnp.swapaxes(curved, 1, 2), n), 1, 2)
        stiffness = stiffness - _ports(by_row, n)
    modal_mass = plant.modal_mass[:, None]
    if longer is not None:
        own = jnp.zeros_like(to_rho).at[:, n].set(1.0)
        slid = plant.tip_mass * chain.cosine
        terms += [
            (plant.modal_mass / longer**2, own, own),
            (slid, own, to_rho),
            (slid, to_rho, own),
        ]
        damping = damping + _by_ports(plant.damping[:, -1] / longer**2, own, own)
        stiffness = stiffness + _by_ports(plant.stiffness[:, -1] / longer**2, own, own)
        parts = {x: getattr(plant, x)[:, :-1] for x in ("stiffness", "damping", "b", "c")}
        plant = plant._replace(stretch=None, **parts)
    mass = sum(_by_ports(*term) for term in terms)
    at_c, at_b, inertia = _from_chord(plant)
    leave = jnp.stack([at_c, -at_b], axis=1)
    springs = None if axial is None else axial[:, None, None] * chord_slopes(plant)
    square, modes = _normal_modes(plant, inertia, springs)
    leave = leave / modal_mass[:, None]
    decay = plant.damping / modal_mass
    count = decay.shape[1]
    sensor, deflection = loop.sensor[..., :count], loop.deflection_at[..., :count]
    actuator = loop.actuator[:, :count]
    if modes is not None:
        leave, sensor, deflection = (
            jnp.einsum("ipr,irs->ips", x, modes) for x in (leave, sensor, deflection)
        )
        actuator = jnp.einsum("irk,irs->isk", actuator, modes)
        decay = jnp.einsum("irs,ir,irs->is", modes, decay, modes)
    enter = leave * modal_mass[:, None]
    if not structure.is_coupled:
        enter = jnp.zeros_like(enter)
    left_out, n_patches = loop.left_out, structure.n_patches
    shape = (len(deflection), deflection.shape[1], n_patches)
    direct = jnp.zeros((len(deflection), n_patches, n_patches), mass.dtype)
    whole = (mass, damping, stiffness)
    return PlantResponse(
        mass=platform + jnp.sum(mass[:, :n, :n], axis=0),
        damping=jnp.sum(damping[:, :n, :n], axis=0),
        stiffness=jnp.sum(stiffness[:, :n, :n], axis=0),
        longer=None if longer is None else tuple(x[:, n] for x in whole),
        square=square,
        decay=decay,
        port=jnp.stack([to_beta, chain.sine[:, None] * to_rho], axis=1),
        enter=enter,
        leave=leave,
        push=None if longer is None else loop.actuator[:, -1] * modal_mass / longer[:, None],
        read=None if longer is None else loop.sensor[..., -1] / longer[:, None],
        sensor=sensor,
        actuator=actuator,
        direct=direct if left_out is None else left_out.sensor,
        deflection=deflection,
        direct_deflection=jnp.zeros(shape, mass.dtype) if left_out is None else left_out.deflection,
        slide=to_rho,
        servo=(*gains, drive.lag) if structure.has_drive_lag else None,
        period=jnp.asarray(electronics.period),
        antialias=jnp.asarray(electronics.antialias),
        highpass=electronics.sensor_highpass if structure.has_sensor_highpass else None,
        lag=electronics.amplifier_lag if structure.has_amplifier else None,
        delay=true_delay(electronics) if structure.has_delay else None,
    )


def _ports(x: Array, n: int) -> Array:
    """Of each link (first axis) the entries of the pose and of its own elongation, (3, ., P)."""
    if x.shape[-1] == n:
        return x
    own = jnp.stack([x[i, ..., n + i] for i in range(len(x))])
    return jnp.concatenate([x[..., :n], own[..., None]], axis=-1)


def _by_ports(weight: Array, one: Array, other: Array) -> Array:
    """weight one other' of each link, (3, P, P)."""
    return weight[:, None, None] * one[:, :, None] * other[:, None]


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


def _normal_modes(
    plant: Plant, inertia: Array | None, springs: Array | None
) -> tuple[Array, Array | None]:
    """Modes of (modal inertia, stiffness with `springs` of axial forces [N/m], (3, R, R)).

    Returns:
        omega^2 of each link between held ends [1/s2], (3, R), and shapes in modal coordinates, of
        modal mass m, (3, R, R); None: themselves.
    """
    mass = plant.modal_mass[:, None]
    if inertia is None and (springs is None or plant.mixed_shortening is None):
        diagonal = 0.0 if springs is None else jnp.einsum("irr->ir", springs)
        return (plant.stiffness + diagonal) / mass, None
    eye = jnp.eye(plant.stiffness.shape[1])
    stiffness = plant.stiffness[:, :, None] * eye + (0.0 if springs is None else springs)
    if inertia is None:
        return tuple(jnp.linalg.eigh(stiffness / mass[:, None]))
    half = jnp.linalg.inv(jnp.linalg.cholesky(inertia / mass[:, None]))
    square, shape = jnp.linalg.eigh(
        jnp.einsum("ijr,irs,iks->ijk", half, stiffness / mass[:, None], half)
    )
    return square, jnp.einsum("ikr,iks->irs", half, shape)


def late_stiffness(plant: Any, s: Array) -> Array:
    """Dynamic stiffness of the ports by motors that follow late, less that of prompt ones.

    Args:
        plant: a `PlantResponse` with `servo`; leaves may have leading axes.
        s: [1/s], (.., N).

    Returns:
        (.., 3, N, P, P).
    """
    (position, rate, lag), slide = plant.servo, plant.slide
    gap = late_response(s, lag[..., None]) - 1
    force = (position[..., None] + rate[..., None] * s[..., None, :]) * gap[..., None, :]
    return force[..., None, None] * (slide[..., None, :, None] * slide[..., None, None, :])


class Assembled(NamedTuple):
    """The rigid part of a machine: p coordinates, the pose and then the links' elongations."""

    mass: Num[Array, "p p"]
    damping: Num[Array, "p p"]
    stiffness: Num[Array, "p p"]
    enter: Num[Array, "links p R"]  # generalised force on them per modal acceleration
    leave: Num[Array, "links p R"]  # inertia force on a mode per acceleration of them


def assembled(plant: Any, xp: Any = jnp) -> Assembled:
    """Its matrices with all elongations at once.

    Args:
        plant: a `PlantResponse`, or what has its fields of the same names.
        xp: NumPy or `jax.numpy`.
    """
    own = plant.mass, plant.damping, plant.stiffness
    modes = [xp.swapaxes(plant.port, 1, 2) @ x for x in (plant.enter, plant.leave)]
    if plant.longer is None:
        return Assembled(*own, *modes)
    links, n = len(plant.square), len(plant.mass)
    place = np.zeros((links, n + 1, n + links))
    place[:, :n, :n], place[np.arange(links), n, n + np.arange(links)] = np.eye(n), 1.0
    whole = []
    for pose, row in zip(own, plant.longer, strict=True):
        side = xp.concatenate([row[:, :n].T, xp.diag(row[:, n])])
        whole.append(xp.concatenate([xp.concatenate([pose, row[:, :n]]), side], axis=1))
    return Assembled(*whole, *(xp.swapaxes(xp.swapaxes(x, 1, 2) @ place, 1, 2) for x in modes))


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
    """Responses at s_n before they are summed."""

    sensed: Complex[Array, "I links*K links*K"]  # sensor volts per held command [V/V]
    # sensor volts per held force on an actuated joint [V/N]
    disturbed: Complex[Array, "I links*K links"]
    # chord deflections by the plant's modes per held command [m/V]
    bent: Complex[Array, "I links*S links*K"]
    pushed: Complex[Array, "I links*S links"]  # the same per held force on an actuated joint [m/N]


def plant_images(plant: PlantResponse, omega: Array, order: np.ndarray) -> Images:
    """Responses of the plant at s_n, without any delay.

    A mode moves by q = (a u - s^2 l X)/(s^2 + 2 zeta omega s + omega^2), the ports by
    Z X = p u + J' F - s^2 sum e q with their dynamic stiffness Z; elongations are eliminated.

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
    at, each, n = (slice(None), None, None), (slice(None), None, None, None), len(plant.mass)
    onto, port = jnp.swapaxes(plant.port, 1, 2), plant.port
    taken = (s2 * s2)[each] * (onto @ through(plant.enter, plant.leave) @ port)  # (I, 3, P, P)
    if plant.servo is not None:
        taken = taken - jnp.swapaxes(late_stiffness(plant, s), 0, 1)
    entering = s2[each] * (onto @ through(plant.enter, act))  # (I, 3, P, K)
    stiffness = s2[at] * plant.mass + s[at] * plant.damping + plant.stiffness
    stiffness = stiffness - jnp.sum(taken[:, :, :n, :n], axis=1)
    force, long = jnp.broadcast_to(plant.slide[:, :n], (*taken.shape[:2], n)), None
    if plant.longer is not None:  # elongations follow the pose and their own forces
        mass, damping, spring = plant.longer
        row = s2[at] * mass + s[at] * damping + spring - taken[:, :, n]
        share, soft = row[..., :n] / row[..., n:], 1 / row[..., n]
        stiffness = stiffness - jnp.einsum("nip,niq->npq", share, row[..., :n])
        pushed = entering[:, :, n] - plant.push  # (I, 3, K)
        entering = entering[:, :, :n] - share[..., None] * pushed[:, :, None]
        force = force - share * plant.slide[:, n:]
        long = share, soft[..., None, None] * pushed[:, :, None], soft * plant.slide[:, n]
    compliance = _inverse(stiffness)
    entering, force = _side_by_side(entering), jnp.swapaxes(force, 1, 2)

    def outputs(rows: Array, direct: Array, read: Array | None, gain: Array) -> tuple[Array, Array]:
        """By commands and by forces, for outputs that are rows over the modes."""
        leaving = s2[each] * (through(rows, plant.leave) @ port)  # (I, 3, m, P)
        own, by_force = through(rows, act) + direct, 0.0
        if long is not None:
            share, by_voltage, by_joint = long
            seen = leaving[..., n:] - (0.0 if read is None else read[..., None])
            own = own + seen * by_voltage
            by_force = _block_diagonal(seen * by_joint[..., None, None])
            leaving = leaving[..., :n] - seen * share[:, :, None]
        leaving = _stacked(leaving) @ compliance  # (I, 3 m, p)
        by_force = leaving @ force + by_force
        by_command = _block_diagonal(own) + leaving @ entering
        return (gain * driven)[at] * by_command, -(gain * held)[at] * by_force

    sensed, disturbed = outputs(plant.sensor, plant.direct, plant.read, seen)
    bent, pushed = outputs(plant.deflection, jnp.zeros(()), None, jnp.ones_like(s))
    return Images(sensed, disturbed, bent, pushed)


def _inverse(matrix: Array) -> Array:
    """Of matrices (..., n, n), n = 2 or 3."""
    if matrix.shape[-1] == 2:
        a, b, c, d = (matrix[..., i, j] for i in range(2) for j in range(2))
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


def command_gain(
    response: SampledLoopResponse, omega: Array, delay: Array | None = None, is_exact: bool = True
) -> Array:
    """L(e^(j omega T)) = -K P where the commands are: I + L is the return difference, (3 K, 3 K).

    P has the hold, computing delay, amplifier, links and pose, patches, anti-alias
    filter and sampler.

    Args:
        response: of the loop.
        omega: above 0 and up to pi/T [rad/s], ().
        delay: more delay [samples], (); None: none.
        is_exact: all images; otherwise `FEW`, for searches.
    """
    plant = response.plant
    late = plant.late if delay is None else plant.late + delay
    images = plant_images(plant, omega, _orders(is_exact))
    sensed = jnp.einsum("n,nab->ab", _turns(plant, omega, late, is_exact), images.sensed)
    return -controller_response(response.controller, jnp.exp(1j * omega * plant.period)) @ sensed


def _orders(is_exact: bool) -> np.ndarray:
    """Numbers of the images that are evaluated, (I,)."""
    most = IMAGES if is_exact else FEW
    return np.arange(-most, most + 1)


def _turns(plant: PlantResponse, omega: Array, delay: Array, is_exact: bool) -> Array:
    """Weights of these images behind a delay [samples], (I,)."""
    order = _orders(is_exact)
    turned = image_weights(delay) if is_exact else jnp.exp(-2j * np.pi * delay * order)
    return turned * jnp.exp(-1j * omega * plant.period * delay)


class ClosedLoop(NamedTuple):
    """Responses of the closed loop."""

    sensitivity: Complex[Array, "links*K links*K"]  # S = (I + L)^-1 of the commands [1]
    # commands per disturbance of the sensor voltages, S K [1]
    control_effort: Complex[Array, "links*K links*K"]
    # chord deflections per force on an actuated joint [m/N]
    disturbance_deflection: Complex[Array, "links*S links"]


def close_loop(response: SampledLoopResponse, omega: Array, is_exact: bool = True) -> ClosedLoop:
    """Responses of the closed loop; forces are held over a sample, deflections sampled.

    Args:
        response: of the loop.
        omega: above 0 and up to pi/T [rad/s], ().
        is_exact: all images; otherwise `FEW`, for searches.
    """
    plant = response.plant
    images = plant_images(plant, omega, _orders(is_exact))
    z = jnp.exp(1j * omega * plant.period)

    def sampled(parts: Array, delay: Array) -> Array:
        return jnp.einsum("n,nab->ab", _turns(plant, omega, delay, is_exact), parts)

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
