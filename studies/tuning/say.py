"""What a tuning tells: what improved, on which machines, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from jaxmodel import status
from jaxmodel.loop_figures import MARGIN_MODES, MARGINS, PEAKS
from jaxmodel.metrics import METRICS
from studies.engine.fidelity import rank_correlation
from studies.engine.poles import HEADER, difference, pole_rows
from studies.show.listing import Rows
from studies.show.report import Chapter, Part, Report, chapter, drawing, machine
from studies.show.units import count_text, headed, is_cut_off, number, readable, settling_text
from studies.study.entries import links_text, parse_entries
from studies.study.margin import caution, margin_in_db, margin_text
from studies.study.spec import Study
from studies.study.template import toml_text
from studies.tuning import plots
from studies.tuning.audit import ALLOWED, MEANING
from studies.tuning.check import JudgedDesign, patch_centers, tuned_study
from studies.tuning.findings import TuneFindings, best_family, is_kept
from studies.tuning.free import PLACEMENT
from studies.tuning.loop_figures import (
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
#: What is said of a tuning whose machines do not differ.
NOMINAL = """All machines are nominal: `tune.scenarios` names nothing in which they differ, so these
figures say nothing of robustness."""


def say(findings: TuneFindings) -> Report:
    """What a tuning tells."""
    spec, folder = findings.spec, findings.folder
    best = spec.families[best_family(spec, findings)]
    file = f"{folder}/{file_name(spec, best)}" if folder else file_name(spec, best)
    return Report(
        title=f"{spec.study.title or 'untitled study'}: tuning",
        result=_result(findings),
        question=_question(findings),
        next_steps=f"""`studies simulate {file} --out run.h5 --report` for its trajectories,
        `studies certify {file} --out certificate` before it runs on a machine, `studies export
        {file} --target c --out dsp` for the controller.""",
        top=[machine(partial(_best_study, findings), "The best design is shown")],
        chapters=[
            _own_machine(findings),
            _fresh(findings),
            _changes(findings),
            _limits(findings),
            _parameters(findings),
            _random_search(findings),
            _fidelity(findings),
            _derivatives(findings),
        ],
        files={"Tuning file": toml_text(spec.data), "Study file": spec.study},
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


def file_name(spec: TuneSpec, family: Family) -> str:
    """File name of a family's study."""
    if len(spec.moving) == 1:
        return "tuned.toml"
    return f"tuned_{label(family.name)}.toml"


def _result(findings: TuneFindings) -> list[str]:
    """What improved, of each family as well, and what must be known beside it."""
    spec, references = findings.spec, findings.references
    loop = findings.judged[best_family(spec, findings)].loop
    least = min(x.objective.mean() for x in findings.judged[: len(spec.moving)])
    beaten = [name for name, x in references.designs if x.objective.mean() < least]
    warnings = [caution(loop.gain_margin)] if loop is not None else []
    warnings += [f"No tuned design is better than {name}." for name in beaten]
    designs = [design for _, design in _designs(findings)]
    warnings += resolution_lines(spec, designs, references.adc_step)
    lines = [family_line(findings, k) for k in range(len(spec.families))]
    if not spec.tune.scenarios.has_others:
        lines.append(NOMINAL)
    lines += reference_lines(spec, findings.baseline, references)
    return [_gains(findings), *(f"**{text}**" for text in warnings if text), *lines]


def family_line(findings: TuneFindings, k: int) -> str:
    """What the best design of a family achieves."""
    spec, design = findings.spec, findings.judged[k]
    loops = [
        f"{name} {worst_value(name, design.fresh_loop[name]):.4g}{_after(unit_text(name))}"
        for name in _judged_fresh(findings)
    ]
    limits = limit_states(findings, k) if k < len(spec.moving) else []
    stops = [name for name, state, _ in limits if state == "active"]
    is_lost = k < len(spec.moving) and findings.at.beyond(findings.at.winner(k)) > 0
    return (
        f"design {spec.families[k].name}: {design.objective.mean():.4f} of the baseline's "
        f"objective on {fresh_machines(spec)}"
        + (f", worst {design.objective.max():.4f}" if len(design.objective) > 1 else "")
        + (f"; on the worst of them {', '.join(loops)}" if loops else "")
        + ("; **a limit is violated**" if is_lost else "")
        + (f"; stopped by {' and '.join(stops)}" if stops else "")
    )


def _gains(findings: TuneFindings) -> str:
    """Figures of the design to recommend beside the baseline's, the worse ones last."""
    spec, k = findings.spec, best_family(findings.spec, findings)
    both = findings.judged[k], findings.baseline
    gains = []
    for name in dict.fromkeys((*spec.metric_terms, *SHOWN)):
        values = [float(x.own_run.metrics[name]) for x in both]
        texts = [_value(name, x.own_run.metrics, x.own_run.watched) for x in both]
        gains.append(_gain(name, values, texts, readable(_unit(name))[1]))
    loops = [x.loop for x in both if x.loop is not None]
    for name in ("gain_margin", *_of_loop(spec)) if len(loops) == len(both) else ():
        values = [float(getattr(x, name)) for x in loops]
        texts = [margin_in_db(x, 3) if name == "gain_margin" else f"{x:.3g}" for x in values]
        gains.append(_gain(name, values, texts, unit_text(name)))
    parts = (", ".join(text for is_worse, text in gains if is_worse == x) for x in (False, True))
    told = ", but ".join(filter(None, parts))
    return f"the best design is {spec.families[k].name}: {told} on the nominal machine"


def _gain(name: str, values: list[float], texts: list[str], unit: str) -> tuple[bool, str]:
    """Whether a figure of a design is worse than the baseline's, the second one; and both."""
    after, before = values
    is_worse = after < (1 - ALIKE) * before if name in LOWER else after > (1 + ALIKE) * before
    both = f"{' instead of '.join(texts)}{_after(unit)}"
    if not before or name == "gain_margin" or any(x.startswith("not") for x in texts):
        return is_worse, f"{name} {both}"
    return is_worse, f"{name} {_change(before, after, '.3g')} ({both})"


def _after(unit: str) -> str:
    """A unit as it stands after a number."""
    return "" if unit == "1" else f" {unit}"


def _question(findings: TuneFindings) -> str:
    spec, tune, at = findings.spec, findings.spec.tune, findings.at
    goals = [f"{'largest' if x in LOWER else 'least'} {x}" for x in tune.objective]
    if len(goals) > 1:
        weights = tune.objective.values()
        goals = [f"{x} (weight {weight:g})" for x, weight in zip(goals, weights, strict=True)]
    names_links = all(parse_entries(name).names_a_link for name in spec.metric_terms)
    links = "" if names_links else f" of {links_text(spec.counted_links, spec.study.n_links)}"
    limits = ", ".join(_bound(name, value) for name, value in tune.limits.items())
    lost = int(at.is_frozen.sum())
    frozen = f" {count_text(lost, 'starting point')} frozen." if lost else ""
    return f"""which design has the {", ".join(goals)}{links}{limits and f" with {limits}"}?
    {count_text(len(spec.free.numbers), "free parameter")} in
    {count_text(len(spec.moving), "family")}, {count_text(len(at.family), "starting point")},
    {count_text(tune.scenarios.count, "machine")} on {count_text(len(spec.moves), "move")}.
    {ended(spec, at)}{frozen}"""


def _bound(name: str, value: float | str) -> str:
    """A limit in words."""
    shown = "the baseline's" if isinstance(value, str) else f"{value:g}"
    return f"{name} {'at least' if name in LOWER else 'at most'} {shown}"


def _best_study(findings: TuneFindings) -> Study:
    spec, at, k = findings.spec, findings.at, best_family(findings.spec, findings)
    return tuned_study(spec, spec.families[k], spec.free.values(at.best_place[at.winner(k)]))


def _of_loop(spec: TuneSpec) -> list[str]:
    """Figures of the loop that are shown beside its gain margin, with those the tuning names."""
    named = (name for name in spec.loop_names if name in (*MARGINS, *PEAKS))
    return list(dict.fromkeys(("slowest_decay", "spillover", *spec.loop_terms, *named)))


def _judged_fresh(findings: TuneFindings) -> list[str]:
    """Figures of the loop that are judged on fresh machines."""
    return [name for name in findings.spec.loop_names if name in findings.baseline.fresh_loop]


def _heads(findings: TuneFindings, of_loop: list[str]) -> list[str]:
    """Headings of metrics and figures of the loop."""
    metrics = [headed(name, _unit(name)) for name in findings.baseline.metrics]
    return metrics + [headed(name.replace("_", " "), unit_text(name)) for name in of_loop]


def _designs(findings: TuneFindings) -> list[tuple[str, JudgedDesign]]:
    """The baseline, the best design of every family, what they have to beat; by name."""
    names = [family.name for family in findings.spec.families]
    judged = zip(names, findings.judged, strict=True)
    return [(REFERENCE, findings.baseline), *judged, *findings.references.designs]


def _unit(metric: str) -> str:
    return METRICS[parse_entries(metric).metric].unit


def _value(metric: str, values: Mapping[str, Any], watched: float) -> str:
    """A figure of one run as a report shows it."""
    value = float(values[metric])
    if metric.startswith("settling_time"):
        return settling_text(value, watched)
    return number(value, _unit(metric))


def _own_machine(findings: TuneFindings) -> Chapter | None:
    """Each design on the machine of its own file."""
    spec, designs, rows = findings.spec, _designs(findings), []
    files = ["study.toml", *(file_name(spec, family) for family in spec.moving)]
    for (name, design), file in zip(designs, files + ["-"] * len(designs), strict=False):
        own, loop = design.own_run, ["-" for _ in ("gain_margin", *_of_loop(spec))]
        if design.loop is not None:
            loop = [f"{getattr(design.loop, x):.4g}" for x in ("gain_margin", *_of_loop(spec))]
            loop[0] = margin_text(design.loop.gain_margin)
        cells = [_value(x, own.metrics, own.watched) for x in findings.baseline.metrics]
        rows.append([name, file, f"{own.objective:.4f}", *cells, *loop, status.REASONS[own.status]])
    heads = _heads(findings, ["gain_margin", *_of_loop(spec)])
    controlled = ", the controlled ones," if len(spec.counted_links) < spec.study.n_links else ""
    never = n_outside(findings.at)
    return chapter(
        "On the nominal machine",
        f"""Results of `studies simulate` for the file of each design. Of
        {links_text(spec.counted_links, spec.study.n_links)}{controlled} the largest value counts.
        The linearised loop has {max(MARGIN_MODES, spec.study.link.modes)} plant modes.""",
        Rows(["design", "file", "objective", *heads, "status"], rows),
        drawing(plots.descent, spec, findings),
        f"{count_text(never, 'starting point')} never kept the limits." if never else None,
    )


def _fresh(findings: TuneFindings) -> Chapter | None:
    """Each design on the worst of all fresh machines and moves."""
    scenarios, loops, rows = findings.spec.tune.scenarios, _judged_fresh(findings), []
    for name, design in _designs(findings):
        row = [name, f"{design.objective.mean():.4f}", f"{design.objective.max():.4f}"]
        for x in findings.baseline.metrics:
            k = int(np.argmax(np.nan_to_num(design.metrics[x], nan=-np.inf)))
            row.append(_value(x, {x: design.metrics[x][k]}, design.watched[k]))
        known = design.fresh_loop
        row += [f"{worst_value(x, known[x]):.4g}" if known else "-" for x in loops]
        codes = zip(*np.unique(design.status, return_counts=True), strict=True)
        ends = [f"{count} {status.REASONS[int(code)]}" for code, count in codes]
        rows.append([*row, ", ".join(ends)])
    heads = ["design", "objective, mean", "objective, worst", *_heads(findings, loops), "statuses"]
    which = "none of them used in the tuning (axis `scenario` of `tune.h5`)"
    if not scenarios.has_others:
        which = "each the nominal machine with its own noise"
    return chapter(
        "On fresh machines",
        f"""{count_text(scenarios.check, "machine")} for each move, {which}, with the real
        converters and limits. The largest value, of margins the least, of all of them.""",
        Rows(heads, rows),
    )


def _changes(findings: TuneFindings) -> Chapter | None:
    """Each design and move."""
    spec, baseline, rows = findings.spec, findings.baseline, []
    count = spec.tune.scenarios.check
    for name, design in _designs(findings)[1:]:
        for k, move in enumerate(spec.moves):
            part = slice(k * count, (k + 1) * count)
            changes = [_change_of(x, baseline, design, part) for x in baseline.metrics]
            objective = _change(1.0, design.objective[part].mean())
            rows.append([name, move_label(move) or "-", objective, *changes])
    return chapter(
        "Change relative to the baseline",
        "Of the mean over the fresh machines.",
        Rows(["design", "move", "objective", *baseline.metrics], rows),
        drawing(plots.gains, spec, findings),
    )


def _change_of(name: str, baseline: JudgedDesign, design: JudgedDesign, part: slice) -> str:
    """Change of the mean of a metric over some cases, unless a run ends before it settles."""
    before, after = (x.metrics[name][part] for x in (baseline, design))
    if name == "settling_time":
        for figures, who in ((design, ""), (baseline, "baseline ")):
            if np.any(is_cut_off(figures.metrics[name][part], figures.watched[part])):
                return f"{who}not settled"
    return _change(before.mean(), after.mean())


def _change(before: float, after: float, digits: str = ".1f") -> str:
    return f"{100 * (after / before - 1):+{digits}} %" if before else f"{after:.3g} (was 0)"


def _limits(findings: TuneFindings) -> Chapter | None:
    spec, machines = findings.spec, findings.spec.tune.scenarios
    if not spec.limit_names:
        return None
    rows = []
    for k, family in enumerate(spec.moving):
        for name, state, left in limit_states(findings, k):
            share = f"{100 * left:.2f} %" if np.isfinite(left) else "-"
            rows.append([family.name, _bound(name, family.limits[name]), state, share])
    where = "the nominal machine, the only one of the tuning"
    if machines.has_others and machines.count > 1:
        where = f"the worst of {machines.count} machines, the nominal one among them"
    front = None
    if spec.metric_limits:
        along = spec.front_limit or spec.metric_limits[0]
        front = drawing(plots.front, spec, findings, along)
    return chapter(
        "Limits on the scenarios of the tuning",
        f"Those of the loop: on {where}." if spec.loop_limits else None,
        Rows(["design", "limit", "state", "left"], rows),
        front,
    )


def limit_states(findings: TuneFindings, k: int) -> list[tuple[str, str, float]]:
    """Limits of a family on the scenarios of the tuning: name, state, what is left.

    The latter as a share, negative where the limit is violated, nan if not known.
    """
    spec, at, states = findings.spec, findings.at, []
    loop, baseline = findings.judged[k].tuned_loop, findings.baseline.tuned_loop
    for name, beyond in zip(spec.limit_names, at.best_limits[at.winner(k)], strict=True):
        left = -float(beyond)
        if name in LOOP_LIMITS:  # on the worst machine of the tuning
            is_known = name in loop and name in baseline
            limit = spec.moving[k].limits[name]
            left = np.nan
            if is_known:
                left = relative_margin(name, loop[name], allowed_on(limit, baseline[name]))
        state = "active" if left < NEAR else "kept" if np.isnan(left) else "inactive"
        states.append((name, "violated" if beyond > KEPT else state, left))
    return states


def _parameters(findings: TuneFindings) -> Chapter | None:
    spec, numbers = findings.spec, _numbers(findings)
    parts: list[Part] = [
        Rows(["parameter", "bounds", "baseline", *(x.name for x in spec.moving)], numbers),
        f"""*: at its bound; -: not moved; in brackets: the range over all starting points that end
        within {100 * ALIKE:g} % of the best; where it is wide, the parameter hardly matters.""",
    ]
    for name, design in _designs(findings):
        if design.poles is not None:
            parts.append(f"Poles of {name}: {difference(design.poles)}")
            parts.append(Rows(HEADER, pole_rows(design.poles)))
    if PLACEMENT in spec.tune.free:
        links = [f"centres on link {i + 1} [mm]" for i in range(spec.study.n_links)]
        parts.append(Rows(["design", *links], _centers(findings)))
    return chapter("Parameters", *parts if numbers else parts[2:])


def _numbers(findings: TuneFindings) -> list[list[str]]:
    """Row of each free parameter but those of the placement, which `_centers` shows in mm."""
    spec, at = findings.spec, findings.at
    families, rows = spec.moving, []
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


def _centers(findings: TuneFindings) -> list[list[str]]:
    """Row of each design: its patch centres [mm], which the free parameters do not show."""
    spec, at = findings.spec, findings.at
    plain, unmoved = spec.moving[0]._replace(columns={}), np.full(len(spec.free.numbers), np.nan)
    centers = {REFERENCE: patch_centers(spec, plain, unmoved)}
    for k, family in enumerate(spec.moving):
        place = at.best_place[at.winner(k)]
        centers[family.name] = patch_centers(spec, family, spec.free.values(place))
    return [
        [name, *(", ".join(f"{1e3 * x:.1f}" for x in row) for row in rows)]
        for name, rows in centers.items()
    ]


def _random_search(findings: TuneFindings) -> Chapter | None:
    spec, search, at = findings.spec, findings.searched, findings.at
    if search is None:
        return None
    main, cost = spec.families[spec.main].name, findings.run_time / search.run_time
    kept = search.objective[is_kept(spec, search)]
    best = f"; the best of them has objective {kept.min():.4f}" if len(kept) else ""
    return chapter(
        "Against random search",
        f"""{len(search.objective)} Sobol designs of {main}, {search.runs} runs: {len(kept)} keep
        all limits{best}; the tuned design has {at.best_objective[at.winner(spec.main)]:.4f} on the
        same scenarios.""",
        f"""All families together took {findings.runs} differentiated runs, each as costly as
        {cost:.2f} plain ones (measured): {findings.runs * cost:.0f} plain runs in all,
        {findings.runs * cost / len(spec.moving):.0f} for the family {main}.""",
    )


def _fidelity(findings: TuneFindings) -> Chapter | None:
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
    order = f"rank correlation {rank_correlation(a, b):.3f}"
    if len(b) < FEW:
        order = "too few to compare their order"
    elif spread < NARROW:
        order = f"too similar (within {100 * spread:.1f} %) to compare their order"
    low, median, high = np.percentile(a / b, [5, 50, 95])
    return chapter(
        "Linear fidelity",
        f"""Residual vibration of the linearised loop (H2 norm) over that of the run, for {len(b)}
        designs that keep the limits of their loop: median {median:.3f}, 90 % between {low:.3f} and
        {high:.3f}; {order}.""",
    )


def _derivatives(findings: TuneFindings) -> Chapter | None:
    spec, worst = findings.spec, max(findings.audited, key=lambda entry: entry.share)
    name = PLACEMENT if worst.name.startswith(PLACEMENT) else worst.name
    return chapter(
        "Derivatives",
        f"""Derivatives by {count_text(len(findings.audited), "number")} of {len(spec.free.names)},
        drawn at random, were compared with finite differences at the best design of
        {spec.families[spec.main].name} (`studies tune FILE --audit` compares all). The worst
        disagreement is {worst.share:.1e} (of {worst.figure} by {name}),
        {"below" if worst.share <= ALLOWED else "**above**"} {ALLOWED:g}. {MEANING}""",
    )
