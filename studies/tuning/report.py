"""The report of a tuning: what was gained, on which machines, and what limits it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.show.markdown import literal, opening, picture, table
from studies.show.sketch import CAPTION
from studies.show.units import count_text, headed, number, readable
from studies.study.entries import links_text, parse_entries
from studies.study.margin import MARGIN_MODES, caution, margin_text
from studies.tuning.audit import ALLOWED, MEANING, Disagreement
from studies.tuning.check import Judged, Searched, patch_centers
from studies.tuning.free import PLACEMENT
from studies.tuning.merit import SHOWN
from studies.tuning.optimise import GAIN, KEPT, PATIENCE, Progress, excess
from studies.tuning.scenarios import move_label
from studies.tuning.spec import LOOP_LIMITS, OWN, Family, TuneSpec, label

#: Limits that hold from below.
LOWER = ("gain_margin", "slowest_decay", "singularity_distance")
#: Settling times this near to the end of the run have not settled [s].
NEARLY = 2e-4
#: A limit nearer than this share counts as active.
NEAR = 0.02
#: Starts that end within this share of the best one count as equally good.
ALIKE = 0.01
#: Fewer designs, or such with less between the smallest and the largest, have no rank to speak of.
FEW, NARROW = 8, 0.05


class Findings(NamedTuple):
    """Everything that a tuning found."""

    at: Progress
    own: Judged  # the study itself
    judged: list[Judged]  # the best design of every family, in the order of `spec.families`
    audited: list[Disagreement]  # at the best design of the family with most free numbers
    linear: np.ndarray  # linear residual vibration of each start's best design [m], (B,)
    residual: np.ndarray  # of its own run on the first scenario [m], (B,); nan if not judged by it
    searched: Searched | None
    run_time: float  # of a differentiated run [s]
    runs: int  # how many there were


def report(spec: TuneSpec, found: Findings) -> str:
    """Markdown text.

    Args:
        spec: of the tuning.
        found: what it found.
    """
    lines = [f"# {literal(spec.study.title) or 'study'}: tuning", ""]
    lines += [
        *opening(_asked(spec, found), _came_out(spec, found), _next(spec, found)),
        picture("machine.png", f"{CAPTION}. Of the best design"),
        "",
        *_own_machine(spec, found),
        *_fresh(spec, found),
        *_by_move(spec, found),
        *_limits(spec, found),
        *_numbers(spec, found),
        *_search(spec, found),
        *_fidelity(spec, found),
        "## Derivatives",
        "",
    ]
    worst = max(found.audited, key=lambda entry: entry.share)
    place = ("half way to the best design", "at the best design")[worst.place]
    verdict = "below" if worst.share <= ALLOWED else "**above**"
    lines.append(
        f"Against differences at the best design of {spec.families[spec.main].name} and half way "
        f"to it the worst disagreement is {worst.share:.1e}, of {worst.figure} by {worst.name} "
        f"{place}, {verdict} {ALLOWED:g}. {MEANING}"
    )
    return "\n".join(lines) + "\n"


def _asked(spec: TuneSpec, found: Findings) -> str:
    goals = ", ".join(
        name if len(spec.tune.objective) == 1 else f"{name} (weight {weight:g})"
        for name, weight in spec.tune.objective.items()
    )
    limits = [
        f"{name} {'at least' if name in LOWER else 'at most'} "
        + ("the study's own" if limit == OWN else f"{limit:g}")
        for name, limit in spec.tune.limits.items()
    ]
    at, scenarios = found.at, spec.tune.scenarios
    return (
        f"the least {goals}{_of_links(spec)}"
        + (f" with {', '.join(limits)}" if limits else "")
        + f"; {count_text(len(spec.free.numbers), 'free number')} in "
        f"{count_text(len(spec.moving), 'family')}, {count_text(len(at.family), 'start')}, "
        f"{count_text(scenarios.count, 'machine')} on {count_text(len(spec.moves), 'move')}. "
        f"{ended(spec, at)}"
        + (f" {at.is_frozen.sum()} starts were frozen." if at.is_frozen.any() else "")
    )


def _of_links(spec: TuneSpec) -> str:
    if all(parse_entries(name).names_a_link for name in spec.tune.objective):
        return ""
    return f" of {links_text(spec.counted_links)}"


def ended(spec: TuneSpec, at: Progress) -> str:
    """Why a tuning ended, in a sentence."""
    done, asked = int(at.iteration), spec.tune.iterations
    if done < asked:
        return (
            f"Ended after {done} of {asked} iterations: for {PATIENCE} no family had gained "
            f"{100 * GAIN:g} %."
        )
    return f"Ended after all {asked} iterations ({spec.tune.method})."


def _came_out(spec: TuneSpec, found: Findings) -> str:
    """The best family in numbers, before and after."""
    k = best_family(spec, found)
    one, own, name = found.judged[k], found.own, spec.families[k].name
    told = []
    for metric in (*spec.tune.objective, *(x for x in SHOWN if x not in spec.tune.objective)):
        before, after = (_value(metric, x.own.metrics, x.own.watched) for x in (own, one))
        told.append(f"{metric} {after} instead of {before} {_unit(metric)}".strip())
    if one.loop is not None and own.loop is not None:
        told.append(f"gain margin {one.loop.gain_margin:.3g} instead of {own.loop.gain_margin:.3g}")
    machines = count_text(spec.tune.scenarios.check, "fresh machine")
    text = (
        f"{name}: {', '.join(told)} on the study's own machine; on {machines} "
        f"{one.objective.mean():.3g} of the objective, {one.objective.max():.3g} on the worst."
    )
    warnings = [caution(one.loop.gain_margin)] if one.loop is not None else []
    if found.at.beyond(found.at.winner(k)) > 0:
        warnings.append("A limit is violated.")
    return " ".join([text, *(f"**{warning}**" for warning in warnings if warning)])


def best_family(spec: TuneSpec, found: Findings) -> int:
    """Position of the family to recommend: limits kept first, then the least objective."""

    def rank(k: int) -> tuple:
        is_moving = k < len(spec.moving)
        beyond = found.at.beyond(found.at.winner(k)) if is_moving else 0.0
        value = found.judged[k].objective.mean()
        return beyond > 0, not np.isfinite(value), value

    return min(range(len(spec.moving)), key=rank)


def _next(spec: TuneSpec, found: Findings) -> str:
    file = file_name(spec, spec.families[best_family(spec, found)])
    return (
        f"`studies simulate {file} --out run.h5 --report` for its trajectories, `studies spillover "
        f"{file} --out certificate` before it meets a machine, `studies export {file} --target c "
        "--out dsp` to take it there."
    )


def file_name(spec: TuneSpec, family: Family) -> str:
    """Of the study that a family gives."""
    if len(spec.moving) == 1:
        return "tuned.toml"
    return f"tuned_{label(family.name)}.toml"


def summary(spec: TuneSpec, found: Findings) -> list[str]:
    """What was gained, a line for each family."""
    machines = count_text(spec.tune.scenarios.check, "fresh machine")
    lines = []
    for k, (family, one) in enumerate(zip(spec.families, found.judged, strict=True)):
        is_moving = k < len(spec.moving)
        lost = is_moving and found.at.beyond(found.at.winner(k)) > 0
        lines.append(
            f"{family.name}: {one.objective.mean():.4f} of the study's objective on {machines}"
            + (f", worst {one.objective.max():.4f}" if len(one.objective) > 1 else "")
            + ("; a limit is violated" if lost else "")
        )
    return lines


def _rows(spec: TuneSpec, found: Findings) -> list[tuple[str, Judged]]:
    pairs = zip(spec.families, found.judged, strict=True)
    return [("the study itself", found.own), *((family.name, one) for family, one in pairs)]


def _unit(metric: str) -> str:
    unit = readable(METRICS[parse_entries(metric).metric].unit)[1]
    return "" if unit == "1" else unit


def _value(metric: str, values: Mapping[str, Any], watched: float) -> str:
    """A figure of one run as a report shows it."""
    value = float(values[metric])
    unit = METRICS[parse_entries(metric).metric].unit
    if metric.startswith("settling_time") and value >= watched - NEARLY > 0:
        return f"not within {number(watched, unit)}"
    return number(value, unit)


def _columns(spec: TuneSpec, found: Findings) -> tuple[list[str], list[str]]:
    """Metrics that tables show, and their heads."""
    names = list(found.own.metrics)
    return names, [headed(x, METRICS[parse_entries(x).metric].unit) for x in names]


def _own_machine(spec: TuneSpec, found: Findings) -> list[str]:
    names, heads = _columns(spec, found)
    modes = max(MARGIN_MODES, spec.study.link.modes)
    rows = []
    files = ["study.toml", *(file_name(spec, x) for x in spec.moving)]
    for k, (name, one) in enumerate(_rows(spec, found)):
        cells = [_value(metric, one.own.metrics, one.own.watched) for metric in names]
        loop = ["-"] * 3
        if one.loop is not None:
            loop = [
                margin_text(one.loop.gain_margin),
                f"{one.loop.slowest_decay:.4g}",
                f"{one.loop.spillover:.4g}",
            ]
        file = f"`{files[k]}`" if k < len(files) else "-"
        rows.append(
            [name, file, f"{one.own.objective:.4f}", *cells, *loop, status.REASONS[one.own.status]]
        )
    return [
        "## On the study's own machine",
        "",
        "What `studies simulate` gives for the file of each design, with the real converters and "
        f"limits. Of {links_text(spec.counted_links)}"
        + (", those under control, " if len(spec.counted_links) < 3 else " ")
        + "the largest value counts: peaks are the highest peak, an rms that of the worst link and "
        f"station, a time that of the slowest link. {_weighing(spec)} Gain margin, slowest decay "
        f"and spillover are those of the linearised loop with {modes} plant modes.",
        "",
        *table(
            (
                "design",
                "file",
                "objective",
                *heads,
                "gain margin",
                "slowest decay [1/s]",
                "spillover",
                "status",
            ),
            rows,
        ),
        "",
        picture(
            "descent.png",
            "Best objective that keeps the limits, over iterations, on the machines "
            "of the tuning; thin: every start",
        ),
        "",
    ]


def _weighing(spec: TuneSpec) -> str:
    count = len(spec.tune.objective)
    whole = "the weighted mean of these shares; " if count > 1 else ""
    return (
        "Objective: " + whole + f"the root of the mean square of all entries of "
        f"{' or '.join(spec.tune.objective)} (links, stations) over that of the study itself, so "
        "1 is the study."
    )


def _machines(spec: TuneSpec) -> str:
    count = count_text(spec.tune.scenarios.check, "machine")
    if not spec.tune.scenarios.spread:
        return (
            f"{count} for each move with noise of their own, the real converters and limits; "
            "`tune.scenarios.spread` is empty, so all are the study's own machine."
        )
    return (
        f"{count} for each move, none of which the tuning has seen (`scenario_...` in `tune.h5`), "
        "with the real converters and limits."
    )


def _fresh(spec: TuneSpec, found: Findings) -> list[str]:
    names, heads = _columns(spec, found)
    rows = []
    for name, one in _rows(spec, found):
        worst = [int(np.argmax(np.nan_to_num(one.metrics[x], nan=-np.inf))) for x in names]
        cells = [
            _value(x, {x: one.metrics[x][k]}, one.watched[k])
            for x, k in zip(names, worst, strict=True)
        ]
        rows.append(
            [name, f"{one.objective.mean():.4f}", f"{one.objective.max():.4f}", *cells, _codes(one)]
        )
    return [
        "## On fresh machines",
        "",
        f"{_machines(spec)} Metrics: the largest value as above, on the worst of all machines and "
        "moves.",
        "",
        *table(("design", "objective, mean", "objective, worst", *heads, "statuses"), rows),
        "",
    ]


def _by_move(spec: TuneSpec, found: Findings) -> list[str]:
    """Change of every figure on each move, mean of the fresh machines."""
    count = spec.tune.scenarios.check
    lines = [
        "## Change against the study itself",
        "",
        "Of the mean over the fresh machines.",
        "",
    ]
    names = list(found.own.metrics)
    lines += ["| design | move | objective | " + " | ".join(names) + " |"]
    lines += ["|---" * (len(names) + 3) + "|"]
    for name, one in _rows(spec, found)[1:]:
        for k, move in enumerate(spec.moves):
            part = slice(k * count, (k + 1) * count)
            changes = [_change(1.0, one.objective[part].mean())]
            changes += [
                _change(found.own.metrics[x][part].mean(), one.metrics[x][part].mean())
                for x in names
            ]
            lines.append(f"| {name} | {move_label(move) or '-'} | " + " | ".join(changes) + " |")
    return [*lines, "", picture("gains.png", "Objective on each fresh machine, by move"), ""]


def _change(before: float, after: float) -> str:
    return f"{100 * (after / before - 1):+.1f} %" if before else f"{after:.3g} (was 0)"


def _limits(spec: TuneSpec, found: Findings) -> list[str]:
    if not spec.limit_names:
        return []
    lines = ["## Limits on the scenarios of the tuning", ""]
    for k, family in enumerate(spec.moving):
        excesses = found.at.best_limits[found.at.winner(k)]
        told = []
        for name, beyond in zip(spec.limit_names, excesses, strict=True):
            limit = family.limits[name]
            margin = _loop_margin(found, k, name, limit) if name in LOOP_LIMITS else -float(beyond)
            wanted = "of the study" if limit == OWN else f"{limit:g}"
            told.append(f"{name} {wanted} {_told(float(beyond), margin)}")
        lines.append(f"- {family.name}: " + "; ".join(told))
    if spec.metric_limits:
        limit = spec.tune.pareto.get("limit", spec.metric_limits[0])
        lines += [
            "",
            picture(
                "front.png", f"Objective over {limit}: random designs, tuned ones, the study itself"
            ),
        ]
    return [*lines, ""]


def _loop_margin(found: Findings, k: int, name: str, limit: float | str) -> float:
    """How far a figure of the loop is from its limit, as a share of it; nan if not known."""
    loop, own = found.judged[k].loop, found.own.loop
    if loop is None or own is None:
        return float("nan")
    allowed = getattr(own, name) if limit == OWN else float(limit)
    margin = getattr(loop, name) / allowed - 1
    return -margin if name == "spillover" else margin


def _told(beyond: float, margin: float) -> str:
    if beyond > KEPT:
        return "**violated**" + (f" by {-100 * margin:.2f} %" if np.isfinite(margin) else "")
    if np.isnan(margin):
        return "kept"
    return ("active" if margin < NEAR else "not active") + f", {100 * margin:.2f} % left"


def _numbers(spec: TuneSpec, found: Findings) -> list[str]:
    heads = [family.name for family in spec.moving]
    lines = ["## Numbers", "", "| free number | bounds | study | " + " | ".join(heads) + " |"]
    lines += ["|---" * (len(heads) + 3) + "|"]
    at = found.at
    places = [at.best_place[at.winner(k)] for k in range(len(heads))]
    alike = [at.best_place[_alike(at, k)] for k in range(len(heads))]
    for n, free in enumerate(spec.free.numbers):
        start = f"{free.start:.4g}" if np.isfinite(free.start) else "-"
        cells = []
        for k, family in enumerate(spec.moving):
            value = spec.free.values(places[k])[n]
            low, high = (spec.free.values(x)[n] for x in (alike[k].min(0), alike[k].max(0)))
            mark = "*" if places[k][n] in (0.0, 1.0) else ""
            span = f" ({low:.3g}..{high:.3g})" if len(alike[k]) > 1 else ""
            cells.append(f"{value:.4g}{mark}{span}" if family.is_free[n] else "-")
        bounds = f"{free.span.low:g} to {free.span.high:g}"
        lines.append(f"| {free.name} | {bounds} | {start} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "`*`: at its bound; `-`: not moved; in brackets the range of all starts that end within "
        f"{100 * ALIKE:g} % of the best, where there are several: a wide one means that the number "
        "hardly matters there.",
        "",
    ]
    return lines + (_centers(spec, places) if PLACEMENT in spec.tune.free else [])


def _centers(spec: TuneSpec, places: list[np.ndarray]) -> list[str]:
    """Where the patches are, which shares of the room that is left do not tell."""
    lines = []
    own = spec.moving[0]._replace(columns={}), np.full(len(spec.free.numbers), np.nan)
    designs = [("the study itself", *own)]
    for family, place in zip(spec.moving, places, strict=True):
        designs.append((family.name, family, spec.free.values(place)))
    for name, family, values in designs:
        centers = 1e3 * patch_centers(spec, family, values)
        cells = [", ".join(f"{x:.1f}" for x in row) for row in centers]
        lines.append([name, *cells])
    heads = [f"centres on link {i + 1} [mm]" for i in range(3)]
    return [*table(("design", *heads), lines), ""]


def _alike(at: Progress, family: int) -> np.ndarray:
    """Starts of a family that end as good as its best one, or nearly."""
    best = at.winner(family)
    is_near = at.best_objective <= (1 + ALIKE) * at.best_objective[best]
    is_kept = excess(at.best_limits) <= at.beyond(best)
    return np.flatnonzero((at.family == family) & is_near & is_kept)


def _search(spec: TuneSpec, found: Findings) -> list[str]:
    seen = found.searched
    if seen is None:
        return []
    main = spec.families[spec.main]
    order = np.argsort(np.where(is_kept(spec, seen), seen.objective, np.inf))
    best, count = int(order[0]), int(is_kept(spec, seen).sum())
    cost = found.run_time / seen.run_time
    tuned = found.at.best_objective[found.at.winner(spec.main)]
    lines = [
        "## Against random search",
        "",
        f"{len(seen.objective)} Sobol designs of {main.name}, {seen.runs} runs: {count} keep all "
        "limits"
        + (f", the best of them has objective {seen.objective[best]:.4f}" if count else "")
        + f"; the tuned design has {tuned:.4f} on the same scenarios.",
        "",
        f"All families together took {found.runs} differentiated runs, each at the cost of "
        f"{cost:.2f} plain ones (measured): {found.runs * cost:.0f} in all, "
        f"{found.runs * cost / len(spec.moving):.0f} for {main.name}.",
        "",
    ]
    return lines


def is_kept(spec: TuneSpec, seen: Searched) -> np.ndarray:
    """Which random designs finish and keep all limits, (n,)."""
    loop = seen.beyond_loop if spec.loop_limits else np.full(len(seen.objective), -np.inf)
    return np.isfinite(seen.objective) & (excess(seen.limits) == 0) & (loop <= KEPT)


def _fidelity(spec: TuneSpec, found: Findings) -> list[str]:
    kept = excess(found.at.best_limits) == 0
    linear, residual = found.linear[kept], found.residual[kept]
    if found.searched is not None:
        stable = found.searched.beyond_loop <= KEPT
        linear = np.concatenate([linear, found.searched.linear[stable]])
        residual = np.concatenate([residual, found.searched.residual[stable]])
    is_known = np.isfinite(linear) & np.isfinite(residual) & (residual > 0)
    if is_known.sum() < 3:
        return []
    a, b = linear[is_known], residual[is_known]
    ratio = np.percentile(a / b, [5, 50, 95])
    spread = b.max() / b.min() - 1
    rank = f"rank correlation {rank_correlation(a, b):.3f}"
    if len(b) < FEW:
        rank = "too few to compare their order"
    elif spread < NARROW:
        rank = f"too much alike ({100 * spread:.1f} %) to compare their order"
    return [
        "## Linear fidelity",
        "",
        f"Residual vibration of the linearised loop (H2 norm) over that of the run, {len(a)} "
        f"designs that keep the limits of their loop: median {ratio[1]:.3f}, 90 % between "
        f"{ratio[0]:.3f} and {ratio[2]:.3f}; {rank}.",
        "",
    ]


def rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's coefficient [1]."""
    rank = [np.argsort(np.argsort(x)).astype(float) for x in (a, b)]
    return float(np.corrcoef(rank[0], rank[1])[0, 1])


def _codes(judged: Judged) -> str:
    codes, counts = np.unique(judged.status, return_counts=True)
    pairs = zip(codes, counts, strict=True)
    return ", ".join(f"{count} {status.REASONS[int(code)]}" for code, count in pairs)


def unkept(spec: TuneSpec, at: Progress) -> list[str]:
    """What no start of a family keeps, one line for each family; empty where all is well."""
    lines = []
    for k, family in enumerate(spec.moving):
        if at.beyond(at.winner(k)) == 0:
            continue
        lines.append(f"{family.name}: {_contradiction(spec, family, at.least[k])}")
    return lines


def _contradiction(spec: TuneSpec, family: Family, values: np.ndarray) -> str:
    least = dict(zip(spec.limit_names, values, strict=True))
    never = [name for name, value in least.items() if value > KEPT]
    if never:
        return ", ".join(
            f"{name} = {family.limits[name]} is kept by no design"
            + ("" if name in LOOP_LIMITS else f" (nearest {100 * least[name]:+.1f} %)")
            for name in never
        )
    return " and ".join(f"{name} = {family.limits[name]}" for name in spec.limit_names) + (
        " are kept by some design each, but by none together"
    )
