"""Gain margins of batches: return difference and loci against the eigenvalues of the loop."""

from __future__ import annotations

import tomllib
from functools import cache
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.damping import least_controlled
from jaxmodel.judge import LEAST_DAMPED, _respond
from jaxmodel.laws import n_channels
from jaxmodel.loci import FrequencyPoint, follow_loci, start_loci
from jaxmodel.loop_figures import HIGHEST, LOWEST
from jaxmodel.pairs import Pair
from jaxmodel.return_difference import (
    characteristic_polynomial,
    controlled_first,
    evaluate_loop_gain,
)
from jaxmodel.steps import scan_steps
from studies.engine import margins, steps
from studies.engine.eigenvalues import eigenvalues
from studies.engine.margins import judge_loops
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import read_sweep
from studies.engine.stability import loop_report, with_margin_modes
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from studies.sweeps.show import ranked_cases
from tests.bare import parse_sweep
from tests.canonical import MACHINE, study_of
from tests.jaxmodel.test_notch import NOTCHES
from tests.loops import Loops, exact_margins, matrices, random_loops
from tests.sweeps import FAST_MOVE, run_sweep

STUDY = study_of(MACHINE)
HOME = np.array(STUDY.motion.waypoints[0])
#: Poses off home, where nothing is symmetric.
POSE = np.array([0.005, -0.003, 0.5])
PLANTS = {
    "plain": {},
    "under load": {"load__wrench": (3.0, -2.0, 0.1)},
    "loaded basis under load": {"load__wrench": (3.0, -2.0, 0.1), "link__basis": "loaded"},
    # modes between held ends are others than the basis: its damping ties them, which is left out
    "free ends": {"link__basis": "pinned_free", "link__damping_ratio": (1e-4,)},
    "free ends under load": {
        "load__wrench": (3.0, -2.0, 0.1),
        "link__basis": "pinned_free",
        "link__damping_ratio": (1e-4,),
    },
    "no reaction of bending": {"run__model": "ked"},
    "locked": {"drive__locked": True},
    "electronics": {"electronics__sensor_highpass_hz": 2.0, "electronics__amplifier_hz": 3000.0},
    "strain rate feedback": {"control__law": "srf", "control__gain_factor": 1e-3},
    "friction": {"drive__coulomb_friction": 0.5},
    "one mode": {"control__modes": 1},
    # all terms of the others are in these two, the first one of them with a delay and notch filters
    "free ends under load, electronics, strain rate feedback": {
        **{f"control__{x}": y for x, y in NOTCHES.items()},
        "electronics__delay": 2.625,
        "load__wrench": (3.0, -2.0, 0.1),
        "link__basis": "pinned_free",
        "link__damping_ratio": (1e-4,),
        "electronics__sensor_highpass_hz": 2.0,
        "electronics__amplifier_hz": 3000.0,
        "control__law": "srf",
        "control__gain_factor": 1e-3,
    },
}


def looked_at(study, pose):
    """The study's loop at rest at a pose, as a batch of one."""
    structure, case = build_structure(study), build_case(study)
    cases = jax.tree.map(lambda x: np.asarray(x)[None], case)
    points = np.broadcast_to(pose, cases.path.waypoints.shape)
    return with_margin_modes(structure, cases._replace(path=cases.path._replace(waypoints=points)))


def response_of(structure, cases):
    """Of the first case, lanes last."""
    return jax.tree.map(np.asarray, responding(structure)(jax.tree.map(lambda x: x[:1], cases)))


@cache
def responding(structure):
    return jax.jit(jax.vmap(lambda case: _respond(structure, case)[0], out_axes=-1))


@jax.jit
def determinant(response, omega, factor):
    """det(I - k L(j omega)) from det(x - L), x = 1/k."""
    omega, factor = omega + 0 * response.period, factor + 0 * response.period
    angle = omega * response.period
    gain = evaluate_loop_gain(
        response, Pair(0 * omega, omega), Pair(jnp.cos(angle), -jnp.sin(angle))
    )
    found = characteristic_polynomial(gain, Pair(1 / factor, 0 * factor))
    return (found.re + 1j * found.im) * factor ** (response.velocity_gain[..., 0].size)


#: Plants of the quick tests: all terms of the others are in them.
QUICK = ("free ends under load, electronics, strain rate feedback", "loaded basis under load")


@pytest.mark.parametrize(
    "name", [pytest.param(x, marks=[] if x in QUICK else pytest.mark.long) for x in PLANTS]
)
def test_return_difference_is_that_of_the_matrices(name):
    points = ((3.0, 1.0), (114.4, 1.0), (500.0, 2.0), (722.0, 1.0), (4400.0, 0.5))
    assert_return_difference(STUDY.change(**PLANTS[name]), points)


def assert_return_difference(study, points):
    """At frequencies [Hz] and factors on the gains."""
    structure, cases = looked_at(study, POSE)
    (opened,), (feedback,) = matrices(structure, cases)
    response, eye = response_of(structure, cases), np.eye(len(opened))
    for hertz, factor in points:
        z = np.exp(2j * np.pi * hertz * float(response.period[0]))
        closed = np.linalg.slogdet(eye * z - opened - factor * feedback)
        alone = np.linalg.slogdet(eye * z - opened)
        wanted = closed[0] / alone[0] * np.exp(closed[1] - alone[1])
        found = determinant(response, 2 * np.pi * hertz, factor)
        # images of the spectrum that are left out
        np.testing.assert_allclose(complex(found[0]), wanted, rtol=3e-4)


def test_the_return_difference_has_positions_as_they_are_measured():
    """Differences take them without a filter; at high frequencies images of the spectrum matter."""
    study = STUDY.change(control__law="lqr", electronics__estimator="difference")
    assert_return_difference(study, ((3.0, 1.0), (114.4, 0.5), (250.0, 0.5)))


#: Forces against soft drives with hardly any damping.
LOADED = {
    "load__wrench": (30.0, -20.0, 0.5),
    "link__basis": "loaded",
    "drive__kp": 5e3,
    "drive__kd": 0.1,
}


@pytest.mark.parametrize("sign", [1, -1])
def test_the_return_difference_has_the_stiffness_of_the_load(sign):
    """Beside the drives' resonances, which the load moves by half a percent with either sign."""
    wrench = tuple(sign * x for x in LOADED["load__wrench"])
    study = STUDY.change(**(LOADED | {"load__wrench": wrench}))
    assert_return_difference(study, ((24.7, 8.0), (25.3, 8.0), (27.9, 8.0), (114.4, 1.0)))


def assert_margins(found, wanted):
    """No verdict wrong; margins within 2 %."""
    np.testing.assert_array_equal(found > 1, wanted > 1)
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=1.02 * LOWEST)


def test_margins_of_random_loops():
    loops = random_loops(16, 5)
    wanted = exact_margins(loops)
    assert_margins(judge_loops(*loops).gain_margin, wanted)
    # neither all stable nor all unstable
    assert 3 < np.sum(wanted > 1) < 13


def too_strong(loops, seed, decades):
    """The same with gains up to so many decades larger."""
    control, rng = loops.cases.control, np.random.default_rng(seed)
    factor = 10 ** rng.uniform(0, decades, len(control.gain_factor))
    control = control._replace(gain_factor=control.gain_factor * factor)
    return loops._replace(cases=loops.cases._replace(control=control))


def test_margins_of_strain_rate_feedback_do_not_depend_on_the_gain_factor():
    """A margin times the factor is the largest factor; at 5 Hz such a loop is not weak any more."""
    study = STUDY.change(
        **PLANTS[QUICK[0]],
        control__velocity_gain=(0.0183, 0.0207, 0.0201),
        electronics__highpass_hz=7.25,
        electronics__lowpass_ratio=(0.874, 2.0, 2.0),
        drive__kp=4000.0,
        drive__kd=300.0,
    )
    factors = np.array([0.1, 0.3, 0.559, 1.3, 3.0])
    structure = build_structure(study)
    cases = build_cases(study, {"control.gain_factor": factors}, structure)
    found = judge_loops(structure, cases)
    largest = found.gain_margin * factors
    np.testing.assert_allclose(largest, largest[0], rtol=0.02)
    assert largest[0] < HIGHEST * factors[0]
    np.testing.assert_allclose(found.breaking_frequency, found.breaking_frequency[0], rtol=0.02)


def test_margins_of_loops_much_too_strong():
    """As of a law whose gains have another unit than the study's."""
    loops = too_strong(random_loops(16, 8), 8, 5)
    wanted = exact_margins(loops)
    assert_margins(judge_loops(*loops).gain_margin, wanted)
    assert np.sum(wanted < 1e-3) > 3


@pytest.mark.long
def test_margins_of_two_hundred_loops_much_too_strong():
    """One verdict is wrong: that loop grows by 1e-6 a sample over a small range of gains."""
    loops = too_strong(random_loops(200, 7), 7, 6)
    found, wanted = judge_loops(*loops).gain_margin, exact_margins(loops)
    is_close = np.isclose(found, wanted, rtol=0.02, atol=1.02 * LOWEST)
    assert np.mean(~is_close) < 0.03
    is_wrong = (found > 1) != (wanted > 1)
    assert np.sum(is_wrong) <= 1
    for k in np.flatnonzero(is_wrong):
        one = loops._replace(cases=jax.tree.map(lambda x, k=k: x[k : k + 1], loops.cases))
        assert largest_growth(one, np.linspace(0, 0.98 * found[k], 200)) < 1e-5


def largest_growth(loops, factors):
    """Of one loop at these factors of its gains, per sample."""
    opened, feedback = (x[0] for x in matrices(*with_margin_modes(*loops)))
    poles = np.linalg.eigvals(opened + factors[:, None, None] * feedback)
    return np.abs(poles).max() - 1


@pytest.mark.long
@pytest.mark.parametrize("seed", range(4))
def test_margins_of_a_thousand_random_loops(seed):
    """Links that are all but alike have crossings side by side: one in 500 is taken for another."""
    loops = random_loops(250, 100 + seed)
    found, wanted = judge_loops(*loops).gain_margin, exact_margins(loops)
    np.testing.assert_array_equal(found > 1, wanted > 1)
    error = np.abs(found / wanted - 1)[wanted > 0]
    assert np.sum(error > 0.02) <= 1 and error.max() < 0.1


def exact_poles(loops):
    """All poles of each loop [1/s], by eigenvalues."""
    wide = with_margin_modes(*loops)
    opened, feedback = matrices(*wide)
    period = np.broadcast_to(np.asarray(wide[1].electronics.period), (len(opened),))
    with np.errstate(all="ignore"):
        return [
            np.log(np.linalg.eigvals(a + b).astype(complex)) / t
            for a, b, t in zip(opened, feedback, period, strict=True)
        ]


def check_damping(loops):
    """Ratios are those of poles that the loops have, wherever they were found; share of those."""
    found, poles = judge_loops(*loops), exact_poles(loops)
    orders = np.broadcast_to(np.asarray(loops.cases.control.n_active), (len(poles),))
    looked, missing = 0, 0
    for k in np.flatnonzero(found.gain_margin > 1):
        is_pole = np.isfinite(poles[k]) & (np.abs(poles[k]) > 0)
        ratio = -poles[k][is_pole].real / np.abs(poles[k][is_pole])
        for order in range(int(orders[k])):
            mine = found.least_damping[k, order]
            looked, missing = looked + 1, missing + int(np.isnan(mine))
            assert np.isnan(mine) or np.abs(ratio - mine).min() < 1e-3 * mine
    return 1 - missing / looked


def test_damping_ratios_are_those_of_the_loops_poles():
    assert check_damping(random_loops(28, 3)) > 0.98


@pytest.mark.long
def test_damping_ratios_of_five_hundred_random_loops():
    assert check_damping(random_loops(500, 900)) > 0.99


def test_damping_ratio_follows_the_modes():
    """As the report of one run has it: the same modes, followed by eigenvalues."""
    structure, case = build_structure(STUDY), as_arrays(build_case(STUDY))
    wanted = loop_report(structure, case, HOME).damping_ratio[:3]
    found = single_damping(STUDY)
    np.testing.assert_allclose(found, wanted.min(axis=1), rtol=2e-3)
    one = single_damping(STUDY.change(control__links=(False, True, False)))
    assert np.all(np.abs(one / found - 1) < 0.3)  # of the link under control, not of the others
    assert np.isnan(single_damping(STUDY.change(control__links=(False, False, False)))).all()


#: Of steel: the drives' own modes, 33 to 46 Hz and well damped, beside the first bending modes.
STEEL = STUDY.change(
    machine__platform_mass=0.6,
    link__length=0.28,
    link__thickness=1.5e-3,
    link__width=20e-3,
    link__density=7850.0,
    link__youngs_modulus=200e9,
    patches__centers=(0.04, 0.12, 0.21),
    patches__width=20e-3,
)


def test_modes_are_told_from_drives_as_quick_as_they():
    structure, case = build_structure(STEEL), as_arrays(build_case(STEEL))
    loop = loop_report(structure, case, HOME)
    spans = [(43.0, 47.0), (175.0, 180.0), (394.0, 396.0)]
    for frequency, (low, high) in zip(loop.frequency_hz, spans, strict=True):
        assert np.all((frequency > low) & (frequency < high))
    assert loop.damping_ratio[0].max() < 0.28  # the drives' are 0.29 to 0.43
    poles = exact_poles(Loops(structure, jax.tree.map(lambda x: np.asarray(x)[None], case)))[0]
    for frequency, ratio in zip(loop.frequency_hz.ravel(), loop.damping_ratio.ravel(), strict=True):
        pole = 2 * np.pi * frequency * (-ratio + 1j * np.sqrt(1 - ratio**2))
        assert np.nanmin(np.abs(poles - pole)) < 1e-3 * abs(pole)
    every, one = (True, True, True), (False, True, False)
    for gain, links, stiffness in ((1.0, every, 2e4), (0.5, one, 2e4), (1.0, every, 1e4)):
        study = STEEL.change(control__gain_factor=gain, control__links=links, drive__kp=stiffness)
        case = as_arrays(build_case(study))
        wanted = loop_report(structure, case, HOME).damping_ratio
        least = least_controlled(wanted.T, np.full(3, sum(links)))
        np.testing.assert_allclose(single_damping(study), least, rtol=2e-3)


def test_weak_control_is_judged_without_eigenvalues():
    """Equal links at home have equal poles, and weak gains hardly move them."""
    with mock.patch("studies.engine.margins.loop_report") as by_eigenvalues:
        for gain in (0.0, 1e-3, 1.0):
            assert np.all(single_damping(STUDY.change(control__gain_factor=gain)) > 0.005)
    assert not by_eigenvalues.called


def single_damping(study):
    structure, case = build_structure(study), build_case(study)
    found = judge_loops(structure, jax.tree.map(lambda x: np.asarray(x)[None], case))
    return found.least_damping[0]


def test_idle_links_cost_nothing_and_change_nothing():
    """Loops whose idle links have no channels, beside the same ones with channels of gain 0."""
    study = STUDY.change(control__links=(False, True, True))
    structure, cases = looked_at(study, POSE)
    whole = response_of(structure, cases)
    mask = np.array([[0.0], [1.0], [1.0]])
    fewer = controlled_first(whole, mask, 2)
    assert fewer.velocity_gain.shape[0] == 2 and np.all(fewer.velocity_gain != 0)
    angle = 700.0 * whole.period
    at = Pair(0 * angle, 700.0 + 0 * angle), Pair(np.cos(angle), -np.sin(angle))
    x = Pair(0.3 + 0 * angle, 0.1 + 0 * angle)
    polynomial = jax.jit(lambda one: characteristic_polynomial(evaluate_loop_gain(one, *at), x))
    found, wanted = polynomial(fewer), polynomial(whole)
    idle = (0.3 + 0.1j) ** n_channels(structure)  # eigenvalues 0
    np.testing.assert_allclose(
        (found.re + 1j * found.im) * idle, wanted.re + 1j * wanted.im, rtol=1e-9
    )


@pytest.mark.long  # in short: steps over lanes by the scan, in test_equations
def test_scan_gives_the_same_as_kernels(monkeypatch):
    loops = random_loops(24, 5)
    is_single = np.sum(loops.cases.control.link_mask, axis=1) == 1  # the smallest programs
    assert np.sum(is_single) > 3
    loops = loops._replace(cases=jax.tree.map(lambda x: x[is_single], loops.cases))
    kernels = judge_loops(*loops)
    steps._PROGRAMS.clear()
    monkeypatch.setattr(steps.llvm, "is_available", lambda: False)
    scanned = judge_loops(*loops)
    steps._PROGRAMS.clear()
    for one, other in zip(jax.tree.leaves(kernels), jax.tree.leaves(scanned), strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-6)


def single(study, is_known=True):
    """Of a loop that the search knows, or need not."""
    structure, case = build_structure(study), build_case(study)
    slow = margins._judge_by_eigenvalues if not is_known else mock.Mock(side_effect=AssertionError)
    with mock.patch.object(margins, "_judge_by_eigenvalues", slow):
        found = judge_loops(structure, jax.tree.map(lambda x: np.asarray(x)[None], case))
    return jax.tree.map(lambda x: float(x[0]), found._replace(least_damping=None))


@pytest.mark.parametrize(
    "name", ["plain", QUICK[0], pytest.param("free ends", marks=pytest.mark.long)]
)
def test_margins_are_those_of_single_runs(name):
    study = STUDY.change(**PLANTS[name])
    wanted = loop_report(build_structure(study), as_arrays(build_case(study)), HOME)
    found = single(study, is_known=name == "plain")
    np.testing.assert_allclose(found.gain_margin, wanted.gain_margin, rtol=1e-3)


@pytest.mark.parametrize(
    "changes",
    [{"control__law": "ppf", "control__gain_factor": 0.4}, {"control__position_gain": (-1e3,) * 3}],
)
def test_margins_of_position_feedback(changes):
    """Positive position feedback takes the static stiffness away: no curve crosses, one ends."""
    study = STUDY.change(**changes)
    wanted = loop_report(build_structure(study), as_arrays(build_case(study)), HOME)
    found = single(study)
    np.testing.assert_allclose(found.gain_margin, wanted.gain_margin, rtol=1e-4)
    is_static = study.control.law == "ppf"
    assert (found.breaking_frequency == 0) == is_static == np.isnan(found.breaking_mode)


def test_what_breaks_is_named():
    """The paper's gains on mode 1 alone break a filter, beside mode 3 of the links."""
    found = single(STUDY)
    (opened,), (feedback,) = matrices(*looked_at(STUDY, HOME))
    poles = np.linalg.eigvals(opened + 1.001 * found.gain_margin * feedback)
    worst = poles[np.argmax(np.abs(poles))]
    hertz = abs(np.angle(worst)) * STUDY.electronics.sample_rate_hz / (2 * np.pi)
    np.testing.assert_allclose(found.breaking_frequency, hertz, rtol=1e-3)
    tracked = loop_report(build_structure(STUDY), as_arrays(build_case(STUDY)), HOME, 5)
    nearest = np.argmin(np.abs(tracked.frequency_hz.mean(axis=1) - hertz)) + 1
    assert found.breaking_mode == nearest


def test_crossings_are_seen_where_they_are():
    """Between two frequencies of a sweep: the rightmost one is where the loop breaks."""
    found, (structure, cases) = single(STUDY), looked_at(STUDY, HOME)
    response, omega = response_of(structure, cases), 2 * np.pi * found.breaking_frequency
    spread = 1e-6 * (1 + np.arange(response.velocity_gain.size))
    given = response, spread.reshape(response.velocity_gain.shape)

    @jax.jit
    def swept(state, omega):
        angle = omega * response.period
        points = FrequencyPoint(omega, jnp.cos(angle), jnp.sin(angle))
        return scan_steps(follow_loci, given, points, state, len(omega))

    grid = omega * np.linspace(0.981, 1.02, 24)[:, None]
    ring = np.exp(2j * np.pi * np.arange(spread.size) / spread.size + 0.3)[:, None]
    first = swept(start_loci(Pair(ring.real, ring.imag)), np.repeat(grid[:1], 24, axis=0))
    last = swept(start_loci(first.value)._replace(omega=grid[0]), grid)
    k = np.argmax(last.crossing)
    np.testing.assert_allclose(last.crossing[k], 1 / found.gain_margin, rtol=1e-3)
    np.testing.assert_allclose(last.place[k], omega, rtol=1e-5)


def test_loops_without_feedback_have_no_limit():
    none = single(STUDY.change(control__links=(False, False, False)))
    assert none.gain_margin == HIGHEST
    assert np.isnan(none.breaking_frequency) and np.isnan(none.breaking_mode)
    assert np.isnan(single(STUDY.change(control__feedback="none")).gain_margin)
    assert np.isnan(single(STUDY.change(control__feedback="ideal")).gain_margin)


@pytest.mark.parametrize(
    "fields",
    [
        # pushed towards the drives, which are too soft to hold the platform
        {
            "drive__kp": 300.0,
            "load__wrench": (0.0, 100.0, 0.0),
            "link__basis": "loaded",
            "control__gain_factor": 0.1,
        },
        {"link__damping_ratio": 0.0, "control__links": (True, False, False)},
        {"link__damping_ratio": 1e-6, "control__links": (True, False, False)},
        {
            "link__modes": 6,
            "link__damping_ratio": ((0.01,) * 6, (0.01,) * 6, (0.01,) * 5 + (7e-5,)),
            "control__gain_factor": 0.59,
        },
        # filters of modes beyond what 10 kHz can sample
        {"electronics__lowpass_ratio": (3.0, 2.0, 5.2)},
    ],
    ids=["falls by itself", "no damping", "hardly any", "one mode of one link", "filters"],
)
def test_machines_that_hardly_stand_alone(fields):
    study = STUDY.change(**fields)
    wanted = loop_report(build_structure(study), as_arrays(build_case(study)), HOME)
    found = single(study, is_known=False).gain_margin
    falls = "load__wrench" in fields or "electronics__lowpass_ratio" in fields
    assert (found == 0) == (wanted.gain_margin == 0) == falls
    np.testing.assert_allclose(found, wanted.gain_margin, rtol=0.02)


def test_damping_by_eigenvalues_is_that_of_the_walk():
    """Of one link under control out of three, on either side of what the sweep can see."""
    fields = {"control__links": (True, False, False), "control__gain_factor": 0.02}
    walked, exact = (
        single_damping(STUDY.change(link__damping_ratio=zeta, **fields))
        for zeta in (1.02 * LEAST_DAMPED, 0.98 * LEAST_DAMPED)
    )
    np.testing.assert_allclose(exact[0], walked[0], rtol=0.01)
    idle = STUDY.change(link__damping_ratio=0.0, control__links=(False, False, False))
    assert np.all(np.isnan(single_damping(idle)))


TWO_LINKS = (
    """
[run]
duration = 0.15
[control]
links = [true, true, false]
"""
    + FAST_MOVE
    + """[metrics]
residual_delay = 0.02
residual_length = 0.09
[sweep]
method = "sobol"
count = 1024
[sweep.axes]
placement = { kind = "same" }
"""
)


@pytest.mark.long
def test_cases_that_are_ok_have_stable_loops(tmp_path):
    """200 of them by eigenvalues, and 50 of those called unstable; none was saturated instead."""
    spec = parse_sweep(tomllib.loads(TWO_LINKS))
    run_sweep(spec, tmp_path / "sweep")
    data, table = read_sweep(tmp_path / "sweep"), build_table(spec)
    rng = np.random.default_rng(0)
    group = plan_groups(table, np.arange(len(table)), local_layout)[0]
    assert set(np.unique(data["status"])) <= {status.OK, status.UNSTABLE}
    for code, count in ((status.OK, 200), (status.UNSTABLE, 50)):
        rows = rng.choice(np.flatnonzero(data["status"] == code), count, replace=False)
        cases = chunk_cases(table, np.sort(rows), group.structure, count)
        cases = jax.tree.map(lambda x, n=count: np.broadcast_to(x, (n, *x.shape[1:])), cases)
        wanted = exact_margins(Loops(group.structure, cases))
        assert np.all((wanted > 1) == (code == status.OK))
        np.testing.assert_allclose(data["gain_margin"][np.sort(rows)], wanted, rtol=0.02, atol=1e-2)
    best = ranked_cases(data, "residual_rms", "gain_margin >= 2", 10)
    assert np.all(data["gain_margin"][best] >= 2)


@pytest.mark.parametrize("factor", [1.0, 1e200, 1e-150])
def test_eigenvalues_are_those_of_numpy_on_every_scale(factor):
    matrix = factor * np.random.default_rng(0).normal(size=(7, 7))
    found, wanted = (np.sort_complex(of(matrix)) for of in (eigenvalues, np.linalg.eigvals))
    np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-13 * factor)


@pytest.mark.parametrize(
    "matrix",
    [np.ones(3), np.ones((2, 3)), np.ones((2, 2, 2)), 1j * np.eye(2), np.full((2, 2), np.nan)],
)
def test_eigenvalues_refuse_what_is_no_real_matrix(matrix):
    with pytest.raises(np.linalg.LinAlgError):
        eigenvalues(matrix)
