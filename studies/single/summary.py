"""What a run ended like, in words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from jaxmodel import status
from studies.engine.runs import Run
from studies.show import units
from studies.show.listing import Rows
from studies.show.units import headed, number

#: Residual vibration below which joints that rub decide [m].
STICKING = 2e-6


def watched(run: Run) -> float:
    """From the end of the shaped command to that of the run [s]."""
    return run.study.run.duration - float(run.result.command_end)


def settling_text(run: Run, link: int) -> str:
    """Settling time of a link [ms], or that it was outside the band to the end."""
    return units.settling_text(float(run.result.metrics.settling_time[link]), watched(run))


def link_rows(run: Run, twin: Run | None = None) -> Rows:
    """What each link did, at its worst station; twin: the same run without control."""
    metrics, record = run.result.metrics, run.result.record
    numbers = [str(k + 1) for k in range(run.study.n_links)]
    columns: dict[str, Sequence[str]] = {"link": numbers}

    def add(name: str, unit: str, values: np.ndarray) -> None:
        columns[headed(name, unit)] = [number(np.max(value), unit) for value in values]

    add("residual rms", "m", metrics.residual_rms)
    if twin is not None:
        add("residual rms without control", "m", twin.result.metrics.residual_rms)
    add("residual peak", "m", metrics.residual_peak)
    if record is not None:
        add("peak of the run", "m", np.abs(record.chord_deflection_stations).max(axis=0))
    columns[headed("settling time", "s")] = [
        settling_text(run, link) for link in range(run.study.n_links)
    ]
    add("peak voltage", "V", metrics.peak_voltage)
    add("peak motor force", "N", metrics.peak_force)
    return Rows(list(columns), [list(row) for row in zip(*columns.values(), strict=True)])


def limits_text(run: Run) -> str:
    """Warning about converters and actuators at their limits in a run that ended ok, "" if none."""
    metrics = run.result.metrics
    shares = {
        "an ADC channel clipped": float(metrics.clipped_fraction),
        "an actuator at its limit": float(metrics.saturated_fraction),
        "a motor at its limit": float(metrics.motor_saturated_fraction),
    }
    warnings = [
        f"{100 * share:.2g} % of the samples have {event}"
        for event, share in shares.items()
        if share > 0
    ]
    return f"CAUTION: {'; '.join(warnings)}." if warnings and run.status == status.OK else ""


def machine_notes(run: Run) -> list[str]:
    """What a real machine would do beside: joints that decide how little is left, cracks."""
    metrics, notes = run.result.metrics, []
    if np.max(metrics.residual_rms) < STICKING and run.study.machine.joint_friction == 0:
        notes.append(
            "Less than 2 um is left: joints that rub decide there, since they hold a link that "
            "hardly bends (machine.joint_friction, here 0; small ball bearings have 0.05 to 0.5 "
            "mN m)."
        )
    if (strain := np.max(metrics.patch_strain_peak)) > (limit := run.study.patches.strain_limit):
        notes.append(f"Ceramics strained up to {strain:.3g}, patches.strain_limit = {limit:g}.")
    return notes
