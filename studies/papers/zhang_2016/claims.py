"""What the paper claims, and whether the machines have it.

The fitted machine answers what the paper measured, the nominal one what it simulated.
"""

from __future__ import annotations

import numpy as np

from studies.papers.card import Claim, Verdict, outcome_of
from studies.papers.zhang_2016.cases import (
    ALL,
    EXPERIMENT_RATIOS,
    OFF,
    ONE,
    TWO,
)
from studies.papers.zhang_2016.context import Context, Machines
from studies.papers.zhang_2016.tables import (
    FREQUENCIES,
    amplitude_change,
    energy_ratio,
    printed_changes,
)
from studies.show.units import span

#: Largest differences that count as agreement: frequencies [1], Table 1 [percentage points].
NEAR_HZ, NEAR_POINTS = 0.01, 5.0
#: Settling times without and with control [s], and two standard deviations of what they may mean
#: (docs/paper-measured.md).
SETTLING, NEAR_SETTLING = (0.14, 0.07), (0.04, 0.02)
#: A link that changes by less than this when another is controlled is not coupled to it [%].
LEAST_CHANGE = 0.5

CLAIMS = (
    Claim(
        "The first two modes of the flexible link have 92.5 and 241.3 Hz.",
        "frequencies of the fitted machine's links over these [1]",
        f"both within {100 * NEAR_HZ:g} % on one link, since the paper does not say on which",
    ),
    Claim(
        "Control of three links reduces the peak of mode 1 by 42 to 45 %, Table 1.",
        "change of the spectral peak of a controlled link, fitted machine [%]",
        f"within {NEAR_POINTS:g} points of every entry",
    ),
    Claim(
        "With control the links settle in 0.07 s, in about half of the time without.",
        "settling time to 5 %, fitted machine [s]",
        f"{SETTLING[1]:g} s within {NEAR_SETTLING[1]:g}, {SETTLING[0]:g} s within "
        f"{NEAR_SETTLING[0]:g} s, all links",
    ),
    Claim(
        "Links are coupled through the platform: control of link 1 changes links 2 and 3.",
        "change of the spectral peak of mode 1 of an uncontrolled link, fitted machine [%]",
        f"one of them by more than {LEAST_CHANGE:g} %",
    ),
    Claim(
        "The more links are controlled, the better the suppression.",
        "mean square of the residual deflection of all links, both machines [m2]",
        "falls with each further link",
    ),
    Claim(
        "Control of two links reduces the platform's residual errors by more than half.",
        "change of the rms error of x, y and φ, both machines [%]",
        "below -50 % in all directions",
    ),
    Claim(
        "Mode 2 has 0.31 to 0.41 of the energy of mode 1, (27).",
        "energy ratio of the fitted machine [1]",
        "within a factor of 2, all links",
    ),
)
LEFT_OPEN = (
    "Young's modulus and structural damping of the links",
    "inertia of the joints and of the platform about its centre",
    "stiffness and damping of the slider drives",
    "converters, filters, sample rate and delay of the controller",
    "motion of the experiments, and the unit of their spectra",
    "unit of the gains: N s/m as printed, 1/s by (20) to (23)",
)


def judge(machines: Machines) -> list[Verdict]:
    """Outcomes of `CLAIMS`, in their order."""
    answers = (
        _frequencies(machines.fitted),
        _table_1(machines.fitted),
        _settling(machines.fitted),
        _coupling(machines.fitted),
        _more_links(machines),
        _platform(machines),
        _ratios(machines.fitted),
    )
    return [
        Verdict(claim, outcome_of(is_met), found)
        for claim, (is_met, found) in zip(CLAIMS, answers, strict=True)
    ]


def _frequencies(fitted: Context) -> tuple[bool, str]:
    hz = fitted.runs.link_hz[:, :2]
    apart = np.abs(hz / np.array(FREQUENCIES) - 1).max(axis=1)
    return bool(apart.min() <= NEAR_HZ), f"{span(hz[:, 0], '.1f')} Hz, {span(hz[:, 1], '.1f')} Hz"


def _table_1(fitted: Context) -> tuple[bool, str]:
    printed = [row for row in printed_changes() if row[2] == 1]
    found = [amplitude_change(fitted, links, mode) for _, links, mode, _ in printed]
    apart = max(
        float(np.abs(ours - theirs).max())
        for ours, (*_, theirs) in zip(found, printed, strict=True)
    )
    return apart <= NEAR_POINTS, f"{span(found[0], '.1f')} %; at most {apart:.1f} points apart"


def _settling(fitted: Context) -> tuple[bool, str]:
    free, held = (fitted.measures.settling[fitted.compared(2, links)] for links in (OFF, ALL))
    is_near = [
        np.abs(x - y).max() <= allowed
        for x, y, allowed in zip((free, held), SETTLING, NEAR_SETTLING, strict=True)
    ]
    found = f"{span(held, '.3f')} s with, {span(free, '.3f')} s without"
    return all(is_near), found


def _coupling(fitted: Context) -> tuple[bool, str]:
    change = amplitude_change(fitted, ONE, 1)[1:]
    found = ", ".join(f"{x:+.1f} %" for x in change)
    return bool(np.abs(change).max() > LEAST_CHANGE), f"links 2 and 3: {found}"


def _more_links(machines: Machines) -> tuple[bool, str]:
    falls, found = [], []
    for context in machines:
        left = np.array(
            [
                np.sum(context.measures.residual[context.compared(2, links)] ** 2)
                for links in (OFF, ONE, TWO, ALL)
            ]
        )
        falls.append(np.all(np.diff(left) < 0))
        shares = ", ".join(f"{x:.2g}" for x in left / left[0])
        found.append(f"{context.name}: {shares} of it with 0 to 3 links")
    return bool(np.all(falls)), "; ".join(found)


def _platform(machines: Machines) -> tuple[bool, str]:
    halves, found = [], []
    for context in machines:
        error = context.runs.result.metrics.pose_error_rms
        off, two = (np.asarray(error[context.compared(3, links)]) for links in (OFF, TWO))
        halves.append(np.all(two < 0.5 * off))
        changes = ", ".join(f"{x:+.0f} %" for x in 100 * (two / off - 1))
        found.append(f"{context.name}: {changes}")
    return bool(np.all(halves)), "; ".join(found)


def _ratios(fitted: Context) -> tuple[bool, str]:
    ours = energy_ratio(fitted)[:, 1]
    theirs = np.array([link[1] for link in EXPERIMENT_RATIOS])
    return bool(np.abs(np.log(ours / theirs)).max() <= np.log(2)), span(ours, ".2g")
