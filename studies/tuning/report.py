"""The report of a tuning: what improved, on which machines, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from jaxmodel import status
from jaxmodel.loop_figures import MARGIN_MODES, MARGINS, PEAKS
from jaxmodel.metrics import METRICS
from studies.engine.fidelity import rank_correlation
from studies.engine.poles import HEADER, difference, pole_rows
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION
from studies.show.units import headed, is_cut_off, number, readable, settling_text
from studies.study.entries import parse_entries
from studies.study.margin import caution, margin_in_db, margin_text
from studies.study.template import toml_text
from studies.tuning.audit import ALLOWED, MEANING
from studies.tuning.check import JudgedDesign, RandomSearch, patch_centers
from studies.tuning.findings import TuneFindings, best_family
from studies.tuning.free import PLACEMENT
from studies.tuning.loop_figures import (
    LOOP_UNITS,
    DesignFigures,
    allowed_on,
    relative_margin,
    unit_text,
    worst_value,
)
from studies.tuning.objective import SHOWN
from studies.tuning.optimise import GAIN, KEPT, PATIENCE, Progress, excess
from studies.tuning.references import reference_lines, resolution_lines
from studies.tuning.scenarios import fresh_machines, move_label
from studies.tuning.spec import LOOP_LIMITS, LOWER, Family, TuneSpec, label

#: A limit closer than this share counts as active.
NEAR = 0.02
#: Starts that end within this share of the best one count as equally good.
ALIKE = 0.01
#: With fewer designs, or a smaller spread between them, ranks are meaningless.
FEW, NARROW = 8, 0.05
#: Heading of the reference row.
REFERENCE = "baseline"


def report(
    spec: TuneSpec, findings: TuneFindings, folder: str = "", images: Path | None = None
) -> str:
    """The page of a tuning.

    Args:
        spec: of the tuning.
        findings: what it found.
        folder: that holds the tuned studies, for commands.
        images: folder with the figures; None: a page without.
    """
    at, search = findings.at, findings.searched
    worst = max(findings.audited, key=lambda entry: entry.share)
    names = list(findings.baseline.metrics)
    return page(
        "tuning/report.html",
        images,
        {"Tuning file": toml_text(spec.data), "Study file": spec.study},
        spec=spec,
        tune=spec.tune,
        findings=findings,
        ended=ended(spec, at),
        n_frozen=int(at.is_frozen.sum()),
        n_outside=n_outside(at),
        names_links=all(parse_entries(name).names_a_link for name in spec.metric_terms),
        lower=LOWER,
        best=_best(spec, findings),
        references=reference_lines(spec, findings.baseline, findings.references),
        better=_better_references(spec, findings),
        unmeasured=_unmeasured(spec, findings),
        folder=f"{folder}/" if folder else "",
        heads=[headed(x, METRICS[parse_entries(x).metric].unit) for x in names],
        own=_own_machine(spec, findings, names),
        loop_heads=[_loop_head(x) for x in _of_response(spec)],
        fresh_loop_heads=[_loop_head(x) for x in _judged_fresh(spec, findings)],
        n_modes=max(MARGIN_MODES, spec.study.link.modes),
        fresh=_fresh(spec, findings, names),
        metrics=names,
        changes=_changes(spec, findings, names),
        limits=_limits(spec, findings),
        front=spec.tune.pareto.get("limit", spec.metric_limits[0]) if spec.metric_limits else "",
        families=[family.name for family in spec.moving],
        numbers=_numbers(spec, findings),
        alike=ALIKE,
        pole_header=HEADER,
        poles=[
            (name, difference(design.poles), pole_rows(design.poles))
            for name, design in _designs(spec, findings)
            if design.poles is not None
        ],
        centers=_centers(spec, findings) if PLACEMENT in spec.tune.free else [],
        main=spec.families[spec.main].name,
        searched=search,
        kept=search.objective[is_kept(spec, search)] if search is not None else [],
        tuned=at.best_objective[at.winner(spec.main)],
        fidelity=_fidelity(spec, findings),
        worst=worst,
        worst_name=PLACEMENT if worst.name.startswith(PLACEMENT) else worst.name,
        allowed=ALLOWED,
        meaning=MEANING,
        sketch_caption=CAPTION,
    )


def n_outside(at: Progress) -> int:
    """Starting points that keep the limits at no iteration."""
    violation = at.history[: int(at.iteration), :, 1]
    return int(np.sum(~np.any(violation <= KEPT, axis=0)))


def ended(spec: TuneSpec, at: Progress) -> str:
    """Why a tuning ended, in a sentence."""
    done, total = int(at.iteration), spec.tune.iterations
    if done < total:
        return (
            f"Ended after {done} of {total} iterations: for {PATIENCE} no family had gained "
            f"{100 * GAIN:g} %."
        )
    return f"Ended after all {total} iterations ({spec.tune.method})."


def _best(spec: TuneSpec, findings: TuneFindings) -> dict[str, Any]:
    """The design to recommend, and its figures beside the baseline's, the worse ones last."""
    k = best_family(spec, findings)
    best, baseline, family = findings.judged[k], findings.baseline, spec.families[k]
    gains = [
        _metric_gain(metric, best, baseline)
        for metric in dict.fromkeys((*spec.metric_terms, *SHOWN))
    ]
    if best.loop is not None and baseline.loop is not None:
        gains += _loop_gains(spec, best.loop, baseline.loop)
    return {
        "family": family.name,
        "file": file_name(spec, family),
        "gains": sorted(gains, key=lambda gain: gain["is_worse"]),
        "objective": best.objective,
        "caution": caution(best.loop.gain_margin) if best.loop is not None else "",
        "is_violated": findings.at.beyond(findings.at.winner(k)) > 0,
    }


def _metric_gain(metric: str, design: JudgedDesign, baseline: JudgedDesign) -> dict[str, Any]:
    """A metric, of which less is better."""
    after, before = (float(x.own_run.metrics[metric]) for x in (design, baseline))
    texts = [_value(metric, x.own_run.metrics, x.own_run.watched) for x in (design, baseline)]
    unit = readable(METRICS[parse_entries(metric).metric].unit)[1]
    change = "" if any(text.startswith("not") for text in texts) else _percent_change(before, after)
    with_unit = texts[1] if unit == "1" else f"{texts[1]} {unit}"
    is_worse = after > (1 + ALIKE) * before
    return _gain(metric, change, texts[0], with_unit, is_worse)


def _gain(figure: str, change: str, after: str, before: str, is_worse: bool) -> dict[str, Any]:
    """A figure beside the baseline's, with its unit there.

    Args:
        figure: its name.
        change: relative, "" if not known.
        after: of the design.
        before: of the baseline.
        is_worse: by more than `ALIKE`.
    """
    names = "figure", "change", "after", "before", "is_worse"
    return dict(zip(names, (figure, change, after, before, is_worse), strict=True))


def _loop_gains(
    spec: TuneSpec, design: DesignFigures, baseline: DesignFigures
) -> list[dict[str, Any]]:
    """Figures of the linearised loop: gain margin, slowest decay, and those the tuning names."""
    margins = [x.gain_margin for x in (design, baseline)]
    is_lost = margins[0] < (1 - ALIKE) * margins[1]
    own, reference = (margin_in_db(x, 3) for x in margins)
    gains = [_gain("gain margin", "", own, reference, is_lost)]
    for name in dict.fromkeys(("slowest_decay", *spec.loop_terms, *_of_response(spec))):
        after, before = (float(getattr(x, name)) for x in (design, baseline))
        larger = after / before if before else np.nan
        is_worse = larger < 1 - ALIKE if name in LOWER else larger > 1 + ALIKE
        unit = "" if unit_text(name) == "1" else f" {unit_text(name)}"
        figure, change = name.replace("_", " "), _percent_change(before, after)
        gains.append(_gain(figure, change, f"{after:.3g}", f"{before:.3g}{unit}", is_worse))
    return gains


def _of_response(spec: TuneSpec) -> list[str]:
    """Margins and norms by frequency response that the objective or a limit names."""
    return [name for name in spec.loop_names if name in (*MARGINS, *PEAKS)]


def _judged_fresh(spec: TuneSpec, findings: TuneFindings) -> list[str]:
    """Figures of the loop that are judged on fresh machines."""
    return [name for name in spec.loop_names if name in findings.baseline.fresh_loop]


def _loop_head(name: str) -> str:
    return headed(name.replace("_", " "), unit_text(name))


def _percent_change(before: float, after: float) -> str:
    """A relative change in percent, "" if there is nothing to relate to."""
    return f"{100 * (after / before - 1):+.3g} %" if before else ""


def file_name(spec: TuneSpec, family: Family) -> str:
    """File name of a family's study."""
    if len(spec.moving) == 1:
        return "tuned.toml"
    return f"tuned_{label(family.name)}.toml"


def summary(spec: TuneSpec, findings: TuneFindings) -> list[str]:
    """What improved, one line per family."""
    machines, lines = fresh_machines(spec), []
    active = {
        name: [limit["name"] for limit in limits if limit["state"] == "active"]
        for name, limits in _limits(spec, findings)
    }
    for k, (family, design) in enumerate(zip(spec.families, findings.judged, strict=True)):
        is_moving = k < len(spec.moving)
        lost = is_moving and findings.at.beyond(findings.at.winner(k)) > 0
        lines.append(
            f"{family.name}: {design.objective.mean():.4f} of the baseline's objective "
            f"on {machines}"
            + (f", worst {design.objective.max():.4f}" if len(design.objective) > 1 else "")
            + _worst_loops(spec, findings, design)
            + ("; a limit is violated" if lost else "")
            + (f"; stopped by {' and '.join(stops)}" if (stops := active.get(family.name)) else "")
        )
    if not spec.tune.scenarios.has_others:
        lines.append(
            "All machines are nominal: [tune.scenarios] names nothing in which they differ, so "
            "these figures say nothing of robustness."
        )
    lines += reference_lines(spec, findings.baseline, findings.references)
    return lines + _unmeasured(spec, findings)


def _worst_loops(spec: TuneSpec, findings: TuneFindings, design: JudgedDesign) -> str:
    """Figures of the loop on the worst fresh machine, "" without any."""
    texts = [
        f"{name} {worst_value(name, design.fresh_loop[name]):.4g}"
        + (f" {unit_text(name)}" if LOOP_UNITS[name] != "1" else "")
        for name in _judged_fresh(spec, findings)
    ]
    return f"; on the worst of them {', '.join(texts)}" if texts else ""


def _better_references(spec: TuneSpec, findings: TuneFindings) -> list[str]:
    """What a tuned design should beat, but no design does."""
    least = min(x.objective.mean() for x in findings.judged[: len(spec.moving)])
    compared = findings.references.designs
    return [name for name, x in compared if x.objective.mean() < least]


def _unmeasured(spec: TuneSpec, findings: TuneFindings) -> list[str]:
    """Warnings of what is compared though the controller cannot measure it."""
    designs = [design for _, design in _designs(spec, findings)]
    return resolution_lines(spec, designs, findings.references.adc_step)


def _designs(spec: TuneSpec, findings: TuneFindings) -> list[tuple[str, JudgedDesign]]:
    """The baseline, the best design of every family, what they have to beat; by name."""
    names = [family.name for family in spec.families]
    compared = findings.references.designs
    return [(REFERENCE, findings.baseline), *zip(names, findings.judged, strict=True), *compared]


def _value(metric: str, values: Mapping[str, Any], watched: float) -> str:
    """A figure of one run as a report shows it."""
    value = float(values[metric])
    if metric.startswith("settling_time"):
        return settling_text(value, watched)
    return number(value, METRICS[parse_entries(metric).metric].unit)


def _own_machine(spec: TuneSpec, findings: TuneFindings, names: list[str]) -> list[list[str]]:
    """Row of each design on the machine of its own file; `names`: of metrics."""
    rows, files = [], ["study.toml", *(file_name(spec, family) for family in spec.moving)]
    for k, (name, design) in enumerate(_designs(spec, findings)):
        cells = [_value(metric, design.own_run.metrics, design.own_run.watched) for metric in names]
        more = _of_response(spec)
        loop = ["-"] * (3 + len(more))
        if design.loop is not None:
            values = [getattr(design.loop, x) for x in ("slowest_decay", "spillover", *more)]
            loop = [margin_text(design.loop.gain_margin), *(f"{x:.4g}" for x in values)]
        file = Markup("<code>{}</code>").format(files[k]) if k < len(files) else "-"
        end = status.REASONS[design.own_run.status]
        rows.append([name, file, f"{design.own_run.objective:.4f}", *cells, *loop, end])
    return rows


def _fresh(spec: TuneSpec, findings: TuneFindings, names: list[str]) -> list[list[str]]:
    """Row of each design on the worst of all fresh machines and moves; `names`: of metrics."""
    rows = []
    for name, design in _designs(spec, findings):
        worst = [int(np.argmax(np.nan_to_num(design.metrics[x], nan=-np.inf))) for x in names]
        cells = [
            _value(x, {x: design.metrics[x][k]}, design.watched[k])
            for x, k in zip(names, worst, strict=True)
        ]
        objective = [f"{design.objective.mean():.4f}", f"{design.objective.max():.4f}"]
        cells += [
            f"{worst_value(x, design.fresh_loop[x]):.4g}" if design.fresh_loop else "-"
            for x in _judged_fresh(spec, findings)
        ]
        rows.append([name, *objective, *cells, _codes(design)])
    return rows


def _changes(spec: TuneSpec, findings: TuneFindings, names: list[str]) -> list[list[str]]:
    """Row of each design and move: changes of the mean over the fresh machines."""
    count, baseline, rows = spec.tune.scenarios.check, findings.baseline, []
    for name, design in _designs(spec, findings)[1:]:
        for k, move in enumerate(spec.moves):
            part = slice(k * count, (k + 1) * count)
            changes = [_change(1.0, design.objective[part].mean())]
            changes += [_change_of(x, baseline, design, part) for x in names]
            rows.append([name, move_label(move) or "-", *changes])
    return rows


def _change_of(name: str, baseline: JudgedDesign, design: JudgedDesign, part: slice) -> str:
    """Change of the mean of a metric over some cases, unless a run ends before it settles."""
    before, after = (x.metrics[name][part] for x in (baseline, design))
    if name == "settling_time":
        for figures, who in ((design, ""), (baseline, "baseline ")):
            if np.any(is_cut_off(figures.metrics[name][part], figures.watched[part])):
                return f"{who}not settled"
    return _change(before.mean(), after.mean())


def _change(before: float, after: float) -> str:
    return f"{100 * (after / before - 1):+.1f} %" if before else f"{after:.3g} (was 0)"


def _limits(spec: TuneSpec, findings: TuneFindings) -> list[tuple[str, list[dict[str, Any]]]]:
    """Limits of each family on the scenarios of the tuning."""
    by_family = []
    for k, family in enumerate(spec.moving):
        excesses = findings.at.best_limits[findings.at.winner(k)]
        limits = []
        for name, beyond in zip(spec.limit_names, excesses, strict=True):
            limit = family.limits[name]
            left = _loop_margin(findings, k, name, limit) if name in LOOP_LIMITS else -float(beyond)
            limits.append(
                {
                    "name": name,
                    "value": limit,
                    "state": _state(float(beyond), left),
                    "left": left if np.isfinite(left) else None,  # a share, negative if violated
                }
            )
        by_family.append((family.name, limits))
    return by_family if spec.limit_names else []


def _loop_margin(findings: TuneFindings, k: int, name: str, limit: float | str) -> float:
    """How far a figure is from its limit on the worst machine of the tuning, as a share of it.

    nan if not known.
    """
    loop, baseline = findings.judged[k].tuned_loop, findings.baseline.tuned_loop
    if name not in loop or name not in baseline:
        return float("nan")
    return relative_margin(name, loop[name], allowed_on(limit, baseline[name]))


def _state(beyond: float, left: float) -> str:
    """State of a limit, from its violation and its remaining margin, nan if unknown."""
    if beyond > KEPT:
        return "violated"
    if np.isnan(left):
        return "kept"
    return "active" if left < NEAR else "inactive"


def _numbers(spec: TuneSpec, findings: TuneFindings) -> list[list[str]]:
    """Row of each free parameter but those of the placement, which `_centers` shows in mm."""
    at, families, rows = findings.at, spec.moving, []
    places = [at.best_place[at.winner(k)] for k in range(len(families))]
    alike = [at.best_place[at.alike(k, ALIKE)] for k in range(len(families))]
    for n, free in enumerate(spec.free.numbers):
        if free.key == PLACEMENT:
            continue
        cells = []
        for k, family in enumerate(families):
            value = spec.free.values(places[k])[n]
            low, high = (spec.free.values(x)[n] for x in (alike[k].min(0), alike[k].max(0)))
            mark = "*" if places[k][n] in (0.0, 1.0) else ""
            span = f" ({low:.3g}..{high:.3g})" if len(alike[k]) > 1 else ""
            cells.append(f"{value:.4g}{mark}{span}" if family.is_free[n] else "-")
        start = f"{free.start:.4g}" if np.isfinite(free.start) else "-"
        rows.append([free.name, f"{free.span.low:g} to {free.span.high:g}", start, *cells])
    return rows


def _centers(spec: TuneSpec, findings: TuneFindings) -> list[list[str]]:
    """Row of each design: its patch centres [mm], which the free parameters do not show."""
    at, unmoved = findings.at, np.full(len(spec.free.numbers), np.nan)
    designs = [(REFERENCE, spec.moving[0]._replace(columns={}), unmoved)]
    for k, family in enumerate(spec.moving):
        place = at.best_place[at.winner(k)]
        designs.append((family.name, family, spec.free.values(place)))
    rows = []
    for name, family, values in designs:
        centers = 1e3 * patch_centers(spec, family, values)
        rows.append([name, *(", ".join(f"{x:.1f}" for x in row) for row in centers)])
    return rows


def is_kept(spec: TuneSpec, search: RandomSearch) -> np.ndarray:
    """Which random designs finish and keep all limits, (n,)."""
    loop = search.beyond_loop if spec.loop_limits else np.full(len(search.objective), -np.inf)
    return np.isfinite(search.objective) & (excess(search.limits) == 0) & (loop <= KEPT)


def _fidelity(spec: TuneSpec, findings: TuneFindings) -> dict[str, Any] | None:
    """Linear residual vibration compared with that of runs; None if there are too few."""
    kept = excess(findings.at.best_limits) == 0
    linear, residual = findings.linear[kept], findings.residual[kept]
    if findings.searched is not None:
        stable = findings.searched.beyond_loop <= KEPT
        linear = np.concatenate([linear, findings.searched.linear[stable]])
        residual = np.concatenate([residual, findings.searched.residual[stable]])
    is_known = np.isfinite(linear) & np.isfinite(residual) & (residual > 0)
    if is_known.sum() < 3:
        return None
    a, b = linear[is_known], residual[is_known]
    spread = float(b.max() / b.min() - 1)
    case = "few" if len(b) < FEW else "alike" if spread < NARROW else "ranked"
    low, median, high = np.percentile(a / b, [5, 50, 95])
    return {
        "designs": len(b),
        "low": low,
        "median": median,
        "high": high,
        "case": case,  # ranked, or why the order of designs is meaningless
        "spread": spread,
        "rank": rank_correlation(a, b),
    }


def _codes(judged: JudgedDesign) -> str:
    codes, counts = np.unique(judged.status, return_counts=True)
    pairs = zip(codes, counts, strict=True)
    return ", ".join(f"{count} {status.REASONS[int(code)]}" for code, count in pairs)
