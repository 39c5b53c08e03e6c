"""A batch is its members: vmap equals single runs, no member touches another, one compilation."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.metrics import Metrics
from jaxmodel.simulate import simulate
from studies.engine import function
from studies.engine.executor import CaseLeaves, Differentiated, Executor
from studies.engine.plan import Layout
from studies.engine.runs import _simulate
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from tests.bare import paper_study

N_CASES = 16
QUICK = {"xla_backend_optimization_level": 0}


def short_study(**changes):
    """One 5 mm move in 25 ms, then 10 ms of residual vibration."""
    short = {
        "run__duration": 0.045,
        "motion__waypoints": ((0.0, 0.0, np.pi / 6), (0.0, 0.005, np.pi / 6)),
        "motion__move_time": 0.025,
        "metrics__residual_delay": 0.0,
        "metrics__residual_length": 0.01,
    }
    return paper_study().change(**(short | changes))


#: Those of `tests.canonical.MACHINE`.
SIZES = {"run__duration": 0.05, "link__modes": 3}


def mixed_case(rng):
    """Placement, mode counts, links, gains, shaper and geometry drawn at random."""
    first = rng.uniform(0.02, 0.05)
    centers = first + np.cumsum(np.r_[0, rng.uniform(0.035, 0.06, 2)])
    ratios = tuple((1.0, *rng.uniform(0, 0.3, 2)) for _ in range(3))
    study = short_study(
        **SIZES,
        patches__centers=tuple(centers),
        control__links=tuple(bool(b) for b in rng.integers(0, 2, 3)),
        control__velocity_gain=tuple(rng.uniform(0.1, 0.6, 3)),
        control__ratios=ratios,
        shaper__kind=str(rng.choice(["none", "zv", "ei"])),
        link__youngs_modulus=rng.uniform(60e9, 80e9),
        machine__guide_side=rng.uniform(0.59, 0.61),
        machine__platform_mass=rng.uniform(0.2, 0.3),
        drive__kp=rng.uniform(1e4, 4e4),
    )
    case = build_case(study)
    return as_arrays(
        case._replace(
            n_modes=rng.integers(2, 4),
            control=case.control._replace(n_active=float(rng.integers(1, 4))),
        )
    )


@pytest.mark.parametrize(("points", "is_shared"), [(1, True), (2, False)])
def test_the_command_of_a_platform_at_rest_is_computed_once(points, is_shared):
    """Also where each case has a shaper of its own."""
    points = paper_study().motion.waypoints[:points]
    study = short_study(motion__waypoints=points, shaper__kind="ei")
    structure = build_structure(study)
    cases = build_cases(study, {"shaper.damping_ratio": np.array([0.01, 0.02])}, structure)
    executor = Executor(structure, Layout(devices=1, blocks=1, lanes=2), kind="scan")
    function, _ = executor._prepare(cases, ())
    varies = jax.tree.unflatten(function.parts.tree, function.parts.is_varying).inputs
    assert varies.window.after_command
    assert {varies.rho, varies.rho_rate, varies.pose} == {not is_shared}


def test_cases_are_prepared_in_groups_and_with_more_effort_where_they_are_many(monkeypatch):
    study = short_study()
    structure, lanes = build_structure(study), 2 * function.GROUP
    gains = {"control.gain_factor": np.linspace(0.1, 0.5, lanes)}
    leaves, tree = jax.tree.flatten(build_cases(study, gains, structure))
    is_own = tuple(len(leaf) > 1 for leaf in leaves)
    own = [x for x, yes in zip(leaves, is_own, strict=True) if yes]
    shared = [x[0] for x, yes in zip(leaves, is_own, strict=True) if not yes]
    made, efforts = [], []
    monkeypatch.setattr(function, "quick_options", lambda effort: efforts.append(effort) or QUICK)
    for size, is_many in ((function.GROUP, False), (function.GROUP, True), (lanes + 1, False)):
        monkeypatch.setattr(function, "GROUP", size)
        block = function.BlockFunction(
            structure, CaseLeaves(tree, is_own), (), own, shared, "kernel", is_many
        )
        made.append(block._program("prepare", block.prepare, (), own, shared))
    assert set(efforts) == {0, 1}
    for grouped, effort, whole in zip(*made, strict=True):
        np.testing.assert_allclose(grouped, whole, rtol=1e-12)
        np.testing.assert_allclose(effort, whole, rtol=1e-12)


def test_gradients_of_several_numbers_are_those_of_their_own_metrics():
    """Cases differ in how many numbers they have a part in, and one has failed."""
    slope = np.random.default_rng(0).normal(size=(2, 4, 3))  # of metrics, by case

    def pull_back(part):
        return lambda weights: sum(x[..., None] * slope[k, part] for k, x in enumerate(weights))

    weights = np.zeros((2, 3, 4))
    weights[0, 0], weights[1, 1, 1:], weights[:, 2, 2] = 2.0, [3.0, 4.0, 5.0], [6.0, 7.0]
    failed = SimpleNamespace(status=np.array([0, 0, 0, status.NON_FINITE]))
    with ThreadPoolExecutor(2) as pool:
        parts = [pull_back(slice(0, 2)), pull_back(slice(2, 4))]
        found = Differentiated(failed, parts, 3, pool).pull_back(tuple(weights))
    wanted = np.einsum("knc,kcp->ncp", weights, slope)
    wanted[:, 3] = 0.0
    np.testing.assert_allclose(found, wanted, atol=1e-14)


@pytest.fixture(scope="module")
def structure():
    return build_structure(short_study(**SIZES))


@pytest.fixture(scope="module")
def cases():
    rng = np.random.default_rng(7)
    return [mixed_case(rng) for _ in range(N_CASES)]


def counted(function):
    """Compiled function that counts its own traces."""
    traces = []

    @jax.jit
    def run(case):
        traces.append(1)
        return function(case)

    run.traces = traces
    return run


@pytest.fixture(scope="module")
def batch(structure):
    return counted(jax.vmap(lambda case: simulate(structure, case)))


@pytest.fixture(scope="module")
def one(structure):
    """The program of single runs."""
    return lambda case: _simulate(structure, case, False)


def stack(cases):
    return jax.tree.map(lambda *x: np.stack(x), *cases)


def compare(batched, index, single):
    for name, x, y in zip(single._fields, batched, single, strict=True):
        if name == "record":
            continue
        for a, b in zip(jax.tree.leaves(x), jax.tree.leaves(y), strict=True):
            a, b = np.asarray(a)[index], np.asarray(b)
            assert np.max(np.abs(a - b)) <= 1e-9 * max(np.max(np.abs(b)), 1e-300), name


def check_batch(cases, batch, one):
    result = batch(stack(cases))
    assert np.all(np.isin(result.status, status.FINISHED))  # some draws saturate
    for index, case in enumerate(cases):
        compare(result, index, one(case))
    assert len(batch.traces) == 1
    rms = np.asarray(result.metrics.residual_rms)
    assert np.unique(np.round(rms[:, 0, 1], 12)).size == N_CASES  # the cases do differ


def test_mixed_batch_equals_single_runs(cases, batch, one):
    check_batch(cases, batch, one)


@pytest.mark.long
@pytest.mark.parametrize("seed", range(8, 20))
def test_many_mixed_batches_equal_single_runs(batch, one, seed):
    rng = np.random.default_rng(seed)
    check_batch([mixed_case(rng) for _ in range(N_CASES)], batch, one)


def test_order_and_neighbours_do_not_matter(cases, batch):
    whole = batch(stack(cases))
    order = np.random.default_rng(3).permutation(N_CASES)
    moved = batch(stack([cases[k] for k in order]))
    other = batch(stack([*cases[:8], *([cases[12]] * (N_CASES - 8))]))
    for name in ("residual_rms", "peak_voltage", "spectral_density"):
        x = np.asarray(getattr(whole.metrics, name))
        close = 1e-12 * np.abs(x).max()
        assert np.abs(np.asarray(getattr(moved.metrics, name)) - x[order]).max() <= close
        assert np.abs(np.asarray(getattr(other.metrics, name))[:8] - x[:8]).max() <= close


def test_bad_members_are_frozen_and_alone(cases, batch):
    whole = batch(stack(cases))
    bad = list(cases)
    centers = np.asarray(bad[1].machine.patches.center)
    patches = bad[1].machine.patches._replace(center=centers * 0 + np.array([0.05, 0.06, 0.15]))
    bad[1] = bad[1]._replace(machine=bad[1].machine._replace(patches=patches))
    points = np.array(bad[2].path.waypoints)
    points[1, 1] = 0.5
    bad[2] = bad[2]._replace(path=bad[2].path._replace(waypoints=points))
    bad[3] = bad[3]._replace(control=bad[3].control._replace(gain_factor=np.array(np.nan)))
    drive = bad[4].drive._replace(kd=np.array(-2e3))
    bad[4] = bad[4]._replace(drive=drive)
    result = batch(stack(bad))
    codes = np.asarray(result.status)
    assert codes[1] == status.PATCHES_OVERLAP
    assert codes[2] == status.OUT_OF_REACH
    assert codes[3] == status.NON_FINITE
    assert codes[4] in (status.DIVERGED, status.OUT_OF_REACH, status.SINGULAR)
    assert 0 < np.asarray(result.bad_time)[4] < 0.05
    good = np.r_[0, 5:N_CASES]
    assert np.all(codes[good] == status.OK)
    for a, b in zip(jax.tree.leaves(result.metrics), jax.tree.leaves(whole.metrics), strict=True):
        a, b = np.asarray(a)[good], np.asarray(b)[good]
        assert np.abs(a - b).max() <= 1e-12 * np.abs(b).max()
    # zeros of a run that stopped would look like a perfect one
    assert all(np.all(np.isnan(np.asarray(a)[1:5])) for a in jax.tree.leaves(result.metrics))


def test_no_number_that_is_not_finite_ends_as_ok(cases, batch):
    """NaN in each kind of input of a member, also in those that only judge it."""
    spoilt = []
    for path, leaf in jax.tree_util.tree_leaves_with_path(cases[0]):
        if np.issubdtype(np.asarray(leaf).dtype, np.integer):
            continue

        def spoil(at, x, path=path):
            return x * np.nan if at == path else x

        spoilt.append(jax.tree_util.tree_map_with_path(spoil, cases[0]))
    assert len(spoilt) > 50
    for start in range(0, len(spoilt), N_CASES - 4):
        part = spoilt[start : start + N_CASES - 4]
        filled = part + cases[1:2] * (N_CASES - len(part))
        codes = np.asarray(batch(stack(filled)).status)
        assert np.all(codes[: len(part)] == status.NON_FINITE)
        assert np.all(codes[len(part) :] == status.OK)


def test_comparator_can_fail(structure, cases, batch):
    """A difference of 1e-8 in one number is noticed."""
    result = batch(stack(cases))
    single = jax.tree.map(lambda x: np.asarray(x)[0], result)
    metrics = single.metrics
    off = Metrics(metrics | {"residual_rms": metrics.residual_rms * (1 + 1e-8)})
    with pytest.raises(AssertionError):
        compare(result, 0, single._replace(metrics=off))
