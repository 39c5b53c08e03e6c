"""The answer of a fit: what `fit.json` and `fit.h5` hold."""

from __future__ import annotations

import numpy as np

from studies.fitting.estimate import Fitted, is_good, named_values
from studies.fitting.experiment import Experiment
from studies.fitting.kinds.contract import Line
from studies.fitting.say import sentences, unknown_numbers
from studies.fitting.statistics import Misfit
from studies.results.labelled import Labelled, Records, Variable, labelled, told, variables

_OWN = "in the field's unit"


class EqualOptimum(Labelled):
    """Another optimum that explains the data as well."""

    rise: float = told("of chi square")
    values: dict[str, float] = told(f"by name, {_OWN}")


class FitDocument(Labelled, command="fit", version=2):
    """`fit.json`, by `studies fit`: parameters of a machine, and how well they are known."""

    ROWS = Records("numbers", ("number",), "a row for each parameter")

    title: str = told("of the study")
    is_good: bool = told("whether the model explains the data, and they identify all parameters")
    is_explained: bool = told("whether the residuals look like the stated noise")
    is_converged: bool = told("whether the search ended by itself")
    messages: list[str] = told("what to know, gravest first")
    chi_square: float = told("of the fitted measurements")
    freedom: int = told("degrees of freedom")
    undetermined: list[dict[str, float]] = told("combinations that the data do not determine")
    equally_good: list[EqualOptimum] = told("other optima")
    unknown: dict[str, dict[str, float]] = told(
        "of measurements: gain [1], delay [s], offset in its unit"
    )
    experiments: tuple[Experiment, ...] = told("the most telling first, or all taken at once")
    held_out: tuple[Misfit, ...] = told("measurements that were not fitted")
    name: np.ndarray[tuple[int], np.dtype[np.str_]] = labelled(
        "1", "parameter", "number", file_name="number"
    )
    value: np.ndarray = labelled("1", f"fitted, {_OWN}", "number")
    sigma: np.ndarray = labelled("1", f"standard deviation, {_OWN}", "number")
    interval_95: np.ndarray = labelled("1", f"95 %, {_OWN}", "number", "end", file_name="interval")
    correlation: np.ndarray = labelled("1", "with each of the numbers", "number", "other")
    machine: np.ndarray = labelled(
        "1", "machines that the data leave possible", "machine", "number", is_in_document=False
    )
    optimum: np.ndarray = labelled(
        "1", f"optima, the best first, {_OWN}", "optimum", "number", is_in_document=False
    )
    optimum_rise: np.ndarray = labelled(
        "1", "rise of chi square from the best optimum", "optimum", is_in_document=False
    )
    sample: np.ndarray | None = labelled(
        "1", f"posterior, {_OWN}", "draw", "number", is_in_document=False
    )


def fit_document(fitted: Fitted) -> FitDocument:
    """The answer of a fit."""
    answer, free, solution = fitted.answer, fitted.spec.free, fitted.solution
    return FitDocument(
        title=fitted.spec.study.title,
        is_good=is_good(fitted),
        is_explained=bool(answer.is_explained),
        is_converged=bool(solution.best.is_converged),
        messages=sentences(fitted),
        chi_square=float(answer.chi_square),
        freedom=int(answer.freedom),
        undetermined=[
            {fitted.names[k]: float(x.parts[k]) for k in x.named()} for x in answer.undetermined
        ],
        equally_good=[
            EqualOptimum(solution.rise(x), named_values(fitted.spec, free.values(x.u)))
            for x in fitted.rivals
        ],
        unknown=unknown_numbers(fitted),
        experiments=fitted.experiments,
        held_out=fitted.checks,
        name=np.array(fitted.names),
        value=answer.values,
        sigma=answer.sigma,
        interval_95=answer.interval,
        correlation=answer.correlation,
        machine=fitted.machines,
        optimum=free.values(np.stack([x.u for x in solution.optima])),
        optimum_rise=np.array([solution.rise(x) for x in solution.optima]),
        sample=None if fitted.posterior is None else fitted.posterior.values,
    )


def fit_variables(fitted: Fitted) -> dict[str, Variable]:
    """Labelled numbers of a fit, with data and model of every measurement."""
    found = variables(fit_document(fitted))
    for k, (name, _, one) in enumerate(fitted.comparisons):
        point = (f"point_{k}",)
        if isinstance(one, Line):
            x, unit = Variable(one.x, point, "1", one.abscissa), one.ordinate
        else:
            x, unit = Variable(np.array(one.labels), point, "1", "number"), "in its unit"
        found |= {
            f"x_{k}": x,
            f"measured_{k}": Variable(one.measured, point, "1", f"{name}: {unit}"),
            f"model_{k}": Variable(one.model, point, "1", f"{name}: {unit}"),
        }
    return found
