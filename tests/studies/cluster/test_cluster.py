"""Sweeps and tunings on a real scheduler and two real workers: the same numbers, whatever dies."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import dask
import jax
import numpy as np
import pytest
from distributed.comm.core import CommClosedError
from rich.console import Console

import studies
from jaxmodel.laws import LAWS
from studies import sources
from studies.cluster import connect, remote
from studies.cluster.connect import connected, on_workers, parse_workers
from studies.cluster.remote import difference, identity
from studies.cluster.runner import ClusterRunner, run_chunk
from studies.engine import plan
from studies.engine.chunks import LocalRunner
from studies.engine.columns import NOT_RUN
from studies.engine.folder import CHUNKS, SweepFolder, finished_cases, read_manifest
from studies.engine.results import read_sweep
from studies.errors import StudyError
from studies.job import Job, locked_folder
from studies.laws import run as laws
from studies.laws import tuning as laws_tuning
from studies.laws.candidates import drive_candidates, law_candidate
from studies.laws.tuning import Budget
from studies.phases import Phases
from studies.screen.local import ScreenProgress, ShardWork, tallies_here
from studies.screen.run import PHASES, run_screen
from studies.screen.shards import screen_of, table_of
from studies.screen.workers import tallies_on
from studies.sweeps.run import sweep_phases, swept_into
from studies.sweeps.verb import sweep
from studies.tuning.run import make_evaluator
from studies.tuning.workers import ClusterEvaluator
from tests.clusters import judged, machines
from tests.studies.engine.test_sweeps import arrays, assert_same
from tests.studies.laws.test_laws import STUDY
from tests.studies.test_cli import refused
from tests.sweeps import MIXED, narrow_blocks, run_sweep, small_spec
from tests.tunings import GAIN, tuning

#: With noise as in the tests of the batch engine, whose programs these are.
NOISE = {"electronics": {"adc_noise": 0.002}}
SPEC = small_spec(**NOISE)
HALF = small_spec(MIXED | {"blocks": [MIXED["blocks"][0] | {"count": 2}]}, **NOISE)
#: And of each chunk, few enough for four chunks a worker.
CASES, CHUNK = 72, 8


@pytest.fixture(autouse=True, scope="module")
def small_chunks():
    with narrow_blocks(16):
        yield


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """A scheduler and two workers, and calls of them."""
    with machines(tmp_path_factory.mktemp("cluster")) as found:
        yield found


@pytest.fixture(autouse=True)
def two_workers_without_trouble(cluster):
    cluster.trouble()
    cluster.remote.client.wait_for_workers(2, timeout=120)


@pytest.fixture(scope="module")
def local(tmp_path_factory):
    """Folder of the same sweep run here."""
    out = tmp_path_factory.mktemp("local") / "sweep"
    run_sweep(SPEC, out)
    return out


def told(cluster, out, timeout=60.0):
    """Run the sweep on the cluster; the outcome and what was said."""
    console = Console(record=True, width=200, file=open(os.devnull, "w"))  # noqa: SIM115
    with locked_folder(out, "sweep"), Phases(console, sweep_phases(SPEC)) as phases:
        outcome = swept_into(SPEC, Job(out, phases), cluster.scheduler, timeout)
    return outcome, console.export_text()


def test_numbers_are_those_of_the_local_run(cluster, local, tmp_path):
    outcome, text = told(cluster, tmp_path / "out")
    assert outcome.n_run == CASES and len(outcome.lost) == 0
    assert_same(arrays(local), arrays(tmp_path / "out"), 1e-12)
    assert "workers: 2" in text and "72/72 cases" in text


def small_screen():
    sweep = {"method": "random", "count": 200, "axes": {"gain": {"from": 0.1, "to": 1.0}}}
    keep = {"keep": 9, "margin": 0.0, "fidelity": "linear"}
    return screen_of(small_spec(sweep | keep), 64)


def test_shards_of_a_screen_come_back_with_their_own_tallies(cluster):
    """Of all designs, which are not run: what runs them is that of sweeps."""
    cluster.trouble(judged=True)
    screen, stop = small_screen(), threading.Event()
    with Phases(Console(quiet=True), PHASES, is_quiet=True) as phases:
        phases.begin("screen")
        work = ShardWork(screen, range(4), ScreenProgress(phases, 200, 0), stop)
        there = dict(tallies_on(cluster.remote, work))
    assert sorted(there) == [0, 1, 2, 3] and sum(x.n_designs for x in there.values()) == 200
    for shard, found in there.items():
        wanted = judged(screen, shard, table_of(screen, shard), stop)
        jax.tree.map(np.testing.assert_array_equal, found, wanted)


@pytest.mark.long  # in short: their tallies come back, and sweeps on workers have the same numbers
def test_a_screen_has_the_same_tally(cluster, tmp_path):
    screen = small_screen()
    tallies = []
    there = partial(tallies_on, cluster.remote)
    for name, screener in (("here", tallies_here), ("there", there)):
        (tmp_path / name).mkdir()
        job = Job(tmp_path / name, Phases(Console(quiet=True), PHASES, is_quiet=True))
        done = run_screen(screen, job, screener)
        assert not done.lost and done.is_done.all()
        tallies.append(done.tally)
    here, there = tallies
    np.testing.assert_array_equal(here.row, there.row)
    np.testing.assert_array_equal(here.endings, there.endings)
    np.testing.assert_allclose(here.value, there.value, rtol=1e-12)
    assert here.n_designs == 200 and here.sketch[0].sum() == here.endings[0]


@pytest.mark.long  # in short: numbers on workers are those of the local run, sweep after sweep
def test_workers_do_not_mix_up_sweeps(cluster, tmp_path):
    """Same shapes, another number that all cases share: it is written into the program."""
    for kp in (2e4, 4e4):  # the first is that of the other tests: compiled already
        spec = small_spec(drive={"kp": kp})
        here, there = tmp_path / f"here{kp:g}", tmp_path / f"there{kp:g}"
        run_sweep(spec, here)
        runner = ClusterRunner(spec, cluster.remote)
        run_sweep(spec, there, runner=runner)
        assert_same(arrays(here), arrays(there), 1e-12)


def test_from_here_to_the_cluster_and_back(cluster, local, tmp_path):
    class Stopped(ClusterRunner):
        def run(self, *arguments):
            yield from islice(super().run(*arguments), 2)

    out = tmp_path / "out"
    run_sweep(HALF, out)
    with pytest.raises(StudyError, match="disappeared"):
        run_sweep(SPEC, out, True, runner=Stopped(SPEC, cluster.remote))
    assert len(list((out / CHUNKS).glob("*.h5"))) == 2
    done = len(finished_cases(out).case_id)
    assert CASES / 2 < done < CASES
    again = run_sweep(SPEC, out, True)
    assert again.n_run == CASES - done
    assert_same(arrays(local), arrays(out), 1e-12)


def test_a_full_disk_leaves_nothing_under_way(cluster, tmp_path, monkeypatch):
    def write(*_):
        raise StudyError("no space")

    class Closed(ClusterRunner):
        def run(self, *arguments):
            try:
                yield from super().run(*arguments)
            finally:
                closed.append(True)

    closed = []
    monkeypatch.setattr(SweepFolder, "write_chunk", write)
    runner = Closed(SPEC, cluster.remote)
    with pytest.raises(StudyError, match="no space") as raised:
        run_sweep(SPEC, tmp_path / "out", runner=runner)
    assert closed and raised.tb  # which keeps the frames: it is no matter of collecting garbage


def test_a_chunk_that_fails_costs_no_worker(cluster, tmp_path):
    cluster.trouble(fail=3)
    before = cluster.pids()
    outcome, text = told(cluster, tmp_path / "out")
    assert outcome.n_run == CASES - CHUNK and "OSError: no room" in text
    assert cluster.pids() == before


def test_other_versions_are_refused(cluster, tmp_path):
    cluster.trouble(identity={"jaxlib": "0.1", "code": "f00"})
    with (
        pytest.raises(StudyError, match="do not match this client: tcp://.*: code f00 .client: "),
        connected(str(cluster.scheduler), 60.0, print),
    ):
        pass
    with pytest.raises(StudyError, match=f"jaxlib 0.1 .client: {identity()['jaxlib']}"):
        told(cluster, tmp_path / "late")  # a worker that came after the others were compared


def test_the_code_that_counts_is_that_of_what_is_called(cluster, monkeypatch):
    """At once where it is known, and with each call; other functions can be called."""
    digest = sources.digest

    def changed(*modules):
        return "f00" if run_chunk.__module__ in modules else digest(*modules)

    monkeypatch.setattr(sources, "digest", changed)
    monkeypatch.setattr(remote, "identity", identity.__wrapped__)
    where = str(cluster.scheduler), 60.0, print
    with connected(*where, parse_workers) as calls:
        assert list(calls.map(parse_workers, [("key", ("3",))])) == [("key", 3)]
        with pytest.raises(StudyError, match=r"worker tcp://.*: code \w+ .client: f00.; install"):
            list(calls.map(run_chunk, [(0, ())]))
    refused = pytest.raises(StudyError, match="do not match this client: tcp://.*: code ")
    with refused, connected(*where, parse_workers, run_chunk):
        pass


def test_a_worker_that_dies_when_asked_is_no_other_version():
    answers = {"tcp://a": CommClosedError("in <TCP>: Stream is closed"), "tcp://b": identity()}
    connect.refuse_other_versions(SimpleNamespace(run=lambda *_, **__: answers))
    answers["tcp://c"] = OSError("no such file")
    with pytest.raises(StudyError, match="do not match this client: tcp://c: no such file;"):
        connect.refuse_other_versions(SimpleNamespace(run=lambda *_, **__: answers))


def test_a_version_that_a_worker_does_not_tell_is_another_one():
    own = identity()
    assert difference(own, own) == ""
    told = {name: x for name, x in own.items() if name != "numpy"}
    assert difference(told, own) == f"numpy None (client: {own['numpy']})"


def test_a_frozen_worker_does_not_hold_up_what_connects(cluster, monkeypatch):
    monkeypatch.setattr(connect, "ANSWER_TIME", 2)
    frozen = cluster.pids()[0]
    os.kill(frozen, signal.SIGSTOP)
    try:
        with (
            pytest.raises(StudyError, match="not told its versions within 2 s: restart workers"),
            connected(str(cluster.scheduler), 60.0, print),
        ):
            pass
    finally:
        os.kill(frozen, signal.SIGCONT)


def test_a_scheduler_that_goes_is_said(cluster):
    """Wherever it is missed: here where the workers are counted."""
    workers = str(cluster.scheduler)
    with pytest.raises(StudyError, match="the scheduler is gone"), connected(workers, 60.0, print):
        raise CommClosedError("ConnectionPool closing.")


@pytest.mark.long
def test_a_tuning_has_the_same_slopes(cluster):
    spec = tuning(GAIN, starts=3)
    here = make_evaluator(spec)
    there = ClusterEvaluator(spec, cluster.remote)
    values = spec.free.values(np.array([[0.2], [0.5], [0.8]]))
    wanted, found = here.evaluate(values), there.evaluate(values)
    for name, x, y in zip(wanted._fields, wanted, found, strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-9, atol=1e-12, err_msg=name)
    assert np.abs(found.slope).min() > 0


@pytest.mark.long
def test_a_comparison_of_laws_has_the_same_numbers(cluster, tmp_path):
    """Tuned and judged by workers: of one law and one drive, in few iterations."""
    (drive,) = [x for x in drive_candidates(STUDY) if x.name == "PD"]
    less = {
        "law_candidates": lambda study: [law_candidate(study, LAWS["srf"])],
        "drive_candidates": lambda _: [drive],
        "make_budget": lambda *_: Budget(50.0, 0.4, starts=2, iterations=2),
        "MACHINES": 2,
    }
    with mock.patch.multiple(laws, **less):
        here = studies.compare(STUDY, tmp_path / "here", progress=False)
        with mock.patch.object(laws_tuning, "optimise", None):  # that of this process
            there = studies.compare(
                STUDY, tmp_path / "there", progress=False, workers=cluster.scheduler
            )
    for name, found in there.judged.metrics.items():
        np.testing.assert_allclose(found, here.judged.metrics[name], rtol=1e-9, err_msg=name)
    for one, other in zip(here.tuned, there.tuned, strict=True):
        assert (one.candidate, one.reason) == (other.candidate, other.reason)
        assert other.quality.objective == pytest.approx(one.quality.objective, rel=1e-9)


def test_a_script_that_its_workers_would_run_again_is_told_so(tmp_path):
    """One traceback, the user's own, whose last line names what is missing; three before."""
    script = tmp_path / "script.py"
    script.write_text(
        "import studies\nstudies.configure()\nstudies.sweep('placement', 'out', workers=1)\n"
    )
    command = [sys.executable, script]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120)
    assert not (tmp_path / "out").exists()
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.count("Traceback") == 1
    assert done.stderr.endswith(
        f"workers do not start (workers import {script}: put what it does under "
        'if __name__ == "__main__":)\n'
    )


def test_bad_options_are_refused(capsys, tmp_path, cluster, monkeypatch):
    monkeypatch.setattr(connect, "PATIENCE", 2)
    spec, out = "placement", tmp_path / "out"
    sweep = ("sweep", spec, "--out", out)
    assert "no scheduler answers" in refused(capsys, *sweep, "--workers", "tcp://127.0.0.1:1")
    assert "--workers = 'udp://a:1'" in refused(capsys, *sweep, "--workers", "udp://a:1")
    nowhere = refused(capsys, *sweep, "--workers", "nowhere.json")
    assert "allowed: a number of processes, tcp://HOST:PORT" in nowhere
    assert "no client certificates" in refused(capsys, *sweep, "--workers", "tls://127.0.0.1:1")
    for count in (0, -1):
        few = refused(capsys, *sweep, "--workers", count)
        assert f"--workers = {count}; allowed: 1 to " in few
    workers = ("--workers", cluster.scheduler)
    assert "--worker-timeout = 0.0" in refused(capsys, *sweep, *workers, "--worker-timeout", 0)
    assert "plans for this process" in refused(capsys, *sweep, *workers, "--dry-run")
    assert not out.exists()


@pytest.fixture
def asked(monkeypatch):
    """Workers that are connected to, which are not there, and how."""
    found = []

    @contextmanager
    def seen(*arguments):
        found.append(arguments)
        yield "remote"

    monkeypatch.setattr(connect, "connected", seen)
    return found


@pytest.mark.parametrize(
    ("cores", "is_large", "named", "used"),
    [(16, True, None, 8), (16, False, None, None), (4, True, None, None), (16, True, 3, 3)],
)
def test_much_work_uses_many_cores_without_being_asked(
    monkeypatch, asked, cores, is_large, named, used
):
    lines = []

    def workers():
        with on_workers(named, 600.0, lines.append, is_large=is_large) as found:
            assert found == ("remote" if asked else None)
        return asked.pop()[0] if asked else None

    monkeypatch.setattr(connect, "usable_cores", lambda: cores)
    assert workers() == used
    is_default = named is None and used is not None
    assert len(lines) == is_default
    assert all(line.startswith("8 processes share 16 cores") for line in lines)
    monkeypatch.setattr(connect, "find_spec", lambda name: None)
    assert workers() == named
    assert all("[cluster]" in line for line in lines[1:])
    monkeypatch.setattr(connect, "find_spec", lambda name: name)
    monkeypatch.setattr(connect, "_unguarded", lambda: "workers import it")
    assert workers() == named
    assert all("workers import it" in line for line in lines[2:]) and len(lines) == 3 * is_default


@pytest.mark.parametrize(
    ("place", "named"),
    [
        (None, None),
        (2, 2),
        ("2", 2),
        ("-1", -1),
        ("tcp://127.0.0.1:1", "tcp://127.0.0.1:1"),
        ("./2", "./2"),
        (Path("cluster.json"), "cluster.json"),
    ],
)
def test_workers_are_named_in_python_as_on_the_command_line(asked, place, named):
    with on_workers(place, 9.0, print, run_chunk) as found:
        assert found == (None if named is None else "remote")
    assert asked == [(named, 9.0, print, run_chunk)] * (named is not None)


@pytest.mark.parametrize("place", [2.0, True, [2]])
def test_what_names_no_workers_is_refused(place, tmp_path):
    with pytest.raises(StudyError, match="--workers = .*; allowed: a number of processes"):
        sweep("gains", tmp_path / "out", workers=place)


@pytest.mark.parametrize(
    ("host", "is_said"), [("127.0.0.1", False), ("localhost", False), ("192.0.2.1", True)]
)
def test_a_scheduler_without_encryption_is_named(monkeypatch, host, is_said):
    monkeypatch.setattr(connect, "PATIENCE", 0.1)
    said = []
    refused = pytest.raises(StudyError, match="no scheduler answers")
    with refused, connected(f"tcp://{host}:1", 60.0, said.append):
        pass
    assert bool(said) == is_said and all("not encrypted" in text for text in said)


def test_a_scheduler_without_encryption_is_refused_where_it_is_required(cluster):
    workers = str(cluster.scheduler)
    required = dask.config.set({"distributed.comm.require-encryption": True})
    refused = pytest.raises(StudyError, match="no scheduler answers .*encryption")
    with required, refused, connected(workers, 60.0, print):
        pass


def test_without_dask_the_options_say_what_to_install(capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "distributed", None)
    out = tmp_path / "out"
    error = refused(capsys, "sweep", "placement", "--out", out, "--workers", "2")
    assert error.startswith("studies: --workers: ") and not out.exists()
    assert "install flexlink-studies[cluster]" in error


@pytest.mark.long
def test_a_worker_that_hangs_is_restarted(cluster, local, tmp_path):
    told(cluster, tmp_path / "warm")  # compiling must not count as hanging
    cluster.trouble(hang=50)
    outcome, text = told(cluster, tmp_path / "out", timeout=4.0)
    assert "has not answered for 4 s" in text and outcome.n_run == CASES
    assert_same(arrays(local), arrays(tmp_path / "out"), 1e-12)


def killing(cluster, out):
    """A thread that kills a worker when the first chunk is there, and the worker's number."""
    killed = []

    def kill():
        while not list((out / CHUNKS).glob("*.h5")):
            time.sleep(0.01)
            if (out / "results.h5").exists():
                return
        killed.append(cluster.pids()[0])
        os.kill(killed[0], signal.SIGKILL)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    return thread, killed


def test_killed_workers_lose_nothing(cluster, local, tmp_path):
    """Many kills: campaigns/test_kills.py."""
    out = tmp_path / "out"
    thread, killed = killing(cluster, out)
    outcome, _ = told(cluster, out)
    thread.join(timeout=60)
    assert killed and outcome.n_run == CASES and len(outcome.lost) == 0
    assert_same(arrays(local), arrays(out), 1e-12)


@pytest.mark.long  # in short: a chunk that fails, and workers that are killed
def test_a_chunk_that_kills_workers_is_left_out_until_resumed(cluster, local, tmp_path):
    cluster.trouble(kill=50)
    out = tmp_path / "out"
    outcome, text = told(cluster, out)
    assert 50 in outcome.lost and len(outcome.lost) == CHUNK
    assert outcome.n_run == CASES - CHUNK
    (entry,) = read_manifest(out)["given_up"]
    first, last = map(int, entry["cases"].split("-"))
    assert first <= 50 <= last == first + CHUNK - 1 and "died" in entry["reason"]
    assert f"cases {entry['cases']} are left out" in text
    status = read_sweep(out)["status"]
    np.testing.assert_array_equal(np.flatnonzero(status == NOT_RUN), outcome.lost)
    cluster.trouble()
    again = run_sweep(SPEC, out, True)  # here
    assert again.n_run == CHUNK and "given_up" not in read_manifest(out)
    assert_same(arrays(local), arrays(out), 1e-12)


@pytest.mark.long
def test_overhead_and_scaling(tmp_path, monkeypatch):
    """Chunks of a second, programs compiled before; medians of four rounds, side by side."""
    monkeypatch.setattr(plan, "LANES", 64)
    monkeypatch.setattr(plan, "LARGEST_CHUNK", 1024)
    gain = {"gain": {"from": 0.1, "to": 1.0, "count": 4096}}
    spec = small_spec({"axes": gain}, run={"duration": 0.4})
    cores = len(jax.local_devices())
    with ExitStack() as stack:
        found = {"here": LocalRunner()}
        for name, workers, threads in (("whole", 1, cores), ("one", 1, 1), ("two", 2, 1)):
            (tmp_path / name).mkdir()
            options = {"workers": workers, "threads": threads, "is_small": False}
            group = stack.enter_context(machines(tmp_path / name, **options))
            found[name] = ClusterRunner(spec, group.remote)
        times = {name: [] for name in found}
        for k in range(5):
            for name, runner in found.items():
                out = tmp_path / f"{name}{k}"
                done = run_sweep(spec, out, runner=runner)
                assert done.n_run == 4096
                times[name] += [done.run_time] * (k > 0)
    here, whole, one, two = (float(np.median(x)) for x in times.values())
    print(f"here {here:.2f} s, one worker with all cores {whole:.2f} s ({whole / here - 1:+.1%});")
    print(f"one worker with one core {one:.2f} s, two {two:.2f} s ({one / two:.2f} times faster)")
    assert whole / here < 1.1
    assert one / two > 1.5
