"""What the paper, and the one that contradicts it, claim about the coupling of links."""

from __future__ import annotations

import numpy as np

from studies.papers.card import FAILS, HOLDS, Claim, Verdict, depends_on, outcome_of
from studies.papers.rrr_2016.coupling import DEFINITIONS
from studies.papers.rrr_2016.findings import LEVELS, Kind
from studies.papers.rrr_2016.thresholds import CONFIDENCE, Threshold
from studies.show.units import span

#: Reduction that suppresses a link [1].
SUPPRESSED = 0.5
#: Reductions between which a platform is damped to some extent [1].
SOME = (0.05, 0.3)
#: The definition that decides.
DECIDING = next(iter(DEFINITIONS))
RATIO = "the coupling ratio"

CLAIMS = (
    Claim(
        "Control of one link suppresses the vibration of this link.",
        "reduction of its rms vibration after plucks of every link, both baselines, all poses [1]",
        f"at least {SUPPRESSED:g}",
    ),
    Claim(
        "Control of one link cannot suppress the vibration of the others.",
        "reduction of the others' rms vibration, mean of all pairs [1]",
        f"below {LEVELS[0]:g}",
    ),
    Claim(
        "Control of all three links suppresses the vibration of all.",
        "reduction of the rms vibration of each link, both baselines, all poses [1]",
        f"at least {SUPPRESSED:g}",
    ),
    Claim(
        "The other paper, zhang_2016: links are coupled, so that control of one changes the "
        "others.",
        "reduction of the others' rms vibration, mean of all pairs [1]",
        f"at least {LEVELS[1]:g}",
    ),
    Claim(
        "The other paper: control of one link damps the platform to some extent.",
        "reduction of place and turn of the platform, both baselines, all poses [1]",
        f"between {SOME[0]:g} and {SOME[1]:g}",
    ),
)
LEFT_OPEN = (
    "masses of platform, links, cranks and motors, and lengths (not in what could be read)",
    "stiffness of the motors' servo, on which it depends whether links can be coupled at all",
    "structural damping of the links, and how equal they are",
    "gain of the strain rate feedback: a link that is held too hard takes up less",
    "from which reduction on a link counts as suppressed, and the scatter of repeated runs",
    "the move, and whether strain is compared while moving or afterwards",
)


def judge(kinds: dict[str, Kind]) -> list[Verdict]:
    """Outcomes of `CLAIMS`, in their order."""
    itself = np.concatenate([kind.baseline.itself for kind in kinds.values()])
    every = np.concatenate([kind.baseline.every for kind in kinds.values()])
    platform = np.concatenate([kind.baseline.platform for kind in kinds.values()])
    is_some = bool(np.all((platform >= SOME[0]) & (platform <= SOME[1])))
    answers = (
        (outcome_of(bool(np.all(itself >= SUPPRESSED))), span(itself, ".2f")),
        (_outcome(kinds, 0, below=True), _baselines(kinds)),
        (outcome_of(bool(np.all(every >= SUPPRESSED))), span(every, ".2f")),
        (_outcome(kinds, 1, below=False), _baselines(kinds)),
        (outcome_of(is_some), span(platform, ".2f")),
    )
    return [
        Verdict(claim, outcome, found)
        for claim, (outcome, found) in zip(CLAIMS, answers, strict=True)
    ]


def _baselines(kinds: dict[str, Kind]) -> str:
    parts = []
    for name, kind in kinds.items():
        ratio, others = kind.baseline.ratio, kind.baseline.others
        numbers = f"ratio {span(ratio, '.2f')}, reduction {span(others, '.4f')}"
        parts.append(f"{name}: {numbers}")
    return "; ".join(parts)


def _outcome(kinds: dict[str, Kind], level: int, below: bool) -> str:
    """Of a claim that the reduction is below, or at least, one of LEVELS, from the samples."""
    reached = np.concatenate(
        [kind.sampled.reduction[DECIDING] >= LEVELS[level] for kind in kinds.values()]
    )
    if reached.all() or not reached.any():
        return FAILS if reached.any() == below else HOLDS
    found = [kind.sampled.thresholds[DECIDING][level] for kind in kinds.values()]
    verb, other = ("holds", "fails") if below else ("fails", "holds")
    return depends_on(RATIO, f"{verb} below {_low(found)}, {_rest(found, other)}")


def _low(found: list[Threshold]) -> str:
    low = np.array([x.low for x in found])
    return f"{np.nanmin(low):.2f} ({100 * CONFIDENCE:g} % of machines)"


def _rest(found: list[Threshold], other: str) -> str:
    middle = np.array([x.middle for x in found])
    if not np.isfinite(middle).all():
        return f"{other} for some machines above"
    error = max(x.error for x in found)
    return f"{other} for more than half of them above {span(middle, '.2f')} ± {error:.2f}"
