"""Writing a sweep's numbers to files: chunks, and the joined results."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from jaxmodel import status
from jaxmodel.lazy import jax
from jaxmodel.metrics import METRICS
from studies.engine.columns import (
    LEAST,
    NOT_RUN,
    PER_CASE,
    axis_variables,
    case_variables,
    forget,
    label_of,
)
from studies.engine.folder import JOINED, Finished
from studies.errors import field_error, nearest
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable
from studies.store import Streamed, Variable, write_store

if TYPE_CHECKING:
    from studies.engine.chunks import JudgedChunk


def kept_metrics(spec: SweepSpec) -> list[str]:
    """Metrics that a sweep keeps.

    Raises:
        StudyError: unknown metric, or one too inaccurate in the working precision.
    """
    for name in spec.sweep.metrics:
        if name not in METRICS:
            hint = nearest(name, METRICS)
            raise field_error("sweep.metrics", name, ", ".join(METRICS), hint=hint)
    kept = list(spec.sweep.metrics or METRICS)
    single = [name for name, metric in METRICS.items() if metric.is_single]
    lost = [name for name in kept if name not in single]
    if lost and jax.dtypes.canonicalize_dtype(np.float64) == np.float32:
        written = lost if spec.sweep.metrics else []
        raise field_error(
            "sweep.metrics",
            written,
            f"with float32 a list of {', '.join(single)}, which it has within 1 %; "
            "leave --precision out for the others",
        )
    return kept


def chunk_variables(
    table: CaseTable,
    rows: np.ndarray,
    judged: JudgedChunk,
    is_too_stiff: np.ndarray,
    substeps: int,
    kept: list[str],
) -> dict[str, Variable]:
    """Contents of a chunk's file: ids, status, metrics of its cases, without padding.

    Args:
        table: all cases.
        rows: those of the chunk.
        judged: of the chunk, padded.
        is_too_stiff: per case of the chunk.
        substeps: plant steps per sample of its program.
        kept: metrics to keep.

    Returns:
        Variables; NaN for metrics of cases that did not finish, and of modes they do not have.
    """
    count, result = len(rows), judged.result
    margins = {name: data[:count] for name, data in judged.margins._asdict().items()}
    code = np.asarray(result.status)[:count].copy()
    code[is_too_stiff] = status.TOO_STIFF
    code[np.isin(code, status.FINISHED) & (margins["gain_margin"] < 1)] = status.UNSTABLE
    is_finished = np.isin(code, status.FINISHED)
    modes, controlled = (table.values(name)[rows] for name in ("link.modes", "control.modes"))
    variables = {
        "case_id": Variable(table.case_id[rows].astype(str), ("case",), "1", "hash of the case")
    }
    known = {"status": code, "substeps": np.full(count, substeps), **margins}
    for name, (dims, *about) in PER_CASE.items():
        data = known[name] if name in known else np.asarray(getattr(result, name))[:count]
        if name in LEAST:
            data = data.copy()
            forget(data, dims.index("controlled_mode"), controlled)
        variables[name] = Variable(data, ("case", *dims), *about)
    for name in kept:
        data = np.array(result.metrics[name], copy=True)[:count]
        dims, unit, text = label_of(name)
        if "mode" in dims:
            forget(data, dims.index("mode"), modes)
        if "controlled_mode" in dims:
            forget(data, dims.index("controlled_mode"), controlled)
        data[~is_finished] = np.nan
        variables[name] = Variable(data, ("case", *dims), unit, text)
    return variables


def axis_sizes(variables: Mapping[str, Variable]) -> dict[str, int]:
    return {
        axis: size
        for v in variables.values()
        for axis, size in zip(v.dims, v.data.shape, strict=True)
    }


def gather(table: CaseTable, finished: Finished) -> dict[str, Variable]:
    """Status and metrics of all cases of a table, from the files that hold them.

    Args:
        table: all cases.
        finished: from `finished_cases`.

    Returns:
        Variables with the axis `case`; NaN and status -1 for missing cases.
    """
    target, is_known = _positions(table, finished)
    variables: dict[str, Variable] = {}
    n = len(table)
    largest = _largest(finished.files)
    for number, file in enumerate(finished.files):
        chosen = is_known & (finished.file == number)
        if not chosen.any():
            continue
        with h5py.File(file, "r") as store:
            for name, dataset in store.items():
                if name not in PER_CASE and name not in METRICS:
                    continue
                data = dataset[()]
                if name not in variables:
                    shape = (n, *largest[name][1:])
                    empty = np.full(shape, -1 if data.dtype.kind == "i" else np.nan)
                    dims, *label = label_of(name)
                    filled = empty.astype(data.dtype)
                    variables[name] = Variable(filled, ("case", *dims), *label)
                inside = (target[chosen], *map(slice, data.shape[1:]))
                variables[name].data[inside] = data[finished.row[chosen]]
    if "status" not in variables:
        empty = np.full(n, NOT_RUN)
        variables["status"] = Variable(empty, ("case",), *PER_CASE["status"][1:])
    return variables


def manifest_attributes(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Global attributes of `results.h5`."""
    return {
        name.replace("-", "_"): json.dumps(value) if isinstance(value, dict) else str(value)
        for name, value in manifest.items()
    }


def merge(folder: Path, table: CaseTable, finished: Finished, attributes: dict[str, Any]) -> None:
    """Join all finished cases in one file, file by file to save memory.

    Args:
        folder: the sweep's folder.
        table: all cases, in the order of the file.
        finished: from `finished_cases`.
        attributes: global ones.

    Raises:
        StudyError: the disk is full or not writable.
    """
    target, is_known = _positions(table, finished)
    places = []
    for number, path in enumerate(finished.files):
        chosen = np.flatnonzero(is_known & (finished.file == number))
        chosen = chosen[np.argsort(target[chosen])]
        places.append((path, target[chosen], finished.row[chosen]))

    def parts(name: str) -> Iterator[tuple[int, np.ndarray]]:
        for path, target, row in places:
            with h5py.File(path, "r") as store:
                data = _fitted(store[name][()], largest[name][1:])
            breaks = np.flatnonzero(np.diff(target) != 1) + 1
            runs = zip(np.split(target, breaks), np.split(row, breaks), strict=True)
            yield from ((int(at[0]), data[rows]) for at, rows in runs if len(at))

    largest = _largest(finished.files)
    variables = case_variables(table)
    with h5py.File(finished.files[-1], "r") as store:
        for name, shape in largest.items():
            dims, *label = label_of(name)
            streamed = Streamed((len(table), *shape[1:]), store[name].dtype, partial(parts, name))
            variables[name] = Variable(streamed, ("case", *dims), *label)
    variables |= axis_variables(table, axis_sizes(variables))
    write_store(folder / JOINED, variables, attributes)


def _positions(table: CaseTable, finished: Finished) -> tuple[np.ndarray, np.ndarray]:
    """Number of each finished case in the table, and whether it is one of its cases."""
    order = np.argsort(table.case_id)
    at = np.searchsorted(table.case_id[order], finished.case_id)
    target = order[np.minimum(at, len(table) - 1)]
    return target, table.case_id[target] == finished.case_id


def _largest(files: list[Path]) -> dict[str, tuple[int, ...]]:
    """Largest shape of each variable: programs of one sweep can have different mode counts."""
    largest: dict[str, tuple[int, ...]] = {}
    for file in files:
        with h5py.File(file, "r") as store:
            for name, dataset in store.items():
                if name in PER_CASE or name in METRICS:
                    old = largest.get(name, dataset.shape)
                    largest[name] = tuple(map(max, old, dataset.shape))
    return largest


def _fitted(data: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Rows padded to a larger shape with NaN."""
    if data.shape[1:] == shape:
        return data
    whole = np.full((len(data), *shape), np.nan, data.dtype)
    whole[(slice(None), *map(slice, data.shape[1:]))] = data
    return whole
