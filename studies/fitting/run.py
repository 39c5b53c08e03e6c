"""From the file of a fit to the folder with its answer."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from studies.engine.preflight import check_run
from studies.engine.progress import Phases
from studies.engine.run_data import run_attributes
from studies.errors import StudyError
from studies.fitting import plots
from studies.fitting.draw import draw_machines
from studies.fitting.experiment import Experiment, next_experiments
from studies.fitting.kinds.contract import DataAndModel, Line, Measurement
from studies.fitting.measurements import guess, make_bench, make_measurements
from studies.fitting.posterior import Posterior, load_blackjax, sample, shape
from studies.fitting.problem import Problem, complaints
from studies.fitting.profiles import Likelihood, describe_confirmed
from studies.fitting.report import is_good, report, sentences, summary
from studies.fitting.solve import Optimum, Solution, solve
from studies.fitting.spec import FitSpec
from studies.fitting.statistics import REGION, Answer, Misfit, misfit, rivals
from studies.show import figures
from studies.show.pages import write_report
from studies.store import Variable, check_folder, replacing, staged, write_store
from studies.study.paths import set_values
from studies.study.spec import Study, parse_study
from studies.study.template import study_template

#: Parameters up to which all likelihoods are profiled.
PROFILED = 6
#: Machines in the file of a tuning.
MACHINES = 64
#: Least gain margin of that tuning [1].
MARGIN = 2.0
#: Files of the folder.
STUDY, TUNE, DATA, DOCUMENT = "fitted.toml", "fitted_tune.toml", "fit.h5", "fit.json"


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
    with Phases(console or Console(quiet=True), fit_phases(spec)) as phases:
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
    kept = tuple(x for x in every if not x.is_checked)
    complaints(kept, guess(spec))
    problem = Problem(
        free=spec.free,
        priors=spec.priors,
        measurements=kept,
        bench=bench,
        is_robust=fit.loss == "robust",
    )
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
    study = parse_study(set_values(spec.study, _numbers(spec, answer.values)))
    return Fitted(
        spec=spec,
        problem=problem,
        solution=solution,
        answer=answer,
        rivals=rivals(problem, solution, answer),
        machines=problem.free.values(places),
        study=study,
        comparisons=tuple(
            DataAndModel(x.name, x.is_checked, x.comparison(answer.values))
            for x in (*kept, *checks)
        ),
        checks=tuple(misfit(x, x.residual(answer.values, False)) for x in checks),
        unpredicted=unpredicted,
        profiles=profiles,
        posterior=posterior,
        fault=_fault(study),
    )


def suggest(found: Fitted, phases: Phases) -> Fitted:
    """The same with the next experiment, or with the reason why there is none."""
    if not found.answer.is_explained:  # a wrong model does not know what it would learn
        return found
    phases.begin("next experiment")
    given = found.problem.bench, found.problem.free, found.answer.place, found.answer.covariance
    try:
        return found._replace(experiments=tuple(next_experiments(*given)))
    except (StudyError, ArithmeticError, ValueError) as error:  # LinAlgError is a ValueError
        return found._replace(experiment_fault=str(error))


def _check(problem: Problem, phases: Phases, starts: int) -> None:
    """Refuse data too large or too few for the parameters.

    Raises:
        StudyError: naming what is allowed.
    """
    first = problem.residual(problem.free.places())
    if not np.isfinite(np.sum(first**2)):
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
            fault = one.complaint(values)
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


def _numbers(spec: FitSpec, values: np.ndarray) -> dict[str, float]:
    return {x.name: float(v) for x, v in zip(spec.free.numbers, values, strict=True)}


def run_fit(
    spec: FitSpec, out: str | Path, console: Console | None = None, has_pdf: bool = False
) -> Fitted:
    """Fit, and write the answer into a folder.

    Args:
        spec: from `load_fit`.
        out: folder for the files, created if missing.
        console: where messages go; default: standard output.
        has_pdf: also write the figures as PDF.

    Raises:
        StudyError: as `fit`, or a folder that cannot be written to.
    """
    out, console = Path(out), console or Console(highlight=False, markup=False)
    check_folder(out)
    with Phases(console, fit_phases(spec)) as phases:
        found = estimate(spec, phases)
        phases.begin("draw")
        try:
            out.mkdir(parents=True, exist_ok=True)
            with staged(out) as staging:
                drawn = _draw(staging, found, has_pdf)
                (staging / STUDY).write_text(study_template(found.study), encoding="utf-8")
                (staging / TUNE).write_text(_tuning(found), encoding="utf-8")
                write_store(staging / DATA, variables(found), run_attributes(found.study))
                _present(staging, found)
            for name in plots.NAMES:  # of an earlier fit
                if name not in drawn:
                    (out / f"{name}.png").unlink(missing_ok=True)
                if name not in drawn or not has_pdf:
                    (out / f"{name}.pdf").unlink(missing_ok=True)
            found = suggest(found, phases)
            _present(out, found)
        except OSError as error:
            raise StudyError(f"--out {out}: cannot write there ({error})") from error
    console.print(summary(found), soft_wrap=True)
    console.print(
        f"written: {out / 'report.html'}; {STUDY} is the fitted study, {TUNE} a tuning for "
        "machines like it",
        soft_wrap=True,
    )
    return found


def _present(folder: Path, found: Fitted) -> None:
    """Write the answer in words, beside its figures."""
    with replacing(folder / DOCUMENT) as file:
        file.write_text(document(found), encoding="utf-8")
    write_report(folder, report(found), found.study)


def _draw(folder: Path, found: Fitted, has_pdf: bool) -> list[str]:
    """Names of the figures that there are."""
    drawn = []
    with figures.styled():
        for name, figure in plots.all_figures(found):
            figures.save(figure, folder, name, has_pdf)
            drawn.append(name)
    return drawn


def machines(found: Fitted) -> dict[str, list[float]]:
    """Machines as the data leave them possible: by parameter, its value on each of them."""
    return {
        name: [float(f"{x:.9g}") for x in column]
        for name, column in zip(found.names, found.machines.T, strict=True)
        if not name.startswith("control.")  # which is free below
    }


def _tuning(found: Fitted) -> str:
    """The fitted study with machines like it, ready for `studies tune`."""
    gain = found.study.control.gain_factor or 1.0
    rows = "\n".join(f"{json.dumps(k)} = {v}" for k, v in machines(found).items())
    is_sampled = found.study.control.feedback == "sampled"
    limits = f"[tune.limits]\ngain_margin = {MARGIN}\n" if is_sampled else ""
    return (
        f"{study_template(found.study)}\n"
        "# What moves, and how far: change it to what you can decide.\n"
        "[tune]\n"
        "# objective = { residual_rms = 1.0 }   # metric = weight, relative to this study's\n"
        "# starts = 8                           # starting points\n"
        "# iterations = 60                      # evaluations from each\n"
        "[tune.free]\n"
        f'"control.gain_factor" = {{ from = {0.2 * gain:g}, to = {2 * gain:g} }}\n'
        f"{limits}\n"
        "# Machines that the data leave possible: chi square of each is within their region of\n"
        f"# {100 * REGION:g} %, about all equally good optima. The controller\n"
        "# knows link.youngs_modulus of each machine; fit link.stiffness_factor for what it does\n"
        "# not know.\n"
        f"{_warning(found)}"
        "[tune.scenarios]\ncount = 4   # of them to tune on, with the nominal one\n"
        "check = 16  # others to judge the result\n"
        f"[tune.scenarios.machines]\n{rows}\n"
    )


def _warning(found: Fitted) -> str:
    if found.answer.is_explained:
        return ""
    return (
        "# THE MODEL DOES NOT EXPLAIN THE DATA: these machines are too much alike (see report).\n"
    )


def document(found: Fitted) -> str:
    """JSON text of the answer."""
    answer, free = found.answer, found.spec.free
    numbers = [
        {
            "name": name,
            "value": float(answer.values[k]),
            "sigma": float(answer.sigma[k]),
            "interval_95": [float(x) for x in answer.interval[k]],
        }
        for k, name in enumerate(found.names)
    ]
    whole: dict[str, Any] = {
        "format": "flexlink-fit",
        "format_version": 1,
        "title": found.spec.study.title,
        "is_good": bool(is_good(found)),
        "is_explained": bool(answer.is_explained),
        "is_converged": bool(found.solution.best.is_converged),
        "messages": sentences(found),
        "chi_square": answer.chi_square,
        "freedom": int(answer.freedom),
        "numbers": numbers,
        "undetermined": [
            {found.names[k]: float(x.parts[k]) for k in x.named()} for x in answer.undetermined
        ],
        "equally_good": [
            {"rise": found.solution.rise(x), "values": _numbers(found.spec, free.values(x.u))}
            for x in found.rivals
        ],
        "correlation": answer.correlation.tolist(),
        "held_out": [
            {"name": x.name, "numbers": x.size, "chi_square": x.square, "is_noise": x.is_noise}
            for x in found.checks
        ],
    }
    return json.dumps(whole, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def variables(found: Fitted) -> dict[str, Variable]:
    """Labelled numbers of a fit."""
    answer, axis = found.answer, ("number",)
    part = {
        "number": Variable(np.array(found.names), axis, "1", "parameter"),
        "value": Variable(answer.values, axis, "1", "fitted, in the field's unit"),
        "sigma": Variable(answer.sigma, axis, "1", "standard deviation, in the field's unit"),
        "interval": Variable(answer.interval, (*axis, "end"), "1", "95 %, in the field's unit"),
        "correlation": Variable(answer.correlation, (*axis, "other"), "1", "of the numbers"),
    }
    if found.posterior is not None:
        part["sample"] = Variable(
            found.posterior.values, ("draw", *axis), "1", "posterior, in the field's unit"
        )
    for k, (name, _, one) in enumerate(found.comparisons):
        point = (f"point_{k}",)
        if isinstance(one, Line):
            x, unit = Variable(one.x, point, "1", one.abscissa), one.ordinate
        else:
            x, unit = Variable(np.array(one.labels), point, "1", "number"), "in its unit"
        part |= {
            f"x_{k}": x,
            f"measured_{k}": Variable(one.measured, point, "1", f"{name}: {unit}"),
            f"model_{k}": Variable(one.model, point, "1", f"{name}: {unit}"),
        }
    return part
