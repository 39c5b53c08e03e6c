"""How axes combine: from the tree of blocks to columns of values, one row per case."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.errors import StudyError
from studies.space.axes import LIMIT, READY_MADE, Axis, build_axis, column_of
from studies.space.methods import METHODS, SamplingRequest
from studies.space.spec import BlockNode
from studies.study.fields import Columns
from studies.study.paths import checked_value, known_field
from studies.study.spec import Study


def spread(node: BlockNode, study: Study, seed: int, stride: int = 1000) -> Columns:
    """Expand a block to columns: what varies, one row per case; {} for a block without axes.

    Args:
        node: the block.
        study: values of everything else.
        seed: of the sampling methods.
        stride: between the seeds of its blocks; theirs is larger, so that none has another's seed.

    Raises:
        StudyError: a bad axis, a name used twice, too many cases.
    """
    method, own = METHODS[node.block.method], None
    if node.block.cases:
        own = _list_cases(node, study)
    elif method.points is not None:
        own = _sample(node, study, seed)
    parts = [own] if own is not None else [_grid_of(a, n) for n, a in _axes(node, study).items()]
    parts += [
        spread(child, study, seed + stride * (k + 1), 1000 * stride)
        for k, child in enumerate(node.children)
    ]
    _check_names(parts, node.path)
    if method.combine == "side by side":
        return _zip_columns(parts, node.path)
    return _product(parts, node.path)


def _axes(node: BlockNode, study: Study) -> dict[str, Axis]:
    path = f"{node.path}.axes"
    return {
        f"{path}.{name}": build_axis(name, written, study, path)
        for name, written in node.block.axes.items()
    }


def _grid_of(axis: Axis, path: str) -> Columns:
    if axis.grid is None:
        raise StudyError(
            f"{path}: a range needs count (placement: candidates) for methods grid and zip"
        )
    return axis.grid


def length(columns: Columns) -> int:
    """Number of rows."""
    return len(next(iter(columns.values()))) if columns else 1


def _check_names(parts: list[Columns], path: str) -> None:
    seen: set[str] = set()
    for columns in parts:
        for name in columns:
            if name in seen:
                raise StudyError(f"{path}: {name} varies twice; let one axis or block vary it")
            seen.add(name)
    for name in seen:
        whole = name.split("[")[0]
        if whole != name and whole in seen:
            raise StudyError(f"{path}: {whole} varies as a whole and by its entry {name}")


def _zip_columns(parts: list[Columns], path: str) -> Columns:
    sizes = [length(columns) for columns in parts]
    if len(set(sizes)) > 1:
        named = ", ".join(
            f"{'/'.join(columns)}: {size}" for columns, size in zip(parts, sizes, strict=True)
        )
        raise StudyError(f"{path}: axes of one length side by side; here {named}")
    return {name: column for columns in parts for name, column in columns.items()}


def _product(parts: list[Columns], path: str) -> Columns:
    sizes = [length(columns) for columns in parts]
    total = int(np.prod([float(size) for size in sizes]))
    if total > LIMIT:
        raise StudyError(f"{path}: {total:.3g} cases; allowed: up to {LIMIT}")
    result: dict[str, np.ndarray] = {}
    inner, outer = total, 1
    for columns, size in zip(parts, sizes, strict=True):
        inner //= size
        index = np.tile(np.repeat(np.arange(size), inner), outer)
        outer *= size
        result |= {name: column[index] for name, column in columns.items()}
    return result


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


def _sample(node: BlockNode, study: Study, seed: int) -> Columns:
    axes = _axes(node, study)
    dimensions = sum(axis.dimensions for axis in axes.values())
    points = unit_points(node, dimensions, seed)
    columns: dict[str, np.ndarray] = {}
    at = 0
    for path, axis in axes.items():
        part = axis.sample(points[:, at : at + axis.dimensions])
        for name in part:
            if name in columns:
                raise StudyError(f"{path}: {name} varies twice; let one axis vary it")
        columns |= part
        at += axis.dimensions
    return columns


def unit_points(node: BlockNode, dimensions: int, seed: int) -> np.ndarray:
    """Points of the unit cube for a sampling method, (n, dimensions).

    Raises:
        StudyError: the method returns something else.
    """
    method = METHODS[node.block.method]
    assert method.points is not None
    points = np.asarray(method.points(SamplingRequest(node.block, dimensions, seed, node.path)))
    is_right = points.dtype.kind == "f" and points.shape == (len(points) or 1, dimensions)
    if not is_right or not np.all((points >= 0) & (points <= 1)):
        raise StudyError(
            f"{node.path}.method = {method.name!r}: gives {points.dtype} of shape {points.shape}; "
            f"wanted one or more points of {dimensions} numbers from 0 to 1"
        )
    return points
