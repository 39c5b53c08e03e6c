"""The JSON document of one run."""

from __future__ import annotations

from typing import Any

from studies.engine.run_data import loop_variables, result_variables
from studies.results.labelled import Labelled, Variable, labelled, told
from studies.single.run import Simulation
from studies.study.labels import describe

#: Axis of metrics that are curves: the files of runs have them.
_CURVE = "spectrum_point"


class RunDocument(Labelled, command="simulate"):
    """What `studies simulate --json` prints: how one run ended. Metrics of links are lists: `axes`
    names the levels of nesting.
    """

    title: str = told("of the study")
    status: int = told("code, as in files")
    status_text: str = told("the same in words")
    metrics: dict[str, Any] = told("metrics and condition numbers by name, in SI units")
    without_control: dict[str, Any] | None = told("the same without control; null: there is none")
    loop: dict[str, Any] | None = told("the linearised sampled loop; null: there is none")
    breaking: str = told("what goes unstable beyond the gain margin; empty if nothing does")
    residual_delay: float = labelled("s", "from the end of the reference to the residual window")
    residual_length: float = labelled("s", "of the residual window")
    units: dict[str, str] = told("SI symbol of each number by its name, 1 for none")
    axes: dict[str, tuple[str, ...]] = told("of each number, outermost first; none for one number")


def run_document(found: Simulation) -> RunDocument:
    """The document of a run."""
    run, twin = found.run, found.free
    metrics, loop = _short(result_variables(run)), loop_variables(run)
    labelled_numbers, windows = metrics | loop, run.case.windows
    return RunDocument(
        title=run.study.title,
        status=int(run.status),
        status_text=describe(run.status),
        metrics=_values(metrics),
        without_control=None if twin is None else _values(_short(result_variables(twin))),
        loop=_values(loop) if loop else None,
        breaking=(run.loop.breaking or "") if run.loop else "",
        residual_delay=float(windows.residual_delay),
        residual_length=float(windows.residual_length),
        units={name: variable.units for name, variable in labelled_numbers.items()},
        axes={name: variable.dims for name, variable in labelled_numbers.items()},
    )


def _short(variables: dict[str, Variable]) -> dict[str, Variable]:
    return {name: x for name, x in variables.items() if _CURVE not in x.dims}


def _values(variables: dict[str, Variable]) -> dict[str, Any]:
    return {name: variable.data for name, variable in variables.items()}
