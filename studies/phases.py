"""Output of long work: a live bar on a terminal, one line that changes in a notebook.

Elsewhere plain lines, and nothing if quiet.
"""

from __future__ import annotations

import signal
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from studies import config


def duration_text(seconds: float) -> str:
    """A duration in words: "40 s", "3 min", "2 h 10 min"."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"


#: Share of its typical time from which on a phase was not kept from an earlier call.
KEPT = 0.1


class Phases:
    """The phases of a long command: the present one, the time since the start, and what is left.

    console: where output goes; names: of all phases, in order, with what each takes on two cores if
    that is known [s]; is_quiet: nothing is shown.
    """

    def __init__(
        self, console: Console, names: Sequence[str] | Mapping[str, float], is_quiet: bool = False
    ) -> None:
        self.console, self.names, self.is_quiet = console, tuple(names), is_quiet
        self.present = ""
        self._typical = dict(names) if isinstance(names, Mapping) else {}
        self._started = self._since = time.perf_counter()
        self._took = self._planned = 0.0  # by finished phases, and typically [s]
        self._first = 0  # steps that were done when the present phase began
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

    def begin(self, name: str, note: str = "", done: int = 0) -> None:
        """A phase begins, perhaps again.

        name: one of `names`. note: what is done in it. done: its steps that an earlier call or
            phase has done.
        """
        now, typical = time.perf_counter(), self._typical.get(self.present, 0.0)
        if now - self._since > KEPT * typical:  # what was found before says nothing of this machine
            self._took, self._planned = self._took + now - self._since, self._planned + typical
        self.present, self._since, self._first = name, now, done
        note = "; ".join(filter(None, (note, self._left())))
        title = self._title = f"{name} ({self.names.index(name) + 1} of {len(self.names)})"
        if self._bar is not None:
            self._bar.tasks[0].total = None  # unknown, which `update` cannot set
            self._bar.update(self._bar.task_ids[0], description=title, completed=0, text=note)
        else:
            since = duration_text(self.elapsed)
            self._rewrite(f"{title}, {since} since the start{note and ': '}{note}")

    def _left(self) -> str:
        """Time left: what is typical, times what this machine needed so far; "" if unknown."""
        if not self._typical:
            return ""
        factor = self._took / self._planned if self._planned else 1.0
        rest = self.names[self.names.index(self.present) :]
        return f"about {duration_text(factor * sum(self._typical[x] for x in rest))} left"

    def rate(self, done: int) -> float:
        """Steps of the present phase per second."""
        return (done - self._first) / max(time.perf_counter() - self._since, 1e-9)

    def advance(self, done: int, total: int, text: str, more: float = 0.0) -> None:
        """Show how far the present phase is, and how long its other steps take at its rate so far.

        done, total: steps. text: about them. more: what it takes beside them [s].
        """
        if self._first < done < total:
            later = ", ".join(self.names[self.names.index(self.present) + 1 :])
            left = duration_text((total - done) / self.rate(done) + more)
            text += f"; about {left} left" + (f" in this phase, then {later}" if later else "")
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
