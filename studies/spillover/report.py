"""The report of a spillover certificate: verdict first, then its basis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxmodel import status
from jaxmodel.laws import LAWS
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.engine.breaking import UNITS
from studies.engine.fast_motion import FAST, WINDOW
from studies.show.document import json_text
from studies.show.pages import page
from studies.show.sketch import CAPTION
from studies.show.words import motion_text
from studies.spillover.certificate import Certificate, Spillover
from studies.spillover.fast_move import ControlEffect
from studies.spillover.plants import PlantVariant
from studies.spillover.proofs import Proofs, machine_text, proof_texts
from studies.study.labels import describe
from studies.study.margin import margin_text
from studies.study.window import residual_delay

#: Spillover below this is rounding [1].
TINY = 1e-9


def verdict(certificate: Certificate) -> str:
    """One line: passed or failed, and the deciding plant or machine."""
    at, machine = certificate.worst, certificate.unstable_machine
    breaking = certificate.breaking[at]
    margin = (
        f"gain margin {margin_text(certificate.margin[at], 3)}, {certificate.required:g} required"
    )
    if certificate.is_passed:
        first = f"; first to go unstable beyond it: {breaking}" if breaking else ""
        return f"passed: {margin}{first}"
    unstable = "" if machine is None else f"unstable machine in the box: {machine_text(machine)}"
    if certificate.fails_from == 0:
        return f"failed by an {unstable}; on the plants: {margin}"
    state = "" if certificate.radius[at] <= 1 + RADIUS_TOLERANCE else "unstable, "
    return f"failed by {breaking}: {state}{margin}{unstable and f'; {unstable}'}"


def spillover_text(certificate: Certificate) -> str:
    """The uncontrolled mode that control makes worst, in a sentence; "" if there is none."""
    worst = certificate.spillover
    if worst is None:
        return ""
    return (
        f"control spillover: mode {worst.mode}, which is not controlled, has a damping ratio of "
        f"{worst.damping_ratio:.2g} instead of {worst.free_damping:.2g} without control "
        f"({worst.plant.basis}, {worst.plant.mismatch})"
    )


def damping_text(certificate: Certificate) -> str:
    """What becomes of mode 1's damping on all plants, in a sentence; "" if it is overdamped."""
    first = np.where(certificate.exists[..., None], certificate.damping_ratio[..., 0, :], np.nan)
    if np.isnan(first).all():
        return ""
    most = np.max(np.where(np.isnan(first), -np.inf, first), axis=-1)
    most = np.where(np.isfinite(most), most, np.nan)
    plant = certificate.plants[np.unravel_index(np.nanargmin(most), most.shape)]
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
    study, margin = certificate.study, float(certificate.margin[certificate.worst])
    return page(
        "spillover/report.html",
        images,
        study,
        certificate=certificate,
        study=study,
        law=LAWS[study.control.law],
        breaking=certificate.breaking[certificate.worst],
        residual=residual_text(certificate),
        spillover=spillover_text(certificate),
        change=certificate.smallest_change,
        units=UNITS._asdict(),
        change_rows=_changes(certificate),
        damping=damping_text(certificate),
        proofs=proof_texts(certificate.proofs) if certificate.proofs is not None else (),
        machine=machine_text(certificate.unstable_machine) if certificate.unstable_machine else "",
        margin=margin,
        worst=certificate.plants[certificate.worst],
        share=margin / certificate.required,
        total=int(certificate.exists.sum()),
        n_left_out=int((~certificate.exists).sum()),
        motion=motion_text(study),
        good=int(certificate.passes[certificate.exists].sum()),
        links="+".join(str(i + 1) for i, is_on in enumerate(study.control.links) if is_on),
        fewest=certificate.plants[0, 0, 0].n_modes,
        sizes=[plant.n_modes for plant in certificate.plants[0, 0]],
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
        float(np.nanmin(certificate.free_damping)),
        float(np.nanmax(certificate.free_damping)),
    )
    return [low] if high - low < 0.1 * high else [low, high]


def _margins(certificate: Certificate) -> list[list[str]]:
    """Row of each basis and mismatch: the largest plant, and the margin of the smallest."""
    rows = []
    for b, d in np.ndindex(certificate.plants.shape[:2]):
        if not certificate.exists[b, d].any():
            continue
        last = int(np.flatnonzero(certificate.exists[b, d])[-1])
        plant = certificate.plants[b, d, last]
        rows.append(
            [
                plant.basis,
                str(plant.mismatch),
                margin_text(certificate.margin[b, d, last], 3),
                margin_text(certificate.margin[b, d, 0], 3) if certificate.exists[b, d, 0] else "-",
                certificate.breaking[b, d, last] or "-",
                f"{certificate.least_damping[b, d, last]:.3g}",
                certificate.weakest[b, d, last],
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
                certificate.plants[b, 0, 0].basis,
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
    mode, plant = int(r) + certificate.n_controlled + 1, certificate.plants[b, d, 0]
    return {"size": size.max(), "mode": mode, "controlled": int(j) + 1, "plant": plant}


def _fast_rows(move: ControlEffect) -> list[list[str]]:
    """Row of each run."""
    return [
        [how, " / ".join(f"{1e6 * x:.3g}" for x in rms), describe(int(code))]
        for how, rms, code in zip(("on", "off"), move.residual_rms, move.status, strict=True)
    ]


def document(certificate: Certificate) -> str:
    """JSON text: the verdict and every number, null if there is none."""
    whole: dict[str, Any] = {
        "title": certificate.study.title,
        "is_passed": certificate.is_passed,
        "spillover": certificate.spillover and _spillover_entry(certificate.spillover),
        "verdict": verdict(certificate),
        "required_margin": certificate.required,
        "smallest_margin": float(np.nanmin(certificate.margin)),
        "fails_from_modes": certificate.fails_from or None,
        "notes": list(certificate.notes),
        "plants": [_plant(certificate, tuple(at)) for at in np.argwhere(certificate.exists)],
        "proofs": certificate.proofs and _proofs(certificate.proofs),
        "smallest_change": certificate.smallest_change and certificate.smallest_change.record(),
        "fast_move": certificate.fast_move and _fast_move(certificate.fast_move),
        "study": certificate.study.model_dump(mode="json"),
    }
    return json_text("spillover", whole, version=3)


def _proofs(proofs: Proofs) -> dict[str, Any]:
    modes, box = proofs
    unstable = None
    if box.unstable is not None:
        names = ("stiffness_factor", "extra_delay_samples", "more_payload_kg")
        unstable = dict(zip(names, box.unstable, strict=True))
    return {
        "statements": list(proof_texts(proofs)),
        "all_modes": {
            "gain_margin": modes.margin,
            "base_gain_margin": modes.base_margin,
            "from_modes": modes.n_base,
            "fault": modes.fault,
        },
        "box": {
            "is_proven": box.is_proven,
            "stiffness_factor": list(box.ranges[0]),
            "extra_delay_samples": list(box.ranges[1]),
            "more_payload_kg": list(box.ranges[2]),
            "undecided_share": box.undecided,
            "has_all_modes": box.has_all_modes,
            "from_modes": box.n_base,
            "cells": box.cells,
            "unstable": unstable,
            "fault": box.fault,
        },
    }


def _fast_move(move: ControlEffect) -> dict[str, Any]:
    return {
        "move_time_s": move.move_time,
        "residual_rms_m": move.residual_rms[0],
        "residual_rms_without_control_m": move.residual_rms[1],
        "run": describe(int(move.status[0])),
        "run_without_control": describe(int(move.status[1])),
    }


def _spillover_entry(worst: Spillover) -> dict[str, Any]:
    return {
        "mode": worst.mode,
        "damping_ratio": worst.damping_ratio,
        "damping_ratio_without_control": worst.free_damping,
        "basis": worst.plant.basis,
        "modes": worst.plant.n_modes,
        "mismatch": str(worst.plant.mismatch),
    }


def _plant(certificate: Certificate, at: tuple[int, ...]) -> dict[str, Any]:
    plant = certificate.plants[at]
    return {
        "basis": plant.basis,
        "modes": plant.n_modes,
        "sensor_length_factor": plant.mismatch.sensor,
        "actuator_length_factor": plant.mismatch.actuator,
        "frequency_factor": plant.mismatch.frequency,
        "joint_inertia_c_kg_m2": _joint(certificate, plant),
        "passes": bool(certificate.passes[at]),
        "spectral_radius": certificate.radius[at],
        "gain_margin": certificate.margin[at],
        "broken_by": str(certificate.breaking[at]),
        "least_damped": str(certificate.weakest[at]),
        "frequency_hz": certificate.frequency_hz[at][: plant.n_modes],
        "damping_ratio": certificate.damping_ratio[at][: plant.n_modes],
        "damping_ratio_without_control": certificate.free_damping[at][: plant.n_modes],
    }


def _joint(certificate: Certificate, plant: PlantVariant) -> Any:
    """True J_C [kg m2], one for all links or three."""
    joint_inertia = plant.mismatch.joint_inertia
    return certificate.study.link.joint_inertia_c if joint_inertia is None else joint_inertia
