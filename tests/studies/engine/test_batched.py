"""A study as a JAX function: equal to the scan, usable inside programs, differentiable."""

import re
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import AxisType, PartitionSpec

from jaxmodel import status
from jaxmodel.simulate import simulate
from studies.engine.batched import batched
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.kernels import bridge, native
from studies.kernels.traced import InputLeaf, trace_loop
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from tests.canonical import TINY, study_of

#: One mode and one patch, which make small programs.
STUDY = study_of(
    TINY,
    run__duration=0.05,
    shaper__kind="ei",
    link__modes=1,
    patches__centers=[[0.1]] * 3,
    control__modes=1,
    control__ratios=[[1.0]] * 3,
)
HOME = np.array(STUDY.motion.waypoints[0])
#: Gains, a number of the shaper, which moves the reference, and a blow on all sliders.
NAMES = ("control.gain_factor", "shaper.tolerance", "drive.pulse_force")


#: What the study does not have: a wrench, friction and a position gain.
MORE = ("load.wrench[0]", "drive.coulomb_friction", "control.position_gain[1]")


@pytest.fixture(scope="module")
def parameters():
    found = np.stack(
        [np.linspace(0.05, 0.15, 10), np.linspace(0.03, 0.08, 10), np.zeros(10)], axis=1
    )
    found[3, 2] = 1e6  # thrown off its course
    return found


@pytest.fixture(scope="module")
def wide(parameters):
    """With numbers of what the study does not have in half of the cases."""
    return np.concatenate([parameters, np.outer(np.arange(10) % 2, [2.0, 0.3, 40.0])], axis=1)


@pytest.fixture(scope="module")
def rounded():
    return batched(STUDY, (*NAMES, *MORE))


@pytest.fixture(scope="module")
def smooth():
    return batched(STUDY.change(run__smooth=True), NAMES)


@pytest.fixture(scope="module")
def results(rounded, wide):
    return jax.tree.map(np.asarray, jax.jit(rounded)(wide))


def test_it_equals_the_scan(results, wide, monkeypatch):
    """Within 1e-9, status by status; ten cases do not fill the vectors."""
    monkeypatch.setattr(bridge, "is_available", lambda: False)
    traced = jax.jit(batched(STUDY, (*NAMES, *MORE))).trace(wide)
    assert "ffi_call" not in (text := str(traced.jaxpr)) and "scan" in text
    wanted = jax.tree.map(np.asarray, traced.lower().compile()(wide))
    np.testing.assert_array_equal(results.status, wanted.status)
    assert set(results.status) == {status.OK, status.DIVERGED}
    good = results.status == status.OK
    for name, x in results.metrics.items():
        size = np.abs(wanted.metrics[name][good]).max()
        assert np.abs(x - wanted.metrics[name])[good].max() <= 1e-9 * size, name
        assert np.isnan(x[~good]).all()


def test_it_runs_inside_other_programs(rounded, results, wide):
    """Made by two threads at once: XLA takes the name of a kernel once."""
    half = np.concatenate([wide[4:8], wide[6:10]])
    whole = np.concatenate([half, half])

    def rms(x):
        return rounded(x).metrics.residual_rms

    alone = results.metrics.residual_rms
    alone = np.concatenate([alone[4:8], alone[6:10]] * 2)
    assert alone.min() > 0
    mesh = jax.make_mesh((2,), ("cases",), axis_types=(AxisType.Auto,))
    spec = PartitionSpec("cases")
    shared = jax.shard_map(rms, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False)
    with ThreadPoolExecutor(2) as pool:
        mapped = pool.submit(jax.jit(lambda x: jax.lax.map(rms, x)), whole.reshape(2, 8, -1))
        parted = pool.submit(jax.jit(shared), whole)
    np.testing.assert_allclose(mapped.result().reshape(alone.shape), alone, rtol=1e-12)
    np.testing.assert_allclose(parted.result(), alone, rtol=1e-12)


def sum_of_squares(function, x):
    """Of the cases that run to their end."""
    result = function(x)
    good = result.status == status.OK
    rms = jnp.where(good[:, None, None], result.metrics.residual_rms, 0.0)
    return jnp.sum((1e6 * rms) ** 2)


@pytest.fixture(scope="module")
def differentiated(smooth):
    """The sum of squares and its gradient."""
    return jax.jit(jax.value_and_grad(partial(sum_of_squares, smooth)))


def test_derivatives_in_both_modes(smooth, differentiated, parameters):
    """Against differences; a case that is thrown off leaves the others alone."""
    gradient = np.asarray(differentiated(parameters)[1])
    assert np.isfinite(gradient).all() and (gradient[3] == 0).all()
    step = np.zeros_like(parameters)
    step[4:, :2] = 1e-5 * parameters[4:, :2]
    ends = [differentiated(parameters + sign * step)[0] for sign in (1, -1)]
    difference, value = (ends[0] - ends[1]) / 2, partial(sum_of_squares, smooth)
    along = jax.jit(lambda x, dx: jax.jvp(value, (x,), (dx,))[1])(parameters, step)
    assert difference == pytest.approx(np.sum(gradient * step), rel=1e-6)
    assert along == pytest.approx(np.sum(gradient * step), rel=1e-9)
    assert (gradient[4:, :2] != 0).all()


@pytest.mark.long
def test_jacobians_and_rounded_loops(smooth, parameters, monkeypatch):
    """Jacobians by both modes; a loop with converters has the derivatives of the scan's."""
    few = parameters[4:12]

    def rms(x):
        return smooth(x).metrics.residual_rms[1].ravel()

    forward, reverse = jax.jacfwd(rms)(few), jax.jacrev(rms)(few)
    np.testing.assert_allclose(forward, reverse, rtol=1e-9, atol=1e-12 * np.abs(forward).max())
    assert (np.asarray(forward)[:, 1, :2] != 0).all() and (np.asarray(forward)[:, 2:] == 0).all()
    rounded = batched(STUDY, NAMES)
    turned = jax.grad(lambda x: rounded(x).metrics.residual_rms.sum())(few)
    monkeypatch.setattr(bridge, "is_available", lambda: False)
    scan = batched(STUDY, NAMES)
    wanted = jax.grad(lambda x: scan(x).metrics.residual_rms.sum())(few)
    size = np.abs(wanted).max(axis=0)
    assert (np.abs(turned - wanted) <= 1e-9 * size).all() and (size[:2] > 0).all()


def test_another_version_of_the_interface_is_left_alone(monkeypatch):
    assert bridge.is_available()
    monkeypatch.setattr(bridge, "_version", lambda: (1, 0))
    assert not bridge.is_available()


@pytest.mark.parametrize(
    ("parameters", "said"),
    [
        (np.ones(3), "shape (3,); expected real numbers of shape (cases, 3)"),
        (np.ones((0, 3)), "shape (0, 3)"),
        (np.ones((2, 0)), "shape (2, 0)"),
        (np.ones((2, 2)), "shape (2, 2)"),
        (np.ones((2, 3)) * 1j, "complex128"),
        ("abc", "not an array of numbers"),
    ],
)
def test_parameters_of_another_shape_are_refused(smooth, parameters, said):
    with pytest.raises(StudyError, match=re.escape(said)):
        smooth(parameters)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("control.gainfactor", "unknown field; did you mean 'control.gain_factor'"),
        ("control.velocity_gain[3]", "no such entry"),
        ("electronics.adc_bits", "expected real numbers"),
        ("shaper.kind", "expected real numbers"),
        ("shaper.frequencies_hz", "= (); expected real numbers"),
        ("run.duration", "not choices"),
        ("drive.pulse_force[0]", "is there twice"),
    ],
)
def test_a_wrong_name_is_refused(wrong, said):
    with pytest.raises(StudyError, match=re.escape(said)):
        batched(STUDY, [*NAMES, wrong])


@pytest.mark.long
def test_what_a_study_does_not_have_can_vary(results, wide):
    """A program for a study without wrench, friction or position gain takes them as names."""
    gain, tolerance, _, wrench, friction, position = wide[5]
    given = STUDY.change(
        control__gain_factor=gain,
        shaper__tolerance=tolerance,
        load__wrench=(wrench, 0.0, 0.0),
        drive__coulomb_friction=friction,
        control__position_gain=(0.0, position, 0.0),
    )
    wanted = run_study(given, has_record=False, has_loop=False).result.metrics.residual_rms
    np.testing.assert_allclose(results.metrics.residual_rms[5], wanted, rtol=1e-9)


def test_a_wrong_study_or_names_are_named():
    with pytest.raises(StudyError, match="study: 'paper'; expected a study"):
        batched("paper", NAMES)
    with pytest.raises(StudyError, match="names: 'drive.kp'; expected names"):
        batched(STUDY, "drive.kp")


def test_a_number_that_is_none_spoils_no_derivative(differentiated, parameters):
    given = parameters.copy()
    given[5, 0] = np.nan
    gradient = np.asarray(differentiated(given)[1])
    assert np.isfinite(gradient).all() and (gradient[5] == 0).all() and (gradient[4, :2] != 0).all()


def test_second_derivatives_are_refused_in_words(smooth, parameters):
    twice = jax.grad(lambda x: jnp.sum(jax.grad(lambda y: sum_of_squares(smooth, y))(x)))
    with pytest.raises(NotImplementedError, match="first derivatives only"):
        jax.eval_shape(twice, parameters)


def test_lanes_fill_vectors():
    with pytest.raises(ValueError, match="lanes = 3; allowed: multiples of"):
        bridge.CpuCall.of_loop(
            trace_loop(lambda *x: x[2], [], [], [InputLeaf((), True)], float), 5, 3
        ).kernel()
    assert native.this_processor().vector_bytes in (16, 32, 64)


def test_it_judges_the_loops_in_the_same_program(parameters):
    """As eigenvalues do; nothing asks the host."""
    run = batched(STUDY, NAMES, is_judged=True)
    values = jax.device_put(parameters[:3])
    traced = jax.jit(lambda values: run(values)[1]).trace(values)
    assert not re.search("callback|infeed|outfeed", str(traced.jaxpr))
    program = traced.lower().compile()
    with jax.transfer_guard("disallow"):
        judged = jax.block_until_ready(program(values))
    assert np.all(judged.is_known)
    for k, factor in enumerate(parameters[:3, 0]):
        study = STUDY.change(control__gain_factor=float(factor))
        one = loop_report(build_structure(study), as_arrays(build_case(study)), HOME, 1)
        np.testing.assert_allclose(judged.gain_margin[k], one.gain_margin, rtol=1e-3)
        np.testing.assert_allclose(judged.least_damping[k], one.damping_ratio.min(), rtol=2e-3)


def test_gain_margins_have_derivatives():
    """By the gain and by what moves modes and patches, as differences have them."""
    names = ("control.gain_factor", "link.thickness", "drive.kp")
    run = batched(STUDY, names, is_judged=True)
    start = np.array([[0.1, STUDY.link.thickness, STUDY.drive.kp]])
    margins = jax.jit(lambda values: run(values)[1].gain_margin)
    (slope,) = jax.jit(jax.grad(lambda values: jnp.sum(run(values)[1].gain_margin)))(start)
    wide = start + np.concatenate([np.diag(1e-5 * start[0]), -np.diag(1e-5 * start[0])])
    ends = np.asarray(margins(wide)).reshape(2, 3)
    wanted = (ends[0] - ends[1]) / (2e-5 * start[0])
    np.testing.assert_allclose(slope, wanted, rtol=1e-5)
    np.testing.assert_allclose(slope[0], -margins(start)[0] / 0.1, rtol=1e-5)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"control__law": "lqg"}, "control.law = 'lqg'"),
        ({"control__feedback": "none"}, "control.feedback = 'none'"),
        ({"drive__lag": 1e-3}, "drive.lag = 0.001 s"),
    ],
)
def test_loops_that_only_eigenvalues_judge_are_named(changes, named):
    with pytest.raises(StudyError, match=re.escape(named)):
        batched(STUDY.change(**changes), NAMES, is_judged=True)


#: What a study has at most: two modes, one of them under control, and two patches.
MANY = STUDY.change(link__modes=2, patches__centers=[[0.07, 0.13]] * 3, control__gain_factor=0.05)


def test_counts_and_links_vary_in_one_program():
    """Placement, numbers of modes, gain and controlled links at once, as their own studies."""
    names = ["link.modes", "patches.centers[0][0]", "control.gain_factor", "link_subsets"]
    values = np.array(
        [[2, 0.07, 0.05, 7], [1, 0.06, 0.1, 5], [2, 0.08, 0.1, 0], [1, 0.05, 0.02, 2]]
    )
    run = jax.jit(batched(MANY, names, is_judged=True))
    found, judged = run(values)
    apart = jax.jit(batched(MANY, [*names[:3], *(f"control.links[{k}]" for k in range(3))]))
    links = np.array([[1, 1, 1], [1, 0, 1], [0, 0, 0], [0, 1, 0]])
    again = apart(np.concatenate([values[:, :3], links], axis=1))
    np.testing.assert_allclose(found.metrics.residual_rms, again.metrics.residual_rms, rtol=1e-12)
    columns = {
        "link.modes": values[:, 0].astype(int),
        "patches.centers": np.array([[[x, 0.13], *[[0.07, 0.13]] * 2] for x in values[:, 1]]),
        "control.gain_factor": values[:, 2],
        "control.links": links.astype(bool),
    }
    structure = build_structure(MANY)
    cases = build_cases(MANY, columns, structure)
    cases = jax.tree.map(lambda x: np.broadcast_to(x, (4, *x.shape[1:])), cases)
    wanted = jax.jit(jax.vmap(partial(simulate, structure)))(cases)
    np.testing.assert_array_equal(found.status, wanted.status)
    np.testing.assert_allclose(found.metrics.residual_rms, wanted.metrics.residual_rms, rtol=1e-7)
    loop = loop_report(structure, build_case(MANY), HOME)
    assert float(judged.gain_margin[0]) == pytest.approx(loop.gain_margin, rel=1e-3)
    with pytest.raises(StudyError, match="'control.links' is there twice"):
        batched(MANY, ["control.links[0]", "link_subsets"])
    with pytest.raises(StudyError, match="control.law"):
        batched(MANY, ["control.law"])
