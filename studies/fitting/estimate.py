"""Fit a model to measurements: estimate, check on what was held out, suggest what to measure."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from rich.console import Console

from studies.engine.preflight import check_run
from studies.engine.progress import Phases
from studies.errors import StudyError
from studies.fitting.diagnosis import Remedy, diagnose
from studies.fitting.draw import draw_machines
from studies.fitting.experiment import Experiment, next_experiments
from studies.fitting.kinds.contract import DataAndModel, Measurement
from studies.fitting.measurements import guess, make_bench, make_measurements
from studies.fitting.posterior import Posterior, load_blackjax, sample, shape
from studies.fitting.problem import Problem, check_sanity, make_problem
from studies.fitting.profiles import Likelihood, describe_confirmed
from studies.fitting.solve import Optimum, Solution, solve
from studies.fitting.spec import FitSpec
from studies.fitting.statistics import Answer, Misfit, misfit, rivals
from studies.publish import shown
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study
from studies.study.window import with_own_window
from studies.threads import serial_blas

#: Parameters up to which all likelihoods are profiled.
PROFILED = 6
#: Machines in the file of a tuning.
MACHINES = 64


class Fitted(NamedTuple):
    """A finished fit."""

    spec: FitSpec
    problem: Problem
    solution: Solution
    answer: Answer
    rivals: tuple[Optimum, ...]  # as good as the best one, and elsewhere
    machines: np.ndarray  # drawn from what the data leave possible, in the study's units, (n, p)
    study: Study  # with the fitted parameters
    comparisons: tuple[DataAndModel, ...]  # of all measurements
    checks: tuple[Misfit, ...]  # of those held out
    unpredicted: tuple[str, ...]  # why others held out are not among them
    profiles: tuple[Likelihood, ...]
    posterior: Posterior | None  # if samples were asked for
    fault: str  # why the fitted study does not run, "" if it does
    experiments: tuple[Experiment, ...] = ()  # the most telling first; none if the model fails
    experiment_fault: str = ""  # why none was found
    remedies: tuple[Remedy, ...] = ()  # of a misfit, the most effective first
    is_diagnosed: bool = False  # whether remedies were sought

    def _repr_html_(self) -> str:
        return shown(self)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.spec.free.names


def fit(spec: FitSpec, console: Console | None = None) -> Fitted:
    """Fit a model to measurements.

    Args:
        spec: from `load_fit`.
        console: where progress goes; default: nowhere.

    Raises:
        StudyError: data that cannot be used, or no starting point that leads to a fit.
    """
    phases = Phases(console or Console(quiet=True), fit_phases(spec))
    # many small matrices: two threads of BLAS take 1.6 times as long
    with phases, serial_blas():
        return suggest(estimate(spec, phases), phases)


def fit_phases(spec: FitSpec) -> tuple[str, ...]:
    """Names of the phases of a fit that is written."""
    samples = ("sample",) if spec.fit.samples else ()
    return ("fit", "profile", "machines", *samples, "check", "draw", "next experiment")


def estimate(spec: FitSpec, phases: Phases | None = None) -> Fitted:
    """Fit a model to measurements, without the next experiment.

    Args:
        spec: from `load_fit`.
        phases: with those of `fit_phases`; default: shown nowhere.

    Raises:
        StudyError: as `fit`.
    """
    fit, phases = spec.fit, phases or Phases(Console(quiet=True), fit_phases(spec))
    if fit.samples:
        load_blackjax()
    phases.begin("fit")
    bench = make_bench(spec)
    every = make_measurements(spec, bench)
    problem = make_problem(spec, bench, every)
    kept = problem.measurements
    check_sanity(kept, guess(spec))
    _check(problem, phases, fit.starts)
    solution = solve(problem, fit.starts, fit.refine, fit.iterations, fit.seed)
    phases.begin("profile", "the likelihood")
    has_all = fit.profile and len(spec.free.numbers) <= PROFILED
    answer, profiles = describe_confirmed(problem, solution.best.u, has_all)
    phases.begin("machines", f"{MACHINES} that the data leave possible")
    places = draw_machines(problem, solution, MACHINES, fit.seed)
    posterior = None
    if fit.samples:
        phases.begin("sample", f"{fit.samples} from the posterior")
        posterior = sample(problem, shape(answer), fit.samples, fit.seed)
    phases.begin("check")
    checks, unpredicted = _predictable([x for x in every if x.is_checked], answer.values)
    fitted = parse_study(set_values(spec.study, named_values(spec, answer.values)))
    study = with_own_window(fitted, spec.data)
    return Fitted(
        spec=spec,
        problem=problem,
        solution=solution,
        answer=answer,
        rivals=rivals(problem, solution, answer),
        machines=problem.free.values(places),
        study=study,
        comparisons=tuple(
            DataAndModel(x.name, x.is_checked, x.compare(answer.values)) for x in (*kept, *checks)
        ),
        checks=tuple(misfit(x, x.residual(answer.values, False)) for x in checks),
        unpredicted=unpredicted,
        profiles=profiles,
        posterior=posterior,
        fault=_fault(study),
    )


def suggest(fitted: Fitted, phases: Phases) -> Fitted:
    """The same with the next experiment, or with the reason why there is none."""
    if not fitted.answer.is_explained:  # a wrong model does not know what it would learn
        phases.begin("next experiment", "none for a wrong model; what would mend it")
        remedies = diagnose(fitted.spec, fitted.problem, fitted.solution.best.u)
        return fitted._replace(remedies=remedies, is_diagnosed=True)
    phases.begin("next experiment")
    try:
        found = next_experiments(
            fitted.problem.bench,
            fitted.problem.free,
            fitted.answer.place,
            fitted.answer.covariance,
            [x.u for x in fitted.rivals],
            fitted.spec.fit.next,
        )
        return fitted._replace(experiments=tuple(found))
    except (StudyError, ArithmeticError, ValueError) as error:  # LinAlgError is a ValueError
        return fitted._replace(experiment_fault=str(error))


def _check(problem: Problem, phases: Phases, starts: int) -> None:
    """Refuse data too large or too few for the parameters.

    Raises:
        StudyError: naming what is allowed.
    """
    first = problem.residual(problem.free.places())
    with np.errstate(over="ignore"):
        is_finite = np.isfinite(np.sum(first**2))
    if not is_finite:
        raise StudyError(
            "fit.data: squared residuals of the starting point overflow; allowed: data and noise "
            "within many orders of magnitude of the model"
        )
    size, priors = len(problem.free.numbers), len(problem.priors)
    count = len(first) - priors
    if count + priors < size:
        raise StudyError(
            f"fit: {count} measured numbers and {priors} known beforehand for {size} parameters; "
            "allowed: as many or more. Fix some, or give mean and sigma of what is known"
        )
    phases.say(f"{count} measured numbers, {size} parameters; {starts} starting points")


def _predictable(
    checks: list[Measurement], values: np.ndarray
) -> tuple[list[Measurement], tuple[str, ...]]:
    """Held-out measurements that the fitted model predicts, and why it does not the others."""
    kept, faults = [], []
    for one in checks:
        try:
            fault = one.sanity_error(values)
            one.reweigh(values)
            one.residual(values, False)
            kept.append(one)
        except (StudyError, np.linalg.LinAlgError) as error:
            fault = str(error).removeprefix(f"{one.name}: ")
        if fault:
            faults.append(f"{one.name} (held out): {fault}")
    return kept, tuple(faults)


def _fault(study: Study) -> str:
    try:
        check_run(study)
    except StudyError as error:
        return str(error)
    return ""


def is_good(fitted: Fitted) -> bool:
    """Whether the model explains the data, and they identify all parameters."""
    answer = fitted.answer
    is_tested = answer.freedom > 0 and not answer.is_too_close
    is_inside = not any(is_at_bound(u) for u in fitted.solution.best.u)
    is_found = fitted.solution.best.is_converged and is_inside
    is_identified = not answer.undetermined and not fitted.rivals
    return bool(answer.is_explained and is_tested and is_found and is_identified)


def is_at_bound(place: float) -> bool:
    return not 1e-6 < place < 1 - 1e-6


def named_values(spec: FitSpec, values: np.ndarray) -> dict[str, float]:
    return {x.name: float(v) for x, v in zip(spec.free.numbers, values, strict=True)}
