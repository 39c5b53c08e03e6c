"""The twin in Exudyn: its machine, its loop, and the command without the extra."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from studies.engine.preflight import check_run
from studies.study.spec import Study
from studies.twin.machine import describe_machine
from studies.twin.mesh import damping_matrix, held_modes, mesh_link
from studies.twin.multibody import Settings, build_model, close_chain

HOME = np.array([0.0, 0.0, np.pi / 6])
DATA = Path(__file__).parent / "data"


def needs_exudyn() -> None:
    pytest.importorskip("exudyn", reason="Exudyn is not installed: pip install '.[twin]'")


def machine_of(**fields):
    return describe_machine(*check_run(Study().change(**fields)))


def test_mesh_has_nodes_at_patch_ends_and_modes_of_a_pinned_beam():
    link = machine_of(patches__centers=(0.047, 0.101, 0.16)).links[0]
    mesh = mesh_link(link, 40)
    np.testing.assert_allclose(mesh.x[mesh.sensor_nodes], link.sensor_ends, atol=1e-12)
    np.testing.assert_allclose(mesh.x[mesh.actuator_nodes], link.actuator_ends, atol=1e-12)
    assert mesh.x[mesh.middle] == pytest.approx(0.1)
    omega, _ = held_modes(mesh, (0.0, 0.0))
    exact = (np.arange(1, 6) * np.pi / 0.2) ** 2 * np.sqrt(70e9 * 0.01 * 0.002**3 / 12 / 0.055)
    np.testing.assert_allclose(omega[:5], exact, rtol=2e-5)


def test_damping_holds_the_ratios_and_leaves_rigid_motion_alone():
    link = machine_of(link__damping_ratio=(0.01, 0.02, 0.005)).links[0]
    mesh = mesh_link(link, 20)
    matrix = damping_matrix(mesh, link)
    omega, shapes = held_modes(mesh, (0.0, 0.0))
    modal = shapes.T @ matrix @ shapes
    np.testing.assert_allclose(
        np.diag(modal)[:4] / (2 * omega[:4]), [0.01, 0.02, 0.005, 0.005], rtol=1e-9
    )
    line = np.stack([0.3 + 2.0 * mesh.x, np.full_like(mesh.x, 2.0)], axis=1).ravel()
    assert np.abs(matrix @ line).max() < 1e-12 * np.abs(matrix).max()


def test_free_machine_has_the_frequencies_of_another_finite_element_model():
    needs_exudyn()
    machine = machine_of()
    rho = close_chain(machine, HOME)[0]
    model = build_model(
        machine,
        HOME,
        lambda i, t, position, rate: 2e4 * (rho[i] - position),
        Settings(n_elements=40, axial_factor=100.0),
    )
    cases = json.loads((DATA / "frequencies.json").read_text())["cases"]
    expected = cases["sliders_on_springs_2e4_N_per_m"]
    square, _ = model.system.ComputeODE2Eigenvalues(computeComplexEigenvalues=False)
    frequency = np.sqrt(np.sort(np.abs(square))[: len(expected)]) / (2 * np.pi)
    np.testing.assert_allclose(frequency, expected, rtol=1e-5)
