"""Ours against theirs: the study's run beside the twin's, and what their difference is made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.beam import BASES
from studies.engine.controller import check_codable
from studies.engine.preflight import check_run
from studies.engine.runs import Run, run_study, uncontrolled_twin
from studies.errors import StudyError, field_error
from studies.results.labelled import Labelled, derived, labelled, told
from studies.study.cases import build_structure
from studies.study.labels import describe
from studies.study.spec import Study
from studies.twin.law import exported_law
from studies.twin.loop import TwinRun, run_twin
from studies.twin.machine import describe_machine
from studies.twin.mesh import MID_SPAN
from studies.twin.multibody import DEFAULT, Settings
from studies.twin.plan import TwinPlan, plan_run

#: How long after the reference trajectory runs are compared [s], and how little is too little.
WINDOW, LEAST = 0.05, 0.005
#: Plant modes per link of our model where its truncation is looked at; the most there are [1].
MOST_MODES = 16
#: Of an ADC that hardly rounds [bit].
FINE_ADC = 28


class RunSignals(NamedTuple):
    """One run at its sampling instants."""

    deflection: np.ndarray  # of mid-span from the chord [m], (N, n)
    pose_error: np.ndarray  # against the shaped reference trajectory [m, m, rad], (N, 3) or (N, 2)
    voltage: np.ndarray  # of the actuators [V], (N, n, K)


class BothModels(NamedTuple):
    """The same run by both models."""

    ours: RunSignals
    theirs: RunSignals


class BothRuns(NamedTuple):
    """The motion without and with control."""

    free: BothModels
    controlled: BothModels


class Gap(Labelled):
    """A quantity in the window after the reference trajectory, rms in its unit, entry by entry."""

    ours: np.ndarray = labelled("SI", "by this model", "entry")
    theirs: np.ndarray = labelled("SI", "by the twin", "entry")
    difference: np.ndarray = labelled("SI", "of both", "entry")

    @derived("1", "difference over theirs", "entry")
    def share(self) -> np.ndarray:
        return np.divide(
            self.difference,
            self.theirs,
            out=np.full_like(self.theirs, np.nan),
            where=self.theirs > 0,
        )

    @derived("1", "difference over theirs, all entries together")
    def whole(self) -> float:
        size = float(np.linalg.norm(self.theirs))
        return float(np.linalg.norm(self.difference)) / size if size > 0 else float("nan")


class ChangedRun(Labelled):
    """One thing changed: the relative differences that are then left, null where it changes
    nothing.
    """

    text: str = told("what is changed")
    free: float = labelled("1", "of mid-span deflections without control, all links")
    controlled: float = labelled("1", "with control")
    voltage: float = labelled("1", "of voltages")


def check_supported(study: Study) -> None:
    """Raise StudyError for a study that the twin cannot repeat."""
    run, link, initial = study.run, study.link, study.initial
    if run.model != "coupled":
        raise field_error("run.model", run.model, "'coupled' for studies twin", "-")
    if run.smooth:
        raise field_error("run.smooth", run.smooth, "false for studies twin", "-")
    check_codable(study)
    if build_structure(study).has_delay:
        delay = study.electronics.delay + study.electronics.unmodelled_delay
        raise field_error("electronics.delay", delay, "1 for studies twin", "samples")
    if not BASES[link.basis].is_on_chord:
        names = ", ".join(name for name, one in BASES.items() if one.is_on_chord)
        raise field_error("link.basis", link.basis, f"{names} for studies twin")
    for name, value, unit in (
        ("patches.hysteresis", study.patches.hysteresis, "1"),
        ("machine.joint_friction", study.machine.joint_friction, "N m"),
        ("drive.lag", study.drive.lag, "s"),
        ("initial.modal", initial.modal, "m"),
        ("initial.load_deflection", initial.load_deflection, "m"),
    ):
        if any(np.any(x) for x in np.atleast_1d(np.asarray(value, object))):
            raise field_error(name, value, "0 for studies twin", unit)


def our_runs(study: Study, has_loop: bool = False) -> tuple[Run, Run]:
    """Runs of the study with and without control, with trajectories.

    Args:
        study: what to run.
        has_loop: also judge the linearised loop.

    Raises:
        StudyError: a fault of the study, or a run that stops early.
    """
    run = run_study(study.change(metrics__stations=(MID_SPAN,)), True, has_loop)
    free = uncontrolled_twin(run)
    assert free is not None
    for one in (run, free):
        if one.status not in status.FINISHED:
            raise StudyError(
                f"{study.title}: {describe(one.status)} at {one.result.bad_time:.4g} s; allowed: a "
                "study that runs to its end"
            )
    if run.status == status.UNSTABLE:
        raise StudyError(
            f"{study.title}: {describe(run.status)}; allowed: a stable loop, see studies simulate"
        )
    return run, free


class TwinBench:
    """A study's motion, ready for the twin."""

    def __init__(self, study: Study, settings: Settings = DEFAULT) -> None:
        self.study, self.settings = study, settings
        self.structure, self.case = check_run(study)
        self.machine = describe_machine(self.structure, self.case)
        self.plan = plan_run(self.structure, self.case, settings, WINDOW)
        left = self.plan.n_samples * self.plan.electronics.period - self.plan.command_end
        if left < LEAST:
            raise field_error(
                "run.duration",
                study.run.duration,
                f"at least {self.plan.command_end + LEAST:.4g}, for runs to compare after the "
                "reference trajectory",
                "s",
            )

    def run(self, is_controlled: bool) -> TwinRun:
        """The twin's run."""
        if not is_controlled:
            return run_twin(self.machine, self.plan, None, self.settings)
        with exported_law(self.study) as law:
            return run_twin(self.machine, self.plan, law, self.settings)


def in_window(plan: TwinPlan) -> slice:
    """The samples that are compared."""
    return slice(round(plan.command_end / plan.electronics.period), plan.n_samples)


def our_signals(run: Run, count: int) -> RunSignals:
    """The first samples of one of `our_runs`."""
    record = run.result.record
    assert record is not None
    return RunSignals(
        deflection=record.chord_deflection_stations[:count, :, 0],
        pose_error=record.pose_error[:count],
        voltage=record.actuator_voltage[:count],
    )


def pair(ours: Run, theirs: TwinRun) -> BothModels:
    """Both models' signals of one run.

    Args:
        ours: one of `our_runs`.
        theirs: the twin's.
    """
    record, own = ours.result.record, our_signals(ours, len(theirs.time))
    assert record is not None
    reference = record.pose[: len(theirs.time)] - own.pose_error
    return BothModels(own, RunSignals(theirs.deflection, theirs.pose - reference, theirs.voltage))


def gap(both: BothModels, quantity: Callable[[RunSignals], np.ndarray], window: slice) -> Gap:
    """A quantity of a pair.

    Args:
        both: the runs.
        quantity: from signals to (N, n) or (N, n, K).
        window: samples.
    """

    def rms(x: np.ndarray) -> np.ndarray:
        square = x[window].reshape(len(x[window]), x.shape[1], -1) ** 2
        return np.asarray(np.sqrt(square.mean(axis=(0, 2))))

    ours, theirs = quantity(both.ours), quantity(both.theirs)
    return Gap(rms(ours), rms(theirs), rms(theirs - ours))


def deflection(signals: RunSignals) -> np.ndarray:
    """Of mid-span [m], (N, n)."""
    return signals.deflection


def voltage(signals: RunSignals) -> np.ndarray:
    """Of the actuators [V], (N, n, K)."""
    return signals.voltage


def place(signals: RunSignals) -> np.ndarray:
    """Error of the platform's place [m], (N, 2)."""
    return signals.pose_error[:, :2]


def turn(signals: RunSignals) -> np.ndarray:
    """Error of its angle [rad], (N, 1), of a body."""
    return signals.pose_error[:, 2:]


def cause(text: str, free: BothModels | None, controlled: BothModels, window: slice) -> ChangedRun:
    """The differences of two pairs; free: None where nothing changes without control."""
    return ChangedRun(
        text=text,
        free=float("nan") if free is None else gap(free, deflection, window).whole,
        controlled=gap(controlled, deflection, window).whole,
        voltage=gap(controlled, voltage, window).whole,
    )


def causes(bench: TwinBench, ours: tuple[Run, Run], base: BothRuns) -> list[ChangedRun]:
    """What the difference is made of, one thing changed at a time.

    Args:
        bench: the study.
        ours: its runs with and without control.
        base: the pairs as they are.
    """
    window, settings, study = in_window(bench.plan), bench.settings, bench.study
    found = [cause("as they are", base.free, base.controlled, window)]
    changes: dict[str, dict[str, Any]] = {
        "twin: links 1000 times stiffer in tension": {"axial_factor": 1000.0},
        "twin: twice the elements": {"n_elements": 2 * settings.n_elements},
        "twin: half the step": {"n_steps": 2 * bench.plan.n_steps},
    }
    both_lengthen = build_structure(study).has_stretch
    for text, changed in list(changes.items())[both_lengthen:]:
        other = TwinBench(study, settings._replace(**changed))
        pairs = [pair(one, other.run(k == 0)) for k, one in enumerate(ours)]
        found.append(cause(text, pairs[1], pairs[0], window))
    if study.link.modes < MOST_MODES:
        runs = our_runs(study.change(link__modes=MOST_MODES))
        controlled, free = (
            both._replace(ours=our_signals(run, len(both.theirs.deflection)))
            for run, both in zip(runs, (base.controlled, base.free), strict=True)
        )
        found.append(cause(f"this model: {MOST_MODES} modes a link", free, controlled, window))
    fine = study.change(electronics__adc_bits=FINE_ADC)
    if not study.electronics.adc_noise:
        theirs = TwinBench(fine, settings).run(is_controlled=True)
        found.append(
            cause("both: an ADC that hardly rounds", None, pair(our_runs(fine)[0], theirs), window)
        )
    return found
