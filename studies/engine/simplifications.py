"""Warnings where a simplification that the study chose shows in its numbers."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from jaxmodel.beam import BASES
from studies.errors import warn_of_model
from studies.study.held_link import first_frequency

if TYPE_CHECKING:
    from studies.study.spec import Study

#: Most that lumping the axial inertia may cost without a word [1].
LUMPING_LIMIT = 2e-3
#: Most that leaving out the patches may move mode 1 of a link without a word [1].
PATCH_LIMIT = 0.02
#: Most that the controller's modes may be away from the plant's without a word [1].
MISMATCH_LIMIT = 0.02


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
