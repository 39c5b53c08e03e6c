"""Functions that run on workers: few calls in flight, none lost, none twice.

A function takes plain arguments and returns a plain value; `call` is what a worker runs. Dask
repeats a call elsewhere when its worker dies. A call whose workers keep dying, or that fails there,
is tried once more with nothing else in flight, since a bad one can take good ones down with it;
then it is given up.
"""

from __future__ import annotations

import platform
from collections import deque
from collections.abc import Callable, Generator, Iterable
from functools import cache
from importlib.metadata import version
from threading import Event, RLock
from typing import TYPE_CHECKING, Any, TypeVar

from studies import config, sources
from studies.cluster.watch import Watch
from studies.errors import StudyError
from studies.extensions import extend_from_environment

if TYPE_CHECKING:
    from distributed import Client, Future

K = TypeVar("K")

#: Calls in flight per worker: one running, one waiting.
AHEAD = 2
#: One call at a time: it uses the whole worker.
alone = RLock()


class Remote:
    """Calls functions on the workers of a cluster."""

    def __init__(self, client: Client, timeout: float, say: Callable[[str], None]) -> None:
        """
        Args:
            client: of the cluster.
            timeout: a worker that stays busy for longer without answering is restarted [s].
            say: called with what users should know.
        """
        self.client, self.timeout, self.say = client, timeout, say

    @property
    def n_workers(self) -> int:
        """How many workers there are now."""
        return len(self.client.ncores())

    def map(
        self,
        function: Callable[..., Any],
        jobs: Iterable[tuple[K, tuple[Any, ...]]],
        stop: Event | None = None,
    ) -> Generator[tuple[K, Any]]:
        """Values of a function, each as soon as it is there, or a text why it was given up.

        Args:
            function: of a module, whose values are no texts.
            jobs: what the caller knows a value by, and the arguments.
            stop: once set, no further jobs are sent.

        Raises:
            StudyError: that of a function; a worker has other versions; the scheduler is gone.
        """
        watch, is_stopped = Watch(self.client, self.timeout, self.say), (stop or Event()).is_set
        common = identity(function.__module__), config.origin()["precision"], function
        waiting, suspects = iter(jobs), deque[tuple[K, tuple[Any, ...]]]()
        in_flight: dict[Future[Any], tuple[tuple[K, tuple[Any, ...]], bool]] = {}

        def send(job: tuple[K, tuple[Any, ...]], is_alone: bool) -> None:
            in_flight[self.client.submit(call, *common, *job[1], pure=False)] = job, is_alone

        try:
            while True:
                while len(in_flight) < AHEAD * max(watch.n_workers, 1) and not is_stopped():
                    job = next(waiting, None)
                    if job is None:
                        break
                    send(job, is_alone=False)
                if not in_flight and suspects and not is_stopped():
                    send(suspects.popleft(), is_alone=True)
                if not in_flight or (is_stopped() and not watch.n_workers):
                    return
                for future in watch.finished(in_flight):
                    job, is_alone = in_flight.pop(future)
                    answer = watch.outcome(future)
                    if isinstance(answer, str) and not is_alone:
                        suspects.append(job)
                    else:
                        yield job[0], answer
        finally:
            if in_flight:
                self.client.cancel(list(in_flight))


def call(
    expected: dict[str, str], precision: str, function: Callable[..., Any], *arguments: Any
) -> tuple[Any, str]:
    """Call a function on a worker, which has all of it: JAX uses one core per thread.

    Args:
        expected: versions of the client, from `identity`.
        precision: of the client.
        function: what to call.
        arguments: its own.

    Returns:
        Its value; the worker's address.

    Raises:
        StudyError: the worker, which may have joined late, has other versions than the client.
    """
    from distributed import get_worker  # an extra

    with alone:
        worker = get_worker()
        if fault := difference(identity(function.__module__), expected):
            raise StudyError(f"worker {worker.address}: {fault}; install the same there")
        config.configure(precision, worker.state.nthreads)
        config.start(precision, gpu=True)  # those that it sees
        return function(*arguments), worker.address


@cache
def identity(*modules: str) -> dict[str, str]:
    """What must be the same on client and workers for functions of these modules."""
    extend_from_environment()
    return {
        "code": sources.digest(__name__, *modules),
        "python": ".".join(platform.python_version_tuple()[:2]),
        **{name: version(name) for name in ("jax", "jaxlib", "numpy")},
    }


def difference(versions: dict[str, str], expected: dict[str, str]) -> str:
    """How a worker differs from the client, "" if it does not."""
    parts = [
        f"{name} {versions.get(name)} (client: {value})"
        for name, value in expected.items()
        if versions.get(name) != value
    ]
    return ", ".join(parts)
