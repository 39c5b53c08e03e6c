"""The report of a tuning: what was gained, on which machines, and what limits it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from studies.tuning.audit import Disagreement
from studies.tuning.check import Judged, Searched
from studies.tuning.optimise import KEPT, Progress, excess
from studies.tuning.scenarios import move_label
from studies.tuning.spec import LOOP_LIMITS, OWN, Family, TuneSpec

#: A limit nearer than this share counts as active.
NEAR = 0.02


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
    at = found.at
    lines = [f"# {spec.study.title}: tuning", ""]
    lines += [
        f"{len(at.family)} starts of {len(spec.moving)} families, {int(at.iteration)} iterations "
        f"({spec.tune.method}), {spec.tune.scenarios.count} machines on {len(spec.moves)} moves"
        + (f"; {at.is_frozen.sum()} starts were frozen." if at.is_frozen.any() else "."), "",
        *_summary(spec, found), *_by_move(spec, found), *_limits(spec, found),
        *_numbers(spec, found), *_search(spec, found), *_fidelity(spec, found),
        "## Derivatives", "",
    ]  # fmt: skip
    worst = max(found.audited, key=lambda entry: entry.share)
    lines.append(
        f"Against central differences at the best design of {spec.families[spec.main].name} and "
        f"half way to it the worst disagreement is {worst.share:.1e}, of {worst.figure} by "
        f"{worst.name} ({worst.derivative:.4g} against {worst.difference:.4g})."
    )
    return "\n".join(lines) + "\n"


def _rows(spec: TuneSpec, found: Findings) -> list[tuple[str, Judged]]:
    pairs = zip(spec.families, found.judged, strict=True)
    return [("the study itself", found.own), *((family.name, one) for family, one in pairs)]


def _summary(spec: TuneSpec, found: Findings) -> list[str]:
    names = list(found.own.metrics)
    lines = [
        f"On {spec.tune.scenarios.check} machines for each move that the tuning has not seen, with "
        "the real converters and limits (objective relative to the study itself, metrics the worst "
        "of all scenarios, figures of the loop on 12 plant modes or more):", "",
        "| design | objective | worst | " + " | ".join(names) + " | gain margin | slowest decay | "
        "spillover | statuses |", "|---" * (len(names) + 7) + "|",
    ]  # fmt: skip
    for name, one in _rows(spec, found):
        loop = "- | - | -"
        if one.loop is not None:
            loop = (
                f"{one.loop.gain_margin:.4g} | {one.loop.slowest_decay:.4g} 1/s | "
                f"{one.loop.spillover:.4g}"
            )
        metrics = " | ".join(f"{one.metrics[metric].max():.4g}" for metric in names)
        lines.append(
            f"| {name} | {one.objective.mean():.4f} | {one.objective.max():.4f} | {metrics} | "
            f"{loop} | {_codes(one)} |"
        )
    return [*lines, ""]


def _by_move(spec: TuneSpec, found: Findings) -> list[str]:
    """Change of every figure on each move, mean of the fresh machines."""
    lines, count = ["## Change against the study itself", ""], spec.tune.scenarios.check
    names = list(found.own.metrics)
    lines += ["| design | move | objective | " + " | ".join(names) + " |"]
    lines += ["|---" * (len(names) + 3) + "|"]
    for name, one in _rows(spec, found)[1:]:
        for k, move in enumerate(spec.moves):
            part = slice(k * count, (k + 1) * count)
            changes = [_change(1.0, one.objective[part].mean() / sum(spec.tune.objective.values()))]
            changes += [
                _change(found.own.metrics[x][part].mean(), one.metrics[x][part].mean())
                for x in names
            ]
            lines.append(f"| {name} | {move_label(move) or '-'} | " + " | ".join(changes) + " |")
    return [*lines, ""]


def _change(before: float, after: float) -> str:
    return f"{100 * (after / before - 1):+.1f} %" if before else f"{after:.3g} (was 0)"


def _limits(spec: TuneSpec, found: Findings) -> list[str]:
    if not spec.limit_names:
        return []
    lines = ["## Limits on the scenarios of the tuning", ""]
    for k, family in enumerate(spec.moving):
        limits = found.at.best_limits[found.at.winner(k)]
        told = [
            f"{name} {'of the study' if family.limits[name] == OWN else f'{family.limits[name]:g}'}"
            f" {_told(name, float(value))}"
            for name, value in zip(spec.limit_names, limits, strict=True)
        ]
        lines.append(f"- {family.name}: " + "; ".join(told))
    return [*lines, ""]


def _told(name: str, value: float) -> str:
    if value > KEPT:
        return "**violated**" + ("" if name in LOOP_LIMITS else f" by {100 * value:.2f} %")
    state = "active" if value > -NEAR else "not active"
    return state if name in LOOP_LIMITS else f"{state}, {-100 * value:.2f} % below it"


def _numbers(spec: TuneSpec, found: Findings) -> list[str]:
    heads = [family.name for family in spec.moving]
    lines = ["## Numbers", "", "| free number | bounds | study | " + " | ".join(heads) + " |"]
    lines += ["|---" * (len(heads) + 3) + "|"]
    places = [found.at.best_place[found.at.winner(k)] for k in range(len(heads))]
    values = [spec.free.values(place) for place in places]
    for n, free in enumerate(spec.free.numbers):
        start = f"{free.start:.4g}" if np.isfinite(free.start) else "-"
        cells = [
            f"{values[k][n]:.4g}" + ("*" if places[k][n] in (0.0, 1.0) else "")
            if family.is_free[n] else "-"
            for k, family in enumerate(spec.moving)
        ]  # fmt: skip
        bounds = f"{free.span.low:g} to {free.span.high:g}"
        lines.append(f"| {free.name} | {bounds} | {start} | " + " | ".join(cells) + " |")
    return [*lines, "", "`*`: at its bound; `-`: not moved.", ""]


def _search(spec: TuneSpec, found: Findings) -> list[str]:
    seen = found.searched
    if seen is None:
        return []
    main = spec.families[spec.main]
    order = np.argsort(np.where(is_kept(spec, seen), seen.objective, np.inf))
    best, count = int(order[0]), int(is_kept(spec, seen).sum())
    cost = found.run_time / (seen.time / seen.runs)
    tuned = found.at.best_objective[found.at.winner(spec.main)]
    lines = [
        "## Against random search", "",
        f"{len(seen.objective)} Sobol designs of {main.name}, {seen.runs} runs: {count} keep all "
        "limits" + (f", the best of them has objective {seen.objective[best]:.4f}" if count else "")
        + f"; the tuned design has {tuned:.4f} on the same scenarios.", "",
        f"All families together took {found.runs} differentiated runs, each at the cost of "
        f"{cost:.2f} plain ones (measured): {found.runs * cost:.0f} in all.", "",
    ]  # fmt: skip
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
    return [
        "## Linear fidelity", "",
        f"Residual vibration of the linearised loop (H2 norm) over that of the run, {len(a)} "
        f"designs that keep the limits of their loop: median {ratio[1]:.3f}, 90 % between "
        f"{ratio[0]:.3f} and {ratio[2]:.3f}; rank correlation {rank_correlation(a, b):.3f}.", "",
    ]  # fmt: skip


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
        if excess(at.best_limits[[at.winner(k)]])[0] == 0:
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
