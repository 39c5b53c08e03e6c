"""Patches as they are: they stiffen links and lengthen them, against two independent codes."""

from functools import cache, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import sampled_loop
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import closed_loop, sampled_plant
from jaxmodel.sampled_response import IMAGES, image_weights, plant_images, plant_response
from jaxmodel.simulate import begin, simulate
from jaxmodel.stretch import find_stretch, held_voltage
from studies.engine.margins import judge_loops
from studies.engine.runs import run_study
from studies.engine.stability import gain_margin, loop_report, with_margin_modes
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.files import READY
from studies.study.spec import load_study, parse_study
from tests import DATA
from tests.canonical import HOME
from tests.elements import plant_of_elements
from tests.jaxmodel import kept

#: Gain margin and frequency of breaking by finite elements and by Exudyn, and damping of mode 1:
#: of the controller with the paper's basis and half the paper's gains (model.md of the order, 4d).
PUBLISHED = {
    ("pinned_pinned", False, 0.01): (3.699, 1199, 3.705, None),
    ("pinned_pinned", True, 0.01): (1.677, 1248, 1.601, None),
    ("pinned_pinned", True, 0.03): (2.190, 1279, 2.038, None),
    ("loaded", False, 0.01): (5.175, 1197, 5.175, (0.1284, 0.1397, 0.1436)),
    ("loaded", True, 0.01): (1.899, 1266, None, (0.1376, 0.1527, 0.1570)),
    ("loaded", True, 0.03): (2.581, 1296, None, (0.1376, 0.1527, 0.1570)),
}
#: The others are judged by the same few lines; in short the first one.
KINDS = ["prrr", *(pytest.param(kind, marks=pytest.mark.long) for kind in ("rrr", "five_bar"))]
CONTROL = {"basis": "pinned_pinned", "velocity_gain": [1.55, 1.75, 1.7]}


def study_of(basis="loaded", stretch=True, damping=0.01, kind="prrr", control=CONTROL, **link):
    link = {"basis": basis, "stretch": stretch, "stretch_damping": damping, **link}
    control = dict(control)
    if kind == "five_bar":
        control["velocity_gain"] = control["velocity_gain"][:2]
    return parse_study({"machine": {"kind": kind}, "link": link, "control": control})


def judged(study, law=None):
    pose = np.array(study.motion.waypoints[0])
    return loop_report(build_structure(study), build_case(study), pose, law=law)


@cache
def report_of(*arguments):
    return judged(study_of(*arguments))


@pytest.mark.parametrize(
    "machine",
    [pytest.param(x, marks=[] if x[0] == "loaded" else pytest.mark.long) for x in PUBLISHED],
)
def test_margins_and_damping_are_those_of_two_independent_codes(machine):
    margin, frequency, other, damping = PUBLISHED[machine]
    report = report_of(*machine)
    bending = not machine[1]
    np.testing.assert_allclose(report.gain_margin, margin, rtol=1e-3 if bending else 0.03)
    np.testing.assert_allclose(report.breaking_frequency, frequency, rtol=1e-3)
    if other is not None:
        np.testing.assert_allclose(report.gain_margin, other, rtol=0.08)
    if damping is not None:
        np.testing.assert_allclose(report.damping_ratio[0], damping, rtol=0.01)
    assert report.breaking.startswith("stretch of links") != bending


@pytest.mark.parametrize("kind", KINDS)
def test_batches_judge_loops_as_eigenvalues_do(kind):
    study = study_of(kind=kind)
    structure, case = build_structure(study), build_case(study)
    wanted = judged(study)
    batch = judge_loops(structure, jax.tree.map(lambda x: np.asarray(x)[None], case))
    np.testing.assert_allclose(batch.gain_margin, wanted.gain_margin, rtol=1e-3)
    np.testing.assert_allclose(batch.least_damping[0], wanted.damping_ratio.min(axis=1), rtol=1e-3)


def test_lower_filters_leave_longitudinal_modes_alone():
    """The ready-made design has what its first lines say, where the default has half of it."""
    found = [judged(x) for x in (load_study(READY / "filtered.toml"), parse_study({}))]
    margin, default = (x.gain_margin for x in found)
    np.testing.assert_allclose((margin, default), (3.84, 2.10), rtol=3e-3)
    damping = [x.damping_ratio[0].min() for x in found]
    np.testing.assert_allclose(damping, (0.227, 0.123), rtol=5e-3)


def finite_elements():
    """A machine as it is by an independent code: E 68.3e9 Pa, payload 0.12 kg, damping 0.012."""
    with np.load(DATA / "as_it_is_plant.npz") as given:
        modes = dict(given)
    none = {"F": np.zeros((78, 3)), "W": np.zeros((9, 78)), "wres": np.zeros((9, 9))}
    return modes, plant_of_elements({**modes, **none}, coordinates=42)


@partial(jax.jit, static_argnums=0)
def around_finite_elements(structure, case):
    return closed_loop(structure, case, case.path.waypoints[0])


def test_a_controller_around_finite_elements_has_its_published_margin(monkeypatch):
    modes, plant = finite_elements()
    study = study_of(modes=12)
    structure, case = build_structure(study), as_arrays(build_case(study))
    monkeypatch.setattr(sampled_loop, "linearise", lambda *_: plant)
    matrices = jax.tree.map(np.asarray, around_finite_elements(structure, case))
    margin = gain_margin(
        lambda factor: np.linalg.eigvals(matrices.open + factor * matrices.feedback)
    )
    np.testing.assert_allclose(margin, 3.664, rtol=1e-3)
    poles = np.log(np.linalg.eigvals(matrices.open + matrices.feedback)) * 1e4
    mode_1 = poles[(np.abs(np.abs(poles) / (2 * np.pi) - 113.8) < 0.5) & (poles.imag > 0)]
    np.testing.assert_allclose(
        np.sort(-mode_1.real / np.abs(mode_1)), [0.1392, 0.1544, 0.1586], atol=1e-4
    )
    # and our plant of that machine, under the same controller
    mine = study_of(modes=12, youngs_modulus=68.3e9, damping_ratio=0.012)
    mine = mine.change(load__mass=0.12)
    law = prepare(structure, case).loop.controller
    found = judged(mine, law)
    np.testing.assert_allclose(found.gain_margin, margin, rtol=0.03)
    # static volts per volt, all patches
    static = modes["S"] @ (modes["B"] / modes["w2"][:, None]) + modes["res"]
    case = as_arrays(build_case(mine))
    np.testing.assert_allclose(static_volts(mine, case), static, atol=1e-3 * static[0, 0])


def static_volts(study, case):
    """Sensor volts per held actuator volt of the machine, all modes, (9, 9)."""
    plant = sampled_plant(build_structure(study), case, case.path.waypoints[0])
    eye = np.eye(len(plant.state))
    return np.asarray(plant.leave @ np.linalg.solve(eye - plant.state, plant.enter))


#: By plane-stress elasticity of a link with its patches (model.md of the order, 4d).
ELASTICITY = 0.0189


@pytest.mark.parametrize(
    ("basis", "stretch", "rounded"),
    [
        ("pinned_pinned", False, 0.05007),
        ("pinned_pinned", True, 0.0350),
        ("loaded", False, 0.0297),
        ("loaded", True, 0.0198),
    ],
)
def test_static_volts_per_volt_are_a_closed_form(basis, stretch, rounded):
    """lambda_s F l (arm/EI - 1/(z_s EA)) of a pair on its own sensor, from first principles."""
    study = study_of(basis, stretch)
    structure, case = build_structure(study), as_arrays(build_case(study))
    beam, patches = study.link, study.patches
    layers, height = 2 * (basis == "loaded"), (beam.thickness + patches.thickness) / 2
    skin = patches.youngs_modulus * patches.width * patches.thickness
    core = beam.youngs_modulus * beam.width * beam.thickness
    shift = skin * height / (skin + core)
    arm = height if stretch and layers else height - shift
    bending = core * beam.thickness**2 / 12 + layers * skin * (
        height**2 + patches.thickness**2 / 12
    )
    push = patches.width * patches.youngs_modulus * abs(patches.d31)
    permittivity = 8.8541878128e-12 * patches.relative_permittivity
    permittivity -= patches.d31**2 * patches.youngs_modulus
    charge = push * patches.thickness / (permittivity * patches.width)
    wanted = charge * push * (height * arm / bending - stretch / (core + layers * skin))
    loop = kept.prepared(structure, case).loop
    stiffness = loop.plant.stiffness / loop.plant.modal_mass[:, None]
    modal = jnp.einsum("ikr,irl->ikl", loop.sensor / stiffness[:, None], loop.actuator)
    found = np.asarray(modal + loop.left_out.sensor)
    np.testing.assert_allclose(found, wanted * np.eye(3) * np.ones((3, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(wanted, rounded, rtol=3e-3)
    if stretch and layers:
        np.testing.assert_allclose(wanted, ELASTICITY, rtol=0.06)


# --- strain of the ceramics -----------------------------------------------------------------------


class Section(NamedTuple):
    """A link between the ends of its patches."""

    axial: float  # E A [N]
    axis: float  # height of the neutral axis over the middle [m]
    bending: float  # E I about it [N m2]


def section_of(study, faces):
    """With ceramic on some faces, 1 for the actuator's and -1 for the other, by its layers."""
    beam, patches = study.link, study.patches
    half, top = beam.thickness / 2, beam.thickness / 2 + patches.thickness
    layers = [(beam.youngs_modulus * beam.width, -half, half)]
    layers += [
        (patches.youngs_modulus * patches.width, *sorted((side * half, side * top)))
        for side in faces
    ]
    axial, first, second = (
        sum(e * (high**n - low**n) / n for e, low, high in layers) for n in (1, 2, 3)
    )
    return Section(axial, first / axial, second - first**2 / axial)


class Ceramics(NamedTuple):
    """How a pair bends and lengthens its centre."""

    section: Section  # there
    push: float  # axial force of its actuators [N/V]
    moment: float  # [N m/V]
    faces: np.ndarray  # heights of the ceramics' outer faces over the neutral axis [m]


def ceramics_of(study):
    """Of a machine as it is, or of the paper's: moments as if no sensor were opposite."""
    patches = study.patches
    is_paired, is_gauge = patches.actuators == "both faces", patches.sensor == "strain_gauge"
    faces = [1, -1] if is_paired or not is_gauge else [1]
    alone = section_of(study, [1, -1] if is_paired else [1])
    real = section_of(study, faces)
    own = real if study.link.basis == "loaded" else section_of(study, [])
    axis = (real if study.link.stretch and own is real else alone).axis
    push = patches.width * patches.youngs_modulus * abs(patches.d31)
    middle = (study.link.thickness + patches.thickness) / 2
    return Ceramics(
        section=own,
        push=0.0 if is_paired else push,
        moment=push * (2 * middle if is_paired else middle - axis),
        faces=np.array(faces) * (study.link.thickness / 2 + patches.thickness) - real.axis,
    )


BOTH, GAUGES = {"actuators": "both faces"}, {"sensor": "strain_gauge"}


@pytest.mark.parametrize(
    ("basis", "stretch", "patches"),
    [
        ("pinned_pinned", False, {}),
        ("pinned_pinned", True, {}),
        ("pinned_pinned", True, GAUGES),
        ("loaded", False, {}),
        ("loaded", True, {}),
        ("loaded", True, GAUGES),
        ("loaded", True, BOTH),
        ("loaded", True, BOTH | GAUGES),
    ],
)
def test_a_voltage_strains_its_own_pair_as_beam_theory_says(basis, stretch, patches):
    """A link between joints bends and lengthens where it is driven: V M/(E I) and V F/(E A)."""
    study = study_of(basis, stretch).change(**{f"patches__{k}": x for k, x in patches.items()})
    loop = jax.tree.map(np.asarray, kept.prepared(*kept.arrays(study)).loop)
    by_q, by_voltage = loop.strain
    compliance = loop.plant.modal_mass[:, None] / loop.plant.stiffness
    settled = by_q @ (compliance[..., None] * loop.actuator) + by_voltage
    pair = ceramics_of(study)
    drawn = stretch * pair.push / pair.section.axial
    strains = drawn + pair.faces * pair.moment / pair.section.bending
    largest = np.abs(settled.reshape(3, -1, 3, 3)).max(axis=1)
    wanted = np.abs(strains).max() * np.eye(3)
    np.testing.assert_allclose(largest, np.tile(wanted, (3, 1, 1)), rtol=1e-9, atol=1e-15)
    if basis == "loaded" and stretch and not patches:
        np.testing.assert_allclose(100 * largest.max(), 2.707e-5, rtol=1e-3)  # by 100 V


#: The default machine's fast move, 10 mm in 30 ms.
FAST = {
    "run": {"duration": 0.05},
    "motion": {"waypoints": [HOME, [0.0, 0.01, HOME[2]]], "move_time": 0.03},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.015},
}


@pytest.fixture(scope="module")
def fast_move():
    return run_study(parse_study(FAST), has_record=True, has_loop=False)


def elongations(study, record, shortening):
    """How much longer each link is than without load, from poses and sliders [m], (n, 3).

    Its chord is by bending, q S q/2, shorter.
    """
    drawing = build_case(study).machine.geometry
    guide = np.array([2 * np.pi / 3, 4 * np.pi / 3, 0.0])
    along, across = (np.stack([np.cos(x), np.sin(x)], axis=-1) for x in (guide, guide + np.pi / 2))
    angle = record.pose[:, 2:] + drawing.joint_angle
    arm = drawing.joint_radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    joint = record.pose[:, None, :2] + arm
    far, high = np.sum(joint * along, axis=-1) + 0.3, np.sum(joint * across, axis=-1) + 0.3 / 3**0.5
    chord = np.hypot(far - record.slider, high)
    q = record.modal_coordinate
    return chord - study.link.length + np.einsum("tij,ijk,tik->ti", q, shortening, q) / 2


def test_the_fast_move_strains_ceramics_as_its_trajectory_says(fast_move):
    """From modes, voltages, poses and sliders of the record, by sections of layers."""
    study, record = fast_move.study, fast_move.result.record
    beam, patches, pair = study.link, study.patches, ceramics_of(study)
    basis = jax.tree.map(np.asarray, kept.bases_of(*kept.arrays(study)).plant)
    seen, driven, volts = basis.sensor_slope, basis.actuator_slope, record.actuator_voltage
    # a voltage bends its own pair, of which the modes have some
    alone, bare = section_of(study, [1]), section_of(study, [])
    unit = pair.push * ((beam.thickness + patches.thickness) / 2 - alone.axis)
    rest = pair.moment / pair.section.bending * patches.sensor_length * np.eye(3)
    rest = rest - unit * np.einsum("ijk,ij,ijl->ikl", seen, 1 / basis.stiffness, driven)
    turned = np.einsum("tij,ijk->tik", record.modal_coordinate, seen)
    turned = turned + np.einsum("ikl,til->tik", rest, volts)
    # tension, of springs in series: pairs, actuators beside their sensors, and the bare link
    under, beside = patches.sensor_length, patches.actuator_length - patches.sensor_length
    driven = under / pair.section.axial + beside / alone.axial
    whole = 3 * driven + (beam.length - 3 * patches.actuator_length) / bare.axial
    shortening = basis.mixed_shortening + basis.shortening[..., None] * np.eye(beam.modes)
    drawn = elongations(study, record, shortening) - pair.push * driven * volts.sum(axis=2)
    drawn = ((drawn / whole)[..., None] + pair.push * volts) / pair.section.axial
    bent = pair.faces[0] * turned / patches.sensor_length
    wanted = (np.abs(bent) + np.abs(drawn)).max(axis=(0, 2))
    found = fast_move.result.metrics.patch_strain_peak
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    assert np.abs(drawn).max() > 0.05 * wanted.max()
    np.testing.assert_allclose(found.max(), 7.208e-5, rtol=1e-3)


def test_a_run_that_is_not_asked_for_strain_does_not_work_it_out():
    study = parse_study(FAST)
    structure, case = build_structure(study), build_case(study)

    def strain(*metrics):
        start = jax.eval_shape(partial(begin, structure._replace(metrics=metrics)), case)
        return start.loop.strain, "patch_strain_peak" in start.state.totals

    assert strain("residual_rms") == (None, False)
    assert strain("patch_strain_peak")[0] is not None and strain()[1]


@pytest.mark.long  # in short: peaks of other signals, in test_gradients
def test_slopes_of_strain_are_those_of_differences():
    """By the drives' stiffness, and the thickness of links and of patches."""
    study = parse_study(FAST).change(
        link__modes=2,
        control__modes=2,
        run__smooth=True,
        run__duration=0.02,
        run__substeps=2,
        motion__move_time=0.01,
        metrics__residual_length=0.005,
    )
    structure, case = kept.arrays(study)
    structure = structure._replace(metrics=("patch_strain_peak",))

    @jax.jit
    def strain(shares):
        kp, thick, patch = 1 + shares
        beam, patches = case.machine.beam, case.machine.patches
        machine = case.machine._replace(
            beam=beam._replace(thickness=thick * beam.thickness),
            patches=patches._replace(thickness=patch * patches.thickness),
        )
        changed = case._replace(machine=machine, drive=case.drive._replace(kp=kp * case.drive.kp))
        return 1e5 * simulate(structure, changed).metrics.patch_strain_peak

    slope, step = jax.jit(jax.jacfwd(strain))(np.zeros(3)), 1e-5
    wanted = [(strain(by) - strain(-by)) / (2 * step) for by in step * np.eye(3)]
    size = np.abs(slope).max(axis=0)
    assert np.all(size > 0.01)
    np.testing.assert_allclose(slope / size, np.transpose(wanted) / size, atol=1e-5)


@pytest.mark.parametrize("kind", KINDS)
def test_responses_in_closed_form_are_those_of_the_sampled_plant(kind):
    study = study_of(kind=kind)
    structure, case = with_margin_modes(build_structure(study), build_case(study), 8)
    case = as_arrays(case)

    @jax.jit
    def both(case, omega):
        pose = case.path.waypoints[0]
        plant = sampled_plant(structure, case, pose)
        response = plant_response(structure, case, prepare(structure, case).loop, pose)
        z = jnp.exp(1j * omega * response.period)
        eye = jnp.eye(len(plant.state))
        wanted = plant.leave @ jnp.linalg.solve(z * eye - plant.state, plant.enter + 0j)
        images = plant_images(response, omega, np.arange(-IMAGES, IMAGES + 1)).sensed
        weights = image_weights(response.late) * z**-response.late
        return wanted, jnp.einsum("n,nab->ab", weights, images)

    for hertz in (20.0, 460.0, 1180.0, 2450.0):
        wanted, found = both(case, 2 * np.pi * hertz)
        np.testing.assert_allclose(found, wanted, atol=1e-7 * np.abs(wanted).max())


def test_pairs_of_actuators_on_both_faces_do_not_lengthen_links():
    one, both = study_of(), study_of().change(patches__actuators="both faces")
    stretch, paired = (
        find_stretch(case.machine.beam, case.machine.patches, case.machine.damping, True)
        for case in (build_case(one), build_case(both))
    )
    assert np.all(np.asarray(stretch.free) > 0) and not np.any(paired.free)
    assert not np.any(held_voltage(paired)) and np.any(held_voltage(stretch))
    margins = [report_of().gain_margin, judged(both).gain_margin]
    assert margins[1] > 1.3 * margins[0]


@pytest.mark.parametrize(
    ("law", "published"), [("lqg", 13.1), pytest.param("observer", 9.9, marks=pytest.mark.long)]
)
def test_laws_with_a_model_keep_their_margins(law, published):
    """Published: of laws that believe that links keep their length."""
    study = study_of(control=CONTROL | {"law": law})
    ignorant = study.change(link__stretch=False)
    believed = prepare(build_structure(ignorant), as_arrays(build_case(ignorant))).loop.controller
    report = judged(study, believed)
    np.testing.assert_allclose(report.gain_margin, published, rtol=5e-3)
