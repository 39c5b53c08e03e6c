"""Work in progress on a cluster: its outcome, and which workers hang."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import TYPE_CHECKING, Any

from studies.errors import StudyError

if TYPE_CHECKING:
    from distributed import Client, Future

#: Message when the scheduler no longer answers.
GONE = "the scheduler is gone; finished work is safe; continue with --resume"
#: How often workers are checked [s].
CHECK_INTERVAL = 1.0
#: Time allowed for stopping a worker that hangs [s].
KILL_TIME = 10


class Watch:
    """Waits for work, counts workers, restarts those that stay busy for too long."""

    def __init__(self, client: Client, timeout: float, on_progress: Callable[[str], None]) -> None:
        """
        Args:
            client: of the cluster.
            timeout: a worker that stays busy for longer without answering is restarted [s].
            on_progress: called with what users should know.
        """
        self._client, self._timeout, self._on_progress = client, timeout, on_progress
        self._idle: dict[str, float] = {}  # when a worker last had nothing to do, or answered
        self._last_check = 0.0
        self.n_workers = max(len(client.ncores()), 1)  # the first check says if there are none

    def finished(self, pending: Iterable[Future[Any]]) -> list[Future[Any]]:
        """Work that has finished; empty if none finishes for a while."""
        from distributed import CancelledError, wait

        futures = list(pending)
        try:
            with self._client.as_current():
                wait(futures, timeout=CHECK_INTERVAL, return_when="FIRST_COMPLETED")
        except (TimeoutError, CancelledError):
            pass
        self._check_workers({future.key for future in futures})
        return [future for future in futures if future.status != "pending"]

    def outcome(self, future: Future[Any]) -> Any:
        """A worker's value, or a text that says why there is none.

        Raises:
            StudyError: that of the work, the worker rejects it, or the scheduler is gone.
        """
        from distributed import KilledWorker

        try:
            value, address = future.result()
        except StudyError:
            raise
        except KilledWorker:
            return "the workers that ran it died"
        except Exception as error:
            if future.status != "error":  # no worker has raised it
                raise StudyError(GONE) from None
            # from JAX, LLVM, memory, disk: anything can go wrong there
            return f"{type(error).__name__}: {str(error).partition(chr(10))[0]}"
        self._idle[address] = time.monotonic()
        return value

    def _check_workers(self, keys: set[Any]) -> None:
        now = time.monotonic()
        if now - self._last_check < CHECK_INTERVAL:
            return
        self._last_check = now
        with suppress(OSError):  # the work itself will report a lost scheduler
            self._judge(self._client.processing(), keys, now)

    def _judge(self, busy: Mapping[str, Any], keys: set[Any], now: float) -> None:
        """Count workers; restart those that are overdue."""
        if len(busy) != self.n_workers:
            self.n_workers = len(busy)
            wait = "" if busy else "; waiting for one to join"
            self._on_progress(f"workers: {self.n_workers}{wait}")
        for address, processing in busy.items():
            if not keys.intersection(processing):
                self._idle[address] = now
            elif now - self._idle.setdefault(address, now) > self._timeout:
                self._on_progress(
                    f"worker {address} has not answered for {self._timeout:g} s; its work is done "
                    "elsewhere"
                )
                self._restart(address)
                self._idle[address] = now

    def _restart(self, address: str) -> None:
        """Stop a worker; its nanny, if any, starts another."""
        scheduler: Any = self._client.scheduler
        self._client.sync(
            scheduler.restart_workers,
            workers=[address],
            timeout=KILL_TIME,
            wait_for_workers=False,
            on_error="return",
            stimulus_id=f"studies-overdue-{time.monotonic()}",
        )
