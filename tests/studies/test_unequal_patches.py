"""Unequal patches: sensors and actuators that are not what the controller believes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel.changes import MachineChange
from jaxmodel.linear import resting
from jaxmodel.response import bench_plant
from jaxmodel.sampled_loop import loop_matrices
from jaxmodel.simulate import simulate
from studies.engine import breaking
from studies.engine.controller import fixed_controller
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.fitting.problem import make_problem
from studies.space.free import join_numbers, plain_numbers
from studies.space.table import build_table
from studies.spillover.plants import LoopBuilder, PlantVariant, pad_channels
from studies.spillover.proofs import SINES, collect
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.fields import column_of
from studies.study.numbers import build_cases, one_study
from studies.study.paths import as_list
from studies.study.section import MACHINE
from studies.study.spec import parse_study
from studies.verify import links
from tests.canonical import HOME
from tests.fits import RESPONSE, blank, followed, give_data, made, spec_of
from tests.jaxmodel import kept
from tests.studies.kernels.test_kernel import both, check_equal
from tests.sweeps import small_spec

SENSOR = ((0.8, 1.0, 1.2), (1.0, 0.0, 1.1), (0.9, 1.3, 1.0))
ACTUATOR = ((1.0, 0.7, 1.2), (1.1, 1.0, 0.9), (1.0, 1.0, 0.0))
UNEQUAL = {"patches__sensor_factor": SENSOR, "patches__actuator_factor": ACTUATOR}
S, A = np.array(SENSOR), np.array(ACTUATOR)
POSE = np.array(HOME)
#: Patches as they are: they stiffen links and lengthen them.
STUDY = parse_study({"link": {"modes": 3}, "motion": {"waypoints": [HOME]}})
GAUGES = STUDY.change(patches__sensor="strain_gauge")


def scaled(loop):
    """The loop with the columns of its actuators and rows of its sensors times their factors."""
    left_out = loop.left_out
    return loop._replace(
        sensor=S[:, :, None] * loop.sensor,
        actuator=loop.actuator * A[:, None],
        observer=None,
        strain=(loop.strain[0], loop.strain[1] * A[:, None]),
        left_out=left_out._replace(
            sensor=S[:, :, None] * left_out.sensor * A[:, None],
            deflection=left_out.deflection * A[:, None],
        ),
    )


@partial(jax.jit, static_argnums=0)
def matrices(structure, case, loop):
    return loop_matrices(structure, case, loop, loop.controller, POSE, resting(structure, case))


def close(found, wanted, within=1e-12):
    """Arrays of two trees, each within a share of its largest number."""
    for one, other in zip(*map(jax.tree.leaves, (found, wanted)), strict=True):
        size = np.abs(np.asarray(other)).max(initial=0.0) or 1.0
        np.testing.assert_allclose(one, other, rtol=0, atol=within * size)


@pytest.mark.parametrize("study", [STUDY, GAUGES], ids=["piezo", "strain gauge"])
def test_the_loop_is_that_of_scaled_sensors_and_actuators(study):
    structure, case = kept.without_run(study)
    unequal = kept.without_run(study.change(**UNEQUAL))[1]
    equal, found = (kept.prepared(structure, x).loop for x in (case, unequal))
    wanted = scaled(equal)
    close(found._replace(observer=None), wanted)
    close(matrices(structure, unequal, found), matrices(structure, case, wanted))
    assert np.abs(found.left_out.sensor).max() > 0


def test_factors_of_one_are_no_factors():
    """One for all, a list for all links, and a list each: the same numbers to the last bit."""
    structure, case = kept.without_run(STUDY)
    for one in (1.0, (1.0,) * 3, ((1.0,) * 3,) * 3):
        same = STUDY.change(patches__sensor_factor=one, patches__actuator_factor=one)
        assert build_structure(same) == build_structure(STUDY)
        jax.tree.map(np.testing.assert_array_equal, kept.without_run(same)[1], case)
    by_patch = STUDY.change(patches__sensor_factor=SENSOR[0])
    each = STUDY.change(patches__sensor_factor=(SENSOR[0],) * 3)
    jax.tree.map(np.testing.assert_array_equal, build_case(by_patch), build_case(each))


def test_a_factor_on_all_sensors_is_one_on_all_gains():
    """Nothing is fed through: the controller's share would not grow with the sensors."""
    study = STUDY.change(control__feedthrough_factor=0.0)
    reports = [
        loop_report(build_structure(x), build_case(x), POSE)
        for x in (study, study.change(patches__sensor_factor=1.25))
    ]
    margins = [report.gain_margin for report in reports]
    np.testing.assert_allclose(margins[0] / margins[1], 1.25, rtol=1e-6)


def test_a_bench_sees_what_patches_do():
    """Responses to actuators, and of sensors, with what modes that are left out do to both."""
    structure, case = kept.without_run(STUDY.change(control__feedback="none"))
    unequal = kept.without_run(STUDY.change(control__feedback="none", **UNEQUAL))[1]
    program = jax.jit(partial(bench_plant, structure))
    equal, found = program(case, POSE), program(unequal, POSE)
    s, a = np.append(S.ravel(), np.ones(len(equal.deflection))), A.ravel()
    wanted = equal._replace(
        actuator=equal.actuator * a,
        sensor=S.ravel()[:, None] * equal.sensor,
        from_actuator=s[:, None] * equal.from_actuator * a,
        from_slider_force=s[:, None] * equal.from_slider_force,
        from_hammer=s[:, None] * equal.from_hammer,
    )
    close(found, wanted, 1e-11)


# --- sweeps and derivatives -----------------------------------------------------------------------

AXES = {
    "patches.sensor_factor[0][1]": [0.7, 1.0, 1.3],
    "patches.actuator_factor[2][0]": {"from": 0.5, "to": 1.5},
    "drive.kp": {"from": 1e4, "to": 2e4},
}
SWEEP = {"method": "random", "count": 16, "axes": AXES}


def test_a_sweep_of_factors_is_of_single_studies():
    spec = small_spec(SWEEP)
    table = build_table(spec)
    cases = build_cases(table.study, table.fields, build_structure(table.study, table.fields))
    for k in range(len(table)):
        factors = np.ones((2, 3, 3))
        factors[0, 0, 1] = table.fields["patches.sensor_factor[0][1]"][k]
        factors[1, 2, 0] = table.fields["patches.actuator_factor[2][0]"][k]
        sensor, actuator = (tuple(map(tuple, x)) for x in factors.tolist())
        single = table.study.change(
            patches__sensor_factor=sensor, patches__actuator_factor=actuator
        )
        wanted = build_case(single).machine.patches
        jax.tree.map(
            lambda x, y, k=k: np.testing.assert_array_equal(x[min(k, len(x) - 1)], y),
            cases.machine.patches,
            wanted,
        )


@pytest.mark.long  # in short: only numbers of the loop differ, and cases are single studies
def test_machine_code_and_scan_of_unequal_patches():
    fast, reference = both(small_spec(SWEEP, link={"modes": 2}))
    check_equal(fast, reference)
    assert np.ptp(reference.metrics.residual_rms) > 0


def test_slopes_by_single_factors_are_those_of_differences():
    """Of the residual vibration, by one sensor's and one actuator's factor in the file."""
    study = small_spec(SWEEP).study.change(run__smooth=True, link__modes=2)
    structure = build_structure(study)._replace(metrics=("residual_rms",), n_frequencies=1)
    names, bounds = list(AXES)[:2], {"from": 0.5, "to": 2.0}
    free = join_numbers([plain_numbers(x, bounds, study, x, (MACHINE,)) for x in names])
    assert list(free.names) == names
    numbers, build = as_arrays(one_study(study, structure)), free.build(structure)

    @partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
    @jax.vmap
    def residual(x):
        def value(x):
            result = simulate(structure, build(numbers, x))
            return 1e6 * jnp.sum(result.metrics.residual_rms)

        return value(x), jax.jacfwd(value)(x)

    at, step = np.array([0.9, 1.2]), 1e-4
    value, slope = residual(at + np.concatenate([k * step * np.eye(2) for k in (1, -1, 0)]))
    wanted = (value[:2] - value[2:4]) / (2 * step)
    np.testing.assert_allclose(slope[4], wanted, rtol=1e-5)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ((1.0, 1.0), r"patches.sensor_factor = .*; allowed: one number, 3 of them \(one a patch\)"),
        (11.0, r"patches.sensor_factor = 11.0; allowed: a finite number >= 0 and <= 10.* \[1\]"),
        (
            ((1.0, -0.1, 1.0),) * 3,
            r"patches.sensor_factor = .*-0.1.*; allowed: a finite number >= 0",
        ),
    ],
)
def test_what_is_no_factor_is_refused(value, text):
    with pytest.raises(StudyError, match=text):
        STUDY.change(patches__sensor_factor=value)
    with pytest.raises(StudyError, match=r"patches.sensor_factor"):
        build_table(small_spec(SWEEP | {"axes": {"patches.sensor_factor": [value]}}))


def test_machines_of_a_tuning_mix_numbers_and_lists():
    """One number is for all patches, a list for all links by patch; a list each link."""
    study, name = (
        STUDY.change(patches__centers=(0.06, 0.14), control__modes=2),
        "patches.sensor_factor",
    )
    each = ((0.9, 1.0), (1.0, 1.1), (1.0, 0.8))
    column = column_of([as_list(name, x, study) for x in (1.2, (0.9, 1.1), each)])
    structure = build_structure(study, {name: column})
    found = build_cases(study, {name: column}, structure).machine.patches.sensor_factor
    np.testing.assert_array_equal(found, [[[1.2, 1.2]] * 3, [[0.9, 1.1]] * 3, each])


def test_a_sweep_has_lists_of_one_shape():
    axes = {"patches.sensor_factor": [1.0, [0.9, 1.0, 1.1]]}
    with pytest.raises(StudyError, match="sensor_factor: lists of different shape in one sweep"):
        build_table(small_spec({"method": "grid", "axes": axes}))


# --- what is found by measuring, and certificates -------------------------------------------------


def test_a_fit_finds_one_weak_actuator(tmp_path):
    blank(tmp_path)
    name = "patches.actuator_factor[0][1]"
    free = {name: {"from": 0.5, "to": 1.5}, "link.damping_ratio": {"from": 0.005, "to": 0.03}}
    others = {"input": "actuator 1.2", "output": "sensor 1.1"}
    spec = spec_of(tmp_path, RESPONSE, RESPONSE | others, free=free)
    bench, every, _ = made(spec)
    rng = np.random.default_rng(0)
    for one in every:
        give_data(bench, one, np.array([0.8, 0.012]), rng)
    problem = make_problem(spec, bench, every)
    value = problem.free.values(followed(problem))
    assert problem.free.names[0] == name
    assert value[0] == pytest.approx(0.8, rel=0.005) and value[1] == pytest.approx(0.012, rel=0.05)


def changed(study, **fields):
    """Designs of a study, and of one whose machine differs, with the same controller."""
    nominal, other = fixed_controller(study), fixed_controller(study.change(**fields))
    for one, same in zip(
        *map(jax.tree.leaves, (other.controller, nominal.controller)), strict=True
    ):
        np.testing.assert_array_equal(one, same)
    return nominal, other


def test_certificates_see_unequal_patches():
    """Their plants, and tolerances of sensors and actuators, which are about the factors."""
    positive = np.where(S > 0, S, 1.0), np.where(A > 0, A, 1.0)
    sensor, actuator = (tuple(map(tuple, x.tolist())) for x in positive)
    nominal, other = changed(
        STUDY, patches__sensor_factor=sensor, patches__actuator_factor=actuator
    )
    zero = np.zeros(3)
    change = MachineChange(
        stiffness=zero,
        damping=zero,
        payload=np.zeros(()),
        patch=0 * S,
        delay=np.zeros(()),
        actuator=0 * S,
        sensor=0 * S,
        joint_inertia=zero,
    )
    drawn = change._replace(sensor=np.log(positive[0]), actuator=np.log(positive[1]))
    found = [
        np.asarray(
            breaking._transition(*breaking._machine(design), POSE, nominal.controller, by)[0]
        )
        for design, by in ((nominal, drawn), (other, change))
    ]
    close(found[0], found[1])
    law = pad_channels(nominal.controller, nominal.n_patches)
    plant = PlantVariant("loaded", 3)
    radii = [LoopBuilder(x).loop(plant, law).poles(1.0) for x in (nominal, other)]
    assert np.abs(radii[0] - radii[1]).max() > 1e-3


@pytest.mark.parametrize("has_correction", [True, False])
def test_proofs_of_boxes_know_unequal_patches(has_correction):
    """What they collect is the equal machine's, times the factors."""
    designs = changed(STUDY.change(link__static_correction=has_correction), **UNEQUAL)
    law = pad_channels(designs[0].controller, designs[0].n_patches)
    equal, unequal = (collect(design, law, SINES, 12) for design in designs)
    s, a = S.ravel(), A.ravel()
    wanted = equal._replace(
        push=equal.push * a,
        read=s[:, None] * equal.read,
        sensor=S[:, :, None] * equal.sensor,
        actuator=equal.actuator * A[:, None],
        steepest=(S * equal.steepest[0], A * equal.steepest[1]),
        held=S[:, :, None] * equal.held * A[:, None],
        exact=None if equal.exact is None else S[:, :, None] * equal.exact * A[:, None],
    )
    close(unequal, wanted, 1e-9)


# --- verification ---------------------------------------------------------------------------------


def test_verification_knows_factors_and_notices_one_that_is_forgotten(monkeypatch):
    study = STUDY.change(**UNEQUAL)
    assert all(row.is_passed and not row.left_out for row in links.check_links(study))
    known = links.prepared

    def forgotten(study):
        structure, case, found = known(study)
        alike = known(STUDY)[2].loop.left_out
        return structure, case, found._replace(loop=found.loop._replace(left_out=alike))

    monkeypatch.setattr(links, "prepared", forgotten)
    failed = [row.assumption for row in links.check_links(study) if not row.is_passed]
    assert failed == ["static bending by the patches, all modes"]
