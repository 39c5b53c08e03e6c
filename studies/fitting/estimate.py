"""Fit a model to measurements: estimate, check on what was held out, suggest what to measure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.fitting.diagnosis import Remedy, diagnose
from studies.fitting.draw import draw_machines
from studies.fitting.experiment import Experiment, next_experiments
from studies.fitting.kinds.contract import DataAndModel, Measurement
from studies.fitting.measurements import guess, make_bench, make_measurements
from studies.fitting.posterior import Posterior, load_blackjax, sample, shape
from studies.fitting.problem import Problem, check_sanity, make_problem
from studies.fitting.profiles import Likelihood, describe_confirmed
from studies.fitting.solve import Optimum, Solution, solve, weigh
from studies.fitting.spec import FitSpec
from studies.fitting.statistics import Answer, Misfit, misfit, rivals
from studies.job import Job
from studies.result import Result
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study
from studies.study.window import with_own_window

#: Parameters up to which all likelihoods are profiled.
PROFILED = 6
#: Machines in the file of a tuning.
MACHINES = 64


@dataclass(frozen=True, eq=False)
class Fitted(Result):
    """A finished fit."""

    FILES = "; fitted.toml is the fitted study, fitted_tune.toml a tuning for machines like it"

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

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return self.spec.free.names


def fit_phases(spec: FitSpec) -> dict[str, float]:
    """What is done, with what it takes on two cores [s]."""
    samples = {"sample": 60.0} if spec.fit.samples else {}
    first = {"fit": 30.0, "profile": 15.0, "machines": 15.0, **samples, "check": 5.0}
    return {**first, "draw": 8.0, "next experiment": 20.0}


def estimate(spec: FitSpec, job: Job) -> Fitted:
    """Fit a model to measurements, without the next experiment.

    Args:
        spec: from `load_fit`.
        job: with `fit_phases`.

    Raises:
        StudyError: as `studies.fit`.
    """
    fit = spec.fit
    if fit.samples:
        load_blackjax()
    job.begin("fit")
    bench = make_bench(spec)
    every = make_measurements(spec, bench)
    problem = make_problem(spec, bench, every)
    kept = problem.measurements
    check_sanity(kept, guess(spec))
    _check(problem, job, fit.starts)
    asked = fit.starts, fit.refine, fit.iterations, fit.seed
    solution = job.part("fit", lambda: solve(problem, *asked))
    weigh(problem, solution.weighed)
    job.begin("profile", "the likelihood")
    has_all, best = fit.profile and len(spec.free.numbers) <= PROFILED, solution.best.u
    answer, profiles = job.part("profile", lambda: describe_confirmed(problem, best, has_all))
    job.begin("machines", f"{MACHINES} that the data leave possible")
    places = job.part("machines", lambda: draw_machines(problem, solution, MACHINES, fit.seed))
    posterior = None
    if fit.samples:
        job.begin("sample", f"{fit.samples} from the posterior")
        about = shape(answer)
        posterior = job.part("sample", lambda: sample(problem, about, fit.samples, fit.seed))
    job.begin("check")
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


def suggest(fitted: Fitted, job: Job) -> Fitted:
    """The same with the next experiment, or with the reason why there is none."""
    if not fitted.answer.is_explained:  # a wrong model does not know what it would learn
        job.begin("next experiment", "none for a wrong model; what would mend it")
        best = fitted.solution.best.u
        remedies = job.part("remedies", lambda: diagnose(fitted.spec, fitted.problem, best))
        return replace(fitted, remedies=remedies, is_diagnosed=True)
    job.begin("next experiment")
    arguments = (
        fitted.problem.bench,
        fitted.problem.free,
        fitted.answer.place,
        fitted.answer.covariance,
        [x.u for x in fitted.rivals],
        fitted.spec.fit.next,
    )
    try:
        found = job.part("next experiment", lambda: tuple(next_experiments(*arguments)))
        return replace(fitted, experiments=found)
    except (StudyError, ArithmeticError, ValueError) as error:  # LinAlgError is a ValueError
        return replace(fitted, experiment_fault=str(error))


def _check(problem: Problem, job: Job, starts: int) -> None:
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
    job.say(f"{count} measured numbers, {size} parameters; {starts} starting points")


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
