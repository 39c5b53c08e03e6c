"""A shard of a screen: consecutive designs that are made, run and reduced together."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from studies.engine.chunks import Done, run_quietly
from studies.engine.fidelity import chunk_values
from studies.engine.plan import Group, local_layout, most_lanes, plan_groups
from studies.engine.results import direction, links_of
from studies.engine.stored import check_names
from studies.errors import StudyError
from studies.screen.tally import Axes, Tally, divided, merged, nothing, tally_of
from studies.space.designs import LazyCases, design_of
from studies.space.spec import CANDIDATES, SweepSpec
from studies.space.table import CaseTable, as_numbers, build_table
from studies.study.fields import Columns

#: Fewest and most designs of a shard.
SHARD = (2**14, 2**18)
#: Shards of a screen, if their size allows it: what an interruption loses is one of them.
SHARDS = 64
#: Designs side by side: preparing many at once is faster, and the linear model needs little memory.
LANES = 512
#: Designs by whose values axes are divided.
TRIED = 2**12
#: Most designs.
MOST = 10**12


class ScreenRequest(NamedTuple):
    """What is screened: the designs of a sweep that keeps some."""

    spec: SweepSpec  # its `links` are the same for all designs
    some: CaseTable  # designs in which every axis varies, the same in any process
    n_designs: int  # of the sweep
    axes: Axes
    shard_size: int  # designs; the last shard may have fewer

    @property
    def entry(self) -> str:
        """What designs are ranked by, without the direction."""
        return self.spec.sweep.by.removeprefix("-")

    @property
    def metric(self) -> str:
        """The metric of that entry."""
        return self.entry.partition("[")[0]

    @property
    def is_linear(self) -> bool:
        """Whether the linear model finds the best designs."""
        return self.spec.sweep.fidelity == "linear"

    @property
    def ranking(self) -> tuple[int, bool]:
        """How many candidates a tally holds, and whether large values are the best."""
        return CANDIDATES, direction(self.spec.sweep.by) == "largest"

    @property
    def n_shards(self) -> int:
        """All of them."""
        return -(-self.n_designs // self.shard_size)

    def rows(self, shard: int) -> np.ndarray:
        """Numbers of a shard's designs, (n,)."""
        first = shard * self.shard_size
        return np.arange(first, min(first + self.shard_size, self.n_designs))


def screen_of(spec: SweepSpec, shard_size: int = 0) -> ScreenRequest:
    """The screen of a sweep's designs.

    Args:
        spec: the sweep, with `keep`.
        shard_size: designs of a shard; 0: by their number.

    Raises:
        StudyError: a metric or condition that no design has, too many designs, or none.
    """
    design = design_of(spec.root, spec.study, spec.sweep.seed)
    if design.size > MOST:
        raise StudyError(
            f"sweep: {design.size:.3g} designs; allowed: up to {MOST:.0e} with sweep.keep"
        )
    tried = _tried(design)
    some = build_table(spec, tried)
    if not len(some):
        raise StudyError(
            f"sweep.where = {spec.sweep.where!r}: true for none of {len(tried)} designs tried; "
            "narrow the axes to where it holds"
        )
    check_names(spec, some)
    links = (np.flatnonzero(links_of(spec, some)) + 1).tolist()
    spec = spec._replace(sweep=spec.sweep.model_copy(update={"links": tuple(links)}))
    return ScreenRequest(
        spec=spec,
        some=some,
        n_designs=design.size,
        axes=divided(_distinct(axis_columns(some))),
        shard_size=shard_size or _shard_size(design.size),
    )


def _shard_size(n_designs: int) -> int:
    return int(np.clip(1 << (n_designs // SHARDS).bit_length(), *SHARD))


def _tried(design: LazyCases) -> np.ndarray:
    """Numbers of some designs in which every axis varies, the same in any process, (n,)."""
    if design.size <= TRIED:
        return np.arange(design.size)
    return np.unique(design.some(np.random.default_rng(0), TRIED))


def _distinct(columns: Columns) -> Columns:
    """Columns that vary, without those that repeat another one, such as links that are alike."""
    found: dict[str, np.ndarray] = {}
    for name, column in columns.items():
        is_known = any(np.array_equal(column, other) for other in found.values())
        if not is_known and np.any(column != column[0]):
            found[name] = column
    return found


def axis_columns(table: CaseTable) -> Columns:
    """Numbers and texts of a table, by the names of fields and entries, (n,) each."""
    found: dict[str, np.ndarray] = {}
    for name, column in table.fields.items():
        if column.dtype.kind not in "bif":
            found |= {name: column} if column.dtype.kind == "U" else {}
            continue
        numbers = np.asarray(as_numbers(column, table.study.n_links), float)
        for place in np.ndindex(numbers.shape[1:]):
            entry = name + "".join(f"[{k}]" for k in place)
            found[entry] = numbers[(slice(None), *place)]
    return found


def table_of(screen: ScreenRequest, shard: int) -> CaseTable:
    """Table of a shard's designs, without those that repeat others."""
    return build_table(screen.spec, screen.rows(shard), has_ids=False)


def designs_table(screen: ScreenRequest, row: np.ndarray) -> CaseTable:
    """Table of some designs.

    Args:
        screen: of the designs.
        row: their numbers in any order, (n,).

    Returns:
        Their cases in that order, without those that repeat the parameters of another.
    """
    order = np.argsort(row)
    table = build_table(screen.spec, row[order])
    place = order[np.searchsorted(row[order], table.row)]
    return table.rows(np.argsort(place))


def shard_groups(screen: ScreenRequest, table: CaseTable) -> list[Group]:
    """Designs of a table by program: one metric, no judgement."""
    return plan_groups(
        table,
        np.arange(len(table)),
        partial(local_layout, most=max(LANES, most_lanes())),
        (screen.metric,),
        screen.is_linear,
        is_judged=False,
    )


def shard_tally(
    screen: ScreenRequest,
    shard: int,
    table: CaseTable,
    stop: threading.Event,
    on_endings: Callable[[np.ndarray], object] = lambda endings: None,
) -> Tally | None:
    """Run the designs of a shard in this process and reduce them.

    Args:
        screen: of the shard.
        shard: its number.
        table: of its designs.
        stop: once set, no further chunks are started.
        on_endings: called with how many designs of each part have ended in which way.

    Returns:
        The tally; None if it was stopped.
    """
    count = len(table)
    total = nothing(screen.axes, len(screen.rows(shard)) - count)
    on_endings(total.endings)
    if not count:
        return total
    n_run = 0
    for done in run_quietly(table, shard_groups(screen, table), stop):
        part = _chunk_tally(screen, table, done)
        total = merged(total, part, *screen.ranking)
        n_run += part.n_designs
        on_endings(part.endings)
    return total if n_run == count else None


def _chunk_tally(screen: ScreenRequest, table: CaseTable, done: Done) -> Tally:
    part = table.rows(done.chunk.rows)
    code, value = chunk_values(screen.spec, table, done, screen.entry)
    columns = axis_columns(part)
    return tally_of(part.row, code, value, columns, screen.axes, *screen.ranking)
