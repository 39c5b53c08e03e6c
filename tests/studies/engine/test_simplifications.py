"""Warnings of simplifications that show: patches left out, a controller for another plant."""

import warnings

import jax
import numpy as np
import pytest

from jaxmodel.bases import find_bases
from studies.engine.controller import fixed_controller
from studies.engine.modes import machine_modes
from studies.engine.preflight import check_run
from studies.engine.simplifications import warn_of_sizes
from studies.errors import ModelWarning, StudyError
from studies.fitting.measurements import make_bench, make_measurements
from studies.single.plant import plant_of
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.held_link import first_frequency
from tests.bare import parse_fit, parse_study
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


@pytest.mark.parametrize(
    ("section", "field", "value", "meant"),
    [
        ("link", "youngs_modulus", 70e3, "if it is in MPa, write 7e.10"),
        ("link", "density", 2.75, "if it is in g/cm3, write 2750"),
        ("link", "length", 9.9, "if it is in cm, write 0.099"),
        ("link", "thickness", 1.2e-5, r"5e-05 to 0.05 m$"),
        ("machine", "platform_mass", 250.0, "if it is in g, write 0.25"),
        ("patches", "d31", -1e-13, "1e-12 to 1e-09 "),
    ],
)
def test_sizes_that_no_machine_has_are_named_with_the_likely_unit(section, field, value, meant):
    wrong = parse_study(with_sections(MACHINE, **{section: {field: value}}))
    with pytest.warns(ModelWarning, match=rf"{section}.{field} = \S+ .*far from .*{meant}"):
        warn_of_sizes(wrong)
    with warnings.catch_warnings():
        warnings.simplefilter("error", ModelWarning)
        warn_of_sizes(study())


def test_commands_that_run_nothing_check_no_residual_window():
    """A drive that does not settle: machine and controller can be read, not the motion run."""
    slow = parse_study(
        with_sections(MACHINE, drive={"kd": 1e-3}, metrics={"residual_delay": "auto"})
    )
    with pytest.raises(StudyError, match="drive.kd.*settles"):
        check_run(slow)
    assert plant_of(slow).a.shape == plant_of(study()).a.shape
    assert len(fixed_controller(slow).controller.feedthrough) == 3
    free = {"link.youngs_modulus": {"from": 6e10, "to": 8e10}}
    modes = {"kind": "modes", "frequency_hz": [114.0] * 3, "sigma_hz": 0.5}
    spec = parse_fit(
        with_sections(MACHINE, drive={"kd": 1e-3}, metrics={"residual_delay": "auto"})
        | {"fit": {"free": free, "data": [modes]}}
    )
    assert make_measurements(spec, make_bench(spec))
