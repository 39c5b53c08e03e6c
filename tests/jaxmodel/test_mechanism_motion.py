"""Moving cranks: energy is accounted for, steps are of fourth order."""

import itertools

import jax
import numpy as np
import pytest
from scipy.integrate import cumulative_simpson

from jaxmodel.drive import motor_force
from jaxmodel.loop import PlantState, plant_rates
from jaxmodel.mechanisms.rrr.cranks import Cranks
from jaxmodel.prepare import prepare
from studies.engine.programs import kept_jit
from tests.jaxmodel.test_integrator import MOVE_TIME, SAMPLE, energies, run, wanted_motion
from tests.jaxmodel.test_mechanisms import MACHINES, POSES, case_of

VISCOUS = 5.0  # friction of the drives [N s/m]
VOLTS = 20.0  # on all actuators [V]


_prepare = kept_jit(static_argnums=0)(prepare)


def at_home(name, modes, **changes):
    """Structure, loop and state at rest."""
    structure, case = case_of(name, control__feedback="none", link__modes=modes, **changes)
    structure = structure._replace(n_steps=1)
    loop = _prepare(structure, case).loop
    home, zero = np.array(POSES[name]), np.zeros((structure.n_links, modes))
    return structure, loop, PlantState(home, 0 * home, zero, zero, zero, zero)


class CranksWithoutCurvature(Cranks):
    """B would be accelerated along its path alone."""

    def near(self, *arguments):
        return super().near(*arguments)._replace(curvature=None)


def energy_and_work(name, legs=Cranks):
    """Energy gained and work done by motors, friction, damping and actuators [J], (N,) each."""
    structure, loop, start = at_home(name, 3, drive__viscous_friction=VISCOUS)
    plant = loop.plant._replace(legs=legs(*loop.plant.legs))
    loop, step = loop._replace(plant=plant), 2e-5
    time = step * np.arange(round(1.2 * MOVE_TIME / step) + 1)
    voltages = np.full((len(time) - 1, structure.n_links, structure.n_patches), VOLTS)
    after = run("etdrk4", structure, loop, step, 1, voltages, start)
    states = jax.tree.map(lambda x, y: np.concatenate([x[None], y]), start, after)

    @jax.jit
    @jax.vmap
    def power(state, time):
        wanted = wanted_motion(loop, start.pose, time)
        chain = plant_rates(structure, loop, state, wanted, voltages[0]).chain
        motor = motor_force(structure, loop.drive, wanted, chain.rho, chain.rho_rate)
        pushed = (motor - VISCOUS * chain.rho_rate) @ chain.rho_rate
        return pushed - (plant.damping * state.q_rate**2).sum()

    held = plant.modal_mass[:, None] * (loop.actuator @ voltages[0][..., None])[..., 0]  # [N]
    work = cumulative_simpson(power(states, time), dx=step, initial=0)
    energy = np.asarray(energies(plant, states))
    return energy - energy[0], work + (held * states.q).sum(axis=(1, 2))


@pytest.mark.parametrize(
    "name", [pytest.param("rrr", marks=pytest.mark.long), "rrr unequal", "five-bar"]
)
def test_energy_gained_is_work_done(name):
    """Motors, friction and structural damping, and actuators that bend the links at once."""
    gained, work = energy_and_work(name)
    assert gained.max() > 0.01
    np.testing.assert_allclose(work, gained, rtol=0, atol=1e-11 * gained.max())


@pytest.mark.long
def test_an_acceleration_left_out_leaves_work_unaccounted_for():
    gained, work = energy_and_work("five-bar", CranksWithoutCurvature)
    assert np.abs(work - gained).max() > 1e-4 * gained.max()


@pytest.mark.long  # in short: energy, which steps of a lower order would lose
@pytest.mark.parametrize("name", MACHINES)
def test_order_is_four(name):
    structure, loop, start = at_home(name, 8)
    shape = (100, structure.n_links, structure.n_patches)
    voltages, ends = np.random.default_rng(11).uniform(-50, 50, shape), []
    for substeps in (8, 16, 32):
        states = run("etdrk4", structure, loop, SAMPLE, substeps, voltages, start)
        ends.append(np.concatenate([states.pose, states.q[:, :, 0], states.z[:, :, 0]], axis=1))
    change = [np.abs(b - a).max(axis=0) for a, b in itertools.pairwise(ends)]
    np.testing.assert_allclose(np.log2(change[0] / change[1]), 4, atol=0.15)
