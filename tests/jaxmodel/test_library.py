"""The physics without files: a run by its numbers, M, C, K, forces, loop, margins, batches."""

import doctest
import json
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodel
from jaxmodel import (
    HOME,
    closed_loop,
    equations_of_motion,
    judge,
    linearise,
    lumped_forces,
    natural_modes,
    paper_case,
    prepare,
    simulate,
    with_values,
)
from jaxmodel.defaults import SWITCHES
from jaxmodel.dynamics import accelerations, modal_chain
from jaxmodel.judge import with_margin_modes
from studies.study import cases
from studies.study.spec import paper_study

#: A short run of a small model: a move of 5 ms, 5 ms of free vibration.
QUICK = {
    "path.waypoints": [[0.0, 0.0, np.pi / 6], [0.0, 0.001, np.pi / 6]],
    "path.move_time": 0.005,
    "shaping.kind": "none",
    "windows.residual_delay": 0.0,
    "windows.residual_length": 0.005,
}
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def quick():
    """Three modes at most, two under control."""
    return paper_case(QUICK, duration=0.012, n_modes=3, n_controlled=2)


# --- numbers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "choices, changes",
    [
        ({}, {}),
        ({"n_modes": 5, "n_controlled": 2}, {"link__modes": 5, "control__modes": 2}),
        ({"law": "ppf"}, {"control__law": "ppf"}),
        ({"drive": "sliding_mode"}, {"drive__kind": "sliding_mode"}),
    ],
)
def test_the_paper_s_run_is_that_of_its_file(choices, changes):
    study = paper_study().change(**changes, metrics__residual_delay=0.026)
    structure, case = paper_case(**choices)
    assert structure == cases.build_structure(study)
    wanted = cases.build_case(study)
    assert jax.tree.structure(case) == jax.tree.structure(wanted)
    for found, value in zip(jax.tree.leaves(case), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-11)


def test_what_is_switched_on_is_what_files_switch_on():
    assert set(SWITCHES) == set(cases.SWITCHES)
    structure, case = paper_case({"control.notch": [300.0, 0, 0], "drive.coulomb_friction": 1.0})
    assert structure == paper_case()[0]._replace(has_notch=True, has_friction=True)
    np.testing.assert_array_equal(case.control.notch, [300, 0, 0])


@pytest.mark.parametrize(
    "values, message",
    [
        ({"control.gain_facto": 1.0}, "control.gain_facto: no such number.*'gain_factor'"),
        ({"control": 1.0}, "control: holds n_active, .*; name one"),
        ({"machine.beams.length": 0.2}, "machine.beams: no such number.*'beam'"),
        ({"machine.beam.length": 200.0}, r"length = 200; allowed: 0.001 to 10 m$"),
        ({"machine.beam.length": [0.2, -0.2, 0.2]}, r"length = -0.2; allowed: 0.001 to 10 m$"),
        ({"control.velocity_gain": [1.0, 2.0]}, r"shape \(2,\); expected \(3,\) or a number"),
        ({"control.gain_factor": "much"}, "control.gain_factor = 'much'; expected numbers"),
        ({"control.gain_factor": np.nan}, "control.gain_factor = nan; allowed: 0 to 1000"),
        ({"shaping.kind": "eii"}, "shaping.kind = eii: no such choice.*'ei'"),
        ({"control.notch": 300.0}, "control.notch: left out .* has_notch = True"),
        ({"machine.patches.center": [[0.05, 0.1]] * 3}, r"shape \(3, 2\); expected \(3, 3\)"),
    ],
)
def test_wrong_numbers_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        with_values(*paper_case(), values)


def test_wrong_choices_are_refused():
    with pytest.raises(ValueError, match="n_mode: no such choice; did you mean 'n_modes'"):
        paper_case(n_mode=3)
    with pytest.raises(ValueError, match="law = imcs: no such choice; did you mean 'imsc'"):
        paper_case(law="imcs")
    with pytest.raises(ValueError, match=r"pose: shape \(2,\); expected \(3,\)"):
        equations_of_motion(*paper_case(n_modes=2), HOME[:2])


# --- equations ------------------------------------------------------------------------------------


def test_small_motions_obey_the_equations(quick):
    """M x'' + C x' + K x = F f + V v, by the nonlinear machine."""
    structure, case = quick
    found = equations_of_motion(structure, case, HOME)
    loop = prepare(structure, case).loop
    n, links = len(HOME), structure.n_links
    x, rate = 1e-10 * RNG.standard_normal((2, len(found.mass)))
    x[:n] = 0  # K has no stiffness of the platform
    force, volts = (
        1e-3 * RNG.standard_normal(links),
        1e-3 * RNG.standard_normal(found.voltage.shape[1]),
    )
    q, q_rate = (y[n:].reshape(links, -1) for y in (x, rate))
    straight = np.asarray(HOME)
    chain = modal_chain(loop.plant, straight, rate[:n], q, q_rate)
    piezo = jnp.einsum("irk,ik->ir", loop.actuator, volts.reshape(links, -1))
    moved = accelerations(loop.plant, chain, rate[:n], q, q_rate, force, piezo)
    acceleration = np.concatenate([moved.pose, np.ravel(moved.modal)])
    left = found.mass @ acceleration + found.damping @ rate + found.stiffness @ x
    right = found.force @ force + found.voltage @ volts
    assert np.abs(found.stiffness @ x).max() > 0.1 * np.abs(right).max()
    np.testing.assert_allclose(left, right, atol=1e-6 * np.abs(right).max())


def test_matrices_have_the_machine_s_own_modes(quick):
    structure, case = quick
    found = equations_of_motion(structure, case, HOME, has_drive=True)
    for matrix in found[:3]:
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    assert np.linalg.eigvalsh(found.mass).min() > 0
    free = structure._replace(feedback="none")
    modes = natural_modes(linearise(free, prepare(free, case).loop, np.array(HOME)))
    poles = np.linalg.eigvals(
        np.block(
            [
                [np.zeros_like(found.mass), np.eye(len(found.mass))],
                [-np.linalg.solve(found.mass, x) for x in (found.stiffness, found.damping)],
            ]
        )
    )
    own = np.sort(np.abs(poles[poles.imag > 0])) / (2 * np.pi)
    np.testing.assert_allclose(own[-6:], np.sort(modes.frequency)[-6:], rtol=1e-6)
    without = equations_of_motion(structure, case, HOME)
    np.testing.assert_allclose(without.stiffness[:3], 0, atol=1e-6 * np.abs(found.stiffness).max())


def test_lumped_forces_are_those_of_the_blocks(quick):
    """t_d = J_pw^T F_a - M_fr X'' - what is off the diagonal of M_ff, T_d = -M_rf q''."""
    structure, case = quick
    found, plant = equations_of_motion(structure, case, HOME), prepare(structure, case).loop.plant
    n, links = len(HOME), structure.n_links
    q = 1e-10 * RNG.standard_normal((links, structure.n_coordinates))
    rate, force = np.zeros(n), np.array([1e-3, -2e-3, 5e-4])
    lumped = lumped_forces(plant, np.array(HOME), rate, q, 0 * q, force, 0 * q)
    right = found.force @ force - found.stiffness @ np.concatenate([rate, np.ravel(q)])
    acceleration = np.linalg.solve(found.mass, right)
    own = np.diag(np.repeat(plant.modal_mass, structure.n_coordinates))
    modes = found.force[n:] @ force - found.mass[n:, :n] @ acceleration[:n]
    modes -= (found.mass[n:, n:] - own) @ acceleration[n:]
    np.testing.assert_allclose(np.ravel(lumped.modes), modes, atol=1e-5 * np.abs(modes).max())
    platform = -found.mass[:n, n:] @ acceleration[n:]
    np.testing.assert_allclose(lumped.platform, platform, atol=1e-5 * np.abs(platform).max())


# --- loops ----------------------------------------------------------------------------------------


def test_the_loop_as_a_b_c_d(quick):
    matrices = closed_loop(*quick, HOME)
    a, b, c, d = matrices.state_space()
    np.testing.assert_allclose(a, matrices.open + matrices.feedback)
    assert a.shape[0] == b.shape[0] == c.shape[1] and d.shape == (c.shape[0], b.shape[1])
    radius = [np.abs(np.linalg.eigvals(matrices.state_space(x)[0])).max() for x in (0, 1, 30)]
    assert radius[0] < 1 and radius[1] < 1 < radius[2]
    margin = judge(*quick).gain_margin
    edge = np.abs(np.linalg.eigvals(closed_loop_at(quick, float(margin)))).max()
    assert edge == pytest.approx(1, abs=2e-4)


def closed_loop_at(quick, factor):
    """The transition with all margin modes at a factor on the gains."""
    return closed_loop(*with_margin_modes(*quick), HOME).state_space(factor)[0]


# --- batches --------------------------------------------------------------------------------------


def drawn(structure, case, count):
    """Cases with drawn placement, mode counts, gains and controlled links."""
    center = np.sort(RNG.uniform(0.03, 0.17, (count, 3, structure.n_patches)), axis=2)
    return {
        "machine.patches.center": center + [-0.01, 0, 0.01],
        "n_modes": RNG.integers(1, structure.n_modes + 1, count),
        "control.n_active": RNG.integers(1, structure.n_controlled + 1, count),
        "control.gain_factor": RNG.uniform(0, 1, count),
        "control.link_mask": RNG.integers(0, 2, (count, 3)).astype(float),
    }


def test_a_thousand_combinations_are_as_many_single_runs(quick):
    structure, case = quick
    values, traced = drawn(structure, case, 1000), []

    def residual(values):
        traced.append(1)
        result = simulate(structure, with_values(structure, case, values))
        return result.metrics.residual_rms, result.metrics.peak_voltage, result.status

    many = jax.jit(jax.vmap(residual))(values)
    assert len(traced) == 1
    single = jax.jit(residual)
    for k in range(1000):
        one = single({name: x[k] for name, x in values.items()})
        for found, wanted in zip(many, one, strict=True):
            np.testing.assert_allclose(found[k], wanted, rtol=1e-12, atol=1e-18)
    assert len(traced) == 2 and len(np.unique(np.asarray(many[0]).round(12))) > 500


def own_loss(structure, case):
    """A loss of pole decays and EMC ratios."""

    def loss(free):
        values = {"control.velocity_gain": free[:3], "control.ratio": free[3:].reshape(3, 2)}
        result = simulate(structure, with_values(structure, case, values))
        return 1e12 * jnp.sum(result.metrics.residual_rms**2)

    return loss


def test_gradients_and_hessians_of_an_own_loss():
    structure, case = paper_case(QUICK, duration=0.012, n_modes=2, n_controlled=2, is_smooth=True)
    loss = jax.jit(own_loss(structure, case))
    free = np.array([0.8, 0.9, 0.9, 1, 0.3, 1, 0.3, 1, 0.3])
    slope = jax.jit(jax.grad(loss))(free)
    for k in (0, 4):
        step = 1e-4 * np.eye(9)[k]
        wanted = (loss(free + step) - loss(free - step)) / 2e-4
        assert slope[k] == pytest.approx(wanted, rel=1e-5)
    curvature = np.asarray(jax.jit(jax.hessian(loss))(free))
    assert np.isfinite(curvature).all() and np.abs(curvature).max() > 0
    np.testing.assert_allclose(curvature, curvature.T, atol=1e-8 * np.abs(curvature).max())


SHARDED = """
import json, sys
import jax, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
jax.config.update("jax_enable_x64", True)
from jaxmodel import paper_case, simulate, with_values
structure, case = paper_case(json.loads(sys.argv[1]), duration=0.012, n_modes=2, n_controlled=2)
def run(gain):
    return simulate(structure, with_values(structure, case, {"control.gain_factor": gain}))
gains = np.linspace(0.1, 1, 8)
program = jax.vmap(lambda gain: run(gain).metrics.residual_rms)
alone = jax.jit(program)(gains)
for kind in (AxisType.Auto, AxisType.Explicit):
    mesh = jax.make_mesh((4,), ("cases",), axis_types=(kind,))
    with jax.set_mesh(mesh):
        on_each = jax.shard_map(program, in_specs=P("cases"), out_specs=P("cases"), check_vma=False)
        whole = program if kind is AxisType.Auto else on_each
        spread = jax.jit(whole)(jax.device_put(gains, NamedSharding(mesh, P("cases"))))
    assert len(spread.sharding.device_set) == 4, spread.sharding
    np.testing.assert_allclose(spread, alone, rtol=1e-12)
print("equal on", len(jax.devices()))
"""


def test_a_batch_on_four_devices_is_that_on_one():
    flags = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, "-c", SHARDED, json.dumps(QUICK)]
    done = subprocess.run(command, env=flags, capture_output=True, text=True, timeout=300)
    assert done.stdout == "equal on 4\n", done.stderr[-2000:]


# --- examples -------------------------------------------------------------------------------------

FUNCTIONS = [x for x in jaxmodel.__all__ if callable(getattr(jaxmodel, x))]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_name_has_an_example_that_runs(name):
    one = getattr(jaxmodel, name)
    given = vars(jaxmodel) | {x: getattr(jaxmodel, x) for x in jaxmodel.__all__}
    given |= {"jax": jax, "jnp": jnp, "np": np}
    (test,) = doctest.DocTestFinder(recurse=False).find(one, name, globs=given)
    assert test.examples, f"{name} has no example"
    said = []
    doctest.DocTestRunner().run(test, out=said.append)
    assert not said, "".join(said)
