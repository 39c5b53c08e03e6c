"""Signals and figures of whole motions."""

from __future__ import annotations

import numpy as np

from jaxmodel.metrics import METRICS
from studies.errors import StudyError, field_error
from studies.fitting.entries.common import (
    Models,
    ascending,
    noise_of,
    reader,
    real,
    signals_of,
    unknown,
)
from studies.fitting.kinds.contract import Measurement
from studies.fitting.kinds.figures import Compared, Figures, Switch
from studies.fitting.kinds.traces import Band, Settling, Trace
from studies.fitting.spec import FiguresEntry, FitSpec, SettlingEntry, TraceEntry
from studies.study.entries import entry_sizes, parse_entries
from studies.study.signals import OUTPUTS


def make_trace(spec: FitSpec, models: Models, entry: TraceEntry, path: str) -> Measurement:
    """A recorded signal."""
    read, (signal,) = reader(spec, entry, path), signals_of(spec, entry, path)
    time, value = (real(read(x), x, path) for x in (entry.time, entry.value))
    ascending(time, f"column {entry.time!r}", path)
    if time[0] < 0 or time[-1] > spec.study.run.duration:
        raise StudyError(
            f"{path}: times from {time[0]:g} to {time[-1]:g} s; allowed: within the run, 0 to "
            f"{spec.study.run.duration:g} [s] (run.duration)"
        )
    return Trace(
        entry.name,
        entry.check,
        models.motions.of(None),
        signal,
        time,
        value,
        noise_of(entry, value, path),
        OUTPUTS[signal.kind][1],
        unknown(entry.unknown),
    )


def make_settling(spec: FitSpec, models: Models, entry: SettlingEntry, path: str) -> Measurement:
    """A settling time."""
    if (entry.band is None) == (entry.band_percent is None):
        raise StudyError(f"{path}: give band [unit of the output] or band_percent [%], one of them")
    (signal,) = signals_of(spec, entry, path)
    if signal.kind in ("slider", "platform", "motor"):
        forms = ", ".join(OUTPUTS[x][0] for x in ("sensor", "deflection"))
        raise field_error(f"{path}.output", entry.output, f"{forms}, which settle about 0")
    if entry.time_s > spec.study.run.duration:
        raise field_error(
            f"{path}.time_s",
            entry.time_s,
            f"within the run, at most {spec.study.run.duration:g} (run.duration)",
            "s",
        )
    share = entry.band_percent
    band = Band(entry.band or 0.0, None)
    if share is not None:
        band = Band(share / 100, models.motions.uncontrolled())
    motion = models.motions.of(entry.links)
    data = motion, signal, band, entry.time_s, entry.sigma_s
    return Settling(entry.name, entry.check, *data)


def make_figures(spec: FitSpec, models: Models, entry: FiguresEntry, path: str) -> Measurement:
    """Metrics."""
    links, modes = entry.links or spec.study.control.links, entry.modes or spec.study.control.modes
    off = (False,) * len(links)
    is_on = spec.study.control.feedback != "none" and any(links)
    if entry.of == "reduction" and not is_on:
        raise StudyError(f"{path}.of = 'reduction': no link is under control in this study")
    if modes > spec.study.control.modes:
        raise field_error(
            f"{path}.modes", modes, f"1 to control.modes = {spec.study.control.modes}"
        )
    compared = []
    for name, value in entry.values.items():
        entries = parse_entries(name, f"{path}.values", entry_sizes(spec.study))
        if entry.amplitude and entry.of != "reduction" and value < 0:
            raise field_error(f"{path}.values.{name}", value, "0 or more where amplitude = true")
        if not METRICS[entries.metric].is_differentiable:
            smooth = [x for x in METRICS if METRICS[x].is_differentiable]
            hint = "; take kind = 'settling'" if entries.metric == "settling_time" else ""
            raise StudyError(
                f"{path}.values: {name!r} has no derivative{hint}; allowed: {', '.join(smooth)}"
            )
        compared.append(
            Compared(
                entries=entries,
                switch=Switch(off if entry.of == "uncontrolled" else links, modes),
                is_reduction=entry.of == "reduction",
                is_amplitude=entry.amplitude,
                is_largest=entry.take == "largest",
                measured=value,
                sigma=float(noise_of(entry, np.array([value]), path).sigma(np.array([value]))[0]),
                label=name,
            )
        )
    return Figures(entry.name, entry.check, models.runs, tuple(compared))
