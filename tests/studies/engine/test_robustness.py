"""Margins and norms by frequency response against matrices of the loop, SciPy and brute force."""

from __future__ import annotations

from functools import cache, partial
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq, minimize, minimize_scalar

from jaxmodel.linear import linearise, resting
from jaxmodel.loop_figures import MARGINS, MOST_DELAY, PEAKS, guaranteed_range
from jaxmodel.prepare import prepare
from jaxmodel.robustness import _refined, coarse_norm, margin_at, norm_peaks, search_frequencies
from jaxmodel.sampled_loop import analogue_plant, closed_loop, delayed_loop
from jaxmodel.sampled_response import close_loop, command_gain
from jaxmodel.scaling import best_scaling
from studies.engine import diagonal_scaling, robustness
from studies.engine.delay_check import DelayedLoops
from studies.engine.loop_gain import loop_gains
from studies.engine.margins import judge_loops
from studies.engine.results import read_sweep
from studies.engine.robustness import (
    BATCH,
    _responses,
    find_margins,
    judge_robustness,
    response_and_modes,
)
from studies.engine.stability import _loops, with_margin_modes
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from studies.sweeps.show import ranked_cases
from studies.tuning import loop_figures
from studies.tuning.check import tuned_study
from studies.tuning.linear_fidelity import LinearFidelity
from studies.tuning.loop_figures import machine_figures, term_values
from studies.tuning.spec import LOOP_TERMS
from tests.bare import parse_sweep
from tests.canonical import MACHINE, study_of
from tests.sweeps import run_sweep
from tests.tunings import EACH, EVERY_KIND, GAIN, SMALL, tuning

#: Off home, where nothing is symmetric.
POSE = np.array([0.005, -0.003, 0.5])
STUDY = study_of(MACHINE)
PLANTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "loaded basis under load, electronics, two links": {
        "load__wrench": (3.0, -2.0, 0.1),
        "link__basis": "loaded",
        "electronics__sensor_highpass_hz": 2.0,
        "electronics__amplifier_hz": 3000.0,
        "control__links": (True, False, True),
    },
    "no reaction of bending": {"run__model": "ked"},
}
#: The last one in long tests alone.
CASES = [
    pytest.param(name, "imsc", id=name, marks=[pytest.mark.long] * ("no reaction" in name))
    for name in PLANTS
]


class Loop(NamedTuple):
    """A loop by frequency response, and by its matrices."""

    structure: Any
    case: Any
    response: Any  # NumPy
    modes: Any
    matrices: Any  # NumPy
    period: float

    @property
    def commands(self) -> slice:
        """Where the state holds the commands."""
        return slice(len(self.matrices.open) - 3 * self.structure.n_patches, None)


@cache
def loop_of(name: str, law: str = "imsc", factor: float = 0.5) -> Loop:
    """By the programs that judge sweeps."""
    study = STUDY.change(**PLANTS[name], control__law=law, control__gain_factor=factor)
    structure, case = with_margin_modes(build_structure(study), as_arrays(build_case(study)))
    case = posed(case, POSE)
    every = jax.tree.map(lambda x: np.stack([x] * BATCH), case)
    found = jax.tree.map(lambda x: np.asarray(x)[0], _responses(structure, False, every)[:2])
    at_rest = _loops(structure, False, case, POSE, None).at_rest
    matrices = jax.tree.map(lambda x: np.asarray(x)[0], at_rest)
    return Loop(structure, case, *found, matrices, float(case.electronics.period))


def posed(case: Any, pose: np.ndarray) -> Any:
    """The same at rest at another pose."""
    points = np.broadcast_to(pose, case.path.waypoints.shape)
    return case._replace(path=case.path._replace(waypoints=points))


def margins_of(loop: Loop, is_fine: bool = False) -> dict[str, float]:
    one = jax.tree.map(lambda x: x[None], (loop.response, loop.modes))
    places = find_margins(*one, MARGINS, is_fine)
    return {name: float(place.value[0]) for name, place in places.items()}


_peaks = jax.jit(norm_peaks, static_argnums=1)
_gain = jax.jit(command_gain)


def exact_gain(loop: Loop, omega: float) -> np.ndarray:
    """L by the matrices of the loop, opened where the controller writes its commands."""
    m, at = loop.matrices, loop.commands
    z = np.exp(1j * omega * loop.period)
    states = np.linalg.solve(z * np.eye(len(m.open)) - m.open, np.eye(len(m.open))[:, at])
    return -m.feedback[at] @ states


@pytest.mark.parametrize(("name", "law"), CASES)
def test_the_response_is_that_of_the_matrices(name, law):
    loop = loop_of(name, law)
    for hertz in (3.0, 114.4, 457.0, 2000.0, 4400.0):
        omega = 2 * np.pi * hertz
        found, wanted = _gain(loop.response, omega, 0.0), exact_gain(loop, omega)
        np.testing.assert_allclose(found, wanted, atol=1e-6 * np.abs(wanted).max())


@pytest.mark.parametrize(("name", "law"), [*CASES, ("plain", "lqr")])
def test_the_search_uses_the_same_response(name, law):
    """In NumPy, also with a further delay; 1e-4 with few images of the spectrum."""
    loop = loop_of(name, law)
    gains = loop_gains(jax.tree.map(lambda x: x[None], loop.response))
    omega = 2 * np.pi * np.array([3.0, 114.4, 457.0, 2000.0, 4400.0])
    acting = np.ix_(gains.acting, gains.acting)
    for delay in (0.0, 0.3):
        wanted = np.stack([np.asarray(_gain(loop.response, w, delay))[acting] for w in omega])
        scale = np.abs(wanted).max()
        late = np.full((1, len(omega)), delay)
        np.testing.assert_allclose(gains.exact(omega[None], late)[0], wanted, atol=1e-12 * scale)
        found = gains.at_delay(omega[None], late)[0]
        np.testing.assert_allclose(found, wanted, atol=1e-4 * scale)


_closed = jax.jit(close_loop)


def test_the_closed_loop_is_that_of_the_matrices():
    loop = loop_of("loaded basis under load, electronics, two links")
    m = loop.matrices
    for hertz in (114.4, 900.0):
        omega = 2 * np.pi * hertz
        z = np.exp(1j * omega * loop.period)
        closed = z * np.eye(len(m.open)) - m.open - m.feedback
        wanted = m.deflection @ np.linalg.solve(closed, m.force)
        found = _closed(loop.response, omega)
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
    for before, after in pairwise(held):
        closed[after, before] = np.eye(k)
    return radius(closed)


def analogue_of(loop: Loop) -> Any:
    if id(loop.matrices) not in _ANALOGUES:
        state, enters = map(np.asarray, _analogue(loop.structure, loop.case))
        _ANALOGUES[id(loop.matrices)] = AnaloguePlant(state, enters)
    return _ANALOGUES[id(loop.matrices)]


@partial(jax.jit, static_argnums=0)
def _analogue(structure, case):
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    plant = linearise(smooth, prepare(smooth, case).loop, POSE, resting(smooth, case))
    found = analogue_plant(smooth, plant, case)
    return found.state, found.enters


class AnaloguePlant(NamedTuple):
    state: np.ndarray
    enters: np.ndarray


_ANALOGUES: dict[int, AnaloguePlant] = {}

#: Laws with gain factors at which their loops are stable.
LOOPS = {"imsc": 0.5, "lqr": 0.5, "srf": 2e-4, "ppf": 0.5, "observer": 0.5, "lqg": 0.5}


#: Laws of the quick tests; each form of a controller compiles a program of its own.
QUICK = ("imsc", "lqr")


@pytest.mark.parametrize(
    "law", [pytest.param(x, marks=[] if x in QUICK else pytest.mark.long) for x in LOOPS]
)
def test_margins_are_where_a_pole_reaches_the_circle(law):
    """Commands turned, or late by exact discretisation: stable before, at the edge there."""
    loop = loop_of("plain", law, LOOPS[law])
    found = margins_of(loop)
    assert turned(loop, 1.0) < 1
    edge = np.deg2rad(found["phase_margin"])
    assert all(turned(loop, np.exp(1j * x)) < 1 for x in np.linspace(-0.9999, 0.9999, 12) * edge)
    if edge < np.pi:
        worst = max(turned(loop, np.exp(1j * sign * edge)) for sign in (1, -1))
        assert worst == pytest.approx(1, abs=1e-8)
    late = found["delay_margin"]
    assert all(delayed(loop, x) < 1 for x in np.linspace(0, 0.9999, 8) * late)
    if late < MOST_DELAY:
        wanted = brentq(lambda x: delayed(loop, x) - 1, late * 0.99, late * 1.01, xtol=1e-12)
        assert late == pytest.approx(wanted, rel=1e-6)


@pytest.mark.parametrize("factor", [1.1, 1.3])
def test_a_delay_margin_is_not_that_of_a_steep_slope_of_the_gain(factor):
    """Beside mode 2, at 486 Hz, |L| falls through 1 between two frequencies of the search."""
    loop = loop_of("plain", "lqr", factor)
    late = margins_of(loop)["delay_margin"]
    assert delayed(loop, 0.99 * late) < 1 < delayed(loop, 1.01 * late)


#: Designs whose links are nearly alike, so that eigenvalues of L nearly coincide; images of the
#: spectrum add up at other delays than at none.
ALIKE = {
    "neighbours": {
        "control__gain_factor": 0.2010975344982944,
        "machine__platform_mass": 0.2813991557922606,
        "electronics__antialias_hz": 4724.87507922483,
        "electronics__lowpass_ratio": [5.81108854, 1.58272912, 3.30750442],
        "electronics__highpass_hz": 133.40043867294227,
        "link__length": 0.17811059287295394,
        "link__damping_ratio": 0.001236226043434794,
        "drive__kp": 32480.75249726945,
    },
    "many crossings": {
        "control__law": "lqr",
        "control__gain_factor": 0.9530697938156152,
        "machine__platform_mass": 0.38166378484716545,
        "electronics__antialias_hz": 3316.79807931698,
        "electronics__highpass_hz": 138.9141974011503,
        "electronics__delay": 0.5,
        "link__length": 0.1754332135033722,
        "link__damping_ratio": 0.0023865921887462997,
        "drive__kp": 30465.015658572185,
    },
    "weak at once": {
        "control__gain_factor": 1.1952392952374062,
        "machine__platform_mass": 0.23304786297844768,
        "electronics__antialias_hz": 1954.2572420324022,
        "electronics__highpass_hz": 144.71568557315203,
        "electronics__delay": 0.25,
        "link__length": 0.17788684169120353,
        "link__damping_ratio": 0.0013903190431939726,
        "drive__kp": 26447.14684709405,
    },
}


@pytest.mark.long  # in short: where a pole reaches the circle, below
@pytest.mark.parametrize("name", ALIKE)
def test_no_delay_margin_is_missed(name):
    study = STUDY.change(**ALIKE[name])
    structure = build_structure(study)
    cases = jax.tree.map(lambda x: x[None], as_arrays(build_case(study)))
    found = judge_robustness(structure, cases, ("delay_margin",), np.array([2.0]))
    structure, cases = with_margin_modes(structure, cases)
    case, margin = jax.tree.map(lambda x: x[0], cases), found["delay_margin"][0]
    radii = [late_radius(structure, case, margin * x) for x in np.linspace(0.04, 0.99, 20)]
    assert max(radii) < 1 < late_radius(structure, case, 1.01 * margin)


def late_radius(structure: Any, case: Any, delay: float) -> float:
    """Spectral radius of the loop under more delay."""
    return radius(np.asarray(_late(structure, case, delay)))


@partial(jax.jit, static_argnums=0)
def _late(structure, case, delay):
    law = prepare(structure, case).loop.controller
    return delayed_loop(structure, case, case.path.waypoints[0], law, delay)


@pytest.mark.parametrize(  # of a drive by analogue electronics: in short above
    "kind", [pytest.param("pd", marks=pytest.mark.long), "super_twisting"]
)
def test_poles_of_a_later_loop_are_those_of_its_delay(kind):
    """A plant on a sampled drive moves freely, which has no eigenvectors of its own."""
    study = STUDY.change(drive__kind=kind)
    structure, case = with_margin_modes(build_structure(study), as_arrays(build_case(study)))
    cases = jax.tree.map(lambda x: np.stack([x] * BATCH), case)
    loops = DelayedLoops.of(_responses(structure, True, cases)[2], cases.electronics)
    for delay in (0.0, 0.3, 1.0, 2.625):
        wanted = np.log(late_radius(structure, case, delay))
        assert loops.growth(0, delay) == pytest.approx(wanted, abs=1e-10)


_best = jax.jit(best_scaling)


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


def test_a_peak_between_points_is_found_with_its_height():
    """Of a parabola; the height at the nearest point of an interval that is halved three times."""
    refined = jax.jit(lambda w: _refined(lambda w: 3 - (w - 1.23) ** 2, w, 3))
    place, height = refined(np.linspace(0, 5, 11))
    assert float(place) == pytest.approx(1.23, abs=1e-9)
    spacing = 1.0 / 4 / 2**3
    assert 3 - (spacing / 2) ** 2 <= float(height) <= 3


def test_a_coarse_norm_is_high_by_a_root_of_the_size_at_most():
    """Sixty-four powers of A'A: the trace has all n singular values, the norm one."""
    rng = np.random.default_rng(4)
    coarse = jax.jit(coarse_norm)
    for n in (1, 2, 7):
        matrix = rng.normal(size=(n, n)) * 10.0**n + 1j * rng.normal(size=(n, n))
        ratio = coarse(matrix) / np.linalg.norm(matrix, 2)
        assert 1 - 1e-9 < ratio < n ** (1 / 128) + 1e-9


@pytest.mark.parametrize("sizes", [(3, 9), pytest.param((15,), marks=pytest.mark.long)])
def test_the_scaling_is_the_best_one(sizes):
    rng = np.random.default_rng(1)
    for n in sizes:
        matrix = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        matrix *= np.exp(2 * rng.normal(size=(n, 1)))
        found = _best(matrix)
        assert float(found.bound) == pytest.approx(smallest_norm(matrix), rel=1e-6)
        change = rng.normal(size=(n, n)) + 1j * rng.normal(size=(n, n))
        ends = [float(_best(matrix + h * change).bound) for h in (1e-5, -1e-5)]
        slope = np.real(np.sum(np.conj(found.slope) * change))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4)
        searched, log = diagonal_scaling.best_scaling(matrix[None])
        assert found.bound * (1 - 1e-9) <= searched[0] <= found.bound * (1 + 1e-4)
        norm = np.linalg.norm(matrix * np.exp(log[0][:, None] - log[0]), 2)
        assert norm == pytest.approx(searched[0], rel=1e-9)


def test_the_slope_of_a_bound_where_singular_values_coincide():
    """Of the best scaling, two of which are then largest, against differences."""
    for seed, n in ((8, 3), (5, 4), (4, 6), (7, 6)):
        rng = np.random.default_rng(seed)
        matrix = rng.normal(size=(n, n)) * (1 - np.eye(n)) + 0.2 * (seed % 2) * np.eye(n)
        found, change = _best(matrix + 0j), rng.normal(size=(n, n))
        x = np.asarray(found.log_scale)
        largest = np.linalg.svd(matrix * np.exp(x[:, None] - x))[1][:2]
        assert largest[1] == pytest.approx(largest[0], rel=1e-6)
        ends = [float(_best(matrix + h * change + 0j).bound) for h in (1e-5, -1e-5)]
        slope = np.real(np.sum(np.conj(found.slope) * change))
        assert slope == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-3)
    # sqrt(m12 m21)
    slope = _best(np.array([[0, 4.0], [1.0, 0]]) + 0j).slope
    np.testing.assert_allclose(slope, [[0, 0.25], [1.0, 0]], rtol=1e-5, atol=1e-9)


@pytest.mark.parametrize("law", ["imsc", "lqr"])
def test_the_disk_margin_is_the_smallest_over_all_frequencies(law):
    loop = loop_of("plain", law, LOOPS[law])
    found = margins_of(loop, is_fine=True)["disk_margin"]

    def excess(omega: float) -> np.ndarray:
        gain = exact_gain(loop, omega)
        return np.linalg.inv(np.eye(len(gain)) + gain) - np.eye(len(gain)) / 2

    def balanced(omega: float) -> float:
        return float(np.linalg.norm(diagonal_scaling.balanced(excess(omega)[None])[0], 2))

    omega = np.asarray(jax.jit(search_frequencies)(loop.response))
    rough = np.array([balanced(x) for x in omega])
    peaks = np.argsort(-rough)[:12]
    exact = {k: float(_best(excess(omega[k])).bound) for k in peaks}
    assert 1 / found >= max(exact.values()) * (1 - 1e-9)
    best = max(exact, key=lambda k: exact[k])
    at = minimize_scalar(
        lambda x: -float(_best(excess(x)).bound),
        bounds=(omega[best - 1], omega[best + 1]),
        method="bounded",
        options={"xatol": 1e-7},
    )
    assert found == pytest.approx(-1 / at.fun, rel=1e-6)
    assert smallest_norm(excess(at.x)) == pytest.approx(1 / found, rel=1e-6)


def test_no_perturbation_inside_the_disk_breaks_the_loop():
    """By the eigenvalues of the matrices with random errors of the actuators as large as it."""
    loop, rng = loop_of("plain"), np.random.default_rng(2)
    alpha = margins_of(loop, is_fine=True)["disk_margin"]
    m, at = loop.matrices, loop.commands
    count = 3 * loop.structure.n_patches

    for _ in range(12):
        delta = 0.999 * alpha * np.exp(2j * np.pi * rng.random(count))
        closed = (m.open + m.feedback).astype(complex)
        closed[at] *= ((1 + delta / 2) / (1 - delta / 2))[:, None]
        assert radius(closed) < 1


def test_peaks_are_those_of_singular_values():
    loop, names = loop_of("plain"), [name.removesuffix("_peak") for name in PEAKS]
    found = _peaks(loop.response, PEAKS)

    @jax.jit
    def norms(omega):
        closed = close_loop(loop.response, omega)
        each = [jnp.linalg.svd(getattr(closed, x), compute_uv=False)[0] for x in names]
        return jnp.stack(each)

    hertz = np.geomspace(0.5, 4990, 3000)
    values = np.array(jax.lax.map(norms, 2 * np.pi * hertz))
    for k, name in enumerate(PEAKS):
        peak = hertz[values[:, k].argmax()]
        best = minimize_scalar(
            lambda x, k=k: -float(norms(2 * np.pi * x)[k]),
            bounds=(peak * 0.99, peak * 1.01),
            method="bounded",
            options={"xatol": 1e-9},
        )
        assert float(found[name]) == pytest.approx(-best.fun, rel=1e-6), name


def test_a_delay_shortens_margins_by_its_share():
    """By differences, and the delay margin by as much as the delay."""
    loop = loop_of("plain", factor=1.0)

    def delayed(x):
        plant = loop.response.plant
        return loop.response._replace(plant=plant._replace(delay=plant.late + 0.3 + x))

    def places(x):
        one = jax.tree.map(lambda x: np.asarray(x)[None], (delayed(x), loop.modes))
        return jax.tree.map(lambda x: x[0], find_margins(*one, MARGINS, is_fine=True))

    names, step = ("phase_margin", "delay_margin"), 1e-4
    here, high, low = places(0.0), places(step), places(-step)

    @jax.jit
    @jax.jacfwd
    def slopes(x):
        return jnp.stack([margin_at(delayed(x), name, here[name]) for name in names])

    wanted = [(high[name].value - low[name].value) / (2 * step) for name in names]
    np.testing.assert_allclose(slopes(0.0), wanted, rtol=1e-4)
    assert wanted[1] == pytest.approx(-1.0, rel=1e-6) and abs(wanted[0]) > 1


@pytest.mark.long
def test_gradients_are_those_of_differences():
    """By gains, drive and placement of all figures."""
    loop = loop_of("plain", "lqr", LOOPS["lqr"])
    structure, case = loop.structure, jax.tree.map(jnp.asarray, loop.case)

    @jax.jit
    def response(x):
        control = case.control._replace(gain_factor=case.control.gain_factor * x[0])
        drive = case.drive._replace(kp=case.drive.kp * x[1])
        patches = case.machine.patches
        patches = patches._replace(center=patches.center * x[2])
        machine = case.machine._replace(patches=patches)
        changed = case._replace(control=control, drive=drive, machine=machine)
        loop = prepare(structure, changed).loop
        return response_and_modes(structure, changed, loop, POSE)

    def places(x):
        one = jax.tree.map(lambda x: np.asarray(x)[None], response(x))
        found = find_margins(*one, MARGINS, is_fine=True)
        return jax.tree.map(lambda x: x[0], found)

    @jax.jit
    def figures(x, places):
        found = norm_peaks(response(x)[0], PEAKS)
        found |= {name: margin_at(response(x)[0], name, places[name]) for name in MARGINS}
        return jnp.log(jnp.stack([found[name] for name in (*MARGINS, *PEAKS)]))

    slope = jax.jit(jax.jacrev(figures))(jnp.ones(3), places(jnp.ones(3)))
    step = 1e-5
    for k, unit in enumerate(np.eye(3)):
        ends = [1 + sign * step * unit for sign in (1, -1)]
        high, low = (np.asarray(figures(x, places(x))) for x in ends)
        np.testing.assert_allclose(slope[:, k], (high - low) / (2 * step), rtol=1e-4, atol=1e-5)


def test_of_modes_that_act_one_at_a_time_the_worst_figures_count(monkeypatch):
    """Of each of two loops: the smaller margin and the larger peak, whichever mode has it."""
    study = STUDY.change(control__law="modified_imsc", control__modes=2)
    structure = build_structure(study)
    cases = build_cases(study, {"control.gain_factor": np.array([0.1, 0.2])}, structure)
    parts = [
        {"disk_margin": np.array([0.5, 0.9]), "sensitivity_peak": np.array([2.0, 4.0])},
        {"disk_margin": np.array([0.7, 0.2]), "sensitivity_peak": np.array([3.0, 1.5])},
    ]
    made_up = iter(parts)
    monkeypatch.setattr(robustness, "_figures_of", lambda *_: next(made_up))
    found = judge_robustness(structure, cases, tuple(parts[0]), np.array([2.0, 2.0]))
    assert next(made_up, None) is None
    np.testing.assert_array_equal(found["disk_margin"], [0.5, 0.2])
    np.testing.assert_array_equal(found["sensitivity_peak"], [3.0, 4.0])


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "patches", "links"),
    [
        ("imsc", 1, (True, False, False)),
        ("srf", 5, (True, True, False)),
        pytest.param("modified_imsc", 3, (True, True, True)),
        pytest.param("lqg", 5, (False, True, True)),
        pytest.param("observer", 3, (True, True, True)),
    ],
)
def test_every_law_is_judged(law, patches, links):
    """Through the sweep's judgement; margins of unstable loops are 0, peaks infinite."""
    centers = np.linspace(0.2, 0.8, patches) * STUDY.link.length if patches > 1 else [0.1]
    size = 0.5 * STUDY.link.length / 6
    study = STUDY.change(
        control__law=law,
        control__links=links,
        control__modes=min(patches, 2),
        patches__centers=[list(map(float, centers))] * 3,
        patches__actuator_length=size,
        patches__sensor_length=size / 2,
        control__ratios=[[1.0, 0.3][: min(patches, 2)]] * 3,
    )
    factors = np.array([0.0, 1e-3, 1e3])
    structure = build_structure(study)
    cases = build_cases(study, {"control.gain_factor": factors}, structure)
    margin = judge_loops(structure, cases).gain_margin
    found = judge_robustness(structure, cases, MARGINS, margin)
    is_stable = margin >= 1
    assert is_stable[0]
    for name, most in zip(MARGINS, (2.0, 180.0, MOST_DELAY), strict=True):
        assert found[name][0] == pytest.approx(most, rel=1e-6)
        assert (found[name][is_stable] > 0).all()
        assert (found[name] <= most * (1 + 1e-6)).all()
        assert (found[name][~is_stable] == 0).all()


@pytest.mark.long
@pytest.mark.parametrize("law", ["imsc", "lqr"])
def test_no_margin_of_random_loops_is_too_large(law):
    """50 loops of each law: stable up to 0.99 of a margin, mostly unstable beyond it."""
    count, rng = 50, np.random.default_rng(4)
    study = STUDY.change(control__law=law)
    columns = {
        "control.gain_factor": np.exp(rng.uniform(np.log(0.05), np.log(0.8), count)),
        "machine.platform_mass": rng.uniform(0.1, 0.4, count),
        "electronics.antialias_hz": rng.uniform(1500.0, 4500.0, count),
    }
    structure = build_structure(study)
    cases = build_cases(study, columns, structure)
    structure, cases = with_margin_modes(structure, as_arrays(cases))
    cases = jax.tree.map(lambda x: np.broadcast_to(x, (count, *np.shape(x)[1:])), cases)

    @jax.jit
    @jax.vmap
    def every(case):
        found = response_and_modes(structure, case, prepare(structure, case).loop, POSE)
        return *found, closed_loop(structure, case, POSE), _analogue(structure, case)

    response, modes, matrices, analogue = jax.tree.map(np.asarray, every(cases))
    places = find_margins(response, modes, MARGINS)
    edges = is_early = 0
    for k in range(count):
        part = jax.tree.map(lambda x, k=k: x[k], (response, modes, matrices))
        loop = Loop(structure, None, *part, float(cases.electronics.period[k]))
        _ANALOGUES[id(loop.matrices)] = AnaloguePlant(*(x[k] for x in analogue))
        if turned(loop, 1.0) >= 1:
            continue
        phase = np.deg2rad(places["phase_margin"].value[k])
        late = places["delay_margin"].value[k]
        for share in (0.5, 0.8, 0.9, 0.95, 0.99):
            assert turned(loop, np.exp(1j * share * phase)) < 1
            assert turned(loop, np.exp(-1j * share * phase)) < 1
            assert delayed(loop, share * late) < 1
        if phase < np.pi:
            edges += 1
            assert max(turned(loop, np.exp(1j * x * phase)) for x in (1.001, -1.001)) > 1
        is_early += bool(late < MOST_DELAY and delayed(loop, 1.001 * late) < 1)
        del _ANALOGUES[id(loop.matrices)]
    assert edges > count // 2
    assert is_early == 0


def test_what_a_disk_margin_guarantees():
    gain, phase = guaranteed_range(np.array([0.0, 1.0, 2.0]))
    np.testing.assert_allclose(gain, [0.0, 20 * np.log10(3.0), np.inf])
    np.testing.assert_allclose(phase, [0.0, 2 * np.rad2deg(np.arctan(0.5)), 90.0])


def linear_tuning(limits, objective):
    """Loops of four designs on two machines, and what they do where the first gain moves."""
    spec = tuning(
        {**GAIN, "drive.kp": EVERY_KIND["drive.kp"]},
        limits=limits,
        objective=objective,
        scenarios={"count": 2, "spread": {"control.velocity_gain[0]": 20.0}, **EACH},
    )
    linear = LinearFidelity(spec, [spec.families[0]] * 4)
    step = np.array([2e-3, 0.0])  # peaks are found to 1e-6
    steps = np.stack([0 * step, step, -step])
    designs = np.concatenate([[0.4, 2e4] * (1 + steps), [[200.0, 2e4]]])
    found = linear.evaluate(designs)

    def check(values, slopes):
        wanted = (values[1] - values[2]) / (designs[1, 0] - designs[2, 0])
        np.testing.assert_allclose(slopes[0, ..., 0], wanted, rtol=1e-4, atol=1e-6)

    check(found.limits, found.limit_slopes)
    check(found.terms, found.term_slopes)
    assert np.isfinite(found.limit_slopes).all()
    assert (found.limits[3] > 0).all()  # unstable
    assert np.isnan(found.terms[3]).all() and np.isfinite(found.terms[:3]).all()
    return spec, linear, designs, found


def test_the_worst_machine_counts_in_tunings(monkeypatch):
    """With its derivatives, and each machine's own in an objective; the nominal one is better."""
    monkeypatch.setattr(loop_figures, "MARGIN_MODES", 4)
    spec, linear, designs, found = linear_tuning({"disk_margin": 0.8}, {"disk_margin": 1.0})
    assert linear.machines.of_scenario.tolist() == [0, 1, 0, 1]
    np.testing.assert_array_equal(found.terms[:, 0], found.terms[:, 2])  # moves do not matter
    nominal, other = found.terms[0, :2, 0]
    x = 1 - min(nominal, other) / 0.8
    np.testing.assert_allclose(found.limits[0, 0], x / (1 + abs(x)), rtol=1e-9)
    worst = int(other < nominal)
    chained = -found.term_slopes[0, worst, 0] / 0.8 / (1 + abs(x)) ** 2
    np.testing.assert_allclose(found.limit_slopes[0, 0], chained, rtol=1e-9)
    assert worst == 1 and other < 0.999 * nominal
    assert np.abs(found.term_slopes[0, 0] / found.term_slopes[0, 1] - 1).min() > 1e-3
    beyond = linear.beyond(0, designs)
    assert (beyond[:3] < 0).all() and beyond[3] == 1.0


@pytest.mark.long
def test_figures_of_tunings_have_the_gradients_of_differences(monkeypatch):
    """Of every figure, also of an unstable design, whose limits are violated."""
    monkeypatch.setattr(loop_figures, "MARGIN_MODES", 4)
    limits = {
        "disk_margin": 0.8,
        "phase_margin": 40.0,
        "delay_margin": 1.0,
        "sensitivity_peak": 1.5,
        "control_effort_peak": 20.0,
        "disturbance_deflection_peak": 5e-5,
    }
    linear_tuning(limits, dict.fromkeys(LOOP_TERMS, 1.0))


@pytest.mark.long
def test_programs_of_tunings_have_the_figures_of_the_host():
    """On every machine, with all its modes: derivatives come with values that judge results."""
    names = dict.fromkeys(LOOP_TERMS, 1.0)
    spec, linear, designs, found = linear_tuning({}, names)
    np.testing.assert_allclose(linear.plain_terms(0, designs)[:3], found.terms[:3], rtol=1e-4)
    study = tuned_study(spec, spec.families[0], designs[0])
    figures = machine_figures(spec, study, linear.machines.columns, tuple(names))
    own = term_values(tuple(names), figures, linear.machines.of_scenario)
    np.testing.assert_allclose(own, found.terms[0], rtol=1e-4)
    baseline = np.tile(spec.free.values(spec.free.places()), (4, 1))
    np.testing.assert_allclose(linear.evaluate(baseline).terms[0], linear.baseline_terms, rtol=1e-4)


@pytest.mark.long
def test_a_sweep_keeps_the_figures_that_it_names(tmp_path):
    data = dict(SMALL) | {
        "sweep": {
            "axes": {"control.gain_factor": [0.1, 0.3]},
            "metrics": ["residual_rms"],
            "robustness": ["disk_margin", "sensitivity_peak"],
        }
    }
    run_sweep(parse_sweep(data), tmp_path / "sweep")
    found = read_sweep(tmp_path / "sweep")
    assert "phase_margin" not in found.variables
    assert (np.diff(found["disk_margin"]) < 0).all()
    assert (found["sensitivity_peak"] > 1).all()
    best = ranked_cases(found, "disk_margin", "sensitivity_peak > 1")
    assert list(best) == [0, 1]


def test_figures_that_no_sweep_has_are_named():
    data = dict(SMALL) | {
        "sweep": {"axes": {"control.modes": [1, 2]}, "robustness": ["disc_margin"]}
    }
    with pytest.raises(StudyError, match="sweep.robustness = 'disc_margin'.*disk_margin"):
        parse_sweep(data)
    data["sweep"]["robustness"] = ["disk_margin", "disk_margin"]
    with pytest.raises(StudyError, match="sweep.robustness = 'disk_margin'.*once"):
        parse_sweep(data)
