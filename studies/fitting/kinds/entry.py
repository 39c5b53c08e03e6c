"""What entries of `[[fit.data]]` have in common: a pose, signals, columns of a file, noise."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from studies.errors import StudyError, field_error
from studies.fitting.bench import Pose as At
from studies.fitting.kinds.contract import DataEntry, Models, Noise
from studies.fitting.kinds.motions import RECORDED
from studies.fitting.tables import column, read_columns
from studies.fitting.uff import Side
from studies.study.consistency import patch_centers
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal
from studies.study.spec import Pose, Section, Study, described

Positive = Annotated[float, Field(ge=1e-30, le=1e12)]
Percent = Annotated[float, Field(ge=1e-6, le=1000)]
#: Of an output: as named, or its derivative by time.
Quantity = Literal["displacement", "velocity", "acceleration"]
#: Derivatives of the output by its quantity.
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
#: The same of outputs that have one quantity.
GIVEN = {"accelerometer": 2, "motor": 0}
#: Rows of a measurement that a fit takes: a minute or two of work.
MOST_ROWS = 20_000
#: Points over time or frequency, at least.
FEWEST = 3


class PoseEntry(DataEntry):
    """Fields of measurements at a pose."""

    pose: Pose | None = described(None, "m; m; rad", "of the platform; default: first way-point")

    def at(self, study: Study) -> At:
        """The pose."""
        return self.pose or study.motion.waypoints[0]


class OutputEntry(DataEntry):
    """Fields of measurements of one output."""

    output: str = described(..., "-", "what is measured")

    def signals(self, study: Study, path: str) -> tuple[Signal, ...]:
        kinds = {x: OUTPUTS[x] for x in RECORDED}
        return (parse_signal(self.output, kinds, *signal_sizes(study), f"{path}.output"),)


class FileEntry(DataEntry):
    """Fields of measurements in a file of columns."""

    file: str = described(..., "-", "CSV, HDF5, MATLAB or UFF, beside this file")

    def sides(self, study: Study, path: str) -> list[Side]:
        """What it says of its output, and of the input of a response."""
        output, quantity = self.signals(study, path)[-1], getattr(self, "quantity", "displacement")
        names = ("output", "outputs") if output.kind in GIVEN else ("quantity", "output")
        field = next(x for x in names if hasattr(self, x))
        return [("ordinate", f"{path}.{field}", getattr(self, field), unit_of(output, quantity))]

    def reader(self, models: Models, path: str) -> Callable[..., np.ndarray]:
        """What reads a column, of real numbers if not said otherwise; all have one length."""
        sides = self.sides(models.study, path)
        columns = read_columns(self.file, models.folder, f"{path}.file", self.kind, sides)
        thin = getattr(self, "thin", 0)
        thinned = {name: x[:: thin or 1] for name, x in columns.items()}
        lengths: dict[str, int] = {}

        def read(name: str, is_real: bool = True) -> np.ndarray:
            rows = lengths[name] = len(columns.get(name, ()))
            if rows > MOST_ROWS * thin > 0:
                raise field_error(
                    f"{path}.thin",
                    thin,
                    f"{-(-rows // MOST_ROWS)} or more for {self.file} of {rows} rows: a fit takes "
                    f"up to {MOST_ROWS} of each measurement (of raw time records take kind = "
                    "'record')",
                    "1",
                )
            values = column(thinned, name, self.file, path)
            if len(set(lengths.values())) > 1:
                sizes = ", ".join(f"{key} {size}" for key, size in lengths.items())
                raise StudyError(
                    f"{path}: columns of {self.file} differ in length: {sizes}; allowed: one length"
                )
            if is_real and np.iscomplexobj(values):
                raise StudyError(f"{path}: column {name!r} is complex; expected real numbers")
            return values

        return read


class ThinnedEntry(OutputEntry, FileEntry):
    """Fields of measurements whose rows can be thinned out."""

    thin: int = described(
        1,
        "1",
        "every how many rows one is kept, where noise is alike in neighbours",
        ge=1,
        le=10**6,
    )


class NoiseEntry(Section):
    """Standard deviation of the values; both parts in quadrature."""

    sigma: Positive | None = described(None, "unit of the output", "standard deviation")
    sigma_percent: Percent | None = described(None, "%", "standard deviation over the value")

    def noise(self, value: np.ndarray, path: str) -> Noise:
        """Noise of measured values.

        Raises:
            StudyError: a value without any.
        """
        noise = Noise(self.sigma or 0.0, (self.sigma_percent or 0.0) / 100)
        without = np.flatnonzero(noise.sigma(value) <= 0)
        if without.size:
            raise StudyError(
                f"{path}: value {without[0] + 1} is 0, where sigma_percent alone means no noise; "
                "give sigma beside it, the noise of small values in the unit of the output"
            )
        return noise


class ShakenEntry(OutputEntry, FileEntry, PoseEntry):
    """Fields of measurements of a machine that is shaken."""

    input: str = described(..., "-", "what shakes the machine")
    quantity: Quantity = described(
        "displacement", "-", "of the output: as named, or its derivative; an accelerometer has none"
    )

    def signals(self, study: Study, path: str) -> tuple[Signal, ...]:
        sizes = signal_sizes(study)
        output = parse_signal(self.output, OUTPUTS, *sizes, f"{path}.output")
        source = parse_signal(self.input, INPUTS, *sizes, f"{path}.input")
        what = f"{path}: responses from commands and to motors are"
        check_drive(study, {source.kind, output.kind}, what)
        return source, output

    def order(self, output: Signal, path: str) -> int:
        """Derivatives by time that the output has."""
        if output.kind not in GIVEN:
            return ORDERS[self.quantity]
        if "quantity" in self.model_fields_set:
            raise StudyError(f"{path}.quantity: has no meaning for {self.output!r}; leave it out")
        return GIVEN[output.kind]


def signal_sizes(study: Study) -> tuple[int, np.ndarray]:
    """Patches of a link, and length of the links [m]: what names of signals are checked by."""
    return patch_centers(study).shape[1], study.each_link(study.link.length)


def check_drive(study: Study, kinds: set[str], what: str) -> None:
    """Refuse commands and motors, kinds of signals, of other drives than PD."""
    if kinds & {"command", "motor"} and study.drive.kind != "pd":
        raise StudyError(
            f"{what} known of drive.kind = 'pd' only, which has no forward path; it is "
            f"{study.drive.kind!r}"
        )


def unit_of(output: Signal, quantity: str) -> str:
    """Unit of an output or of its derivative."""
    order = 0 if output.kind in GIVEN else ORDERS[quantity]
    return OUTPUTS[output.kind][1] + ("", "/s", "/s^2")[order]


def each(value: Any, count: int, path: str) -> np.ndarray:
    """One number for all, or one for each."""
    if isinstance(value, tuple) and len(value) != count:
        raise field_error(path, value, f"one number, or {count}")
    return np.broadcast_to(np.asarray(value, float), (count,)).copy()


def ascending(x: np.ndarray, name: str, path: str) -> None:
    """Refuse a column of time or frequency that does not ascend, or of few points.

    Raises:
        StudyError: with the first row that does not.
    """
    if len(x) < FEWEST:
        text = f"column {name!r} has {len(x)} points; allowed: {FEWEST} or more"
        raise StudyError(f"{path}: {text}")
    if not np.all(np.diff(x) > 0):
        row = int(np.argmax(np.diff(x) <= 0)) + 2
        raise StudyError(f"{path}: column {name!r} must ascend; row {row} does not")
