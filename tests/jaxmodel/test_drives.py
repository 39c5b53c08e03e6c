"""Drives of the sliders: each law on one mass against closed forms, and in the loop."""

import tomllib
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.case import Drive
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw, SliderError, drive_gains
from jaxmodel.simulate import begin, simulate
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.export import c_drive
from studies.export.c_drive import compare_drive, drive_code
from studies.export.compiler import find_compiler
from studies.extensions import extend
from studies.study.cases import build_structure
from studies.study.window import settling_time
from studies.verify.loops import _release
from tests.bare import parse_study
from tests.jaxmodel.kept import arrays, loop_at, simulated
from tests.studies.kernels.test_kernel import both, check_equal
from tests.sweeps import small_spec

SAMPLED = [name for name, law in DRIVES.items() if law.is_sampled]
#: One fast move of a small machine.
MOVE = tomllib.loads("""
[run]
duration = 0.05
[link]
modes = 2
[motion]
waypoints = [[0, 0, 0.5236], [0, 0.01, 0.5236]]
move_time = 0.02
[shaper]
kind = "none"
[control]
modes = 2
ratios = [[1.0, 0.3], [1.0, 0.3], [1.0, 0.3]]
[metrics]
residual_delay = 0.01
residual_length = 0.01
arrival_tolerance = 0.1
""")
MASS = 0.185


def short_ones(names, kept):
    """All as parameters; those not kept are long."""
    return [pytest.param(x, marks=[] if x in kept else pytest.mark.long) for x in names]


def numbers(name, **own):
    """Numbers of a drive for three equal sliders."""
    parameters = {x.name: own.get(x.name, x.default) for x in DRIVES[name].parameters}
    each = {key: jnp.full(3, float(value)) for key, value in parameters.items()}
    rest = dict.fromkeys(Drive._fields, jnp.zeros(3))
    gains = {"kp": jnp.full(3, 2e4), "kd": jnp.full(3, 60.0), "force_limit": jnp.full(3, 1e9)}
    return Drive(**(rest | gains | {"parameters": each}))


def slide(name, disturbance, period=1e-4, rate=0.0, **own):
    """Errors of a mass under force F one sample late and disturbance d: m e'' = -F - d.

    disturbance: at the middle of each sample [N], (n,) or by slider (n, 3). rate: e' at the start
    [m/s], () or (3,).

    Returns e and e' at the instants, (n,) each, or (n, 3). Exact for forces that are held.
    """
    law, drive = DRIVES[name], numbers(name, **own)

    def one(state, d):
        e, v, force, memory = state
        error = SliderError(e, v)
        demand = law.force(drive, memory, error, False)
        after = memory if law.update is None else law.update(drive, memory, error, force, period)
        push = -(force + d) / MASS
        moved = e + period * v + period**2 / 2 * push
        return (moved, v + period * push, demand, after), (e, v)

    zero = jnp.zeros(3)
    memory = None if law.update is None else zero
    start = (zero, zero + rate, zero, memory)
    found = jax.tree.map(np.asarray, jax.lax.scan(one, start, jnp.asarray(disturbance))[1])
    return found if np.ndim(disturbance) == 2 else tuple(x[:, 0] for x in found)


def test_observer_leaves_no_error_of_a_constant_force_and_the_predicted_one_of_a_ramp():
    n, period, g, slope = 2_500, 1e-4, 300.0, 40.0
    time = period * (np.arange(n) + 0.5)
    pushed = np.stack([np.full(n, 5.0), slope * time, 0 * time], axis=1)
    error, _ = slide("disturbance_observer", pushed)
    assert np.abs(error[:, 0]).max() > 1e-5 and np.abs(error[-1, 0]) < 1e-15
    np.testing.assert_allclose(error[-1, 1], -slope * (1 / g + period) / 2e4, rtol=1e-6)
    # without an observer's bandwidth it is the PD: d/Kp
    error, _ = slide("disturbance_observer", np.full(n, 5.0), bandwidth=0.0)
    np.testing.assert_allclose(error[-1], -5.0 / 2e4, rtol=1e-6)


def test_sliding_mode_reaches_its_layer_in_time_and_keeps_the_predicted_error():
    force, layer, decay, rate, period = 40.0, 0.1, 150.0, 1.0, 1e-5
    d = np.array([0.0, 8.0, -8.0])
    error, speed = slide("sliding_mode", np.tile(d, (600, 1)), period, rate)
    s = speed + decay * error
    reached = period * np.argmax(s < layer, axis=0)
    wanted = MASS * (rate - layer) / (force + d)
    assert np.all(np.abs(reached - wanted) < 4 * period)  # a sample late, and seen at instants
    error, _ = slide("sliding_mode", np.tile(d, (2500, 1)), 1e-4, rate)
    np.testing.assert_allclose(error[-1], -layer * d / (force * decay), rtol=1e-6, atol=1e-15)


def twisted(period, rate, disturbance, layer=1e-14, **own):
    """Sliding variable of a super-twisting drive from e' = rate on, (n, 3)."""
    error, speed = slide("super_twisting", disturbance, period, rate, layer=layer, **own)
    return speed + 150.0 * error


def test_super_twisting_converges_in_finite_time_which_is_homogeneous():
    """Without disturbance the flow is homogeneous: four times s takes twice as long."""
    period, n, rate = 1e-5, 5_000, np.array([0.02, 0.08, 0.0])
    s = np.abs(twisted(period, rate, np.zeros((n, 3))))
    times = [period * np.flatnonzero(s[:, k] > 1e-3 * rate[k])[-1] for k in (0, 1)]
    assert 1e-3 < times[0] < 0.03
    assert times[1] / times[0] == pytest.approx(2.0, rel=0.02)


def test_super_twisting_rejects_a_disturbance_of_known_slope_to_second_order_in_the_period():
    """|s| stays within O(T^2) of 0 (Levant 1993); a steeper disturbance is not rejected."""
    worst = []
    for period in (4e-5, 2e-5):
        time = period * (np.arange(round(0.06 / period)) + 0.5)
        d = 500.0 / 200.0 * np.sin(200.0 * time)[:, None] * np.array([1.0, 4.0, 0.0])
        s = twisted(period, 0.05, d)
        worst.append(np.abs(s[len(s) // 2 :]).max(axis=0))
    assert 1.7 < np.log2(worst[0][0] / worst[1][0]) < 2.3
    assert worst[1][1] > 100 * worst[1][0]


@pytest.mark.parametrize("name", DRIVES)
def test_gains_of_small_motions(name):
    gains = drive_gains(DRIVES[name], numbers(name))
    kp, kd = {
        "pd": (2e4, 60.0),
        "computed_torque": (2e4, 60.0),
        "disturbance_observer": (2e4, 60.0 + 300 * MASS),
        "sliding_mode": (400.0 * 150, 400.0 + MASS * 150),
        "super_twisting": (
            150 * 15 * np.sqrt(500 * MASS),
            15 * np.sqrt(500 * MASS) + MASS * 150,
        ),
    }[name]
    np.testing.assert_allclose(gains.position, kp, rtol=1e-12)
    np.testing.assert_allclose(gains.rate, kd, rtol=1e-12)


def study_of(name, **changes):
    return parse_study(MOVE).change(drive__kind=name, **changes)


def test_window_waits_for_the_drive():
    """With a good model an observer adds poles and leaves those of the PD where they are."""
    times = {name: settling_time(study_of(name)) for name in DRIVES}
    assert times["computed_torque"] == times["pd"]
    assert times["disturbance_observer"] == pytest.approx(times["pd"], rel=0.05)
    # down the sliding line with lambda, at least
    assert times["sliding_mode"] == pytest.approx(np.log(50) / 150, rel=0.1)


def peak_error(study):
    """Of the platform's place in a run [m]."""
    structure, case = arrays(study)
    found = simulated(structure._replace(metrics=("pose_error_peak",)), case, False)
    return np.max(found.metrics.pose_error_peak[:2])


@pytest.mark.long  # in short: one step a sample, below
def test_computed_torque_follows_with_rigid_links_to_the_order_of_the_integrator():
    """`ked` moves the pose as if links were rigid: RK4's error remains, and falls sixteenfold."""
    study = study_of("computed_torque", run__model="ked", control__feedback="none")
    once, twice = (peak_error(study.change(run__substeps=steps)) for steps in (1, 2))
    assert once < 1e-9 and 10 < once / twice < 24


_begin = kept_jit(static_argnums=0)(begin)


def test_computed_torque_has_the_mass_that_it_is_told():
    """The true mass moves; forces are those of a machine with 80 % of platform and payload."""
    heavy, light = (
        study_of(
            "computed_torque",
            drive__model_mass=share,
            machine__platform_mass=0.25 * of,
            machine__platform_inertia=3e-4 * of,
            load__mass=0.1 * of,
            load__inertia=1e-4 * of,
            load__offset=(0.01, -0.02),
        )
        for share, of in ((0.8, 1.0), (1.0, 0.8))
    )
    forces = [np.asarray(_begin(*arrays(study)).inputs.feedforward) for study in (heavy, light)]
    np.testing.assert_allclose(*forces, rtol=1e-9, atol=1e-9 * np.abs(forces).max())
    known = study_of("computed_torque", run__model="ked", control__feedback="none")
    errors = [peak_error(known.change(drive__model_mass=share)) for share in (1.0, 0.8)]
    assert errors[0] < 1e-9 and errors[1] > max(1e3 * errors[0], 1e-5)


@pytest.mark.parametrize("name", short_ones(SAMPLED, ["super_twisting"]))
def test_simulated_release_is_that_of_the_linear_sampled_loop(name):
    """The nonlinear run of a small release against powers of the transition matrix."""
    assert _release(study_of(name, drive__lag=5e-4)).difference < 1e-3


@pytest.mark.long  # in short: all operations of a loop, in test_delay
@pytest.mark.parametrize("name", SAMPLED)
def test_kernel_equals_scan(name):
    parameters = DRIVES[name].parameters[:2]
    axes = {
        f"drive.kinds.{name}.{x.name}": {"from": 0.5 * x.default, "to": 1.5 * x.default}
        for x in parameters
    }
    sections = {
        "link": {"modes": 2},
        "drive": {
            "kind": name,
            "coulomb_friction": 0.5,
            "friction_speed": 0.05,
            "ripple": 0.3,
            "force_limit": 3.0,
        },
        "metrics": {
            "residual_delay": 0.0,
            "residual_length": 0.004,
            "saturation_limit": 1.0,
            "arrival_tolerance": 1.0,
        },
    }
    fast, reference = both(small_spec({"method": "random", "count": 8, "axes": axes}, **sections))
    assert np.all(reference.status == status.OK)
    assert np.max(reference.metrics.motor_saturated_fraction) > 0
    assert len(np.unique(reference.metrics.pose_error_peak[:, 1])) >= 8
    check_equal(fast, reference)


@pytest.mark.long
@pytest.mark.parametrize("name", SAMPLED)
def test_gradients_by_a_drives_own_numbers_equal_differences(name):
    study = study_of(
        name, run__smooth=True, drive__coulomb_friction=0.5, drive__friction_speed=0.05
    )
    structure = build_structure(study)._replace(
        metrics=("pose_error_rms", "residual_rms"), n_frequencies=1, n_steps=420
    )
    case = arrays(study)[1]

    def objective(x):
        own = {key: value * x[k] for k, (key, value) in enumerate(case.drive.parameters.items())}
        found = simulate(structure, case._replace(drive=case.drive._replace(parameters=own)))
        moved = jnp.sum((1e6 * found.metrics.pose_error_rms[:2]) ** 2)
        return moved + jnp.sum((1e6 * found.metrics.residual_rms) ** 2)

    options = {"xla_backend_optimization_level": 0}
    at, step = jnp.ones(len(case.drive.parameters)), 1e-4
    backward = np.asarray(jax.jit(jax.grad(objective), compiler_options=options)(at))
    points = jnp.concatenate([at + k * step * jnp.eye(at.size) for k in (-2, -1, 1, 2)])
    many = jax.jit(lambda x: jax.lax.map(objective, x, batch_size=4), compiler_options=options)
    value = np.asarray(many(points)).reshape(4, -1)
    central = (value[0] - 8 * value[1] + 8 * value[2] - value[3]) / (12 * step)
    assert np.all(np.abs(central) > 1e-6 * np.abs(central).max()), central
    scale = np.maximum(np.abs(central), 1e-3 * np.abs(central).max())
    np.testing.assert_array_less(np.abs(backward - central) / scale, 1e-4)
    if name != "super_twisting":  # those that are long
        push = jax.jit(lambda d: jax.jvp(objective, (at,), (d,))[1], compiler_options=options)
        forward = np.array([push(d) for d in jnp.eye(at.size)])
        np.testing.assert_array_less(np.abs(forward - backward) / scale, 1e-8)


@pytest.mark.skipif(not find_compiler(), reason="needs a C compiler")
def test_exported_c_of_every_sampled_drive_equals_the_drive_in_jax():
    """Strict C99 in both precisions, along a random motion that reaches the motors' limit."""
    for name in SAMPLED:
        study = study_of(name)
        structure, case = arrays(study)
        exported = SimpleNamespace(structure=structure, case=case)
        code = drive_code(exported, "servo", ["a test"])
        double, single = compare_drive(code, find_compiler())
        assert double < 1e-12 and 1e-9 < single < 1e-3, name
        weaker = code._replace(
            drive=code.drive._replace(kp=0.9 * code.drive.kp, force_limit=np.full(3, 2e3))
        )
        if name == "disturbance_observer":  # the comparison can fail
            assert compare_drive(weaker, find_compiler())[0] > 1e-3
    study = study_of("pd")
    exported = SimpleNamespace(structure=build_structure(study), case=None)
    assert drive_code(exported, "servo", []) is None


@pytest.mark.skipif(not find_compiler(), reason="needs a C compiler")
@pytest.mark.parametrize("name", SAMPLED)
def test_an_argument_that_is_not_finite_does_not_stay_in_a_drive(name):
    """Each motor has another argument that is not finite for five samples."""
    study = study_of(name)
    structure, case = arrays(study)
    exported = SimpleNamespace(structure=structure, case=case)
    code = drive_code(exported, "servo", ["a test"])
    signals = np.ones((3, 20, 3)) * np.array([1e-4, 0.01, 10.0])[:, None, None]
    broken = signals.copy()
    broken[[0, 1, 2], :5, [0, 1, 2]] = [np.nan, np.inf, -np.inf, np.nan, np.nan]
    wanted = c_drive._run(code, find_compiler(), np.float64, *signals)
    found = c_drive._run(code, find_compiler(), np.float64, *broken)
    assert np.all(wanted != 0) and np.all(found[:5] == 0)
    np.testing.assert_array_equal(found[5:], wanted[:-5])


def test_a_drive_too_stiff_for_its_delay_is_unstable_in_the_loop_that_is_judged():
    """K/phi above m/T, 1.85 kN s/m, of which a drive in continuous time knows nothing."""

    study = study_of("sliding_mode", drive__kinds={"sliding_mode": {"layer": 0.1}})
    structure, case = arrays(study)

    def radius_of(layer):
        own = case.drive.parameters | {"layer": layer * np.ones(3)}
        changed = case._replace(drive=case.drive._replace(parameters=own))
        loop = loop_at(structure._replace(n_steps=1), changed, np.array(study.motion.waypoints[0]))
        return np.abs(np.linalg.eigvals(loop.open)).max()

    radius = [radius_of(layer) for layer in (0.1, 0.04, 0.02, 0.01)]
    assert radius[0] < 1 and radius[1] < 1 < radius[2] < radius[3]


def fault(**drive):
    with pytest.raises(StudyError) as error:
        parse_study({"drive": drive})
    return str(error.value)


def test_faults_name_field_value_range_and_unit():
    assert "drive.kind = 'sliding'" in fault(kind="sliding")
    assert "did you mean 'sliding_mode'?" in fault(kind="sliding_mod")
    text = fault(kinds={"sliding_mode": {"layer": 0.0}})
    assert "drive.kinds.sliding_mode.layer = 0.0; allowed: 1e-06 to 100 [m/s]" in text
    text = fault(kinds={"sliding_mode": {"layr": 0.1}})
    assert "drive.kinds.sliding_mode.layr" in text and "did you mean 'layer'?" in text
    assert "did you mean 'sliding_mode'?" in fault(kinds={"sliding_mod": {}})


def test_what_breaks_the_contract_of_drives_is_refused():
    good = DRIVES["super_twisting"]
    for wrong, message in (
        (good._replace(name="x", force=3), "force = 3; expected a function"),
        (good._replace(name="x", is_sampled=False), "only sampled drives have a memory"),
        (good._replace(name="x", parameters="a"), "expected a tuple of Parameter"),
        (good._replace(text="another"), "this name is taken"),
    ):
        with pytest.raises(StudyError, match=message):
            extend(drives=[wrong])
    assert "x" not in DRIVES and isinstance(good, DriveLaw)
