"""Return difference of the sampled loop: det(I - k L(s)) without any large matrix.

L(s) takes the forces of the controller's channels once round the loop: hold, amplifier, links and
pose, patches, filters, controller. A sampler sees the sum of the plant's responses at
s + 2 pi j n/T. Links couple only through the pose, so each response is a sum over the modes of each
link and a system of three equations for the pose, and det(x - L) follows link by link and then
from 3x3 matrices. docs/theory.md, "Gain margins of a batch". Shapes: structure first, lanes last.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.delay import true_delay
from jaxmodel.estimator import Estimator
from jaxmodel.lazy import jax, jnp
from jaxmodel.loop import Loop
from jaxmodel.notch import Notch
from jaxmodel.pairs import Pair, determinant, product
from jaxmodel.parameters import Array, Num
from jaxmodel.sampled_response import Assembled, PlantResponse, assembled, plant_response
from jaxmodel.trigonometry import sine_cosine

#: Images n of the spectrum that are summed; those left out change the sum by 1e-4.
IMAGES = (0, -1, 1, -2)
#: Images of which only what is direct counts.
FAR = (2, -3, 3, -4, 4, -5, 5)
#: Modes are taken to be at least as wide as this share of their frequency [1].
NARROWEST = 1e-6


class Lateness(NamedTuple):
    """Delay of the commands beyond one sample."""

    time: Num[Array, ""]  # tau [s]
    images: Pair  # exp(-j 2 pi n tau/T) of `IMAGES` and `FAR`


class LoopResponse(NamedTuple):
    """One loop about rest, in normal coordinates of each link (modal masses 1).

    The first n links have channels: all three, or those under control, see `controlled_first`.
    """

    mass: Num[Array, "pose pose"]  # of the pose with straight links
    damping: Num[Array, "pose pose"]  # of the drive in the pose
    stiffness: Num[Array, "pose pose"]
    square: Num[Array, "links R"]  # omega^2 of the modes of a link with held ends [1/s2]
    decay: Num[Array, "links R"]  # 2 zeta omega [1/s]
    lightness: Num[Array, "links R"]  # inertia left to a mode that drags only the pose's mass [1]
    # of elongations, the ports and the two motions by which they move modes: see `PlantResponse`
    longer: tuple[Num[Array, "links pose+1"], ...] | None
    heavy: Num[Array, "links"] | None  # mass that an elongation feels above all frequencies [kg]
    port: Num[Array, "links 2 P"]
    enter: Num[Array, "links 2 R"]
    leave: Num[Array, "links 2 R"]
    push: Num[Array, "n C"]  # force on an elongation per channel force; None without elongations
    read: Num[Array, "n C"]  # channels per elongation; None likewise
    observe: Num[Array, "n C R"]  # channels per modal coordinate
    act: Num[Array, "n C R"]  # on the modes per channel force
    direct: Num[Array, "n C C"]  # by modes that are left out, channels per channel force
    feedthrough: Num[Array, "n C C"]  # compensated, the same way
    estimator: Estimator
    velocity_gain: Num[Array, "n C"]
    position_gain: Num[Array, "n C"] | None
    period: Num[Array, ""]  # T [s]
    antialias: Num[Array, ""]  # [rad/s]
    highpass: Num[Array, ""] | None  # of the patches [rad/s], None if there is none
    lag: Num[Array, ""] | None  # of the amplifiers [s], None if there are none
    late: Lateness | None = None  # None: the delay is one sample
    notch: Notch | None = None  # of the links with channels, (n, 1) each


def loop_response(structure: Structure, case: Case, loop: Loop, pose: Array) -> LoopResponse:
    """Collect what the return difference reads; a sampled drive acts by its `drive_gains`.

    Args:
        structure: static choices with feedback "sampled".
        case: the numbers.
        loop: of the case, from `prepare`.
        pose: where to linearise, at rest under the steady load [m, m, rad], (3,).

    Returns:
        LoopResponse.
    """
    law, through = loop.controller.feedback, loop.controller.feedthrough
    assert isinstance(law, Channels)
    plant = plant_response(structure, case, loop, pose)
    whole = assembled(plant)
    light = jnp.linalg.inv(whole.mass)
    drag = jnp.einsum("ipr,pq,iqr->ir", whole.enter, light, whole.leave)
    longer = plant.longer
    return LoopResponse(
        mass=plant.mass,
        damping=plant.damping,
        stiffness=plant.stiffness,
        square=plant.square,
        decay=plant.decay,
        lightness=1 - drag,
        longer=longer,
        heavy=None if longer is None else 1 / jnp.diagonal(light)[len(plant.mass) :],
        port=plant.port,
        enter=plant.enter,
        leave=plant.leave,
        push=None if longer is None else jnp.einsum("ik,ikc->ic", plant.push, law.synthesizer),
        read=None if longer is None else jnp.einsum("ick,ik->ic", law.filter, plant.read),
        observe=jnp.einsum("ick,ikr->icr", law.filter, plant.sensor),
        act=jnp.einsum("irk,ikc->icr", plant.actuator, law.synthesizer),
        direct=jnp.einsum("ick,ikl,ild->icd", law.filter, plant.direct, law.synthesizer),
        feedthrough=jnp.einsum("ick,ikl,ild->icd", law.filter, through, law.synthesizer),
        estimator=law.estimator,
        velocity_gain=law.velocity_gain,
        position_gain=law.position_gain,
        period=plant.period,
        antialias=plant.antialias,
        highpass=plant.highpass,
        lag=plant.lag,
        late=_lateness(case) if structure.has_delay else None,
        notch=jax.tree.map(lambda x: x[:, None], loop.controller.notch),
    )


def _lateness(case: Case) -> Lateness:
    late = true_delay(case.electronics) - 1
    angle = 2 * np.pi * np.array(IMAGES + FAR) * late
    return Lateness(late * case.electronics.period, Pair(jnp.cos(angle), -jnp.sin(angle)))


def loop_strength(response: LoopResponse) -> Array:
    """Largest eigenvalue of L due to a mode of a link with held ends at its resonance, ().

    It covers the mode's own part of L, which has rank one, without spectral images and pose: a
    measure of size, not a bound.
    """
    n = response.observe.shape[0]
    square, decay = response.square[:n], response.decay[:n]
    omega = jnp.sqrt(jnp.maximum(square, 1.0))
    angle, zero = omega * response.period, jnp.zeros_like(omega)
    shift = Pair(jnp.cos(angle), -jnp.sin(angle))

    def force(cosine: Array, sine: Array) -> Pair:
        return _channel(response, Pair(cosine[:, None], sine[:, None]))

    channel = jax.vmap(force, in_axes=1, out_axes=2)(shift.re, shift.im)  # (n, C, R)
    s = Pair(zero, omega)
    passed = _electronics(response, s, s * s, -shift + 1.0)
    link_gain = jnp.abs(response.observe * response.act) * _size(channel)
    narrow = jnp.maximum(decay, NARROWEST * omega) * omega
    return jnp.max(jnp.sum(link_gain, axis=1) * _size(passed) / narrow)


def _size(x: Pair) -> Array:
    return jnp.hypot(x.re, x.im)


#: Fields of links, and those that only links with channels need.
_LINK_FIELDS = ("square", "decay", "lightness", "longer", "heavy", "port", "enter", "leave")
_CHANNEL_FIELDS = (
    "push",
    "read",
    "observe",
    "act",
    "direct",
    "feedthrough",
    "estimator",
    "velocity_gain",
    "position_gain",
    "notch",
)


def controlled_first(response: LoopResponse, link_mask: Array, count: int) -> LoopResponse:
    """The same loops with controlled links first and no channels on the others.

    Args:
        response: with channels on all links, lanes last.
        link_mask: above 0 for controlled links, (3, lanes).
        count: how many links keep channels, the largest number controlled in any lane (static).
    """
    order = jnp.argsort(link_mask <= 0, axis=0, stable=True)

    def moved(x: Array, most: int) -> Array:
        rows = order[:most].reshape(most, *(1,) * (x.ndim - 2), order.shape[1])
        return jnp.take_along_axis(x, rows, axis=0)

    parts = {
        name: jax.tree.map(partial(moved, most=most), getattr(response, name))
        for names, most in ((_LINK_FIELDS, len(link_mask)), (_CHANNEL_FIELDS, count))
        for name in names
    }
    return response._replace(**parts)


class AssembledModes(NamedTuple):
    """Modes of the uncontrolled machine, m = p + n R; damping to first order."""

    omega: Num[Array, "m"]  # ascending [rad/s]
    decay: Num[Array, "m"]  # zeta omega [1/s]
    share: Num[Array, "1+R m"]  # of kinetic energy in the pose, then in the links' modes by order
    growth: Num[Array, ""]  # growth rate of an unstable rest, 0: stable [1/s]
    shape: Num[Array, "n R m"]  # coordinates of the links' modes in each, of modal mass 1
    rigid: Num[Array, "p m"]  # pose, and elongations if links lengthen


def pose_coupling(whole: Assembled, xp: Any = jnp) -> Array:
    """Entries of the mass matrix between pose and links, G' of `assembled_modes`, (p, n R)."""

    def side_by_side(x: Array) -> Array:
        return xp.concatenate([x[i] for i in range(len(x))], axis=1)

    enter, leave = side_by_side(whole.enter), side_by_side(whole.leave)
    # entries of both have one sign; without coupling the pose does not feel the links at all
    return xp.sign(leave) * xp.sqrt(xp.maximum(enter * leave, 0.0))


def assembled_modes(response: LoopResponse | PlantResponse) -> AssembledModes:
    """Natural modes of pose and links: one symmetric eigenvalue problem.

    With modal masses 1 the mass matrix is (1 G'; G M) and its Cholesky factor (1 0; G C),
    C C' = M - G G', so that K reduces to (K_q, -K_q G'C'^-1; ., C^-1 (K_p + G K_q G') C'^-1).
    """
    whole = assembled(response)
    drag = pose_coupling(whole)
    factor = jnp.linalg.inv(jnp.linalg.cholesky(whole.mass - drag @ drag.T))

    def reduced(pose: Array, links: Array) -> Array:
        side = -(factor @ drag) * links
        pose = factor @ (pose + (drag * links) @ drag.T) @ factor.T
        return jnp.block([[pose, side], [side.T, jnp.diag(links)]])

    stiffness = reduced(whole.stiffness, jnp.ravel(response.square))
    damping = reduced(whole.damping, jnp.ravel(response.decay))
    square, shape = jnp.linalg.eigh(stiffness)
    n_links, n_modes = response.square.shape
    energy, pose = shape * shape, len(whole.mass)
    links = jnp.sum(jnp.reshape(energy[pose:], (n_links, n_modes, -1)), axis=0)
    rigid = factor.T @ shape[:pose]
    return AssembledModes(
        omega=jnp.sqrt(jnp.maximum(square, 0.0)),
        decay=jnp.sum(shape * (damping @ shape), axis=0) / 2,
        share=jnp.concatenate([jnp.sum(energy[:pose], axis=0)[None], links]),
        growth=jnp.sqrt(jnp.maximum(-square[0], 0.0)),
        shape=jnp.reshape(shape[pose:] - drag.T @ rigid, (n_links, n_modes, -1)),
        rigid=rigid,
    )


def mode_strength(response: LoopResponse, modes: AssembledModes) -> Array:
    """Largest eigenvalue of L due to each mode of the machine at its resonance, (m,).

    It covers the mode's own part of L, which has rank one, without the other images: a measure of
    size, not a bound.
    """
    n = response.observe.shape[0]
    omega = jnp.maximum(modes.omega, 1.0)
    shift = Pair(jnp.cos(omega * response.period), -jnp.sin(omega * response.period))
    channel = jax.vmap(lambda re, im: _channel(response, Pair(re, im)), out_axes=2)(
        shift.re, shift.im
    )  # (n, C, m)
    s = Pair(jnp.zeros_like(omega), omega)
    passed = _electronics(response, s, s * s, -shift + 1.0)
    seen, moved = (
        jnp.einsum("icr,irm->icm", x, modes.shape[:n]) for x in (response.observe, response.act)
    )
    if response.longer is not None:
        longer = modes.rigid[len(response.mass) :][:n, None]
        seen = seen + response.read[..., None] * longer
        moved = moved + response.push[..., None] * longer
    gain = jnp.sum(jnp.abs(seen * moved) * _size(channel), axis=(0, 1)) * _size(passed)
    return gain / (2 * omega * jnp.maximum(modes.decay, NARROWEST * omega))


class LoopGain(NamedTuple):
    """L at one s, in the form its determinants need; `characteristic_polynomial` reads it."""

    own: list[Pair]  # coefficients of det(x - L_i) of each link, highest power first, (n,) each
    joint: list[Pair]  # of entering adj(x - L_i) leaving, the same way, (n, 3, 3)
    pose: Pair  # dynamic stiffness of the pose including its links, (3, 3)
    pose_inverse: Pair  # 1/det of that, ()
    assembled: Pair  # det of the stiffness of pose and elongations, 0 at poles of the machine, ()


def evaluate_loop_gain(
    response: LoopResponse, s: Pair, shift: Pair, spread: Array | None = None
) -> LoopGain:
    """Evaluate L at s.

    Args:
        response: of the loop.
        s: [1/s], ().
        shift: exp(-s T), ().
        spread: subtracted from the diagonal of L, so that channels without gains have distinct
            eigenvalues [1], (n, C); None: nothing.
    """
    n, gains, shares = response.observe.shape[0], [], []
    late = None if response.late is None else delayed(s, response.late.time)
    stiff = Pair(jnp.ones_like(s.re), jnp.zeros_like(s.re))
    # kernels write them once
    link_gain, pose_share = jax.jit(_link_gain), jax.jit(_pose_alone)
    for i in range(response.square.shape[0]):
        link = _one_link(response, i, i < n)
        if i < n:
            apart = None if spread is None else spread[i : i + 1]
            *gain, share, soft = link_gain(link, s, shift, late, apart)
            gains.append(gain)
        else:
            share, soft = pose_share(link, s)
        shares.append(share)
        stiff = stiff if soft is None else stiff * soft[0].inverse()
    own, joint = jax.tree.map(lambda *x: jnp.concatenate(x), *gains)
    links = sum(shares[1:], start=shares[0])
    pose = s * s * response.mass + s * response.damping + response.stiffness - links
    whole = determinant(pose)
    return LoopGain(
        own=own, joint=joint, pose=pose, pose_inverse=whole.inverse(), assembled=whole * stiff
    )


def _one_link(response: LoopResponse, i: int, has_channels: bool) -> LoopResponse:
    """The part of one link, without what belongs to the pose."""
    one = slice(i, i + 1)
    fields = (*_LINK_FIELDS, *(_CHANNEL_FIELDS if has_channels else ()))
    parts = {x: jax.tree.map(lambda leaf: leaf[one], getattr(response, x)) for x in fields}
    return response._replace(mass=None, damping=None, stiffness=None, **parts)


def _link_gain(
    response: LoopResponse, s: Pair, shift: Pair, late: Pair | None, spread: Array | None
) -> tuple[list[Pair], list[Pair], Pair, Pair | None]:
    """`own` and `joint` of a link's `LoopGain`, and the first two of `_share_in_pose`."""
    observe, act = response.observe, response.act
    sampling = 2 * np.pi / response.period
    held = -shift + 1.0
    seen = None
    for k, image in enumerate(IMAGES + FAR):
        at = Pair(s.re, s.im + image * sampling)
        at2 = at * at
        chain = _electronics(response, at, at2, held)
        if late is not None and response.late is not None:
            chain = chain * (late * response.late.images[k])
        if image in FAR:
            seen = seen + chain * response.direct
            continue
        inertia = 1.0 if image == 0 else response.lightness
        inverse = (at2 * inertia + at * response.decay + response.square).inverse()
        own = _through(observe, act, inverse) + response.direct
        if image == 0:
            links, soft, leaving, entering, through = _at_ports(response, s, inverse)
            own, leaving = own if through is None else own + through, leaving * chain
        elif response.heavy is not None and response.longer is not None:
            _, decay, spring = (x[:, -1] for x in response.longer)
            free = (at2 * response.heavy + at * decay + spring).inverse()[:, None, None]
            own = own + free * (response.read[:, :, None] * response.push[:, None])
        seen = own * chain if seen is None else seen + own * chain
    channel = _channel(response, shift)[:, :, None]
    loop, leaving = (seen - response.feedthrough) * channel, leaving * channel
    if spread is not None:
        loop = _plus_diagonal(loop, Pair(-spread, jnp.zeros_like(spread)))
    return *_by_link(loop, leaving, entering), links, soft


def _at_ports(
    response: LoopResponse, s: Pair, inverse: Pair
) -> tuple[Pair, Pair | None, Pair, Pair, Pair | None]:
    """The first two of `_share_in_pose`; channels by pose, (n, C, p), forces on the pose by
    channels, (n, p, C), and channels by channels through an elongation, (n, C, C)."""
    s2 = s * s
    links, soft, share = _share_in_pose(response, s, inverse)
    leaving = _carried(_through(response.observe, response.leave, inverse) * s2, response.port)
    entering = _carried(
        _turned(_through(response.enter, response.act, inverse) * s2), response.port
    )
    entering = _turned(entering)
    if soft is None or share is None:
        return links, None, leaving, entering, None
    pushed, heard = entering[:, -1] - response.push, leaving[:, :, -1] - response.read
    entering = entering[:, :-1] - share[:, :, None] * pushed[:, None]
    leaving = leaving[:, :, :-1] - heard[:, :, None] * share[:, None]
    return links, soft, leaving, entering, heard[:, :, None] * (pushed * soft[:, None])[:, None]


def _pose_alone(response: LoopResponse, s: Pair) -> tuple[Pair, Pair | None]:
    """What a link without channels takes from the pose's stiffness, see `_share_in_pose`."""
    inverse = (s * s + s * response.decay + response.square).inverse()
    return _share_in_pose(response, s, inverse)[:2]


def _share_in_pose(
    response: LoopResponse, s: Pair, inverse: Pair
) -> tuple[Pair, Pair | None, Pair | None]:
    """What a link takes from the pose's stiffness, (p, p), its elongation eliminated.

    Returns:
        that; elongation per force on it, (n,); and per motion of the pose, sign reversed, (n, p).
    """
    s2, port = s * s, response.port
    taken = _carried(_through(response.enter, response.leave, inverse) * (s2 * s2), port)
    taken = _carried(_turned(taken), port)
    if response.longer is None:
        return taken.sum(0), None, None
    mass, damping, stiffness = response.longer
    row = s2 * mass + s * damping + stiffness - taken[:, -1]
    pose, soft = row[:, :-1], row[:, -1].inverse()
    share = pose * soft[:, None]
    taken = taken[:, :-1, :-1] + share[:, :, None] * pose[:, None]
    return taken.sum(0), soft, share


def _carried(x: Pair, port: Array) -> Pair:
    """x port, (n, A, 2) and (n, 2, P) to (n, A, P)."""
    return (x[:, :, :, None] * port[:, None]).sum(2)


def _turned(x: Pair) -> Pair:
    return Pair(jnp.swapaxes(x.re, 1, 2), jnp.swapaxes(x.im, 1, 2))


def _through(one: Array, other: Array, inverse: Pair) -> Pair:
    """sum over the modes of one_a other_b/own, (n, A, B)."""
    weighed = Pair(other * inverse.re[:, None], other * inverse.im[:, None])
    return Pair(
        jnp.sum(one[:, :, None] * weighed.re[:, None], axis=3),
        jnp.sum(one[:, :, None] * weighed.im[:, None], axis=3),
    )


def _electronics(response: LoopResponse, s: Pair, s2: Pair, held: Pair) -> Pair:
    """Hold, amplifier, high-pass of the patches and anti-alias filter at s, ()."""
    corner = response.antialias
    below = (s2 + s * (np.sqrt(2.0) * corner) + corner * corner) * (s * response.period)
    above = held * (corner * corner)
    if response.highpass is not None:
        below, above = below * (s + response.highpass), above * s
    if response.lag is not None:
        below = below * (s * response.lag + 1.0)
    return above * below.inverse()


#: exp of a number up to 40 by `delayed`: that of a 64th by its series.
_HALVINGS, _TERMS = 6, 14


def delayed(s: Pair, time: Array) -> Pair:
    """exp(-s tau) by elementwise arithmetic, ().

    Args:
        s: [1/s], ().
        time: tau [s], ().
    """
    decay, size = s.re * time * (-1 / 2**_HALVINGS), jnp.ones_like(s.re)
    for n in range(_TERMS, 0, -1):
        size = 1 + decay * size * (1 / n)
    for _ in range(_HALVINGS):
        size = size * size
    sine, cosine = sine_cosine(s.im * time)
    return Pair(size * cosine, -size * sine)


def _channel(response: LoopResponse, shift: Pair) -> Pair:
    """Force of each channel per channel signal, one sample later, (n, C)."""
    estimator, shift2 = response.estimator, shift * shift

    def section(c0: Array, c1: Array, c2: Array) -> Pair:
        return Pair(c0 + c1 * shift.re + c2 * shift2.re, c1 * shift.im + c2 * shift2.im)

    b0, b1, a1 = estimator.first
    zero = jnp.zeros_like(b0)
    above = section(*(response.velocity_gain * c for c in estimator.velocity))
    if response.position_gain is not None:
        above = above + section(*(response.position_gain * c for c in estimator.position))
    below = section(1 + zero, *estimator.denominator) * section(1 + zero, a1, zero)
    force = above * section(b0, b1, zero) * below.inverse()
    if response.position_gain is not None:
        force = force + response.position_gain * estimator.direct
    if response.notch is not None:
        b0, b1, b2, a1, a2 = response.notch
        force = force * (section(b0, b1, b2) * section(1 + 0 * a1, a1, a2).inverse())
    return -(force * shift)


def _by_link(loop: Pair, leaving: Pair, entering: Pair) -> tuple[list[Pair], list[Pair]]:
    """det(x - L_i) and entering adj(x - L_i) leaving as polynomials in x (Faddeev, LeVerrier).

    With M_1 = I, c_0 = 1: c_j = -tr(L M_j)/j, M_(j+1) = L M_j + c_j I, det = sum c_j x^(n-j) and
    adj = sum M_(j+1) x^(n-1-j).
    """
    n = loop.re.shape[1]
    trace = sum((loop[:, i, i] for i in range(1, n)), start=loop[:, 0, 0])
    own, joint, power = [-trace], [product(entering, leaving)], loop
    for j in range(1, n):
        power = _plus_diagonal(power, own[-1][:, None])
        joint.append(product(entering, product(power, leaving)))
        power = product(loop, power)
        trace = sum((power[:, i, i] for i in range(1, n)), start=power[:, 0, 0])
        own.append(trace * (-1 / (j + 1)))
    return own, joint


def _plus_diagonal(matrix: Pair, value: Pair) -> Pair:
    """Add to the diagonals of (i, n, n); value (i, n), or (i, 1)."""
    n = matrix.re.shape[1]
    eye = np.eye(n).reshape(1, n, n, *(1,) * (matrix.re.ndim - 3))
    return Pair(matrix.re + eye * value.re[:, None], matrix.im + eye * value.im[:, None])


def characteristic_polynomial(loop_gain: LoopGain, x: Pair) -> Pair:
    """det(x - L), whose zeros are the eigenvalues of L, (); the highest power has factor 1.

    Args:
        loop_gain: L at some s.
        x: [1], ().
    """
    own, joint = x + loop_gain.own[0], loop_gain.joint[0]
    for constant, matrix in zip(loop_gain.own[1:], loop_gain.joint[1:], strict=True):
        own, joint = own * x + constant, joint * x + matrix
    pose = loop_gain.pose - (joint * own.inverse()[:, None, None]).sum(0)
    value = determinant(pose) * loop_gain.pose_inverse
    for link in range(own.re.shape[0]):
        value = value * own[link]
    return value
