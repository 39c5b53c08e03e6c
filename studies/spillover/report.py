"""The report of a spillover certificate: verdict first, then what it rests on."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from jaxmodel.laws import LAWS
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.show.markdown import literal, opening, picture, table
from studies.show.sketch import CAPTION
from studies.spillover.certificate import Certificate
from studies.spillover.comparison import FAST, GIVEN, SETTLING, WINDOW, WITHOUT, Comparison
from studies.spillover.plants import Plant
from studies.study.labels import describe
from studies.study.margin import margin_text

#: Leakage below this is rounding [1].
TINY = 1e-9
_COVERED = """\
Covered: delay, hold and anti-alias filter, exactly; the controller's own filters; every
combination of the bases, departures and numbers of modes above, one departure at a time. A margin
counts only as far as every smaller gain is stable, too.

Not covered: more plant modes than that; other damping than the study's; patches in other places, or
links that depart differently; poses other than the first way-point, and the forces of the motion
(the run's own report has those); rounding, saturation and the limits of the converters; whatever
bends or moves beyond the model (docs/theory.md). A large margin on these plants is no proof for
others."""

_LAW_NOTES = (
    "*IMSC-LQR*: the optimal gains of each mode, one weight of control for all; at factor 1 it "
    "gives mode 1 the design's velocity gain.",
    "*Modified IMSC*: of each link only the mode of highest estimated energy is controlled at a "
    "time. It switches, so its linear numbers are those of the loops with one mode alone, the "
    "smallest margin of them; that proves nothing about switching, which only the run shows.",
    "*Positive position feedback*: a second-order filter per mode, tuned so that it lags by 90° "
    "together with delay and anti-alias filter. It also answers to quasi-static bending during the "
    "move, hence its voltage.",
    "*Strain rate feedback* (16)–(18): every patch by itself, no modal filter; its rate is exact "
    "at mode 1 only.",
)


def verdict(found: Certificate) -> str:
    """One line: passed or failed, and what decides."""
    at = found.worst
    margin, breaking = margin_text(found.margin[at], 3), found.breaking[at]
    if found.is_passed:
        first = f"; first to go unstable beyond it: {breaking}" if breaking else ""
        return f"passed: gain margin {margin}, {found.required:g} required{first}"
    state = "" if found.radius[at] <= 1 + RADIUS_TOLERANCE else "unstable, "
    return f"failed by {breaking}: {state}gain margin {margin}, {found.required:g} required"


def report(found: Certificate, laws: Comparison | None) -> str:
    """Markdown text.

    Args:
        found: the certificate.
        laws: beside it, where they can be compared.
    """
    sections = [_head(found), _margins(found), _leakage(found)]
    if laws is not None:
        sections.append(_laws(laws))
    sections.append(["## What this covers", "", _COVERED])
    if found.notes:
        sections[-1] += ["", *(f"- {literal(note)}" for note in found.notes)]
    return "\n".join(line for section in sections for line in (*section, ""))


def _head(found: Certificate) -> list[str]:
    study, at = found.study, found.worst
    control, electronics = study.control, study.electronics
    total, good = int(found.exists.sum()), int(found.passes[found.exists].sum())
    links = "+".join(str(i + 1) for i in range(3) if control.links[i])
    told = (
        f"Its coefficients were kept while the plant changed: {good} of {total} plants pass, which "
        f"means that they are stable and stay so with all gains times up to {found.required:g}. "
        f"Smallest margin {margin_text(found.margin[at], 3)}, on {found.plants[at]}."
    )
    if found.fails_from == found.plants[0, 0, 0].n_modes:
        told += " It fails with the fewest plant modes already."
    elif found.fails_from:
        told += f" With fewer than {found.fails_from} plant modes a link all of them pass."
    return [
        f"# Spillover certificate {'passed' if found.is_passed else 'failed'}: gain margin "
        f"{margin_text(found.margin[at], 3)}, {found.required:g} required",
        "",
        *opening(
            f"is the controller of {literal(study.title) or 'the study'} safe on plants that it "
            f"does not know: {total} of them, a gain margin of {found.required:g} on each.",
            f"**{verdict(found)[0].upper()}{verdict(found)[1:]}.** {good} of {total} plants pass.",
            _next(found),
        ),
        picture("machine.png", CAPTION),
        "",
        "## The design",
        "",
        f"{literal(study.title) or 'study'}: law {control.law}, basis {control.basis}, "
        f"{found.n_controlled} controlled modes on links {links}, gain factor "
        f"{control.gain_factor:g}; {electronics.sample_rate_hz:g} Hz, anti-alias filter "
        f"{electronics.antialias_hz:g} Hz, "
        f"one sample of delay, velocity estimate {electronics.estimator}.",
        "",
        told,
    ]


def _next(found: Certificate) -> str:
    margin = float(found.margin[found.worst])
    if found.is_passed:
        return "`studies export DESIGN --target c --out dsp` takes it to a controller."
    if margin > 0:
        share = margin / found.required
        return (
            f"gains times {share:.2g} would pass on these plants (`control.gain_factor = "
            f"{share * found.study.control.gain_factor:.3g}`), at less damping; or move the "
            "patches and filters (`studies tune tune_placement`)."
        )
    return "another law, basis or estimate of the velocity (see the laws below): no gain passes."


def _margins(found: Certificate) -> list[str]:
    rows = []
    for b, n in np.ndindex(found.plants.shape[0], found.plants.shape[2]):
        exists = found.exists[b, :, n]
        if not exists.any():
            continue
        margin = np.where(exists, found.margin[b, :, n], np.inf)
        zeta = np.where(exists, found.least_damping[b, :, n], np.inf)
        low, weak = int(np.argmin(margin)), int(np.argmin(zeta))
        plant = found.plants[b, low, n]
        rows.append(
            [
                plant.basis,
                str(plant.n_modes),
                margin_text(margin[low], 3),
                str(plant.departure),
                found.breaking[b, low, n] or "-",
                f"{zeta[weak]:.3g}",
                found.weakest[b, weak, n],
                "yes" if found.passes[b, :, n][exists].all() else "**no**",
            ]
        )
    names = (
        "basis",
        "modes",
        "smallest margin",
        "where",
        "broken by",
        "least damping ratio",
        "of",
        "all pass",
    )
    return [
        "## Margins and damping",
        "",
        "For each basis and number of plant modes per link: the smallest gain margin of all "
        "departures from what the controller believes (sensors and actuators of other lengths, "
        "links of other stiffness, joints of other inertia), what goes unstable beyond it, and the "
        "least damping ratio of all link modes "
        f"at the design's gains (without control: {_free(found)}). The mode is "
        'the one that holds most energy of the motion; "through a filter" says that the pole is '
        "one of the controller's filters, which the mode, far stiffer, feeds.",
        "",
        *table(names, rows),
        "",
        picture("margins.png", "Gain margin over the number of plant modes"),
        "",
        picture("damping.png", "Damping ratio of every link mode at the design's gains"),
    ]


def _free(found: Certificate) -> str:
    """Damping ratios of the plants without control."""
    low, high = np.nanmin(found.free_damping), np.nanmax(found.free_damping)
    return f"{low:.3g}" if high - low < 0.1 * high else f"{low:.3g} to {high:.3g}"


def _leakage(found: Certificate) -> list[str]:
    law = LAWS[found.study.control.law]
    if law.channel != "mode":
        told = f"{law.text.capitalize()} has no modal filter: each patch feeds back all modes."
        return ["## Leakage", "", told]
    first = found.n_controlled
    size = np.abs(found.observation)
    rows = []
    for b in range(len(size)):
        if np.all(np.isnan(size[b])) or size.shape[4] <= first:
            continue
        worst = np.nanmax(size[b], axis=(0, 1))[:, first:]
        for j, values in enumerate(worst):
            cells = (f"{x:.2g}" if x > TINY else "0" for x in values)
            rows.append([found.plants[b, 0, 0].basis, f"q^{j + 1}", *cells])
    if not rows:
        return ["## Leakage", "", "No plant has more modes than are controlled."]
    pushed = np.where(np.isnan(found.actuation), 0.0, np.abs(found.actuation))[..., first:, :]
    at = np.unravel_index(np.argmax(pushed), pushed.shape)
    r, j, basis = int(at[3]), int(at[4]), found.plants[at[0], 0, 0].basis
    names = [f"mode {r + 1}" for r in range(first, size.shape[4])]
    return [
        "## Leakage",
        "",
        "What a unit of a mode that is not controlled adds to the estimate q^j of a controlled one "
        "(modal filter times sensors): the largest of all links and departures, in the scale of "
        f"the plant's basis. {_worst_leak(found)} The other way round a force on a "
        f"controlled mode pushes others by up to {pushed.max():.3g} of itself (mode {j + 1} on "
        f"mode {r + first + 1}, {basis}).",
        "",
        *table(("basis", "estimate", *names), rows),
        "",
        picture("leakage.png", "Leakage of plant modes into the estimated ones"),
    ]


def _worst_leak(found: Certificate) -> str:
    size = np.where(np.isnan(found.observation), 0.0, np.abs(found.observation))
    size = size[..., found.n_controlled :]
    b, d, _, j, r = np.unravel_index(np.argmax(size), size.shape)
    return (
        f"Worst: mode {r + found.n_controlled + 1} in q^{j + 1} with {size.max():.3g} "
        f"({found.plants[b, d, 0].basis}, {found.plants[b, d, 0].departure})."
    )


def _laws(laws: Comparison) -> list[str]:
    off = laws.residual_rms[laws.names.index(WITHOUT)]
    rows = []
    for k, name in enumerate(laws.names):
        rms = laws.residual_rms[k]
        rows.append(
            [
                name,
                f"{laws.factor[k]:.3g}",
                *(f"{zeta:.3g}" if np.isfinite(zeta) else "-" for zeta in laws.damping_ratio[k]),
                margin_text(laws.margin[k], 3) if np.isfinite(laws.margin[k]) else "-",
                laws.breaking[k] or "-",
                " / ".join(f"{1e6 * x:.3g}" for x in rms),
                f"{100 * np.mean(rms / off):.3g} %" if np.all(off > 0) else "-",
                f"{laws.peak_voltage[k]:.3g}",
                f"{laws.control_energy[k]:.3g}",
                describe(int(laws.status[k])),
            ]
        )
    modes = [f"zeta {j + 1}" for j in range(laws.damping_ratio.shape[1])]
    names = (
        "law",
        "factor",
        *modes,
        "margin",
        "broken by",
        "residual rms of links 1 / 2 / 3 [µm]",
        "of no control",
        "peak [V]",
        "energy [V² s]",
        "run",
    )
    motion = "the study's own start, without a move"
    if len(laws.study.motion.waypoints) > 1:
        motion = (
            f"the design's first move in {laws.study.motion.move_time:.3g} s (as fast as "
            f"{1e3 * FAST[0]:g} mm in {FAST[1]:g} s), no shaper"
        )
    return [
        "## Laws",
        "",
        "The same machine, patches, electronics and controlled modes. Factor 1 is the design's own "
        "damping constant of mode 1. Each law has the largest factor that leaves a margin of "
        f"{laws.required:g} on the design's own plants ({laws.plant.basis}, as believed), "
        f'but no more than damps mode 1 as "{GIVEN}" does, or as well as it can. Damping ratios: '
        f"the smallest of the links that control the mode, {laws.plant.n_modes} modes a link. Run, "
        f"nonlinear: {motion}; residual over {WINDOW:g} s from {SETTLING:g} s after the command "
        "on, when the drives have nearly settled; of no control: mean of the three links' shares.",
        "",
        *table(names, rows),
        "",
        picture("laws.png", "Residual vibration of the laws"),
        "",
        *(f"- {note}" for note in _LAW_NOTES),
    ]


def document(found: Certificate, laws: Comparison | None) -> str:
    """JSON text: the verdict and every number, null where there is none."""
    whole: dict[str, Any] = {
        "format": "flexlink-spillover",
        "format_version": 2,
        "title": found.study.title,
        "is_passed": found.is_passed,
        "verdict": verdict(found),
        "required_margin": found.required,
        "smallest_margin": float(np.nanmin(found.margin)),
        "fails_from_modes": found.fails_from or None,
        "notes": list(found.notes),
        "plants": [_plant(found, tuple(at)) for at in np.argwhere(found.exists)],
        "laws": [] if laws is None else [_law(laws, k) for k in range(len(laws.names))],
        "study": found.study.model_dump(mode="json"),
    }
    return json.dumps(_plain(whole), indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def _plant(found: Certificate, at: tuple[int, ...]) -> dict[str, Any]:
    plant = found.plants[at]
    return {
        "basis": plant.basis,
        "modes": plant.n_modes,
        "sensor_length_factor": plant.departure.sensor,
        "actuator_length_factor": plant.departure.actuator,
        "frequency_factor": plant.departure.frequency,
        "joint_inertia_c_kg_m2": _joint(found, plant),
        "passes": bool(found.passes[at]),
        "spectral_radius": found.radius[at],
        "gain_margin": found.margin[at],
        "broken_by": str(found.breaking[at]),
        "least_damped": str(found.weakest[at]),
        "frequency_hz": found.frequency_hz[at][: plant.n_modes],
        "damping_ratio": found.damping_ratio[at][: plant.n_modes],
        "damping_ratio_without_control": found.free_damping[at][: plant.n_modes],
    }


def _joint(found: Certificate, plant: Plant) -> Any:
    """True J_C [kg m2], one for all links or three."""
    known = plant.departure.joint_inertia
    return found.study.link.joint_inertia_c if known is None else known


def _law(laws: Comparison, k: int) -> dict[str, Any]:
    return {
        "law": laws.names[k],
        "factor": laws.factor[k],
        "damping_ratio": laws.damping_ratio[k],
        "gain_margin": laws.margin[k],
        "broken_by": laws.breaking[k],
        "residual_rms_m": laws.residual_rms[k],
        "peak_voltage_v": laws.peak_voltage[k],
        "control_energy_v2s": laws.control_energy[k],
        "run": describe(int(laws.status[k])),
    }


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    return None if isinstance(value, float) and not np.isfinite(value) else value
