"""Connect to workers: those of an existing scheduler, or new ones on this machine."""

from __future__ import annotations

import glob
import logging
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from ipaddress import ip_address
from multiprocessing import current_process, resource_tracker
from pathlib import Path
from typing import TYPE_CHECKING, Any

from studies.cluster.watch import GONE
from studies.config import processor, usable_cores
from studies.errors import StudyError, field_error
from studies.reading import read_json

if TYPE_CHECKING:
    from distributed import Client

    from studies.cluster.remote import Remote

#: Workers as users name them: a number of processes on this machine, a scheduler's address
#: (tcp://..., tls://...) or its file (JSON); None: all cores where that is worth their start,
#: otherwise this process.
Place = int | str | Path | None
#: Workers silent for so long are restarted by default [s].
TIMEOUT = 600.0
#: On so many cores, processes with two of them each are faster than one process: in that, threads
#: of XLA wait for each other (docs/performance.md).
MANY = 16
#: Time limit for the scheduler to answer [s].
PATIENCE = 15
#: That for the first worker to join [s].
WORKER_PATIENCE = 300
#: That for all workers to tell their versions, which computing does not delay [s].
ANSWER_TIME = 60


def parse_workers(workers: Place) -> int | str | None:
    """A number of processes, or a scheduler's address or file; None if none are named.

    Raises:
        StudyError: it is neither.
    """
    if workers is None:
        return None
    text = str(workers)
    return int(text) if re.fullmatch(r"[+-]?\d+", text) else text


def all_cores(say: Callable[[str], None]) -> int | None:
    """Processes that share many cores, where that can be done, otherwise None."""
    cores = usable_cores()
    if cores < MANY or processor() != "cpu":
        return None
    reason = "" if find_spec("distributed") else "flexlink-studies[cluster] uses all"
    if reason := reason or _unguarded():
        say(f"one process uses about four of {cores} cores; {reason}")
        return None
    say(f"{cores // 2} processes share {cores} cores; --workers 1: one uses about four")
    return cores // 2


@contextmanager
def on_workers(
    workers: Place,
    timeout: float,
    say: Callable[[str], None],
    *functions: Callable[..., Any],
    is_large: bool = False,
) -> Iterator[Remote | None]:
    """Workers, None for this process.

    Args:
        workers: which ones.
        timeout: one busy for longer without an answer is restarted [s].
        say: called with progress messages.
        functions: what they are to run, see `Remote.map`.
        is_large: the work is worth the 10 s that workers take to start, also if not asked for.

    Raises:
        StudyError: as `connected`.
    """
    named = parse_workers(workers)
    if named is None and is_large:
        named = all_cores(say)
    if named is None:
        yield None
        return
    with connected(named, timeout, say, *functions) as remote:
        yield remote


@contextmanager
def connected(
    workers: int | str,
    timeout: float,
    say: Callable[[str], None],
    *functions: Callable[..., Any],
) -> Iterator[Remote]:
    """Compatible workers.

    Args:
        workers: a number of processes, or a scheduler's address or file.
        timeout, say, functions: as in `on_workers`.

    Raises:
        StudyError: no extra `cluster`, no such scheduler, no worker, workers of other versions or
            without an answer, or the scheduler goes meanwhile.
    """
    try:
        import distributed  # noqa: F401
    except ImportError:
        raise StudyError(
            "--workers: Dask's distributed is missing: install flexlink-studies[cluster]"
        ) from None
    # this package itself reports what users should know
    for name in ("distributed", "distributed.client"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    cluster = _local_cluster(workers) if isinstance(workers, int) else _remote_cluster(workers, say)
    from distributed.comm.core import CommClosedError

    from studies.cluster.remote import Remote

    with cluster as client:
        try:
            if not client.ncores():
                say("waiting for a worker to join")
            wait_for_workers(client)
            refuse_other_versions(client, *functions)
            yield Remote(client, timeout, say)
        except CommClosedError:  # while workers were waited for, or asked for something
            raise StudyError(GONE) from None


def wait_for_workers(client: Client) -> None:
    """Raise StudyError if no worker joins in time."""
    try:
        client.wait_for_workers(1, timeout=WORKER_PATIENCE)
    except TimeoutError:
        raise StudyError(f"no worker has joined within {WORKER_PATIENCE} s") from None


@contextmanager
def _remote_cluster(scheduler: str, say: Callable[[str], None]) -> Iterator[Client]:
    from distributed import Client
    from distributed.security import Security

    address = scheduler if "://" in scheduler else written_address(scheduler)
    if not re.fullmatch(r"(tcp|tls)://[^/]+:\d+", address):
        raise field_error("--workers", address, "tcp://HOST:PORT or tls://HOST:PORT")
    if address.startswith("tcp://") and not _is_here(address):
        say(
            f"--workers {address}: not encrypted, and whoever reaches that port can run programs "
            "here and on the workers; use tls:// unless the network is private "
            "(docs/how-to/cluster.md)"
        )
    # Dask does not clean up after these errors
    context = Security().get_connection_args("client").get("ssl_context")
    if address.startswith("tls://") and context is None:
        raise StudyError(
            f"--workers {address}: no client certificates; set them for Dask "
            "(distributed.comm.tls, docs/how-to/cluster.md)"
        )
    try:
        client = Client(address, timeout=PATIENCE, set_as_default=False)
    except (OSError, ValueError, RuntimeError) as error:  # OSError covers timeouts
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise StudyError(f"--workers {scheduler}: no scheduler answers ({reason})") from None
    with client:
        yield client


def _is_here(address: str) -> bool:
    """Whether only this machine can be at an address."""
    host = address.split("://")[1].rpartition(":")[0].strip("[]")
    try:
        return ip_address(host).is_loopback
    except ValueError:  # a name
        return host == "localhost"


def written_address(file: str) -> str:
    """Address in a scheduler's file."""
    try:
        address = read_json(Path(file))["address"]
    except FileNotFoundError:
        raise StudyError(
            f"--workers {file}: no such file; allowed: a number of processes, tcp://HOST:PORT, "
            "tls://HOST:PORT, or a scheduler's JSON file"
        ) from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise StudyError(f"--workers {file}: not a scheduler's file ({error})") from None
    return str(address)


@contextmanager
def _local_cluster(count: int) -> Iterator[Client]:
    """Workers on this machine that share its cores, or have one GPU each."""
    from distributed import Client, Nanny, Scheduler, SpecCluster

    if getattr(current_process(), "_inheriting", False):  # a worker that imports the user's script
        sys.exit(1)  # the process that starts it says why
    cores = usable_cores()
    if not 1 <= count <= cores:
        raise field_error("--workers", count, f"1 to {cores}, the cores of this machine")
    options = {
        "nthreads": cores // count,
        "host": "127.0.0.1",
        "silence_logs": logging.CRITICAL,
    }
    workers = {k: {"cls": Nanny, "options": options | {"env": _graphics(k)}} for k in range(count)}
    ports = {"host": "127.0.0.1", "port": 0, "dashboard": False, "dashboard_address": "127.0.0.1:0"}
    heart = {"cls": Scheduler, "options": ports}
    with _ignore_interrupts():
        try:
            cluster = SpecCluster(workers, heart, silence_logs=logging.CRITICAL)
        except (OSError, RuntimeError) as error:  # OSError covers timeouts
            reason = _unguarded() or str(error).partition("\n")[0] or type(error).__name__
            raise StudyError(f"--workers: workers do not start ({reason})") from None
    with cluster, Client(cluster, timeout=PATIENCE, set_as_default=False) as client:
        yield client


def _unguarded() -> str:
    """What the user's script lacks if workers, which import it, would run it again; "" if not."""
    script = Path(getattr(sys.modules["__main__"], "__file__", None) or "")
    if not script.is_file() or "__main__" in script.read_text("utf-8", errors="replace"):
        return ""
    return f'workers import {script}: put what it does under if __name__ == "__main__":'


@contextmanager
def _ignore_interrupts() -> Iterator[None]:
    """Shield threads and processes started in this context, and their children, from Ctrl-C.

    In a terminal, Ctrl-C would reach the workers too, but only the client shuts down cleanly.
    """
    resource_tracker.ensure_running()  # started here, it would unblock the signal again
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _graphics(number: int) -> dict[str, str]:
    """Environment that shows a worker one of the GPUs; empty if there is none."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    numbers = [str(k) for k in range(len(glob.glob("/dev/nvidia[0-9]*")))]
    devices = named.split(",") if named else numbers
    return {"CUDA_VISIBLE_DEVICES": devices[number % len(devices)]} if devices else {}


def refuse_other_versions(client: Client, *functions: Callable[..., Any]) -> None:
    """Raise StudyError if a worker has other versions than this process, for these functions."""
    from distributed.comm.core import CommClosedError

    from studies.cluster.remote import difference, identity

    modules = [function.__module__ for function in functions]
    own, faults = identity(*modules), []
    try:
        answers = client.run(identity, *modules, on_error="return", callback_timeout=ANSWER_TIME)
    except TimeoutError:
        raise StudyError(
            f"a worker has not told its versions within {ANSWER_TIME} s: restart workers that "
            "hang, then repeat the command"
        ) from None
    except Exception as error:  # Dask cannot pass on every error of a worker
        raise StudyError(
            f"cannot ask workers for their versions ({error or type(error).__name__}); is "
            "flexlink-studies installed there?"
        ) from None
    for address, answer in answers.items():
        if isinstance(answer, CommClosedError):
            continue  # it died meanwhile; the next one tells its versions with each chunk
        if isinstance(answer, Exception):
            faults.append(f"{address}: {str(answer) or type(answer).__name__}")
        elif difference(answer, own):
            faults.append(f"{address}: {difference(answer, own)}")
    if faults:
        more = f" (and {len(faults) - 3} more)" if len(faults) > 3 else ""
        raise StudyError(
            f"workers do not match this client: {'; '.join(faults[:3])}{more}; install the same "
            "versions everywhere"
        )
