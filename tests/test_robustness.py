"""Margins and norms by frequency response against matrices of the loop, SciPy and brute force."""

from __future__ import annotations

from functools import cache, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq, minimize, minimize_scalar

from jaxmodel.frequency_response import close_loop, command_gain, response_of_loop
from jaxmodel.laws import LAWS
from jaxmodel.prepare import prepare
from jaxmodel.robustness import MARGINS, PEAKS, guaranteed_range, robustness_figures
from jaxmodel.sampled_loop import (
    _with_electronics,
    closed_loop,
    linearise,
    resting,
    sampled_plant,
)
from jaxmodel.scaling import best_scaling
from studies.engine.stability import with_margin_modes
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import paper_study

#: Off home, where nothing is symmetric.
POSE = np.array([0.005, -0.003, 0.5])
STUDY = paper_study()
PLANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "loaded basis under load": {"load__wrench": (3.0, -2.0, 0.1), "link__basis": "loaded"},
    "electronics, two links": {
        "electronics__sensor_highpass_hz": 2.0,
        "electronics__amplifier_hz": 3000.0,
        "control__links": (True, False, True),
    },
    "no reaction of bending": {"run__model": "ked"},
}


class Loop(NamedTuple):
    """A loop by frequency response, and by its matrices."""

    structure: Any
    case: Any
    response: Any
    matrices: Any  # NumPy
    period: float

    @property
    def commands(self) -> slice:
        """Where the state holds the commands."""
        return slice(len(self.matrices.open) - 3 * self.structure.n_patches, None)


@partial(jax.jit, static_argnums=0)
def _both(structure, case):
    loop = prepare(structure, case).loop
    return response_of_loop(structure, case, loop, POSE), closed_loop(structure, case, POSE)


@cache
def loop_of(name: str, law: str = "imsc", factor: float = 0.5) -> Loop:
    study = STUDY.change(**PLANTS[name], control__law=law, control__gain_factor=factor)
    structure, case = with_margin_modes(build_structure(study), as_arrays(build_case(study)))
    response, matrices = _both(structure, case)
    period = float(case.electronics.period)
    return Loop(structure, case, response, jax.tree.map(np.asarray, matrices), period)


_figures = jax.jit(robustness_figures, static_argnums=1)


def exact_gain(loop: Loop, omega: float) -> np.ndarray:
    """L by the matrices of the loop, opened where the controller writes its commands."""
    m, at = loop.matrices, loop.commands
    z = np.exp(1j * omega * loop.period)
    states = np.linalg.solve(z * np.eye(len(m.open)) - m.open, np.eye(len(m.open))[:, at])
    return -m.feedback[at] @ states


@pytest.mark.parametrize("name", PLANTS)
def test_the_response_is_that_of_the_matrices(name):
    loop = loop_of(name)
    for hertz in (3.0, 114.4, 457.0, 2000.0, 4400.0):
        omega = 2 * np.pi * hertz
        found, wanted = command_gain(loop.response, omega), exact_gain(loop, omega)
        np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


def test_the_closed_loop_is_that_of_the_matrices():
    loop = loop_of("electronics, two links")
    m = loop.matrices
    for hertz in (114.4, 900.0):
        omega = 2 * np.pi * hertz
        z = np.exp(1j * omega * loop.period)
        closed = z * np.eye(len(m.open)) - m.open - m.feedback
        wanted = m.deflection @ np.linalg.solve(closed, m.force)
        found = close_loop(loop.response, omega)
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(found.disturbance_deflection, wanted, atol=1e-6 * scale)
        gain = exact_gain(loop, omega)
        wanted = np.linalg.inv(np.eye(len(gain)) + gain)
        np.testing.assert_allclose(found.sensitivity, wanted, atol=1e-6)


def radius(matrix: np.ndarray) -> float:
    return float(np.abs(np.linalg.eigvals(matrix)).max())


def turned(loop: Loop, factor: complex) -> float:
    """Spectral radius with all commands times a complex factor."""
    return radius(loop.matrices.open + factor * loop.matrices.feedback)


def delayed(loop: Loop, delay: float) -> float:
    """Spectral radius with commands that arrive `delay` samples later, by exact discretisation."""
    whole, share = divmod(delay, 1.0)
    m, k = loop.matrices, 3 * loop.structure.n_patches
    analogue = analogue_of(loop)
    n, period = len(analogue.state), loop.period
    both = np.zeros((n + k, n + k))
    both[:n, :n], both[:n, n:] = analogue.state, np.asarray(analogue.enters)[:, :k]
    early, late = expm(both * share * period), expm(both * (1 - share) * period)
    size = len(m.open)
    closed = np.zeros((size + (int(whole) + 1) * k,) * 2)
    closed[:size, :size] = m.open + m.feedback
    closed[:n] = 0
    closed[:n, :n] = late[:n, :n] @ early[:n, :n]
    # commands held now, one sample ago, ...
    held = [slice(size - k, size)]
    held += [slice(size + j * k, size + (j + 1) * k) for j in range(int(whole) + 1)]
    closed[:n, held[int(whole) + 1]] += late[:n, :n] @ early[:n, n:]
    closed[:n, held[int(whole)]] += late[:n, n:]
    for before, after in zip(held, held[1:], strict=False):
        closed[after, before] = np.eye(k)
    return radius(closed)


def analogue_of(loop: Loop) -> Any:
    smooth = loop.structure._replace(is_smooth=True, feedback="sampled")

    def matrices(case):
        plant = linearise(smooth, prepare(smooth, case).loop, POSE, resting(smooth, case))
        found = _with_electronics(smooth, plant, case)
        return found.state, found.enters

    if id(loop.matrices) not in _ANALOGUES:
        state, enters = map(np.asarray, jax.jit(matrices)(loop.case))
        _ANALOGUES[id(loop.matrices)] = _Analogue(state, enters)
    return _ANALOGUES[id(loop.matrices)]


class _Analogue(NamedTuple):
    state: np.ndarray
    enters: np.ndarray


_ANALOGUES: dict[int, _Analogue] = {}

#: Laws with gains at which their loops are stable but not far from the edge.
LOOPS = {"imsc": 0.5, "srf": 1e-3, "lqr": 0.5}


@pytest.mark.parametrize("law", LOOPS)
def test_the_phase_margin_is_where_a_pole_reaches_the_circle(law):
    loop = loop_of("plain", law, LOOPS[law])
    found = float(_figures(loop.response, MARGINS)["phase_margin"])
    assert turned(loop, 1.0) < 1 and 0 < found < 180
    edge = np.deg2rad(found)
    worst = max(turned(loop, np.exp(1j * s * edge)) for s in (1, -1))
    assert worst == pytest.approx(1, abs=1e-8)
    assert all(turned(loop, np.exp(1j * x)) < 1 for x in np.linspace(-0.999, 0.999, 9) * edge)


@pytest.mark.parametrize("law", LOOPS)
def test_the_delay_margin_is_where_a_pole_reaches_the_circle(law):
    loop = loop_of("plain", law, LOOPS[law])
    found = float(_figures(loop.response, MARGINS)["delay_margin"])
    assert 0 < found < 16
    wanted = brentq(lambda x: delayed(loop, x) - 1, found * 0.98, found * 1.02, xtol=1e-12)
    assert found == pytest.approx(wanted, rel=1e-6)
    assert all(delayed(loop, x) < 1 for x in np.linspace(0, 0.999, 7) * found)


def smallest_norm(matrix: np.ndarray) -> float:
    """The best diagonal scaling by descent on Schatten norms of rising order."""
    n = len(matrix)
    y, best = np.zeros(n - 1), np.inf
    for p in 4.0 ** np.arange(11):

        def norm(y, p=p):
            x = np.append(y, 0.0)
            u, s, v = np.linalg.svd(matrix * np.exp(x[:, None] - x))
            log = 2 * p * np.log(s)
            weight = np.exp(log - log.max())
            value = (log.max() + np.log(weight.sum())) / (2 * p)
            weight /= weight.sum()
            return value, (np.abs(u) ** 2 @ weight - weight @ np.abs(v) ** 2)[:-1]

        y = minimize(norm, y, jac=True, method="BFGS", options={"gtol": 1e-12}).x
        x = np.append(y, 0.0)
        best = min(best, np.linalg.norm(matrix * np.exp(x[:, None] - x), 2))
    return best


def test_the_scaling_is_the_best_one():
    rng = np.random.default_rng(1)
    for n in (3, 9, 15):
        matrix = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        matrix *= np.exp(2 * rng.normal(size=(n, 1)))
        found = jax.jit(best_scaling)(matrix)
        assert float(found.bound) == pytest.approx(smallest_norm(matrix), rel=1e-6)
        change = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        ends = [float(best_scaling(matrix + h * change).bound) for h in (1e-5, -1e-5)]
        slope = np.real(np.sum(np.conj(found.slope) * change))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)


@pytest.mark.parametrize("law", LOOPS)
def test_the_disk_margin_is_the_smallest_over_all_frequencies(law):
    loop = loop_of("plain", law, LOOPS[law])
    found = float(_figures(loop.response, MARGINS)["disk_margin"])

    def excess(omega: float) -> np.ndarray:
        gain = exact_gain(loop, omega)
        return np.linalg.inv(np.eye(len(gain)) + gain) - np.eye(len(gain)) / 2

    bound = jax.jit(best_scaling)
    modes = np.array([114.4, 457.6, 1029.5, 1830.0])
    hertz = np.concatenate([np.geomspace(5, 4990, 150), *(modes * x for x in np.linspace(0.9, 1.1, 81)[:, None])])
    values = np.array([float(bound(excess(2 * np.pi * x)).bound) for x in hertz])
    assert 1 / found >= values.max() * (1 - 1e-9)
    peak = hertz[values.argmax()]
    best = minimize_scalar(
        lambda x: -float(bound(excess(2 * np.pi * x)).bound),
        bounds=(peak * 0.995, peak * 1.005), method="bounded", options={"xatol": 1e-9},
    )
    assert found == pytest.approx(1 / -best.fun, rel=1e-6)
    assert smallest_norm(excess(2 * np.pi * best.x)) == pytest.approx(-best.fun, rel=1e-6)


@pytest.mark.parametrize("name", PEAKS)
def test_peaks_are_those_of_singular_values(name):
    loop = loop_of("plain")
    found = float(_figures(loop.response, PEAKS)[name])
    field = name.removesuffix("_peak")

    @jax.jit
    def norm(omega):
        return jnp.linalg.svd(getattr(close_loop(loop.response, omega), field), compute_uv=False)[0]

    hertz = np.geomspace(0.5, 4990, 4000)
    values = np.array(jax.lax.map(norm, 2 * np.pi * hertz))
    peak = hertz[values.argmax()]
    best = minimize_scalar(
        lambda x: -float(norm(2 * np.pi * x)),
        bounds=(peak * 0.99, peak * 1.01), method="bounded", options={"xatol": 1e-9},
    )
    assert found == pytest.approx(-best.fun, rel=1e-6)
