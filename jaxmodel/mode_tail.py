"""Bounds in closed form of all that a sampled loop's model leaves out: high modes, far images.

A sampler sees the plant's responses at omega + 2 pi n/T, each weighed by hold and anti-alias
filter. The modes from a base number on, any number of them, answer there by a remainder beyond
their static compliance; its largest size follows from the slopes of sines (at most j pi/L at an
end of a patch), from modal compliances falling as 1/j^4, from the damping (1/(2 zeta) at
resonance, wherever an image meets it), and from the coupling with the pose (b_j, c_j ~ 1/j). Links
that lengthen push on the rigid part at once, which follows as 1/omega^2 at far images. In the
spirit of Selivanov and Fridman (2025), who treat a continuous loop of a PDE, here for a sampled
loop of several channels. docs/theory.md, "All modes".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.modal_loop import ModalLoop
from jaxmodel.parameters import Array, Num

#: Bands of width 2 pi/T, one per image, that are bounded one by one.
BANDS = 60
#: Slices of the base band, in which few modes are resonant at a time.
SLICES = 64
#: Images in which they are told apart.
FINE = 8
#: Part of image 0 beyond pi/T that is covered too, as a share of 2 pi/T.
OVERLAP = 0.05


class Tail(NamedTuple):
    """Sizes that the responses left out do not exceed; U = 3 K voltages in, sensors out.

    Coupling with the rigid part of p coordinates, here "the pose" in short, is per nu^2,
    nu = omega/sqrt(E), and for coordinates times E.
    """

    # from command to sampled voltage, times E, chain included, by slices of omega, at image 0 what
    # modes answer at once
    images: Num[Array, "slices U U"]
    # the rest at image 0, chain excluded: sensors from pose, about half the static answer
    # of known modes, so that any number of them is as near
    sensor_by_pose: Num[Array, "U p"]
    pose_by_voltage: Num[Array, "p U"]  # force on the pose from voltage
    pose_by_pose: Num[Array, "p p"]  # from pose, per nu^4


class _Sizes(NamedTuple):
    """Moduli of couplings, links and modes first; pose in coordinates of unit mass, largest E."""

    sense: Num[Array, "links R K"]  # sensors per modal coordinate
    pull: Num[Array, "links R K"]  # static answer to voltages, |actuator|/omega^2
    enter: Num[Array, "links R"]
    leave: Num[Array, "links R"]
    push: Num[Array, "U"]  # force on the pose by voltages at once, times E
    read: Num[Array, "U"]  # sensors by the pose at once
    spring: float  # pose stiffness over mass [1/s2]


class _Unknown(NamedTuple):
    """The same of modes j beyond those that are known one by one; closed forms of j."""

    known: int  # J, modes that are known
    sense: Num[Array, "links K"]  # per j
    pull: Num[Array, "links K"]  # times j^3
    enter: float  # times j
    leave: float  # times j
    omega: float  # over j^2, the smallest [rad/s]
    resonance: float  # largest 1/|D| and x^2/|D| [1]
    zeta: float  # of mode J, the largest [1]
    spring: float  # |axial force's share| of mode J [1]


def bound_tail(
    loop: ModalLoop, base: int, near: int, stiffness: tuple[float, float], payload: float
) -> Tail | None:
    """Bound what remains beyond `base` modes a link and the images from -near to near.

    It covers every number of modes from `base` on, each with its static correction if the loop has
    one.

    Args:
        loop: NumPy arrays; modes beyond its own R by the growth of slopes and couplings.
        base: modes that the model has.
        near: images whose direct responses the model has.
        stiffness: smallest and largest factor E on the links' stiffness [1].
        payload: the smallest [kg].

    Returns:
        Tail; None where there is no bound: damping ratios that fall with frequency, or damping too
        small for the coupling with the pose.
    """
    if not 0 <= loop.exponent <= 1 or np.any(loop.zeta <= 0) or np.any(loop.spring <= -0.5):
        return None
    sizes = _sizes(loop, payload, stiffness[1])
    unknown = _unknown(loop, sizes)
    sampling = 2 * np.pi / float(loop.period)
    high = (np.arange(loop.omega.shape[1]) >= base) * 1.0
    edges = np.linspace(0, 0.5, SLICES + 1) * sampling
    total = np.zeros((SLICES, *[sizes.sense.shape[0] * sizes.sense.shape[2]] * 2))
    for image in [n for n in range(-BANDS, BANDS + 1) if n != 0]:
        shifted = np.abs(edges + image * sampling)
        # beyond a few images the whole band is one slice
        width = 1 if abs(image) <= FINE else SLICES
        for k in range(0, SLICES, width):
            low, top = sorted(shifted[[k, k + width]])
            part = _one_image(loop, sizes, unknown, (low, top), stiffness, high, abs(image) <= near)
            if part is None:
                return None
            total[k : k + width] += part
    for k in range(SLICES):
        total[k] += _first_image(loop, sizes, unknown, (edges[k], edges[k + 1]), stiffness, high)
    rest = _static_rest(loop, base)
    far = _beyond_bands(loop, sizes, unknown, high * (loop.exact is not None), rest, stiffness)
    if far is None:
        return None
    total += far + _unknown_images(loop, unknown, stiffness)
    first = _suprema(loop, 0.0, (0.5 + OVERLAP) * sampling, stiffness)
    return _with_first_image(loop, sizes, unknown, first, high, total, payload, stiffness)


def _one_image(
    loop: ModalLoop,
    sizes: _Sizes,
    unknown: _Unknown,
    span: tuple[float, float],
    stiffness: tuple[float, float],
    high: Array,
    is_near: bool,
) -> Array | None:
    """What is left out of one image over a span of |omega|, (U, U)."""
    at = _suprema(loop, *span, stiffness)
    seen = high * _direct_answer(loop, at)
    part = _through_pose(sizes, unknown, at, *span, stiffness, high if is_near else None)
    if part is None:
        return None
    if not is_near:
        seen = seen + (1 - high) * at.answer
        part = part + _static_rest(loop, int(np.sum(high == 0)))
    return _chain(loop, span[0]) * (part + _direct(sizes, seen))


def _direct_answer(loop: ModalLoop, at: _Band) -> Array:
    """What a mode that is left out does directly, beyond its static correction if there is one."""
    return at.remainder if loop.exact is not None else at.answer


def _first_image(
    loop: ModalLoop,
    sizes: _Sizes,
    unknown: _Unknown,
    span: tuple[float, float],
    stiffness: tuple[float, float],
    high: Array,
) -> Array:
    """Direct answers at image 0 over a span of omega, where hold and filters are at most 1."""
    at = _suprema(loop, *span, stiffness)
    seen = high * _direct_answer(loop, at)
    x = np.asarray(span[1] / unknown.omega / unknown.known**2 / np.sqrt(stiffness[0]))
    distance, size = _remainder(loop, unknown, x, stiffness)
    compliance = np.einsum("ik,il->ikl", unknown.sense, unknown.pull) / unknown.known
    return _direct(sizes, seen) + _on_diagonal(compliance) * (distance / size)


class _Band(NamedTuple):
    """Suprema over a band of omega and all stiffnesses."""

    answer: Num[Array, "links R"]  # 1/|D|
    inertial: Num[Array, "links R"]  # x^2/|D|
    remainder: Num[Array, "links R"]  # |1/D - 1|


def least_denominator(square: Array, zeta: Array) -> Array:
    """Least |square - x^2 + 2 i zeta x| over all x."""
    sharp = np.minimum(zeta / np.sqrt(square), np.sqrt(0.5))
    return 2 * square * sharp * np.sqrt(1 - sharp**2)


def _suprema(loop: ModalLoop, low: float, top: float, stiffness: tuple[float, float]) -> _Band:
    """D = 1 + spring/E - x^2 + 2 i zeta x, x = omega/(sqrt(E) omega_j)."""
    x_low = low / (np.sqrt(stiffness[1]) * loop.omega)
    x_top = top / (np.sqrt(stiffness[0]) * loop.omega)
    springs = [loop.spring / e for e in stiffness]
    square_low, square_top = 1 + np.minimum(*springs), 1 + np.maximum(*springs)
    apart = np.maximum(np.maximum(square_low - x_top**2, x_low**2 - square_top), 0.0)
    size = np.hypot(apart, 2 * loop.zeta * x_low)
    size = np.maximum(size, least_denominator(square_low, loop.zeta))
    answer = 1 / size
    # x^2/|D| = 1/|square/x^2 - 1 + 2 i zeta/x|; beyond resonance it falls towards 1
    resonant = square_top / least_denominator(square_low, loop.zeta)
    after = x_low**2 / np.maximum(x_low**2 - square_top, 1e-300)
    inertial = np.where(x_low**2 > square_top, np.minimum(after, resonant), resonant)
    with np.errstate(invalid="ignore"):
        inertial = np.fmin(inertial, x_top**2 * answer)
    distance = x_top**2 + 2 * loop.zeta * x_top + np.maximum(*np.abs(springs))
    return _Band(answer, inertial, np.minimum(distance * answer, 1 + answer))


def _chain(loop: ModalLoop, omega: float) -> float:
    """Largest size of hold and filters from omega on: |A| <= (corner/omega)^2, hold 2/(omega T)."""
    filtered = min(1.0, (float(loop.antialias) / omega) ** 2)
    return filtered * min(1.0, 2 / (omega * float(loop.period)))


def pose_scale(loop: ModalLoop, payload: float) -> Array:
    """C^-1 of the rigid part's mass C C' with a payload, (p, p)."""
    return np.linalg.inv(np.linalg.cholesky(loop.mass + payload * loop.payload_mass))


def _sizes(loop: ModalLoop, payload: float, stiffest: float) -> _Sizes:
    scale = pose_scale(loop, payload)
    enter, leave = (np.linalg.norm(scale @ x, axis=1) for x in (loop.enter, loop.leave))
    return _Sizes(
        sense=np.abs(np.swapaxes(loop.sensor, 1, 2)),
        pull=np.abs(loop.actuator) / loop.omega[:, :, None] ** 2,
        enter=enter,
        leave=leave,
        push=stiffest * np.linalg.norm(scale @ loop.push, axis=0),
        read=np.linalg.norm(loop.read @ scale.T, axis=1),
        spring=sum(
            float(np.linalg.norm(scale @ x @ scale.T, 2))
            for x in (loop.stiffness, stiffest * loop.axial_stiffness)
        ),
    )


def _unknown(loop: ModalLoop, sizes: _Sizes) -> _Unknown:
    """Coupling with the pose times j alternates between two values: known modes show its size.

    Where slopes are 0 there are no more modes.
    """
    count = loop.omega.shape[1]
    order = np.arange(1, count + 1)
    first = loop.omega[:, :1]
    zeta = loop.zeta[:, -1]
    exist = float(np.any(loop.steepest[0]))
    return _Unknown(
        known=count,
        sense=np.asarray(loop.steepest[0]),
        pull=np.asarray(loop.steepest[1]) / first**2,
        enter=exist * float(np.max(sizes.enter * order)) * len(sizes.enter),  # links add up
        leave=exist * float(np.max(sizes.leave * order)),
        omega=float(np.min(first)),
        resonance=max(1.2, float(np.max(1 / least_denominator(0.9 + 0 * zeta, zeta)))),
        zeta=float(np.max(zeta)),
        spring=float(np.max(np.abs(loop.spring[:, -1]))),
    )


def _static_rest(loop: ModalLoop, base: int) -> Array:
    """Sizes of `static_rest`, (U, U)."""
    return _on_diagonal(np.abs(static_rest(loop, base)))


def static_rest(loop: ModalLoop, base: int) -> Array:
    """Static voltages per voltage beside `base` modes, (3, K, K)."""
    if loop.exact is None:
        return np.asarray(loop.held)
    compliance = 1 / loop.omega[:, :base] ** 2
    by_modes = np.einsum(
        "ikr,ir,irl->ikl", loop.sensor[:, :, :base], compliance, loop.actuator[:, :base]
    )
    return np.asarray(loop.exact) - by_modes


def _on_diagonal(blocks: Array) -> Array:
    """Blocks (3, a, b) on a diagonal, (3 a, 3 b)."""
    n, a, b = blocks.shape
    whole = np.zeros((n, a, n, b))
    whole[np.arange(n), :, np.arange(n)] = blocks
    return whole.reshape(n * a, n * b)


def _direct(sizes: _Sizes, seen: Array) -> Array:
    """Sum over modes from voltage to sensor, (U, U)."""
    return _on_diagonal(np.einsum("irk,ir,irl->ikl", sizes.sense, seen, sizes.pull))


def _through_pose(
    sizes: _Sizes,
    unknown: _Unknown,
    at: _Band,
    low: float,
    top: float,
    stiffness: tuple[float, float],
    high: Array | None,
) -> Array | None:
    """From voltage to pose to sensor in a band, (U, U); None: no bound.

    M p + sum enter q = -push u/nu^2, q = (pull u + x^2 leave p)/D: ||p|| <= f u/(1 - g),
    y <= h ||p||; springs take part of M, dampers only add to it.

    Args:
        high: 1 for modes that the model leaves out, if it has the rest: only what these change;
            None: all modes.
    """
    more = unknown.known
    square = (top / unknown.omega) ** 2 / stiffness[0]  # x^2 of mode j times j^4
    slack = 1 - square / more**4 - unknown.spring / stiffness[0]
    if unknown.leave > 0 and slack < 0.8:
        return None
    nonresonant = 1 / max(slack, 0.8)
    pushed = np.einsum("ir,ir,irk->rik", sizes.enter, at.answer, sizes.pull)
    seen = np.einsum("irk,ir,ir->rik", sizes.sense, at.inertial, sizes.leave)
    back = np.sum(sizes.enter * at.inertial * sizes.leave, axis=0)
    # of the modes that are not known one by one
    pushed_by = unknown.enter * unknown.pull.ravel() * nonresonant / (3 * more**3)
    seen_by = unknown.sense.ravel() * unknown.leave * square * nonresonant / (3 * more**3)
    back_by = unknown.enter * unknown.leave * square * nonresonant / (5 * more**5)
    slack = 1 - sizes.spring / low**2 - np.sum(back) - back_by
    if slack <= 0:
        return None
    pushed, seen = (x.reshape(len(x), -1) for x in (pushed, seen))
    whole = [sizes.read + np.sum(seen, axis=0), sizes.push / low**2 + np.sum(pushed, axis=0)]
    if high is None:
        return np.outer(whole[0] + seen_by, whole[1] + pushed_by) / slack
    seen_high, pushed_high = high @ seen + seen_by, high @ pushed + pushed_by
    changed = np.outer(seen_high, whole[1] + pushed_by)
    changed += np.outer(whole[0] - high @ seen, pushed_high)
    turned = (high @ back + back_by) / slack
    return (changed + turned * np.outer(*whole)) / slack


def _beyond_bands(
    loop: ModalLoop,
    sizes: _Sizes,
    unknown: _Unknown,
    static: Array,
    rest: Array,
    stiffness: tuple[float, float],
) -> Array | None:
    """All images beyond `BANDS`, (U, U), known modes direct, all modes through the pose.

    At image n the unknown modes up to 2 j_n, j_n^2 = nu_n/omega_1, are taken to be resonant, those
    above answer by less than 4/3 x^2.
    """
    sampling = 2 * np.pi / float(loop.period)
    low, more = (BANDS + 0.5) * sampling, unknown.known
    at = _suprema(loop, low, np.inf, stiffness)
    pushed = np.einsum("ir,ir,irk->ik", sizes.enter, at.answer, sizes.pull).ravel()
    pushed += unknown.enter * unknown.pull.ravel() * unknown.resonance / (3 * more**3)
    pushed += sizes.push / low**2
    back = np.sum(sizes.enter * at.inertial * sizes.leave)
    back += unknown.enter * unknown.leave * unknown.resonance / more
    slack = 1 - sizes.spring / low**2 - back
    if slack <= 0:
        return None
    weight = 4 * float(loop.antialias) ** 2 / (float(loop.period) * sampling**3)
    cubes = weight / (2 * (BANDS - 0.5) ** 2)
    # sum of (n - 1/2)^-5/2
    fuller = weight / (1.5 * (BANDS - 0.5) ** 1.5)
    per_image = np.sqrt(2 * sampling / (np.sqrt(stiffness[0]) * unknown.omega))
    known = np.einsum("irk,ir,ir->ik", sizes.sense, at.inertial, sizes.leave).ravel()
    resonant = 3 * unknown.sense.ravel() * unknown.leave * unknown.resonance * per_image
    seen = cubes * (sizes.read + known) + fuller * resonant
    return cubes * (_direct(sizes, static + at.answer) + rest) + np.outer(seen, pushed) / slack


def _unknown_images(loop: ModalLoop, unknown: _Unknown, stiffness: tuple[float, float]) -> Array:
    """Direct answers of unknown modes at all images but the first, (U, U).

    Images with x <= 1/2 by the remainder of mode J, which is the largest; those beyond by the
    resonance.
    """
    sampling = 2 * np.pi / float(loop.period)
    root = np.sqrt(stiffness[0])
    omega = unknown.omega * unknown.known**2
    weight = 4 * float(loop.antialias) ** 2 / (float(loop.period) * sampling**3)
    n = np.arange(1, 100_001)
    x = np.minimum((n + 0.5) * sampling / (root * omega), 0.5)
    distance, size = _remainder(loop, unknown, x, stiffness)
    near = weight * np.sum((n - 0.5) ** -3.0 * distance / size)
    near += weight * 2 / (2 * (len(n) - 0.5) ** 2)
    turn = max(omega * root / (2 * sampling), 2.0)
    far = weight / (2 * (turn - 1.5) ** 2) * (1 + unknown.resonance) / 5
    compliance = np.einsum("ik,il->ikl", unknown.sense, unknown.pull) / unknown.known
    return _on_diagonal(compliance) * (near + far)


def _remainder(
    loop: ModalLoop, unknown: _Unknown, x: Array, stiffness: tuple[float, float]
) -> tuple[Array, Array]:
    """Bounds of |D - 1| (or 1 without static correction) from above and |D| from below."""
    spring = unknown.spring / stiffness[0]
    size = 1 - x**2 - spring
    if loop.exact is None:
        return np.ones_like(x), size
    return x**2 + 2 * unknown.zeta * x + spring, size


def _with_first_image(
    loop: ModalLoop,
    sizes: _Sizes,
    unknown: _Unknown,
    first: _Band,
    high: Array,
    images: Array,
    payload: float,
    stiffness: tuple[float, float],
) -> Tail:
    more, scale = unknown.known, pose_scale(loop, payload)
    enter, leave = (np.abs(scale @ x) for x in (loop.enter, loop.leave))  # (n, p, R)
    soft = high * first.answer / loop.omega**2
    x = np.asarray((0.5 + OVERLAP) * 2 * np.pi / float(loop.period) / unknown.omega / more**2)
    _, size = _remainder(loop, unknown, x / np.sqrt(stiffness[0]), stiffness)
    rare = 1 / (3 * more**3 * unknown.omega**2 * size)
    away = high * (0.5 + np.minimum(first.remainder, first.answer)) / loop.omega**2
    by_pose = np.einsum("irk,ir,ipr->ikp", sizes.sense, away, leave)
    by_pose = by_pose.reshape(-1, len(scale))
    by_voltage = np.einsum("ipr,ir,irk->pik", enter, high * first.answer, sizes.pull)
    by_voltage = by_voltage.reshape(len(scale), -1)
    own = unknown.enter * unknown.leave / (5 * more**5 * unknown.omega**2 * size)
    return Tail(
        images=images,
        sensor_by_pose=by_pose + rare * unknown.leave * unknown.sense.reshape(-1, 1),
        pose_by_voltage=by_voltage + unknown.enter * unknown.pull.ravel() / (3 * more**3 * size),
        pose_by_pose=np.einsum("ipr,ir,iqr->pq", enter, soft, leave) + own,
    )
