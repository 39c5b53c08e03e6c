"""Linearisation and free motion against an independent finite-element multibody code."""

from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel.case import Structure
from jaxmodel.defaults import HOME
from jaxmodel.linear import flatten, frequency_response, linearise, natural_modes, unflatten
from jaxmodel.loop import PlantState
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import assembled_modes, loop_response
from jaxmodel.simulate import _about
from studies.engine.programs import kept_jit
from studies.engine.runs import _simulate
from studies.reference import tables
from studies.study.cases import as_arrays, build_case, build_structure
from tests.bare import paper_study

UNDAMPED = paper_study().change(
    link__modes=3, link__damping_ratio=0.0, control__feedback="none", drive__kd=0.0
)


@partial(jax.jit, static_argnums=0)
def linear_plant(structure, case):
    loop = prepare(structure, case).loop
    return linearise(structure, loop, np.array(HOME))


def linear(study):
    plant = linear_plant(build_structure(study), as_arrays(build_case(study)))
    return jax.tree.map(np.asarray, plant)


_prepare = kept_jit(static_argnums=0)(prepare)
response = jax.jit(frequency_response)


def prepared(study):
    return _prepare(build_structure(study), as_arrays(build_case(study)))


@pytest.mark.parametrize("name", tables.HELD)
def test_frequencies_equal_finite_elements(name):
    modes = natural_modes(linear(UNDAMPED.change(**tables.HELD[name])))
    rigid = modes.frequency[modes.frequency < 1]
    found = modes.frequency[modes.frequency > 1]
    assert rigid.size == (0 if "springs" in name else 3)
    np.testing.assert_allclose(found, tables.frequencies(name), rtol=2e-4)
    assert not modes.damping_ratio.any()


def test_assembled_modes_are_those_of_the_linear_plant():
    """Of the machine whose drives and links have little damping, told to first order."""
    study = paper_study().change(link__modes=3, drive__kd=1.0)
    structure, case = build_structure(study), as_arrays(build_case(study))

    @jax.jit
    def assembled(case):
        loop = prepare(structure, case).loop
        return assembled_modes(loop_response(structure, case, loop, np.array(HOME)))

    modes, found = natural_modes(linear(study)), assembled(case)
    np.testing.assert_allclose(found.omega / (2 * np.pi), modes.frequency, rtol=1e-3)
    np.testing.assert_allclose(found.decay / found.omega, modes.damping_ratio, rtol=0.02)


def test_one_mode_is_enough_for_the_first_frequency():
    modes = natural_modes(linear(UNDAMPED.change(link__modes=1, drive__kp=0.0)))
    wanted = tables.frequencies("sliders_free")[:3]
    np.testing.assert_allclose(modes.frequency[3:], wanted, rtol=3e-6)


def test_pinned_free_modes_converge_slowly_to_the_same_frequencies():
    modes = natural_modes(linear(UNDAMPED.change(link__basis="pinned_free", drive__kp=0.0)))
    np.testing.assert_allclose(modes.frequency[[3, 6]], [114.9, 462.8], atol=0.05)


def test_equal_modes_that_rounding_splits_are_two():
    """A double eigenvalue may come out as a complex pair, whose real parts are one shape."""
    block, one = np.array([[-2.0, 1e-15], [-1e-15, -2.0]]), np.eye(2)
    state, order = np.zeros((4, 4)), [0, 2, 1, 3]  # from (X, q, X', q') to (X, X', q, q')
    state[np.ix_(order, order)] = np.block([[0 * one, one], [block, 0 * one]])
    modes = natural_modes(linear(UNDAMPED)._replace(state=state, force=np.zeros((4, 1))))
    np.testing.assert_allclose(modes.frequency, np.sqrt(2) / (2 * np.pi), rtol=1e-12)
    assert abs(np.linalg.det(modes.shape)) > 0.5


def test_first_frequencies_are_the_same_for_the_other_assembly():
    changes = {"machine__assembly": "outward", "drive__kp": 0.0}
    modes = natural_modes(linear(UNDAMPED.change(**changes)))
    np.testing.assert_allclose(modes.frequency[3:], tables.frequencies("sliders_free"), rtol=2e-4)


def test_damping_ratio_of_the_links_alone():
    modes = natural_modes(linear(UNDAMPED.change(link__damping_ratio=0.013, drive__locked=True)))
    np.testing.assert_allclose(modes.damping_ratio[3:], 0.013, rtol=1e-9)


def test_overdamped_pairs_keep_their_frequency_and_damping():
    plant = linear(UNDAMPED.change(drive__kd=600.0, link__damping_ratio=0.01))
    modes = natural_modes(plant)
    assert modes.frequency.size == 3 + 9 and np.all(np.diff(modes.frequency) >= 0)
    # the product of all poles is det A, so frequencies multiply to its root
    mechanical = np.prod(np.linalg.eigvals(plant.state))
    log_product = 2 * np.sum(np.log(2 * np.pi * modes.frequency))
    np.testing.assert_allclose(log_product, np.log(mechanical.real), rtol=1e-9)
    assert np.sum(modes.damping_ratio >= 1) >= 3


def test_real_poles_are_paired_with_their_own():
    """Sliders braked hard: all three drive modes are alike, slow and fast poles of one each."""
    modes = natural_modes(linear(UNDAMPED.change(drive__kd=1000.0)))
    drive = modes.damping_ratio > 1
    assert drive.sum() == 3
    np.testing.assert_allclose(modes.frequency[drive], [50.9, 50.9, 56.2], atol=0.1)
    np.testing.assert_allclose(modes.damping_ratio[drive], [8.0, 8.0, 8.83], atol=0.01)


def test_response_of_a_locked_link_to_its_actuators_is_the_modal_sum():
    study = UNDAMPED.change(link__damping_ratio=0.01, drive__locked=True)
    plant = linear(study)
    frequency = np.array([1.0, 60.0, 114.39, 300.0, 457.5])
    found = np.asarray(response(plant, plant.deflection, plant.voltage, frequency))
    loop = jax.tree.map(np.asarray, prepared(study).loop)
    omega, s = np.asarray(loop.omega[0]), 2j * np.pi * frequency[:, None]
    receptance = 1 / (s**2 + 0.02 * omega * s + omega**2)  # per modal mass, as is the actuator
    modal_sum = np.einsum(
        "sr,fr,rk->fsk", loop.deflection_at[0], np.asarray(receptance), loop.actuator[0]
    )
    scale = np.abs(modal_sum).max()
    np.testing.assert_allclose(found[:, :3, :3], modal_sum, atol=1e-10 * scale)
    np.testing.assert_allclose(found[:, 3:, :3], 0, atol=1e-10 * scale)  # no way to other links


def test_static_response_of_the_free_machine_is_that_of_its_springs():
    """At rest on the drive a voltage bends its own link by sum Y_j Q_j/k_j and moves nothing."""
    study = UNDAMPED.change(link__damping_ratio=0.01, drive__kd=60.0)
    plant = linear(study)
    found = np.array(response(plant, plant.deflection, plant.voltage, np.zeros(1)))[0]
    loop = jax.tree.map(np.asarray, prepared(study).loop)
    bending = np.asarray(loop.actuator / loop.omega[:, :, None] ** 2)
    static = np.einsum("isr,irk->isk", np.asarray(loop.deflection_at), bending)
    scale = np.abs(static).max()
    for i in range(3):
        own = slice(3 * i, 3 * i + 3)
        np.testing.assert_allclose(found[own, own], static[i], atol=1e-9 * scale)
        found[own, own] = 0
    np.testing.assert_allclose(found, 0, atol=1e-9 * scale)


def test_drive_damps_the_pose_modes():
    modes = natural_modes(linear(UNDAMPED.change(drive__kd=60.0)))
    assert np.all(modes.damping_ratio[:3] > 0.1)
    assert np.all(modes.damping_ratio[3:] < 0.01)


def test_flatten_and_unflatten_are_inverse():
    rng = np.random.default_rng(0)
    state = PlantState(*rng.normal(size=(2, 3)), *rng.normal(size=(2, 3, 5)))
    for before, after in zip(
        state[:4], unflatten(flatten(state), Structure(n_modes=5)), strict=False
    ):
        np.testing.assert_array_equal(before, after)


@pytest.mark.long  # in short: fast moves, in test_axial
def test_released_link_moves_like_the_finite_element_link():
    time, given = tables.free_response()
    study = UNDAMPED.change(
        link__modes=8,
        drive__locked=True,
        run__duration=0.0501,
        motion__waypoints=((0.0, 0.0, HOME[2]),),
        shaper__kind="none",
        initial__load_station=0.1,
        initial__load_deflection=(5e-5, 0.0, 0.0),
        metrics__stations=(0.5,),
    )
    structure, case = build_structure(study), as_arrays(build_case(study))
    few = structure._replace(metrics=("residual_rms",), n_frequencies=1)
    record = _simulate(few, case, True).record
    deflection = np.asarray(record.chord_deflection_stations)[:, :, 0]
    np.testing.assert_allclose(record.time[::2], time, atol=1e-12)
    np.testing.assert_allclose(deflection[::2, 0], given, atol=0.001 * 5e-5)
    # the neighbours feel that its chord grows and shrinks by 31 nm
    assert 0 < np.abs(deflection[:, 1:]).max() < 1e-3 * 5e-5


def test_a_linear_machine_rests_at_the_last_way_point():
    study = UNDAMPED.change(motion__waypoints=(HOME, (0.0, 0.01, HOME[2]), (0.01, 0.02, HOME[2])))
    structure = build_structure(study)._replace(is_linear=True)
    pose = jax.jit(lambda case: prepare(structure, case).loop.rest.pose)(
        as_arrays(build_case(study))
    )
    assert pose.tolist() == [0.01, 0.02, HOME[2]]


def test_shapes_have_a_largest_entry_of_one():
    shape = natural_modes(linear(UNDAMPED)).shape
    largest = shape[np.argmax(np.abs(shape), axis=0), np.arange(shape.shape[1])]
    np.testing.assert_allclose(largest, 1.0, rtol=1e-12)


def test_a_function_about_rest_is_its_tangent():
    linear = _about(lambda pose, rate: pose**2 + 3 * rate + rate**2, np.array([2.0]))
    pose, rate = np.array([[2.0], [2.5]]), np.array([[0.0], [0.5]])
    np.testing.assert_allclose(linear(pose, rate), [[4.0], [4 + 4 * 0.5 + 1.5]], rtol=1e-14)
