"""Measurements of whole motions: signals over time, and metrics such as residual vibration."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.parameters import Array
from jaxmodel.simulate import simulate
from studies.engine.program import Place
from studies.engine.runs import check_run
from studies.errors import StudyError
from studies.fitting.bench import with_slopes
from studies.fitting.kinds.contract import Curve, Noise, Residual, scaled
from studies.fitting.signals import Signal
from studies.study.entries import Entries
from studies.study.labels import describe
from studies.study.spec import Study


class Trace:
    """One signal over time, compared at the times of the measurement."""

    kind, is_ordered, n_hidden = "trace", True, 0

    def __init__(
        self,
        name: str,
        is_checked: bool,
        study: Study,
        place: Place,
        signal: Signal,
        time: np.ndarray,
        measured: np.ndarray,
        noise: Noise,
        unit: str,
    ) -> None:
        """
        Args:
            name, is_checked: of the measurement.
            study: its motion.
            place: puts free numbers into a case.
            signal: the output.
            time: [s], (n,), ascending and within the run.
            measured: (n,).
            noise: of the measured values.
            unit: of the signal.
        """
        self.name, self.is_checked, self._unit = name, is_checked, unit
        self._given, self._signal = (*_smooth(study), place), signal
        self.time, self.measured = time, measured
        self._noise, self.sigma = noise, noise.sigma(measured)

    def predicted(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        """The signal at the measured times, (n,), and its derivatives, (n, p)."""
        structure, case, place = self._given
        run = _traced_slopes if has_slopes else _traced
        found = run(structure, place, self._signal.kind, case, values)
        time, value, code, *slope = (np.asarray(x) for x in found)
        _check_finished(self.name, int(code))
        at = self._signal
        column = value[:, at.link] if value.ndim == 2 else value[:, at.link, at.patch]
        model = np.interp(self.time, time, column)
        if not has_slopes:
            return model, None
        by = slope[0][:, at.link] if value.ndim == 2 else slope[0][:, at.link, at.patch]
        return model, np.stack([np.interp(self.time, time, x) for x in by.T], axis=1)

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        found, slope = self.predicted(values, has_slopes)
        return scaled(found, slope, self.measured, self.sigma)

    def reweigh(self, values: np.ndarray) -> None:
        self.sigma = self._noise.of_model(self.predicted(values, False)[0], self.measured)

    def curve(self, values: np.ndarray) -> Curve:
        found = self.predicted(values, False)[0]
        label = f"{self._signal.kind} [{self._unit}]"
        return Curve(
            abscissa="time [s]",
            ordinate=label,
            x=self.time,
            measured=self.measured,
            model=found,
            is_log=False,
        )

    def complaint(self, values: np.ndarray) -> str:
        model = self.predicted(values, False)[0]
        ratio = float(np.ptp(self.measured) / max(np.ptp(model), 1e-300))
        if 0.01 < ratio < 100:
            return ""
        return (
            f"measured moves {ratio:.3g} times as far as the model at the first guess; expected "
            f"{self._unit}: check the unit"
        )


def _smooth(study: Study) -> tuple[Structure, Case]:
    """A study's run with derivatives.

    Raises:
        StudyError: as `check_run`.
    """
    structure, case = check_run(study)
    return structure._replace(is_smooth=True), case


def _recorded(structure: Structure, place: Place, kind: str, case: Case, values: Array) -> Any:
    result = simulate(structure, place(case, values), has_record=True)
    record = result.record
    assert record is not None
    signals = {
        "sensor": record.sensor_voltage,
        "slider": record.slider,
        "platform": record.pose,
        "deflection": record.chord_deflection_stations,
    }
    return signals[kind], (record.time, result.status)


@partial(jax.jit, static_argnums=(0, 1, 2))
def _traced(structure: Structure, place: Place, kind: str, case: Case, values: Array) -> Any:
    value, (time, code) = _recorded(structure, place, kind, case, values)
    return time, value, code


@partial(jax.jit, static_argnums=(0, 1, 2))
def _traced_slopes(structure: Structure, place: Place, kind: str, case: Case, values: Array) -> Any:
    run = with_slopes(_recorded, 4, is_first=True)
    slope, (value, (time, code)) = run(structure, place, kind, case, values)
    return time, value, code, slope


def _check_finished(name: str, code: int) -> None:
    if code not in status.FINISHED:
        raise StudyError(f"{name}: the run ends with status {describe(code)}")


#: No link under control.
OFF = (False, False, False)


class Switch(NamedTuple):
    """What is under control."""

    links: tuple[bool, bool, bool]
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


class Runs:
    """Runs of one study with different links under control, kept for the last free numbers.

    All figures share them: one program runs every combination that any of them needs.
    """

    def __init__(self, study: Study, place: Place) -> None:
        """Arguments: what all runs share, and what puts free numbers into a case.

        Raises:
            StudyError: as `check_run`.
        """
        self._structure, self._case = _smooth(study)
        self._place = place
        self._metrics: set[str] = set()
        self._switches: list[Switch] = []
        self._kept: tuple[bytes, bool, Any] = b"", False, None

    def add(self, compared: tuple[Compared, ...]) -> None:
        """Run what these figures need, too."""
        self._metrics |= {x.entries.metric for x in compared}
        needed = [x.switch for x in compared] + [_off(x) for x in compared if x.is_reduction]
        self._switches += [x for x in dict.fromkeys(needed) if x not in self._switches]

    def find(self, values: np.ndarray, has_slopes: bool) -> Any:
        """Metrics of all runs and, perhaps, their derivatives.

        Raises:
            StudyError: a run that does not reach its end.
        """
        key, slopes, found = self._kept
        if key != values.tobytes() or (has_slopes and not slopes):
            masks = np.array([x.links for x in self._switches], float)
            modes = np.array([x.modes for x in self._switches])
            structure = self._structure._replace(metrics=tuple(sorted(self._metrics)))
            run = _metric_slopes if has_slopes else _metrics
            given = structure, self._place, self._case, masks, modes, values
            found = jax.tree.map(np.asarray, run(*given))
            self._kept = values.tobytes(), has_slopes, found
        metrics, code, *by = found
        for one in code:
            _check_finished("figures", int(one))
        return metrics, *by[: int(has_slopes)]

    def at(self, switch: Switch) -> int:
        """Place of a run among all of them."""
        return self._switches.index(switch)


class Figures:
    """Metrics of runs that differ in which links are controlled."""

    kind, is_ordered, n_hidden = "figures", False, 0

    def __init__(
        self, name: str, is_checked: bool, runs: Runs, compared: tuple[Compared, ...]
    ) -> None:
        self.name, self.is_checked, self._runs, self._compared = name, is_checked, runs, compared
        runs.add(compared)
        self.measured = np.array([x.measured for x in compared])
        self.sigma = np.array([x.sigma for x in compared])

    def predicted(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        """Numbers of the model, (m,), and their derivatives, (m, p)."""
        found = [self._number(x, *self._runs.find(values, has_slopes)) for x in self._compared]
        value = np.array([x for x, _ in found])
        return value, np.array([by for _, by in found]) if has_slopes else None

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
        by = np.moveaxis(slopes[name][k : k + 1], -1, 0)  # (p, 1, ...)
        parts = np.stack([one.entries.take(x)[0][kept] for x in by], axis=-1)  # (entries, p)
        slope = (value @ parts) / (len(value) * size) if size != 0 else parts.sum(0)
        return root, slope / (2 * root) if one.is_amplitude and root > 0 else slope

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        found, slope = self.predicted(values, has_slopes)
        return scaled(found, slope, self.measured, self.sigma)

    def reweigh(self, values: np.ndarray) -> None:
        pass  # few numbers, whose noise is a share of what was measured

    def curve(self, values: np.ndarray) -> Curve:
        found = self.predicted(values, False)[0]
        return Curve(
            abscissa="",
            ordinate="figure of the run",
            x=np.arange(len(found)),
            measured=self.measured,
            model=found,
            is_log=False,
            labels=tuple(x.label for x in self._compared),
        )

    def complaint(self, values: np.ndarray) -> str:
        return ""


def _off(one: Compared) -> Switch:
    return one.switch._replace(links=OFF)


def _run_metrics(
    structure: Structure, place: Place, case: Case, masks: Array, modes: Array, values: Array
) -> Any:
    changed = place(case, values)

    def one(mask: Array, count: Array) -> Any:
        control = changed.control._replace(
            link_mask=jnp.ones_like(changed.control.link_mask) * mask, n_active=count
        )
        result = simulate(structure, changed._replace(control=control))
        named = {name: getattr(result.metrics, name) for name in structure.metrics}
        return named, result.status

    return jax.vmap(one)(jnp.asarray(masks), jnp.asarray(modes))


_metrics = jax.jit(_run_metrics, static_argnums=(0, 1))


@partial(jax.jit, static_argnums=(0, 1))
def _metric_slopes(
    structure: Structure, place: Place, case: Case, masks: Array, modes: Array, values: Array
) -> Any:
    run = with_slopes(_run_metrics, 5, is_first=True)
    slopes, (metrics, code) = run(structure, place, case, masks, modes, values)
    return metrics, code, slopes
