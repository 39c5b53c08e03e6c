"""What the kept modes leave out: exact static bending, and loops that converge with the modes."""

from functools import partial
from itertools import pairwise, product

import jax
import numpy as np
import pytest
import scipy.linalg

from jaxmodel.bases import find_bases, station_places
from jaxmodel.beam import build_basis, left_out_of_loads
from jaxmodel.electronics import PASSED, voltage_passage
from jaxmodel.linear import linearise
from jaxmodel.loop import deflection
from jaxmodel.numbers import case_of
from jaxmodel.piezo import actuator_constant, sensor_constant
from jaxmodel.prepare import prepare
from studies.engine.margins import judge_loops
from studies.engine.programs import kept_jit
from studies.engine.stability import loop_report
from studies.fitting.bench import Bench, response
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import build_cases
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal
from tests.bare import paper_study

#: Three different links with unequal patches, two of which overlap on the third link.
UNLIKE = {
    "link__length": (0.2, 0.22, 0.21),
    "link__thickness": (2e-3, 2.2e-3, 1.9e-3),
    "link__youngs_modulus": (70e9, 69e9, 72e9),
    "link__stiffness_factor": (1.0, 0.9, 1.1),
    "patches__centers": ((0.05, 0.10, 0.15), (0.05, 0.11, 0.17), (0.05, 0.09, 0.16)),
    "patches__actuator_length": (0.03, 0.02, 0.03),
    "patches__sensor_length": (0.01, 0.02, 0.035),
}


_prepare = kept_jit(static_argnums=0)(prepare)


@partial(jax.jit, static_argnums=0)
def plant_of(structure, case):
    """Linearised at the first way-point."""
    return linearise(structure, prepare(structure, case).loop, case.path.waypoints[0])


def arrays(**fields):
    study = paper_study().change(**fields)
    return build_structure(study), as_arrays(build_case(study))


def prepared(**fields):
    structure, case = arrays(**fields)
    return structure, case, _prepare(structure, case).loop


places_of = jax.jit(station_places)


def by_hand(case, basis, link):
    """Sensor volts and station deflections per actuator volt, piece by piece in plain Python."""
    one = jax.tree.map(lambda x: np.broadcast_to(x, (3,))[link], case.machine.beam)
    alike = {"sensor_factor": 1.0, "actuator_factor": 1.0}
    patches = case.machine.patches._replace(center=0.0, **alike)
    patches = jax.tree.map(lambda x: float(np.broadcast_to(x, (3,))[link]), patches)
    centers, length = np.asarray(case.machine.patches.center)[link], float(one.length)
    half = patches.actuator_length / 2, patches.sensor_length / 2
    actuators, sensors = ([(c - h, c + h) for c in centers] for h in half)
    cuts = sorted({0.0, length, *(x for ends in actuators + sensors for x in ends)})
    lambda_a, lambda_s = actuator_constant(one, patches), sensor_constant(one, patches)

    def inside(piece, ends):
        return int(ends[0] < sum(piece) / 2 < ends[1])

    def stiffness(piece):
        """E I of layers about their common neutral axis; a pair is symmetric."""
        bare = one.youngs_modulus * one.width * one.thickness**3 / 12
        axial = one.youngs_modulus * one.width * one.thickness
        patch = patches.youngs_modulus * patches.width * patches.thickness
        arm = (one.thickness + patches.thickness) / 2
        own = patch * patches.thickness**2 / 12
        shift = patch * arm / (axial + patch)
        single = axial * shift**2 + patch * (arm - shift) ** 2 + own
        double = 2 * (patch * arm**2 + own)
        added = 0.0
        for sensor, actuator in zip(sensors, actuators, strict=True):
            count = inside(piece, sensor) + inside(piece, actuator)
            added += (0.0, single, double)[count]
        return (bare + (added if basis == "loaded" else 0.0)) * one.stiffness_factor

    volts, bent = np.zeros((3, 3)), np.zeros((3, 3))
    for piece in pairwise(cuts):
        curvature = [lambda_a / stiffness(piece) * inside(piece, a) for a in actuators]
        p, q = piece
        for k, x in enumerate(length * np.broadcast_to(case.windows.stations, (3, 3))[link]):
            # w = int (x - s) kappa ds up to x, less the chord's share of the same up to L
            to_x = (max(x - p, 0) ** 2 - max(x - q, 0) ** 2) / 2
            to_end = ((length - p) ** 2 - (length - q) ** 2) / 2
            bent[k] += np.multiply(curvature, to_x - x / length * to_end)
            if inside(piece, sensors[k]):
                volts[k] += np.multiply(curvature, lambda_s * (q - p))
    return volts, bent


@pytest.mark.parametrize(
    ("n_modes", "basis"),
    [
        pytest.param(n, x, marks=() if n == 3 or n * x == "pinned_pinned" else pytest.mark.long)
        for n in (1, 3, 8)
        for x in ("pinned_pinned", "pinned_free", "loaded")
    ],
)
def test_held_voltages_bend_the_links_as_statics_says(n_modes, basis):
    """A step on each patch, all sensors and stations of the assembled machine, in the long run."""
    fields = UNLIKE if n_modes != 1 else {}
    fields = {**fields, "control__modes": 1, "metrics__stations": (0.25, 0.5, 0.75)}
    structure, case = arrays(link__basis=basis, link__modes=n_modes, **fields)
    if n_modes != 1:
        centers = np.array(case.machine.patches.center)
        centers[2, 1] = 0.072
        patches = case.machine.patches._replace(center=centers)
        case = case._replace(machine=case.machine._replace(patches=patches))
    plant = plant_of(structure, case)
    still = np.linalg.solve(plant.state, -plant.voltage)
    volts = np.array(plant.sensor @ still + plant.direct_sensor)
    bent = np.array(plant.deflection @ still + plant.direct_deflection)
    for link in range(3):
        own = slice(3 * link, 3 * link + 3)
        for found, wanted in zip((volts, bent), by_hand(case, basis, link), strict=True):
            size = np.abs(wanted).max()
            np.testing.assert_allclose(found[own, own], wanted, rtol=0, atol=1e-12 * size)
            found[own, own] = 0.0
    assert np.abs(volts).max() < 1e-12  # no patch moves another link
    if basis == "pinned_pinned" and n_modes == 1:
        assert by_hand(case, basis, 0)[0][0, 0] == pytest.approx(0.050075, rel=1e-4)


def test_no_other_sensor_answers():
    volts, _ = by_hand(arrays()[1], "pinned_pinned", 0)
    assert np.count_nonzero(volts) == 3


@pytest.mark.parametrize("highpass", [None, 2 * np.pi * 30])
@pytest.mark.parametrize("lag", [None, 0.0, 1e-7, 3e-5, 1e-3])
def test_voltages_pass_the_electronics_exactly(highpass, lag):
    """Against SciPy's exponential of the same five equations, written out here."""
    h, w = 1e-4, 2 * np.pi * 2000
    d, rate = highpass or 0.0, 0.0 if not lag else 1 / lag
    is_slow = bool(lag)
    rows = [
        [0, 1, 0, 0, 0],
        [-(w**2), -np.sqrt(2) * w, -(w**2), is_slow * w**2, w**2],
        [0, 0, -d, is_slow * d, d],
        [0, 0, 0, -rate, 0],
        [0, 0, 0, 0, 0],
    ]
    scale = np.array([1, w, 1, 1, 1])
    wanted = scipy.linalg.expm(np.array(rows) * h / scale[:, None] * scale)
    found = np.asarray(voltage_passage(h, w, highpass, lag)) * scale / scale[:, None]
    kept = [k for k, name in enumerate(PASSED) if name != "remainder"]
    every = kept if not is_slow else range(5)
    np.testing.assert_allclose(
        found[np.ix_(kept, every)], wanted[np.ix_(kept, every)], rtol=0, atol=1e-12
    )


#: Independent finite elements with the exported controller (40, 80, 120 elements a link agree to
#: 1e-4): gain margin, and damping ratios of the three first modes. `loaded` is given to 3 digits.
FINITE_ELEMENTS = {
    "pinned_pinned": (3.699, (0.2265, 0.2256, 0.2244)),
    "loaded": (5.175, (0.128, 0.140, 0.144)),
}


@pytest.mark.parametrize(
    ("basis", "n_modes", "within"),
    [
        # in short: of loops in test_sampled_loop, and of a batch below
        pytest.param("pinned_pinned", 3, 0.06, marks=pytest.mark.long),
        pytest.param("pinned_pinned", 8, 0.0225, marks=pytest.mark.long),
        pytest.param("pinned_pinned", 12, 0.01, marks=pytest.mark.long),
        ("loaded", 12, 0.01),
    ],
)
def test_margins_are_those_of_finite_elements(basis, n_modes, within):
    structure, case = arrays(link__modes=n_modes, link__basis=basis)
    found = loop_report(structure, case, case.path.waypoints[0], n_modes=n_modes)
    margin, damping = FINITE_ELEMENTS[basis]
    assert found.gain_margin == pytest.approx(margin, rel=within)
    np.testing.assert_allclose(found.damping_ratio[0], damping, rtol=min(within, 0.01))


@pytest.mark.long  # in short: the table of test_sampled_loop
@pytest.mark.parametrize(
    ("n_modes", "margin", "damping"), [(3, 5.56, 0.307), (8, 4.44, 0.248), (12, 2.68, 0.184)]
)
def test_truncated_plants_have_another_loop(n_modes, margin, damping):
    """The paper's model, for comparison: modal sums alone, whose margins do not converge."""
    structure, case = arrays(link__modes=n_modes, link__static_correction=False)
    found = loop_report(structure, case, case.path.waypoints[0], n_modes=n_modes)
    assert found.gain_margin == pytest.approx(margin, rel=2e-3)
    assert found.damping_ratio[0, 0] == pytest.approx(damping, rel=3e-3)


def test_margins_of_a_batch_have_the_correction_too():
    study = paper_study().change(link__modes=12)
    structure = build_structure(study)
    columns = {"control.gain_factor": np.array([0.6, 1.0, 2.0])}
    found = judge_loops(structure, build_cases(study, columns, structure))
    np.testing.assert_allclose(
        found.gain_margin, 3.6966 / columns["control.gain_factor"], rtol=1e-3
    )


def test_compensation_subtracts_what_is_there():
    """With as many modes as the controller knows, the feed-through that is left is rounding."""
    for n_modes in (3, 16):
        _, _, loop = prepared(link__modes=n_modes, control__feedthrough_factor=1.0)
        modes = np.arange(n_modes) >= 3
        stiffness = np.asarray(loop.plant.stiffness) / np.asarray(loop.plant.modal_mass)[:, None]
        others = np.einsum("ikr,ir,irl->ikl", loop.sensor, modes / stiffness, loop.actuator)
        there = others + np.asarray(loop.left_out.sensor)
        np.testing.assert_allclose(loop.controller.feedthrough, there, rtol=0, atol=1e-14)


def test_deflections_at_the_stations_have_it():
    _, case, loop = prepared(link__modes=2)
    build = jax.jit(build_basis, static_argnums=(0, 3))
    basis = build("pinned_pinned", case.machine.beam, case.machine.patches, 40, places_of(case))
    volts = np.zeros((3, 3))
    volts[:, 1] = 30.0
    lambda_a = float(np.max(jax.jit(actuator_constant)(case.machine.beam, case.machine.patches)))
    force = lambda_a * np.einsum("irk,ik->ir", basis.actuator_slope, volts)
    wanted = np.einsum("isr,ir->is", basis.deflection_at, force / np.asarray(basis.stiffness))
    q = np.einsum("irk,ik->ir", loop.actuator, volts) / np.asarray(loop.omega) ** 2
    np.testing.assert_allclose(jax.jit(deflection)(loop, q, volts), wanted, rtol=2e-4)
    alone = np.einsum("isr,ir->is", loop.deflection_at, q)
    assert np.abs(alone / wanted - 1).max() > 5e-3


def test_stations_are_fractions_and_measured_places_metres():
    """Of links of different length; places stay where they are if a length is a parameter."""
    study = paper_study().change(
        link__length=(0.2, 0.25, 0.22), metrics__stations=(0.25, 0.75), link__modes=3
    )
    structure, case = build_structure(study), as_arrays(build_case(study))
    shape = np.asarray(jax.jit(partial(find_bases, structure))(case).plant.deflection_at)
    wave = np.sin(np.pi * np.outer([0.25, 0.75], [1, 2, 3]))
    np.testing.assert_allclose(shape, np.broadcast_to(wave, (3, 2, 3)), atol=1e-12)
    bench = Bench(study, _with_length, study.motion.waypoints[:1], (0.05, 0.1))
    for length in (0.2, 0.3):
        numbers = jax.jit(bench.place)(bench.numbers, np.array([length]))
        places = places_of(case_of(bench.structure, numbers))
        np.testing.assert_allclose(places, [[0.05, 0.1]] * 3, rtol=1e-12)


def _with_length(numbers, values):
    return numbers | {"link.length": numbers["link.length"].at[1].set(values[0])}


def test_bench_responses_have_it():
    """Of an actuator at low frequency: what statics says, from three modes."""
    study = paper_study().change(link__modes=3, drive__kp=2e4)
    pose = study.motion.waypoints[0]
    bench = Bench(study, lambda case, values: case, (pose,), (0.1,))
    plant = bench.plant(pose, np.zeros(0), False)
    volts, bent = by_hand(
        case_of(bench.structure, bench.numbers)._replace(windows=arrays()[1].windows),
        "pinned_pinned",
        0,
    )
    station = list(arrays()[1].windows.stations).index(0.5)
    for output, wanted in (
        (Signal("sensor", 0, 1, np.nan), volts[1, 1]),
        (Signal("deflection", 0, 0, 0.1), bent[station, 1]),
    ):
        signals = Signal("actuator", 0, 1, np.nan), output
        found = response(plant, signals, bench.places(signals), np.array([1e-3]))
        np.testing.assert_allclose(found.value, wanted, rtol=1e-6)


@pytest.mark.parametrize(
    ("basis", "many", "least"), [("pinned_pinned", 400, 1e-4), ("loaded", 80, 2e-3)]
)
def test_loads_leave_out_the_sum_of_all_further_modes(basis, many, least):
    """Forces at stations and the inertia of the link's own motion, joints with inertia included."""
    study = paper_study().change(**UNLIKE, metrics__stations=(0.2, 0.55, 0.9))
    if basis == "loaded":
        study = study.change(
            link__basis=basis, link__joint_inertia_b=2e-6, link__joint_inertia_c=1e-6
        )
    case = as_arrays(build_case(study))
    machine, stations = case.machine, station_places(case)

    @partial(jax.jit, static_argnums=0)
    def left_out(n_modes, beam, patches):
        modes = build_basis(basis, beam, patches, n_modes, stations)
        return left_out_of_loads(basis, beam, patches, stations, modes)

    few, whole = (np.asarray(left_out(n, machine.beam, machine.patches)) for n in (3, many))
    assert few.shape == (3, 9, 5)
    size = np.abs(few).max(axis=(0, 1))
    assert np.all(np.abs(whole).max(axis=(0, 1)) < least * size)


NAMES = (
    "actuator 1.1, slider 2, hammer 1 at 0.05, hammer 2 at 0.05, command 1",
    "sensor 1.1, sensor 2.2, deflection 1 at 0.08, accelerometer 1 at 0.05, platform x, slider 1, "
    "motor 1",
)


@pytest.mark.parametrize("basis", ["pinned_pinned", pytest.param("loaded", marks=pytest.mark.long)])
def test_responses_of_every_pair_need_three_modes(basis):
    """Off resonance, against 16 modes; without what modes leave out, up to 86 %."""
    inputs, outputs = (
        [parse_signal(name, kinds, 3, np.full(3, 0.2), "") for name in names.split(", ")]
        for names, kinds in zip(NAMES, (INPUTS, OUTPUTS), strict=True)
    )
    pose, omega = (0.0, 0.0, np.pi / 6), 2 * np.pi * np.array([20.0, 60.0, 180.0, 300.0])
    found = []
    for n_modes in (3, 16):
        study = paper_study().change(link__basis=basis, link__modes=n_modes)
        bench = Bench(study, lambda numbers, values: numbers, [pose], [0.05, 0.08])
        plant = bench.plant(pose, np.zeros(0), False)
        pairs = list(product(inputs, outputs))
        found.append([response(plant, x, bench.places(x), omega).value for x in pairs])
    error = np.abs(np.divide(*found) - 1)
    assert np.median(error) < 1e-4 and error.max() < 0.02
