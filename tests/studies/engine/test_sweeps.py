"""Running sweeps: one compilation, nothing lost, nothing run twice, failures kept apart."""

import contextlib
import os
import resource
import shutil
import signal
import stat
import subprocess
import sys
import threading
import time
from pathlib import Path
from unittest import mock

import h5py
import numpy as np
import pytest
import xarray

import studies
from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine import chunks, function, plan
from studies.engine.design import deviations, load_design
from studies.engine.folder import (
    CHUNKS,
    SweepFolder,
    finished_cases,
    make_manifest,
)
from studies.engine.function import TRACES
from studies.engine.margins import no_margins
from studies.engine.results import metric_values, read_sweep
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.job import locked_folder
from studies.space.table import build_table
from studies.study.cases import build_structure
from studies.sweeps import run as run_module
from studies.sweeps.run import make_plan
from studies.sweeps.show import case_rows, margin_warning, ranked_cases
from tests import TOP
from tests.sweeps import FAST_MOVE, HOME_PHI, MIXED, narrow_blocks, run_sweep, small, small_spec


@pytest.fixture(scope="module", autouse=True)
def small_chunks():
    """Chunks of 16 cases, so that a small sweep has several."""
    with narrow_blocks(16):
        yield


#: Numbers of cases depend on seeds, so that a place in a chunk or a process for a seed would show.
NOISE = {"electronics": {"adc_noise": 0.002}}


def noisy_spec(sweep=MIXED):
    return small_spec(sweep, **NOISE)


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Folder of a finished sweep of 72 cases, and how often its program was traced."""
    out = tmp_path_factory.mktemp("mixed") / "sweep"
    function._FUNCTIONS.clear()  # of other tests
    before = len(TRACES)
    outcome = run_sweep(noisy_spec(), out)
    assert outcome.n_cases == outcome.n_run == 72 and outcome.is_good
    return out, len(TRACES) - before


def deviation(run, stored):
    """Largest of the deviations of metrics, and of which one; (0, "") if there is none."""
    found = ((x[0], name) for name, x in deviations(run, stored).items() if name in METRICS)
    return max(found, default=(0.0, ""))


def arrays(folder):
    return {name: v.data for name, v in read_sweep(folder).variables.items()}


def assert_same(a, b, tolerance=1e-12):
    assert a.keys() == b.keys()
    for name, x in a.items():
        y = b[name]
        if x.dtype.kind == "f":
            size = max(np.nanmax(np.abs(x), initial=0.0), 1e-300)
            assert np.array_equal(np.isnan(x), np.isnan(y)), name
            assert np.nanmax(np.abs(x - y), initial=0.0) <= tolerance * size, name
        else:
            np.testing.assert_array_equal(x, y, err_msg=name)


def test_mode_counts_subsets_and_placements_share_one_compilation(mixed):
    folder, traces = mixed
    assert traces == 1
    data = read_sweep(folder)
    assert data.n_cases == 72 and not (folder / CHUNKS).exists()
    assert set(np.unique(data["status"])) <= {status.OK, status.SATURATED, status.UNSTABLE}
    np.testing.assert_array_equal(data["status"] == status.UNSTABLE, data["gain_margin"] < 1)
    rms = data["residual_modal_rms"]
    assert np.isnan(rms[data["link.modes"] == 2][:, :, 2]).all()  # a mode that does not exist
    assert np.isfinite(rms[data["link.modes"] == 3]).all()
    assert len(np.unique(data["residual_rms"][:, 0, 0])) > 40


def test_a_strained_patch_is_the_status_of_its_case_alone(tmp_path):
    axes = {"patches.strain_limit": [1e-7, 4e-4, 1e-3]}
    run_sweep(noisy_spec({"axes": axes}), tmp_path / "sweep")
    data = read_sweep(tmp_path / "sweep")
    np.testing.assert_array_equal(data["status"], [status.STRAINED, status.OK, status.OK])
    peak = data["patch_strain_peak"]
    assert np.all((peak > 1e-7) & (peak < 4e-4))


def test_cases_without_a_verdict_are_not_ok(tmp_path):
    """As in a single run: their metrics hold, but no ranking takes them."""
    unjudged = mock.patch.object(chunks, "judge_loops", no_margins)
    with unjudged:
        run_sweep(noisy_spec({"axes": {"gain": [0.5, 1.0]}}), tmp_path / "a")
    data = read_sweep(tmp_path / "a")
    assert set(data["status"]) == {status.UNJUDGED}
    assert np.isfinite(data["residual_rms"]).all()


def test_every_case_equals_its_replay(mixed):
    folder, _ = mixed
    data = read_sweep(folder)
    full = np.flatnonzero((data["link.modes"] == 3) & (data["control.modes"] == 3))
    for case in full[[0, 5, 11]]:
        design = load_design(folder, int(case))
        found = run_study(design.study, has_record=False, has_loop=False)
        assert found.status == design.stored["status"]
        difference, name = deviation(found, design.stored)
        assert 0 < difference < 1e-9, name
        for name in ("sensor_condition", "actuator_condition"):
            wanted = getattr(found.result, name)
            np.testing.assert_allclose(data[name][case], wanted, rtol=1e-9, err_msg=name)


def test_results_open_in_xarray_and_in_plain_hdf5(mixed):
    folder, _ = mixed
    with xarray.open_dataset(folder / "results.h5") as data:
        assert data.residual_rms.dims == ("case", "link", "station")
        assert data.residual_rms.attrs["units"] == "m"
        assert data["control.modes"].dims == ("case",)
        assert set(data.link_subsets.values) == {"none", "1", "1+2+3"}
        assert "git" in data.attrs and float(data.attrs["run_time"]) > 0
        assert studies.load(folder).data.residual_rms.equals(data.residual_rms)
    with h5py.File(folder / "results.h5") as file:
        for name, dataset in file.items():
            assert dataset.is_scale or all(len(axis) == 1 for axis in dataset.dims), name


def test_equal_sweeps_have_equal_datasets(mixed, tmp_path):
    """In a background thread, too: signals can be caught in the main thread only."""
    found, out = [], tmp_path / "again"
    thread = threading.Thread(target=lambda: found.append(run_sweep(noisy_spec(), out)))
    thread.start()
    thread.join()
    assert found[0].n_cases == 72 and found[0].is_good
    assert_same(arrays(mixed[0]), arrays(tmp_path / "again"), 0.0)


def test_impossible_cases_do_not_touch_the_others(tmp_path):
    # what goes wrong in a case differs between the good ones, too: both sweeps share a program
    named = {
        "patches.centers": [0.05, 0.1, 0.15],
        "motion.waypoints": [[0, 0, 0.5], [0, 0.002, 0.5]],
        "metrics.residual_length": 0.01,
        "control.modes": 3,
        "drive.coulomb_friction": 0.0,
        "electronics.antialias_hz": 2e3,
    }
    good = [
        named
        | {
            "patches.centers": [0.05, 0.1, 0.15 + 1e-3 * k],
            "control.gain_factor": 0.1 * k,
            "motion.waypoints": [[0, 0, 0.5], [0, 0.002 + 1e-5 * k, 0.5]],
            "metrics.residual_length": 0.01 - 1e-4 * k,
            "control.modes": 1 + k % 3,
            "drive.coulomb_friction": 0.01 * k,
            "electronics.antialias_hz": 2e3 - k,
        }
        for k in range(1, 10)
    ]
    bad = [
        {"patches.centers": [0.05, 0.06, 0.15]},
        {"motion.waypoints": [[0, 0, 0.5], [0, 0.5, 0.5]]},
        {"patches.centers": [0.001, 0.06, 0.15]},
        {"metrics.residual_length": 1.0},
        {"control.modes": 4},
        {"drive.coulomb_friction": 1e3},
        {"electronics.antialias_hz": 6e3},
    ]
    mixed_list = [*good[:4], *(named | case for case in bad), *good[4:]]
    before = len(TRACES)
    for name, cases in (("a", good), ("b", mixed_list)):
        run_sweep(small_spec({"method": "list", "cases": cases}), tmp_path / name)
    assert len(TRACES) == before + 1
    clean, dirty = read_sweep(tmp_path / "a"), read_sweep(tmp_path / "b")
    codes = dirty["status"]
    is_bad = np.isin(np.arange(len(codes)), range(4, 11))
    wanted = [
        status.PATCHES_OVERLAP,
        status.OUT_OF_REACH,
        status.PATCH_OFF_LINK,
        status.WINDOW_TOO_LONG,
        status.TOO_MANY_MODES,
        status.TOO_STIFF,
        status.TOO_FAST,
    ]
    np.testing.assert_array_equal(codes[is_bad], wanted)
    np.testing.assert_array_equal(codes[~is_bad], clean["status"])
    assert np.isnan(dirty["residual_rms"][is_bad]).all()
    for name in ("residual_rms", "peak_voltage", "pose_error_rms", "control_energy"):
        a, b = clean[name], dirty[name][~is_bad]
        assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max(), name


@pytest.mark.long
def test_gains_from_each_cases_own_uncontrolled_run(tmp_path):
    axes = {"control.ratio_source": "all", "emc_exponent": [0.5, 1.0], "move_time": [0.008, 0.01]}
    run_sweep(small_spec({"axes": axes}), tmp_path / "s")
    data = read_sweep(tmp_path / "s")
    is_own = data["control.ratio_source"] == "own_run"
    assert is_own.sum() == 4
    for case in np.flatnonzero(is_own):
        design = load_design(tmp_path / "s", int(case))
        found = run_study(design.study, has_record=False, has_loop=False)
        assert deviation(found, design.stored)[0] < 1e-9
    assert np.abs(data["control_energy"][is_own] / data["control_energy"][~is_own] - 1).min() > 1e-6


@pytest.mark.long
def test_programs_of_different_mode_counts_join(tmp_path):
    cases = [
        {"link.modes": 3, "control.modes": 2, "run.duration": 0.025},
        {"link.modes": 2, "control.modes": 1, "run.duration": 0.026},
    ]
    run_sweep(small_spec({"method": "list", "cases": cases}), tmp_path / "s")
    data = read_sweep(tmp_path / "s")
    assert np.all(data["status"] == status.OK) and data["residual_modal_rms"].shape == (2, 3, 3)
    assert np.isnan(data["residual_modal_rms"][1, :, 2]).all()
    assert np.isfinite(data["residual_modal_rms"][0]).all()


@pytest.mark.long
def test_noise_differs_between_repeats_and_is_the_same_again(tmp_path):
    electronics = {"adc_noise": 0.01}
    sweep = {"axes": {"gain": [0.5]}, "repeats": 4}
    run_sweep(small_spec(sweep, electronics=electronics), tmp_path / "a")
    run_sweep(small_spec(sweep, electronics=electronics), tmp_path / "b")
    energy = read_sweep(tmp_path / "a")["control_energy"]
    assert len(np.unique(energy)) == 4
    np.testing.assert_array_equal(energy, read_sweep(tmp_path / "b")["control_energy"])


@pytest.mark.long
def test_each_case_takes_the_plant_steps_that_it_takes_alone(tmp_path):
    spec = small_spec(
        {"axes": {"control.velocity_gain[0]": [0.1, 3e3, 1e6]}},
        link={"modes": 1},
        shaper={"kind": "none"},
        control={"modes": 1, "feedback": "ideal", "velocity_gain": [0.1] * 3},
    )
    run_sweep(spec, tmp_path / "s")
    data = read_sweep(tmp_path / "s")
    np.testing.assert_array_equal(data["status"], [status.OK, status.SATURATED, status.TOO_STIFF])
    assert data["substeps"][0] == 1 < data["substeps"][1]
    for case in (0, 1):
        design = load_design(tmp_path / "s", case)
        alone = design.study.change(run__substeps=0)
        found = run_study(alone, has_record=False, has_loop=False)
        assert found.structure.substeps == data["substeps"][case]
        assert deviation(found, design.stored)[0] < 1e-9


def test_a_path_out_of_reach_needs_no_plant_steps(tmp_path):
    """Of links that lengthen: longitudinal modes of a machine that cannot close mean nothing."""
    cases = [{"motion.waypoints": [[0, 0, HOME_PHI], [0, y, HOME_PHI]]} for y in (0.002, 0.9)]
    spec = small_spec({"method": "list", "cases": cases}, link={"modes": 3, "stretch": True})
    run_sweep(spec, tmp_path / "s")
    data = read_sweep(tmp_path / "s")
    np.testing.assert_array_equal(data["status"], [status.OK, status.OUT_OF_REACH])
    assert data["substeps"][0] == data["substeps"][1]


def test_static_choices_make_groups():
    masses = [0.0, 0.1]
    axes = {"control.feedback": ["none", "sampled"], "load.mass": masses, "plant_modes": [2, 3]}
    groups = make_plan(small_spec({"axes": axes})).groups
    assert {group.structure.feedback for group in groups} == {"none", "sampled"}
    assert all(len(group.rows) == 4 and group.structure.n_modes == 3 for group in groups)
    with pytest.raises(StudyError, match="needs a compilation; allowed: up to 64"):
        many = {"run.duration": {"from": 0.021, "to": 0.029, "count": 80}}
        make_plan(small_spec({"axes": many}))


# --- what must survive ----------------------------------------------------------------------------

SCRIPT = """
import json, os, sys
sys.path.insert(0, sys.argv[3])
import studies
studies.configure()
studies.config.keep_programs()
from studies.engine import plan
from studies.space.spec import parse_sweep
plan.LANES, plan.LARGEST_CHUNK = 8, 16
studies.sweep(parse_sweep(json.loads(sys.argv[1])), sys.argv[2])
"""


def started(data, out):
    """A sweep in a process of its own."""
    import json

    root = str(TOP)
    command = [sys.executable, "-c", SCRIPT, json.dumps(data), str(out), root]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


@pytest.mark.long  # in short: what signals, full disks and damage leave, below
def test_a_killed_sweep_runs_only_what_is_left(tmp_path, mixed):
    """Kills at random moments, of all commands: campaigns/test_kills.py."""
    out = tmp_path / "killed"
    process = started(small(**NOISE), out)
    deadline = time.monotonic() + 120
    while not list(out.glob("*/*.h5")) and process.poll() is None and time.monotonic() < deadline:
        time.sleep(0.002)
    process.send_signal(signal.SIGKILL)
    process.communicate(timeout=120)
    done = finished_cases(out).case_id
    assert 0 < len(done) < 72
    outcome = run_sweep(noisy_spec(), out, resume=True)
    assert outcome.n_cases == 72 and outcome.n_run == 72 - len(done)
    assert_same(arrays(mixed[0]), arrays(out))


def test_the_fastest_pole_of_every_case_sets_its_plant_steps(monkeypatch):
    """Of more cases than are looked at together; one that has no poles counts as 0."""
    table = build_table(small_spec({"axes": {"gain": np.linspace(0.1, 0.4, 300).tolist()}}))
    gain = table.values("control.gain_factor")

    def made_up(structure, cases):
        rate = np.where(cases.control.gain_factor == gain[7], np.nan, cases.control.gain_factor)
        slow, fast = -rate * np.array([[[1.0]], [[100.0]]])
        return np.stack([slow, fast], axis=-1).swapaxes(0, 1)[..., None] * np.eye(2)

    monkeypatch.setattr(plan, "_mechanics", made_up)
    members = np.arange(300)[::-1]
    found = plan._pole_decay(table, build_structure(table.study), members)
    np.testing.assert_allclose(found, np.where(members == 7, 0.0, 100 * gain[members]))


def test_a_chunk_outlives_a_loss_of_power(tmp_path, monkeypatch):
    """It is on the disk before it has its name, and then its name is."""
    flushed = []

    def fsync(descriptor):
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        flushed.append((is_folder, len(list(tmp_path.glob("chunks/*.h5")))))

    monkeypatch.setattr(os, "fsync", fsync)
    SweepFolder(tmp_path).write_chunk({"status": np.zeros(2)})
    assert flushed == [(False, 0), (True, 1)]


def partly_done(out, spec=None, number=signal.SIGINT):
    """A sweep that stopped after two chunks, as Ctrl-C leaves it."""
    spec = spec or noisy_spec()
    from studies.sweeps import run as module

    original, count = module.SweepFolder.write_chunk, [0]

    def write(self, *given):
        original(self, *given)
        count[0] += 1
        if count[0] == 2:
            os.kill(os.getpid(), number)
            time.sleep(0.01)

    module.SweepFolder.write_chunk = write
    before = signal.getsignal(number)  # a shell starts what runs in its background without
    try:
        with pytest.raises(KeyboardInterrupt, match="of 72 cases are safe") as stopped:
            run_sweep(spec, out)
    finally:
        module.SweepFolder.write_chunk = original
    assert signal.getsignal(number) is before
    return int(str(stopped.value).split()[0])


def test_a_signal_finishes_the_chunk_and_says_so(tmp_path):
    """Ctrl-C; of a batch system, and what runs afterwards: the next test."""
    out = tmp_path / "s"
    n_done = partly_done(out)
    assert 32 <= n_done < 72
    data = read_sweep(out)
    assert np.sum(data["status"] >= 0) == n_done
    assert np.isnan(data["residual_rms"][data["status"] < 0]).all()


def test_damaged_chunks_run_again(tmp_path, mixed):
    out = tmp_path / "s"
    partly_done(out, number=signal.SIGTERM)
    chunks = sorted((out / CHUNKS).glob("*.h5"))
    content = bytearray(chunks[0].read_bytes())
    content[len(content) // 2] ^= 1
    chunks[0].write_bytes(content)
    chunks[1].write_bytes(chunks[1].read_bytes()[:1000])
    (out / CHUNKS / "unfinished.tmp").write_bytes(b"half")
    before = len(finished_cases(out).case_id)
    resumed = run_sweep(noisy_spec(), out, resume=True)
    assert resumed.n_run == 72 - before >= 32
    assert_same(arrays(mixed[0]), arrays(out))
    assert len(list((out / CHUNKS).glob("*.damaged"))) == 2


def test_chunks_lost_while_it_runs_are_noticed(tmp_path):
    out = tmp_path / "s"
    finish = run_module.finished_cases

    def lossy(folder, *tell):
        for chunk in sorted((out / CHUNKS).glob("*.h5"))[:1]:
            chunk.unlink()
        return finish(folder, *tell)

    # not by monkeypatch, which keeps no programs
    with (
        mock.patch.object(run_module, "finished_cases", lossy),
        pytest.raises(StudyError, match="16 of 72 cases disappeared while the sweep ran"),
    ):
        run_sweep(noisy_spec(), out)
    assert not (out / "results.h5").exists()


def test_extended_sweep_runs_only_new_cases(tmp_path):
    def spec(count, modes, **more):
        axes = MIXED["axes"] | {"controlled_modes": modes, "link_subsets": ["1", "1+2+3"]}
        inner = MIXED["blocks"][0] | {"count": count}
        return noisy_spec({"axes": axes, "blocks": [inner], **more})

    out, longest = tmp_path / "s", spec(4, [1, 2, 3])
    run_sweep(spec(2, [2, 3]), out)
    with locked_folder(out, "sweep"):
        SweepFolder(out).begin(make_manifest(longest.data))
    begun = read_sweep(out)  # stopped before the first chunk: old cases are known by their ids
    assert begun.n_cases == 48 and np.sum(begun["status"] >= 0) == 16
    is_full = (begun["link.modes"] == 3) & (begun["control.modes"] == 3)  # a program of replays
    case = int(np.flatnonzero((begun["status"] >= 0) & is_full)[1])
    found = run_study(load_design(out, case).study, has_record=False, has_loop=False)
    assert deviation(found, load_design(out, case).stored)[0] < 1e-9
    longer = run_sweep(longest, out, resume=True)
    assert longer.n_run == 48 - 16 and longer.n_cases == 48
    run_sweep(longest, tmp_path / "whole")
    assert_same(arrays(tmp_path / "whole"), arrays(out), 1e-9)
    other = spec(4, [1, 2, 3], metrics=["residual_rms"])
    with pytest.raises(StudyError, match="keeps the same"):
        run_sweep(other, out, resume=True)
    before = (out / "sweep.json").read_bytes()
    with pytest.raises(StudyError, match="finished cases in .* are not part of this sweep"):
        run_sweep(spec(2, [2, 3]), out, resume=True)
    assert (out / "sweep.json").read_bytes() == before


def test_what_does_not_fit_is_refused(tmp_path, mixed):
    folder, _ = mixed
    with pytest.raises(StudyError, match="holds a sweep already; add --resume"):
        run_sweep(noisy_spec(), folder)
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.tmp").write_text("x")
    with pytest.raises(StudyError, match="holds other files .thesis.tmp."):
        run_sweep(noisy_spec(), tmp_path / "other")
    with pytest.raises(StudyError, match="holds other files .thesis.tmp."):
        run_sweep(noisy_spec(), tmp_path / "other", resume=True)
    assert [x.name for x in (tmp_path / "other").iterdir()] == ["thesis.tmp"]
    (tmp_path / "file").write_text("x")
    with pytest.raises(StudyError, match="this is a file; name a folder"):
        run_sweep(noisy_spec(), tmp_path / "file")
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    text = (copy / "sweep.json").read_text()
    digest = text.split('"code": "')[1][:16]
    (copy / "sweep.json").write_text(text.replace(digest, "0" * 16))
    with pytest.raises(StudyError, match="begun with another code"):
        run_sweep(noisy_spec(), copy, resume=True)
    content = bytearray((copy / "results.h5").read_bytes())
    content[len(content) // 3] ^= 1
    (copy / "results.h5").write_bytes(content)
    with pytest.raises(StudyError, match="results.h5: damaged, or not of this sweep"):
        read_sweep(copy)
    (copy / "sweep.json").write_text("{")
    with pytest.raises(StudyError, match="damaged"):
        read_sweep(copy)


def test_two_processes_cannot_share_a_folder(tmp_path):
    """Locks of two open files exclude each other, whether one process opened them or two."""
    out = tmp_path / "s"
    with (
        locked_folder(out, "sweep"),
        pytest.raises(StudyError, match="another process is at work on a sweep there"),
    ):
        run_sweep(small_spec(), out)
    assert not list((out / CHUNKS).glob("*"))  # nothing has begun


def test_full_disk_keeps_what_is_finished(tmp_path, mixed):
    """A small file system where the test may mount one, else a limit on the size of files."""
    out = tmp_path / "disk"
    out.mkdir()
    is_mounted = _mount(out, "size=96k")
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    if not is_mounted:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, old[1]))
    try:
        with pytest.raises(StudyError, match="cannot write"):
            run_sweep(noisy_spec(), out / "s")
        kept = len(finished_cases(out / "s").case_id)
        assert not list((out / "s" / CHUNKS).glob("*.tmp"))
        if is_mounted:
            assert 0 < kept < 72
            subprocess.run(["mount", "-o", "remount,size=8m", str(out)], check=True, timeout=120)
        else:
            resource.setrlimit(resource.RLIMIT_FSIZE, old)
        assert run_sweep(noisy_spec(), out / "s", resume=True).n_run == 72 - kept
        assert_same(arrays(mixed[0]), arrays(out / "s"))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
        if is_mounted:
            subprocess.run(["umount", "-l", str(out)], check=False, timeout=120)


def _mount(folder, options):
    with contextlib.suppress(OSError):
        command = ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)]
        return subprocess.run(command, capture_output=True, timeout=120).returncode == 0
    return False


def test_best_cases_obey_conditions(mixed):
    data = read_sweep(mixed[0])
    first = ranked_cases(data, "residual_rms", count=5)
    value = data["residual_rms"].max(axis=(1, 2))
    is_ok = data["status"] == status.OK
    assert value[first[0]] == value[is_ok].min() and np.all(np.diff(value[first]) >= 0)
    limited = ranked_cases(data, "residual_rms[1]", "peak_voltage < 1 and control.modes == 2", 99)
    assert len(limited) and np.all(data["peak_voltage"][limited].max(axis=1) < 1)
    assert np.all(data["control.modes"][limited] == 2)
    worst = data["sensor_condition"].max(axis=1)
    apart = ranked_cases(data, "residual_rms", f"sensor_condition < {np.median(worst)}", 99)
    assert len(apart) < is_ok.sum() and worst[apart].max() < np.median(worst)
    second = data["residual_rms"][:, 1].max(axis=1)
    named = ranked_cases(data, "residual_rms[link=2]", "peak_voltage[link=1] > 0", 99)
    assert np.all(np.diff(second[named]) >= 0) and np.all(data["peak_voltage"][named, 0] > 0)
    np.testing.assert_array_equal(
        metric_values(data, "residual_rms[station=2][link=3]"), data["residual_rms"][:, 2, 1]
    )
    with pytest.raises(StudyError, match="allowed: link = 1 to 3, station = 1 to 3"):
        ranked_cases(data, "residual_rms[link=4]")
    with pytest.raises(StudyError, match="did you mean 'peak_voltage'"):
        ranked_cases(data, "voltage_peak")
    with pytest.raises(StudyError, match="no case with status ok"):
        ranked_cases(data, "residual_rms", "peak_voltage < 0")


def test_small_margins_are_not_passed_over(mixed):
    data = read_sweep(mixed[0])
    order = np.argsort(data["gain_margin"])
    warned, fine = margin_warning(data, order[:3]), margin_warning(data, order[-1:])
    assert f"smallest {data['gain_margin'].min():.3g}" in warned and "gain_margin > 2" in warned
    assert (fine == "") == (data["gain_margin"].max() >= 2)
    table = case_rows(data, order[:1], ["residual_rms"])
    assert table.heads[-1] == "gain_margin" and float(table.rows[0][-1]) < 2


LOADED = (
    """
[run]
duration = 0.05
[link]
basis = "loaded"
[control]
basis = "loaded"
"""
    + FAST_MOVE
    + """[metrics]
residual_delay = 0.0
residual_length = 0.01
[[sweep.blocks]]
method = "random"
count = 256
axes = { gain = { from = 0.01, to = 0.1 }, "link.joint_inertia_c" = { from = 1e-6, to = 1e-5 } }
"""
)


@pytest.mark.long
def test_sweeps_of_loaded_links_end(tmp_path):
    """Eigenvalue problems side by side used to hang XLA's CPU client two times out of three."""
    (tmp_path / "loaded.toml").write_text(LOADED)
    plain = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}
    for k in range(4):
        studies_command = str(Path(sys.executable).with_name("studies"))
        command = [studies_command, "sweep", "loaded.toml", "--out", f"out{k}"]
        subprocess.run(command, cwd=tmp_path, env=plain, check=True, timeout=300)
