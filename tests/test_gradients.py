"""Gradients of the residual vibration agree with central differences, forward and reverse."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel.control import pole_placement
from jaxmodel.prepare import design_controller
from jaxmodel.simulate import simulate
from studies.cases import as_arrays, build_case, build_structure
from tests.test_batch import short_study

SIZES = {"velocity_gain": 3, "ratio": 3, "decay": 3, "damped_frequency": 3, "center": 3}


@pytest.fixture(scope="module")
def objective():
    """Residual vibration [um^2] as a function of one vector of 15 numbers of order 1."""
    study = short_study(
        run__smooth=True, link__modes=5, electronics__adc_noise=1e-4, drive__ripple=0.1,
        control__position_gain=(10.0, 10.0, 10.0),
    )  # fmt: skip
    structure, case = build_structure(study), as_arrays(build_case(study))
    omega = design_controller(structure, case).assembled_omega[:, 0]

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


def test_forward_reverse_and_central_differences_agree(objective):
    x = jnp.asarray(np.random.default_rng(1).uniform(0.5, 1.5, 15))
    reverse = np.asarray(jax.jit(jax.grad(objective))(x))
    forward = np.asarray(jax.jit(jax.jacfwd(objective))(x))
    step = 1e-4 * np.eye(15)
    run = jax.jit(jax.vmap(objective))
    # fourth-order central difference
    steps = np.concatenate([k * step for k in (-2, -1, 1, 2)])
    value = np.asarray(run(x + steps)).reshape(4, 15)
    central = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * 1e-4)
    scale = np.maximum(np.abs(central), 1e-3 * np.abs(central).max())
    assert np.max(np.abs(reverse - forward) / scale) < 1e-8
    assert np.max(np.abs(forward - central) / scale) < 1e-5
    # each kind of parameter matters, so that agreement is not of zeros
    assert np.all(np.abs(central).reshape(5, 3).max(axis=1) > 1e-6 * np.abs(central).max())


def test_bad_case_leaves_gradients_of_others_alone(objective):
    x = jnp.ones((2, 15))
    alone = jax.jit(jax.vmap(jax.grad(objective)))
    good = np.asarray(alone(x))[0]
    broken = x.at[1, 12:].set(40.0)  # patches pushed off the link
    after = np.asarray(alone(broken))
    np.testing.assert_allclose(after[0], good, rtol=1e-12)
    assert np.all(np.isfinite(after[1]))
