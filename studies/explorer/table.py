"""What an explorer shows: cases with their parameters and figures, whatever they come from."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from studies.explorer.replays import ReplayedCase

#: Cases of a page at most; of more, a part is shown, and the page says so.
MOST_CASES = 20_000
#: Share of the cases of a thinned page that are the best ones; the others are spread over the rest.
BEST_SHARE = 0.25


class Column(NamedTuple):
    """A parameter or a figure of every case."""

    name: str  # as in the files
    unit: str  # in which it is shown, "" for none
    value: np.ndarray  # in that unit, (n,); NaN: this case has none
    is_parameter: bool = False  # given, not computed
    labels: tuple[str, ...] = ()  # of texts, whose places in here are the values
    is_log: bool = False
    better: str = ""  # "smallest" or "largest"
    bound: float = np.inf  # a value of this stands for larger ones


class Placement(NamedTuple):
    """Lengths along the links, one row per case [mm]."""

    length: np.ndarray  # of the links, (n, 3)
    actuator: np.ndarray  # of the patches, (n, 3)
    sensor: np.ndarray  # of the patches, (n, 3)
    centers: np.ndarray  # of the pairs of patches, from the actuated joint, (n, 3, P); NaN: none
    is_controlled: np.ndarray  # (n, 3)


class ExplorerTable(NamedTuple):
    """Everything that a page is made of."""

    title: str
    noun: str  # what a row is: "case"
    columns: tuple[Column, ...]
    status: np.ndarray  # 0: ok, (n,)
    reasons: Mapping[int, str]  # the statuses in words
    names: tuple[str, ...]  # of the rows, (n,)
    rank: str  # the column that orders the rows
    conditions: Mapping[str, float] = {}  # least values that the page begins with, by column
    baseline: Mapping[str, float] = {}  # values without control, by column
    command: tuple[str, ...] = ()  # that reruns one of them; its name stands between these parts
    placement: Placement | None = None
    replays: tuple[ReplayedCase, ...] = ()
    notes: tuple[str, ...] = ()
    about: Mapping[str, str] = {}  # the question and the machine, in words, by what they say

    def column(self, name: str) -> Column:
        """The column of a name; KeyError without one."""
        for column in self.columns:
            if column.name == name:
                return column
        raise KeyError(name)

    def checked(self) -> ExplorerTable:
        """Itself.

        Raises:
            ValueError: a column has not one value a row.
        """
        for column in self.columns:
            if np.shape(column.value) != (len(self.status),):
                raise ValueError(f"{column.name}: not one value for each {self.noun}")
        return self

    @property
    def order(self) -> np.ndarray:
        """Rows, the best first, those without a value last, (n,)."""
        column = self.column(self.rank)
        sign = -1.0 if column.better == "largest" else 1.0
        value = np.where(self.status == 0, sign * column.value, np.nan)
        return np.argsort(value, kind="stable")


def text_column(name: str, texts: np.ndarray, is_parameter: bool) -> Column:
    """A column of texts, numbered in order of appearance."""
    labels = tuple(dict.fromkeys(map(str, texts)))
    places = {label: k for k, label in enumerate(labels)}
    value = np.array([places[str(text)] for text in texts], float)
    return Column(name, "", value, is_parameter=is_parameter, labels=labels)


def shown_rows(table: ExplorerTable) -> np.ndarray:
    """Rows that a page shows, in their order: all, or of too many the best and a spread of others.

    Replayed rows are among them.
    """
    order = table.order
    if len(order) <= MOST_CASES:
        return np.arange(len(order))
    n_best = int(BEST_SHARE * MOST_CASES)
    replayed = np.array([x.row for x in table.replays], int)
    n_spread = MOST_CASES - n_best - len(replayed)
    spread = order[n_best:][np.linspace(0, len(order) - n_best - 1, n_spread).astype(int)]
    return np.unique(np.concatenate([order[:n_best], spread, replayed]))
