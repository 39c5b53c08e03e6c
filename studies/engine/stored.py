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
    LEFT_OUT,
    NOT_RUN,
    PER_CASE,
    SCREENED,
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
    from studies.engine.chunks import Done


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


def chunk_variables(table: CaseTable, done: Done, kept: list[str]) -> dict[str, Variable]:
    """Contents of a chunk's file: ids, status, metrics of its cases, without padding.

    Args:
        table: all cases.
        done: the chunk.
        kept: metrics to keep.

    Returns:
        Variables; NaN for metrics of cases that did not finish, and of modes they do not have.
    """
    rows, result = done.chunk.rows, done.judged.result
    count = len(rows)
    loops = done.judged.margins
    margins = {
        "gain_margin": loops.gain_margin[:count],
        "breaking_frequency": loops.breaking_frequency[:count],
        "breaking_mode": loops.breaking_mode[:count],
        "damping_ratio": loops.least_damping[:count],
    }
    code = np.asarray(result.status)[:count].copy()
    code[done.chunk.is_too_stiff] = status.TOO_STIFF
    code[np.isin(code, status.FINISHED) & (margins["gain_margin"] < 1)] = status.UNSTABLE
    is_finished = np.isin(code, status.FINISHED)
    modes, controlled = (table.values(name)[rows] for name in ("link.modes", "control.modes"))
    variables = {
        "case_id": Variable(table.case_id[rows].astype(str), ("case",), "1", "hash of the case")
    }
    known = {"status": code, "substeps": np.full(count, done.substeps), **margins}
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
    target, is_known = positions(table, finished)
    variables: dict[str, Variable] = {}
    n = len(table)
    largest = _largest(finished.files, (*PER_CASE, *METRICS))
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
                    shape = (n, *largest[name][0][1:])
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


def merge(
    folder: Path,
    table: CaseTable,
    finished: Finished,
    attributes: dict[str, Any],
    screened: Finished | None = None,
) -> None:
    """Join all finished cases in one file, file by file to save memory.

    Args:
        folder: the sweep's folder.
        table: all cases, in the order of the file.
        finished: from `finished_cases`.
        attributes: global ones.
        screened: the same for the screen, if there is one.

    Raises:
        StudyError: the disk is full or not writable.
    """
    variables = case_variables(table)
    rest = np.full(len(table), NOT_RUN)
    if screened is not None:
        target, is_known = positions(table, screened)
        code = joined(screened, "screen_status")
        # what no run can start with is a fault in either model
        left = np.where(np.isin(code, status.FINISHED), LEFT_OUT, code)
        rest[target[is_known]] = left[is_known]
        variables |= _streamed(table, screened, tuple(SCREENED), np.full(len(table), NOT_RUN))
    found = _streamed(table, finished, (*PER_CASE, *METRICS), rest)
    variables |= found or {"status": Variable(rest, ("case",), *PER_CASE["status"][1:])}
    variables |= axis_variables(table, axis_sizes(variables))
    write_store(folder / JOINED, variables, attributes)


#: Bytes of a variable that are joined at once.
BLOCK_BYTES = 2**25


def joined(finished: Finished, name: str) -> np.ndarray:
    """Values of a number of each finished case, (n,).

    Args:
        finished: from `finished_cases`.
        name: of the number.
    """
    found = np.empty(len(finished.case_id))
    for number, path in enumerate(finished.files):
        chosen = finished.file == number
        with h5py.File(path, "r") as store:
            found[chosen] = store[name][()][finished.row[chosen]]
    return found


def _streamed(
    table: CaseTable, finished: Finished, names: tuple[str, ...], rest: np.ndarray
) -> dict[str, Variable]:
    """Variables of these names, read from the files that hold them as they are written.

    Args:
        table: all cases.
        finished: where they are.
        names: of the variables, as far as they exist.
        rest: codes of cases that are in no file, (n,).
    """
    target, is_known = positions(table, finished)
    places = []
    for number, path in enumerate(finished.files):
        chosen = np.flatnonzero(is_known & (finished.file == number))
        chosen = chosen[np.argsort(target[chosen])]
        places.append((path, target[chosen], finished.row[chosen]))

    def parts(name: str, shape: tuple[int, ...], dtype: np.dtype) -> Iterator[Any]:
        size = max(1, BLOCK_BYTES // (dtype.itemsize * int(np.prod(shape[1:]))))
        for start in range(0, shape[0], size):
            count = min(size, shape[0] - start)
            whole = np.full((count, *shape[1:]), np.nan if dtype.kind == "f" else NOT_RUN, dtype)
            if name == "status":
                whole[:] = rest[start : start + count]
            for path, at, row in places:
                here = slice(*np.searchsorted(at, (start, start + count)))
                if here.start < here.stop:
                    with h5py.File(path, "r") as store:
                        data = _fitted(store[name][()], shape[1:])
                    whole[at[here] - start] = data[row[here]]
            yield start, whole

    variables = {}
    for name, (shape, dtype) in _largest(finished.files, names).items():
        dims, *label = label_of(name)
        whole = (len(table), *shape[1:])
        streamed = Streamed(whole, dtype, partial(parts, name, whole, dtype))
        variables[name] = Variable(streamed, ("case", *dims), *label)
    return variables


def positions(table: CaseTable, finished: Finished) -> tuple[np.ndarray, np.ndarray]:
    """Number of each finished case in the table, and whether it is one of its cases."""
    order = np.argsort(table.case_id)
    at = np.searchsorted(table.case_id[order], finished.case_id)
    target = order[np.minimum(at, len(table) - 1)]
    return target, table.case_id[target] == finished.case_id


def _largest(
    files: list[Path], names: tuple[str, ...]
) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Largest shape of each variable, and its type: programs can have different mode counts."""
    largest: dict[str, tuple[tuple[int, ...], np.dtype]] = {}
    for file in files:
        with h5py.File(file, "r") as store:
            for name, dataset in store.items():
                if name in names:
                    shape = largest[name][0] if name in largest else dataset.shape
                    largest[name] = tuple(map(max, shape, dataset.shape)), dataset.dtype
    return largest


def _fitted(data: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Rows padded to a larger shape with NaN."""
    if data.shape[1:] == shape:
        return data
    whole = np.full((len(data), *shape), np.nan, data.dtype)
    whole[(slice(None), *map(slice, data.shape[1:]))] = data
    return whole
