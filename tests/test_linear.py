"""The assembled machine against an independent finite-element multibody code."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxmodel.linear import frequency_response, linearise
from jaxmodel.parameters import HOME
from jaxmodel.prepare import prepare
from studies.cases import as_arrays, build_case, build_structure
from studies.errors import StudyError
from studies.modes import machine_modes
from studies.runs import chord_deflection, run_study
from studies.spec import paper_study

DATA = Path(__file__).parent / "data"
CASES = {
    "sliders_locked": {"locked": True},
    "sliders_free": {"kp": 0.0},
    "sliders_on_springs_2e4_N_per_m": {"kp": 2e4},
}


@pytest.mark.parametrize("name", CASES)
def test_frequencies_of_the_assembled_machine(name):
    wanted = np.array(json.loads((DATA / "frequencies.json").read_text())["cases"][name])
    found = machine_modes(**CASES[name]).frequency
    assert np.all(np.diff(found) >= 0)
    wanted = wanted[(wanted > 1) & (wanted < 1100)]
    elastic = found[(found > 1) & (found < 1100)]
    np.testing.assert_allclose(elastic, wanted, rtol=5e-4)
    if name == "sliders_free":
        assert found.size == 12 and np.all(found[:3] < 0.1)


def test_one_mode_is_enough():
    """The chord frame converges at once: one mode per link gives 114.65 and 115.04 Hz."""
    found = machine_modes(kp=0.0, n_modes=1).frequency
    np.testing.assert_allclose(found[3:], (114.6518, 115.0373, 115.0373), rtol=1e-5)


def test_paper_basis_converges_slowly():
    """Three pinned-free modes per link: 114.9 and 462.8 Hz."""
    found = machine_modes(kp=0.0, basis="pinned_free").frequency
    assert found[3] == pytest.approx(114.9, abs=0.06)
    assert found[6] == pytest.approx(462.8, abs=0.06)


def test_both_assemblies_have_the_same_frequencies():
    def at_home(assembly):
        study = paper_study().change(
            machine__assembly=assembly, link__modes=3, link__damping_ratio=0.0, drive__kd=0.0
        )
        structure, case = build_structure(study), as_arrays(build_case(study))
        loop = jax.jit(prepare, static_argnums=0)(structure, case).loop
        plant = linearise(structure, loop, np.array(HOME), case.electronics.antialias)
        return np.sort(np.abs(np.linalg.eigvals(np.asarray(plant.state))))

    np.testing.assert_allclose(at_home("inward"), at_home("outward"), rtol=1e-6)


def test_drive_damping_and_structural_damping_show():
    quiet, driven = machine_modes(), machine_modes(kd=60.0)
    assert np.all(quiet.damping_ratio == 0)
    assert driven.frequency.size == quiet.frequency.size
    assert np.all(driven.damping_ratio[:3] > 0.1)
    structural = machine_modes(damping=0.01, locked=True)
    np.testing.assert_allclose(structural.damping_ratio[3:], 0.01, rtol=1e-6)


def test_locked_needs_a_basis_that_is_still_at_the_tip():
    with pytest.raises(StudyError, match="pinned_free"):
        machine_modes(locked=True, basis="pinned_free")


def test_frequency_response_has_its_static_value_and_its_resonance():
    study = paper_study().change(link__modes=3)
    structure, case = build_structure(study), as_arrays(build_case(study))
    loop = jax.jit(prepare, static_argnums=0)(structure, case).loop
    plant = linearise(structure, loop, np.array(HOME), case.electronics.antialias)
    frequency = np.array([0.0, 20.0, 114.7, 200.0])
    response = np.abs(frequency_response(plant, plant.deflection, plant.voltage, frequency))
    # a static voltage bends its own link by Y_j lambda_a Phi_a/k_j
    static = np.einsum(
        "sr,rk->sk",
        np.asarray(loop.deflection_at[0]),
        np.asarray(loop.actuator[0]) / np.asarray(loop.plant.stiffness[0])[:, None],
    )
    np.testing.assert_allclose(response[0, :3, :3], np.abs(static), rtol=1e-8)
    assert response[2, 1, 1] > 20 * response[0, 1, 1]


def test_released_beam_moves_as_in_the_finite_element_code():
    """Link 1 bent by a load at mid-span, sliders locked, no damping: first 0.05 s within 1 %."""
    table = np.loadtxt(DATA / "free_response.csv", delimiter=",")
    study = paper_study().change(
        run__duration=0.0601, link__modes=3, link__damping_ratio=0.0, drive__locked=True,
        control__feedback="none", shaper__kind="none", motion__waypoints=(HOME,),
        metrics__residual_length=0.01, electronics__sample_rate_hz=10e3,
        initial__load_station=0.1, initial__load_deflection=(5e-5, 0.0, 0.0),
    )  # fmt: skip
    run = run_study(study)
    time = np.asarray(run.result.record.time)
    table = table[table[:, 0] <= 0.05 + 1e-9]
    index = np.round(table[:, 0] * 10e3).astype(int)
    np.testing.assert_allclose(time[index], table[:, 0], atol=1e-9)
    found = chord_deflection(run)[index, 0]
    assert np.abs(found - table[:, 1]).max() < 0.01 * 5e-5
    assert np.abs(chord_deflection(run)[:, 1:]).max() < 1e-9
