"""Specified and obtained poles: on the nominal link, for which they are placed, and the machine."""

from __future__ import annotations

from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.nominal_loop import nominal_loop
from studies.engine.programs import kept_jit
from studies.engine.simplifications import MISMATCH_LIMIT, mismatch_text
from studies.engine.stability import LoopFigures

#: Relative difference of a decay or frequency that is worth a sentence [1].
NOTABLE = 0.02
HEADER = ["mode", "link", "specified", "nominal link", "assembled machine"]


class PoleReport(NamedTuple):
    """Poles s = -alpha + j beta of controlled modes [1/s], complex, (n, C); NaN: not controlled."""

    specified: np.ndarray
    nominal: np.ndarray  # of the nominal link's loop
    assembled: np.ndarray  # of the assembled modes of each order, nearest to the nominal ones
    gain_factor: float  # control.gain_factor [1]
    is_by_damping: bool  # specified as added damping ratios, and shown as such
    plant_omega: np.ndarray  # of the links between held ends [rad/s], (n, C)
    model_omega: np.ndarray  # of the controller's model [rad/s], (n, C)


def tracked_modes(structure: Structure) -> int:
    """How many link modes are followed: three, or all controlled ones if poles are specified."""
    most = max(3, structure.n_controlled) if structure.has_poles else 3
    return min(most, structure.n_modes)


@kept_jit(static_argnums=0)
def _nominal_loop(structure: Structure, case: Case) -> Any:
    """`nominal_loop`; frequencies of plant and controller's model [rad/s], (n, C) each."""
    bases = find_bases(structure, case)
    return *nominal_loop(structure, case), bases.plant_omega, bases.believed_omega


def pole_report(structure: Structure, case: Case, loop: LoopFigures) -> PoleReport | None:
    """Where specified poles lie; None if no mode that acts has any.

    Args:
        structure: with feedback "sampled".
        case: the numbers.
        loop: its figures, with `tracked_modes`.
    """
    if not structure.has_poles:
        return None
    specified, matrix, *omega = map(np.asarray, _nominal_loop(structure, case))
    is_on, period = ~np.isnan(specified), float(case.electronics.period)
    if not is_on.any():
        return None
    nominal, assembled = (np.full(specified.shape, np.nan, complex) for _ in range(2))
    for link, mode in np.argwhere(is_on):
        block = matrix[link, min(mode, matrix.shape[1] - 1)]
        z = np.linalg.eigvals(block)
        near = z[np.argmin(np.abs(z - np.exp(specified[link, mode] * period)))]
        nominal[link, mode] = np.log(near) / period
    frequency, zeta = loop.frequency_hz, loop.damping_ratio
    poles = 2 * np.pi * frequency * (-zeta + 1j * np.sqrt(np.maximum(1 - zeta**2, 0)))
    for mode in np.flatnonzero(is_on.any(axis=0))[: len(poles)]:
        matched = _matched(nominal[:, mode], poles[mode])
        assembled[:, mode] = np.where(is_on[:, mode], matched, np.nan)
    is_by_damping = bool(np.any(np.asarray(case.control.damping) >= 0))
    factor = float(case.control.gain_factor)
    return PoleReport(specified, nominal, assembled, factor, is_by_damping, *omega)


def _matched(nominal: np.ndarray, poles: np.ndarray) -> np.ndarray:
    """The assembled poles in the order that brings them nearest to the nominal link's."""
    return min(
        (poles[list(order)] for order in permutations(range(len(poles)))),
        key=lambda ordered: float(np.nansum(np.abs(ordered - nominal))),
    )


def pole_rows(report: PoleReport) -> list[list[str]]:
    """Row of each controlled mode and link, by `HEADER`.

    Decay [1/s] and frequency [Hz]; of added damping ratios: damping ratio and natural frequency.
    """
    shown = _in_ratio if report.is_by_damping else _in_decay
    return [
        [str(mode + 1), str(link + 1), *(shown(poles[link, mode]) for poles in report[:3])]
        for mode, link in np.argwhere(~np.isnan(report.specified).T)
    ]


def _in_decay(pole: complex) -> str:
    if np.isnan(pole):
        return "-"
    return f"{-pole.real:.4g} 1/s, {abs(pole.imag) / (2 * np.pi):.4g} Hz"


def _in_ratio(pole: complex) -> str:
    if np.isnan(pole):
        return "-"
    return f"zeta {-pole.real / abs(pole):.4g}, {abs(pole) / (2 * np.pi):.4g} Hz"


def difference(report: PoleReport) -> str:
    """Where poles differ most from what is specified, and why."""
    sentences, reference = [], report.specified
    shown = _in_ratio if report.is_by_damping else _in_decay
    if report.gain_factor != 1:
        sentences.append(
            f"Poles are placed for control.gain_factor = 1; with {report.gain_factor:g}, the "
            "nominal link has others."
        )
        reference = report.nominal
    elif np.nanmax(_relative_distance(report.nominal, reference)) > NOTABLE:
        sentences.append("The nominal link does not have them: they cannot be placed.")
    apart = _relative_distance(report.assembled, reference)
    than = "specified" if reference is report.specified else "on the nominal link"
    if np.isnan(apart).all():
        return " ".join(sentences)
    if np.nanmax(apart) <= NOTABLE:
        return " ".join([*sentences, f"The assembled machine has all of them as {than}, to 2 %."])
    at = np.unravel_index(np.nanargmax(apart), apart.shape)
    sentences.append(
        f"The assembled machine differs most in mode {at[1] + 1} of link {at[0] + 1}: "
        f"{shown(report.assembled[at])} instead of {shown(reference[at])} {than}. {_cause(report)}"
    )
    return " ".join(sentences)


def _cause(report: PoleReport) -> str:
    """Why the assembled machine has other poles than the nominal link."""
    error = np.abs(report.model_omega / report.plant_omega - 1)
    error = np.where(np.isnan(report.specified), 0.0, error)
    if error.max() > MISMATCH_LIMIT:
        text = mismatch_text(report.plant_omega, report.model_omega, error)
        return f"First of all a {text} (control.basis, link.stiffness_factor)."
    return (
        "Its links are coupled by the platform and patches act on all modes (spillover); gains are "
        "designed mode by mode."
    )


def _relative_distance(poles: np.ndarray, specified: np.ndarray) -> np.ndarray:
    """Relative difference of decay or frequency, whichever is larger [1]."""
    decay = np.abs((poles.real - specified.real) / specified.real)
    return np.maximum(decay, np.abs((poles.imag - specified.imag) / np.abs(specified)))
