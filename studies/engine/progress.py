"""Output of a long command: a live bar on a terminal, one line that changes in a notebook.

Elsewhere plain lines, and nothing if quiet.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from jaxmodel import status
from studies import config
from studies.engine.folder import ranges


def duration_text(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "2 h 10 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


class Phases:
    """The phases of a long command: the present one, the time since the start, and what is left.

    console: where output goes; names: of all phases, in order; is_quiet: nothing is shown.
    """

    def __init__(self, console: Console, names: Sequence[str], is_quiet: bool = False) -> None:
        self.console, self.names, self.is_quiet = console, tuple(names), is_quiet
        self.present = ""
        self._started = time.perf_counter()
        self._bar: Progress | None = None
        self._line: Any = None  # of a notebook
        self._title = ""

    def __enter__(self) -> Phases:
        self._outer, config.shows_phases = config.shows_phases, True
        if self.console.is_jupyter and not self.is_quiet:
            from IPython.display import display  # which is there in a notebook

            self._line = display(_plain(""), raw=True, display_id=True)
        elif self.console.is_terminal and not self.is_quiet:
            self._bar = Progress(
                TextColumn("{task.description}"),
                BarColumn(),
                TimeElapsedColumn(),
                TextColumn("{task.fields[text]}"),
                console=self.console,
            )
            self._bar.add_task("", total=None, text="")
            self._bar.start()
        return self

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self._started

    def __exit__(self, *_: object) -> None:
        config.shows_phases = self._outer  # of a command that this is a part of
        if self._bar is not None:
            self._bar.stop()

    def begin(self, name: str, note: str = "") -> None:
        """A phase begins, perhaps again.

        name: one of `names`. note: what is done in it.
        """
        self.present = name
        title = self._title = f"{name} ({self.names.index(name) + 1} of {len(self.names)})"
        if self._bar is not None:
            self._bar.tasks[0].total = None  # unknown, which `update` cannot set
            self._bar.update(self._bar.task_ids[0], description=title, completed=0, text=note)
        else:
            since = duration_text(self.elapsed)
            self._rewrite(f"{title}, {since} since the start{note and ': '}{note}")

    def advance(self, done: int, total: int, text: str, left: str = "") -> None:
        """Show how far the present phase is.

        done, total: steps. text: about them. left: the time that the rest of the phase takes, ""
            if it is unknown.
        """
        if left:
            later = ", ".join(self.names[self.names.index(self.present) + 1 :])
            text += f"; {left} left" + (f" in this phase, then {later}" if later else "")
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], total=total, completed=done, text=text)
        else:
            self._rewrite(text if self._line is None else f"{self._title}: {text}")

    def _rewrite(self, text: str) -> None:
        """Show where the command is: in place of what was shown, where that is possible."""
        if self._line is not None:
            self._line.update(_plain(text), raw=True)
        else:
            self.say(text)

    def say(self, text: str) -> None:
        """Print a line, unless quiet."""
        if not self.is_quiet:
            self.console.print(text, soft_wrap=True)


def _plain(text: str) -> dict[str, str]:
    """A text as notebooks take it."""
    return {"text/plain": text}


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
        self.phases.begin(self.name)

    def chunk(self, codes: np.ndarray) -> None:
        """Count a chunk that is safely on disk; codes are its statuses."""
        if self.phases.present != self.name:  # nothing had to be compiled
            self.phases.begin(self.name)
        self.done += len(codes)
        self.n_run += len(codes)
        self.failures.update(int(code) for code in codes if code != status.OK)
        text = f"{self.done}/{self.total} cases, {self.rate:.3g} cases/s, {self.failure_text()}"
        self.phases.advance(self.done, self.total, text, self._left())

    def lost(self, rows: np.ndarray, reason: str) -> None:
        """Report a chunk that was given up; rows are the numbers of its cases."""
        text = f"cases {ranges(rows)} are left out: {reason}"
        self.phases.console.print(text, soft_wrap=True)

    def _left(self) -> str:
        """Time for the cases left, and for compiling their programs as long as those before."""
        if self.done >= self.total:
            return ""
        programs = max(self.programs - self.n_compiled, 0)
        compiling = programs * self.compile_time / max(self.n_compiled, 1)
        return f"about {duration_text((self.total - self.done) / self.rate + compiling)}"

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


@contextmanager
def interrupts() -> Iterator[threading.Event]:
    """An event that Ctrl-C or SIGTERM sets; a second one ends the process at once.

    SIGTERM is what batch systems send some time before they end a job.
    """
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    before: dict[int, Any] = {}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)

    def ask(*_: object) -> None:
        stop.set()
        restore()
        print("studies: stopping after what is under way; Ctrl-C again: at once", file=sys.stderr)

    for number in (signal.SIGINT, signal.SIGTERM):
        before[number] = signal.signal(number, ask)
    try:
        yield stop
    finally:
        restore()
