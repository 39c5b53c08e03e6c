"""Counts of a sweep's cases while they run."""

from __future__ import annotations

import time
from collections import Counter

import numpy as np

from jaxmodel import status
from studies.engine.folder import ranges
from studies.phases import Phases


class Reporter:
    """Counts cases and failures, and reports them.

    phases: of the command, with "compile" and `name`; name: the phase that runs the cases; total
    and done: cases; programs: to compile.
    """

    def __init__(
        self, phases: Phases, name: str, total: int, done: int = 0, programs: int = 0
    ) -> None:
        self.phases, self.name, self.total, self.done = phases, name, total, done
        self.programs, self.n_compiled = programs, 0
        self.started, self.compile_time, self.n_run = time.perf_counter(), 0.0, 0
        self.failures: Counter[int] = Counter()
        self.executor = ""
        self.say = phases.say

    def compiling(self) -> None:
        """Report that a program is about to be compiled."""
        self.phases.begin("compile", f"program {self.n_compiled + 1} of {self.programs}")

    def compiled(self, executor: str, seconds: float) -> None:
        """Report that a program has compiled."""
        self.executor = executor
        self.n_compiled += 1
        self.compile_time += seconds
        waited = f", compiled in {seconds:.1f} s" if seconds >= 0.05 else ""
        self.say(f"executor: {executor}{waited}")
        self.phases.begin(self.name, done=self.done)

    def chunk(self, codes: np.ndarray) -> None:
        """Count a chunk that is safely on disk; codes are its statuses."""
        if self.phases.present != self.name:  # nothing had to be compiled
            self.phases.begin(self.name, done=self.done)
        self.done += len(codes)
        self.n_run += len(codes)
        self.failures.update(int(code) for code in codes if code != status.OK)
        text = f"{self.done}/{self.total} cases, {self.rate:.3g} cases/s, {self.failure_text()}"
        # programs left compile as long as those before
        programs = max(self.programs - self.n_compiled, 0)
        compiling = programs * self.compile_time / max(self.n_compiled, 1)
        self.phases.advance(self.done, self.total, text, compiling)

    def lost(self, rows: np.ndarray, reason: str) -> None:
        """Report a chunk that was given up; rows are the numbers of its cases."""
        text = f"cases {ranges(rows)} are left out: {reason}"
        self.phases.console.print(text, soft_wrap=True)

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
