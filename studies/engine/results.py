"""Results of a sweep: reading them, and their metrics."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.columns import (
    LARGEST_FIRST,
    LEAST,
    PER_CASE,
    axis_variables,
    case_variables,
)
from studies.engine.folder import (
    BASELINE,
    CHUNKS,
    MANIFEST,
    RESULTS,
    Finished,
    finished_cases,
    read_manifest,
    steady,
)
from studies.engine.stored import gather
from studies.errors import StudyError, field_error, nearest
from studies.reading import parse_json
from studies.results.labelled import Variable
from studies.space.axes import LABELS, SHOWN_AS
from studies.space.condition import evaluate
from studies.space.spec import SweepSpec, parse_sweep
from studies.space.table import CaseTable, build_table, case_ids, designs
from studies.store import axis_sizes, numbers_digest, read_store, with_coordinates
from studies.study.fields import Fields
from studies.study.paths import NAMED_INDEX, known_field, parse_entry

#: Relative difference of equal runs of different programs, at most [1].
ROUNDING = 1e-6


@dataclass(frozen=True)
class SweepData:
    """A sweep as read: named arrays and their metadata."""

    variables: dict[str, Variable]
    attributes: dict[str, Any]
    spec: SweepSpec
    cases: CaseTable | None = None  # where they are at hand, or not all of the sweep's
    baseline: dict[str, Variable] = field(default_factory=dict)  # without control; {}: not known
    notes: tuple[str, ...] = ()  # why finished cases of its folder are not among them

    def __getitem__(self, name: str) -> np.ndarray:
        return self.variables[name].data

    @cached_property
    def table(self) -> CaseTable:
        """Its cases, built once."""
        if self.cases is not None:
            return self.cases
        table = build_table(self.spec)
        if len(table) != self.n_cases:
            raise StudyError(
                f"{RESULTS}: {self.n_cases} cases; its sweep has {len(table)}. An older version "
                "ran equal cases twice: run its sweep anew, in a new folder"
            )
        return table

    @cached_property
    def designs(self) -> np.ndarray:
        """Number of the design of each case, from 0, (n,): cases apart in environments are one."""
        return designs(self.table, self.spec.sweep.environments)

    @property
    def n_cases(self) -> int:
        return len(self.variables["status"].data)

    @property
    def is_finished(self) -> np.ndarray:
        """Cases with valid metrics, (n,)."""
        return np.isin(self["status"], status.FINISHED)

    def __repr__(self) -> str:
        done = int(np.sum(self["status"] >= 0))
        return (
            f"<sweep {self.spec.study.title!r}: {done} of {self.n_cases} cases, axes "
            f"{', '.join(swept_names(self))}; {len(self.variables)} variables>"
        )


def swept_names(data: SweepData) -> list[str]:
    """What varies, as variables of the file, in the order of the sweep; labels stand for fields."""
    return data.table.axes


def read_sweep(path: str | Path, cases: CaseTable | None = None) -> SweepData:
    """Read a sweep, finished or not; cases that have not run have status -1 and NaN.

    Args:
        path: the sweep's folder.
        cases: its table, if it is at hand.

    Raises:
        StudyError: no sweep there, a damaged file, or results of another version.
    """
    if not isinstance(path, str | os.PathLike):
        raise field_error("path", path, "the folder of a sweep")
    data: SweepData = steady(Path(path), lambda: _read(Path(path), cases))
    return data


def _read(folder: Path, cases: CaseTable | None) -> SweepData:
    written = read_manifest(folder)["spec"]
    spec = parse_sweep(written)
    baseline = read_baseline(folder, spec)
    if (folder / RESULTS).is_file() and not any((folder / CHUNKS).glob("*.h5")):
        finished_cases(folder)  # refuses what no sweep has written
        variables, attributes = read_store(folder / RESULTS)
        try:
            is_whole = parse_json(attributes["spec"]) == written
        except (KeyError, TypeError, ValueError) as error:
            raise StudyError(f"{folder / RESULTS}: damaged (spec: {error})") from None
        if is_whole:  # otherwise an extension has started
            return SweepData(variables, attributes, spec, cases, baseline)
    table = build_table(spec) if cases is None else cases
    finished = finished_cases(folder)
    gathered = gather(table, finished)
    axes = axis_variables(spec.study, axis_sizes(gathered), table.columns)
    variables = case_variables(table) | gathered | axes
    variables = with_coordinates(variables)
    notes = tuple(_not_shown(folder, table, finished))
    return SweepData(variables, {"title": spec.study.title}, spec, table, baseline, notes)


def _not_shown(folder: Path, table: CaseTable, finished: Finished) -> Iterator[str]:
    """Why finished cases of a folder are not shown."""
    strange = int(np.sum(~np.isin(finished.case_id, table.case_id)))
    if strange:
        has = "case in this folder is" if strange == 1 else "cases in this folder are"
        yield (
            f"{strange:,} finished {has} not of this sweep: {folder / MANIFEST} has another study "
            "or other axes than the one that ran them. They are not shown."
        )
    if finished.damaged:
        names = ", ".join(chunk.name for chunk in finished.damaged[:NAMED])
        yield (
            f"{len(finished.damaged):,} of the files in {folder / CHUNKS} are damaged ({names}): "
            "their cases count as not run yet, and run again with --resume."
        )


#: Damaged files that a note names.
NAMED = 3
#: Axes of what the baseline's file holds beside metrics.
BASELINE_DIMS: dict[str, tuple[str, ...]] = {"status": (), "adc_step": ("link",)}


def read_baseline(folder: Path, spec: SweepSpec) -> dict[str, Variable]:
    """The baseline of a sweep without control: its status and metrics, and one ADC step.

    Args:
        folder: of the sweep.
        spec: the sweep.

    Returns:
        {} where that is not stored.

    Raises:
        StudyError: a damaged file.
    """
    path = folder / BASELINE
    if not path.is_file():
        return {}
    try:
        variables, attributes = read_store(path)
    except StudyError:
        raise StudyError(f"{path}: damaged; remove it and go on with --resume") from None
    n_links = spec.study.n_links
    for name, stored in variables.items():
        dims = BASELINE_DIMS.get(name, METRICS[name].dims if name in METRICS else None)
        if dims is None:
            continue
        sizes = dict(zip(stored.dims, stored.data.shape, strict=False))
        if (
            stored.dims != dims
            or sizes.get("link", n_links) != n_links
            or stored.data.dtype.kind not in "if"
        ):
            raise StudyError(f"{path}: damaged ({name}); remove it and go on with --resume")
    if attributes.get(DIGEST) not in (None, baseline_digest(variables)):  # None: an older one
        raise StudyError(f"{path}: damaged; remove it and go on with --resume")
    return variables if attributes.get("case_id") == baseline_id(spec) else {}


#: Attribute of the baseline's file.
DIGEST = "digest"


def baseline_digest(variables: Mapping[str, Variable]) -> str:
    """Hash of a baseline's numbers."""
    own = {name for name in variables if name in BASELINE_DIMS or name in METRICS}
    return numbers_digest({name: variables[name].data for name in own})


def baseline_id(spec: SweepSpec) -> str:
    """Hash of all parameters of a sweep's baseline."""
    return str(case_ids(spec.study, {}, np.zeros(1, int))[0].decode())


def is_worse(values: np.ndarray, uncontrolled: float) -> np.ndarray:
    """Which values of a metric are above that without control by more than rounding, (n,)."""
    with np.errstate(invalid="ignore"):
        return np.asarray(values > uncontrolled * (1 + ROUNDING))


def uncontrolled_value(data: SweepData, name: str) -> float | None:
    """A metric of the baseline without control, as `metric_values`.

    None if it is not known, or if the cases' windows and stations differ from the baseline's.
    """
    if any(field.startswith("metrics.") for field in data.table.fields):
        return None
    if name.partition("[")[0] not in set(METRICS) & set(data.baseline):
        return None
    variables = {
        key: Variable(x.data[None], ("case", *x.dims), x.units, x.long_name)
        for key, x in data.baseline.items()
    }
    try:
        value = metric_values(replace(data, variables=variables, cases=data.table), name)[0]
    except StudyError:  # an entry that the baseline does not have
        return None
    return float(value) if np.isfinite(value) else None


def metric_values(data: SweepData, name: str) -> np.ndarray:
    """One number per case: a metric, an entry of it, or a field, (n,).

    A metric or condition number with more axes counts with its largest value over the links of
    `counted_links`: `residual_rms` is that of the worst link and its worst station,
    `residual_rms[link=3]` that of the worst station of link 3, controlled or not. Of poses, x and y
    count; `pose_error_peak[2]` is the angle. Indices without a name count from 0. A field that does
    not vary has the same value in every case.

    Raises:
        StudyError: unknown name or entry.
    """
    labels = [x for x, field in LABELS.items() if field == name and x in data.variables]
    if labels and data[name].ndim > 1:
        name = labels[0]
    named = NAMED_INDEX.findall(name)
    if named:
        return _of_axes(data, NAMED_INDEX.sub("", name), named)
    entry = parse_entry(name)
    if entry is not None and entry.field in SHOWN_AS:
        name = SHOWN_AS[entry.field] + name[len(entry.field) :]
        entry = parse_entry(name)
    key = entry.field if entry else name
    variables = data.variables
    for candidate, indices in ((name, ()), (key, entry.indices if entry else ())):
        if candidate in variables and variables[candidate].dims[:1] == ("case",):
            return _entry(data, name, indices, candidate)
    if "." in key:
        swept = data.table.columns
        if name == key and any(column.startswith(f"{key}[") for column in swept):
            raise StudyError(f"{key}: differs between links here; name one, such as {key}[0]")
        value = known_field(name, data.spec.study)
        if isinstance(value, tuple):
            raise StudyError(f"{name}: a list; name one entry of it, such as {name}[0]")
        return np.full(data.n_cases, value)
    names = [n for n, v in variables.items() if v.dims[:1] == ("case",)]
    ready = [n for n, field in SHOWN_AS.items() if field in names]
    close = nearest(key, [*ready, *names]) or _same_words(key, names)
    hint = f"did you mean {close!r}?" if close else f"known: {', '.join(names)}"
    if key in METRICS and key in (data.spec.sweep.metrics or METRICS):
        raise StudyError(f"{name!r}: no case has finished, so none has it")
    if any(np.any(data[n] == key) for n in names if data[n].dtype.kind in "OSUT"):
        hint = f"a text stands in quotes: '{key}'"
    raise StudyError(f"{name!r}: unknown metric or axis; {hint}")


def meets(data: SweepData, condition: str, field: str) -> np.ndarray:
    """Cases for which a condition on metrics and axes holds; a missing number meets none, (n,).

    Args:
        data: the sweep.
        condition: "" for all cases.
        field: where the condition is written, for messages.

    Raises:
        StudyError: not a condition, or unknown names in it.
    """
    is_known = np.ones(data.n_cases, bool)
    if not condition:
        return is_known

    def lookup(name: str) -> np.ndarray:
        nonlocal is_known
        values = metric_values(data, name)
        if values.dtype.kind == "f":
            is_known = is_known & ~np.isnan(values)  # so that "not x < 2" does not hold either
        return values

    truth = evaluate(condition, lookup, field)
    return np.broadcast_to(truth, is_known.shape) & is_known


def direction(by: str) -> str:
    """Which values of a metric come first: "smallest" or "largest"; - in front reverses that."""
    is_large = by.removeprefix("-").partition("[")[0] in LARGEST_FIRST
    return "largest" if is_large != by.startswith("-") else "smallest"


def _of_axes(data: SweepData, name: str, named: list[tuple[str, str]]) -> np.ndarray:
    """Values of a metric at given indices of some of its axes, counted from 1."""
    if name not in data.variables or name not in (*METRICS, *PER_CASE):
        metric_values(data, name)  # reports what is wrong with it
        raise StudyError(f"{name!r}: indices that name an axis are for metrics")
    variable = data.variables[name]
    array, dims = variable.data, list(variable.dims)
    for axis, written in named:
        number, size = int(written), array.shape[dims.index(axis)] if axis in dims[1:] else 0
        if not 1 <= number <= size:
            allowed = ", ".join(
                f"{d} = 1 to {n}" for d, n in zip(dims[1:], array.shape[1:], strict=True)
            )
            raise StudyError(f"{name}[{axis}={written}]; allowed: {allowed or 'no index'}")
        array = np.take(array, number - 1, axis=dims.index(axis))
        dims.remove(axis)
    return _worst(data, array, tuple(dims), name in LEAST)


def _worst(
    data: SweepData, array: np.ndarray, dims: tuple[str, ...], is_least: bool = False
) -> np.ndarray:
    """Largest, or least, value of each case over the links that count, (n,)."""
    if array.ndim == 1:
        return array
    if "pose_axis" in dims:  # the angle has another unit
        array = np.take(array, (0, 1), axis=dims.index("pose_axis"))
    if array.dtype.kind == "f" and "link" in dims:
        shape = [-1 if d == "link" else 1 for d in dims]
        array = np.where(np.reshape(counted_links(data), shape), array, np.nan)
    flat = array.reshape(len(array), -1)
    if flat.dtype.kind != "f":
        return flat.max(axis=1)
    if is_least:
        return -_worst(data, -flat, ("case", "entry"))
    is_empty = np.all(np.isnan(flat), axis=1)
    return np.where(is_empty, np.nan, np.nanmax(np.where(np.isnan(flat), -np.inf, flat), axis=1))


def counted_links(data: SweepData) -> np.ndarray:
    """Links that a metric of a sweep counts, (n,)."""
    return links_of(data.spec, None if data.spec.sweep.links else data.table)


def links_of(spec: SweepSpec, table: CaseTable | None) -> np.ndarray:
    """Links that a metric of some cases counts, (n,).

    Those of `sweep.links`, else those that any case controls, all if none does: the same for all
    cases; otherwise fewer controlled links would look like less vibration.
    """
    if named := spec.sweep.links:
        return np.isin(np.arange(spec.study.n_links) + 1, named)
    assert table is not None  # a sweep that names no links has its cases
    is_counted = np.any(controlled(table), axis=0)
    return is_counted if is_counted.any() else np.ones_like(is_counted)


def controlled(table: CaseTable) -> np.ndarray:
    """Which links each case controls, (n, 3), or (1, 3) if they are the same in all."""
    fields = Fields(table.study, table.fields)
    is_closed = fields.raw("control.feedback") != "none"
    return (fields.numbers("control.links") != 0) & is_closed[:, None]


def _same_words(name: str, names: list[str]) -> str:
    """One of the names with the same words in another order."""
    words = sorted(name.split("_"))
    return next((other for other in names if sorted(other.split("_")) == words), "")


def _entry(data: SweepData, name: str, indices: tuple[int, ...], candidate: str) -> np.ndarray:
    variable = data.variables[candidate]
    array, dims = variable.data, variable.dims
    for index in indices:
        if array.ndim < 2 or index >= array.shape[1]:
            sizes = ", ".join(
                f"{axis}: 0 to {size - 1}"
                for axis, size in zip(variable.dims[1:], variable.data.shape[1:], strict=True)
            )
            raise StudyError(f"{name!r}: no such entry; indices allowed: {sizes or 'none'}")
        array, dims = array[:, index], (dims[0], *dims[2:])
    if array.ndim > 1 and candidate not in (*METRICS, *PER_CASE):
        raise StudyError(f"{name!r}: a list; name one entry of it, such as {name}[0]")
    return _worst(data, array, dims, candidate in LEAST)
