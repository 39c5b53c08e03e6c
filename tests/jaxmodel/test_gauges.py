"""Strain gauges in place of piezo sensors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.integrate

from jaxmodel import status
from jaxmodel.piezo import actuator_constant, sensor_constant
from jaxmodel.simulate import simulate
from jaxmodel.static import link_pieces, section_stiffness
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case
from studies.verify.links import check_links
from tests.bare import paper_study, parse_study
from tests.jaxmodel import kept
from tests.jaxmodel.kept import loop_at, plant_at, prepared
from tests.jaxmodel.test_onset import BASE, HOME
from tests.studies.kernels.test_kernel import both, check_equal
from tests.sweeps import small_spec

POSE = np.array(HOME)
GAUGES = {
    "sensor": "strain_gauge",
    "gauge_factor": 2.0,
    "gauge_excitation": 4.0,
    "gauge_arms": 2,
    "gauge_gain": 800.0,
}


def arrays(**patches):
    return kept.arrays(parse_study({**BASE, "patches": patches}))


def one_link(case):
    machine = case.machine
    return jax.tree.map(
        lambda x: np.asarray(x)[0] if np.ndim(x) else np.asarray(x), (machine.beam, machine.patches)
    )


def strain_per_curvature(beam, patches):
    """At the bare face [m]: its distance from the axis that bending does not stretch, by layers."""
    bottom, face, top = -beam.thickness / 2, beam.thickness / 2, beam.thickness / 2 + 0.2e-3
    assert top - face == pytest.approx(float(patches.thickness))
    link, patch = float(beam.youngs_modulus), float(patches.youngs_modulus)
    layers = ((link, bottom, face), (patch, face, top))

    def whole(power):
        return sum(
            modulus * scipy.integrate.quad(lambda z: z**power, low, high)[0]
            for modulus, low, high in layers
        )

    return whole(1) / whole(0) - bottom


def test_voltage_is_that_of_the_bridge():
    """Mean strain of mode 1 by quadrature, and a half bridge of resistors by Kirchhoff."""
    structure, case = arrays(**GAUGES)
    beam, patches = one_link(case)
    loop = prepared(structure, case).loop
    left, length, q = 0.05 - 0.005, 0.2, 1e-5
    curvature = scipy.integrate.quad(
        lambda x: q * (np.pi / length) ** 2 * np.sin(np.pi * x / length), left, left + 0.01
    )[0]
    strain = curvature / 0.01 * strain_per_curvature(beam, patches)
    up, down = 350 * (1 + 2.0 * strain), 350 * (1 - 2.0 * strain)
    voltage = 800 * 4.0 * (up / (up + down) - 0.5)
    assert abs(float(loop.sensor[0, 0, 0]) * q) == pytest.approx(abs(voltage), rel=1e-9)


def test_static_response_is_the_closed_form():
    """Bending between the actuator's ends alone, whatever modes are kept."""
    structure, case = arrays(**GAUGES)
    beam, patches = one_link(case)
    plant = jax.tree.map(np.asarray, plant_at(structure, case, POSE))
    still = np.eye(len(plant.state)) - plant.state
    found = plant.leave @ np.linalg.solve(still, plant.enter)
    stiffness = beam.youngs_modulus * beam.width * beam.thickness**3 / 12
    each = sensor_constant(beam, patches) * actuator_constant(beam, patches) * 0.01 / stiffness
    np.testing.assert_allclose(found, float(each) * np.eye(9), atol=1e-8 * float(each))


def test_loop_does_not_depend_on_the_kind_of_sensor():
    """Without rounding and drain: the modal filter knows what its sensors are."""
    radii = []
    for patches in ({}, GAUGES):
        matrices = loop_at(*arrays(**patches), POSE)
        values = np.linalg.eigvals(np.asarray(matrices.open + matrices.feedback))
        radii.append(np.sort(np.abs(values))[-40:])
    np.testing.assert_allclose(radii[1], radii[0], rtol=1e-8)


def test_gauges_neither_stiffen_nor_load_a_link():
    structure, case = arrays(**GAUGES)
    beam, patches = one_link(case)
    assert structure.basis == "pinned_pinned"
    pieces = link_pieces(beam, patches)
    bending = np.asarray(section_stiffness(beam, patches, pieces, has_patches=True))
    both = np.asarray(pieces.has_sensor.sum(axis=0) > 0)
    one = np.asarray(pieces.has_actuator.sum(axis=0) > 0) & ~both
    np.testing.assert_allclose(bending[both], bending[one][0], rtol=1e-12)
    whole = section_stiffness(beam, patches._replace(is_gauge=0.0), pieces, has_patches=True)
    np.testing.assert_array_equal(whole, bending)  # pieces say what covers them
    with_ceramic = link_pieces(beam, patches._replace(is_gauge=0.0))
    stiffer = section_stiffness(beam, patches, with_ceramic, has_patches=True)
    assert np.all(np.asarray(stiffer)[both] > 1.2 * bending[both])


def test_noise_of_the_bridge_adds_to_that_of_the_converter():
    study = parse_study(
        {**BASE, "patches": {**GAUGES, "gauge_noise": 0.03}, "electronics": {"adc_noise": 0.004}}
    )
    structure, case = kept.arrays(study)
    assert structure.has_noise
    noise = float(prepared(structure, case).loop.controller.adc_noise)
    assert noise == pytest.approx(np.hypot(0.1 * 0.03, 0.004), rel=1e-12)
    piezo = as_arrays(build_case(study.change(patches__sensor="piezo")))
    assert float(prepared(structure, piezo).loop.controller.adc_noise) == 0.004


@pytest.mark.long  # in short: all operations of a loop, in test_delay
def test_kernel_equals_scan_over_both_kinds():
    axes = {
        "patches.sensor": ["piezo", "strain_gauge"],
        "patches.gauge_noise": [0.0, 0.01],
        "drive.kp": {"from": 1e4, "to": 2e4},
    }
    sweep = {"method": "random", "count": 16, "axes": axes}
    fast, reference = both(small_spec(sweep, link={"modes": 2}, patches={"gauge_gain": 800.0}))
    assert np.sum(reference.status == status.OK) >= 8
    check_equal(fast, reference)


def test_nothing_drains_a_gauge():
    with pytest.raises(StudyError, match=r"sensor_highpass_hz = 5.*0 where patches.sensor"):
        parse_study({"patches": GAUGES, "electronics": {"sensor_highpass_hz": 5.0}})
    assert paper_study().patches.sensor == "piezo"


@pytest.mark.parametrize("basis", ["pinned_pinned", pytest.param("loaded", marks=pytest.mark.long)])
def test_verification_of_the_links_knows_gauges(basis):
    study = parse_study({**BASE, "patches": GAUGES, "link": {"modes": 3, "basis": basis}})
    for row in check_links(study):
        assert row.left_out or row.difference <= row.allowed, row


@pytest.mark.long
def test_slopes_of_a_run_are_those_of_differences():
    """Of residual vibration, by the gauges' length and noise."""
    study = parse_study(
        {
            **BASE,
            "link": {"modes": 2},
            "run": {"duration": 0.01, "smooth": True},
            "metrics": {"residual_delay": 0.0, "residual_length": 0.005},
            "patches": {**GAUGES, "gauge_noise": 0.02},
        }
    )
    structure, case = kept.arrays(study)
    structure = structure._replace(metrics=("residual_rms",))

    def residual(shares):
        patches = case.machine.patches
        patches = patches._replace(
            sensor_length=patches.sensor_length * (1 + shares[0]),
            gauge_noise=patches.gauge_noise * (1 + shares[1]),
        )
        machine = case.machine._replace(patches=patches)
        result = simulate(structure, case._replace(machine=machine))
        return 1e6 * jnp.sum(result.metrics.residual_rms)

    slope = np.asarray(jax.jit(jax.jacfwd(residual))(np.zeros(2)))
    function, step = jax.jit(residual), 1e-4
    wanted = [(function(by) - function(-by)) / (2 * step) for by in step * np.eye(2)]
    np.testing.assert_allclose(slope, wanted, rtol=1e-4)
