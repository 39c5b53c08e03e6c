"""Writing a sweep's numbers to files: chunks, and the joined results."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
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
    ON_DEMAND,
    PER_CASE,
    axis_variables,
    case_variables,
    mask_unused,
    named,
)
from studies.engine.folder import JOINED, Finished
from studies.errors import StudyError, field_error, nearest
from studies.results.labelled import Variable
from studies.space.condition import evaluate
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable, metric_sizes
from studies.store import LazyArray, axis_sizes, write_store
from studies.study.entries import parse_entries
from studies.study.paths import NAMED_INDEX

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
    lost = inaccurate(kept)
    if lost:
        raise field_error(
            "sweep.metrics",
            lost if spec.sweep.metrics else [],
            f"with float32 a list of {accurate()}",
        )
    return kept


def check_names(spec: SweepSpec, table: CaseTable) -> None:
    """Reject a sweep that ranks by or asks for what no case has, before anything runs.

    Args:
        spec: the sweep.
        table: its cases, or some of them.

    Raises:
        StudyError: so it does.
    """
    metrics, sizes = kept_metrics(spec), metric_sizes(table)
    parse_entries(spec.sweep.by.removeprefix("-"), "sweep.by", sizes)

    def lookup(name: str) -> np.ndarray:
        key = NAMED_INDEX.sub("", name).partition("[")[0]
        if key in metrics:
            parse_entries(name, sizes=sizes)
        elif key in METRICS:
            raise StudyError(f"{name!r}: sweep.metrics does not keep it")
        elif key not in PER_CASE:
            close = nearest(key, (*metrics, *PER_CASE))
            if close:
                raise StudyError(f"unknown {name!r}; did you mean {close!r}?")
            return table.values(name)[:1]
        return np.ones(1)

    if spec.sweep.subject_to:
        evaluate(spec.sweep.subject_to, lookup, "sweep.subject_to")


def inaccurate(names: Iterable[str]) -> list[str]:
    """Those of some metrics that are too inaccurate in the working precision."""
    if jax.dtypes.canonicalize_dtype(np.float64) != np.float32:
        return []
    return [name for name in names if not METRICS[name].is_single]


def accurate() -> str:
    """Metrics that single precision has, for messages."""
    single = ", ".join(name for name, metric in METRICS.items() if metric.is_single)
    return f"{single}, which it has within 1 %; leave --precision out for the others"


def chunk_arrays(table: CaseTable, done: Done, kept: list[str]) -> dict[str, np.ndarray]:
    """Status, figures of the loop and metrics of a chunk's cases, without padding.

    Args:
        table: all cases.
        done: the chunk.
        kept: metrics to keep.

    Returns:
        One row per case; NaN for metrics of cases that did not finish, and of modes they do not
        have.
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
    margins |= {name: data[:count] for name, data in (loops.robustness or {}).items()}
    code = np.asarray(result.status)[:count].copy()
    code[done.chunk.is_too_stiff] = status.TOO_STIFF
    is_finished, margin = np.isin(code, status.FINISHED), margins["gain_margin"]
    code[is_finished & (margin < 1)] = status.UNSTABLE
    code[is_finished & np.isnan(margin) & done.judged.has_verdict] = status.UNJUDGED
    modes, controlled = (table.values(name)[rows] for name in ("link.modes", "control.modes"))
    arrays: dict[str, np.ndarray] = {}
    judged = {"status": code, "substeps": np.full(count, done.substeps), **margins}
    for name, (dims, *_) in PER_CASE.items():
        if name in ON_DEMAND and name not in judged:
            continue
        data = judged[name] if name in judged else np.asarray(getattr(result, name))[:count]
        if name in LEAST:
            data = data.copy()
            mask_unused(data, dims.index("controlled_mode"), controlled)
        arrays[name] = data
    for name in kept:
        data = np.array(result.metrics[name], copy=True)[:count]
        dims = METRICS[name].dims
        if "mode" in dims:
            mask_unused(data, dims.index("mode"), modes)
        if "controlled_mode" in dims:
            mask_unused(data, dims.index("controlled_mode"), controlled)
        data[~is_finished] = np.nan
        arrays[name] = data
    return arrays


def gather(table: CaseTable, finished: Finished) -> dict[str, Variable]:
    """Variables of all cases of a table, from the files that hold them.

    Args:
        table: all cases.
        finished: from `finished_cases`.

    Returns:
        Those that any file has, and the status; NaN and -1 for missing cases.
    """
    columns, whole = joined_columns(table, finished), slice(0, len(table))
    return {name: v._replace(data=v.data.read(whole)) for name, v in columns.items()}


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
) -> None:
    """Join all finished cases in one file, in parts to save memory.

    Args:
        folder: the sweep's folder.
        table: all cases, in the order of the file.
        finished: from `finished_cases`.
        attributes: global ones.

    Raises:
        StudyError: the disk is full or not writable.
    """
    variables = case_variables(table)
    labels = {**attributes, "coordinates": " ".join(variables)}  # for xarray
    variables |= joined_columns(table, finished)
    variables |= axis_variables(table.study, axis_sizes(variables), table.columns)
    write_store(folder / JOINED, variables, labels)


def joined_columns(table: CaseTable, finished: Finished) -> dict[str, Variable]:
    """The same as `gather`, but the data are read when they are needed."""
    order = np.argsort(table.case_id)
    at = np.searchsorted(table.case_id[order], finished.case_id)
    target = order[np.minimum(at, len(table) - 1)]
    is_known = table.case_id[target] == finished.case_id
    places = []
    for number, path in enumerate(finished.files):
        chosen = np.flatnonzero(is_known & (finished.file == number))
        chosen = chosen[np.argsort(target[chosen])]
        places.append((path, target[chosen], finished.row[chosen]))

    def read(name: str, shape: tuple[int, ...], dtype: np.dtype, rows: slice) -> np.ndarray:
        empty = np.nan if dtype.kind == "f" else NOT_RUN
        part = np.full((rows.stop - rows.start, *shape), empty, dtype)
        for path, at, row in places:
            inside = slice(*np.searchsorted(at, (rows.start, rows.stop)))
            if inside.start < inside.stop:
                with h5py.File(path, "r") as store:
                    if name not in store:  # of a sweep that an older version has extended
                        continue
                    data = store[name][()]
                into = (at[inside] - rows.start, *map(slice, data.shape[1:]))
                part[into] = data[row[inside]]
        return part

    columns = {}
    for name, (shape, dtype) in _largest(finished.files).items():
        column = LazyArray((len(table), *shape), dtype, partial(read, name, shape, dtype))
        columns[name] = named(name, column, "case")
    return columns


def _largest(files: list[Path]) -> dict[str, tuple[tuple[int, ...], np.dtype]]:
    """Largest shape of a row of each variable, and its type: programs differ in mode counts."""
    largest: dict[str, tuple[tuple[int, ...], np.dtype]] = {"status": ((), np.dtype(int))}
    names = (*PER_CASE, *METRICS)
    for file in files:
        with h5py.File(file, "r") as store:
            for name in (name for name in names if name in store):
                shape, dtype = store[name].shape[1:], store[name].dtype
                largest[name] = tuple(map(max, largest.get(name, (shape,))[0], shape)), dtype
    return largest
