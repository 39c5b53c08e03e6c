"""Forces along the links: fast moves against finite elements, preload, buckling, stretch, KED."""

import warnings
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest

import studies
from jaxmodel import axial, status
from jaxmodel.bases import find_bases
from jaxmodel.defaults import HOME
from jaxmodel.dynamics import modal_chain
from jaxmodel.kinematics import close_chain
from jaxmodel.linear import Moment, linearise, natural_modes
from jaxmodel.prepare import prepare
from jaxmodel.simulate import command
from studies.engine.preflight import check_run
from studies.engine.runs import _simulate
from studies.engine.stability import loop_report, run_report
from studies.errors import ModelWarning, StudyError
from studies.reference import lagrangian as reference
from studies.reference import tables
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.margin import ENOUGH
from studies.study.spec import load_study
from tests.bare import paper_study

SPECS = Path(studies.__file__).parent / "specs"
HOME_POSE = np.array(HOME)
BARE = paper_study().change(
    link__damping_ratio=0.0, control__feedback="none", drive__kd=0.0, link__modes=3
)
N_CR = np.pi**2 * 70e9 * (0.01 * 0.002**3 / 12) / 0.2**2  # 115 N


def arrays(study):
    return build_structure(study), as_arrays(build_case(study))


def simulated(structure, case, *metrics):
    """A run with its record and few metrics: what nobody asks for takes time to compile."""
    few = structure._replace(metrics=metrics or ("residual_rms",), n_frequencies=1)
    return _simulate(few, case, True)


@partial(jax.jit, static_argnums=0)
def plant_of(structure, case):
    return prepare(structure, case).loop.plant


@partial(jax.jit, static_argnums=0)
def linear_at(structure, case, pose, moment):
    loop = prepare(structure, case).loop
    return linearise(structure, loop, pose, moment)


close = jax.jit(close_chain)
axial_force = jax.jit(axial.axial_force)


def loaded_frequency(plant, tension):
    """Frequencies of links with held ends under axial forces [rad/s], (3, R)."""
    stiffness = plant.stiffness[:, :, None] * np.eye(plant.stiffness.shape[1])
    stiffness = stiffness + np.asarray(tension)[:, None, None] * axial.chord_slopes(plant)
    return np.sqrt(np.linalg.eigvalsh(stiffness / plant.modal_mass[:, None, None]))


def bending(study, wrench=(0.0, 0.0, 0.0), acceleration=(0.0, 0.0, 0.0)):
    """Frequencies above the drive's [Hz], of the machine at home under a load."""
    moment = Moment(np.zeros(3), np.array(acceleration), np.array(wrench))
    plant = jax.tree.map(np.asarray, linear_at(*arrays(study), HOME_POSE, moment))
    found = natural_modes(plant).frequency
    return found[found > 80]


def statics(wrench):
    """Tension in each link at home from the platform's equilibrium alone [N]."""
    machine = jax.tree.map(np.asarray, as_arrays(build_case(BARE)).machine)
    angle = np.asarray(machine.geometry.guide_angle) + np.pi / 3  # gamma = 60 deg
    axis = np.stack([np.cos(angle), np.sin(angle)])
    arm = np.asarray(reference.platform_joints(machine.geometry, HOME_POSE)) - HOME_POSE[:2]
    moment = arm[:, 0] * axis[1] - arm[:, 1] * axis[0]
    # a link in tension pulls the platform towards its slider, against its axis
    return np.linalg.solve(np.vstack([axis, moment]), np.array(wrench))


def fast_square(**changes):
    """Square of 10 mm in 0.05 s a move, no shaper, no damping, PD drive: ours, and finite elements.

    Deflections of mid-span [m], (T, 3), and poses (T, 3), at the instants of the file; time [s].
    """
    given = tables.fast_move()
    study = BARE.change(
        drive__kd=60.0,
        motion__move_time=0.05,
        shaper__kind="none",
        run__duration=0.3001,
        metrics__stations=(0.5,),
        metrics__residual_delay=0.0,
        metrics__residual_length=0.1,
        **changes,
    )
    record = simulated(*arrays(study)).record
    at = np.round(given.time / 1e-4).astype(int)
    deflection = np.asarray(record.chord_deflection_stations)[at, :, 0]
    return given.time, (deflection, given.deflection), (np.asarray(record.pose)[at], given.pose)


FAST = [
    pytest.param({"link__modes": 3}, marks=pytest.mark.long),
    {"link__modes": 8},
    pytest.param({"link__modes": 8, "link__axial_inertia": "distributed"}, marks=pytest.mark.long),
]


@pytest.mark.parametrize("changes", FAST)
def test_fast_moves_equal_finite_elements(changes):
    time, (deflection, wanted), (pose, true_pose) = fast_square(**changes)
    assert (np.abs(deflection - wanted).max(axis=0) < 1e-3 * np.abs(wanted).max(axis=0)).all()
    rms, true = (np.sqrt(np.mean(x[time > 0.2] ** 2, axis=0)) for x in (deflection, wanted))
    np.testing.assert_allclose(rms, true, rtol=5e-3)
    np.testing.assert_allclose(pose[:, :2], true_pose[:, :2], atol=150e-9)
    np.testing.assert_allclose(pose[:, 2], true_pose[:, 2], atol=2e-6)


@pytest.mark.long  # in short: a preload that the model without shortening does not feel, below
def test_the_model_without_shortening_is_far_off_on_fast_moves():
    """What the comparison above must notice: 5 % of the peak."""
    _, (deflection, wanted), _ = fast_square(link__shortening=False)
    assert np.abs(deflection - wanted).max() > 0.03 * np.abs(wanted).max()


#: Links ten times as dense and half as thick, in the programs of the fast square.
HEAVY_LINKS = BARE.change(
    link__modes=8,
    link__density=27500.0,
    link__thickness=1e-3,
    drive__kd=60.0,
    motion__move_time=0.05,
    shaper__kind="none",
    run__duration=0.3001,
    metrics__residual_delay=0.0,
    metrics__residual_length=0.05,
    metrics__stations=(0.5,),
)


#: Of the lumped model of these links, by a run of each model: see the long test.
HEAVY_ERROR = 0.00959


def test_lumped_inertia_of_heavy_links_is_estimated_and_reported():
    with pytest.warns(ModelWarning, match=r"link\.axial_inertia = 'lumped' .* about") as found:
        check_run(HEAVY_LINKS)
    words = next(text for x in found if "axial_inertia" in (text := str(x.message)))
    estimate = float(words.split("about ")[1].split(" %")[0]) / 100
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", "link.basis = .* leaves out the patches|link.density = ")
        check_run(HEAVY_LINKS.change(link__axial_inertia="distributed"))
        check_run(HEAVY_LINKS.change(link__shortening=False))
    # undamped: phases drift apart
    assert estimate / 3 < HEAVY_ERROR < 3 * estimate


@pytest.mark.long
def test_runs_of_heavy_links_differ_as_the_estimate_expects():
    studies = (HEAVY_LINKS.change(link__axial_inertia=x) for x in ("lumped", "distributed"))
    results = (simulated(*arrays(x)) for x in studies)
    mine, true = (np.asarray(x.record.chord_deflection_stations) for x in results)
    error = np.abs(mine - true).max() / np.abs(true).max()
    assert error == pytest.approx(HEAVY_ERROR, rel=1e-2)


HELD = BARE.change(drive__locked=True, machine__platform_mass=1e3, machine__platform_inertia=1e2)


@pytest.mark.parametrize("wrench", [(40.0, 0.0, 0.0), (-40.0, 25.0, 0.0), (0.0, 0.0, 5.0)])
def test_axial_force_changes_the_frequency_of_a_link_between_held_ends(wrench):
    tension = statics(wrench)
    assert np.abs(tension).max() > 20
    structure, case = arrays(HELD)
    plant = plant_of(structure, case)
    still = np.zeros(3)
    found = axial_force(plant, HOME_POSE, still, still, np.array(wrench))
    np.testing.assert_allclose(found, tension, atol=1e-9)
    np.testing.assert_allclose(axial.critical_force(plant), N_CR, rtol=1e-12)
    first = 1 + tension[:, None] / (np.arange(1, 4) ** 2 * N_CR)
    wanted = np.sort((114.388 * np.arange(1, 4) ** 2 * np.sqrt(first)).ravel())
    scale = 114.388 / (np.asarray(plant.stiffness / plant.modal_mass[:, None])[0, 0] ** 0.5)
    np.testing.assert_allclose(
        np.sort(np.ravel(loaded_frequency(plant, found))) * scale, wanted, rtol=1e-12
    )
    # the whole machine, its ends held by inertia, has the same frequencies
    held = bending(HELD, wrench)[:9] * 2 * np.pi * scale
    np.testing.assert_allclose(held, wanted, rtol=1e-6)


def test_axial_force_of_straight_links_is_the_same_in_every_basis():
    wrench, acceleration = np.array([7.0, -3.0, 0.2]), np.array([5.0, 20.0, -30.0])
    forces = [
        axial_force(
            plant_of(*arrays(BARE.change(link__basis=kind))),
            HOME_POSE,
            np.array([0.2, 0.1, 0.5]),
            acceleration,
            wrench,
        )
        for kind in ("pinned_pinned", "pinned_free")
    ]
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-9)


def test_static_preload_equals_finite_elements():
    """20 N on the platform at home, sliders on springs: 108.19, 118.16, 118.47 Hz."""
    found = bending(BARE, (20.0, 0.0, 0.0))[:3]
    np.testing.assert_allclose(found, [108.19, 118.16, 118.47], atol=0.02)
    without = bending(BARE.change(link__shortening=False), (20.0, 0.0, 0.0))[:3]
    np.testing.assert_allclose(without, [114.73, 115.19, 115.20], atol=0.01)


#: Runs that share a program: a wrench, several plant steps a sample.
LOADED = BARE.change(
    run__duration=0.1,
    run__substeps=4,
    metrics__residual_delay=0.0,
    metrics__residual_length=0.02,
    shaper__kind="none",
    motion__waypoints=(HOME, HOME),
    motion__move_time=0.02,
    load__wrench=(20.0, 0.0, 0.1),
)


@pytest.mark.parametrize(("share", "code"), [(0.99, status.OK), (1.01, status.BUCKLED)])
def test_a_load_beyond_the_critical_force_is_a_status(share, code):
    """The moment that compresses all links alike up to N_cr, and a little beyond."""
    moment = -share * N_CR * 5.0 / statics((0.0, 0.0, 5.0))[0]
    structure, case = arrays(LOADED)
    load = case.load._replace(wrench=np.array([0.0, 0.0, moment]))
    result = simulated(structure, case._replace(load=load))
    assert result.status == code
    assert np.isfinite(result.metrics.residual_rms).all() == (code == status.OK)
    if code == status.BUCKLED:
        with pytest.raises(StudyError, match=r"load.wrench.*115.1 N .here link .: 116.3 N"):
            check_run(LOADED.change(load__wrench=(0.0, 0.0, moment)))


def test_links_buckle_before_a_path_leaves_the_reach():
    """The fault that comes first is the one that counts, and when it comes."""
    study = BARE.change(run__duration=0.1, shaper__kind="none", motion__waypoints=(HOME, HOME))
    structure, case = arrays(study)
    structure = structure._replace(has_wrench=True)
    away = case.path._replace(waypoints=HOME_POSE + np.array([[0, 0, 0], [0, 1.0, 0]]))

    @jax.jit
    def faults(moment):
        load = case.load._replace(wrench=np.array([0, 0, 1.0]) * moment)
        loaded = case._replace(path=away, load=load)
        found = command(structure, loaded, prepare(structure, loaded))
        return found.status, found.bad_time

    code, time = faults(0.0)
    assert code == status.OUT_OF_REACH and 0 < time < study.motion.move_time
    assert faults(-1.01 * N_CR * 5.0 / statics((0.0, 0.0, 5.0))[0]) == (status.BUCKLED, 0)


def test_a_steady_load_is_held_and_a_pulse_moves_the_platform():
    study = LOADED.change(drive__kd=60.0, link__damping_ratio=0.01)
    held = simulated(*arrays(study))
    np.testing.assert_allclose(held.record.pose, np.tile(HOME, (1000, 1)), atol=1e-12)
    # a long pulse: the platform sags as on the springs of the drive, dX = (J^t Kp J)^-1 W
    pulse = {"load__pulse": (5.0, 0.0, 0.0), "load__pulse_length": 0.1}
    pushed = simulated(*arrays(study.change(**pulse)))
    plant = plant_of(*arrays(BARE))
    jacobian = np.stack([close(plant, HOME_POSE, rate).rho_rate for rate in np.eye(3)], axis=1)
    sag = np.linalg.solve(jacobian.T @ jacobian * 2e4, [5.0, 0.0, 0.0])
    moved = np.asarray(pushed.record.pose[-1]) - HOME_POSE
    np.testing.assert_allclose(moved[:2], sag[:2], atol=0.02 * sag[0])
    assert abs(moved[2]) < 5e-6  # what is left is bending and second order


# --- axial compliance -----------------------------------------------------------------------------


@pytest.mark.parametrize("pose", [HOME_POSE, HOME_POSE + np.array([0.006, -0.004, 0.03])])
def test_stretch_error_is_the_geometry_of_longer_links(pose):
    plant = plant_of(*arrays(BARE))
    stretch = 1e-6 * np.array([3.0, -2.0, 1.0])
    still = np.zeros(3)
    chain = close(plant, pose, still)
    found = np.asarray(jax.jit(axial.stretch_error)(chain, stretch))
    longer = plant._replace(length=plant.length + stretch)
    moved = close(longer, pose + found, still)
    np.testing.assert_allclose(moved.rho, chain.rho, atol=1e-10)  # the sliders stay
    np.testing.assert_allclose(axial.axial_compliance(arrays(BARE)[1].machine), 0.2 / 1.4e6)


# --- kineto-elastodynamics ------------------------------------------------------------------------


def test_ked_has_no_coupled_frequencies():
    """No split of 114.7 and 115.2 Hz: every link rings as between held ends."""
    found = bending(BARE.change(run__model="ked"))
    np.testing.assert_allclose(found, np.repeat([114.388, 457.552, 1029.49], 3), rtol=1e-5)
    assert np.ptp(bending(BARE)[:3]) > 0.4


@pytest.mark.long  # in short: what bends links in KED, in test_dynamics
def test_ked_leaves_uncontrolled_links_as_they_are():
    """Table 1 would read exactly 0 %: control of link 1 changes links 2 and 3 by nothing."""
    study = paper_study().change(
        link__modes=3,
        motion__move_time=0.03,
        shaper__kind="none",
        run__duration=0.2,
        metrics__residual_length=0.03,
        metrics__residual_delay=0.05,
    )

    def residual(links, model):
        changed = study.change(control__links=links, run__model=model)
        return np.asarray(_simulate(*arrays(changed), False).metrics.residual_rms)[:, 1]

    none, one = ((False,) * 3, (True, False, False))
    before, after = (residual(links, "ked") for links in (none, one))
    np.testing.assert_array_equal(after[1:], before[1:])
    assert after[0] < 0.9 * before[0]
    coupled = residual(one, "coupled") / residual(none, "coupled") - 1
    assert np.abs(coupled[1:]).min() > 0.005


KED_METRICS = ("structural_peak", "residual_rms")


@pytest.mark.long  # in short: what bends links in KED, in test_dynamics
@pytest.mark.parametrize(("kp", "peak", "residual"), [(2e4, 0.01, 0.15), (1e5, 0.08, None)])
def test_ked_fails_where_the_drive_rings_with_the_links(kp, peak, residual):
    """Two cells of the map of docs/reference/exploring.md: 10 mm in 0.05 s."""
    study = load_study(SPECS / "paper.toml").change(
        motion__waypoints=(HOME, (0.0, 0.01, HOME[2])),
        motion__move_time=0.05,
        link__modes=3,
        shaper__kind="none",
        control__feedback="none",
        run__duration=0.2,
        metrics__residual_delay=0.0,
        metrics__residual_length=0.1,
        drive__kp=kp,
    )
    coupled, ked = (
        simulated(*arrays(study.change(run__model=model)), *KED_METRICS).metrics
        for model in ("coupled", "ked")
    )

    def error(name):
        right, found = (np.asarray(getattr(m, name)) for m in (coupled, ked))
        return np.abs(found - right).max() / right.max()

    assert error("structural_peak") < peak
    if residual is None:
        assert error("structural_peak") > 0.02 and error("residual_rms") > 0.3
    else:
        assert error("residual_rms") < residual


# --- along the path -------------------------------------------------------------------------------


def test_margins_move_with_the_forces_of_the_motion():
    study = paper_study().change(motion__move_time=0.03)
    structure, case = arrays(study)
    loop, found = run_report(structure, case, HOME_POSE)
    at_rest = loop_report(structure, case, HOME_POSE).gain_margin
    np.testing.assert_allclose(loop.gain_margin, at_rest, rtol=1e-9)
    np.testing.assert_allclose(found.gain_margin[0], at_rest, rtol=1e-3)
    assert found.time[0] == 0 and np.abs(found.axial_force[0]).max() < 1e-9
    assert 8 < np.abs(found.axial_force).max() < 14
    pull, push = found.axial_force.max(axis=0), -found.axial_force.min(axis=0)
    np.testing.assert_allclose(pull, push, rtol=0.1)  # of every link: it brakes as hard
    moved = np.abs(found.gain_margin / at_rest - 1).max()
    assert 1e-4 < moved < 0.02  # mode 7 decides, which hardly feels N


def test_frequencies_move_with_the_forces_of_the_motion():
    """A heavy platform that accelerates by 0.04 m/s2 pulls and pushes with 40 N."""
    plant, acceleration = plant_of(*arrays(HELD)), np.array([0.0, 0.04, 0.0])
    tension = axial_force(plant, HOME_POSE, np.zeros(3), acceleration)
    np.testing.assert_allclose(tension, statics((0.0, -40.0, 0.0)), atol=0.01)  # and the links' own
    wanted = np.sort(np.ravel(loaded_frequency(plant, tension))) / (2 * np.pi)
    np.testing.assert_allclose(bending(HELD, acceleration=acceleration)[:9], wanted, rtol=1e-6)


# --- the machine as it was measured ---------------------------------------------------------------


@pytest.mark.parametrize("modes", [8, pytest.param(12, marks=pytest.mark.long)])
def test_the_measured_machine_has_a_margin(modes):
    """Patches and joint inertia in the plant, measured frequencies in the controller."""
    study = load_study(SPECS / "measured.toml").change(link__modes=modes)
    found = loop_report(*arrays(study), HOME_POSE)
    # longitudinal modes leave less than the 2.5 and more of links that keep their length
    assert found.gain_margin > ENOUGH and found.is_stable
    assert 92 < found.frequency_hz[0].min() < 97 and found.damping_ratio[0].min() > 0.08


MEASURED = load_study(SPECS / "measured.toml").change(
    motion__move_time=0.03,
    control__links=(False,) * 3,
    shaper__kind="none",
    run__duration=0.5,
    metrics__residual_delay=0.0,
    metrics__residual_length=0.1,
)


@pytest.mark.long  # in short: where spectra are taken, in test_metrics
def test_spectra_of_the_measured_machine_stand_on_their_peaks():
    density = np.asarray(_simulate(*arrays(MEASURED), False).metrics.spectral_density)
    assert (np.abs(density[:, 0].argmax(axis=-1) - 4) <= 1).all()  # of 9 points, +-10 %


def test_the_measured_machine_has_the_measured_frequencies():
    bases = jax.jit(find_bases, static_argnums=0)(*arrays(MEASURED))
    held = np.asarray(bases.plant_omega) / (2 * np.pi)
    np.testing.assert_allclose(held, np.tile([92.5, 240.2], (3, 1)), rtol=1e-3)


def moved(distance, duration, **changes):
    """Study of a move along y [m] in some time [s], unshaped, with no delay of the window."""
    return paper_study().change(
        motion__waypoints=(HOME, (0.0, distance, HOME[2])),
        motion__move_time=duration,
        shaper__kind="none",
        metrics__residual_delay=0.0,
        run__smooth=True,
        **changes,
    )


@pytest.mark.long  # in short: few steps are as good as forty, in test_integrator
def test_one_step_per_sample_is_enough_for_the_fastest_moves():
    """20 mm in 0.03 s, actuators at their limit, 8 modes: a step against eight."""
    rest = {"run__duration": 0.08, "metrics__residual_length": 0.02}
    study = moved(0.02, 0.03, control__gain_factor=1.0, **rest)
    one, eight = (_simulate(*arrays(study.change(run__substeps=n)), True) for n in (1, 8))
    assert eight.metrics.peak_voltage.max() > 90
    signals = (np.asarray(x.record.chord_deflection_stations) for x in (one, eight))
    coarse, fine = signals
    assert np.abs(coarse - fine).max() < 1e-5 * np.abs(fine).max()


def test_records_are_of_the_sampling_instant():
    """However many steps lead to the next one, sliders are where pose and bending put them."""
    study = LOADED.change(motion__waypoints=(HOME, (0.0, 0.01, HOME[2])))
    record = jax.tree.map(np.asarray, simulated(*arrays(study)).record)
    place = jax.jit(jax.vmap(partial(modal_chain, plant_of(*arrays(BARE)))))
    pose, q = record.pose, record.modal_coordinate
    wanted = place(pose, 0 * pose, q, 0 * q).rho
    # a step of the four moves sliders by far more than what follows allows
    assert np.abs(np.diff(record.slider, axis=0)).max() / 4 > 1e-5
    np.testing.assert_allclose(record.slider, wanted, rtol=0, atol=1e-12)
