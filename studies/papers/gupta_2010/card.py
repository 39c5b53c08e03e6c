"""The card: claims, tables and figure."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from matplotlib.figure import Figure

from studies.engine.batches import ProgressCallback
from studies.papers.card import CardResult, Claim, PaperCard, Verdict, outcome_of
from studies.papers.gupta_2010.closed_loop import LAW, MARGIN, MODES
from studies.papers.gupta_2010.criteria import ADDED, COUNTED, CRITERIA
from studies.papers.gupta_2010.findings import PlaceGrid, PlacementFindings, find
from studies.show import figures
from studies.show.listing import Rows
from studies.show.pages import page
from studies.show.sketch import CAPTION

#: A criterion chooses a good place if control there leaves at most this much more [1].
LOSS = 0.05
CLAIMS = tuple(
    Claim(
        f"The place with the largest value of a criterion, {name}, is the place for a pair.",
        "rms vibration that the best gain leaves there over that at the best place, minus 1 [1]",
        f"at most {LOSS:g}",
    )
    for name in CRITERIA
)
LEFT_OPEN = (
    "by how much a place may miss the best one",
    "delay, filters and sample rate of the loop, of which no criterion knows",
    "which modes count, and how much each",
    "how many pairs share a structure, and whether sensor and actuator are in one place",
)
GRID = PlaceGrid()


def judge(findings: PlacementFindings) -> list[Verdict]:
    """Outcomes of `CLAIMS`, in their order."""
    return [
        Verdict(
            claim,
            outcome_of(one.loss <= LOSS),
            f"loss {100 * one.loss:.1f} % at {1e3 * one.place:.0f} mm, "
            f"rank correlation {one.correlation:.2f}",
        )
        for claim, one in zip(CLAIMS, findings.ranks.values(), strict=True)
    ]


def evaluate(grid: PlaceGrid, on_progress: ProgressCallback) -> CardResult:
    """Run the study on a given grid."""
    findings = find(grid, on_progress)
    verdicts, tables = judge(findings), _tables(findings)

    def report(folder: Path) -> str:
        residual = findings.loops.residual
        return page(
            "papers/gupta_2010/report.html",
            folder,
            findings.study,
            card=CARD,
            verdicts=verdicts,
            tables=tables,
            good=[x for x, one in findings.ranks.items() if one.loss <= LOSS],
            bad=[x for x, one in findings.ranks.items() if one.loss > LOSS],
            best=1e3 * float(findings.loops.place[residual.argmin()]),
            least=float(residual.min()),
            closest=max(findings.ranks, key=lambda name: findings.ranks[name].correlation),
            loss=LOSS,
            law=LAW,
            margin=MARGIN,
            modes=MODES,
            counted=COUNTED,
            added=ADDED,
            sketch_caption=CAPTION,
        )

    return CardResult(
        study=findings.study,
        verdicts=verdicts,
        tables=tables,
        figures={"places": partial(draw, findings)},
        page=report,
    )


def _tables(findings: PlacementFindings) -> dict[str, Rows]:
    heads = [
        "criterion",
        "chooses [mm]",
        "rms left there over that without control [1]",
        "loss [%]",
        "rank correlation [1]",
    ]
    rows = [
        [
            name,
            f"{1e3 * one.place:.0f}",
            f"{one.residual:.3f}",
            f"{100 * one.loss:.1f}",
            f"{one.correlation:.2f}",
        ]
        for name, one in findings.ranks.items()
    ]
    values = [one.value for one in findings.ranks.values()]
    columns = zip(findings.loops.place, findings.loops.residual, *values, strict=True)
    places = [[f"{x:.6g}" for x in row] for row in columns]
    return {
        "criteria": Rows(heads, rows),
        "places": Rows(["place [m]", "rms left over that without control", *CRITERIA], places),
    }


def draw(findings: PlacementFindings) -> Figure:
    """What control removes and what the criteria say, over the place of the pair."""
    figure, axes = figures.new_figure(2, 1, 2.2)
    upper, lower = axes[:, 0]
    place = 1e3 * findings.loops.place
    upper.plot(place, 100 * (1 - findings.loops.residual), color="#000000")
    upper.set_ylabel("removed by control [%]")
    for k, (name, one) in enumerate(findings.ranks.items()):
        color = figures.SERIES[k % len(figures.SERIES)]
        style = figures.DASHES[(k + k // len(figures.SERIES)) % len(figures.DASHES)]
        lower.plot(place, one.value, color=color, linestyle=style, label=name)
    lower.set_ylabel("criterion over its largest [1]")
    lower.set_xlabel("centre of the pair [mm]")
    figures.legend_beside(lower)
    return figure


CARD = PaperCard(
    name="gupta_2010",
    title="do the usual criteria for the places of patches choose what the closed loop needs?",
    source=(
        "V. Gupta, M. Sharma and N. Thakur, Optimization criteria for optimal placement of "
        "piezoelectric sensors and actuators on a smart structure: a technical review, Journal of "
        "Intelligent Material Systems and Structures 21 (2010) 1227-1243, "
        "doi:10.1177/1045389X10381659"
    ),
    read=(
        "Read: the abstract, up to the fourth of the six criteria that it lists; observability and "
        "spillover complete the list as later work quotes it. Not read: the formulas, so that "
        "each criterion is the usual one of its name."
    ),
    claims=CLAIMS,
    left_open=LEFT_OPEN,
    work=GRID.steps,
    run=partial(evaluate, GRID),
)
