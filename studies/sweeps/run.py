"""`studies sweep`: runs the remaining cases, chunk by chunk, and joins the results."""

from __future__ import annotations

import threading
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from jaxmodel.case import Structure
from studies import config
from studies.cluster.connect import Place, on_workers
from studies.cluster.runner import ClusterRunner
from studies.engine.baseline import keep_baseline
from studies.engine.chunks import Done, LocalRunner, Lost, Runner
from studies.engine.folder import (
    CONTENT,
    SCREEN,
    Finished,
    SweepFolder,
    check_resumed,
    finished_cases,
    make_manifest,
    open_folder,
)
from studies.engine.plan import Group, Layout, local_layout, plan_groups
from studies.engine.progress import Phases, Reporter, interrupts
from studies.engine.results import links_of
from studies.engine.screen import (
    Round,
    check_names,
    first_round,
    full_runs,
    next_round,
    ranked,
    screen_arrays,
    screen_groups,
    screened_cases,
)
from studies.engine.stored import chunk_arrays, kept_metrics, manifest_attributes, merge
from studies.errors import StudyError
from studies.publish import shown
from studies.space.designs import design_of
from studies.space.spec import READING, SELECTING, SPREADING, SweepSpec, load_sweep
from studies.space.table import CaseTable, build_table
from studies.study.fields import idle_axes

#: From so many cases on, workers of this machine are worth their start.
LARGE = 50_000


def sweep_phases(spec: SweepSpec) -> tuple[str, ...]:
    """Names of the phases of `run_sweep`."""
    return ("compile", *(() if spec.screen is None else ("screen",)), "run", "join")


class Outcome(NamedTuple):
    """How a sweep ended."""

    out: Path  # its folder
    table: CaseTable
    n_done: int  # cases with results, those of earlier runs included
    n_run: int  # in this run
    compile_time: float  # [s]
    run_time: float  # [s]
    is_interrupted: bool  # by Ctrl-C
    executor: str  # that ran the last chunks; "" if there were none
    lost: np.ndarray  # numbers of cases that were given up, with the reason in the folder

    def _repr_html_(self) -> str:
        return shown(self)


class Plan(NamedTuple):
    """What a sweep would do."""

    table: CaseTable
    groups: list[Group]  # those of a screen first
    n_before: int  # cases already done


def make_plan(spec: SweepSpec, out: Path | None = None) -> Plan:
    """Remaining cases of a sweep, grouped by program.

    Args:
        spec: the sweep.
        out: folder with some of them done, if the sweep is to be resumed.

    Returns:
        Plan; of a screened sweep, as if the first cases passed the screen.

    Raises:
        StudyError: a fault of the sweep, or a folder with a different sweep.
    """
    config.require_configured()
    table, sweep = build_table(spec), spec.sweep
    check_names(spec, table)
    rows = np.arange(len(table))
    if out is not None:
        before, _ = _joined(out, spec, table, make_manifest(spec.data))
        rows = np.flatnonzero(~np.isin(table.case_id, before.case_id))
    n_before, groups = len(table) - len(rows), []
    if spec.screen is not None:
        groups = screen_groups(table, rows, local_layout, spec.screen)
        rows = rows[: full_runs(len(table), spec.screen)]
    is_linear = sweep.fidelity == "linear"
    groups += plan_groups(table, rows, local_layout, sweep.metrics, is_linear)
    return Plan(table, groups, n_before)


def run_sweep(
    spec: SweepSpec | str | Path,
    out: str | Path,
    is_resumed: bool = False,
    console: Console | None = None,
    is_quiet: bool = False,
    workers: Place = None,
    phases: Phases | None = None,
    runner: Runner | None = None,
) -> Outcome:
    """Run a sweep into a folder.

    Args:
        spec: the sweep, or its file.
        out: its folder.
        is_resumed: continue or extend the existing sweep.
        console: where progress goes; default: standard output.
        is_quiet: hide progress.
        workers: a number of processes on this machine, or a scheduler's address or file, as
            `--local-workers` and `--scheduler`; default: this process, for many cases all cores.
        phases: of a longer command, with those of `sweep_phases`, in place of console and is_quiet.
        runner: of the chunks, in place of workers.

    Returns:
        Outcome; `results.h5` exists unless the run was interrupted.

    Raises:
        StudyError: a fault of the sweep, the folder or the disk. Finished chunks stay.
    """
    config.require_configured()
    spec = spec if isinstance(spec, SweepSpec) else load_sweep(spec)
    if phases is None:
        console = console or Console(highlight=False, markup=False)
        with Phases(console, sweep_phases(spec), is_quiet) as phases:
            return run_sweep(spec, out, is_resumed, None, False, workers, phases, runner)
    n_cases = design_of(spec.root, spec.study, spec.sweep.seed).size * spec.sweep.repeats
    remote = partial(ClusterRunner, spec)
    with on_workers(workers, n_cases >= LARGE, phases.say, remote, runner) as found:
        return _run_rest(spec, Path(out), is_resumed, found or LocalRunner(), phases)


def _run_rest(
    spec: SweepSpec, out: Path, is_resumed: bool, runner: Runner, phases: Phases
) -> Outcome:
    say = partial(phases.console.print, soft_wrap=True)
    manifest = make_manifest(spec.data)
    with open_folder(out, manifest, is_resumed) as folder, interrupts() as stop:
        table = build_table(spec)
        check_names(spec, table)
        before, screened_before = _joined(out, spec, table, manifest)
        folder.begin(manifest, (*before.damaged, *screened_before.damaged), say)
        run = _Run(spec, table, folder, runner, phases, stop)
        if spec.screen is None:
            rows, screened = run.full(np.arange(len(table)), _headline), None
        else:
            rows, screened = run.screened(screened_before)
        if rows is not None:
            phases.begin("join")
            finished = finished_cases(out)
            keep_baseline(spec, table, out, phases.say)
            _check_whole(table, rows, np.union1d(finished.case_id, table.case_id[run.lost]), out)
            attributes = {"title": spec.study.title, **manifest_attributes(manifest)}
            timings = {"compile_time": run.compile_time, "run_time": run.run_time}
            merge(out, table, finished, attributes | timings, screened)
            folder.publish()
        return Outcome(
            out=out,
            table=table,
            n_done=len(before.case_id) + run.n_run,
            n_run=run.n_run,
            compile_time=run.compile_time,
            run_time=run.run_time,
            is_interrupted=rows is None,
            executor=run.executor,
            lost=run.lost,
        )


class _Run:
    """The chunks of one call, and what they took."""

    def __init__(
        self,
        spec: SweepSpec,
        table: CaseTable,
        folder: SweepFolder,
        runner: Runner,
        phases: Phases,
        stop: threading.Event,
    ) -> None:
        """
        Args:
            spec, phases, runner: as in `run_sweep`.
            table: all cases.
            folder: open.
            stop: set to end after the chunks under way.
        """
        self.spec, self.table, self.folder, self.runner = spec, table, folder, runner
        self.phases, self.stop = phases, stop
        self.lost = np.empty(0, int)  # rows that were given up
        self.n_run, self.compile_time, self.run_time, self.executor = 0, 0.0, 0.0, ""
        self._layouts: dict[Structure, Layout] = {}

    def full(self, rows: np.ndarray, headline: Headline) -> np.ndarray | None:
        """Run what is left of these rows; returns them, None if interrupted."""
        sweep, kept = self.spec.sweep, kept_metrics(self.spec)
        left = self._left(rows, finished_cases(self.folder.path))
        is_linear = sweep.fidelity == "linear"
        groups = plan_groups(
            self.table,
            left,
            self._layout,
            sweep.metrics,
            is_linear,
            robustness=sweep.robustness,
        )

        def save(done: Done) -> np.ndarray:
            arrays = chunk_arrays(self.table, done, kept)
            self.folder.write_chunk({"case_id": self.table.case_id[done.chunk.rows], **arrays})
            self.n_run += len(done.chunk.rows)
            return arrays["status"]

        n_before = len(rows) - len(left)
        text = headline(self.table, groups, n_before)
        return rows if self._chunks("run", groups, len(rows), n_before, text, save) else None

    def screened(self, before: Finished) -> tuple[np.ndarray | None, Finished]:
        """Screen all cases and run the best.

        Args:
            before: screened by earlier calls.

        Returns:
            (rows of the best, None if interrupted; where the screen's results are).
        """
        screen, table, path = self.spec.screen, self.table, self.folder.path
        assert screen is not None
        left = self._left(np.arange(len(table)), before)
        groups = screen_groups(table, left, self.runner.layout, screen)

        def save(done: Done) -> np.ndarray:
            arrays = screen_arrays(self.spec, table, done)
            self.folder.write_chunk(arrays, SCREEN)
            return arrays["screen_status"]

        n_before = len(table) - len(left)
        text = f"screen by the linear model: {_headline(table, groups, n_before)}"
        is_whole = self._chunks("screen", groups, len(table), n_before, text, save)
        stored = screened_cases(path)
        if not is_whole:
            return None, stored
        order = ranked(table, stored, screen)
        this: Round | None = first_round(table, order, self.spec)
        while this is not None:
            rows = self.full(this.rows, _kept_headline)
            if rows is None:
                return None, stored
            this = next_round(table, order, self.spec, this, path)
        return rows, stored

    def _left(self, rows: np.ndarray, finished: Finished) -> np.ndarray:
        """Those of some rows that are neither finished nor given up."""
        is_done = np.isin(self.table.case_id[rows], finished.case_id)
        return rows[~is_done & ~np.isin(rows, self.lost)]

    def _layout(self, n: int, structure: Structure) -> Layout:
        """One layout for all rounds of a screen, since each compiles its own program."""
        if structure not in self._layouts:
            self._layouts[structure] = self.runner.layout(n, structure)
        return self._layouts[structure]

    def _chunks(
        self,
        name: str,
        groups: list[Group],
        total: int,
        n_before: int,
        headline: str,
        save: Callable[[Done], np.ndarray],
    ) -> bool:
        """Run and save chunks in a phase; returns whether all of them were run."""
        reporter = Reporter(self.phases, name, total, n_before, len(groups))
        reporter.say(headline)
        n_lost = len(self.lost)
        with closing(self.runner.run(self.table, groups, reporter, self.stop)) as chunks:
            for one in chunks:
                if isinstance(one, Lost):
                    self.lost = np.concatenate([self.lost, one.chunk.rows])
                    self.folder.give_up(one.chunk.rows, one.reason)
                    reporter.lost(one.chunk.rows, one.reason)
                else:
                    reporter.chunk(save(one))
        n_lost = len(self.lost) - n_lost
        self.compile_time += reporter.compile_time
        self.run_time += reporter.run_time
        self.executor = reporter.executor or self.executor
        return not (self.stop.is_set() and reporter.done + n_lost < total)


#: First line of a run: of the table, the groups that are run, and how many cases were done before.
Headline = Callable[[CaseTable, list[Group], int], str]


def _headline(table: CaseTable, groups: list[Group], n_before: int) -> str:
    text = f"{len(table)} cases"
    if table.n_dropped:
        text += f" ({table.n_dropped} left out by where)"
    if table.n_double:
        reasons = idle_axes(table.study, table.columns)
        text += f" ({'; '.join([f'{table.n_double} duplicates left out', *reasons])})"
    if n_before:
        text += f", {n_before} of them already computed"
    chunks = sum(len(group.chunks()) for group in groups)
    return f"{text}; chunks: {chunks}, programs to compile: {len(groups)}"


def _kept_headline(table: CaseTable, groups: list[Group], n_before: int) -> str:
    count = sum(len(group.rows) for group in groups)
    text = f"{count} of {len(table)} cases pass the screen or check it"
    return f"{text}, {n_before} more already computed" if n_before else text


def case_content(spec: SweepSpec, table: CaseTable) -> dict[str, Any]:
    """What of a request, beside its cases' parameters, decides what is stored for a case.

    Parameters are in the ids of cases. Of `[sweep]` everything decides, except what says which
    cases there are and what is looked at once they are finished.
    """
    content = spec.sweep.model_dump(mode="json", exclude={*SPREADING, *READING, "screen"})
    content |= {"metrics": sorted(kept_metrics(spec)), "robustness": sorted(content["robustness"])}
    if spec.screen is None:
        return content
    of_screen = spec.screen.model_dump(mode="json", exclude=SELECTING)
    of_screen["links"] = links_of(spec, table).tolist()  # its values are taken over them
    return content | {f"screen.{name}": value for name, value in of_screen.items()}


def _joined(
    out: Path, spec: SweepSpec, table: CaseTable, manifest: dict[str, Any]
) -> tuple[Finished, Finished]:
    """What a folder has already, of the whole model and of the screen; completes the manifest.

    A resumed sweep can have more cases than the existing one, but not fewer.

    Raises:
        StudyError: what it has would not fit the other cases, or is not part of this sweep.
    """
    manifest[CONTENT] = case_content(spec, table)
    check_resumed(out, manifest)
    done = finished_cases(out)
    strange = int(np.sum(~np.isin(done.case_id, table.case_id)))
    if strange:
        raise StudyError(
            f"--resume: {strange} of {len(done.case_id)} finished cases in {out} are not part of "
            "this sweep; an extended sweep keeps all cases of the old one (same study, seed and "
            "axes; more values or points; for a Latin hypercube the same size). Name a new folder "
            "for another sweep"
        )
    return done, screened_cases(out)


def _check_whole(table: CaseTable, rows: np.ndarray, done: np.ndarray, out: Path) -> None:
    """Check that no chunks were removed while the sweep ran."""
    lost = int(np.sum(~np.isin(table.case_id[rows], done)))
    if lost:
        raise StudyError(
            f"{out}: chunks with {lost} of {len(rows)} cases disappeared while the sweep ran; "
            "run them again with --resume"
        )
