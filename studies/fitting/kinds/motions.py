"""Recorded runs of a study's motion, which all traces and settling times of it share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.case import Structure
from jaxmodel.numbers import Numbers, case_of, with_used
from jaxmodel.parameters import Array
from jaxmodel.simulate import simulate
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.fitting.bench import with_outputs_at, with_slopes
from studies.space.free import Place
from studies.study.cases import as_arrays
from studies.study.labels import describe
from studies.study.numbers import one_study
from studies.study.signals import Signal
from studies.study.spec import Study

#: What a run records of each kind of output.
RECORDED = {
    "sensor": "sensor_voltage",
    "slider": "slider",
    "motor": "slider_force",
    "platform": "pose",
    "deflection": "chord_deflection_stations",
}


class Recording(NamedTuple):
    """One output of a run."""

    time: np.ndarray  # [s], (n,)
    command_end: float  # [s]
    value: np.ndarray  # (n,)
    slope: np.ndarray | None  # by the parameters, (n, p)


class Motion:
    """A study's run with some links under control, kept for the last parameters."""

    def __init__(
        self, study: Study, place: Place, places: tuple[float, ...], moving: Sequence[str]
    ) -> None:
        """
        Args:
            study: the run.
            place: puts parameters among the numbers.
            places: its stations [m], if any.
            moving: fields of the parameters, which may be 0 in the study.

        Raises:
            StudyError: as `check_run`.
        """
        self._structure, self._numbers = smooth_run(study, moving)
        self._place, self._places = place, places
        self._kinds: set[str] = set()
        self._kept: tuple[Any, Any] = None, None

    @property
    def patches(self) -> tuple[int, int]:
        """Links, and pairs of patches on each."""
        return self._structure.n_links, self._structure.n_patches

    def add(self, signal: Signal) -> None:
        """Record what this output needs, too."""
        self._kinds.add(signal.kind)

    def find(self, name: str, signal: Signal, values: np.ndarray, has_slopes: bool) -> Recording:
        """One output for some values of the parameters, (p,).

        Raises:
            StudyError: naming the measurement `name`; a run that does not reach its end.
        """
        kinds = tuple(sorted(self._kinds))
        key = values.tobytes(), kinds
        kept_key, results = self._kept
        if kept_key not in ((*key, True), (*key, has_slopes)):
            run = _recorded_slopes if has_slopes else _recorded
            results = run(self._structure, self._place, kinds, self._numbers, values)
            results = jax.tree.map(np.asarray, results)
            self._kept = (*key, has_slopes), results
        signals, (time, command_end, code), *slopes = results
        check_finished(name, int(code))
        at = (slice(None), *self._entry(signal))
        slope = slopes[0][signal.kind][at] if has_slopes else None
        return Recording(time, float(command_end), signals[signal.kind][at], slope)

    def _entry(self, signal: Signal) -> tuple[int, ...]:
        """Where an output lies in what is recorded of its kind."""
        if signal.kind == "sensor":
            return signal.link, signal.patch
        if signal.kind == "deflection":
            return signal.link, self._places.index(signal.place)
        return (signal.link,)


class Motions:
    """Recorded runs of one study, by the links under control."""

    def __init__(
        self, study: Study, place: Place, places: tuple[float, ...], moving: Sequence[str]
    ) -> None:
        """Arguments: as `Motion`; where deflections are measured [m]; fields that move."""
        self._study, self._place = (
            with_outputs_at(study, place, places) if places else (study, place)
        )
        self._places, self._moving = places, moving
        self._known: dict[tuple[bool, ...] | None, Motion] = {}

    def uncontrolled(self) -> Motion:
        """The run with no link under control."""
        return self.of((False,) * self._study.n_links)

    def of(self, links: tuple[bool, ...] | None) -> Motion:
        """The run with these links under control; None: those of the study."""
        if links not in self._known:
            study = self._study if links is None else self._study.change(control__links=links)
            self._known[links] = Motion(study, self._place, self._places, self._moving)
        return self._known[links]


def smooth_run(study: Study, moving: Sequence[str]) -> tuple[Structure, Numbers]:
    """A study's run with derivatives by some fields, which may be 0 in it.

    Raises:
        StudyError: as `check_run`.
    """
    structure = with_used(check_run(study)[0], moving)._replace(is_smooth=True)
    return structure, as_arrays(one_study(study, structure))


def check_finished(name: str, code: int) -> None:
    """Refuse a run that did not reach its end.

    Raises:
        StudyError: it did not.
    """
    if code not in status.FINISHED:
        raise StudyError(f"{name}: the run ends with status {describe(code)}")


@kept_jit(static_argnums=(0, 1, 2))
def _recorded(
    structure: Structure, place: Place, kinds: tuple[str, ...], numbers: Numbers, values: Array
) -> Any:
    result = simulate(structure, case_of(structure, place(numbers, values)), has_record=True)
    record = result.record
    assert record is not None
    signals = {kind: getattr(record, RECORDED[kind]) for kind in kinds}
    return signals, (record.time, result.command_end, result.status)


@kept_jit(static_argnums=(0, 1, 2))
def _recorded_slopes(
    structure: Structure, place: Place, kinds: tuple[str, ...], numbers: Numbers, values: Array
) -> Any:
    slopes, results = with_slopes(_recorded, 4, is_first=True)(
        structure, place, kinds, numbers, values
    )
    return *results, slopes
