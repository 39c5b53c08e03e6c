"""The paper's statements on coupling, checked against all subsets."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from studies.atlas.subsets import CHOICES, Subsets, link_label
from studies.study.printed import TABLE_1

#: Columns of Table 1 after the uncontrolled one: links 1 to 3, links 1 and 2, link 1.
TABLE_1_LINKS = (0b111, 0b011, 0b001)
#: Changes smaller than this do not count as a change of sign [1].
NO_CHANGE = 1e-3


class Signs(NamedTuple):
    """Table 1: change of the spectral peak of mode 1."""

    paper: np.ndarray  # [1], (3 columns, 3 links)
    ours: np.ndarray  # [1], (settings, 3, 3)
    is_controlled: np.ndarray  # whether the column controls the link, (3, 3)

    @property
    def agree(self) -> np.ndarray:
        """Whether both fall or both rise, (settings, 3, 3)."""
        return np.sign(self.ours) == np.sign(self.paper)


def table_1_signs(choices: Subsets) -> Signs:
    """Our Table 1: three links with two modes each, the others with the first mode only.

    Args:
        choices: of links, (settings, C, 8).
    """
    table = np.array(TABLE_1).T
    peak = choices.peak[..., 0]  # (settings, C, 8, 3)
    modes = (min(2, choices.modes) - 1, 0, 0)
    columns = [peak[:, k, links] for k, links in zip(modes, TABLE_1_LINKS, strict=True)]
    ours = np.stack(columns, axis=1) / peak[:, :1, 0] - 1
    on = (np.array(TABLE_1_LINKS)[:, None] >> np.arange(3)) & 1
    return Signs(table[1:] / table[0] - 1, ours, on.astype(bool))


class LinkSteps(NamedTuple):
    """One more controlled link: all 12 steps between the 8 choices of links."""

    labels: list[str]  # "1 -> 1+3", (12,)
    is_controlled: np.ndarray  # which links are, after the step, (12, 3)
    change: np.ndarray  # of the rms by TARGETS [1], (settings, 5, 12)

    @property
    def rises(self) -> np.ndarray:
        """How many of the 12 steps make it worse, (settings, 5)."""
        return np.sum(self.change > NO_CHANGE, axis=-1)


def one_more_link(links: Subsets) -> LinkSteps:
    """Change of every residual when one more link is controlled.

    Args:
        links: the choices of links, (settings, 8).
    """
    left = np.sqrt(np.maximum(1 - links.removed(), 0.0))
    steps = [(a, a | 1 << i) for a in CHOICES for i in range(3) if not a >> i & 1]
    labels = [f"{link_label(a)} -> {link_label(b)}" for a, b in steps]
    before, after = (left[..., [step[k] for step in steps]] for k in (0, 1))
    on = (np.array(steps)[:, 1:] >> np.arange(3)) & 1
    return LinkSteps(labels, on.astype(bool), after / before - 1)


class PairChanges(NamedTuple):
    """Two controlled links: change of the platform's residual error."""

    labels: list[str]  # "1+2", (3,)
    change: np.ndarray  # [1], (settings, 3)


def two_links(links: Subsets) -> PairChanges:
    """The paper's claim: with two links controlled the residual error falls by more than 50 %.

    Args:
        links: the choices of links, (settings, 8).
    """
    pairs = [1 << i | 1 << k for i, k in combinations(range(3), 2)]
    change = links.platform[:, pairs] / links.platform[:, :1] - 1
    return PairChanges([link_label(pair) for pair in pairs], change)
