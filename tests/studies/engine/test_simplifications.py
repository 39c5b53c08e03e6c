"""Warnings of simplifications that show: patches left out, a controller for another plant."""

import warnings

import jax
import numpy as np
import pytest

from jaxmodel.bases import find_bases
from studies.engine.modes import machine_modes
from studies.engine.preflight import check_run
from studies.errors import ModelWarning
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.held_link import first_frequency
from studies.study.spec import parse_study
from tests.canonical import MACHINE, with_sections

#: A link of carbon fibre: light, so that the patches weigh on it.
CARBON = {"length": 0.24, "thickness": 1.6e-3, "youngs_modulus": 110e9, "density": 1600.0}


def study(control=None, **link):
    return parse_study(with_sections(MACHINE, link=link, control=control or {}))


_bases = jax.jit(find_bases, static_argnums=0)


@pytest.mark.parametrize("link", [{}, CARBON, {"length": [0.2, 0.22, 0.24]}], ids=str)
def test_stodola_equals_ritz(link):
    """Mode 1 of links with patches: iteration on the exact curvature against Ritz functions."""
    loaded = study(basis="loaded", **link)
    bases = _bases(build_structure(loaded), as_arrays(build_case(loaded)))
    ritz = np.asarray(bases.plant_omega)[:, 0] / (2 * np.pi)
    np.testing.assert_allclose(first_frequency(loaded, with_patches=True), ritz, rtol=5e-5)


def test_stodola_equals_bare_link():
    area, inertia = 0.01 * 0.002, 0.01 * 0.002**3 / 12
    hertz = np.pi / 2 * np.sqrt(70e9 * inertia / (2750 * area)) / 0.2**2
    np.testing.assert_allclose(first_frequency(study(), with_patches=False), hertz, rtol=1e-5)


def test_patches_left_out_are_named_with_their_effect():
    with pytest.warns(ModelWarning, match=r"mode 1 of link 1 by 9\.9 %, from 104\.4 to 94\.11 Hz"):
        machine_modes(study(**CARBON))
    with warnings.catch_warnings():
        warnings.simplefilter("error", ModelWarning)
        machine_modes(study())  # the paper's links: 0.5 %
        machine_modes(study(basis="loaded", **CARBON))


def test_controller_of_another_plant_is_a_mismatch():
    with pytest.warns(
        ModelWarning, match="104.4 Hz, the plant at 94.11 Hz; see control.basis .a nearer"
    ):
        check_run(study(basis="loaded", **CARBON))
    with pytest.warns(ModelWarning, match="at 80 Hz, .*; see control.frequencies_hz"):
        check_run(study({"frequencies_hz": [80.0], "modes": 1}))
    both = {"basis": "loaded", **CARBON}
    with warnings.catch_warnings():
        warnings.simplefilter("error", ModelWarning)
        check_run(study({"basis": "loaded"}, **both))
        check_run(study({"basis": "loaded"}, stiffness_factor=1.2, **both))  # on purpose
        check_run(study({"feedback": "none"}, **both))
