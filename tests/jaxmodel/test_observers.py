"""Laws with observers: Riccati equations, LQG against an independent computation, placed poles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm, solve_discrete_are

from jaxmodel.controller import controller_step, rest_controller
from jaxmodel.laws.bending import BENDING, bent, walk
from jaxmodel.laws.link_model import link_model
from jaxmodel.laws.observer import corrections
from jaxmodel.riccati import filter_gain, regulator_gain, solve_riccati
from jaxmodel.simulate import simulate
from jaxmodel.state_space import StateSpace, dense
from studies.engine.blocks import modal_blocks, responses
from studies.engine.controller import fixed_controller
from studies.engine.executor import Executor
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.stability import loop_report, with_margin_modes
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case
from tests.bare import parse_study
from tests.canonical import MACHINE
from tests.jaxmodel.kept import arrays, design_of, loop_at
from tests.jaxmodel.test_state_space import assert_code_is_the_controller

SHORT = MACHINE | {"control": {"law": "lqg", "modes": 2}}


@pytest.mark.parametrize("seed", range(4))
def test_riccati_equations_are_solved(seed):
    """As SciPy solves them, to 1e-9; a slow and a singular plant among them."""
    rng = np.random.default_rng(seed)
    n, m = 15, 3
    a = rng.normal(size=(n, n))
    a *= (0.9999 if seed else 0.5) / np.abs(np.linalg.eigvals(a)).max()
    if seed == 1:
        a[:, 0] = 0.0
    b, q, r = rng.normal(size=(n, m)), np.diag(rng.uniform(0, 1, n)), 10.0 ** (seed - 2) * np.eye(m)
    found, wanted = solve_riccati(a, b, q, r), solve_discrete_are(a, b, q, r)
    np.testing.assert_allclose(found, wanted, atol=1e-9 * np.abs(wanted).max())
    gain = np.linalg.solve(r + b.T @ wanted @ b, b.T @ wanted @ a)
    np.testing.assert_allclose(regulator_gain(a, b, q, r), gain, rtol=1e-8, atol=1e-10)
    both = np.asarray(filter_gain(a.T, b.T, q, r))
    np.testing.assert_allclose(
        both, np.linalg.solve(r + b.T @ wanted @ b, b.T @ wanted).T, rtol=1e-8
    )


@pytest.mark.parametrize("name", range(4))
def test_riccati_solutions_have_derivatives(name):
    """In both modes, against differences of SciPy's solutions, to 1e-6."""
    rng = np.random.default_rng(name)
    n, m = 7, 2
    a = rng.normal(size=(n, n))
    numbers = [0.999 * a / np.abs(np.linalg.eigvals(a)).max(), rng.normal(size=(n, m))]
    numbers += [np.diag(rng.uniform(0, 1, n)), np.diag(rng.uniform(0.5, 1, m))]
    change = rng.normal(size=numbers[name].shape)
    change = change + change.T if name > 1 else change  # Q and R stay symmetric
    weight = rng.normal(size=(n, n))

    def solved(x):
        return solve_discrete_are(*numbers[:name], numbers[name] + x * change, *numbers[name + 1 :])

    step = 1e-5
    wanted = (solved(step) - solved(-step)) / (2 * step)
    tangents = [change if k == name else np.zeros_like(x) for k, x in enumerate(numbers)]
    forward = _tangent(numbers, tangents)
    np.testing.assert_allclose(forward, wanted, atol=1e-6 * np.abs(wanted).max())
    reverse = np.sum(_cotangents(numbers, weight)[name] * change)
    np.testing.assert_allclose(reverse, np.sum(weight * forward), rtol=1e-9)


@jax.jit
def _tangent(numbers, tangents):
    return jax.jvp(solve_riccati, tuple(numbers), tuple(tangents))[1]


@jax.jit
def _cotangents(numbers, weight):
    return jax.vjp(solve_riccati, *numbers)[1](weight)


def compensator(study, nominal, case, link):
    """A, B, C, D of one link by SciPy: each mode with its own filter, then hold and delay.

    Last the slow forces of the move, one for each mode, which the regulator does not know.
    """
    electronics, parameters = case.electronics, case.control.parameters
    corner, period = float(electronics.antialias), float(electronics.period)
    omega, mass = np.asarray(nominal.omega[link]), np.asarray(nominal.modal_mass[link])
    sensor, actuator = np.asarray(nominal.sensor[link]), np.asarray(nominal.actuator[link])
    count, patches = len(omega), sensor.shape[0]
    zeta = parameters["model_damping"][link]
    n = 4 * count + 2 * patches  # q, q', z, z' of one mode after another [m, m/s]; z, z' of volts
    a, b, f = np.zeros((n, n)), np.zeros((n, patches)), np.zeros((n, count))
    c = np.zeros((patches, n))
    for k in range(count):
        i = 4 * k
        a[i, i + 1] = a[i + 2, i + 3] = 1.0
        a[i + 1, i : i + 2] = -(omega[k] ** 2), -2 * zeta * omega[k]
        a[i + 3, i], a[i + 3, i + 2] = corner**2, -(corner**2)
        a[i + 3, i + 3] = -np.sqrt(2) * corner
        b[i + 1], f[i + 1, k], c[:, i + 2] = actuator[k] / mass[k], 1 / mass[k], sensor[:, k]
    for k in range(patches):  # what all other modes show of the commands, filtered as they are
        i = 4 * count + 2 * k
        a[i, i + 1], a[i + 1, i : i + 2] = 1.0, (-(corner**2), -np.sqrt(2) * corner)
        b[i + 1, k], c[:, i] = corner**2, nominal.feedthrough[link][:, k]
    size = np.concatenate([np.tile([1e-6, 1e-3, 1e-6, 1e-2], count), np.tile([1.0, 1e4], patches)])
    whole = np.zeros((n + patches + count,) * 2)
    whole[:n] = np.hstack([a, b, f])
    scale = np.concatenate([size, np.ones(patches + count)])
    held = expm(whole * period * scale / scale[:, None]) * scale[:, None] / scale
    state = np.block(
        [[held[:n, :n], held[:n, n : n + patches]], [np.zeros((patches, n + patches))]]
    )
    enter = np.vstack([np.zeros((n, patches)), np.eye(patches)])
    drive = np.vstack([held[:n, n + patches :], np.zeros((patches, count))])
    look = np.hstack([c, np.zeros((patches, patches))])
    energy = np.zeros(n + patches)
    energy[0 : 4 * count : 4], energy[1 : 4 * count : 4] = mass * omega**2, mass
    eye = np.eye(patches)
    s = np.concatenate([size, np.ones(patches)])  # SciPy needs numbers of one size
    a1, b1, l1 = state * s / s[:, None], enter / s[:, None], look * s
    w1 = drive / s[:, None] * parameters["disturbance"][link]  # per rms of the new forces
    weight, noise = parameters["voltage_weight"][link], parameters["sensor_noise"][link] ** 2
    x = solve_discrete_are(a1, b1, np.diag(energy * s**2) / weight, eye)
    gain = np.linalg.solve(eye + b1.T @ x @ b1, b1.T @ x @ a1)
    corner = 2 * np.pi * parameters["bending_hz"][link] * period
    # slow forces in units of the others' rms; they change by `corner` of it per sample
    slow = np.exp(-0.01 * corner) * np.eye(count)
    bent = np.linalg.solve(np.eye(len(s)) - a1, w1)  # at rest under them
    a1 = np.block([[a1, w1], [np.zeros((count, len(s))), slow]])
    b1 = np.vstack([b1, np.zeros((count, patches))])
    l1 = np.hstack([l1, np.zeros((patches, count))])
    gain = np.hstack([gain, -gain @ bent])
    shaken = np.zeros_like(a1)
    shaken[: len(s), : len(s)] = w1 @ w1.T
    shaken[len(s) :, len(s) :] = corner**2 * np.eye(count)
    p = solve_discrete_are(a1.T, l1.T, shaken / noise, eye)
    correct = np.linalg.solve(eye + l1 @ p @ l1.T, l1 @ p).T
    kept = np.eye(len(a1)) - correct @ l1
    after = a1 - b1 @ gain
    return after @ kept, after @ correct, -gain @ kept, -gain @ correct


def nominal_of(structure, case):
    return jax.tree.map(np.asarray, design_of(structure, case).nominal)


def controller_of(structure, case):
    return jax.tree.map(np.asarray, design_of(structure, case).controller)


def test_damping_and_margin_are_those_of_an_independent_computation():
    """Filter and regulator by SciPy in other coordinates, put into the same plant."""
    study = parse_study(SHORT)
    structure, case = arrays(study)
    nominal = nominal_of(structure, case)
    parts = [compensator(study, nominal, case, link) for link in range(3)]
    a, b, c, d = (np.stack([part[k] for part in parts]) for k in range(4))
    other = StateSpace(a[:, None], b[:, None], c[:, :, None], d)
    plain, wide = with_margin_modes(structure, case)
    pose = np.array(study.motion.waypoints[0])

    own = controller_of(structure, case)
    # far from their limits, so that nothing tells of them
    mine = own._replace(feedback=own.feedback._replace(anti_windup=None))
    loops = [
        jax.tree.map(np.asarray, loop_at(plain, wide, pose, law))
        for law in (mine, own._replace(feedback=other))
    ]

    def poles(loop, factor=1.0):
        value = np.linalg.eigvals(loop.open + factor * loop.feedback)
        return value[np.argsort(-np.abs(value))]

    mine, theirs = map(poles, loops)
    apart = np.abs(mine[:40, None] - theirs).min(axis=1)  # 40 may divide a pair
    assert apart.max() < 1e-7
    report = loop_report(structure, case, pose)
    below, above = (
        np.abs(poles(loops[1], share * report.gain_margin)[0]) for share in (0.999, 1.001)
    )
    assert below < 1 < above
    assert report.gain_margin > 2
    damping, omega = report.damping_ratio, 2 * np.pi * report.frequency_hz
    found = np.exp(omega * (-damping + 1j * np.sqrt(1 - damping**2)) * 1e-4)
    assert np.abs(found[..., None] - theirs).min(axis=-1).max() < 2e-8
    assert damping[0].min() > 5 * study.link.first_damping


def test_certainty_equivalence():
    """On its own model, the loop's poles are those of regulator and filter, and all are stable."""
    study = parse_study(SHORT)
    structure, case = arrays(study)
    a, b, c, d = compensator(study, nominal_of(structure, case), case, 0)
    system = controller_of(structure, case).feedback
    mine = dense(StateSpace(*(part[:1] for part in system)))
    z = np.exp(0.4j)

    def transfer(a, b, c, d):
        return c @ np.linalg.solve(z * np.eye(len(a)) - a, b) + d

    np.testing.assert_allclose(transfer(*mine), transfer(a, b, c, d), rtol=1e-7)


@pytest.mark.long  # in short: among all parts of a run, in test_hysteresis
def test_gradients_equal_differences():
    """Of residual vibration after the motion, by the logarithms of all weights, to 1e-4."""
    study = parse_study(SHORT | {"run": {"duration": 0.06, "smooth": True}})
    structure, case = arrays(study)
    structure = structure._replace(metrics=("residual_rms",))
    names = ("voltage_weight", "disturbance", "sensor_noise", "bending_hz")

    def residual(x):
        given = case.control.parameters
        moved = {name: given[name] * jnp.exp(x[k]) for k, name in enumerate(names)}
        parameters = {**given, **moved}
        control = case.control._replace(parameters=parameters)
        found = simulate(structure, case._replace(control=control))
        squares = jnp.sum(found.metrics.residual_rms**2) * 1e9
        return squares, squares

    run = jax.jit(jax.jacfwd(residual, has_aux=True))  # one program for both
    slope = run(np.zeros(4))[0]
    wanted = [float(run(x)[1] - run(-x)[1]) / 2e-3 for x in 1e-3 * np.eye(4)]
    np.testing.assert_allclose(slope, wanted, rtol=1e-4)


@pytest.mark.parametrize("highpass", [0.0, pytest.param(3.0, marks=pytest.mark.long)])
def test_observers_have_the_poles_that_were_placed(highpass):
    """Of every mode: the given damping at its frequency, and its bending; its filters' stay."""
    control = {"law": "observer", "modes": 2, "laws": {"observer": {"observer_damping": 0.4}}}
    electronics = {"sensor_highpass_hz": highpass}
    study = parse_study(SHORT | {"control": control, "electronics": electronics})
    structure, case = arrays(study)

    nominal = nominal_of(structure, case)
    omega = nominal.omega

    @jax.jit
    def both(case, nominal):
        model = bent(case, link_model(structure, case, nominal)).model
        return model.state, corrections(structure, case, nominal)

    state, own = map(np.asarray, both(case, nominal))
    period, corner = float(case.electronics.period), float(case.electronics.antialias)
    size = own.shape[2]
    assert size == (6 if highpass else 5)
    for link, j in np.ndindex(3, 2):
        at = np.append(np.arange(size - 1) * 2 + j, state.shape[1] - 2 + j)
        f, look = state[link][np.ix_(at, at)], np.eye(size)[2]
        error = f @ (np.eye(size) - np.outer(own[link, j], look))
        poles = np.log(np.linalg.eigvals(error)) / period
        wanted = [omega[link, j] * (-0.4 + 1j * np.sqrt(1 - 0.4**2)), corner * (-1 + 1j) / 2**0.5]
        real = [-2 * np.pi * highpass] * (size - 5) + [-2 * np.pi * BENDING.default]
        wanted = np.concatenate([wanted, np.conj(wanted), real])
        apart = np.abs(poles[:, None] - wanted[None]).min(axis=0)
        assert np.all(apart < 1e-5 * np.abs(wanted))


@pytest.mark.long  # in short: poles of the nominal link in test_poles, a margin in test_onset
def test_modal_control_by_observers_damps_as_modal_filters_do():
    """With few modes and slow enough observers, the damping that the gains intend."""
    found = {}
    for law in ("imsc", "observer"):
        control = {"law": law, "velocity_gain": (0.6, 0.7, 0.7), "modes": 2}
        structure, case = arrays(parse_study(SHORT | {"control": control}))
        found[law] = loop_report(structure, case, np.array([0.0, 0.0, 0.5236]))
        assert found[law].gain_margin > 2
    damping = [found[law].damping_ratio[0].mean() for law in ("imsc", "observer")]
    assert damping[1] == pytest.approx(damping[0], rel=0.25) and damping[0] > 0.02


def command_ratio(law, structure, case):
    """Voltage per voltage at 30 Hz over that at mode 1, of link 1's first sensor and actuator."""
    system = controller_of(structure, case)
    a, b, c, d = dense(system.feedback)
    period = float(case.electronics.period)

    def gain(hertz):
        z = np.exp(2j * np.pi * hertz * period)
        return np.abs(c @ np.linalg.solve(z * np.eye(len(a)) - a, b) + d)[:3, :3].max()

    return gain(30.0) / gain(114.4)


@pytest.mark.parametrize("law", ["lqg", "observer"])
def test_quasi_static_bending_is_left_alone(law):
    """The higher `bending_hz`, the less the controller does at 30 Hz; without it 0.7 and more."""
    ratios = []
    for corner in (0.1, 60.0, BENDING.default):
        control = {"law": law, "modes": 2, "laws": {law: {"bending_hz": corner}}}
        structure, case = arrays(parse_study(SHORT | {"control": control}))
        ratios.append(command_ratio(law, structure, case))
    assert ratios[0] > 0.65 and ratios[1] < 0.75 * ratios[0] and ratios[2] < ratios[1]


@pytest.mark.parametrize("law", ["lqg", "observer"])
def test_predictions_know_the_commands_as_they_were_limited(law):
    """The state is that of an observer that is given the limited commands, however far they go."""
    structure, case = arrays(parse_study(SHORT | {"control": {"law": law, "modes": 2}}))

    @jax.jit
    def model_of(case, nominal):
        return bent(case, link_model(structure, case, nominal)).model

    controller = controller_of(structure, case)
    model = jax.tree.map(np.asarray, model_of(case, nominal_of(structure, case)))
    system = controller.feedback
    a, b, c, d = (np.asarray(x) for x in dense(system))
    order = model.state.shape[1]
    # x_(k+1) = (A - E C) x + (B - E D) y + E v of link 1, v limited
    enter = model.enter[0]
    own, ports = slice(0, order), slice(0, 3)
    inner, seen = a[own, own] - enter @ c[ports, own], b[own, ports] - enter @ d[ports, ports]
    rng = np.random.default_rng(3)
    state, x, limit = rest_controller(controller), np.zeros(order), 0.05
    controller = controller._replace(voltage_limit=limit)
    step = jax.jit(controller_step)
    reached = 0
    for voltage in rng.normal(size=(60, 3, 3)) * np.array([1, 0, 0])[:, None]:
        state, info = step(controller, state, voltage)
        v = np.asarray(info.command)[0]
        wanted = c[ports, own] @ x + d[ports, ports] @ np.asarray(info.measured)[0]
        np.testing.assert_allclose(v, np.clip(wanted, -limit, limit), atol=1e-8)
        reached += int(np.sum(np.abs(wanted) > 2 * limit))
        x = inner @ x + seen @ np.asarray(info.measured)[0] + enter @ v
        np.testing.assert_allclose(np.asarray(state.feedback)[0, 0], x, rtol=1e-8, atol=1e-9)
    assert reached > 20


def test_gain_factors_do_not_change_what_limits_tell():
    """E (v - u)/f: half of a doubled demand's excess; and nothing where a factor is 0."""
    structure, case = arrays(parse_study(SHORT | {"control": {"law": "lqg", "modes": 2}}))
    system = controller_of(structure, case)
    one = np.asarray(system.feedback.anti_windup)
    np.testing.assert_allclose(system.feedback.amplified(2.0).anti_windup, one / 2)
    assert not np.any(np.asarray(system.feedback.amplified(0.0).anti_windup))


@pytest.mark.long  # in short: all operations of a loop, in test_delay
@pytest.mark.parametrize("law", ["lqg", "observer"])
def test_kernel_is_scan_at_the_limits(law):
    """Peak and residual to 1e-9, with commands limited to 2 V."""
    data = SHORT | {"control": {"law": law, "modes": 1}, "electronics": {"voltage_limit": 2.0}}
    table = build_table(parse_sweep(data | {"sweep": {"axes": {"gain": [0.7, 1.0]}}}))
    group = plan_groups(table, np.arange(2), local_layout)[0]
    structure = group.structure._replace(metrics=("residual_rms", "peak_voltage"))
    cases = chunk_cases(table, group.rows, structure, group.layout.size)
    one, other = (
        Executor(structure, group.layout, kind=name).start(cases).wait()
        for name in ("kernel", "scan")
    )
    assert np.max(one.metrics.peak_voltage) == 2
    for name in structure.metrics:
        np.testing.assert_allclose(other.metrics[name], one.metrics[name], rtol=1e-9)


def test_slow_forces_walk_as_far_as_new_ones_at_the_corner():
    """A sum of steps w has the spectrum w^2/(omega T)^2 below half the sample rate."""
    case = as_arrays(build_case(parse_study({"control": {"law": "lqg"}})))
    force = np.array([1.0, 2.0, 3.0])
    corner, period = 2 * np.pi * case.control.parameters["bending_hz"], case.electronics.period
    np.testing.assert_allclose(walk(case, force) / (corner * period), force, rtol=1e-12)


@pytest.mark.parametrize(
    "law, electronics, is_dense",
    [
        ("lqg", {"unmodelled_delay": 0.3}, False),
        # two poles at zero, apart by rounding: pairs keep 3e-13 of the response or just not
        ("lqg", {"delay": 1.3}, None),
        ("lqg", {"unmodelled_delay": 0.3, "sample_rate_hz": 50_000}, False),
        # two modes leave three patches a direction in which a delay line is a Jordan block
        ("lqg", {"delay": 2.5}, True),
        ("observer", {"delay": 1.3}, True),
        ("observer", {"delay": 2.5}, True),
    ],
)
def test_code_is_the_controller_at_every_delay(law, electronics, is_dense):
    study = parse_study(SHORT | {"control": {"law": law, "modes": 2}, "electronics": electronics})
    assert_code_is_the_controller(study)
    size = fixed_controller(study).channels.system.state.shape[2]
    # with shorter numbers poles are less accurate, so that more are dense
    if is_dense is not None and np.finfo(np.longdouble).eps < 1e-18:
        assert (size > 2) == is_dense


def test_a_jordan_block_keeps_its_states():
    """A delay line of three samples beside a mode; commands older than that are left out."""
    a = np.diag([1.0, 1.0, 1.0, 0.0], -1)
    a[2, 3:] = a[0, :] = 0.0
    a[0, 4], a[4, 4], a[3, 2] = 0.5, 0.9, 1.0
    enter, leave = np.zeros((5, 2)), np.zeros((2, 5))
    enter[4], leave[0, 2], leave[1, 4] = (1.0, 2.0), 3.0, 1.0
    system = StateSpace(a[None, None], enter[None, None], leave[None, :, None], np.zeros((1, 2, 2)))
    found = modal_blocks(system, 1).system
    kept = [0, 1, 2, 4]
    np.testing.assert_array_equal(found.state, a[None, None][..., kept, :][..., kept])
    wanted = [leave @ np.linalg.matrix_power(a, k) @ enter for k in range(20)]
    response = responses(found, 0, 21).command[..., 1:]
    np.testing.assert_allclose(np.moveaxis(response, -1, 0), wanted, rtol=1e-14)
