"""Output of a running sweep: a live bar on a terminal, plain lines elsewhere, nothing if quiet."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from jaxmodel import status
from studies.engine.folder import ranges


class Reporter:
    """Counts cases and failures, and reports them.

    console: where output goes; quiet: report only problems with the folder.
    """

    def __init__(self, console: Console, total: int, done: int, is_quiet: bool) -> None:
        self.console, self.total, self.done, self.is_quiet = console, total, done, is_quiet
        self.started, self.compile_time, self.n_run = time.perf_counter(), 0.0, 0
        self.failures: Counter[int] = Counter()
        self.executor = ""
        self._bar: Progress | None = None
        self._task: TaskID | None = None

    def __enter__(self) -> Reporter:
        if self.console.is_terminal and not self.is_quiet:
            columns = (
                TextColumn("cases"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
                TextColumn("{task.description}"),
            )
            self._bar = Progress(*columns, console=self.console)
            self._task = self._bar.add_task("", total=self.total, completed=self.done)
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def say(self, text: str) -> None:
        """Print a line, unless quiet."""
        if not self.is_quiet:
            self.console.print(text, soft_wrap=True)

    def compiled(self, executor: str, seconds: float) -> None:
        """Report that a program has compiled."""
        self.executor = executor
        self.compile_time += seconds
        self.say(f"executor: {executor}, compiled in {seconds:.1f} s")

    def chunk(self, codes: np.ndarray) -> None:
        """Count a chunk that is safely on disk; codes are its statuses."""
        self.done += len(codes)
        self.n_run += len(codes)
        self.failures.update(int(code) for code in codes if code != status.OK)
        text = f"{self.rate:.3g} cases/s, {self.failure_text()}"
        if self._bar is not None and self._task is not None:
            self._bar.update(self._task, completed=self.done, description=text)
        else:
            left = (self.total - self.done) / max(self.rate, 1e-9)
            self.say(f"{self.done}/{self.total} cases, {text}, {left:.0f} s left")

    def lost(self, rows: np.ndarray, reason: str) -> None:
        """Report a chunk that was given up; rows are the numbers of its cases."""
        self.console.print(f"cases {ranges(rows)} are left out: {reason}", soft_wrap=True)

    @property
    def run_time(self) -> float:
        """Time since the start, without compiling [s]."""
        return max(time.perf_counter() - self.started - self.compile_time, 1e-9)

    @property
    def rate(self) -> float:
        """Cases per second, without compiling."""
        return self.n_run / self.run_time

    def failure_text(self) -> str:
        """Failures so far by reason."""
        parts = [f"{n} {status.REASONS[code]}" for code, n in self.failures.most_common()]
        return "; ".join(parts) or "all ok"
