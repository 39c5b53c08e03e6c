"""The cases of a sweep as a table: columns of values, and for each case its id and its seed.

The id is a hash of all parameters of the case, swept or not, and of its repeat; the seed follows
from the study's seed and the id. Both are thus the same in any sweep that contains the case.
"""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import blake2b
from itertools import product
from typing import Any

import numpy as np

from studies.errors import StudyError, field_error, nearest
from studies.space.axes import ALIASES, LABELS, LIMIT, READY_MADE, SHOWN_AS
from studies.space.condition import evaluate
from studies.space.designs import design_of
from studies.space.spec import SweepSpec
from studies.study.consistency import EACH_PATCH, SAMPLE_LIMIT
from studies.study.entries import entry_sizes
from studies.study.fields import Columns, Fields, acting_columns, padded, row_keys
from studies.study.paths import (
    Parts,
    as_list,
    known_field,
    parse_entry,
    replaced,
    set_value,
)
from studies.study.spec import AUTO, Study, parse_study
from studies.study.window import DELAY, check_varied


@dataclass(frozen=True)
class CaseTable:
    """All cases; a column whose name has no dot is a label that stands for other columns."""

    study: Study  # values of all fields without a column
    columns: Columns  # one row per case
    repeat: np.ndarray  # number of the repeat, (n,)
    n_dropped: int  # cases excluded by `where`
    origin: np.ndarray  # for each row of the design, including duplicates, the number of its case
    row: np.ndarray  # number of its row in the design, from 0, (n,)

    def __len__(self) -> int:
        return len(self.repeat)

    @cached_property
    def case_id(self) -> np.ndarray:
        """16 hexadecimal digits as bytes, (n,)."""
        return case_ids(self.study, self.columns, self.repeat)

    @cached_property
    def seed(self) -> np.ndarray:
        """Of noise and ripple, (n,)."""
        return _seeds(self.study, self.columns, self.case_id)

    @property
    def n_double(self) -> int:
        """Number of rows of the design that duplicate an earlier one."""
        return len(self.origin) - len(self)

    @property
    def axes(self) -> list[str]:
        """What varies, in the order of the sweep; labels stand for their fields."""
        labelled = {LABELS[name] for name in self.columns if name in LABELS}
        return [name for name in self.columns if name not in labelled]

    @property
    def fields(self) -> dict[str, np.ndarray]:
        """Columns of fields, without labels."""
        return {name: column for name, column in self.columns.items() if "." in name}

    def values(self, name: str) -> np.ndarray:
        """Values of a field, an entry or a label for every case, (n,); errors as `values`."""
        return np.broadcast_to(values(self.study, self.columns, name), (len(self),))

    def rows(self, chosen: np.ndarray, origin: np.ndarray | None = None) -> CaseTable:
        """Some of the cases; `origin`, if they stand for all."""
        part = replace(
            self,
            origin=self.origin if origin is None else origin,
            columns={name: column[chosen] for name, column in self.columns.items()},
            repeat=self.repeat[chosen],
            row=self.row[chosen],
        )
        made = {name: vars(self)[name] for name in ("case_id", "seed") if name in vars(self)}
        vars(part).update({name: column[chosen] for name, column in made.items()})
        return part


def environment_columns(names: Iterable[str], columns: Iterable[str]) -> set[str]:
    """Columns of the axes that `sweep.environments` names, their labels and entries.

    Raises:
        StudyError: a name of no axis.
    """
    found: set[str] = set()
    for name in names:
        stands_for = {name, LABELS.get(name, name), SHOWN_AS.get(name, name)}
        own = {x for x in columns if x in stands_for or x.startswith(f"{name}[")}
        own |= {label for label, field in LABELS.items() if field in own and label in columns}
        if not own:
            known = [x for x in columns if x not in LABELS.values()]
            raise field_error(
                "sweep.environments", name, ", ".join(known), hint=nearest(name, known)
            )
        found |= own
    return found


def designs(table: CaseTable, environments: Iterable[str]) -> np.ndarray:
    """Number of the design of each case, from 0, (n,).

    Args:
        table: the cases.
        environments: axes in which cases of a design differ; without any, each case is one.
    """
    outside = environment_columns(environments, table.columns)
    if not outside:
        return np.arange(len(table))
    codes = [np.zeros(len(table), int)]
    acting = acting_columns(table.study, table.columns)
    codes += [_codes(column) for name, column in acting.items() if name not in outside]
    return np.unique(np.stack(codes, axis=1), axis=0, return_inverse=True)[1].ravel()


def _codes(column: np.ndarray) -> np.ndarray:
    """A number for each different value of a column, (n,)."""
    if column.dtype == object:
        known: dict[str, int] = {}
        return np.array([known.setdefault(repr(value), len(known)) for value in column])
    axis = 0 if column.ndim > 1 else None
    return np.unique(column, axis=axis, return_inverse=True)[1].ravel()


def build_table(spec: SweepSpec, rows: np.ndarray | None = None, has_ids: bool = True) -> CaseTable:
    """Expand a sweep into its cases.

    Args:
        spec: the sweep.
        rows: numbers of those rows of its design that are wanted, ascending, (n,); None: all.
        has_ids: cases that repeat the parameters of an earlier one are found by their ids, which
            take longer than all else here; otherwise by their columns, and ids are made when they
            are asked for.

    Raises:
        StudyError: a bad axis or condition, no case left, columns that do not fit one program.
    """
    design = design_of(spec.root, spec.study, spec.sweep.seed)
    is_whole = rows is None
    if rows is None:
        if design.size > LIMIT:
            raise StudyError(
                f"sweep: {design.size:.3g} cases; allowed: up to {LIMIT}; sweep.keep finds the "
                "best of more"
            )
        rows = np.arange(design.size)
    columns = _with_subsets(design.rows(rows))
    environment_columns(spec.sweep.environments, columns)
    _check_shapes(columns)
    _check_samples(spec.study, columns)
    _check_moves(spec.study, columns)
    check_varied(spec.data, spec.study, columns)
    _check_read(spec.study, columns)
    if np.any(columns.get(DELAY, np.zeros(1)).astype(str) == AUTO):
        raise field_error(DELAY, AUTO, "numbers in an axis; without the axis, 'auto' holds", "s")
    n = len(rows)
    kept = np.arange(n)
    if spec.sweep.where:
        truth = evaluate(
            spec.sweep.where, lambda name: values(spec.study, columns, name), "sweep.where"
        )
        kept = np.flatnonzero(np.broadcast_to(truth, (n,)))
    if len(kept) == 0 and is_whole:
        raise StudyError(f"sweep.where = {spec.sweep.where!r}: true for none of {n} cases")
    repeats = spec.sweep.repeats
    if len(kept) * repeats > LIMIT:
        raise field_error(
            "sweep.repeats", repeats, f"at most {LIMIT // len(kept)} with {len(kept)} cases"
        )
    index = np.repeat(kept, repeats)
    columns = {name: column[index] for name, column in columns.items()}
    repeat = np.tile(np.arange(repeats), len(kept))
    origin = np.arange(len(index))
    table = CaseTable(spec.study, columns, repeat, n - len(kept), origin, rows[index])
    keys = table.case_id if has_ids else _keys(table)
    _, first, which = np.unique(keys, return_index=True, return_inverse=True)
    single = np.sort(first)
    if len(single) == len(table):
        return table
    return table.rows(single, np.searchsorted(single, first[which]))


def all_columns(spec: SweepSpec) -> Columns:
    """Columns of every row of a sweep's design, without `where` and with those that repeat."""
    design = design_of(spec.root, spec.study, spec.sweep.seed)
    return _with_subsets(design.rows(np.arange(design.size)))


def _with_subsets(columns: Columns) -> Columns:
    """With names of the links that are controlled, where lists of switches vary."""
    if "control.links" not in columns or "link_subsets" in columns:
        return columns
    numbers = (np.flatnonzero(row) + 1 for row in columns["control.links"])
    names = ["+".join(map(str, one)) or "none" for one in numbers]
    return {**columns, "link_subsets": np.array(names)}


def _keys(table: CaseTable) -> np.ndarray:
    """Bytes that are equal for cases with equal columns, (n,)."""
    acting = acting_columns(table.study, table.fields)
    columns = [table.repeat, *acting.values()]
    return row_keys(_codes(x) if x.dtype.kind not in "bif" else x for x in columns)


def values(study: Study, columns: Columns, name: str) -> np.ndarray:
    """Values of a field, an entry or a label for all cases, (n,) or (1,) if it does not vary.

    Raises:
        StudyError: no such name, or a whole list where one value is needed.
    """
    name = ALIASES.get(name, name)
    if name in columns and columns[name].ndim == 1 and columns[name].dtype != object:
        return columns[name]
    value = known_field(name, study, others=READY_MADE)
    entry = parse_entry(name)
    assert entry is not None
    if isinstance(value, tuple):
        raise StudyError(f"{name}: a list; name one entry of it, such as {name}[0]")
    if any(column.startswith(f"{name}[") for column in columns):
        raise StudyError(f"{name}: differs between links here; name one, such as {name}[0]")
    if not entry.indices and name in columns:
        raise StudyError(f"{name}: a list in this sweep; name one entry of it, such as {name}[0]")
    if not entry.indices or isinstance(value, str):
        return np.array([value])
    array = Fields(study, columns).numbers(entry.field)
    if array.ndim - 1 != len(entry.indices):
        raise StudyError(f"{name}: a list in this sweep; name one entry of it, such as {name}[0]")
    chosen = np.moveaxis(array, 0, -1)[entry.indices]
    return chosen > 0 if isinstance(value, bool) else chosen


def metric_sizes(table: CaseTable) -> dict[str, int]:
    """Lengths of the axes of metrics over all cases."""
    return entry_sizes(table.study) | {
        "mode": int(table.values("link.modes").max()),
        "controlled_mode": int(table.values("control.modes").max()),
    }


def _check_shapes(columns: Columns) -> None:
    """Reject lists of different lengths where the program needs equal ones."""
    for name in ("patches.centers", "shaper.frequencies_hz", "metrics.stations", *EACH_PATCH):
        if name in columns and columns[name].dtype == object:
            raise StudyError(f"{name}: lists of different shape in one sweep; use equal ones")
    for name in ("motion.move_time", "motion.dwell"):
        if name in columns and columns[name].dtype == object:
            kinds = {isinstance(value, tuple) for value in columns[name]}
            if len(kinds) > 1:
                raise StudyError(f"{name}: numbers and lists mixed; use one of them")


def _check_read(study: Study, columns: Columns) -> None:
    """Reject own fields of a law, drive or mechanism that no case selects."""
    selectors = ("control.law", "drive.kind", "machine.kind")
    chosen = product(*(np.unique(values(study, columns, name)) for name in selectors))
    every = [Parts(*names) for names in chosen]
    for name in columns:
        if not any(parts.owns(name) for parts in every):
            raise StudyError(f"{name}: varies, but no case selects the part whose field it is")


def _check_samples(study: Study, columns: Columns) -> None:
    """Reject runs longer than a program can take."""
    rate = Fields(study, columns).numbers("electronics.sample_rate_hz")
    longest = float(np.max(Fields(study, columns).numbers("run.duration") * rate))
    if longest > SAMPLE_LIMIT:
        raise StudyError(
            f"run.duration: a case with {longest:.3g} samples; allowed: up to {SAMPLE_LIMIT}"
        )


def _check_moves(study: Study, columns: Columns) -> None:
    """Reject times of moves that a case does not have, and locked drives with a path."""
    fields = Fields(study, columns)
    count = np.sum(~np.isnan(fields.numbers("motion.waypoints")[..., 0]), axis=1)
    for name in ("motion.move_time", "motion.dwell"):
        times = fields.numbers(name)
        if times.ndim == 2 and np.any(np.sum(~np.isnan(times), axis=1) != count - 1):
            raise StudyError(
                f"{name}: lists and motion.waypoints that do not fit in some cases; allowed: one "
                "number, or as many as there are moves"
            )
    if np.any((fields.numbers("drive.locked") > 0) & (count > 1)):
        raise StudyError(
            "drive.locked: true in cases with more than one of motion.waypoints; locked drives "
            "follow no path"
        )


def case_study(table: CaseTable, index: int) -> Study:
    """The study of one case, as its own file would define it.

    Raises:
        StudyError: the case is not valid as a single study (its status says so too).
    """
    data = loose_study(table, index, table.fields).model_dump()
    data["run"]["seed"] = int(table.seed[index])
    modes = data["control"]["modes"]  # a mask of all cases can name more than this one has
    data["control"]["mode_mask"] = tuple(row[:modes] for row in data["control"]["mode_mask"])
    data["title"] = f"{table.study.title}: case {table.case_id[index].decode()}"[:200]
    return parse_study(data)


def loose_study(table: CaseTable, index: int, names: Iterable[str]) -> Study:
    """The study with some fields of one case, whether or not these fit together."""
    study = table.study
    for name in table.fields.keys() & {*names}:
        data = set_value(study, name, as_python(table.fields[name][index]))
        study = Study.model_construct(**dict(_sections(data)))
    return study


def _sections(data: dict[str, Any]) -> Any:
    """Sections rebuilt without checks: columns may only be valid together."""
    for name, value in data.items():
        model: Any = Study.model_fields[name].annotation
        yield name, model.model_construct(**value) if isinstance(value, dict) else value


def as_python(value: Any) -> Any:
    """A column's entry as Python numbers and tuples."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    return tuple(map(as_python, value)) if isinstance(value, (list, tuple)) else value


def case_ids(study: Study, columns: Columns, repeat: np.ndarray) -> np.ndarray:
    """Hash of all parameters of each case that act in it, 16 hexadecimal digits as bytes, (n,)."""
    varying = _varying_text(study, acting_columns(study, columns))
    varying["repeat"] = [str(k) for k in repeat.tolist()]
    data = study.model_dump(mode="json")
    fixed = {
        f"{section}.{leaf}": json.dumps(value)
        for section, fields in data.items()
        if isinstance(fields, dict)  # the title is not a parameter
        for leaf, value in fields.items()
        if value != {}
    }
    names = sorted(fixed.keys() | varying.keys())
    # consecutive fixed lines are joined once
    pieces: list[bytes] = [b""]
    lists: list[list[str]] = []
    for name in names:
        if name in varying:
            pieces[-1] += f"{name}=".encode()
            pieces.append(b"\n")
            lists.append(varying[name])
        else:
            pieces[-1] += f"{name}={fixed[name]}\n".encode()
    start, rest = blake2b(pieces[0], digest_size=8), pieces[1:]
    ids = np.empty(len(repeat), "S16")
    for k, texts in enumerate(zip(*lists, strict=True)):
        digest = start.copy()
        for text, piece in zip(texts, rest, strict=True):
            digest.update(text.encode())
            digest.update(piece)
        ids[k] = digest.hexdigest()
    return ids


def _varying_text(study: Study, columns: Columns) -> dict[str, list[str]]:
    """Text of each field that varies, for all cases."""
    whole: dict[str, list[Any]] = {}
    for name, column in columns.items():
        entry = parse_entry(name)
        if entry is not None and not entry.indices and "." in name:
            whole[name] = column.tolist()
    for name, column in columns.items():
        entry = parse_entry(name)
        if entry is None or not entry.indices:
            continue
        base = whole.get(entry.field) or [known_field(entry.field, study)] * len(column)
        base = [as_list(entry.field, value, study) for value in base]
        whole[entry.field] = [
            replaced(value, entry.indices, new)
            for value, new in zip(base, column.tolist(), strict=True)
        ]
    return {name: [_text(value) for value in values] for name, values in whole.items()}


def _text(value: Any) -> str:
    return repr(value) if type(value) in (float, int) else json.dumps(value)


def _seeds(study: Study, columns: Columns, ids: np.ndarray) -> np.ndarray:
    bases = columns["run.seed"].tolist() if "run.seed" in columns else [study.run.seed] * len(ids)
    pairs = zip(bases, ids.tolist(), strict=True)
    digests = (blake2b(b"%d:%s" % pair, digest_size=8).digest() for pair in pairs)
    return np.fromiter((int.from_bytes(d, "big") % 10**9 for d in digests), np.int64, len(ids))


def as_numbers(column: np.ndarray, n_links: int) -> np.ndarray:
    """A column as an array for a file: lists of unequal length padded with NaN."""
    return padded(list(column), n_links) if column.dtype == object else column
