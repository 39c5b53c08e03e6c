"""How axes combine: from the tree of blocks to columns of values, one row per case.

A design has any number of cases, since only those are made that are asked for: all of a sweep, some
at a time of one that keeps the best.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.space.axes import LIMIT, READY_MADE, Axis, build_axis
from studies.space.methods import METHODS, SamplingRequest
from studies.space.spec import BlockNode
from studies.study.fields import Columns, column_of
from studies.study.paths import checked_value, known_field
from studies.study.spec import Study

#: Points of a sampled block that stand for all of them: the first ones, which are quick to make.
#: Rows further apart than that are made without those between them.
EARLY = 2**12


class LazyCases(NamedTuple):
    """Cases as they are written, made only when they are asked for."""

    names: tuple[str, ...]  # of the columns
    size: int
    rows: Callable[[np.ndarray], Columns]  # of these numbers, from 0, ascending, (n,)
    # so many numbers at random that are quick to make together
    some: Callable[[np.random.Generator, int], np.ndarray]


def design_of(node: BlockNode, study: Study, seed: int, stride: int = 1000) -> LazyCases:
    """The cases of a block; without axes one, without columns.

    Args:
        node: the block.
        study: values of everything else.
        seed: of the sampling methods.
        stride: between the seeds of its blocks; theirs is larger, so that none has another's seed.

    Raises:
        StudyError: a bad axis, or a name used twice.
    """
    method = METHODS[node.block.method]
    if node.block.cases:
        parts = [_stored(_list_cases(node, study))]
    elif method.points is not None:
        parts = [_sampled(node, study, seed)]
    else:
        parts = [_grid_of(axis, path) for path, axis in _axes(node, study).items()]
    parts += [
        design_of(child, study, seed + stride * (k + 1), 1000 * stride)
        for k, child in enumerate(node.children)
    ]
    _check_names(parts, node.path)
    if method.combine == "side by side":
        return _zipped(parts, node.path)
    return _product(parts)


def _stored(columns: Columns) -> LazyCases:
    return LazyCases(
        tuple(columns),
        length(columns),
        lambda rows: {name: column[rows] for name, column in columns.items()},
        _anywhere(length(columns)),
    )


def _anywhere(size: int) -> Callable[[np.random.Generator, int], np.ndarray]:
    """Numbers below a size, each as likely as another."""
    return lambda rng, count: rng.integers(size, size=count)


def _axes(node: BlockNode, study: Study) -> dict[str, Axis]:
    path = f"{node.path}.axes"
    return {
        f"{path}.{name}": build_axis(name, written, study, path)
        for name, written in node.block.axes.items()
    }


def _grid_of(axis: Axis, path: str) -> LazyCases:
    if axis.grid is None:
        raise StudyError(
            f"{path}: a range needs count (placement: candidates) for methods grid and zip"
        )
    return _stored(axis.grid)


def length(columns: Columns) -> int:
    """Number of rows."""
    return len(next(iter(columns.values()))) if columns else 1


def _check_names(parts: list[LazyCases], path: str) -> None:
    seen: set[str] = set()
    for part in parts:
        for name in part.names:
            if name in seen:
                raise StudyError(f"{path}: {name} varies twice; let one axis or block vary it")
            seen.add(name)
    for name in seen:
        whole = name.split("[")[0]
        if whole != name and whole in seen:
            raise StudyError(f"{path}: {whole} varies as a whole and by its entry {name}")


def _zipped(parts: list[LazyCases], path: str) -> LazyCases:
    sizes = [part.size for part in parts]
    if len(set(sizes)) > 1:
        named = ", ".join(f"{'/'.join(part.names)}: {part.size}" for part in parts)
        raise StudyError(f"{path}: axes of one length side by side; here {named}")
    return LazyCases(
        _names(parts),
        sizes[0] if sizes else 1,
        lambda rows: {name: x for part in parts for name, x in part.rows(rows).items()},
        _anywhere(min(sizes[0] if sizes else 1, LIMIT)),
    )


def _product(parts: list[LazyCases]) -> LazyCases:
    """Every combination; the last part varies fastest."""

    def rows_of(rows: np.ndarray) -> Columns:
        result: dict[str, np.ndarray] = {}
        inner = math.prod(part.size for part in parts)
        for part in parts:
            inner //= part.size
            result |= _some(part, rows // inner % part.size)
        return result

    def some(rng: np.random.Generator, count: int) -> np.ndarray:
        rows = np.zeros(count, np.int64)
        for part in parts:
            rows = rows * part.size + part.some(rng, count)
        return rows

    return LazyCases(_names(parts), math.prod(part.size for part in parts), rows_of, some)


def _some(part: LazyCases, rows: np.ndarray) -> Columns:
    """Rows of a part, in any order and as often as named."""
    distinct, where = np.unique(rows, return_inverse=True)
    if len(distinct) == len(rows) and np.all(rows[:-1] < rows[1:]):
        return part.rows(rows)
    return {name: column[where] for name, column in part.rows(distinct).items()}


def _names(parts: list[LazyCases]) -> tuple[str, ...]:
    return tuple(name for part in parts for name in part.names)


def _list_cases(node: BlockNode, study: Study) -> Columns:
    """Listed cases; fields that a case does not name have the base study's value."""
    path = f"{node.path}.cases"
    for k, case in enumerate(node.block.cases):
        for name in case:
            if name in READY_MADE:
                raise StudyError(
                    f"{path}.{k}: {name} is not a field; write the field it stands for"
                )
            known_field(name, study, f"{path}.{k}", READY_MADE)
    names = list(dict.fromkeys(name for case in node.block.cases for name in case))
    columns: dict[str, np.ndarray] = {}
    for name in names:
        base = known_field(name, study)
        values: list[Any] = [
            checked_value(study, name, case[name], f"{path}.{k}") if name in case else base
            for k, case in enumerate(node.block.cases)
        ]
        columns[name] = column_of(values)
    return columns


def _sampled(node: BlockNode, study: Study, seed: int) -> LazyCases:
    axes, method = _axes(node, study), METHODS[node.block.method]
    dimensions = sum(axis.dimensions for axis in axes.values())

    def at(points: np.ndarray) -> Columns:
        columns: dict[str, np.ndarray] = {}
        begin = 0
        for path, axis in axes.items():
            part = axis.sample(points[:, begin : begin + axis.dimensions])
            for name in part:
                if name in columns:
                    raise StudyError(f"{path}: {name} varies twice; let one axis vary it")
            columns |= part
            begin += axis.dimensions
        return columns

    names = tuple(at(np.full((1, dimensions), 0.5)))
    if not method.is_streamed:
        every = unit_points(node, dimensions, seed)
        return LazyCases(names, len(every), lambda rows: at(every[rows]), _anywhere(len(every)))

    def rows_of(rows: np.ndarray) -> Columns:
        pieces = np.split(rows, np.flatnonzero(np.diff(rows) > EARLY) + 1)
        if max(piece[-1] - piece[0] for piece in pieces) >= LIMIT:
            raise StudyError(
                f"{node.path}: more than {LIMIT} points at once; let the block with the most "
                "points be the outermost one"
            )
        points = []
        for piece in pieces:
            span = int(piece[0]), int(piece[-1]) + 1
            points.append(unit_points(node, dimensions, seed, span)[piece - piece[0]])
        return at(np.concatenate(points))

    return LazyCases(names, node.block.count, rows_of, _anywhere(min(node.block.count, EARLY)))


def unit_points(
    node: BlockNode, dimensions: int, seed: int, span: tuple[int, int] | None = None
) -> np.ndarray:
    """Points of the unit cube for a sampling method, (n, dimensions).

    Args:
        node: the block.
        dimensions: of the cube.
        seed: of the method.
        span: first point, and one beyond the last; None: all of them.

    Raises:
        StudyError: the method returns something else.
    """
    method = METHODS[node.block.method]
    assert method.points is not None
    first, stop = span or (0, node.block.count)
    request = SamplingRequest(
        block=node.block,
        dimensions=dimensions,
        seed=seed,
        path=node.path,
        first=first,
        stop=stop,
    )
    points = np.asarray(method.points(request))
    is_right = points.dtype.kind == "f" and points.shape == (len(points) or 1, dimensions)
    if not is_right or not np.all((points >= 0) & (points <= 1)):
        raise StudyError(
            f"{node.path}.method = {method.name!r}: gives {points.dtype} of shape {points.shape}; "
            f"wanted one or more points of {dimensions} numbers from 0 to 1"
        )
    if method.is_streamed and len(points) != stop - first:
        raise StudyError(
            f"{node.path}.method = {method.name!r}: gives {len(points)} points; wanted those from "
            f"{first} to before {stop}"
        )
    return points
