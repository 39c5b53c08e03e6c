"""Metrics by name, whole or in part: `residual_rms`, `residual_rms[link=1]`, `peak_voltage[0]`.

Indices that name their axis count from 1, as the files do; others follow the axes' order and count
from 0. A whole metric is taken over the links that count: the controlled ones.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.case import Structure
from jaxmodel.metrics import METRICS, Sizes
from studies.errors import StudyError, nearest
from studies.study.paths import NAMED_INDEX, parse_entry
from studies.study.spec import Study


class Entries(NamedTuple):
    """Some entries of a metric."""

    metric: str
    at: tuple[int | None, ...]  # index along each axis after the runs', from 0; None: all

    def take(self, data: Any, links: tuple[int, ...] | None = None) -> Any:
        """Entries of an array of many runs, (S, n).

        Args:
            data: of the metric, (S, ...).
            links: those that count if no link is named, from 0; None: all.
        """
        index: list[Any] = [slice(None)] * data.ndim
        for k, (axis, number) in enumerate(zip(self.axes, self.at, strict=True), 1):
            if number is not None:
                index[k] = slice(number, number + 1)
            elif axis == "link" and links is not None:
                data = data[(slice(None),) * k + (np.array(links),)]
        taken = data[tuple(index)]
        return taken.reshape(len(taken), -1)

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the metric's axes after the runs'."""
        return METRICS[self.metric].dims

    @property
    def names_a_link(self) -> bool:
        """Whether it belongs to a single link."""
        return any(
            axis == "link" and number is not None
            for axis, number in zip(self.axes, self.at, strict=True)
        )


def parse_entries(name: str, path: str = "", sizes: Mapping[str, int] | None = None) -> Entries:
    """Entries denoted by a name.

    Args:
        name: of a metric, perhaps with indices.
        path: where it is written, for messages.
        sizes: of axes, for checking indices; those that are missing are not checked.

    Raises:
        StudyError: no such metric, axis or entry.
    """
    where = f"{path}: " if path else ""
    plain = parse_entry(NAMED_INDEX.sub("", name))
    if plain is None or plain.field not in METRICS:
        hint = nearest(name.partition("[")[0], METRICS)
        suggestion = f"did you mean {hint!r}?" if hint else f"allowed: {', '.join(METRICS)}"
        raise StudyError(f"{where}{name!r}: unknown metric; {suggestion}")
    axes = METRICS[plain.field].dims
    size = {axis: (sizes or {}).get(axis, sys.maxsize) for axis in axes}
    at: dict[str, int] = {}
    for axis, written in NAMED_INDEX.findall(name):
        if axis not in axes or axis in at or not 1 <= int(written) <= size[axis]:
            allowed = ", ".join(f"[{x}={_span(1, n)}]" for x, n in size.items()) or "no index"
            raise StudyError(f"{where}{name!r} has no such entry; allowed: {allowed}")
        at[axis] = int(written) - 1
    left = [axis for axis in axes if axis not in at]
    at |= dict(zip(left, plain.indices, strict=False))
    is_inside = all(number < size[axis] for axis, number in at.items())
    if len(plain.indices) > len(left) or not is_inside:
        shape = "".join(f"[{_span(0, n - 1)}]" for n in size.values())
        raise StudyError(f"{where}{name!r} has no such entry; allowed: {plain.field}{shape}")
    return Entries(plain.field, tuple(at.get(axis) for axis in axes))


def _span(first: int, last: int) -> str:
    return f"{first} to {last}" if last < sys.maxsize - 1 else f"{first} or more"


def entry_sizes(study: Study) -> dict[str, int]:
    """Lengths of the axes of a study's metrics."""
    sizes = Sizes(
        n_stations=len(study.metrics.stations),
        n_modes=study.link.modes,
        n_controlled=study.control.modes,
        n_frequencies=Structure().n_frequencies,
        n_links=study.n_links,
        n_pose=study.n_pose,
    )
    return sizes.axes


def controlled_links(studies: Iterable[Study]) -> tuple[int, ...]:
    """Links that any of these studies controls, from 0; all if none does."""
    studies = list(studies)
    links = {
        k
        for study in studies
        if study.control.feedback != "none"
        for k, is_on in enumerate(study.control.links)
        if is_on
    }
    return tuple(sorted(links)) or tuple(range(studies[0].n_links))


def links_text(links: tuple[int, ...], n_links: int) -> str:
    """Counted links of so many in words: "link 1", "links 1 and 3", "all links"."""
    names = [str(k + 1) for k in links]
    if len(names) == n_links:
        return "all links"
    return f"link{'s' if len(names) > 1 else ''} {' and '.join(names)}"
