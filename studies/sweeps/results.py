"""Results of a sweep: as they are stored, and as they are read again."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import h5py
import jax
import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from jaxmodel.prepare import SPECTRUM_SPAN
from studies.errors import StudyError, field_error, nearest
from studies.fields import Fields
from studies.paths import NAMED_INDEX, field_unit, field_value, known_field, parse_entry
from studies.runs import DISTANCE_TEXT, STATUS_LABEL
from studies.stability import HIGHEST, MARGIN_MODES
from studies.store import Streamed, Variable, read_store, variable_labels, write_store
from studies.sweeps.axes import LABELS, SHOWN_AS
from studies.sweeps.chunks import Judged
from studies.sweeps.folder import (
    CHUNKS,
    JOINED,
    RESULTS,
    Finished,
    check_results,
    finished_cases,
    read_manifest,
)
from studies.sweeps.spec import SweepSpec, parse_sweep
from studies.sweeps.table import Table, as_numbers, build_table

#: Status of a case that has not been run.
NOT_RUN = -1
#: Names of the axes of fields that are lists, outermost first.
_LIST_AXES = {
    "patches.centers": ("link", "patch"),
    "control.links": ("link",),
    # lists of their own lengths
    "control.mode_mask": ("link", "mode_mask_entry"),
    "control.ratios": ("link", "ratios_entry"),
    "control.velocity_gain": ("link",),
    "control.position_gain": ("link",),
    "control.frequencies_hz": ("link", "frequencies_hz_entry"),
    "link.damping_ratio": ("link", "damping_ratio_entry"),
    "drive.pulse_force": ("slider_axis",),
    "load.wrench": ("pose_axis",),
    "load.pulse": ("pose_axis",),
    "metrics.stations": ("station",),
}
#: What every case has, finished or not: axes after `case`, unit, long name and any flags.
_PER_CASE: dict[str, tuple] = {
    "status": ((), *STATUS_LABEL[:2], {NOT_RUN: "not run", **STATUS_LABEL[2]}),
    "bad_time": ((), "s", "when the status appeared, 0 if ok"),
    "command_end": ((), "s", "end of the shaped command"),
    "substeps": ((), "1", "plant steps per sample"),
    "sensor_condition": (("link",), "1", "condition number of the modal filter"),
    "actuator_condition": (("link",), "1", "condition number of the synthesizer"),
    "singularity_distance": ((), "rad", DISTANCE_TEXT),
    "gain_margin": (
        (), "1", "largest factor on all gains with every smaller one stable, at the first "
        f"way-point with {MARGIN_MODES} plant modes or more; {HIGHEST:g}: that or more",
    ),
    "breaking_frequency": ((), "Hz", "of what goes unstable at the gain margin, NaN: nothing"),
    "breaking_mode": (
        (), "1", "order of the link mode nearest to that frequency, 0: the drive, NaN: nothing"
    ),
    "damping_ratio": (
        ("controlled_mode",), "1", "least of the modes of each order, of as many as links are "
        "controlled, the most damped ones",
    ),
}  # fmt: skip

#: Of these the smallest entry is the worst.
LEAST = ("damping_ratio",)


def kept_metrics(spec: SweepSpec) -> list[str]:
    """Metrics that a sweep keeps.

    Raises:
        StudyError: unknown metric, or one that the working precision does not hold.
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
            "sweep.metrics", written,
            f"with float32 a list of {', '.join(single)}, which it has within 1 %; "
            "leave --precision out for the others",
        )  # fmt: skip
    return kept


def chunk_variables(
    table: Table,
    rows: np.ndarray,
    judged: Judged,
    is_too_stiff: np.ndarray,
    substeps: int,
    kept: list[str],
) -> dict[str, Variable]:
    """What a chunk's file holds: ids, status, metrics of its cases, without padding.

    Args:
        table: all cases.
        rows: those of the chunk.
        judged: of the chunk, padded.
        is_too_stiff: per case of the chunk.
        substeps: plant steps per sample of its program.
        kept: metrics to keep.

    Returns:
        Variables; metrics of a case that did not finish, and of modes that it does not have, NaN.
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
    for name, (dims, *about) in _PER_CASE.items():
        data = known[name] if name in known else np.asarray(getattr(result, name))[:count]
        if name in LEAST:
            data = data.copy()
            _forget(data, dims.index("controlled_mode"), controlled)
        variables[name] = Variable(data, ("case", *dims), *about)
    for name in kept:
        data = np.array(result.metrics[name], copy=True)[:count]
        dims, unit, text = _label(name)
        if "mode" in dims:
            _forget(data, dims.index("mode"), modes)
        if "controlled_mode" in dims:
            _forget(data, dims.index("controlled_mode"), controlled)
        data[~is_finished] = np.nan
        variables[name] = Variable(data, ("case", *dims), unit, text)
    return variables


def _forget(data: np.ndarray, axis: int, count: np.ndarray) -> None:
    """NaN beyond the first `count` entries of an axis (after the one of cases)."""
    shape = [1] * data.ndim
    shape[axis + 1] = -1
    order = np.arange(data.shape[axis + 1]).reshape(shape)
    limit = count.reshape((-1,) + (1,) * (data.ndim - 1))
    data[np.broadcast_to(order >= limit, data.shape)] = np.nan


def variable_name(field: str) -> str:
    """Name in a file: `control.velocity_gain[0]` is `control_velocity_gain_0`."""
    return re.sub(r"\W+", "_", field).strip("_")


def case_variables(table: Table) -> dict[str, Variable]:
    """What tells the cases apart: number, id, seed, repeat and every column."""
    axis = ("case",)
    variables = {
        "case": Variable(np.arange(len(table)), axis, "1", "number of the case"),
        "case_id": Variable(table.case_id.astype(str), axis, "1", "hash of the case's parameters"),
        "seed": Variable(table.seed, axis, "1", "seed of noise and ripple"),
        "repeat": Variable(table.repeat, axis, "1", "number of the repeat"),
    }
    for name, column in table.columns.items():
        array = as_numbers(column)
        entry = parse_entry(name)
        field = entry.field if entry else name
        dims = _LIST_AXES.get(field, ())[-(array.ndim - 1) :] if array.ndim > 1 else ()
        if len(dims) != array.ndim - 1:
            dims = tuple(f"{variable_name(name)}_{k}" for k in range(1, array.ndim))
        variables[variable_name(name)] = Variable(array, (*axis, *dims), field_unit(field), name)
    return variables


def axis_variables(table: Table, sizes: Mapping[str, int]) -> dict[str, Variable]:
    """Coordinates of the metrics' axes."""
    found = {"link": Variable(np.arange(1, 4), ("link",), "1", "link number")}
    if "pose_axis" in sizes:
        names = np.array(["x", "y", "phi"])
        found["pose_axis"] = Variable(names, ("pose_axis",), "1", "pose component")
    if "station" in sizes and "metrics.stations" not in table.columns:
        stations = np.array(field_value(table.study, "metrics.stations"))
        found["station"] = Variable(stations, ("station",), "m", "position along the link")
    if "spectrum_point" in sizes:
        ratio = np.linspace(1 - SPECTRUM_SPAN, 1 + SPECTRUM_SPAN, sizes["spectrum_point"])
        found["spectrum_point"] = Variable(
            ratio, ("spectrum_point",), "1", "frequency over the modal frequency"
        )
    return found


@dataclass(frozen=True)
class SweepData:
    """A sweep as read: named arrays, and what belongs to them."""

    variables: dict[str, Variable]
    attributes: dict[str, Any]
    spec: SweepSpec

    def __getitem__(self, name: str) -> np.ndarray:
        return self.variables[name].data

    @cached_property
    def table(self) -> Table:
        """Its cases, spread once."""
        return build_table(self.spec)

    @property
    def n_cases(self) -> int:
        return len(self.variables["case"].data)

    @property
    def is_finished(self) -> np.ndarray:
        """Cases whose metrics hold, (n,)."""
        return np.isin(self["status"], status.FINISHED)

    def __repr__(self) -> str:
        done = int(np.sum(self["status"] != NOT_RUN))
        return (
            f"<sweep {self.spec.study.title!r}: {done} of {self.n_cases} cases, axes "
            f"{', '.join(swept_names(self))}; {len(self.variables)} variables>"
        )

    def to_xarray(self) -> Any:
        """The same as an xarray dataset.

        Raises:
            StudyError: xarray is not installed.
        """
        try:
            import xarray
        except ImportError:
            raise StudyError("xarray is missing: install flexlink-studies[xarray]") from None
        return xarray.Dataset(
            {name: (v.dims, v.data, variable_labels(v)) for name, v in self.variables.items()},
            attrs=self.attributes,
        )


def swept_names(data: SweepData) -> list[str]:
    """What varies, as variables of the file, in the order of the sweep; labels stand for fields."""
    columns = data.table.columns
    labelled = {LABELS[name] for name in columns if name in LABELS}
    return [variable_name(name) for name in columns if name not in labelled]


def load(path: str | Path) -> SweepData:
    """Read a sweep, finished or not; cases that have not been run have status -1 and NaN.

    Args:
        path: the sweep's folder.

    Raises:
        StudyError: no sweep there, or a damaged file.
    """
    folder = Path(path)
    written = read_manifest(folder)["spec"]
    spec = parse_sweep(written)
    if (folder / RESULTS).is_file() and not any((folder / CHUNKS).glob("*.h5")):
        check_results(folder)
        variables, attributes = read_store(folder / RESULTS)
        if json.loads(attributes["spec"]) == written:  # else an extension has begun
            return SweepData(variables, attributes, spec)
    table = build_table(spec)
    gathered = gather(table, finished_cases(folder))
    sizes = _sizes(gathered)
    variables = case_variables(table) | gathered | axis_variables(table, sizes)
    for axis, size in (_sizes(variables)).items():
        if axis not in variables:
            variables[axis] = Variable(np.arange(1, size + 1), (axis,), "1", f"number of {axis}")
    return SweepData(variables, {"title": spec.study.title}, spec)


def _sizes(variables: Mapping[str, Variable]) -> dict[str, int]:
    return {
        axis: size
        for v in variables.values()
        for axis, size in zip(v.dims, v.data.shape, strict=True)
    }


def gather(table: Table, finished: Finished) -> dict[str, Variable]:
    """Status and metrics of all cases of a table, from the files that hold them.

    Args:
        table: all cases.
        finished: from `finished_cases`.

    Returns:
        Variables with the axis `case`; NaN and status -1 for what is not there.
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
                if name not in _PER_CASE and name not in METRICS:
                    continue
                data = dataset[()]
                if name not in variables:
                    shape = (n, *largest[name][1:])
                    empty = np.full(shape, -1 if data.dtype.kind == "i" else np.nan)
                    dims, *label = _label(name)
                    filled = empty.astype(data.dtype)
                    variables[name] = Variable(filled, ("case", *dims), *label)
                inside = (target[chosen], *map(slice, data.shape[1:]))
                variables[name].data[inside] = data[finished.row[chosen]]
    if "status" not in variables:
        empty = np.full(n, NOT_RUN)
        variables["status"] = Variable(empty, ("case",), *_PER_CASE["status"][1:])
    return variables


def metric_values(data: SweepData, name: str) -> np.ndarray:
    """One number per case: a metric, an entry of it, or a field, (n,).

    A metric or condition number with more axes counts with its largest value, of the links that
    some case controls: `residual_rms` is that of the worst of them and its worst station,
    `residual_rms[link=3]` that of the worst station of link 3, controlled or not. Indices without
    a name count from 0. A field that does not vary has its value in every case.

    Raises:
        StudyError: unknown name or entry.
    """
    named = NAMED_INDEX.findall(name)
    if named:
        return _of_axes(data, NAMED_INDEX.sub("", name), named)
    entry = parse_entry(name)
    if entry is not None and entry.field in SHOWN_AS:
        name = SHOWN_AS[entry.field] + name[len(entry.field) :]
        entry = parse_entry(name)
    key = entry.field if entry else name
    variables = data.variables
    for candidate in (variable_name(name), variable_name(key)):
        if candidate in variables and variables[candidate].dims[:1] == ("case",):
            return _entry(data, name, entry.indices if entry else (), candidate)
    if "." in key:
        swept = data.table.columns
        if name == key and any(column.startswith(f"{key}[") for column in swept):
            raise StudyError(f"{key}: differs between links here; name one, such as {key}[0]")
        value = known_field(name, data.spec.study)
        if isinstance(value, tuple):
            raise StudyError(f"{name}: a list; name one entry of it, such as {name}[0]")
        return np.full(data.n_cases, value)
    known = [n for n, v in variables.items() if v.dims[:1] == ("case",)]
    close = nearest(key, known) or _turned(key, known)
    hint = f"did you mean {close!r}?" if close else f"known: {', '.join(known)}"
    raise StudyError(f"{name!r}: unknown metric or axis; {hint}")


def _of_axes(data: SweepData, name: str, named: list[tuple[str, str]]) -> np.ndarray:
    """Values of a metric at numbers of some of its axes, counted from 1."""
    if name not in data.variables or name not in (*METRICS, *_PER_CASE):
        metric_values(data, name)  # says what is wrong with it
        raise StudyError(f"{name!r}: indices that name an axis are for metrics")
    variable = data.variables[name]
    array, dims = variable.data, list(variable.dims)
    for axis, written in named:
        number, size = int(written), array.shape[dims.index(axis)] if axis in dims[1:] else 0
        if not 1 <= number <= size:
            allowed = ", ".join(
                f"{d} = 1 to {n}" for d, n in zip(dims[1:], array.shape[1:], strict=True)
            )
            raise StudyError(f"{name}[{axis}={written}]: allowed {allowed or 'no index'}")
        array = np.take(array, number - 1, axis=dims.index(axis))
        dims.remove(axis)
    return _worst(data, array, tuple(dims), name in LEAST)


def _worst(
    data: SweepData, array: np.ndarray, dims: tuple[str, ...], is_least: bool = False
) -> np.ndarray:
    """Largest number of each case, or least, of the links that count, (n,)."""
    if array.ndim == 1:
        return array
    if array.dtype.kind == "f" and "link" in dims:
        shape = [3 if d == "link" else 1 for d in dims]
        array = np.where(np.reshape(counted_links(data), shape), array, np.nan)
    flat = array.reshape(len(array), -1)
    if flat.dtype.kind != "f":
        return flat.max(axis=1)
    if is_least:
        return -_worst(data, -flat, ("case", "entry"))
    is_empty = np.all(np.isnan(flat), axis=1)
    return np.where(is_empty, np.nan, np.nanmax(np.where(np.isnan(flat), -np.inf, flat), axis=1))


def counted_links(data: SweepData) -> np.ndarray:
    """Links that a metric counts: those that some case controls, all where none does, (3,).

    The same for all cases, or fewer links under control would look like less vibration.
    """
    fields = Fields(data.spec.study, data.table.fields)
    is_closed = fields.raw("control.feedback") != "none"
    links = (fields.numbers("control.links") != 0) & is_closed[:, None]
    found = links.any(axis=0)
    return found if found.any() else np.ones(3, bool)


def _turned(name: str, known: list[str]) -> str:
    """A name of the same words in another order."""
    words = sorted(name.split("_"))
    return next((other for other in known if sorted(other.split("_")) == words), "")


def _entry(data: SweepData, name: str, indices: tuple[int, ...], candidate: str) -> np.ndarray:
    variable = data.variables[candidate]
    array, dims = variable.data, variable.dims
    if variable_name(name) != candidate or "[" not in name:
        used = indices
    else:
        used = ()  # the entry is a variable of its own
    for index in used:
        if array.ndim < 2 or index >= array.shape[1]:
            sizes = ", ".join(
                f"{axis}: 0 to {size - 1}"
                for axis, size in zip(variable.dims[1:], variable.data.shape[1:], strict=True)
            )
            raise StudyError(f"{name!r}: no such entry; indices allowed: {sizes or 'none'}")
        array, dims = array[:, index], (dims[0], *dims[2:])
    if array.ndim > 1 and candidate not in (*METRICS, *_PER_CASE):
        raise StudyError(f"{name!r}: a list; name one entry of it, such as {name}[0]")
    return _worst(data, array, dims, candidate in LEAST)


def manifest_attributes(manifest: Mapping[str, Any]) -> dict[str, Any]:
    """Global attributes of `results.h5`."""
    return {
        name.replace("-", "_"): json.dumps(value) if isinstance(value, dict) else str(value)
        for name, value in manifest.items()
    }


def merge(folder: Path, table: Table, finished: Finished, attributes: dict[str, Any]) -> None:
    """Join all finished cases in one file, file by file, so that memory stays small.

    Args:
        folder: the sweep's folder.
        table: all cases, in the order of the file.
        finished: from `finished_cases`.
        attributes: global ones.

    Raises:
        StudyError: no room on the disk, or it cannot be written to.
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
            dims, *label = _label(name)
            streamed = Streamed(
                (len(table), *shape[1:]), store[name].dtype, partial(parts, name)
            )  # fmt: skip
            variables[name] = Variable(streamed, ("case", *dims), *label)
    variables |= axis_variables(table, _sizes(variables))
    write_store(folder / JOINED, variables, attributes)


def _positions(table: Table, finished: Finished) -> tuple[np.ndarray, np.ndarray]:
    """Number of each finished case in the table, and whether it is one of its cases."""
    order = np.argsort(table.case_id)
    at = np.searchsorted(table.case_id[order], finished.case_id)
    target = order[np.minimum(at, len(table) - 1)]
    return target, table.case_id[target] == finished.case_id


def _largest(files: list[Path]) -> dict[str, tuple[int, ...]]:
    """Largest shape of each variable: programs of one sweep may have different mode counts."""
    largest: dict[str, tuple[int, ...]] = {}
    for file in files:
        with h5py.File(file, "r") as store:
            for name, dataset in store.items():
                if name in _PER_CASE or name in METRICS:
                    old = largest.get(name, dataset.shape)
                    largest[name] = tuple(map(max, old, dataset.shape))
    return largest


def _fitted(data: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Rows of a larger shape, NaN where they have nothing."""
    if data.shape[1:] == shape:
        return data
    whole = np.full((len(data), *shape), np.nan, data.dtype)
    whole[(slice(None), *map(slice, data.shape[1:]))] = data
    return whole


def _label(name: str) -> tuple:
    """Axes after `case`, unit, long name and any flags of what a chunk holds."""
    if name in _PER_CASE:
        return _PER_CASE[name]
    metric = METRICS[name]
    return metric.dims, metric.unit, metric.text
