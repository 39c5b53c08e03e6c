"""Gradients of the residual vibration agree with central differences, forward and reverse."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import studies
from jaxmodel.bases import find_bases
from jaxmodel.control import pole_placement
from jaxmodel.simulate import simulate
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import parse_study
from tests.documents import blocks, page
from tests.studies.engine.test_batch import short_study
from tests.sweeps import BASE


@pytest.fixture(scope="module")
def objective():
    """Residual vibration [um^2] as a function of one vector of 15 numbers of order 1."""
    study = short_study(
        run__smooth=True,
        link__modes=5,
        electronics__adc_noise=1e-4,
        drive__ripple=0.1,
        control__position_gain=(10.0, 10.0, 10.0),
    )
    # what nobody asks for must not cost a compilation
    structure = build_structure(study)._replace(metrics=("residual_rms",), n_frequencies=1)
    case = as_arrays(build_case(study))
    omega = find_bases(structure, case).believed_omega[:, 0]

    def run(x):
        gain, ratio, decay, frequency, center = jnp.split(x, 5)
        # poles of link 1..3's first mode, placed by (22)-(23), on top of the directly given gains
        placed = pole_placement(30 * decay, omega * (1 + 0.01 * frequency), omega)
        mass = 0.0055
        control = case.control._replace(
            velocity_gain=3 * gain + mass * placed.velocity,
            position_gain=mass * placed.position,
            ratio=case.control.ratio.at[:, 1].set(0.3 * ratio),
        )
        offset = 0.002 * center[:, None] * jnp.array([1.0, -1.0, 0.5])
        patches = case.machine.patches._replace(center=case.machine.patches.center + offset)
        machine = case.machine._replace(patches=patches)
        result = simulate(structure, case._replace(control=control, machine=machine))
        return jnp.sum((1e6 * result.metrics.residual_rms) ** 2)

    return run


@pytest.fixture(scope="module")
def reverse(objective):
    """Gradients of two cases at once; compiled with little optimisation, since it runs twice."""
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(jax.vmap(jax.grad(objective)), compiler_options=options)


@pytest.fixture(scope="module")
def point():
    return np.random.default_rng(1).uniform(0.5, 1.5, 15)


@pytest.fixture(scope="module")
def central(objective, point):
    """Central differences of fourth order, and the scale to judge by."""
    step = 1e-4
    steps = np.concatenate([k * step * np.eye(15) for k in (-2, -1, 1, 2)])
    value = np.asarray(jax.jit(lambda x: jax.lax.map(objective, x, batch_size=15))(point + steps))
    value = value.reshape(4, 15)
    found = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * step)
    # each kind of parameter matters, so that agreement is not of zeros
    assert np.all(np.abs(found).reshape(5, 3).max(axis=1) > 1e-6 * np.abs(found).max())
    return found, np.maximum(np.abs(found), 1e-3 * np.abs(found).max())


def test_reverse_and_central_differences_agree(reverse, central, point):
    backward = np.asarray(reverse(np.stack([point, point])))[1]
    found, scale = central
    assert np.max(np.abs(backward - found) / scale) < 1e-5


@pytest.mark.long  # in short: derivatives by the kernel are those of `jax.jvp`, in test_tangents
def test_forward_and_reverse_agree(objective, reverse, point, central):
    backward = np.asarray(reverse(np.stack([point, point])))[1]

    @jax.jit
    def push(x):
        return jax.vmap(lambda d: jax.jvp(objective, (x,), (d,))[1])(jnp.eye(15))

    assert np.max(np.abs(backward - np.asarray(push(point))) / central[1]) < 1e-8


def test_bad_case_leaves_gradients_of_others_alone(reverse, point):
    good = np.asarray(reverse(np.stack([point, point])))[0]
    broken = point.copy()
    broken[12:] = 40.0  # patches pushed off the link
    after = np.asarray(reverse(np.stack([point, broken])))
    np.testing.assert_allclose(after[0], good, rtol=1e-12)
    # a sum over a batch that leaves it out by its status keeps the right slope
    np.testing.assert_array_equal(after[1], 0.0)


def test_a_rounded_loop_has_the_derivative_of_the_smooth_one():
    study = parse_study(BASE)
    structure, case = build_structure(study), as_arrays(build_case(study))

    def residual(structure, factor):
        placed = case._replace(control=case.control._replace(gain_factor=factor))
        return simulate(structure, placed).metrics.residual_rms.max()

    (rounded, slope), (smooth, wanted) = (
        jax.jit(jax.value_and_grad(partial(residual, structure._replace(is_smooth=x))))(0.5)
        for x in (False, True)
    )
    assert wanted != 0 and float(slope) == pytest.approx(float(wanted), rel=1e-9)
    assert abs(rounded / smooth - 1) > 1e-6


@pytest.mark.long
def test_rounded_loops_have_the_slope_of_the_smooth_loop():
    """Code of the docs: values with real converters, derivatives by smooth differences."""
    codes = blocks(page("docs/reference/python.md"), "python")
    (code,) = (x for x in codes if "studies.batched" in x)
    names = {}
    exec(code, names)
    residual, factors, slopes = (names[name] for name in ("residual", "factors", "slopes"))
    many = np.asarray(residual(factors))
    assert many.shape == (8,) and np.all(many > 0)

    study, k, step = studies.Study(), 4, 1e-3
    structure = build_structure(study)._replace(is_smooth=True)
    case = as_arrays(build_case(study))

    @jax.jit
    def smooth(factor):
        placed = case._replace(control=case.control._replace(gain_factor=factor))
        return 1e6 * simulate(structure, placed).metrics.residual_rms.max()

    near = [float(smooth(factors[k, 0] + place * step)) for place in (-2, -1, 1, 2)]
    slope = (near[0] - 8 * near[1] + 8 * near[2] - near[3]) / (12 * step)
    assert float(slopes[k, 0]) == pytest.approx(slope, rel=1e-6)
    # rounding shows in the value: these are not the same loop
    assert abs(float(smooth(factors[k, 0])) / many[k] - 1) > 1e-6
