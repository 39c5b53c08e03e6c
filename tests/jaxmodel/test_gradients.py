"""Gradients of the residual vibration agree with central differences, forward and reverse."""

import sys
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import studies
from jaxmodel.case import Structure
from jaxmodel.control import pole_placement
from jaxmodel.simulate import simulate
from studies.study.cases import as_arrays, build_case, build_structure
from tests.bare import parse_study
from tests.documents import blocks, page
from tests.jaxmodel.kept import bases_of
from tests.studies.engine.test_batch import short_study
from tests.sweeps import BASE


@pytest.fixture(scope="module")
def objective():
    """Residual vibration [um^2] as a function of one vector of 15 numbers of order 1."""
    study = short_study(
        run__smooth=True,
        link__modes=3,
        electronics__adc_noise=1e-4,
        drive__ripple=0.1,
        control__position_gain=(10.0, 10.0, 10.0),
    )
    # what nobody asks for must not cost a compilation
    structure = build_structure(study)._replace(metrics=("residual_rms",), n_frequencies=1)
    case = as_arrays(build_case(study))
    omega = np.asarray(bases_of(structure, case).believed_omega[:, 0])

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


STEP = 1e-4
#: Where values are taken for central differences, and twice the point itself.
STEPS = np.concatenate([k * STEP * np.eye(15) for k in (-2, -1, 1, 2)] + [np.zeros((2, 15))])


@pytest.fixture(scope="module")
def valued(objective):
    """Values and gradients of 62 cases at once; compiled with little optimisation."""
    options = {"xla_backend_optimization_level": 0}
    return jax.jit(jax.vmap(jax.value_and_grad(objective)), compiler_options=options)


@pytest.fixture(scope="module")
def point():
    return np.random.default_rng(1).uniform(0.5, 1.5, 15)


@pytest.fixture(scope="module")
def found(valued, point):
    """Values and gradients about the point."""
    return tuple(map(np.asarray, valued(point + STEPS)))


@pytest.fixture(scope="module")
def central(found):
    """Central differences of fourth order, and the scale to judge by."""
    value = found[0][:60].reshape(4, 15)
    slope = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * STEP)
    # each kind of parameter matters, so that agreement is not of zeros
    assert np.all(np.abs(slope).reshape(5, 3).max(axis=1) > 1e-6 * np.abs(slope).max())
    return slope, np.maximum(np.abs(slope), 1e-3 * np.abs(slope).max())


def test_reverse_and_central_differences_agree(found, central):
    slope, scale = central
    assert np.max(np.abs(found[1][-1] - slope) / scale) < 1e-5


@pytest.mark.long  # in short: derivatives by the kernel are those of `jax.jvp`, in test_tangents
def test_forward_and_reverse_agree(objective, found, point, central):
    @jax.jit
    def push(x):
        return jax.vmap(lambda d: jax.jvp(objective, (x,), (d,))[1])(jnp.eye(15))

    assert np.max(np.abs(found[1][-1] - np.asarray(push(point))) / central[1]) < 1e-8


def test_bad_case_leaves_gradients_of_others_alone(valued, found, point):
    points = np.tile(point, (len(STEPS), 1))
    points[-1, 12:] = 40.0  # patches pushed off the link
    after = np.asarray(valued(points)[1])
    np.testing.assert_allclose(after[-2], found[1][-2], rtol=1e-12)
    # a sum over a batch that leaves it out by its status keeps the right slope
    np.testing.assert_array_equal(after[-1], 0.0)


def test_a_rounded_loop_has_the_derivative_of_the_smooth_one(monkeypatch):
    """Of runs that are replaced by powers; the long test below has real ones."""
    asked = []

    def run(structure, has_record, case):
        asked.append(has_record)
        return case**3 if structure.is_smooth else jnp.round(case**2)

    simulation = sys.modules["jaxmodel.simulate"]  # hidden by the function of that name
    monkeypatch.setattr(simulation, "_run", run)
    simulation._rounded.cache_clear()
    try:
        ways = [
            jax.value_and_grad(partial(simulate, Structure(is_smooth=x, feedback=feedback)))
            for x, feedback in ((False, "sampled"), (True, "sampled"), (False, "ideal"))
        ]
        # rounded; smooth; without converters
        assert [tuple(map(float, way(1.5))) for way in ways] == [(2, 6.75), (3.375, 6.75), (2, 0)]
        assert not any(asked)
        asked.clear()
        simulate(Structure(), 1.5, True)
        assert asked == [True]
    finally:
        simulation._rounded.cache_clear()


@pytest.mark.long
def test_a_rounded_run_has_the_derivative_of_the_smooth_one():
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
