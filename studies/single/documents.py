"""JSON documents of one study: its run, and its natural modes."""

from __future__ import annotations

from typing import Any

from studies.engine.modes import NamedModes
from studies.engine.run_data import loop_variables, result_variables
from studies.engine.runs import Run
from studies.store import Variable
from studies.study.labels import describe

#: Axis of metrics that are curves: the files of runs have them.
_CURVE = "spectrum_point"


def run_document(run: Run, twin: Run | None) -> dict[str, Any]:
    """What `studies simulate` says; twin: the same run without control, None if nothing acts."""
    metrics, loop = _short(result_variables(run)), loop_variables(run)
    free = None if twin is None else _values(_short(result_variables(twin)))
    labelled, windows = metrics | loop, run.case.windows
    return {
        "title": run.study.title,
        "status": run.status,
        "status_text": describe(run.status),
        "metrics": _values(metrics),
        "without_control": free,
        "loop": _values(loop) if loop else None,
        "breaking": (run.loop.breaking or "") if run.loop else "",
        "residual_delay": float(windows.residual_delay),
        "residual_length": float(windows.residual_length),
        "units": {name: variable.units for name, variable in labelled.items()},
        "axes": {name: variable.dims for name, variable in labelled.items()},
    }


def _short(variables: dict[str, Variable]) -> dict[str, Variable]:
    return {name: x for name, x in variables.items() if _CURVE not in x.dims}


def _values(variables: dict[str, Variable]) -> dict[str, Any]:
    return {name: variable.data for name, variable in variables.items()}


def modes_document(found: NamedModes) -> dict[str, Any]:
    """What `studies modes` says."""
    rows = zip(found.frequency, found.damping_ratio, found.kinds, strict=True)
    return {
        "modes": [
            {"mode": k, "frequency_hz": frequency, "damping_ratio": ratio}
            | kind._asdict()
            | {"description": kind.description}
            for k, (frequency, ratio, kind) in enumerate(rows, 1)
        ],
        "units": {"frequency_hz": "Hz", "damping_ratio": "1", "share": "1"},
    }
