"""Loop gain of many sampled loops at many frequencies, in NumPy.

The same equations as `jaxmodel.frequency_response`, where they are explained, arranged for speed:
products of whole matrices instead of programs that take seconds to compile. Tests hold the two
equal.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.channels import Channels
from jaxmodel.controller import Controller
from jaxmodel.estimator import responses
from jaxmodel.frequency_response import (
    IMAGES,
    PlantResponse,
    SampledLoopResponse,
    late_stiffness,
    tail_weights,
)
from jaxmodel.notch import notch_response
from jaxmodel.return_difference import FAR
from jaxmodel.return_difference import IMAGES as FEW
from jaxmodel.state_space import StateSpace

_FEW, _FAR, _ALL = np.array(FEW), np.array(FAR), np.arange(-IMAGES, IMAGES + 1)
#: Evaluations of the plant at once, which stay in a processor's cache.
AT_ONCE = 1500


#: Largest condition number of the eigenvectors of a controller.
WORST = 1e6


class ModalSystem(NamedTuple):
    """G linear systems by their poles."""

    pole: np.ndarray  # (n, G, b)
    residue: np.ndarray  # (n, G, b, M M)
    direct: np.ndarray  # D, (n, G, M, M)


class LoopGains(NamedTuple):
    """L(e^(j omega T)) = -K P of n loops at the m commands that act; NumPy."""

    plant: PlantResponse  # leaves (n, ...)
    controller: Any  # Controller; a linear system's feedback is a `ModalSystem` if it can be
    pairs: np.ndarray  # products of a mode's rows and columns, see `_modal_sums`, (n, l, R, q)
    acting: np.ndarray  # numbers of the commands, (m,)

    @property
    def top(self) -> np.ndarray:
        """Half the sample rate [rad/s], (n,)."""
        return np.pi / self.plant.period

    def part(self, rows: np.ndarray) -> LoopGains:
        """Some of the loops, also repeated."""
        plant, controller, pairs = jax.tree.map(lambda x: x[rows], self[:3])
        return LoopGains(plant, controller, pairs, self.acting)

    def searched(self, omega: np.ndarray) -> np.ndarray:
        """L to 1e-4, (n, F, m, m).

        Args:
            omega: above 0 [rad/s], (n, F).
        """
        return self._gains(omega, np.zeros(omega.shape), is_exact=False)

    def exact(self, omega: np.ndarray, delay: np.ndarray | None = None) -> np.ndarray:
        """L with all images of the spectrum, (n, F, m, m).

        Args:
            omega: above 0 [rad/s], (n, F).
            delay: a further one [samples], (n, F); None: none.
        """
        delay = np.zeros(omega.shape) if delay is None else delay
        return self._gains(omega, delay, is_exact=True)

    def at_delay(self, omega: np.ndarray, delay: np.ndarray) -> np.ndarray:
        """L to 1e-4 with further delays, arguments as for `exact`."""
        return self._gains(omega, delay, is_exact=False)

    def _gains(self, omega: np.ndarray, delay: np.ndarray, is_exact: bool) -> np.ndarray:
        if not omega.size:
            return np.zeros((*omega.shape, *[len(self.acting)] * 2), complex)
        order = _ALL if is_exact else _FEW
        step = max(1, AT_ONCE // (omega.shape[1] * len(order)))
        if step >= len(omega):
            return self._evaluated(omega, delay, order)
        parts = [np.arange(k, min(k + step, len(omega))) for k in range(0, len(omega), step)]
        return np.concatenate(
            [self.part(rows)._evaluated(omega[rows], delay[rows], order) for rows in parts]
        )

    def _evaluated(self, omega: np.ndarray, delay: np.ndarray, order: np.ndarray) -> np.ndarray:
        w, gain = self._chain(omega, delay, order)
        flat = w.reshape(len(w), -1)
        direct: Any = 0.0
        if order is _FEW:  # of farther images only what is direct counts
            far = np.sum(self._chain(omega, delay, _FAR)[1], axis=-1)
            direct = far[:, None, :, None, None] * self.plant.direct[:, :, None]
        sensed = self._sensed(flat, gain.reshape(flat.shape), len(order), direct)
        feedback = _feedback(self.controller, np.exp(1j * omega * self.plant.period[:, None]))
        return -feedback[..., self.acting, :] @ sensed

    def _chain(
        self, omega: np.ndarray, delay: np.ndarray, order: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Frequencies of images and their weights through delay and electronics, (n, F, I)."""
        plant, period = self.plant, self.plant.period[:, None]
        late = (1.0 if plant.delay is None else plant.delay[:, None]) + delay
        gain = _image_weights(late, order) * np.exp(-1j * omega * period * late)[..., None]
        w = omega[..., None] + 2 * np.pi / period[..., None] * order
        return w, gain * _electronics(plant, omega, w)

    def _sensed(self, w: np.ndarray, gain: np.ndarray, images: int, far: Any) -> np.ndarray:
        """Sensor volts per command, see `plant_images`; images summed, `far` added to each
        link's own channels, (n, F, l K, m)."""
        plant, n = self.plant, len(w)
        (links, k), p = plant.sensor.shape[1:3], plant.mass.shape[-1]
        square = w * w
        at = (..., None, None)
        dynamic = (1j * w)[at] * plant.damping[:, None] + (
            plant.stiffness[:, None] - square[at] * plant.mass[:, None]
        )
        own, leaving, entering, taken = self._at_ports(w)
        dynamic = dynamic - taken[..., :p, :p].sum(axis=1)
        own = own + plant.direct[:, :, None]
        if plant.longer is not None:  # elongations are eliminated
            jw, w2 = 1j * w[:, None, :, None], square[:, None, :, None]
            mass, damping, stiffness = (x[:, :, None] for x in plant.longer)
            row = jw * damping + (stiffness - w2 * mass) - taken[..., p, :]
            share = row[..., :p] / row[..., p:]
            heard = leaving[..., p] + plant.read[:, :, None] / w2
            pushed = entering[..., p] + plant.push[:, :, None] / w2
            dynamic = dynamic - np.einsum("nlfp,nlfq->nfpq", share, row[..., :p])
            own = own + (heard * w2 * w2 / row[..., p:])[..., None] * pushed[..., None, :]
            leaving, entering = (
                x[..., :p] - y[..., None] * share[..., None, :]
                for x, y in ((leaving, heard), (entering, pushed))
            )
        compliance = (gain * square * square)[at] * small_inverse(dynamic)
        leaving = leaving.transpose(0, 2, 1, 3, 4).reshape(n, -1, links * k, p)
        entering = entering.transpose(0, 2, 4, 1, 3).reshape(n, -1, p, links * k)
        leaving = (leaving @ compliance).reshape(n, -1, images, links * k, p)
        # the sum over images and pose is one product
        left = leaving.transpose(0, 1, 3, 2, 4).reshape(n, -1, links * k, p * images)
        sensed = left @ entering[..., self.acting].reshape(n, -1, p * images, len(self.acting))
        own = gain[:, None, :, None, None] * own
        own = own.reshape(n, links, -1, images, k, k).sum(axis=3) + far
        whole = np.zeros((*sensed.shape[:3], links * k), complex)
        for i in range(links):
            rows = slice(i * k, (i + 1) * k)
            whole[..., rows, rows] = own[:, i]
        return sensed + whole[..., self.acting]

    def _at_ports(self, w: np.ndarray) -> tuple[np.ndarray, ...]:
        """Of each link, sensors by actuators, (n, l, N, K, K), over w^2 sensors and actuators by
        ports, (n, l, N, K, P), and what modes take from the ports' stiffness, (n, l, N, P, P)."""
        blocks, port = self._modal_sums(w), self.plant.port
        (n, links), k = blocks.shape[:2], blocks.shape[-1] - 2

        def carried(x: np.ndarray) -> np.ndarray:
            flat = x.reshape(n, links, -1, 2) @ port
            return flat.reshape(*x.shape[:-1], -1)

        leaving, entering = blocks[..., :k, k:], np.swapaxes(blocks[..., k:, :k], 3, 4)
        taken = carried(np.swapaxes(carried(blocks[..., k:, k:]), 3, 4))
        taken = (w**4)[:, None, :, None, None] * taken
        if self.plant.servo is not None:
            taken = taken - late_stiffness(self.plant, 1j * w)
        return blocks[..., :k, :k], carried(leaving), carried(entering), taken

    def _modal_sums(self, w: np.ndarray) -> np.ndarray:
        """Sums over the modes of each link at j w, (n, l, N, K + 2, K + 2).

        Rows are sensors and forces on the two motions of its ports, columns actuators and these
        motions. Real and imaginary parts are multiplied by real matrices, which takes half the
        time.
        """
        plant, count = self.plant, w.shape[1]
        w = w[:, None, :, None]
        stiff = plant.square[:, :, None] - w * w  # (n, l, N, R)
        loss = plant.decay[:, :, None] * w
        size = 1 / (stiff * stiff + loss * loss)
        both = np.concatenate([stiff * size, -loss * size], axis=2) @ self.pairs
        whole = both[:, :, :count] + 1j * both[:, :, count:]
        side = plant.sensor.shape[2] + 2
        return whole.reshape(*whole.shape[:3], side, side)


def loop_gains(response: SampledLoopResponse) -> LoopGains:
    """Loop gains by frequency responses, leaves (n, ...), NumPy in float64."""
    plant = response.plant
    rows = np.concatenate([plant.sensor, plant.enter], axis=2)  # (n, l, K + 2, R)
    columns = np.concatenate([np.swapaxes(plant.actuator, 2, 3), plant.leave], axis=2)
    pairs = np.einsum("niar,nibr->nirab", rows, columns)
    acting = np.flatnonzero(acting_commands(response.controller).any(axis=0))
    controller: Any = response.controller
    if isinstance(controller.feedback, StateSpace):
        controller = controller._replace(feedback=_modal_form(controller.feedback))
    return LoopGains(plant, controller, pairs.reshape(*pairs.shape[:3], -1), acting)


def acting_commands(controller: Controller) -> np.ndarray:
    """Which commands act, (n, l K)."""
    n = len(controller.voltage_limit)
    seen = _feedback(controller, np.broadcast_to(np.exp(1j * np.array([0.3, 3.0])), (n, 2)))
    return np.any(seen != 0, axis=(1, 3))


def _image_weights(late: np.ndarray, order: np.ndarray) -> np.ndarray:
    """See `jaxmodel.frequency_response.image_weights`, (n, F, I)."""
    turn = 2 * np.pi * late[..., None]
    weights = np.exp(-1j * turn * order)
    if len(order) < len(_ALL):
        return weights
    even, odd = tail_weights()
    beyond = np.arange(IMAGES + 1, IMAGES + 1 + len(even))
    return weights + np.cos(turn * beyond) @ even - 1j * (np.sin(turn * beyond) @ odd)


def _electronics(plant: PlantResponse, omega: np.ndarray, w: np.ndarray) -> np.ndarray:
    """Hold, amplifier, patches and anti-alias filter, (n, F, I)."""

    def spread(x: np.ndarray) -> np.ndarray:
        return np.asarray(x)[:, None, None]

    s, corner = 1j * w, spread(plant.antialias)
    held = (1 - np.exp(-1j * omega * plant.period[:, None]))[..., None] / spread(plant.period)
    gain = held * corner**2 / (corner**2 - w * w + np.sqrt(2.0) * corner * s) / s
    if plant.highpass is not None:
        gain = gain * s / (s + spread(plant.highpass))
    if plant.lag is not None:
        gain = gain / (1 + s * spread(plant.lag))
    return gain


def _feedback(controller: Any, z: np.ndarray) -> np.ndarray:
    """See `jaxmodel.frequency_response.controller_response`, (n, F, l K, l K)."""
    feedback, through, notch = controller.feedback, controller.feedthrough, controller.notch
    if isinstance(feedback, Channels):
        estimator = jax.tree.map(lambda x: x[:, None], feedback.estimator)
        rate, value = responses(estimator, z[..., None, None])
        force = feedback.velocity_gain[:, None] * rate
        if feedback.position_gain is not None:
            force = force + feedback.position_gain[:, None] * value
        into = feedback.synthesizer[:, None] * force[..., None, :]
        blocks = -into @ feedback.filter[:, None]
    else:
        blocks = _transfer(feedback, z)
    groups, m = blocks.shape[2:4]
    if notch is not None:
        coefficients = jax.tree.map(lambda x: x[:, None], notch)
        passed = np.asarray(notch_response(coefficients, z[..., None]))  # (n, F, l)
        columns = np.repeat(passed, through.shape[2], axis=2)
        blocks = blocks * columns.reshape(*z.shape, groups, 1, m)
    if np.any(through):
        own = through if groups == through.shape[1] else block_diagonal(through)[:, None]
        late = own[:, None] / z[..., None, None, None]
        blocks = np.linalg.solve(np.eye(m) + blocks @ late, blocks)
    return block_diagonal(blocks)


def _transfer(system: StateSpace | ModalSystem, z: np.ndarray) -> np.ndarray:
    """C (z - A)^-1 B + D, (n, F, G, M, M)."""
    if isinstance(system, ModalSystem):
        n, groups, count = system.pole.shape
        share = 1 / (z[:, None, :, None] - system.pole[:, :, None])  # (n, G, F, b)
        moved = (share @ system.residue).reshape(n, groups, -1, *system.direct.shape[2:])
        return np.swapaxes(moved, 1, 2) + system.direct[:, None]
    eye = np.eye(system.state.shape[-1])
    enter = system.enter[:, None] + 0j
    state = np.linalg.solve(z[..., None, None, None, None] * eye - system.state[:, None], enter)
    leave = np.swapaxes(system.leave, 2, 3)[:, None]  # (n, 1, G, N, M, b)
    return np.sum(leave @ state, axis=3) + system.direct[:, None]


def _modal_form(system: StateSpace) -> StateSpace | ModalSystem:
    """The system by its poles, unless they are too close together for that."""
    pole, shape = np.linalg.eig(system.state + 0j)  # (n, G, N, b), (n, G, N, b, b)
    # units of the states do not matter
    alike = shape / np.linalg.norm(shape, axis=-1, keepdims=True)
    if not np.all(np.linalg.cond(alike / np.linalg.norm(alike, axis=-2, keepdims=True)) < WORST):
        return system
    into = np.linalg.inv(shape) @ system.enter  # (n, G, N, b, M)
    out = np.swapaxes(system.leave, 2, 3) @ shape  # (n, G, N, M, b)
    residue = np.einsum("ngkmb,ngkbl->ngkbml", out, into)
    n, groups = pole.shape[:2]
    m = system.direct.shape[-1]
    return ModalSystem(
        pole.reshape(n, groups, -1), residue.reshape(n, groups, -1, m * m), system.direct
    )


def small_inverse(matrix: np.ndarray) -> np.ndarray:
    """Of matrices (..., p, p), p = 2 or 3, by cofactors."""
    if matrix.shape[-1] == 2:
        (a, b), (c, d) = np.moveaxis(matrix, (-2, -1), (0, 1))
        turned = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
        return turned / (a * d - b * c)[..., None, None]
    a, b, c = (matrix[..., k, :] for k in range(3))

    def crossed(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        each = [x[..., k - 2] * y[..., k - 1] - x[..., k - 1] * y[..., k - 2] for k in range(3)]
        return np.stack(each, axis=-1)

    columns = np.stack([crossed(b, c), crossed(c, a), crossed(a, b)], axis=-1)
    return columns / np.sum(a * columns[..., 0], axis=-1)[..., None, None]


def block_diagonal(blocks: np.ndarray) -> np.ndarray:
    """(..., G, m, m) to (..., G m, G m)."""
    *outer, groups, m, _ = blocks.shape
    whole = np.zeros((*outer, groups * m, groups * m), blocks.dtype)
    for g in range(groups):
        whole[..., g * m : (g + 1) * m, g * m : (g + 1) * m] = blocks[..., g, :, :]
    return whole
