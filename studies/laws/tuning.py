"""Each candidate tuned to one budget: as little residual vibration as it can under equal limits.

The same largest voltage, the same disk margin, as many starting points and iterations. A tuning is
kept in its own file after every iteration, on workers once it has ended, so that an interrupted
comparison continues there.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from jaxmodel import status
from studies.engine.runs import run_study
from studies.errors import StudyError, field_error
from studies.laws.candidates import Contender
from studies.laws.machines import machines_of
from studies.results.labelled import Labelled, labelled, told
from studies.study.labels import describe
from studies.study.spec import Study
from studies.tuning.check import tuned_study
from studies.tuning.folder import load_progress, save_progress
from studies.tuning.optimise import Progress, has_ended, is_compatible, optimise
from studies.tuning.run import make_evaluator
from studies.tuning.spec import TuneSpec, parse_tuning

if TYPE_CHECKING:
    from studies.cluster.remote import Remote

#: The limit on the loop.
MARGIN = "disk_margin"
#: Share of the best objective within which starting points count as agreeing.
AGREE = 0.05
#: The last iterations, of which the gain says whether a tuning has ended.
LATE = 5


class Budget(Labelled):
    """What every candidate may spend."""

    voltage: float = labelled("V", "largest of an actuator")
    margin: float = labelled("1", "least disk margin")
    starts: int = told("starting points of a tuning", default=4)
    iterations: int = told("from each", default=20)
    machines: int = told("of a tuning, the design's own among them", default=2)
    seed: int = told("of machines and resamplings", default=0)


def make_budget(study: Study, voltage: float | None, margin: float) -> Budget:
    """A budget from the command line.

    Args:
        study: the design.
        voltage: largest of an actuator [V]; None: what the design itself needs in its motion.
        margin: least disk margin [1].

    Raises:
        StudyError: out of range; a design that does not finish its motion.
    """
    if not 0 < margin < 2:
        raise field_error("--margin", margin, "a disk margin > 0 and < 2", "1")
    limit = study.electronics.voltage_limit
    if voltage is not None and not 0 < voltage <= limit:
        raise field_error("--voltage", voltage, f"> 0 and <= {limit:g}, the actuators' limit", "V")
    if voltage is None:
        run = run_study(study)
        if run.status not in status.FINISHED:
            raise StudyError(f"--voltage: the design ends with {describe(run.status)}; name one")
        if run.loop is not None and run.loop.gain_margin < 1:
            raise StudyError("--voltage: the design's loop is unstable; name one")
        voltage = float(np.max(run.result.metrics.peak_voltage))
        if voltage == 0:
            raise StudyError("--voltage: the design uses none; name one")
    return Budget(float(voltage), margin)


class Quality(Labelled):
    """What says whether a tuning found the best numbers."""

    objective: float = labelled("1", "over that of the design as given, on the tuning's machines")
    n_alike: int = told("starting points that agree with the best one, itself included")
    late_gain: float = labelled("1", "share by which the last iterations improved the best one")
    at_bound: tuple[str, ...] = told("numbers that end at one of their bounds")


class Tuned(NamedTuple):
    """A candidate after its tuning."""

    candidate: Contender
    study: Study | None  # with its best numbers; None: no run of it finished
    reason: str  # why there is none, or which limit it does not keep; "" if all is well
    n_free: int  # numbers it was tuned by
    quality: Quality | None = None  # None: no run of it finished


def tuning_of(study: Study, candidate: Contender, budget: Budget) -> TuneSpec:
    """The tuning of a candidate.

    Raises:
        StudyError: the design with this candidate is not valid.
    """
    tune: dict[str, Any] = {
        "free": candidate.free,
        "objective": candidate.objective,
        "limits": {"peak_voltage": budget.voltage, MARGIN: budget.margin},
        "families": {"tuned": {"set": candidate.settings}},
        "starts": budget.starts,
        "iterations": budget.iterations,
        "seed": budget.seed,
        "scenarios": _scenarios(study, budget),
    }
    return parse_tuning(study.model_dump() | {"tune": tune})


def _scenarios(study: Study, budget: Budget) -> dict[str, Any]:
    """The machines of a tuning: the design's own and others like those to judge on."""
    others = machines_of(study, budget.machines, budget.seed)  # the last one, to check, is not run
    columns = {name: [machine[name] for machine in others] for name in others[0]}
    del columns["run.seed"]
    return {"count": budget.machines, "check": 1, "seed": budget.seed, "machines": columns}


def tune_candidate(
    study: Study,
    candidate: Contender,
    budget: Budget,
    file: Path,
    say: Callable[[str], None],
) -> Tuned:
    """Tune a candidate, or go on where its file ends.

    Args:
        study: the design.
        candidate: what is tuned.
        budget: what it may spend.
        file: of its progress.
        say: called with the progress of each iteration.

    Raises:
        StudyError: the file is damaged.
    """
    before = load_progress(file)
    try:
        spec = tuning_of(study, candidate, budget)
    except StudyError as error:
        return Tuned(candidate, None, str(error), len(candidate.free))
    if before is not None and not is_compatible(spec, before):
        raise StudyError(f"{file}: damaged; delete it")
    try:
        at = _optimised(spec, before, file, say)
    except StudyError as error:
        return Tuned(candidate, None, str(error), len(candidate.free))
    best, family = at.winner(0), spec.moving[0]
    count = int(family.is_free.sum())
    if not np.isfinite(at.best_objective[best]):
        return Tuned(candidate, None, "no start finished a run", count)
    tuned = tuned_study(spec, family, spec.free.values(at.best_place[best]))
    return Tuned(
        candidate=candidate,
        study=tuned,
        reason=_violated(spec, at, best),
        n_free=count,
        quality=_quality(spec, at),
    )


def _quality(spec: TuneSpec, at: Progress) -> Quality:
    best = at.winner(0)
    least = np.fmin.reduce(at.least_so_far(), axis=1)
    before = least[max(len(least) - 1 - LATE, 0)]
    ends = np.isin(at.best_place[best], (0.0, 1.0)) & spec.moving[0].is_free
    return Quality(
        objective=float(at.best_objective[best]),
        n_alike=len(at.alike(0, AGREE)),
        late_gain=float(1 - least[-1] / before),
        at_bound=tuple(
            free.name for free, is_end in zip(spec.free.numbers, ends, strict=True) if is_end
        ),
    )


def _optimised(
    spec: TuneSpec, before: Progress | None, file: Path, say: Callable[[str], None]
) -> Progress:
    """Progress at the end of a tuning, which its file keeps."""
    if before is not None and has_ended(spec, before):
        return before

    def keep(at: Progress) -> None:
        save_progress(file, at)
        best = at.best_objective[at.winner(0)]
        say(f"{int(at.iteration)}/{spec.tune.iterations}: {best:.3f} of the design's residual")

    say("compile")
    return optimise(spec, make_evaluator(spec), before, keep)


def tune_on_workers(
    study: Study, candidates: list[Contender], budget: Budget, files: list[Path], remote: Remote
) -> Iterator[int]:
    """Bring the files of candidates to their ends, each by one call, for `tune_candidate` to read.

    Args:
        study: the design.
        candidates: what is tuned.
        budget: what each may spend.
        files: of their progress.
        remote: the workers.

    Yields:
        The position of each candidate that has been tuned.

    Raises:
        StudyError: a file is damaged, a call is given up, or as `Remote.map`.
    """

    def jobs() -> Iterator[tuple[int, tuple[str, Progress | None]]]:
        for k, candidate in enumerate(candidates):
            at = load_progress(files[k])
            with suppress(StudyError):  # `tune_candidate` gives the reason
                spec = tuning_of(study, candidate, budget)
                if at is None or (is_compatible(spec, at) and not has_ended(spec, at)):
                    yield k, (json.dumps(spec.data), at)

    with closing(remote.map(descend, jobs())) as answered:
        for k, answer in answered:
            if isinstance(answer, str):
                raise StudyError(
                    f"{candidates[k].name} cannot be tuned: {answer}; finished tunings are safe; "
                    "continue with --resume"
                )
            if answer is not None:
                save_progress(files[k], answer)
            yield k


def descend(spec: str, before: Progress | None) -> Progress | None:
    """Tune a candidate to the end, on a worker.

    Args:
        spec: the tuning as JSON.
        before: where to go on; None: at the beginning.

    Returns:
        Its progress; None if it fails, for reasons that `tune_candidate` finds again.
    """
    tuning = parse_tuning(json.loads(spec))
    try:
        return optimise(tuning, make_evaluator(tuning), before, lambda _: None)
    except StudyError:
        return None


def _violated(spec: TuneSpec, at: Progress, best: int) -> str:
    """The limits that the best numbers do not keep, and by how much."""
    if at.beyond(best) == 0:
        return ""
    worst = int(np.argmax(at.best_limits[best]))
    share = 100 * at.best_limits[best][worst]
    return f"{spec.limit_names[worst]} violated by {share:.2g} %"
