"""A scheduler and workers on this machine, each a process of its own, with trouble on demand."""

import json
import os
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import psutil

import studies
from jaxmodel import status
from studies.cluster.connect import connected
from studies.screen.shards import axis_columns
from studies.screen.tally import tally_of

#: Chunks of 16 cases as in the other tests, and what the file `trouble` asks for. Programs are
#: kept, so that a worker that is started again has them.
PRELOAD = """
import json, os, time
from pathlib import Path
from studies import config
from studies.cluster import remote, runner
from studies.engine import plan
from studies.screen import workers
from tests.clusters import judged

plan.LANES, plan.LARGEST_CHUNK = 8, 16
config.keep_programs()
trouble = Path(os.environ["TROUBLE"])
# this file may be run twice
start, identity = runner.__dict__.setdefault("plain", (runner.start_chunk, remote.identity))
run = workers.__dict__.setdefault("plain", workers.shard_tally)

def started(executor, table, rows, *more):
    asked = json.loads(trouble.read_text())
    if asked.get("kill") in rows:
        os._exit(9)
    if asked.get("fail") in rows:
        raise OSError("no room")
    if asked.get("hang") in rows:
        trouble.write_text("{}")
        time.sleep(1000)
    return start(executor, table, rows, *more)

def tallied(*shard):
    return judged(*shard) if json.loads(trouble.read_text()).get("judged") else run(*shard)

runner.start_chunk = started
workers.shard_tally = tallied
remote.identity = lambda *modules: identity(*modules) | json.loads(trouble.read_text()).get(
    "identity", {}
)
"""


def judged(screen, shard, table, stop):
    """Tally of designs that are not run: each is as good as its gain, and the largest are lost."""
    gain = table.columns["control.gain_factor"]
    lost = np.where(gain > 0.9, status.UNSTABLE, status.OK)
    return tally_of(table.row, lost, gain, axis_columns(table), screen.axes, *screen.ranking)


class Machines:
    """Processes of a cluster."""

    def __init__(self, folder, threads=1, is_small=True):
        self._threads, self._is_small = threads, is_small
        self.scheduler, self._trouble = folder / "scheduler.json", folder / "trouble"
        self._preload = folder / "preload.py"
        self._preload.write_text(PRELOAD)
        root = str(Path(studies.__file__).parents[1])
        self._environment = os.environ | {
            "TROUBLE": str(self._trouble),
            "DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES": "1",
            "DASK_TEMPORARY_DIRECTORY": str(folder),
            "PYTHONPATH": root,
        }
        self.processes = []
        self.trouble()
        self._start("dask_scheduler", "--port", "0", "--no-dashboard", "--no-show")
        deadline = time.monotonic() + 60
        while not self._is_written() and time.monotonic() < deadline:
            time.sleep(0.05)

    def trouble(self, **asked):
        """What goes wrong from now on: `kill`, `fail` or `hang` with a case, other `identity`.

        With `judged`, shards of a screen are not run.
        """
        self._trouble.write_text(json.dumps(asked))

    def add_worker(self):
        """Start a worker with its nanny."""
        small = ["--preload", self._preload] if self._is_small else []
        self._start("dask_worker", "--nthreads", self._threads, "--no-dashboard", *small)

    def pids(self):
        """Of the workers, whose parents are their nannies."""
        found = []
        for nanny in self.processes[1:]:
            for child in psutil.Process(nanny.pid).children(recursive=True):
                with suppress(psutil.Error):
                    found += [child.pid] * ("spawn_main" in " ".join(child.cmdline()))
        return sorted(found)

    def _is_written(self):
        """Whether the scheduler has written its file: it exists before it has contents."""
        with suppress(OSError, ValueError):
            return bool(json.loads(self.scheduler.read_text()))
        return False

    def _start(self, program, *options):
        command = [sys.executable, "-m", f"distributed.cli.{program}", *map(str, options)]
        command += ["--scheduler-file", str(self.scheduler), "--host", "127.0.0.1"]
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        self.processes.append(subprocess.Popen(command, env=self._environment, **quiet))

    def stop(self):
        """End them all at once."""
        every = [psutil.Process(process.pid) for process in self.processes]
        for process in [*every, *(c for one in every for c in one.children(recursive=True))]:
            with suppress(psutil.Error):
                process.kill()
        for process in self.processes:
            process.wait(timeout=60)


@contextmanager
def machines(folder, workers=2, **options):
    """A scheduler with workers, and calls of them."""
    found = Machines(folder, **options)
    try:
        for _ in range(workers):
            found.add_worker()
        with connected(str(found.scheduler), 60.0, print) as remote:
            remote.client.wait_for_workers(workers, timeout=120)
            found.remote = remote
            yield found
    finally:
        found.stop()
