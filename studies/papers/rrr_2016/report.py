"""Tables and page of the card."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from studies.papers.card import PaperCard, Verdict
from studies.papers.rrr_2016.claims import DECIDING
from studies.papers.rrr_2016.confirmation import FOLLOWED, PLUCK
from studies.papers.rrr_2016.coupling import DEFINITIONS, law, ratio_of
from studies.papers.rrr_2016.findings import LEVELS, WORKING, Effort, Kind
from studies.papers.rrr_2016.machines import RANGES, REACH
from studies.papers.rrr_2016.maps import STRONG
from studies.papers.rrr_2016.thresholds import CONFIDENCE
from studies.show.listing import Rows
from studies.show.pages import page
from studies.show.sketch import CAPTION
from studies.show.units import span
from studies.study.printed import TABLE_1

#: Structural damping ratios for which the largest mass ratio is told [1].
DAMPINGS = (0.001, 0.002, 0.005, 0.01)


def tables(kinds: dict[str, Kind], effort: Effort) -> dict[str, Rows]:
    """All tables, by name of their file."""
    return {
        "baselines": _baselines(kinds),
        "thresholds": _thresholds(kinds),
        "masses": _masses(kinds),
        "simulated": _simulated(kinds),
        "modes": _modes(kinds, effort),
        "machines": _machines(kinds),
        "maps": _maps(kinds),
    }


def report(
    card: PaperCard,
    verdicts: list[Verdict],
    kinds: dict[str, Kind],
    written: dict[str, Rows],
    images: Path | None = None,
) -> str:
    """The page.

    Args:
        card: of the paper.
        verdicts: on its claims.
        kinds: findings.
        written: from `tables`.
        images: folder with the figures; None: a page without.
    """
    found = [kind.sampled.thresholds[DECIDING] for kind in kinds.values()]
    printed = np.array(TABLE_1)[1:]
    changes = 100 * (printed[:, 3] / printed[:, 0] - 1)
    return page(
        "papers/rrr_2016/report.html",
        images,
        kinds["3-RRR"].study,
        card=card,
        verdicts=verdicts,
        kinds=kinds,
        tables=written,
        level=LEVELS[0],
        low=[one[0].low for one in found],
        middle=[one[0].middle for one in found],
        deciding_ratio=ratio_of(LEVELS[0]),
        shares={
            name: float(np.mean(kind.sampled.reduction[DECIDING] >= LEVELS[0]))
            for name, kind in kinds.items()
        },
        printed=changes.tolist(),
        is_alike=bool(np.abs(changes).max() < 100 * LEVELS[0]),
        below={
            name: float(np.mean(kind.sampled.reduction[DECIDING] < law(kind.sampled.ratio)))
            for name, kind in kinds.items()
        },
        confidence=CONFIDENCE,
        ranges=RANGES,
        reach=REACH,
        working=WORKING,
        strong=STRONG,
        pluck=PLUCK,
        followed=FOLLOWED,
        dampings=DAMPINGS,
        sketch_caption=CAPTION,
    )


def _baselines(kinds: dict[str, Kind]) -> Rows:
    heads = [
        "machine",
        "coupling ratio, home [1]",
        "all poses [1]",
        "reduction of the others, home [%]",
        "all poses [%]",
        "of the controlled link [%]",
        "platform's place [%]",
        "platform's turn [%]",
    ]
    rows = []
    for name, kind in kinds.items():
        base = kind.baseline
        others, itself, platform = (100 * x for x in (base.others, base.itself, base.platform))
        rows.append(
            [
                name,
                f"{base.ratio[0]:.3f}",
                span(base.ratio),
                f"{others[0]:.3f}",
                span(others, ".2g"),
                span(itself),
                span(platform[:, 0]),
                span(platform[:, 1]),
            ]
        )
    return Rows(heads, rows)


def _thresholds(kinds: dict[str, Kind]) -> Rows:
    heads = [
        "machine",
        "what calms means",
        "reduction [%]",
        f"{100 * CONFIDENCE:g} % of machines stay below, up to a coupling ratio of [1]",
        "half of them, up to [1]",
        "standard error [1]",
        f"{100 * CONFIDENCE:g} % exceed it, from here on [1]",
        "law [1]",
    ]
    rows = [
        [
            name,
            definition,
            f"{100 * one.reduction:g}",
            *(_known(x) for x in (one.low, one.middle, one.error, one.high)),
            f"{ratio_of(one.reduction):.3f}",
        ]
        for name, kind in kinds.items()
        for definition, found in kind.sampled.thresholds.items()
        for one in found
    ]
    return Rows(heads, rows)


def _known(value: float) -> str:
    return f"{value:.3f}" if np.isfinite(value) else "not in the sample"


def _masses(kinds: dict[str, Kind]) -> Rows:
    """Largest mass ratio at which the level is reached, over all drives: pose by pose."""
    heads = ["machine", "control", *(f"damping ratio {x:g}" for x in DAMPINGS)]
    rows = [
        [name, text, *(_largest_mass(chart.damping, chart.mass_ratio, x) for x in DAMPINGS)]
        for name, kind in kinds.items()
        for text, chart in (("strong", kind.strong), ("best", kind.best))
    ]
    return Rows(heads, rows)


def _largest_mass(damping: np.ndarray, mass_ratio: np.ndarray, least: float) -> str:
    """Interval over poses of the mass ratio, interpolated on its logarithm."""
    is_feasible = np.isfinite(damping).all(axis=(0, 1))
    greatest = damping[:, :, is_feasible].max(axis=0)  # of all drives, by mass and pose
    found = [_falls_below(mass_ratio, one, least) for one in greatest.T]
    known = [x for x in found if x > 0]
    if not known:
        return "at no mass ratio"
    text = f"up to {span(known, '.2g')}"
    return text if len(known) == len(found) else f"{text}; at {len(known)} of {len(found)} poses"


def _falls_below(mass_ratio: np.ndarray, greatest: np.ndarray, least: float) -> float:
    """Mass ratio up to which the greatest damping is at least this; 0: nowhere."""
    above = np.flatnonzero(greatest >= least)
    if not above.size:
        return 0.0
    k = int(above[-1])
    if k + 1 == len(mass_ratio) or greatest[k + 1] <= 0:
        return float(mass_ratio[k])
    pair = np.log(greatest[k : k + 2])
    share = (pair[0] - np.log(least)) / (pair[0] - pair[1])
    return float(np.exp(np.interp(share, [0, 1], np.log(mass_ratio[k : k + 2]))))


def _simulated(kinds: dict[str, Kind]) -> Rows:
    heads = [
        "machine",
        "structural damping [1]",
        "coupling ratio from link 1, linear [1]",
        "simulated [1]",
        "reduction of links 1, 2, 3, linear [%]",
        "simulated [%]",
    ]
    rows = []
    for name, kind in kinds.items():
        damping = kind.sampled.machines.columns["link.damping_ratio"][kind.sampled.row]
        for k, one in kind.confirmed:
            rows.append(
                [
                    name,
                    f"{damping[k]:.4f}",
                    f"{one.linear_ratio:.4f}",
                    f"{one.simulated_ratio:.4f}",
                    ", ".join(f"{100 * x:.1f}" for x in one.linear),
                    ", ".join(f"{100 * x:.1f}" for x in one.simulated),
                ]
            )
    return Rows(heads, rows)


def _modes(kinds: dict[str, Kind], effort: Effort) -> Rows:
    heads = ["machine", "modes per link", "coupling ratio [1]", "reduction of the others [%]"]
    rows = [
        [name, str(modes), f"{ratio:.6f}", f"{100 * others:.6f}"]
        for name, kind in kinds.items()
        for modes, (ratio, others) in zip(effort.modes, kind.baseline.converged, strict=True)
    ]
    return Rows(heads, rows)


def _machines(kinds: dict[str, Kind]) -> Rows:
    """Every machine of the samples."""
    columns = ("link.width", "machine.platform_mass", "drive.kp", "link.damping_ratio")
    heads = ["machine", *columns, "coupling ratio", *DEFINITIONS]
    rows = []
    for name, kind in kinds.items():
        sampled = kind.sampled
        values = [sampled.machines.columns[column][sampled.row] for column in columns]
        values += [sampled.ratio, *sampled.reduction.values()]
        rows += [[name, *(f"{x:.6g}" for x in row)] for row in zip(*values, strict=True)]
    return Rows(heads, rows)


def _maps(kinds: dict[str, Kind]) -> Rows:
    heads = [
        "machine",
        "control",
        "drive over link frequency [1]",
        "platform over link mass [1]",
        "pose",
        "greatest damping ratio [1]",
    ]
    rows = [
        [
            name,
            text,
            f"{chart.drive_ratio[i]:.6g}",
            f"{chart.mass_ratio[j]:.6g}",
            str(pose + 1),
            f"{chart.damping[i, j, pose]:.6g}",
        ]
        for name, kind in kinds.items()
        for text, chart in (("strong", kind.strong), ("best", kind.best))
        for i, j, pose in np.ndindex(chart.damping.shape)
    ]
    return Rows(heads, rows)
