"""Derivatives by the traced kernel against those by JAX."""

import jax
import numpy as np
import pytest

from studies.engine.gradients import (
    KernelGradients,
    ScanGradients,
    is_forward_cheaper,
    reverse_gradients,
)
from studies.engine.plan import Layout
from studies.kernels.cpu import build_kernel
from studies.kernels.graph import Graph, objects
from studies.kernels.tangents import push_forward
from studies.kernels.traced import InputLeaf, trace_loop
from studies.study.cases import as_arrays, build_cases, build_structure
from studies.study.spec import paper_study
from tests.test_kernel import every_operation, translated

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


@pytest.mark.long  # in short: gradients of tunings (test_tuning.py) are those of differences
def test_kernel_and_scan_agree(chunk):
    structure, cases, parameters = chunk
    fast, slow = (
        executor(structure, LAYOUT, place).evaluate(cases, parameters)
        for executor in (KernelGradients, ScanGradients)
    )
    np.testing.assert_array_equal(fast.result.status, slow.result.status)
    good = np.flatnonzero(fast.result.status == 0)
    assert len(good) == LAYOUT.size - 1  # the one that is thrown off spoils no other
    for name, a in fast.metrics.items():
        b = slow.metrics[name]
        assert a.shape[:2] == (LAYOUT.size, N_PARAMETERS)
        size = np.abs(b[good]).max()
        assert np.abs(a[good] - b[good]).max() <= 1e-9 * size, name
    stopped = np.delete(fast.metrics.residual_rms, good, axis=0)
    assert len(stopped) == 1 and (stopped == 0).all()
    rms = fast.metrics.residual_rms[good]
    assert (np.abs(rms).max((0, 2, 3)) > 0).all()  # by every parameter


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
    for k in range(directions):
        value, wanted = jax.jvp(lambda x: whole(x, c), (x,), (along[k],))
        np.testing.assert_allclose(out, value, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(pushed[k], wanted, rtol=1e-11, atol=1e-11)
    assert np.abs(translated(every_operation, shape)[0]).max() > 1


def test_what_does_not_move_has_the_known_tangent_zero():
    graph = Graph()
    a, b = graph.read("a", True), graph.read("b", True)
    product, alone = graph.operation("mul")(a, b), graph.operation("sqrt")(b)
    assert push_forward(graph, [product, alone, 2.0], {id(a): 1.0}) == [b, 0.0, 0.0]
    assert objects([a], (1,))[0] is a


def test_mode_by_rule():
    """Forward for few parameters, reverse for many."""
    for name in ("traced kernel", "XLA scan"):
        assert is_forward_cheaper(1, name) and not is_forward_cheaper(1000, name)


@pytest.mark.long
def test_reverse_mode_agrees_with_forward_mode(chunk):
    """One number's gradient, by the mode that pays for many parameters."""
    structure, cases, parameters = chunk
    forward = ScanGradients(structure, LAYOUT, place).evaluate(cases, parameters)
    whole = jax.tree.map(lambda x: np.repeat(x, LAYOUT.size // len(x), axis=0), cases)
    value, slope = reverse_gradients(structure, place, control_energy, as_arrays(whole), parameters)
    good = forward.result.status == 0
    wanted, change = forward.result.metrics.control_energy, forward.metrics.control_energy
    np.testing.assert_allclose(value[good], wanted[good], rtol=1e-9)
    size = np.abs(change[good]).max()
    np.testing.assert_allclose(slope[good], change[good], atol=1e-9 * size)


def control_energy(metrics):
    return metrics.control_energy
