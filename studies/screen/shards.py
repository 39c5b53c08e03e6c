"""A shard of a screen: consecutive designs that are made, run and reduced together."""

from __future__ import annotations

import threading
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from jaxmodel.loop_figures import HIGHEST
from studies.engine.chunks import Done, run_quietly
from studies.engine.plan import local_layout, most_lanes, plan_groups
from studies.engine.results import SweepData, counted_links, direction
from studies.engine.screen import chunk_values
from studies.engine.stored import accurate, inaccurate
from studies.errors import StudyError, field_error
from studies.screen.tally import Axes, Tally, divided, merged, nothing, tally_of
from studies.space.designs import LazyCases, design_of
from studies.space.methods import METHODS
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable, as_numbers, build_table, metric_sizes
from studies.study.entries import parse_entries
from studies.study.fields import Columns
from studies.study.margin import ENOUGH

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
#: Best designs of a screen, whatever their margins: those to be kept are chosen among them.
CANDIDATES = 100_000


class ScreenRequest(NamedTuple):
    """What is screened, and what is kept."""

    spec: SweepSpec  # its `links` are the same for all designs
    by: str  # metric, or entry of one; a minus in front: the worst first
    keep: int  # most designs kept
    margin: float  # least gain margin of these [1]; 0: any
    n_designs: int  # of the sweep
    axes: Axes
    shard_size: int  # designs; the last shard may have fewer

    @property
    def entry(self) -> str:
        """What designs are ranked by, without the direction."""
        return self.by.removeprefix("-")

    @property
    def metric(self) -> str:
        """The metric of that entry."""
        return self.entry.partition("[")[0]

    @property
    def ranking(self) -> tuple[int, bool]:
        """How many candidates a tally holds, and whether large values are the best."""
        return CANDIDATES, direction(self.by) == "largest"

    @property
    def n_shards(self) -> int:
        """All of them."""
        return -(-self.n_designs // self.shard_size)

    def rows(self, shard: int) -> np.ndarray:
        """Numbers of a shard's designs, (n,)."""
        first = shard * self.shard_size
        return np.arange(first, min(first + self.shard_size, self.n_designs))


def screen_of(
    spec: SweepSpec,
    by: str = "",
    keep: int = 1000,
    margin: float = ENOUGH,
    fidelity: str = "linear",
    shard_size: int = 0,
) -> ScreenRequest:
    """A screen of a sweep's designs.

    Args:
        spec: the sweep.
        by: metric, or entry of one; "": what the sweep ranks by.
        keep: most designs kept.
        margin: least gain margin of these [1]; 0: any.
        fidelity: model of the runs, "linear" or "full".
        shard_size: designs of a shard; 0: by their number.

    Raises:
        StudyError: a sweep that cannot be screened, or a bad metric.
    """
    spec = spec._replace(sweep=spec.sweep.model_copy(update={"fidelity": fidelity}))
    by = by or spec.sweep.by
    if METHODS[spec.sweep.method].analysis is not None:
        raise field_error(
            "sweep.method", spec.sweep.method, "any that is not for studies sensitivity"
        )
    for name in ("repeats", "environments", "screen"):
        value = getattr(spec.sweep, name)
        default = type(spec.sweep).model_fields[name].default
        if value != default:
            raise field_error(f"sweep.{name}", value, f"{default!r} in a screen")
    if not 1 <= keep <= CANDIDATES:
        raise field_error("--keep", keep, f"1 to {CANDIDATES} designs")
    if not 0 <= margin < HIGHEST:
        raise field_error("--margin", margin, f"0 to less than {HIGHEST:g}")
    design = design_of(spec.root, spec.study, spec.sweep.seed)
    if design.size > MOST:
        raise StudyError(f"sweep: {design.size:.3g} designs; allowed: up to {MOST:.0e} in a screen")
    tried = _tried(design)
    table = build_table(spec, tried)
    if not len(table):
        raise StudyError(
            f"sweep.where = {spec.sweep.where!r}: true for none of {len(tried)} designs tried; "
            "narrow the axes to where it holds"
        )
    parse_entries(by.removeprefix("-"), "--by", metric_sizes(table))
    links = (np.flatnonzero(counted_links(SweepData({}, {}, spec, table))) + 1).tolist()
    spec = spec._replace(sweep=spec.sweep.model_copy(update={"links": tuple(links)}))
    if inaccurate([by.removeprefix("-").partition("[")[0]]):
        raise field_error("--by", by, f"with float32 {accurate()}")
    return ScreenRequest(
        spec=spec,
        by=by,
        keep=keep,
        margin=margin,
        n_designs=design.size,
        axes=divided(_distinct(axis_columns(table))),
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
    is_linear = screen.spec.sweep.fidelity == "linear"
    lay_out = partial(local_layout, most=max(LANES, most_lanes()))
    groups = plan_groups(
        table, np.arange(count), lay_out, (screen.metric,), is_linear, is_judged=False
    )
    n_run = 0
    for done in run_quietly(table, groups, stop):
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
