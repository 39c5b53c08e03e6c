"""The report of a spillover certificate: verdict first, then its basis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxmodel import status
from jaxmodel.laws import LAWS
from studies.engine.breaking import UNITS
from studies.engine.fast_motion import FAST, WINDOW
from studies.show.pages import page
from studies.show.sketch import CAPTION
from studies.show.words import motion_text
from studies.spillover.certificate import Certificate
from studies.spillover.fast_move import ControlEffect
from studies.spillover.proofs import machine_text
from studies.study.labels import describe
from studies.study.margin import margin_text
from studies.study.window import residual_delay

#: Spillover below this is rounding [1].
TINY = 1e-9


def statements(certificate: Certificate) -> list[str]:
    """The verdict, what becomes of modes, and what is proven, in sentences."""
    texts = certificate.verdict, damping_text(certificate), spillover_text(certificate)
    proven = () if certificate.proofs is None else certificate.proofs.statements
    return [text for text in (*texts, *proven) if text]


def spillover_text(certificate: Certificate) -> str:
    """The uncontrolled mode that control makes worst, in a sentence; "" if there is none."""
    worst = certificate.spillover
    if worst is None:
        return ""
    return (
        f"control spillover: mode {worst.mode}, which is not controlled, has a damping ratio of "
        f"{worst.damping_ratio:.2g} instead of {worst.free_damping:.2g} without control "
        f"({worst.basis}, {worst.mismatch})"
    )


def damping_text(certificate: Certificate) -> str:
    """What becomes of mode 1's damping on all plants, in a sentence; "" if it is overdamped."""
    first = np.where(certificate.exists[..., None], certificate.damping_ratio[..., 0, :], np.nan)
    if np.isnan(first).all():
        return ""
    most = np.max(np.where(np.isnan(first), -np.inf, first), axis=-1)
    most = np.where(np.isfinite(most), most, np.nan)
    plant = certificate.variants[np.unravel_index(np.nanargmin(most), most.shape)]
    return (
        f"damping ratio of mode 1, on the most damped link: {np.nanmin(most):.2g} to "
        f"{np.nanmax(most):.2g} on these plants (least: {plant.basis}, {plant.mismatch})"
    )


def residual_text(certificate: Certificate) -> str:
    """What control leaves of the fast move's vibration, in a sentence; "" if there is no move."""
    move = certificate.fast_move
    if move is None:
        return ""
    lost = [
        f"{how} control: {describe(int(code))}"
        for how, code in zip(("with", "without"), move.status, strict=True)
        if code != status.OK
    ]
    last = f" (run {', '.join(lost)})" if lost else ""
    controlled, free = move.worst
    if not np.isfinite(move.worst).all():
        return f"residual vibration on the nominal machine: no figure{last}"
    change = f", {100 * (controlled / free - 1):+.3g} %" if free > 0 else ""
    effect = "CONTROL MAKES IT WORSE: " if controlled > free else ""
    return (
        f"{effect}residual vibration on the nominal machine{_after(move.move_time)}: "
        f"{1e6 * controlled:.4g} µm rms on its worst link, {1e6 * free:.4g} without control"
        f"{change}{last}"
    )


def _after(move_time: float | None) -> str:
    if move_time is None:
        return ""
    return f" after a first move in {1e3 * move_time:.4g} ms without shaper"


def report(certificate: Certificate, images: Path | None = None) -> str:
    """The page of a certificate.

    Args:
        certificate: from `certify`.
        images: folder with the figures; None: a page without.
    """
    study, margin = certificate.study, float(certificate.gain_margin[certificate.worst])
    return page(
        "spillover/report.html",
        images,
        study,
        certificate=certificate,
        study=study,
        law=LAWS[study.control.law],
        breaking=certificate.broken_by[certificate.worst],
        residual=residual_text(certificate),
        spillover=spillover_text(certificate),
        change=certificate.smallest_change,
        units=UNITS._asdict(),
        change_rows=_changes(certificate),
        damping=damping_text(certificate),
        proofs=() if certificate.proofs is None else certificate.proofs.statements,
        machine=machine_text(certificate.unstable_machine) if certificate.unstable_machine else "",
        margin=margin,
        worst=certificate.variants[certificate.worst],
        share=margin / certificate.required_margin,
        total=int(certificate.exists.sum()),
        n_left_out=int((~certificate.exists).sum()),
        motion=motion_text(study),
        good=int(certificate.passes[certificate.exists].sum()),
        links="+".join(str(i + 1) for i, is_on in enumerate(study.control.links) if is_on),
        fewest=certificate.plant_modes[0],
        sizes=certificate.plant_modes,
        free_damping=_free_damping(certificate),
        margins=_margins(certificate),
        leakage=_leakage(certificate),
        move=certificate.fast_move,
        move_rows=_fast_rows(certificate.fast_move) if certificate.fast_move else [],
        fast=FAST,
        delay=residual_delay(certificate.fast_move.study) if certificate.fast_move else None,
        window=WINDOW,
        sketch_caption=CAPTION,
    )


def _free_damping(certificate: Certificate) -> list[float]:
    """Least and largest damping ratio without control [1], or one if they hardly differ."""
    low, high = (
        float(np.nanmin(certificate.free_damping_ratio)),
        float(np.nanmax(certificate.free_damping_ratio)),
    )
    return [low] if high - low < 0.1 * high else [low, high]


def _margins(certificate: Certificate) -> list[list[str]]:
    """Row of each basis and mismatch: the largest plant, and the margin of the smallest."""
    rows = []
    for b, d in np.ndindex(certificate.variants.shape[:2]):
        if not certificate.exists[b, d].any():
            continue
        last = int(np.flatnonzero(certificate.exists[b, d])[-1])
        plant = certificate.variants[b, d, last]
        rows.append(
            [
                plant.basis,
                str(plant.mismatch),
                margin_text(certificate.gain_margin[b, d, last], 3),
                margin_text(certificate.gain_margin[b, d, 0], 3)
                if certificate.exists[b, d, 0]
                else "-",
                certificate.broken_by[b, d, last] or "-",
                f"{certificate.least_damping[b, d, last]:.3g}",
                certificate.least_damped[b, d, last],
                "yes"
                if certificate.passes[b, d][certificate.exists[b, d]].all()
                else Markup("<b>no</b>"),
            ]
        )
    return rows


def _changes(certificate: Certificate) -> list[list[str]]:
    """Row of each number of the smallest change that breaks the design."""
    change = certificate.smallest_change
    parts = () if change is None else change.parts
    return [[part.name, part.text.removeprefix(part.name), f"{part.size:+.2f}"] for part in parts]


def _leakage(certificate: Certificate) -> dict[str, Any] | None:
    """Uncontrolled modes in the estimates, and forces on them; None: no such modes."""
    first, last = certificate.n_controlled, certificate.observation.shape[4]
    if first == last or certificate.observation.shape[3] == 0:
        return None
    seen = certificate.observation[..., first:]
    size = np.nan_to_num(np.abs(seen)).max(axis=(1, 2))
    return {
        "seen": _largest(certificate, seen),
        "pushed": _largest(certificate, np.swapaxes(certificate.actuation, 3, 4)[..., first:]),
        "modes": [f"mode {r + 1}" for r in range(first, last)],
        "rows": [
            [
                certificate.basis[b],
                f"q^{j + 1}",
                *(f"{x:.2g}" if x > TINY else "0" for x in size[b, j]),
            ]
            for b, j in np.ndindex(size.shape[:2])
            if certificate.exists[b].any()
        ],
    }


def _largest(certificate: Certificate, leakage: np.ndarray) -> dict[str, Any]:
    """The largest entry of a leakage of all plants, (B, D, 3, C, uncontrolled modes).

    Its size [1], the uncontrolled and the controlled mode, from 1, and the plant.
    """
    size = np.nan_to_num(np.abs(leakage))
    b, d, _, j, r = np.unravel_index(np.argmax(size), size.shape)
    mode, plant = int(r) + certificate.n_controlled + 1, certificate.variants[b, d, 0]
    return {"size": size.max(), "mode": mode, "controlled": int(j) + 1, "plant": plant}


def _fast_rows(move: ControlEffect) -> list[list[str]]:
    """Row of each run."""
    return [
        [how, " / ".join(f"{1e6 * x:.3g}" for x in rms), describe(int(code))]
        for how, rms, code in zip(("on", "off"), move.residual_rms, move.status, strict=True)
    ]
