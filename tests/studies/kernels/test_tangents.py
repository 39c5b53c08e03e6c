"""Derivatives by the traced kernel against those by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from studies.engine import function
from studies.engine.executor import Executor
from studies.engine.plan import Layout
from studies.kernels import bridge, native
from studies.kernels.adjoint import trace_adjoint
from studies.kernels.cpu import build_kernel
from studies.kernels.derivatives import push_forward
from studies.kernels.graph import Graph, objects
from studies.kernels.traced import InputLeaf, trace_loop
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from tests.bare import paper_study
from tests.studies.kernels.test_kernel import every_operation, translated

LAYOUT = Layout(devices=1, blocks=1, lanes=16)
N_PARAMETERS = 4


def place(case, parameters):
    """Gains, a number of the drive and one of the shaper, which moves the reference."""
    control, drive, shaping = case.control, case.drive, case.shaping
    return case._replace(
        control=control._replace(
            velocity_gain=control.velocity_gain * parameters[0], ratio=control.ratio * parameters[1]
        ),
        drive=drive._replace(kp=drive.kp * parameters[2]),
        shaping=shaping._replace(tolerance=parameters[3]),
    )


@pytest.fixture(scope="module")
def chunk():
    """A machine that is thrown off its course in one case, after one short move."""
    study = paper_study().change(
        link__modes=2,
        control__modes=2,
        run__smooth=True,
        run__duration=0.06,
        motion__waypoints=paper_study().motion.waypoints[:2],
        motion__move_time=0.03,
        metrics__residual_length=0.01,
        metrics__residual_delay=0.002,
    )
    structure = build_structure(study)
    force = np.zeros((LAYOUT.size, 3))
    force[3] = 1e6
    columns = {"control.gain_factor": np.linspace(0.1, 0.4, LAYOUT.size)}
    cases = build_cases(study, columns, structure)
    cases = cases._replace(drive=cases.drive._replace(pulse_force=force))
    random = np.random.default_rng(0)
    parameters = random.uniform(0.8, 1.2, (LAYOUT.size, N_PARAMETERS))
    parameters[:, 3] = random.uniform(0.03, 0.08, LAYOUT.size)
    return structure, cases, parameters


def test_every_operation_is_differentiated():
    """Directions of a state, pushed through one step, against `jax.jvp`."""
    random, shape, lanes, directions = np.random.default_rng(1), (3, 4), 16, 2
    x = 2 * random.normal(size=(*shape, lanes))
    c, along = random.normal(size=shape), random.normal(size=(directions, *shape, lanes))
    loop = trace_loop(
        lambda constants, row, state: [every_operation(state[0], constants[0]) + 0 * row[0][0]],
        [c],
        [InputLeaf((1,), False)],
        [InputLeaf(shape, True)],
        np.float64,
        directions,
    )
    built = build_kernel(loop)
    out, pushed = x.copy(), along.copy()
    built.run([np.zeros((1, 1)), out, pushed], 1, lanes)
    whole = jax.vmap(every_operation, (-1, None), -1)
    pushed_by_jax = jax.jit(lambda x, t: jax.jvp(lambda x: whole(x, c), (x,), (t,)))
    for k in range(directions):
        value, wanted = pushed_by_jax(x, along[k])
        np.testing.assert_allclose(out, value, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(pushed[k], wanted, rtol=1e-11, atol=1e-11)
    assert np.abs(translated(every_operation, shape)[0]).max() > 1


def test_what_does_not_move_has_the_known_tangent_zero():
    graph = Graph()
    a, b = graph.read("a", True), graph.read("b", True)
    product, alone = graph.operation("mul")(a, b), graph.operation("sqrt")(b)
    assert push_forward(graph, [product, alone, 2.0], {id(a): 1.0}) == [b, 0.0, 0.0]
    assert objects([a], (1,))[0] is a


def weights(metrics, random):
    """Derivatives of three numbers by the metrics; the second depends on a few cases only."""

    def some(x):
        found = random.normal(size=(3, *x.shape)) / (np.nanmax(np.abs(x)) or 1.0)
        found[1, 1:5] = found[1, 7:] = 0.0
        return found

    return jax.tree.map(some, metrics)


@pytest.mark.long  # in short: the reverse of a loop below, and gradients of tunings
def test_kernel_and_scan_agree(chunk, monkeypatch):
    structure, cases, parameters = chunk
    monkeypatch.setattr(bridge.CpuCall, "RECORD", 2**18)  # several pieces, the last one shorter
    monkeypatch.setattr(function, "_FUNCTIONS", {})
    fast, slow = (
        Executor(structure, LAYOUT, place=place, kind=kind).differentiate(cases, parameters)
        for kind in ("kernel", "scan")
    )
    np.testing.assert_array_equal(fast.result.status, slow.result.status)
    by = weights(slow.result.metrics, np.random.default_rng(3))
    found, wanted = fast.pull_back(by), slow.pull_back(by)
    good = slow.result.status == 0
    assert found.shape == wanted.shape == (3, LAYOUT.size, N_PARAMETERS)
    # the one that is thrown off spoils no other
    assert good.sum() == LAYOUT.size - 1 and (found[:, ~good] == 0).all()
    assert (found[1, 7:] == 0).all() and (found[1, 5:7] != 0).all()
    size = np.abs(wanted[:, good]).max(axis=(0, 1))
    assert (size > 0).all()  # by every parameter
    assert (np.abs(found - wanted)[:, good] <= 1e-9 * size).all()


@pytest.mark.parametrize("has_masks", [True, False])
def test_reverse_of_a_loop_gives_the_gradient(has_masks):
    """Cotangents of a state after many samples, pulled back to all that a loop is given."""
    processor = native.this_processor()
    if not has_masks:
        processor = processor.without("avx512")
    random, lanes, n = np.random.default_rng(1), 16, 7
    shape = (3, 4)

    def step(constants, row, state):
        gain, fixed = constants
        (given,) = row
        x, peak = state
        moved = every_operation(0.3 * x, fixed) * 0.1 + gain * x + given * fixed[0, 0]
        is_going = x[0, 0] < 3.0  # some lanes freeze on their way
        return [jnp.where(is_going, moved, x), jnp.maximum(peak, jnp.abs(moved))]

    fixed = random.normal(size=shape)
    gain = random.uniform(0.8, 1.4, (*shape, lanes))
    given = random.normal(size=(n, *shape, lanes))
    start = random.normal(size=(*shape, lanes)), np.zeros((*shape, lanes))
    moving = InputLeaf(shape, True, True)
    made = trace_adjoint(step, [moving, fixed], [moving], [InputLeaf(shape, True)] * 2, np.float64)
    kept = np.empty((n, made.kept, lanes))
    last = [x.copy() for x in start]
    build_kernel(made.forward, processor).run([gain, given, *last, kept], n, lanes)

    def ended(gain, given, start):
        x = list(start)
        for row in given:
            x = step([gain, fixed], [row], x)
        return x

    @jax.jit
    def pulled(turned, *arguments):
        found, back = jax.vjp(jax.vmap(ended, -1, -1), *arguments)
        return found, back(turned)

    turned = [random.normal(size=x.shape) for x in start]
    wanted, (by_gain, by_given, by_start) = pulled(turned, gain, given, start)
    for a, b in zip(last, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)
    sums, rows = np.zeros_like(gain), np.empty_like(given)
    run = build_kernel(made.backward, processor).run
    run([gain, given, kept, *turned, sums, rows], n, lanes)
    for a, b in zip([*turned, sums, rows], [*by_start, by_gain, by_given], strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    frozen = np.asarray(by_given)[-1, 0, 0] == 0
    assert frozen.any() and not frozen.all()
