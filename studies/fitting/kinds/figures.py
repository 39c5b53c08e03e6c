"""Metrics of whole motions, such as residual vibration, and their reduction by control."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from jaxmodel.metrics import METRICS
from studies.errors import StudyError, field_error
from studies.fitting.kinds.contract import DataEntry, Measurement, Models
from studies.fitting.kinds.entry import NoiseEntry
from studies.fitting.kinds.runs import Runs, Switch
from studies.study.entries import Entries, entry_sizes, parse_entries
from studies.study.links import OneALink
from studies.study.spec import described


class FiguresEntry(DataEntry, NoiseEntry):
    """Metrics of the study's motion, or their reduction by control."""

    values: dict[str, float] = described(
        ..., "-", "metric = value, in its unit or in percent", min_length=1
    )
    of: Literal["controlled", "uncontrolled", "reduction"] = described(
        "controlled", "-", "with control, without, or percent less with it"
    )
    amplitude: bool = described(
        False, "-", "of the square root of the metric: an amplitude where it is a power"
    )
    take: Literal["rms", "largest"] = described("rms", "-", "of several entries of a metric")
    modes: int | None = described(
        None, "1", "controlled modes; default: those of the study", ge=1, le=12
    )
    links: OneALink[bool] | None = described(
        None, "-", "under control; default: those of the study"
    )

    def measurement(self, models: Models, path: str) -> Measurement:
        control = models.study.control
        switch = Switch(self.links or control.links, self.modes or control.modes)
        if self.of == "reduction" and (control.feedback == "none" or not any(switch.links)):
            raise StudyError(f"{path}.of = 'reduction': no link is under control in this study")
        if switch.modes > control.modes:
            allowed = f"1 to control.modes = {control.modes}"
            raise field_error(f"{path}.modes", switch.modes, allowed)
        entries, sigma = dict[str, Entries](), []
        for name, value in self.values.items():
            one = parse_entries(name, f"{path}.values", entry_sizes(models.study))
            entries[name] = one
            if self.amplitude and self.of != "reduction" and value < 0:
                allowed = "0 or more where amplitude = true"
                raise field_error(f"{path}.values.{name}", value, allowed)
            if not METRICS[one.metric].is_differentiable:
                smooth = [x for x in METRICS if METRICS[x].is_differentiable]
                hint = "; take kind = 'settling'" if one.metric == "settling_time" else ""
                raise StudyError(
                    f"{path}.values: {name!r} has no derivative{hint}; allowed: {', '.join(smooth)}"
                )
            sigma.append(self.noise(np.array([value]), path).sigma(np.array([value]))[0])
        if self.of == "uncontrolled":
            switch = switch.off
        return Figures(self, models.runs, switch, entries, np.array(sigma))


class Figures(Measurement):
    """Metrics of a run, or by how many percent they are less than without control."""

    kind = "figures"

    def __init__(
        self,
        entry: FiguresEntry,
        runs: Runs,
        switch: Switch,
        entries: dict[str, Entries],
        sigma: np.ndarray,
    ) -> None:
        super().__init__(entry, np.array(list(entry.values.values())), sigma)
        self._entry, self._runs, self._switch, self._entries = entry, runs, switch, entries
        self._is_reduction = entry.of == "reduction"
        root, power = ("root of ", "^(1/2)") if entry.amplitude else ("", "")
        for name, one in entries.items():
            unit = "%" if self._is_reduction else METRICS[one.metric].unit + power
            self.labels = (*self.labels, f"{root}{name} [{unit}]")
            runs.add(one.metric, switch, *[switch.off] * self._is_reduction)

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        outcome = self._runs.run(values, has_slopes)
        pairs = (self._number(name, *outcome) for name in self._entries)
        numbers, slopes = zip(*pairs, strict=True)
        return np.array(numbers), np.array(slopes) if has_slopes else None

    def _number(self, name: str, metrics: Any, slopes: Any = None) -> tuple[Any, Any]:
        one = self._entries[name]
        on, by_on = self._taken(one, self._switch, metrics, slopes)
        if not self._is_reduction:
            return on, by_on
        off, by_off = self._taken(one, self._switch.off, metrics, slopes)
        if off == 0:
            raise StudyError(f"{self.name}: {name} is 0 without control: it has no reduction")
        by = None if slopes is None else 100 * (on * by_off / off**2 - by_on / off)
        return 100 * (1 - on / off), by

    def _taken(self, one: Entries, switch: Switch, metrics: Any, slopes: Any) -> tuple[Any, Any]:
        """The metric of a run, and its derivatives."""
        k = self._runs.at(switch)
        value = one.take(metrics[one.metric][k : k + 1])[0]
        kept = [int(np.argmax(value))] if self._entry.take == "largest" else slice(None)
        value = value[kept]
        size = float(np.sqrt(np.mean(value**2))) if len(value) > 1 else float(value[0])
        root = np.sqrt(size) if self._entry.amplitude else size
        if slopes is None:
            return root, None
        by = slopes[one.metric][:, k : k + 1]  # (p, 1, ...)
        parts = np.stack([one.take(x)[0][kept] for x in by], axis=-1)  # (entries, p)
        slope = (value @ parts) / (len(value) * size) if size != 0 else parts.sum(0)
        return root, slope / (2 * root) if self._entry.amplitude and root > 0 else slope
