"""Linear controllers of any order: x_(k+1) = A x_k + B y_k, u_k = C x_k + D y_k, A in blocks.

Where a command is limited to v_k, E (v_k - u_k) is added to x_(k+1): with E the effect of a command
on what an observer predicts, it predicts with the command as it was applied, and does not wind up
(the observer form of anti-windup, Astrom and Rundqwist 1989).

One system for all links together, or one for each link. With blocks of 2x2, the real modal form
(`modal_form`), a sample costs O(order x channels). Shapes: structure first, lanes last.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num

#: Condition number of the largest similarity that keeps enough digits [1].
WORST_CONDITION = 1e7
#: Poles that are no further apart share a space whose vectors are as they may be [1].
CLOSE = 1e-6


class StateSpace(NamedTuple):
    """G systems, one or one a link: each has N blocks of b states.

    Each has M sensors and as many actuators: all n K of the machine, or the K of its link.
    """

    state: Num[Array, "G N b b"]  # A
    enter: Num[Array, "G N b M"]  # B, state per sensor volt
    leave: Num[Array, "G M N b"]  # C, actuator volts per state
    direct: Num[Array, "G M M"]  # D [1]
    anti_windup: Num[Array, "G N b M"] | None = None  # E, state per volt that a limit adds; None: 0

    @property
    def has_output(self) -> bool:
        """Whether it does anything; NumPy arrays."""
        return bool(np.any(self.leave) or np.any(self.direct))

    def at_rest(self) -> Array:
        """State zero, (G, N, b)."""
        return jnp.zeros_like(jnp.asarray(self.state)[..., 0])

    def step(self, state: Array, voltage: Array) -> tuple[Array, Array]:
        """One sample.

        Args:
            state: x, (G, N, b).
            voltage: of the sensors [V], (n, K).

        Returns:
            (next state, voltages wanted on the actuators [V], (n, K)).
        """
        y = jnp.reshape(voltage, (state.shape[0], -1, *voltage.shape[2:]))
        after = jnp.sum(self.state * state[:, :, None], axis=3)
        after = after + jnp.sum(self.enter * y[:, None, None], axis=3)
        demand = jnp.sum(jnp.sum(self.leave * state[:, None], axis=3), axis=2)
        demand = demand + jnp.sum(self.direct * y[:, None], axis=2)
        return after, jnp.reshape(demand, voltage.shape)

    def limited(self, state: Array, change: Array) -> Array:
        """The next state, told what the limits changed.

        Args:
            state: from `step`.
            change: of the voltages wanted, by limits [V], (n, K).
        """
        if self.anti_windup is None:
            return state
        volts = jnp.reshape(change, (state.shape[0], -1, *change.shape[2:]))
        return state + jnp.sum(self.anti_windup * volts[:, None, None], axis=3)

    def amplified(self, factor: Array) -> StateSpace:
        """Outputs times a factor: one for all, or one for each actuator, (n, K).

        A factor is taken for one of the machine: the state is told of limits as if it had not been
        there, E (v - u)/factor.
        """
        ports = self.direct.shape[:2]
        each = jnp.reshape(factor, ports) if jnp.ndim(factor) else jnp.full(ports, factor)
        tell = self.anti_windup
        if tell is not None:
            is_on = each != 0
            share = jnp.where(is_on, 1 / jnp.where(is_on, each, 1.0), 0.0)
            tell = tell * share[:, None, None]
        return self._replace(
            leave=self.leave * each[:, :, None, None],
            direct=self.direct * each[:, :, None],
            anti_windup=tell,
        )

    def with_sensors(self, factor: Array) -> StateSpace:
        """Sensor voltages times a factor each, (n, K)."""
        each = jnp.reshape(factor, (self.direct.shape[0], -1))
        return self._replace(
            enter=self.enter * each[:, None, None], direct=self.direct * each[:, None]
        )

    def without_rivals(self) -> StateSpace:
        """Itself: it has no channels."""
        return self

    def linear_parts(self) -> list[tuple[slice, StateSpace]]:
        """See `jaxmodel.controller.linear_parts`."""
        return [(slice(None), self)]

    def padded(self, n_channels: int) -> StateSpace:
        """Itself: it has no channels that another law could have more of."""
        return self


class IllConditionedError(ValueError):
    """No well-conditioned modal form."""


def dense(system: StateSpace) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A, B, C, D of all groups as one system from all sensors to all actuators; NumPy arrays."""
    groups, n, b, _ = system.state.shape
    size = system.direct.shape[1]
    order = n * b
    a = np.zeros((groups * order, groups * order))
    enter, leave = np.zeros((groups * order, groups * size)), np.zeros((groups * size, len(a)))
    direct = np.zeros((groups * size, groups * size))
    for g in range(groups):
        states, ports = slice(g * order, (g + 1) * order), slice(g * size, (g + 1) * size)
        for k in range(n):
            at = slice(g * order + k * b, g * order + (k + 1) * b)
            a[at, at] = system.state[g, k]
        enter[states, ports] = np.reshape(system.enter[g], (order, size))
        leave[ports, states] = np.reshape(system.leave[g], (size, order))
        direct[ports, ports] = system.direct[g]
    return a, enter, leave, direct


def used_states(a: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Which states of x_(k+1) = A x + .., u = C x + .. anything depends on, (n,).

    A delay line longer than the delay has commands that nothing reads, and states that only these
    read.
    """
    used: np.ndarray = np.ones(len(a), bool)
    while np.any(idle := used & ~(np.any(a[used], axis=0) | np.any(c, axis=0))):
        used = used & ~idle
    return used


class ModalForm(NamedTuple):
    """A system in real modal form: blocks of two states, a pair of poles or two real ones."""

    state: np.ndarray  # (N, 2, 2)
    enter: np.ndarray  # (N, 2, m)
    leave: np.ndarray  # (m', N, 2)
    condition: float  # of the similarity, with columns of length 1 [1]


def modal_form(
    a: np.ndarray, b: np.ndarray, c: np.ndarray, worst: float = WORST_CONDITION
) -> ModalForm:
    """Bring x_(k+1) = A x + B y, u = C x to real modal form.

    A complex pair sigma +- j w becomes the block ((sigma, w), (-w, sigma)); real poles share blocks
    in ascending order, an odd one with a state that stays 0. States are scaled so that the rows of
    B and the columns of C have one size.

    Args:
        a, b, c: (n, n), (n, m), (m', n), finite.
        worst: largest condition number of the similarity [1].

    Raises:
        IllConditionedError: (nearly) equal poles whose eigenvectors are nearly parallel.
    """
    if len(a) == 0:  # one state that stays 0
        a, b, c = np.zeros((1, 1)), np.zeros((1, b.shape[1])), np.zeros((len(c), 1))
    value, vector = np.linalg.eig(a)
    condition = float(np.linalg.cond(vector))
    if not condition <= worst:
        i, j = _closest(value)
        raise IllConditionedError(
            f"no well-conditioned modal form: its transformation has the condition number "
            f"{condition:.2g} (allowed: {worst:g}); poles {value[i]:.6g} and "
            f"{value[j]:.6g} are too close for their coupling"
        )
    value, vector = _corrected(a, value, vector)
    upper = np.flatnonzero(value.imag > 0)
    real = np.flatnonzero(value.imag == 0)
    real = real[np.argsort(value[real].real)]
    columns, blocks = [], []
    for pole, shape in zip(value[upper], vector[:, upper].T, strict=True):
        columns += [shape.real, shape.imag]
        blocks.append(np.array([[pole.real, pole.imag], [-pole.imag, pole.real]]))
    for at in range(0, len(real), 2):
        pair = real[at : at + 2]
        columns += list(vector[:, pair].real.T)
        blocks.append(np.diag([*value[pair].real, 0.0][:2]))
    basis = np.stack(columns, axis=1) if columns else np.zeros((0, 0))
    short = basis.astype(float)
    enter, leave = np.linalg.solve(short, b), (c @ basis).astype(float)
    enter = enter + np.linalg.solve(short, (b - basis @ enter).astype(float))
    if len(real) % 2:
        enter = np.vstack([enter, np.zeros((1, b.shape[1]))])
        leave = np.hstack([leave, np.zeros((c.shape[0], 1))])
    n = len(blocks)
    enter, leave = enter.reshape(n, 2, -1), leave.reshape(len(c), n, 2)
    size = np.sqrt(
        _safe(np.linalg.norm(enter, axis=(1, 2))) / _safe(np.linalg.norm(leave, axis=(0, 2)))
    )
    return ModalForm(
        state=np.array(blocks, float).reshape(n, 2, 2),
        enter=enter / size[:, None, None],
        leave=leave * size[:, None],
        condition=condition,
    )


def _corrected(
    a: np.ndarray, value: np.ndarray, vector: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues and vectors after a step of Newton's method, their residual in long doubles.

    Slow poles at high sample rates ring for thousands of samples and show every bit.
    """
    is_real, apart = value.imag == 0, value - value[:, None]
    is_apart = np.abs(apart) > CLOSE
    wide = vector.astype(np.clongdouble)
    rest = np.linalg.solve(vector, (a @ wide - wide * value).astype(complex))
    value = value + np.diag(rest)
    wide = wide + wide @ (is_apart * rest / np.where(is_apart, apart, 1.0))
    value[is_real], wide[:, is_real] = value[is_real].real, wide[:, is_real].real
    return value, wide


def _safe(x: np.ndarray) -> np.ndarray:
    return np.where(x > 0, x, 1.0)


def _closest(value: np.ndarray) -> tuple[int, int]:
    """Two poles of least distance."""
    apart = np.abs(value[:, None] - value[None]) + 1e300 * np.eye(len(value))
    i, j = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return int(i), int(j)
