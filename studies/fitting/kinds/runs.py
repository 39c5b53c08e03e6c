"""Runs of a study's motion that differ in which links are controlled, and their metrics."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.metrics import Metrics
from jaxmodel.numbers import Numbers, case_of
from jaxmodel.parameters import Array
from studies.engine.function import fastest_function
from studies.engine.plan import lane_unit, padded_rows
from studies.fitting.kinds.motions import check_finished, smooth_run
from studies.space.free import Place, Placing
from studies.study.spec import Study


class Switch(NamedTuple):
    """What is under control."""

    links: tuple[bool, ...]
    modes: int  # of each of these links

    @property
    def off(self) -> Switch:
        """Nothing."""
        return self._replace(links=(False,) * len(self.links))


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

    def add(self, metric: str, *switches: Switch) -> None:
        """Run these, too, and keep a metric."""
        self._metrics.add(metric)
        self._switches += [x for x in switches if x not in self._switches]

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


def _switched_case(
    structure: Structure, place: Place, values: Array, switch: tuple[Array, Array], numbers: Numbers
) -> Case:
    """The case of parameters with these links and modes under control."""
    case, (mask, count) = case_of(structure, place(numbers, values)), switch
    mask = jnp.ones_like(case.control.link_mask) * mask
    return case._replace(control=case.control._replace(link_mask=mask, n_active=count))


def _named(structure: Structure, metrics: Metrics) -> dict[str, Any]:
    return {name: getattr(metrics, name) for name in structure.metrics}
