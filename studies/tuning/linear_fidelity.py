"""Figures of designs from the linearised sampled loop: margins, spillover, residual vibration.

No eigenvalues and no runs: repeated squaring and doubling (`jaxmodel.sampled_loop`), so it works in
batches on any device, with derivatives. Every machine of a tuning has its own loop.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Structure
from jaxmodel.loop_figures import MARGINS, PEAKS
from jaxmodel.numbers import Numbers, in_working_precision
from jaxmodel.parameters import Array
from studies.engine.plan import in_parts
from studies.engine.robustness import find_margins
from studies.errors import StudyError
from studies.study.cases import build_structure
from studies.study.numbers import stack_numbers, study_numbers
from studies.tuning.loop_figures import (
    allowed_on,
    figures_of_cases,
    judged_structure,
    machine_figures,
    relative_margin,
    term_values,
    with_decay,
    with_margin_modes,
)
from studies.tuning.loop_programs import (
    STABLE,
    figure_slopes,
    loop_responses,
    screen_designs,
    tuned_cases,
)
from studies.tuning.scenarios import nominal, tuned_machines
from studies.tuning.spec import BASELINE, OF_LOOP, Family, TuneSpec

#: Designs per call of a screen; each core takes one call after another.
BATCH = 16


class LoopEvaluation(NamedTuple):
    """Loops of designs on the machines of a tuning, with derivatives; NumPy arrays."""

    #: x/(1 + |x|) of x = value/limit - 1 on the worst machine, positive where violated,
    #: (designs, m)
    limits: np.ndarray
    limit_slopes: np.ndarray  # (designs, m, p)
    terms: np.ndarray  # of the objective, nan where the loop is unstable, (designs, S, t)
    term_slopes: np.ndarray  # (designs, S, t, p)


class LinearFidelity:
    """Evaluates designs of some families."""

    def __init__(self, spec: TuneSpec, families: list[Family]) -> None:
        """
        Args:
            spec: of the tuning.
            families: of each design, in the order given.

        Raises:
            StudyError: the baseline has no stable loop to measure designs against.
        """
        self._spec, self._links = spec, spec.counted_links
        self.names, self.terms = spec.loop_limits, spec.loop_terms
        self.machines = tuned_machines(spec)
        self._compiled: set[Any] = set()
        every = [spec.parts(family) for family in families]
        self._batches = {
            parts: self._batch(families, np.flatnonzero([x == parts for x in every]))
            for parts in dict.fromkeys(every)
        }
        baseline = self._baseline(families)
        #: Of the baseline, (S, t).
        self.baseline_terms = term_values(self.terms, baseline, self.machines.of_scenario)
        shape = len(families), self.machines.size, len(self.names)
        limits = [
            [allowed_on(x.limits[name], baseline[name]) for name in self.names] for x in families
        ]
        self._limits = np.reshape(np.swapaxes(limits, 1, 2) if self.names else limits, shape)

    def _batch(self, families: list[Family], rows: np.ndarray) -> _Batch:
        spec, chosen = self._spec, [families[k] for k in rows]
        parts = spec.parts(chosen[0])
        study = nominal(spec, None if parts == spec.parts() else chosen[0])
        structure = judged_structure(spec, study)
        of_family = {
            name: self._on_machines(family, structure)
            for name, family in {family.name: family for family in chosen}.items()
        }
        numbers = stack_numbers([of_family[family.name] for family in chosen])
        numbers = in_working_precision(numbers)
        return _Batch(rows, structure, build_structure(study).n_steps, numbers)

    def _on_machines(self, family: Family, structure: Structure) -> Numbers:
        study = with_margin_modes(family.study(self._spec.study))
        numbers = study_numbers(study, structure, self.machines.columns)
        whole: Numbers = jax.tree.map(
            lambda x: np.broadcast_to(x, (self.machines.size, *x.shape[1:])), numbers
        )
        return whole

    def _baseline(self, families: list[Family]) -> dict[str, np.ndarray]:
        """Figures of the baseline that designs are measured against, nan: none is, (machines,)."""
        relative = {
            name: f"tune.limits.{name} = {BASELINE!r}"
            for name in self.names
            if any(family.limits[name] == BASELINE for family in families)
        } | {name: f"tune.objective.{name}" for name in self.terms}
        is_stable_needed = any(name in OF_LOOP for name in relative)
        names = with_decay(tuple(relative)) if is_stable_needed else tuple(relative)
        found = dict.fromkeys(self.names, np.full(self.machines.size, np.nan))
        if names:
            found |= machine_figures(self._spec, self._spec.study, self.machines.columns, names)
        for name, path in relative.items():
            if name in OF_LOOP:
                _check_stable(path, found["slowest_decay"])
            bad = ~(np.isfinite(found[name]) & (found[name] > 0))
            if bad.any():
                k = int(np.argmax(bad))
                raise StudyError(
                    f"{path}: the baseline has {found[name][k]:.4g}{_on_machine(k, bad)}; allowed: "
                    "a baseline with a finite value > 0 on every machine of tune.scenarios"
                )
        return found

    def evaluate(self, values: np.ndarray) -> LoopEvaluation:
        """Limits and terms of the objective of the loop, with derivatives.

        Args:
            values: one design for each family of the constructor, (designs, p).
        """
        designs, p = values.shape
        count = len(self.names) + len(self.terms)
        figures = np.zeros((designs, self.machines.size, count))
        slopes = np.zeros((*figures.shape, p))
        for batch in self._batches.values() if count else ():
            found = self._differentiate(batch, values[batch.rows])
            figures[batch.rows], slopes[batch.rows] = found
        excess, terms = np.split(figures, [len(self.names)], axis=2)
        by_limit, by_term = np.split(slopes, [len(self.names)], axis=2)
        worst = excess.argmax(axis=1, keepdims=True)  # of the machines; nan first
        return LoopEvaluation(
            limits=np.take_along_axis(excess, worst, axis=1)[:, 0],
            limit_slopes=np.take_along_axis(by_limit, worst[..., None], axis=1)[:, 0],
            terms=terms[:, self.machines.of_scenario],
            term_slopes=by_term[:, self.machines.of_scenario],
        )

    def _differentiate(self, batch: _Batch, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Figures of some designs on every machine, (designs, machines, m + t), and slopes."""
        designs, machines = len(values), self.machines.size
        place = self._spec.free.place
        margins = tuple(x for x in MARGINS if x in (*self.names, *self.terms))
        limits = self._limits[batch.rows].reshape(designs * machines, -1)
        numbers = batch.each_machine()

        def differentiate(lanes: np.ndarray) -> tuple[Array, Array]:
            own = jax.tree.map(lambda x: x[lanes], numbers)
            mine, places = values[lanes // machines], {}
            if margins:
                response, modes = loop_responses(batch.structure, place, own, mine)
                places = find_margins(response, modes, margins, is_fine=True)
            return figure_slopes(
                batch.structure, self.names, self.terms, place, own, limits[lanes], mine, places
            )

        cores, lanes = os.cpu_count() or 1, designs * machines
        found = self._in_parts(batch, lanes, -(-lanes // cores), differentiate)
        figures, slopes = (x.reshape(designs, machines, *x.shape[1:]) for x in found)
        return figures, slopes

    def screen(self, position: int, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """A quick evaluation of designs of one family, on the nominal machine alone.

        Margins and norms by frequency response are left out, which take longer than all others.

        Args:
            position: index of a design of that family among those of the constructor.
            values: (n, p), any number of them.

        Returns:
            (largest excess over the limits of the loop, at least that of a stable one, inf where
            none is found, (n,); linear residual vibration [m], (n,)).
        """
        batch = self._batch_of(position)
        if batch.structure.feedback != "sampled":
            return np.zeros(len(values)), np.zeros(len(values))
        quick = [k for k, name in enumerate(self.names) if name not in (*MARGINS, *PEAKS)]
        names = tuple(self.names[k] for k in quick) or ("slowest_decay",)
        evaluate = partial(
            screen_designs,
            batch.structure._replace(n_steps=batch.n_steps),
            names,
            self._spec.free.place,
            jax.tree.map(lambda x: x[0], batch.of_design(position)),
            self._limits[position, 0, quick] if quick else np.array([STABLE]),
            self._links,
        )
        excess, residual = self._in_parts(
            batch, len(values), BATCH, lambda rows: evaluate(values[rows])
        )
        worst = excess.max(axis=1)
        return (
            np.where(np.isfinite(worst), worst, np.inf),
            np.where(np.isfinite(residual), residual, np.inf),
        )

    def plain_terms(self, position: int, values: np.ndarray) -> np.ndarray:
        """Terms of the objective of designs (n, p) of one family, see `screen`; (n, S, t)."""
        if not self.terms:
            return np.zeros((len(values), len(self.machines.of_scenario), 0))
        figures = self._plain(position, values, with_decay(self.terms))
        terms = [
            term_values(
                self.terms, dict(zip(figures, each, strict=True)), self.machines.of_scenario
            )
            for each in zip(*figures.values(), strict=True)
        ]
        return np.stack(terms)

    def beyond(self, position: int, values: np.ndarray) -> np.ndarray:
        """How far designs (n, p) of one family exceed the limits of the loop on any machine, (n,).

        As shares of the limits, -inf without limits.
        """
        figures = self._plain(position, values, self.names)
        beyond = np.full((len(values), len(self.names)), -np.inf)
        for k, name in enumerate(self.names):
            allowed = self._limits[position, :, k]
            beyond[:, k] = [-relative_margin(name, each, allowed) for each in figures[name]]
        return beyond.max(axis=1, initial=-np.inf)

    def _plain(
        self, position: int, values: np.ndarray, names: tuple[str, ...]
    ) -> dict[str, np.ndarray]:
        """Figures of designs of one family on every machine, (n, machines)."""
        batch, shape = self._batch_of(position), (len(values), self.machines.size)
        lanes = np.arange(shape[0] * shape[1])
        numbers = jax.tree.map(lambda x: x[lanes % shape[1]], batch.of_design(position))
        cases = tuned_cases(
            batch.structure, self._spec.free.place, numbers, values[lanes // shape[1]]
        )
        cases = jax.tree.map(np.asarray, cases)
        figures = figures_of_cases(batch.structure, cases, names, len(lanes))
        return {name: x.reshape(shape) for name, x in figures.items()}

    def _in_parts(
        self, batch: _Batch, count: int, size: int, evaluate: Callable[[np.ndarray], Any]
    ) -> tuple[np.ndarray, ...]:
        """Evaluate rows in parts of equal size; each core takes one part after another.

        Args:
            batch: whose designs they are.
            count: of rows.
            size: of a part; the last row fills the last one up.
            evaluate: function of rows (size,), a tuple of arrays with these first.
        """
        # two threads would compile the same program twice
        program = evaluate.__qualname__, batch.structure, size
        cores = os.cpu_count() if program in self._compiled else 1
        self._compiled.add(program)
        found: tuple[np.ndarray, ...] = in_parts(evaluate, count, size, cores)
        return found

    def _batch_of(self, position: int) -> _Batch:
        return next(x for x in self._batches.values() if position in x.rows)


def _check_stable(path: str, decay: np.ndarray) -> None:
    is_bad = ~(decay > 0)
    if is_bad.any():
        k = int(np.argmax(is_bad))
        raise StudyError(
            f"{path}: the loop of the baseline is unstable{_on_machine(k, is_bad)}, its slowest "
            f"decay {decay[k]:.4g} 1/s; allowed: > 0 on every machine of tune.scenarios"
        )


def _on_machine(k: int, every: np.ndarray) -> str:
    if len(every) == 1:
        return ""
    return " on machine " + (f"{k + 1}" if k else "1, the nominal one") + f" of {len(every)}"


class _Batch(NamedTuple):
    """Designs of one law and drive."""

    rows: np.ndarray  # places among all designs, rising
    structure: Structure  # of the loop alone
    n_steps: int  # samples of the command, as a run has them
    numbers: Numbers  # leaves (designs, machines, ...)

    def of_design(self, position: int) -> Numbers:
        """Those of one design by its place among all, leaves (machines, ...)."""
        row = int(np.searchsorted(self.rows, position))
        numbers: Numbers = jax.tree.map(lambda x: x[row], self.numbers)
        return numbers

    def each_machine(self) -> Numbers:
        """Machine by machine within each design, leaves (designs x machines, ...)."""
        numbers: Numbers = jax.tree.map(
            lambda x: x.reshape(x.shape[0] * x.shape[1], *x.shape[2:]), self.numbers
        )
        return numbers
