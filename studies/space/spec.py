"""The file of a sweep: a study plus `[sweep]`, which says what varies and how.

`[sweep]` is a block; a block holds axes and further blocks, and its method combines them:

- `grid`: every combination; `zip`: axes in parallel, of equal length; `list`: explicit `cases`;
- `random`, `latin_hypercube`, `sobol`: `count` points of its axes, combined with every further
  block; Latin hypercubes of `size` points follow one another, so that more can be added later;
- `morris`: `count` trajectories on a grid of `levels`; `saltelli`: `count` base points; both for
  `studies sensitivity`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field

from jaxmodel.loop_figures import HIGHEST, MARGINS, PEAKS
from studies.errors import StudyError, field_error, nearest
from studies.reading import check_depth
from studies.space.methods import METHODS
from studies.study.choices import OWN, OneOf
from studies.study.entries import entry_sizes, parse_entries
from studies.study.files import read_toml
from studies.study.margin import ENOUGH
from studies.study.paths import parse_section
from studies.study.spec import Section, Study, described, parse_study
from studies.study.window import with_window


class Block(Section):
    """Axes and how they combine."""

    method: Annotated[str, OneOf(lambda: METHODS, OWN)] = described(
        "grid", "-", "how axes and blocks combine"
    )
    axes: dict[str, object] = described({}, "-", "field or ready-made axis = values")
    blocks: tuple[Block, ...] = described((), "-", "further blocks")
    cases: tuple[dict[str, object], ...] = described(
        (), "-", "for method list: field = value, per case"
    )
    count: int = described(0, "1", "points of a sampling method", ge=0, le=10**12)
    size: int = described(0, "1", "points of one Latin hypercube; 0: count", ge=0, le=10**7)
    levels: int = described(4, "1", "levels of a Morris grid", ge=2, le=100)


#: Best designs of a sweep that keeps some, whatever their margins: they are chosen among these.
CANDIDATES = 100_000


class Sweep(Block):
    """What varies, and what is kept."""

    where: str = described("", "-", "condition on the fields; other cases are excluded")
    repeats: int = described(1, "1", "runs of each case, with their own seeds", ge=1, le=10**6)
    seed: int = described(0, "1", "of the sampling methods", ge=0, le=10**9)
    metrics: tuple[str, ...] = described((), "-", "metrics to keep; empty: all")
    robustness: tuple[str, ...] = described(
        (), "-", f"further figures of every sampled loop to keep: {', '.join((*MARGINS, *PEAKS))}"
    )
    by: str = described("residual_rms", "-", "metric, or entry of one, that cases are ranked by")
    keep: int = described(
        0,
        "1",
        "keep only so many designs, the best, which run in full; 0: all",
        ge=0,
        le=CANDIDATES,
    )
    margin: float = described(
        ENOUGH, "1", "with keep: least gain margin of kept designs; 0: any", ge=0, lt=HIGHEST
    )
    subject_to: str = described(
        "", "-", "condition on metrics and axes that the best must meet, with keep so many designs"
    )
    links: tuple[int, ...] = described(
        (), "1", "links that metrics are taken over, from 1; empty: those that any case controls"
    )
    environments: tuple[str, ...] = described(
        (),
        "-",
        "axes that a design meets rather than chooses, such as its payload: cases that differ in "
        "them alone are one design, ranked over all of them",
    )
    over: Literal["worst", "mean"] | Annotated[float, Field(gt=0, le=1)] = described(
        "worst", "-", "how: by the worst case, the mean, or a quantile (1 is the worst)"
    )
    fidelity: Literal["full", "linear"] = described(
        "full",
        "-",
        "model of the runs, with keep of those that find the best; linear: mechanics linearised at "
        "the last way-point",
    )


class BlockNode(NamedTuple):
    """A validated block with its validated blocks; `path` names it in messages."""

    block: Block
    children: tuple[BlockNode, ...]
    path: str


#: What says which cases there are.
SPREADING = {*Block.model_fields, "where", "seed"}
#: What says which designs are kept.
SELECTING = {"keep", "margin", "subject_to"}
#: What says how finished cases are counted and ranked.
READING = {"repeats", "by", "links", "environments", "over", *SELECTING}


class SweepSpec(NamedTuple):
    """A sweep as requested."""

    study: Study  # values of all fields that do not vary
    sweep: Sweep
    root: BlockNode  # the tree of blocks; its block is `sweep`
    data: dict[str, Any]  # as read, for the record


def load_sweep(path: str | Path) -> SweepSpec:
    """Read a sweep file, or the ready-made one of that name.

    Raises:
        StudyError: unreadable, not TOML, or not a valid sweep.
    """
    return parse_sweep(read_toml(path))


def parse_sweep(data: dict[str, Any]) -> SweepSpec:
    """Validate a dictionary as a sweep.

    Raises:
        StudyError: first fault found, with field, value, allowed range and unit.
    """
    if "sweep" not in data:
        raise StudyError("sweep: missing; a sweep is a study file with a section [sweep]")
    try:
        check_depth(data["sweep"])
    except ValueError as error:
        raise StudyError(f"sweep: {error}") from None
    study = with_window(
        parse_study({name: value for name, value in data.items() if name != "sweep"})
    )
    sweep = parse_section(Sweep, data["sweep"], "sweep")
    entry = sweep.by.removeprefix("-") if sweep.keep else sweep.by  # - for the largest first
    ranking = parse_entries(entry, "sweep.by", _known_sizes(study)).metric
    is_ranked = sweep.keep or "by" in data["sweep"]
    if is_ranked and sweep.metrics and ranking not in sweep.metrics:
        raise field_error("sweep.by", sweep.by, f"one of sweep.metrics = {list(sweep.metrics)}")
    known = range(1, study.n_links + 1)
    if not set(sweep.links) <= set(known) or len(set(sweep.links)) < len(sweep.links):
        raise field_error(
            "sweep.links", list(sweep.links), f"each of {', '.join(map(str, known))} once"
        )
    for name in sweep.robustness:
        if name not in (*MARGINS, *PEAKS):
            hint = nearest(name, (*MARGINS, *PEAKS))
            raise field_error("sweep.robustness", name, ", ".join((*MARGINS, *PEAKS)), hint=hint)
        if sweep.robustness.count(name) > 1:
            raise field_error("sweep.robustness", name, "each figure once")
    _check_kept(sweep, data["sweep"])
    return SweepSpec(study=study, sweep=sweep, root=_node(sweep, "sweep"), data=data)


def _known_sizes(study: Study) -> dict[str, int]:
    """Lengths of the axes of metrics that are the same in every case."""
    sizes = entry_sizes(study)
    return {axis: sizes[axis] for axis in ("link", "pose_axis")}


def _check_kept(sweep: Sweep, written: dict[str, Any]) -> None:
    """Check that a sweep that keeps its best designs has what it needs, and no other has it."""
    if not sweep.keep:
        if "margin" in written:
            raise field_error("sweep.margin", sweep.margin, "none without sweep.keep")
        return
    if METHODS[sweep.method].analysis is not None:
        raise field_error(
            "sweep.keep", sweep.keep, f"0 with method {sweep.method}, which needs every case"
        )
    for name in ("repeats", "environments"):
        value, default = getattr(sweep, name), Sweep.model_fields[name].default
        if value != default:
            raise field_error(f"sweep.{name}", value, f"{default!r} with sweep.keep")


#: Blocks can be nested this deep.
DEEPEST = 20


def _node(block: Block, path: str, depth: int = 0) -> BlockNode:
    if depth > DEEPEST:
        raise StudyError(f"sweep.blocks: nested {depth} deep; allowed: up to {DEEPEST}")
    _check_block(block, path)
    inner = (_node(x, f"{path}.blocks.{k}", depth + 1) for k, x in enumerate(block.blocks))
    return BlockNode(block, tuple(inner), path)


def _check_block(block: Block, path: str) -> None:
    """Check that a block has what its method needs, and nothing it would ignore."""
    name, method = block.method, METHODS[block.method]
    if "count" in method.fields and block.count < 1:
        raise field_error(f"{path}.count", block.count, f"1 or more, for method {name}")
    for field in ("count", "size", "levels"):
        value, default = getattr(block, field), Block.model_fields[field].default
        if field not in method.fields and value != default:
            readers = ", ".join(other.name for other in METHODS.values() if field in other.fields)
            raise field_error(
                f"{path}.{field}", value, f"{default}, method {name} has no {field} ({readers})"
            )
    if block.size and block.count % block.size:
        raise field_error(
            f"{path}.count", block.count, f"a multiple of {path}.size = {block.size}", "1"
        )
    if ("cases" in method.fields) != bool(block.cases):
        raise field_error(f"{path}.cases", block.cases, "one or more, with method list only")
    if block.cases and block.axes:
        raise field_error(f"{path}.axes", list(block.axes), "none with method list")
    if method.points is not None and not block.axes:
        raise field_error(f"{path}.axes", {}, "one axis or more")
    if not (block.axes or block.blocks or block.cases) and path != "sweep":
        raise field_error(path, {}, "a block with axes, blocks or cases")
    if path != "sweep" and method.analysis is not None:
        raise field_error(
            f"{path}.method", name, "any other inside a block; these stand alone in [sweep]"
        )
    if method.analysis is not None and block.blocks:
        raise field_error(f"{path}.blocks", len(block.blocks), "none with method " + name)
