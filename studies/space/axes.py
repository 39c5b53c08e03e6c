"""One axis of a sweep: a field of the study, or a ready-made axis of this machine.

An axis is written as a list of values, `"all"` (of a choice, a switch or a ready-made axis that
knows all its values), or a range `{from = 0.1, to = 10, count = 8, scale = "log"}`, where `count`
is only for `grid` and `zip`. `READY_MADE` lists ready-made axes and what they stand for.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations, product
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from jaxmodel.laws.state_space import STATE_SPACE
from studies.errors import field_error, nearest, shown_name
from studies.study.consistency import patch_centers, patch_pitch
from studies.study.fields import Columns, column_of
from studies.study.paths import checked_value, field_choices, known_field, parse_section
from studies.study.section import Section, described
from studies.study.spec import Study

#: Axes with their own names: what each varies, and how it is written.
READY_MADE = {
    "placement": "patches.centers, sorted and without overlap: {kind = 'same' | 'mirrored' | "
    "'per_link', candidates = 12}; candidates for grid and zip only",
    "plant_modes": "link.modes",
    "controlled_modes": "control.modes",
    "link_subsets": "control.links: 'all', or names such as '1+3' and 'none'",
    "link_mode_masks": "control.mode_mask, every link x mode switch: 'all'",
    "gain": "control.gain_factor",
    "emc_exponent": "control.ratio_exponent",
    "shaper": "shaper.kind",
    "shaper_frequency": "shaper.frequencies_hz, one frequency [Hz]",
    "frequency_error": "true over assumed frequency minus one [1], through link.stiffness_factor",
    "move_time": "motion.move_time, of all moves [s]",
}
#: Ready-made axes that only rename a field.
ALIASES = {
    "plant_modes": "link.modes",
    "controlled_modes": "control.modes",
    "gain": "control.gain_factor",
    "emc_exponent": "control.ratio_exponent",
    "shaper": "shaper.kind",
    "move_time": "motion.move_time",
}
#: Labels and the fields they stand for.
LABELS = {
    "frequency_error": "link.stiffness_factor",
    "link_subsets": "control.links",
    "link_mode_masks": "control.mode_mask",
}
#: Columns that ready-made axes are found under in results.
SHOWN_AS = ALIASES | {
    "placement": "patches.centers",
    "shaper_frequency": "shaper.frequencies_hz",
}
#: Numbers beyond this are refused.
LARGEST = 1e150
Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
#: Most modes of all links of which every subset becomes a case.
MOST_MASKED = 15
#: More values than this from one axis or block are refused.
LIMIT = 10**7


class Axis(NamedTuple):
    """One axis, ready to be expanded."""

    dimensions: int  # of the unit cube for `sample`
    sample: Callable[[np.ndarray], Columns]  # (n, dimensions) in [0, 1) to columns of n values
    grid: Columns | None  # its values for grid and zip; None for a range without count


class Range(NamedTuple):
    """Numbers from low to high."""

    low: float
    high: float
    number: int  # of points on a grid, 0: no grid
    is_log: bool

    def at(self, u: np.ndarray) -> np.ndarray:
        """u in [0, 1] to numbers."""
        if self.is_log:
            inside = np.exp(np.log(self.low) + u * np.log(self.high / self.low))
        else:
            inside = self.low + u * (self.high - self.low)
        return np.clip(inside, self.low, self.high)

    def points(self) -> np.ndarray:
        """`number` numbers from end to end."""
        return self.at(np.linspace(0, 1, self.number)) if self.number > 1 else np.array([self.low])


def build_axis(name: str, written: Any, study: Study, path: str) -> Axis:
    """An axis from what the file says.

    Args:
        name: field, entry of a list, or ready-made axis.
        written: its values.
        study: the base study.
        path: where it is written, for messages.

    Raises:
        StudyError: unknown name, bad value, bad range.
    """
    full = f"{path}.{shown_name(name)}"
    if name in ALIASES:
        return _field_axis(ALIASES[name], written, study, full)
    special = {
        "placement": _placement,
        "link_subsets": _link_subsets,
        "link_mode_masks": _link_mode_masks,
        "shaper_frequency": _shaper_frequency,
        "frequency_error": _frequency_error,
    }
    if name in special:
        return special[name](written, study, full)
    return _field_axis(name, written, study, full)


def _field_axis(name: str, written: Any, study: Study, path: str) -> Axis:
    base = known_field(name, study, path, READY_MADE)
    if written == "all":
        written = _every_choice(name, base, path, study)
    if isinstance(written, dict):
        return _range_axis(name, base, parse_range(written, path), study, path)
    if not isinstance(written, list | tuple) or not written:
        raise field_error(path, written, _WRITTEN)
    values = column_of([checked_value(study, name, value, path) for value in written])
    if isinstance(base, tuple) and "[" in name and values.shape[1:] != np.shape(base):
        raise field_error(path, written, f"lists of the shape of the one there, {list(base)}")
    return choice_axis({name: values})


_WRITTEN = "a list of values, a range {from = ..., to = ..., count = ..., scale = ...}, or 'all'"


def _every_choice(name: str, base: Any, path: str, study: Study) -> list[Any]:
    """All values of a choice or a switch; laws without the file that they need are none."""
    choices = list(field_choices(name))
    if name == "control.law" and not study.state_space.c:
        choices.remove(STATE_SPACE.name)
    if choices:
        return choices
    if isinstance(base, bool):
        return [False, True]
    raise field_error(path, "all", "'all' for a choice or a switch only; " + _WRITTEN)


def choice_axis(columns: Columns) -> Axis:
    """An axis that takes listed values."""
    size = len(next(iter(columns.values())))

    def sample(u: np.ndarray) -> Columns:
        index = np.minimum((u[:, 0] * size).astype(int), size - 1)
        return {name: column[index] for name, column in columns.items()}

    return Axis(1, sample, columns)


def _is_number(value: Any) -> bool:
    """Whether it is a number whose differences and squares are finite too."""
    is_numeric = isinstance(value, (int, float)) and not isinstance(value, bool)
    return is_numeric and abs(value) <= LARGEST


class WrittenRange(Section):
    """Numbers from low to high, as files write them."""

    low: Finite = described(..., "", "lowest", alias="from")
    high: Finite = described(..., "", "highest", alias="to")
    scale: Literal["linear", "log"] = described("linear", "-", "of the numbers between")


class WrittenGrid(WrittenRange):
    """Numbers from low to high, perhaps on a grid, as files write them."""

    count: int = described(0, "1", "of points for grid and zip; 0: none", ge=0, le=LIMIT)


def parse_range(written: object, path: str, model: type[WrittenRange] = WrittenGrid) -> Range:
    """The range that is written at a place.

    Raises:
        StudyError: no range, or one without numbers between its ends.
    """
    found = parse_section(model, written, path)
    low, high = found.low, found.high
    if not low < high:
        raise field_error(f"{path}.to", high, f"more than {path}.from = {low:g}")
    if found.scale == "log" and low <= 0:
        raise field_error(f"{path}.from", low, "more than 0 on a log scale")
    return Range(low, high, getattr(found, "count", 0), found.scale == "log")


def _range_axis(name: str, base: Any, span: Range, study: Study, path: str) -> Axis:
    """Numbers from end to end; whole numbers for an integer field."""
    if isinstance(base, tuple) and name == "motion.move_time":
        base = 0.1
    if isinstance(base, bool) or not isinstance(base, (int, float)):
        raise field_error(path, {"from": span.low, "to": span.high}, "a list of values here")
    is_whole = isinstance(base, int)
    for key, end in (("from", span.low), ("to", span.high)):
        checked_value(study, name, int(end) if is_whole else end, f"{path}.{key}")
    if not is_whole:
        return _numeric_axis(name, span, span.at)
    if span.low != int(span.low) or span.high != int(span.high):
        raise field_error(f"{path}.to", span.high, "whole numbers at both ends", "1")
    wide = span._replace(low=span.low - 0.5, high=span.high + 0.5)

    def whole(u: np.ndarray) -> np.ndarray:
        inside = np.rint((span if span.is_log else wide).at(u))
        return np.clip(inside, span.low, span.high).astype(int)

    axis = _numeric_axis(name, span, whole)
    points = np.unique(np.rint(span.points()).astype(int)) if span.number else None
    return axis._replace(grid=None if points is None else {name: points})


def _numeric_axis(name: str, span: Range, at: Callable[[np.ndarray], np.ndarray]) -> Axis:
    grid = {name: span.points()} if span.number else None
    return Axis(1, lambda u: {name: at(u[:, 0])}, grid)


def _map_axis(axis: Axis, convert: Callable[[np.ndarray], Columns], name: str) -> Axis:
    """An axis with one column `name` whose values stand for other columns."""
    return Axis(
        axis.dimensions,
        lambda u: convert(axis.sample(u)[name]),
        None if axis.grid is None else convert(axis.grid[name]),
    )


def _numbers_axis(written: Any, path: str) -> Axis:
    """Free numbers, named "value"."""
    if isinstance(written, dict):
        span = parse_range(written, path)
        return _numeric_axis("value", span, span.at)
    is_list = isinstance(written, list | tuple) and len(written) > 0
    if not is_list or not all(map(_is_number, written)):
        raise field_error(path, written, "a list of finite numbers, or a range {from, to, ...}")
    return choice_axis({"value": np.array(written, float)})


def _ends(axis: Axis) -> np.ndarray:
    """Smallest and largest number of an axis made by `_numbers_axis`."""
    values = axis.sample(np.linspace(0, 1, 1001)[:, None])["value"]
    return np.array([values.min(), values.max()])


def _shaper_frequency(written: Any, study: Study, path: str) -> Axis:
    axis = _numbers_axis(written, path)
    for end in _ends(axis):
        checked_value(study, "shaper.frequencies_hz", [float(end)], path)
    return _map_axis(axis, lambda value: {"shaper.frequencies_hz": value[:, None]}, "value")


def _frequency_error(written: Any, study: Study, path: str) -> Axis:
    axis = _numbers_axis(written, path)
    for end in _ends(axis):
        if end <= -1:
            raise field_error(path, float(end), "more than -1", "1")
        checked_value(study, "link.stiffness_factor", float((1 + end) ** 2), path)

    def convert(error: np.ndarray) -> Columns:
        return {"link.stiffness_factor": (1 + error) ** 2, "frequency_error": error}

    return _map_axis(axis, convert, "value")


def _link_subsets(written: Any, study: Study, path: str) -> Axis:
    numbers = [str(i + 1) for i in range(study.n_links)]
    subsets = (combinations(numbers, size) for size in range(study.n_links + 1))
    names = ["+".join(subset) or "none" for some in subsets for subset in some]
    chosen = names if written == "all" else written
    if not isinstance(chosen, list | tuple) or not chosen:
        raise field_error(path, written, "'all', or a list of " + ", ".join(names))
    for value in chosen:
        if value not in names:
            hint = nearest(str(value), names)
            raise field_error(path, value, ", ".join(names), hint=hint)
    flags = np.array([[number in name for number in numbers] for name in chosen])
    return choice_axis({"control.links": flags, "link_subsets": np.array(chosen)})


def _link_mode_masks(written: Any, study: Study, path: str) -> Axis:
    if written != "all":
        raise field_error(path, written, "'all' (list values under control.mode_mask instead)")
    links, modes = study.n_links, study.control.modes
    most = MOST_MASKED // links
    if modes > most:
        raise field_error(path, written, f"control.modes up to {most} here; it is {modes}")
    bits = np.array(list(product((False, True), repeat=links * modes))).reshape(-1, links, modes)
    text = ["/".join("".join(str(int(b)) for b in row) for row in mask) for mask in bits]
    return choice_axis({"control.mode_mask": bits, "link_mode_masks": np.array(text)})


class WrittenPlacement(Section):
    """Patches in order and without overlap."""

    kind: Literal["same", "mirrored", "per_link"] = described("same", "-", "on all links")
    candidates: int = described(0, "1", "places for grid and zip; 0: none", ge=0, le=60)


def _placement(written: Any, study: Study, path: str) -> Axis:
    asked = parse_section(WrittenPlacement, written, path)
    kind, candidates = asked.kind, asked.candidates
    count = patch_centers(study).shape[1]
    lengths, pitches = study.each_link(study.link.length), patch_pitch(study)
    if kind == "per_link":
        if candidates:
            raise field_error(f"{path}.candidates", candidates, "0 with kind per_link")
        rooms = [
            _PatchPlacement(*room, count, False, path)
            for room in zip(lengths, pitches, strict=True)
        ]

        def sample(u: np.ndarray) -> Columns:
            rows = [rooms[i].place(u[:, i * count : (i + 1) * count]) for i in range(study.n_links)]
            return {"patches.centers": np.stack(rows, axis=1)}

        return Axis(study.n_links * count, sample, None)
    if kind == "mirrored" and np.ptp(lengths) > 0:
        raise field_error(
            f"{path}.kind", kind, f"'same' or 'per_link' with link.length = {list(lengths)}"
        )
    room = _PatchPlacement(lengths.min(), pitches.max(), count, kind == "mirrored", path)
    grid = {"patches.centers": room.grid(candidates)} if candidates else None
    if grid is not None and len(grid["patches.centers"]) == 0:
        raise field_error(
            f"{path}.candidates", candidates, f"so many that {count} patches fit on them apart", "1"
        )
    return Axis(room.free, lambda u: {"patches.centers": room.place(u)}, grid)


class _PatchPlacement:
    """Room for sorted patches: the length they leave free, distributed in order."""

    def __init__(
        self, length: float, size: float, count: int, is_mirrored: bool, path: str
    ) -> None:
        self.length, self.size, self.count, self.is_mirrored = length, size, count, is_mirrored
        self.free = count // 2 if is_mirrored else count
        taken = self.free * self.size
        end = self.length
        if is_mirrored:
            end = self.length / 2 - (self.size / 2 if count % 2 else 0.0)
        self.play = end - taken
        if self.free == 0 or self.play < 0:
            raise field_error(
                path,
                f"{count} patches of {self.size:g} m",
                f"patches that fit on link.length = {self.length:g}, two or more if mirrored",
                "m",
            )

    def place(self, u: np.ndarray) -> np.ndarray:
        """Points of the unit cube (n, free) to placements (n, count), uniform where they fit."""
        order = np.arange(self.free)
        return self._whole(np.sort(u, axis=1) * self.play + (order + 0.5) * self.size)

    def grid(self, candidates: int) -> np.ndarray:
        """All placements on equally spaced candidate positions."""
        spots = np.linspace(0.0, self.play + (self.free - 1) * self.size, candidates)
        chosen = np.array(list(combinations(spots, self.free))).reshape(-1, self.free)
        is_apart = np.all(np.diff(chosen, axis=1) >= self.size - 1e-12, axis=1)
        return self._whole(chosen[is_apart] + self.size / 2)

    def _whole(self, left: np.ndarray) -> np.ndarray:
        if not self.is_mirrored:
            return left
        middle = np.full((len(left), self.count % 2), self.length / 2)
        return np.concatenate([left, middle, self.length - left[:, ::-1]], axis=1)
