"""Warnings of simplifications that show in a study's numbers, and of unlikely sizes."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from jaxmodel.beam import BASES
from studies.errors import warn_of_model
from studies.study.held_link import first_frequency
from studies.study.paths import field_unit, field_value

if TYPE_CHECKING:
    from studies.study.spec import Study

#: Most that lumping the axial inertia may cost without a word [1].
LUMPING_LIMIT = 2e-3
#: Most that leaving out the patches may move mode 1 of a link without a word [1].
PATCH_LIMIT = 0.02
#: Most that the controller's modes may be away from the plant's without a word [1].
MISMATCH_LIMIT = 0.02


class Usual(NamedTuple):
    """Sizes of a field on machines that can be built, and the units that are typed by mistake."""

    low: float  # in the field's unit
    high: float
    units: dict[str, float]  # by name, in the field's unit


_LENGTHS, _MODULI = {"mm": 1e-3, "cm": 1e-2, "µm": 1e-6}, {"GPa": 1e9, "MPa": 1e6, "kPa": 1e3}
_DENSITIES, _MASSES = {"g/cm3": 1e3, "t/m3": 1e3, "mg/mm3": 1e3}, {"g": 1e-3}
#: Of elastomers to diamond, of foam to osmium, of foils to beams.
USUAL = {
    "machine.platform_mass": Usual(5e-3, 100, _MASSES),
    "machine.slider_mass": Usual(5e-3, 100, _MASSES),
    "link.length": Usual(0.01, 5, _LENGTHS),
    "link.thickness": Usual(5e-5, 0.05, _LENGTHS),
    "link.width": Usual(5e-4, 0.5, _LENGTHS),
    "link.density": Usual(50, 23e3, _DENSITIES),
    "link.youngs_modulus": Usual(1e7, 1.3e12, _MODULI),
    "patches.sensor_length": Usual(2e-4, 0.5, _LENGTHS),
    "patches.actuator_length": Usual(2e-4, 0.5, _LENGTHS),
    "patches.width": Usual(2e-4, 0.5, _LENGTHS),
    "patches.thickness": Usual(5e-6, 5e-3, _LENGTHS),
    "patches.density": Usual(500, 12e3, _DENSITIES),
    "patches.youngs_modulus": Usual(1e8, 5e11, _MODULI),
    "patches.d31": Usual(1e-12, 1e-9, {"pC/N": 1e-12, "nC/N": 1e-9}),
}


def warn_of_sizes(study: Study) -> None:
    """Warn of numbers that no machine has, and name the unit in which one would."""
    for name, usual in USUAL.items():
        given = np.abs(np.ravel(field_value(study, name)))
        wrong = given[(given > 0) & ((given < usual.low) | (given > usual.high))]
        if not len(wrong):
            continue
        value, unit = float(wrong[0]), field_unit(name)
        typed = [x for x, y in usual.units.items() if usual.low <= value * y <= usual.high]
        meant = (
            f"; if it is in {typed[0]}, write {value * usual.units[typed[0]]:g}" if typed else ""
        )
        warn_of_model(
            f"{name} = {value:g} {unit} is far from what machines have, {usual.low:g} to "
            f"{usual.high:g} {unit}{meant}"
        )


def warn_of_patches(study: Study) -> None:
    """Warn of a plant without the patches' mass and stiffness where they move mode 1."""
    if BASES[study.link.basis].has_patches:
        return
    bare, real = (first_frequency(study, with_patches=value) for value in (False, True))
    shift = real / bare - 1
    i = int(np.abs(shift).argmax())
    if abs(shift[i]) <= PATCH_LIMIT:
        return
    side = "lower" if shift[i] < 0 else "raise"
    with_patches = next(name for name, basis in BASES.items() if basis.has_patches)
    warn_of_model(
        f"link.basis = {study.link.basis!r} leaves out the patches, which {side} mode 1 of link "
        f"{i + 1} by {100 * abs(shift[i]):.2g} %, from {bare[i]:.4g} to {real[i]:.4g} Hz between "
        f"held ends; link.basis = {with_patches!r} has them, and control.basis = "
        f"{with_patches!r} the controller"
    )


def warn_of_lumping(study: Study, cost: float) -> None:
    """Warn where lumping the axial inertia costs deflections a share of their size [1]."""
    if cost > LUMPING_LIMIT:
        warn_of_model(
            f"link.axial_inertia = {study.link.axial_inertia!r} moves deflections by about "
            f"{100 * cost:.2g} % on this path (limit {100 * LUMPING_LIMIT:g} %); "
            "'distributed' is exact"
        )


def warn_of_mismatch(study: Study, plant_omega: np.ndarray, model_omega: np.ndarray) -> None:
    """Warn of a controller designed for other frequencies than the plant of the study has.

    Args:
        study: its `link.stiffness_factor`, a mismatch on purpose, is no reason.
        plant_omega: of the links between held ends [rad/s], (3, C).
        model_omega: of the controller's model [rad/s], (3, C).
    """
    if study.control.feedback == "none":
        return
    nominal = plant_omega / np.sqrt(study.each_link(study.link.stiffness_factor))[:, None]
    error = np.abs(model_omega / nominal - 1) * np.array(study.control.links)[:, None]
    if error.size == 0 or error.max() <= MISMATCH_LIMIT:
        return
    cause = "control.frequencies_hz" if study.control.frequencies_hz else "control.basis"
    warn_of_model(
        f"{mismatch_text(nominal, model_omega, error)}; see {cause} (a nearer model may need other "
        "gains: compare gain margins)"
    )


def mismatch_text(plant_omega: np.ndarray, model_omega: np.ndarray, error: np.ndarray) -> str:
    """The mode with the largest error, and both its frequencies."""
    i, j = np.unravel_index(error.argmax(), error.shape)
    believed, real = (omega[i, j] / (2 * np.pi) for omega in (model_omega, plant_omega))
    return (
        f"model mismatch: the controller's model has mode {j + 1} of link {i + 1} at "
        f"{believed:.4g} Hz, the plant at {real:.4g} Hz"
    )
