"""The physics without files: a run by its numbers, M, C, K, forces, loop, margins, batches."""

import doctest
import inspect
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmodel
from jaxmodel import (
    HOME,
    closed_loop,
    ei,
    equations_of_motion,
    linearise,
    lumped_forces,
    natural_modes,
    paper_case,
    prepare,
    simulate,
    status,
)
from jaxmodel.dynamics import accelerations, modal_chain
from jaxmodel.simulate import begin
from studies.study.cases import build_case, build_structure
from studies.study.paths import set_values
from studies.study.spec import paper_study, parse_study

#: A short run of a small model: a move of 5 ms, 5 ms of free vibration.
QUICK = {
    "run.duration": 0.012,
    "link.modes": 3,
    "control.modes": 2,
    "motion.waypoints": [[0.0, 0.0, np.pi / 6], [0.0, 0.001, np.pi / 6]],
    "motion.move_time": 0.005,
    "shaper.kind": "none",
    "metrics.residual_delay": 0.0,
    "metrics.residual_length": 0.005,
}
RNG = np.random.default_rng(0)


@pytest.fixture(scope="module")
def quick():
    return paper_case(QUICK)


# --- numbers --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"link.modes": 5, "control.modes": 2},
        {"control.law": "ppf", "control.laws.ppf.filter_damping": 0.4},
        {"drive.kind": "sliding_mode", "drive.coulomb_friction": 1.0},
        {"control.notch_hz": (300.0, 0.0, 200.0), "control.damping": (0.1, 0.2, 0.1)},
        {
            "patches.centers": ((0.05, 0.15),) * 3,
            "control.modes": 2,
            "link.basis": "pinned_free",
            "run.smooth": True,
        },
        {"link.length": 0.22, "motion.move_time": (0.1, 0.2, 0.1, 0.2), "shaper.kind": "zvd"},
        {"patches.centers": (0.04, 0.1, 0.15), "control.pole_decay": (20.0, 30.0, 20.0)},
        {"control.pole_decay": 20.0, "control.pole_frequency_hz": ((100.0,),) * 3},
        {"control.pole_decay": ((20.0,),) * 3, "link.damping_ratio": (0.01, 0.02)},
        {"control.damping": 0.1, "control.frequencies_hz": (90.0, 300.0)},
    ],
)
def test_a_case_is_that_of_a_file_with_the_same_numbers(values):
    study = paper_study().change(metrics__residual_delay=0.026)
    study = parse_study(set_values(study, values))
    structure, case = paper_case(values)
    assert structure == build_structure(study)
    wanted = build_case(study)
    assert jax.tree.structure(case) == jax.tree.structure(wanted)
    for found, value in zip(jax.tree.leaves(case), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(found, value, rtol=1e-12)


@pytest.mark.parametrize(
    "values, message",
    [
        ({"control.gain_facto": 1.0}, "control.gain_facto: no such field.*'control.gain_factor'"),
        ({"link.length": 200.0}, r"link.length = 200; allowed: .* >= 0.001 and <= 10 \[m\]$"),
        ({"link.length": [0.2, -0.2, 0.2]}, "link.length = -0.2; allowed: "),
        ({"control.velocity_gain": [1.0, 2.0]}, r"shape \(2,\); expected \(3,\) or a number"),
        ({"control.gain_factor": "much"}, "gain_factor = 'much'; allowed: a finite number >= 0"),
        ({"control.gain_factor": np.nan}, "gain_factor = nan; allowed: a finite number >= 0"),
        ({"control.laws.ppf.damping_ratio": -1}, "no such field"),
        ({"shaper.kind": "eii"}, "shaper.kind = eii: no such choice; allowed: none, .*'ei'"),
        ({"control.law": "imcs"}, "control.law = imcs: no such choice.*'imsc'"),
        ({"control.ratios": [1.0, 0.3, 0.1]}, r"ratios: shape \(3,\); expected \(3, n\)"),
        ({"control.ratios": [[1.0, 0.3]] * 2}, r"ratios: shape \(2, 2\); expected \(3, n\)"),
        ({"patches.centers": np.full((2, 3), 0.1)}, r"centers: shape \(2, 3\); expected \(3, n\)"),
        (
            {"patches.sensor_factor": [1.0, 1.0]},
            r"sensor_factor: shape \(3, 2\); expected \(3, 3\)",
        ),
        ({"motion.waypoints": [[0.0, 0.0]]}, r"waypoints: shape \(1, 2\); expected \(n, 3\)"),
        ({"shaper.frequencies_hz": 90.0}, r"frequencies_hz: shape \(\); expected \(n,\)"),
        ({"motion.move_time": [0.1, 0.2]}, r"move_time: shape \(2,\); expected \(4,\)"),
        ({"electronics.lowpass_ratio": []}, r"lowpass_ratio: shape \(0,\); expected \(n,\)"),
        ({"machine.joint_angles_deg": (1, 2)}, r"angles_deg: shape \(2,\); expected \(3,\)"),
        ({"control.basis": np.array([])}, "control.basis = .*: no such choice; allowed: "),
        ({"control.gain_factor": True}, "gain_factor = True; allowed: a finite number"),
        ({"control.links": [2, 1, 0]}, "control.links = 2; allowed: .* true or false"),
        ({"link.modes": 2.5}, "link.modes = 2.5; allowed: a whole number"),
        ({"link.modes": "2"}, "link.modes = '2'; allowed: a whole number"),
        ({"control.gain_factor": None}, "gain_factor = None; allowed: a finite number"),
    ],
)
def test_wrong_numbers_are_refused(values, message):
    with pytest.raises(ValueError, match=message):
        paper_case(values)


def test_counts_of_modes_are_checked():
    for values, count, message in (
        ({}, 40, "n_modes = 40; allowed: a whole number >= 1 and <= 16"),
        ({"link.modes": 3}, 2, "link.modes = 3; allowed: up to n_modes = 2"),
    ):
        with pytest.raises(ValueError, match=message):
            paper_case(values, n_modes=count)


def test_traced_numbers_that_are_not_allowed_give_a_status():
    values = {
        "link.modes": np.array([2, 40, 0, 3, 2, 2, 2]),
        "control.gain_factor": np.array([0.5, 0.5, 0.5, -1, np.nan, 0.5, 0.5]),
        "control.links": np.array([[1.0] * 3] * 5 + [[2.0, 1, 1], [0.0, 1, 1]]),
    }

    def run(values):
        result = simulate(*paper_case(QUICK | values, n_modes=3, n_controlled=2))
        return result.status, result.metrics.residual_rms

    code, left = jax.jit(jax.vmap(run))(values)
    is_fine = np.array([1, 0, 0, 0, 0, 0, 1], bool)
    np.testing.assert_array_equal(np.asarray(code)[~is_fine], status.NON_FINITE)
    np.testing.assert_array_equal(np.isfinite(left).all(axis=(1, 2)), is_fine)


def test_no_machine_has_no_matrices(quick):
    structure, case = quick
    overlapping = paper_case(QUICK | {"patches.centers": (0.05, 0.06, 0.15)})
    for given, pose in (
        (quick, (0.0, 1.0, 0.5)),
        (quick, (np.nan, 0.0, 0.5)),
        (overlapping, HOME),
    ):
        found = equations_of_motion(*given, np.array(pose))
        assert all(np.isnan(x).all() for x in found)
        assert np.isnan(closed_loop(*given, np.array(pose)).state_space()[0]).any()


@pytest.mark.parametrize("name, value", [("omega", -1.0), ("zeta", 1.0), ("tolerance", np.nan)])
def test_a_shaper_says_which_number_is_wrong(name, value):
    numbers = {"omega": 700.0, "zeta": 0.01, "tolerance": 0.05} | {name: value}
    with pytest.raises(ValueError, match=f"{name} = {value:g}; allowed: "):
        ei(**numbers)


def test_what_must_be_known_before_is_not_traced():
    for name, message in (
        ("link.modes", "n_modes: missing; expected the largest link.modes"),
        ("run.duration", "run.duration: traced"),
    ):
        with pytest.raises(ValueError, match=message):
            jax.jit(lambda x, name=name: paper_case({name: x})[1])(4.0)
    with pytest.raises(ValueError, match=r"pose: shape \(2,\); expected \(3,\)"):
        equations_of_motion(*paper_case({"link.modes": 2}), HOME[:2])


# --- equations ------------------------------------------------------------------------------------


def test_small_motions_obey_the_equations(quick):
    """M x'' + C x' + K x = F f + V v, by the nonlinear machine."""
    structure, case = quick
    mass, damping, stiffness, by_force, by_volts = equations_of_motion(structure, case, HOME)
    loop = prepare(structure, case).loop
    n, links = len(HOME), structure.n_links
    x, rate = 1e-10 * RNG.standard_normal((2, len(mass)))
    x[:n] = 0  # K has no stiffness of the platform
    force, volts = (1e-3 * RNG.standard_normal(y.shape[1]) for y in (by_force, by_volts))
    q, q_rate = (y[n:].reshape(links, -1) for y in (x, rate))
    chain = modal_chain(loop.plant, np.asarray(HOME), rate[:n], q, q_rate)
    piezo = jnp.einsum("irk,ik->ir", loop.actuator, volts.reshape(links, -1))
    moved = accelerations(loop.plant, chain, rate[:n], q, q_rate, force, piezo)
    acceleration = np.concatenate([moved.pose, np.ravel(moved.modal)])
    left = mass @ acceleration + damping @ rate + stiffness @ x
    right = by_force @ force + by_volts @ volts
    assert np.abs(stiffness @ x).max() > 0.1 * np.abs(right).max()
    np.testing.assert_allclose(left, right, atol=1e-6 * np.abs(right).max())


def test_matrices_have_the_machine_s_own_modes(quick):
    structure, case = quick
    found = equations_of_motion(structure, case, HOME, has_drive=True)[:3]
    for matrix in found:
        np.testing.assert_allclose(matrix, matrix.T, atol=1e-9 * np.abs(matrix).max())
    mass, damping, stiffness = found
    assert np.linalg.eigvalsh(mass).min() > 0
    free = structure._replace(feedback="none")
    modes = natural_modes(linearise(free, prepare(free, case).loop, np.array(HOME)))
    blocks = [np.zeros_like(mass), np.eye(len(mass))]
    blocks = [blocks, [-np.linalg.solve(mass, x) for x in (stiffness, damping)]]
    poles = np.linalg.eigvals(np.block(blocks))
    own = np.sort(np.abs(poles[poles.imag > 0])) / (2 * np.pi)
    np.testing.assert_allclose(own[-6:], np.sort(modes.frequency)[-6:], rtol=1e-6)
    without = equations_of_motion(structure, case, HOME)[2]
    np.testing.assert_allclose(without[:3], 0, atol=1e-6 * np.abs(stiffness).max())


def test_lumped_forces_are_those_of_the_blocks(quick):
    """t_d = J_pw^T F_a - M_fr X'' - what is off the diagonal of M_ff, T_d = -M_rf q''."""
    structure, case = quick
    mass, _, stiffness, by_force, _ = equations_of_motion(structure, case, HOME)
    plant, n = prepare(structure, case).loop.plant, len(HOME)
    q = 1e-10 * RNG.standard_normal((structure.n_links, structure.n_coordinates))
    rate, force = np.zeros(n), np.array([1e-3, -2e-3, 5e-4])
    platform, modes = lumped_forces(plant, np.array(HOME), rate, q, 0 * q, force, 0 * q)
    right = by_force @ force - stiffness @ np.concatenate([rate, np.ravel(q)])
    acceleration = np.linalg.solve(mass, right)
    own = np.diag(np.repeat(plant.modal_mass, structure.n_coordinates))
    wanted = by_force[n:] @ force - mass[n:, :n] @ acceleration[:n]
    wanted -= (mass[n:, n:] - own) @ acceleration[n:]
    np.testing.assert_allclose(np.ravel(modes), wanted, atol=1e-5 * np.abs(wanted).max())
    wanted = -mass[:n, n:] @ acceleration[n:]
    np.testing.assert_allclose(platform, wanted, atol=1e-5 * np.abs(wanted).max())


# --- loops ----------------------------------------------------------------------------------------


def test_the_loop_as_a_b_c_d(quick):
    matrices = closed_loop(*quick, HOME)
    a, b, c, d = matrices.state_space()
    np.testing.assert_allclose(a, matrices.open + matrices.feedback)
    assert a.shape[0] == b.shape[0] == c.shape[1] and d.shape == (c.shape[0], b.shape[1])
    radius = [np.abs(np.linalg.eigvals(matrices.state_space(x)[0])).max() for x in (0, 1, 30)]
    assert radius[0] < 1 and radius[1] < 1 < radius[2]


# --- batches --------------------------------------------------------------------------------------


def drawn(count):
    """Drawn placements, mode counts, gains and controlled links."""
    center = [0.05, 0.1, 0.15] + RNG.uniform(-0.008, 0.008, (count, 3, 3))
    return {
        "patches.centers": center,
        "link.modes": RNG.integers(1, 4, count),
        "control.modes": RNG.integers(1, 3, count),
        "control.gain_factor": RNG.uniform(0, 1, count),
        "control.links": RNG.integers(0, 2, (count, 3)).astype(float),
    }


def test_a_thousand_combinations_are_as_many_single_runs():
    values, traced = drawn(1000), []

    def residual(values):
        traced.append(1)
        result = simulate(*paper_case(QUICK | values, n_modes=3, n_controlled=2))
        return result.metrics.residual_rms, result.metrics.peak_voltage, result.status

    many = jax.jit(jax.vmap(residual))(values)
    assert len(traced) == 1
    single = jax.jit(residual)
    for k in range(1000):
        one = single({name: x[k] for name, x in values.items()})
        for found, wanted in zip(many, one, strict=True):
            np.testing.assert_allclose(found[k], wanted, rtol=1e-12, atol=1e-18)
    assert len(traced) == 2 and len(np.unique(np.asarray(many[0]).round(12))) > 500


def own_loss(free):
    """A loss of velocity gains and EMC ratios."""
    values = {"control.velocity_gain": free[:3], "control.ratios": free[3:].reshape(3, 2)}
    result = simulate(*paper_case(QUICK | {"link.modes": 2, "run.smooth": True} | values))
    return 1e12 * jnp.sum(result.metrics.residual_rms**2)


@pytest.mark.long  # in short: tests of gradients, and the derivatives of batched studies
def test_gradients_and_hessians_of_an_own_loss():
    loss, free = jax.jit(own_loss), np.array([0.8, 0.9, 0.9, 1, 0.3, 1, 0.3, 1, 0.3])
    slope = jax.jit(jax.grad(own_loss))(free)
    for k in (0, 4):
        step = 1e-4 * np.eye(9)[k]
        wanted = (loss(free + step) - loss(free - step)) / 2e-4
        assert float(slope[k]) == pytest.approx(float(wanted), rel=1e-5)
    curvature = np.asarray(jax.jit(jax.jacfwd(jax.jacfwd(own_loss)))(free))
    assert np.isfinite(curvature).all() and np.abs(curvature).max() > 0
    np.testing.assert_allclose(curvature, curvature.T, atol=1e-8 * np.abs(curvature).max())


SHARDED = """
import json, sys
import jax, numpy as np
from jax.sharding import AxisType, NamedSharding, PartitionSpec as P
jax.config.update("jax_enable_x64", True)
from jaxmodel import paper_case, simulate
def run(gain):
    return simulate(*paper_case(json.loads(sys.argv[1]) | {"control.gain_factor": gain}))
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


@pytest.mark.long  # in short: notebook 12, on one device
def test_a_batch_on_four_devices_is_that_on_one():
    flags = os.environ | {"XLA_FLAGS": "--xla_force_host_platform_device_count=4"}
    command = [sys.executable, "-c", SHARDED, json.dumps(QUICK)]
    done = subprocess.run(command, env=flags, capture_output=True, text=True, timeout=300)
    assert done.stdout == "equal on 4\n", done.stderr[-2000:]


# --- examples -------------------------------------------------------------------------------------

FUNCTIONS = [x for x in jaxmodel.__all__ if inspect.isfunction(getattr(jaxmodel, x))]


def test_every_public_function_has_an_example():
    assert [x for x in FUNCTIONS if ">>>" not in (getattr(jaxmodel, x).__doc__ or "")] == []


@pytest.mark.long  # in short: the one above
@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_public_function_has_an_example_that_runs(name):
    one = getattr(jaxmodel, name)
    given = vars(jaxmodel) | {x: getattr(jaxmodel, x) for x in jaxmodel.__all__}
    given |= {"jax": jax, "jnp": jnp, "np": np, "begin": begin}
    (test,) = doctest.DocTestFinder(recurse=False).find(one, name, globs=given)
    assert test.examples, f"{name} has no example"
    said = []
    doctest.DocTestRunner().run(test, out=said.append)
    assert not said, "".join(said)


def test_no_module_has_the_name_of_something_public():
    """Importing it would put the module in the place of the function."""
    homes = {name: getattr(jaxmodel, name).__module__ for name in FUNCTIONS}
    modules = {x.stem for x in Path(jaxmodel.__file__).parent.glob("*.py")}
    assert {x for x, home in homes.items() if x in modules and home != f"jaxmodel.{x}"} == set()


def test_a_traced_number_of_a_law_is_checked_too():
    def length(damping):
        values = {"control.law": "ppf", "control.laws.ppf.filter_damping": damping}
        return paper_case(values)[1].machine.beam.length

    length = jax.jit(length)
    assert np.isfinite(length(0.4)).all() and np.isnan(length(-0.4)).all()
