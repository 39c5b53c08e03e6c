"""What a run ended like, in words."""

from __future__ import annotations

from jaxmodel import status
from studies.engine.runs import Run
from studies.show import units


def watched(run: Run) -> float:
    """From the end of the shaped command to that of the run [s]."""
    return run.study.run.duration - float(run.result.command_end)


def settling_text(run: Run, link: int) -> str:
    """Settling time of a link [ms], or that it was outside the band to the end."""
    return units.settling_text(float(run.result.metrics.settling_time[link]), watched(run))


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
