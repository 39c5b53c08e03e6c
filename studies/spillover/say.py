"""What a spillover certificate tells: verdict first, then its basis."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from jaxmodel.laws import LAWS
from studies.engine.fast_motion import FAST, WINDOW
from studies.show.listing import Rows
from studies.show.report import Chapter, Items, Report, chapter, drawing, machine
from studies.show.units import span
from studies.show.words import motion_text
from studies.space.machines import UNITS
from studies.spillover import plots
from studies.spillover.certificate import Certificate
from studies.spillover.fast_move import ControlEffect
from studies.spillover.plants import PlantVariant
from studies.study.labels import describe
from studies.study.margin import GUESSED, margin_in_db, margin_text
from studies.study.window import residual_delay

#: Spillover below this is rounding [1].
TINY = 1e-9


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


def say(certificate: Certificate) -> Report:
    """What a certificate tells."""
    study, plants = certificate.study, int(certificate.exists.sum())
    changed = certificate.smallest_change
    residual, spillover = residual_text(certificate), spillover_text(certificate)
    statements = () if certificate.proofs is None else certificate.proofs.statements
    result = [
        certificate.verdict if certificate.is_passed else f"**{certificate.verdict}**",
        damping_text(certificate),
        f"**{spillover}**" if spillover else "",
        *statements,
        "" if changed is None else changed.text,
        *certificate.notes,
        f"**{residual}**" if residual.startswith("CONTROL") else residual,
    ]
    return Report(
        title=f"{study.title or 'untitled study'}: spillover certificate "
        f"{'passed' if certificate.is_passed else 'failed'}",
        result=result,
        question=f"""{study.title or "the study"}: is its controller stable on {plants} plants that
        differ from its nominal model, with a gain margin of {certificate.required_margin:g} on
        each?""",
        next_steps=_next_steps(certificate),
        top=[machine(study)],
        chapters=[
            _margins(certificate, plants),
            _proofs(certificate),
            _smallest_change(certificate),
            _spillover(certificate),
            _move(certificate),
            _coverage(certificate),
        ],
        files={"Study file": study},
        caveat=GUESSED,
    )


def _next_steps(certificate: Certificate) -> str:
    margin = float(certificate.gain_margin[certificate.worst])
    share = margin / certificate.required_margin
    if certificate.is_passed:
        return "`studies export DESIGN --target c --out dsp` writes the controller in C."
    if share >= 1:
        return """lower `control.gain_factor`, or shorten the delay that the controller has to
        expect, until `--prove` finds no unstable machine: the plants, which pass, have neither the
        delay nor the payload of the box."""
    if margin > 0:
        return f"""with its gains scaled by {share:.2g} the controller would pass on these plants
        (`control.gain_factor = {share * certificate.study.control.gain_factor:.3g}`), with less
        damping; or move the patches and filters by `studies tune` (`studies init --from
        tune_placement` is an example, for the paper's machine)."""
    return """no gain passes: choose another basis or velocity estimator, or another law (`studies
    laws DESIGN --out DIR` compares them)."""


def _margins(certificate: Certificate, plants: int) -> Chapter | None:
    study, sizes = certificate.study, certificate.plant_modes
    control, electronics = study.control, study.electronics
    links = "+".join(str(i + 1) for i, is_on in enumerate(control.links) if is_on)
    worst = certificate.variants[certificate.worst]
    heads = ["basis", "model mismatch", "gain margin", f"with {sizes[0]} modes", "broken by"]
    heads += ["smallest damping ratio", "least damped", "passes"]
    good = int(certificate.passes[certificate.exists].sum())
    left_out = int((~certificate.exists).sum())
    free = certificate.free_damping_ratio
    return chapter(
        "Margins and damping",
        f"""The controller (law {control.law}, basis {control.basis}, {certificate.n_controlled}
        controlled modes per link on links {links}, gain factor {control.gain_factor:g}, sampled at
        {electronics.sample_rate_hz:g} Hz, velocity estimator {electronics.estimator}) stays as it
        is while the plant varies. {good} of {plants} plants pass"""
        + (f" ({left_out} more left out, see below)" if left_out else "")
        + f""": they are stable, and stay so with all gains scaled by up to
        {certificate.required_margin:g}. Smallest margin:
        {margin_in_db(float(certificate.gain_margin[certificate.worst]), 3)}, on {worst.basis},
        {worst.n_modes} modes per link, {worst.mismatch}."""
        + (
            f" Margins with {sizes[-2]} and {sizes[-1]} modes differ by up to "
            f"{100 * certificate.truncation:.2g} %."
            if len(sizes) > 1
            else ""
        ),
        f"""Gain margin, what becomes unstable beyond it, and smallest damping ratio of plants with
        {sizes[-1]} modes per link (without control: {span(free[np.isfinite(free)])}). The modes
        named hold most of the energy of the motion; those above half the sample rate,
        {electronics.sample_rate_hz / 2:g} Hz, reach the controller folded.""",
        Rows(heads, _plant_rows(certificate)),
        drawing(plots.margins, certificate, height=4.35),
        drawing(plots.mode_damping, certificate, name="damping", height=3.4),
    )


def _proofs(certificate: Certificate) -> Chapter | None:
    if certificate.proofs is None:
        return None
    return chapter(
        "Proofs",
        Items(certificate.proofs.statements),
        f"""Not samples: on the whole unit circle the return difference of the sampled loop is shown
        to have no zero, with bounds in closed form for all that the model leaves out. Up to
        rounding, for the design's plant ({certificate.study.link.basis}) at the first way-point;
        the first statement is about pinned_pinned links.""",
    )


def _smallest_change(certificate: Certificate) -> Chapter | None:
    change = certificate.smallest_change
    if change is None:
        return None
    units = UNITS._asdict()
    sizes = ", ".join(
        f"{name} {value:.3g}" + (f" {units[name]}" if units[name] != "1" else "")
        for name, value in change.tolerances.items()
    )
    rows = [
        [str(x.name), x.text.removeprefix(x.name).strip(), f"{x.size:+.2f}"] for x in change.parts
    ]
    return chapter(
        "The smallest change that breaks it",
        f"""Sizes are in units of tolerances ({sizes}; relative ones as natural logarithms; other
        ones: `--tolerance NAME=VALUE`), and the distance is Euclidean.""",
        Rows(["number", "change", "in tolerances"], rows),
    )


def _spillover(certificate: Certificate) -> Chapter | None:
    title, law = "Observation and control spillover", LAWS[certificate.study.control.law]
    if law.channel != "mode":
        return chapter(title, f"{law.text} has no modal filter: it feeds back all modes.")
    first, last = certificate.n_controlled, certificate.observation.shape[4]
    if first == last or certificate.observation.shape[3] == 0:
        return chapter(title, "No plant has more modes than are controlled.")
    observation = certificate.observation[..., first:]
    seen, mode, estimate, plant = _largest(certificate, observation)
    pushed, excited, controlled, other = _largest(
        certificate, np.swapaxes(certificate.actuation, 3, 4)[..., first:]
    )
    size = np.nan_to_num(np.abs(observation)).max(axis=(1, 2))
    rows = [
        [
            str(certificate.basis[b]),
            f"q^{j + 1}",
            *(f"{x:.2g}" if x > TINY else "0" for x in size[b, j]),
        ]
        for b, j in np.ndindex(size.shape[:2])
        if certificate.exists[b].any()
    ]
    return chapter(
        title,
        f"""What one unit of an uncontrolled mode adds to the estimate q^j of a controlled one: the
        largest value over all links and mismatches. Worst: mode {mode} in q^{estimate}, {seen:.3g}
        ({plant.basis}, {plant.mismatch}). Control spillover: a force on a controlled mode excites
        uncontrolled ones by up to {pushed:.3g} of itself (mode {controlled} on mode {excited},
        {other.basis}).""",
        Rows(["basis", "estimate", *(f"mode {r + 1}" for r in range(first, last))], rows),
        drawing(plots.leakage, certificate),
    )


def _move(certificate: Certificate) -> Chapter | None:
    move = certificate.fast_move
    if move is None:
        return None
    motion = f"{motion_text(certificate.study)}, from the study's initial state"
    if move.move_time is not None:
        motion = f"""the design's first move in {1e3 * move.move_time:.4g} ms (the acceleration of a
        move of {1e3 * FAST[0]:g} mm in {1e3 * FAST[1]:.4g} ms), no shaper"""
    return chapter(
        "With and without control" if move.move_time is None else "The fast move",
        f"""Nonlinear runs of the nominal machine with the design's controller and with no link
        controlled: {motion}; residual over {1e3 * WINDOW:.4g} ms, starting
        {1e3 * residual_delay(move.study):.4g} ms after the reference trajectory, when the drives
        have settled.""",
        Rows(["control", "residual rms by link [µm]", "run"], _fast_rows(move)),
    )


def _coverage(certificate: Certificate) -> Chapter | None:
    proven = "" if certificate.proofs is None else ', except as under "Proofs"'
    return chapter(
        "What this covers",
        f"""Covered: delay, hold and filters, exactly; every combination of the bases, mismatches
        and numbers of modes above, one mismatch at a time. A margin counts only if every smaller
        gain is stable as well. Not covered: more plant modes{proven}; damping other than the
        study's; patches in other positions, or links that differ in their mismatch; poses other
        than the first way-point, and the forces of the motion; rounding, saturation and the limits
        of the converters. The smallest change is the nearest one that a search found.""",
    )


def _plant_rows(certificate: Certificate) -> list[list[str]]:
    """Row of each basis and mismatch: the largest plant, and the margin of the smallest."""
    rows = []
    for b, d in np.ndindex(certificate.variants.shape[:2]):
        exists, margin = certificate.exists[b, d], certificate.gain_margin[b, d]
        if not exists.any():
            continue
        last = int(np.flatnonzero(exists)[-1])
        plant = certificate.variants[b, d, last]
        rows.append(
            [
                plant.basis,
                str(plant.mismatch),
                margin_text(margin[last], 3),
                margin_text(margin[0], 3) if exists[0] else "-",
                certificate.broken_by[b, d, last] or "-",
                f"{certificate.least_damping[b, d, last]:.3g}",
                certificate.least_damped[b, d, last],
                "yes" if certificate.passes[b, d][exists].all() else "no",
            ]
        )
    return rows


def _largest(certificate: Certificate, leakage: np.ndarray) -> tuple[float, int, int, PlantVariant]:
    """Size [1] of the largest entry of a leakage, (B, D, 3, C, uncontrolled modes).

    With its uncontrolled and its controlled mode, from 1, and its plant.
    """
    size = np.nan_to_num(np.abs(leakage))
    b, d, _, j, r = np.unravel_index(np.argmax(size), size.shape)
    mode, plant = int(r) + certificate.n_controlled + 1, certificate.variants[b, d, 0]
    return float(size.max()), mode, int(j) + 1, plant


def _fast_rows(move: ControlEffect) -> list[list[str]]:
    """Row of each run."""
    return [
        [how, " / ".join(f"{1e6 * x:.3g}" for x in rms), describe(int(code))]
        for how, rms, code in zip(("on", "off"), move.residual_rms, move.status, strict=True)
    ]
