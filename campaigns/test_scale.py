"""Many designs and many cases: memory and handles stay where they are, and the best are found."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest

import studies
from studies.engine.folder import CHUNKS
from studies.engine.results import read_sweep
from studies.job import working
from studies.screen.local import tallies_here
from studies.screen.run import PHASES, run_screen
from studies.screen.shards import screen_of
from studies.study.files import READY, read_toml
from studies.study.template import toml_text
from tests import TOP
from tests.sweeps import small, small_spec

pytestmark = pytest.mark.timeout(7200)  # the long ones, on a busy machine
MIB = 2**20


class Watched:
    """Notes memory, handles and threads after each shard."""

    def __init__(self):
        self.notes = []

    def tallies(self, work):
        own = psutil.Process()
        for answer in tallies_here(work):
            note = own.memory_info().rss, own.num_fds(), own.num_threads()
            self.notes.append(note)
            yield answer


def test_shards_leave_nothing_behind(tmp_path):
    """In short what ten million designs show."""
    axes = {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 1.0}}
    keep = {"keep": 10, "fidelity": "linear"}
    spec = small_spec({"method": "random", "count": 24 * 256, "axes": axes} | keep)
    watched = Watched()
    with working("sweep", tmp_path / "out", None, PHASES, progress=False) as job:
        run_screen(screen_of(spec, 256), job, watched.tallies)
    memory, handles, threads = (np.array(x) for x in zip(*watched.notes, strict=True))
    assert len(memory) == 24
    assert handles[12:].max() <= handles[6:12].max()
    # Pools that end take a moment, so counts vary upwards; what each shard keeps raises the lowest.
    assert threads[12:].min() <= threads[6:12].min()
    assert memory[-1] - memory[11] < 8 * MIB


def watch(arguments, limit):
    """Run a command; its memory [bytes] and number of handles, every half second."""
    environment = os.environ | {"PYTHONPATH": str(TOP)}
    command = [sys.executable, "-c", "from studies.cli import main; main()", *map(str, arguments)]
    process = subprocess.Popen(command, env=environment, stdout=subprocess.DEVNULL)
    own, notes = psutil.Process(process.pid), []
    timer = threading.Timer(limit, process.kill)
    timer.start()
    while process.poll() is None:
        try:
            notes.append((own.memory_info().rss, own.num_fds()))
        except psutil.Error:  # ended meanwhile
            break
        time.sleep(0.5)
    timer.cancel()
    assert process.wait() == 0
    return np.array(notes)


def wide(folder, **sweep):
    """The ready-made wide search with other fields of its sweep."""
    data = read_toml(READY / "wide_search.toml")
    path = folder / "wide.toml"
    path.write_text(toml_text(data | {"sweep": data["sweep"] | sweep}))
    return path


@pytest.mark.long
def test_ten_million_designs_take_no_more_memory_than_one(tmp_path):
    path = wide(tmp_path, count=10_000_000, keep=10, margin=0.0)  # few to judge and to run
    notes = watch(["sweep", path, "--out", tmp_path / "out", "--no-progress"], 7200.0)
    memory, handles = notes[: len(notes) * 9 // 10].T  # without the runs of the full model
    tenth = len(memory) // 10
    assert memory[-tenth:].max() < 1.02 * memory[tenth : 2 * tenth].max() + 8 * MIB
    assert handles[-tenth:].max() <= handles[tenth : 2 * tenth].max()


@pytest.mark.long
def test_two_hundred_thousand_short_cases(tmp_path):
    """A sweep holds its table, so memory may grow by what a case's numbers take, no more."""
    axes = {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 1.0}}
    sweep = {"method": "random", "count": 200_000, "axes": axes, "metrics": ["residual_rms"]}
    path = tmp_path / "sweep.toml"
    path.write_text(toml_text(small(sweep)))
    notes = watch(["sweep", path, "--out", tmp_path / "out", "--no-progress"], 3600.0)
    memory, handles = notes.T
    half = len(memory) // 2
    assert memory[half:].max() < memory[half // 2 : half].max() + 200_000 * 1000
    assert handles[half:].max() <= handles[half // 2 : half].max() + 2
    data = read_sweep(tmp_path / "out")
    assert data.n_cases == 200_000 and np.all(data["status"] >= 0)
    assert not (tmp_path / "out" / CHUNKS).exists()


def true_best_found(folder, count, margin):
    """Of the best 100 designs by the full model, how many a sweep by the linear one keeps."""
    ids = {}
    for fidelity, keep in (("full", 100), ("linear", 1000)):
        path = wide(folder, count=count, margin=margin, fidelity=fidelity, keep=keep)
        studies.sweep(path, folder / fidelity, progress=False)
        ids[fidelity] = read_sweep(folder / fidelity)["case_id"]
    return int(np.isin(ids["full"], ids["linear"]).sum())


@pytest.mark.long
@pytest.mark.parametrize("margin", [0.0, 2.0])
def test_the_linear_model_finds_the_true_best(tmp_path, margin):
    """Of a million designs, how many of the best 100 by the full model the linear one keeps."""
    found = true_best_found(tmp_path, 1_000_000, margin)
    print(f"margins from {margin}: of the true best 100, {found} are among the 1000 kept")
    assert found >= 95
