"""Many designs and many cases: memory and handles stay where they are, and the best are found."""

import os
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest

from studies.engine.folder import CHUNKS
from studies.engine.results import read_sweep
from studies.screen.local import LocalScreener
from studies.screen.run import run_screen
from studies.screen.shards import screen_of
from studies.space.spec import load_sweep
from studies.study.files import READY, read_toml
from studies.study.template import toml_text
from tests import TOP
from tests.sweeps import small, small_spec

pytestmark = pytest.mark.timeout(7200)  # the long ones, on a busy machine
MIB = 2**20


class Watched(LocalScreener):
    """Notes memory, handles and threads after each shard."""

    def __init__(self):
        self.notes = []

    def tallies(self, work):
        own = psutil.Process()
        for answer in super().tallies(work):
            note = own.memory_info().rss, own.num_fds(), own.num_threads()
            self.notes.append(note)
            yield answer


def test_shards_leave_nothing_behind(tmp_path):
    """In short what ten million designs show."""
    axes = {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 1.0}}
    spec = small_spec({"method": "random", "count": 24 * 256, "axes": axes})
    watched = Watched()
    run_screen(screen_of(spec, shard_size=256), tmp_path / "out", True, screener=watched)
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


def wide(folder, count, name="wide.toml"):
    """The ready-made wide search with this many designs."""
    data = read_toml(READY / "wide_search.toml")
    data["sweep"]["count"] = count
    path = folder / name
    path.write_text(toml_text(data))
    return path


#: Few designs to judge, as memory while designs run is looked at.
FEW = ("--keep", "10", "--margin", "0")


@pytest.mark.long
def test_ten_million_designs_take_no_more_memory_than_one(tmp_path):
    path = wide(tmp_path, 10_000_000)
    notes = watch(["screen", path, "--out", tmp_path / "out", "--quiet", *FEW], 3600.0)
    memory, handles = notes[:-4].T  # without the report
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
    notes = watch(["sweep", path, "--out", tmp_path / "out", "--quiet"], 3600.0)
    memory, handles = notes.T
    half = len(memory) // 2
    assert memory[half:].max() < memory[half // 2 : half].max() + 200_000 * 1000
    assert handles[half:].max() <= handles[half // 2 : half].max() + 2
    data = read_sweep(tmp_path / "out")
    assert data.n_cases == 200_000 and np.all(data["status"] >= 0)
    assert not (tmp_path / "out" / CHUNKS).exists()


@pytest.mark.long
def test_the_linear_model_finds_the_true_best(tmp_path):
    """Of a million designs, how many of the best 100 by the full model the linear one keeps."""
    spec = load_sweep(wide(tmp_path, 1_000_000))
    for margin in (0.0, 2.0):
        asked = {"margin": margin, "shard_size": 2**18}
        full = screen_of(spec, keep=100, fidelity="full", **asked)
        true = run_screen(full, tmp_path / "full", True).selection.kept
        linear = run_screen(screen_of(spec, keep=1000, **asked), tmp_path / "linear", True)
        found = np.isin(true.row, linear.selection.kept.row).sum()
        print(f"margins from {margin}: of the true best 100, {found} are among the 1000 kept")
        assert found >= 95
