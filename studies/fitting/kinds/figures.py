"""Metrics of whole motions, such as residual vibration, and their reduction by control."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.metrics import METRICS, Metrics
from jaxmodel.numbers import Numbers, case_of
from jaxmodel.parameters import Array
from studies.engine.function import fastest_function
from studies.engine.plan import lane_unit, padded_rows
from studies.errors import StudyError
from studies.fitting.kinds.contract import Measurement
from studies.fitting.kinds.motions import check_finished, smooth_run
from studies.space.free import Place, Placing
from studies.study.entries import Entries
from studies.study.spec import Study


class Switch(NamedTuple):
    """What is under control."""

    links: tuple[bool, ...]
    modes: int  # of each of these links


class Compared(NamedTuple):
    """One number of a run."""

    entries: Entries
    switch: Switch
    is_reduction: bool  # in percent of the same without control
    is_amplitude: bool  # square root of the metric
    is_largest: bool  # of several entries; otherwise root of the mean square
    measured: float
    sigma: float
    label: str

    @property
    def title(self) -> str:
        """Its name with its unit, or what it is a reduction of."""
        unit = "%" if self.is_reduction else METRICS[self.entries.metric].unit
        root = "root of " if self.is_amplitude else ""
        return f"{root}{self.label} [{unit}{'^(1/2)' if root and not self.is_reduction else ''}]"


class Runs:
    """Runs of one study with different links under control, kept for the last parameters.

    All figures share them: one program runs every combination that any of them needs.
    """

    def __init__(self, study: Study, place: Place, moving: Sequence[str]) -> None:
        """Arguments: what all runs share, what puts parameters among them, and their fields."""
        self._study, self._moving, self._place = study, moving, place
        self._metrics: set[str] = set()
        self._switches: list[Switch] = []
        self._kept: tuple[bytes, bool, Any] = b"", False, None

    def add(self, compared: tuple[Compared, ...]) -> None:
        """Run what these figures need, too."""
        self._metrics |= {x.entries.metric for x in compared}
        needed = [x.switch for x in compared] + [_off(x) for x in compared if x.is_reduction]
        self._switches += [x for x in dict.fromkeys(needed) if x not in self._switches]

    def run(self, values: np.ndarray, has_slopes: bool) -> Any:
        """Metrics of all runs and, perhaps, their derivatives.

        Raises:
            StudyError: a run that does not reach its end.
        """
        key, slopes, outcome = self._kept
        if key != values.tobytes() or (has_slopes and not slopes):
            outcome = jax.tree.map(np.asarray, self._run_all(values, has_slopes))
            self._kept = values.tobytes(), has_slopes, outcome
        code, *metrics = outcome
        for one in code[: len(self._switches)]:
            check_finished("figures", int(one))
        return metrics[: 1 + int(has_slopes)]

    @cached_property
    def _smooth(self) -> tuple[Structure, Numbers]:
        return smooth_run(self._study, self._moving)

    def _run_all(self, values: np.ndarray, has_slopes: bool) -> Any:
        """Statuses, metrics by name, runs first, and perhaps their derivatives, (p, runs, ...)."""
        structure, numbers = self._smooth
        structure = structure._replace(metrics=tuple(sorted(self._metrics)))
        rows = padded_rows(len(self._switches), lane_unit())
        masks = np.array([x.links for x in self._switches], float)[rows]
        modes = np.array([x.modes for x in self._switches])[rows]
        free, own = np.tile(values, (len(rows), 1)), (masks, modes)
        build = Placing(_switched_case, (structure, self._place))
        run = fastest_function(structure, build, free, own, numbers)
        if not has_slopes:
            result = run.run(free, own)
            return result.status, _named(structure, result.metrics)
        result, slopes = run.jacobian(values, own)
        return result.status, _named(structure, result.metrics), _named(structure, slopes)

    def at(self, switch: Switch) -> int:
        """Place of a run among all of them."""
        return self._switches.index(switch)


class Figures(Measurement):
    """Metrics of runs that differ in which links are controlled."""

    kind = "figures"

    def __init__(
        self, name: str, is_checked: bool, runs: Runs, compared: tuple[Compared, ...]
    ) -> None:
        measured, sigma = (
            np.array([getattr(x, k) for x in compared]) for k in ("measured", "sigma")
        )
        super().__init__(name, is_checked, measured, sigma)
        self.labels = tuple(x.title for x in compared)
        self._runs, self._compared = runs, compared
        runs.add(compared)

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        outcome = self._runs.run(values, has_slopes)
        numbers, slopes = zip(*(self._number(x, *outcome) for x in self._compared), strict=True)
        return np.array(numbers), np.array(slopes) if has_slopes else None

    def _number(self, one: Compared, metrics: Any, slopes: Any = None) -> tuple[Any, Any]:
        on, by_on = self._taken(one, one.switch, metrics, slopes)
        if not one.is_reduction:
            return on, by_on
        off, by_off = self._taken(one, _off(one), metrics, slopes)
        if off == 0:
            raise StudyError(f"{self.name}: {one.label} is 0 without control: it has no reduction")
        by = None if slopes is None else 100 * (on * by_off / off**2 - by_on / off)
        return 100 * (1 - on / off), by

    def _taken(self, one: Compared, switch: Switch, metrics: Any, slopes: Any) -> tuple[Any, Any]:
        """The metric of a run, and its derivatives."""
        k, name = self._runs.at(switch), one.entries.metric
        value = one.entries.take(metrics[name][k : k + 1])[0]
        kept = [int(np.argmax(value))] if one.is_largest else slice(None)
        value = value[kept]
        size = float(np.sqrt(np.mean(value**2))) if len(value) > 1 else float(value[0])
        root = np.sqrt(size) if one.is_amplitude else size
        if slopes is None:
            return root, None
        by = slopes[name][:, k : k + 1]  # (p, 1, ...)
        parts = np.stack([one.entries.take(x)[0][kept] for x in by], axis=-1)  # (entries, p)
        slope = (value @ parts) / (len(value) * size) if size != 0 else parts.sum(0)
        return root, slope / (2 * root) if one.is_amplitude and root > 0 else slope


def _off(one: Compared) -> Switch:
    return one.switch._replace(links=(False,) * len(one.switch.links))


def _switched_case(
    structure: Structure, place: Place, values: Array, switch: tuple[Array, Array], numbers: Numbers
) -> Case:
    """The case of parameters with these links and modes under control."""
    case, (mask, count) = case_of(structure, place(numbers, values)), switch
    mask = jnp.ones_like(case.control.link_mask) * mask
    return case._replace(control=case.control._replace(link_mask=mask, n_active=count))


def _named(structure: Structure, metrics: Metrics) -> dict[str, Any]:
    return {name: getattr(metrics, name) for name in structure.metrics}
