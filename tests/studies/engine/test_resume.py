"""Folders of sweeps that are resumed with another request, renamed, removed, or read meanwhile."""

import copy
import json
import random
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from campaigns.mutations import sweep_folder
from jaxmodel.loop_figures import MARGINS
from studies.engine import baseline, results
from studies.engine import folder as folders
from studies.engine.folder import (
    BASELINE,
    CHUNKS,
    RESULTS,
    finished_cases,
)
from studies.engine.results import DIGEST, baseline_digest, baseline_id, read_sweep
from studies.errors import StudyError
from studies.job import LOCK, locked_folder, working
from studies.publish import publish, replacing
from studies.results.labelled import Variable
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.store import write_store
from studies.sweeps import run as run_module
from studies.sweeps.run import make_plan
from tests import TOP
from tests.bare import bare
from tests.canonical import TINY
from tests.sweeps import narrow_blocks, run_sweep

GAINS = [round(0.05 * k, 2) for k in range(2, 26)]
SWEEP = {"axes": {"gain": GAINS}, "metrics": ["residual_rms", "peak_voltage"]}


@pytest.fixture(scope="module", autouse=True)
def small_chunks():
    with narrow_blocks(8):
        yield


def request(**changes):
    data = bare(copy.deepcopy(TINY))
    return {"title": "resumed", **data, "sweep": copy.deepcopy(SWEEP) | changes}


def run(data, out, **options):
    return run_sweep(parse_sweep(data), out, **options)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    out = tmp_path_factory.mktemp("finished") / "sweep"
    assert run(request(), out).n_run == len(GAINS)
    return out


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """The same after one of two chunks."""
    out = tmp_path_factory.mktemp("begun") / "sweep"
    with pytest.MonkeyPatch.context() as patch:
        write, count = folders.SweepFolder.write_chunk, []

        def once(self, *given):
            if count:
                raise StudyError("stopped")
            count.append(1)
            write(self, *given)

        patch.setattr(folders.SweepFolder, "write_chunk", once)
        with pytest.raises(StudyError, match="stopped"):
            run(request(), out)
    assert 0 < len(folders.finished_cases(out).case_id) < len(GAINS)
    return out


def contents(folder):
    return {x.relative_to(folder): x.read_bytes() for x in folder.rglob("*") if x.is_file()}


@pytest.mark.parametrize(
    "changes",
    [
        {"robustness": ["disk_margin"]},
        {"robustness": ["disk_margin"], "axes": {"gain": [0.1, 0.5, 1.0, 2.0]}},
        {"metrics": ["residual_rms"]},
        {"fidelity": "linear"},
    ],
)
def test_what_finished_cases_do_not_hold_is_refused(changes, tmp_path):
    """In a dry run, too, and for an unfinished sweep."""
    for folder in sweep_folder(tmp_path):
        (folder / CHUNKS).mkdir(exist_ok=True)
        (folder / CHUNKS / "left.tmp").write_text("of a kill")
        before, data = contents(folder), json.loads((folder / "sweep.json").read_text())["spec"]
        spec = parse_sweep(data | {"sweep": data["sweep"] | changes})
        refused = partial(pytest.raises, StudyError, match=r"sweep\.\w+ = .* keeps the same")
        with refused():
            run_sweep(spec, folder, resume=True)
        with refused():
            make_plan(spec, folder)
        assert contents(folder) == before


def test_an_extension_by_sampled_feedback_learns_the_step_of_its_adc(tmp_path):
    spec = parse_sweep(request())
    variables = {"status": Variable(np.array(0), (), "1", "status")}
    seal = {"case_id": baseline_id(spec), DIGEST: baseline_digest(variables)}
    write_store(tmp_path / BASELINE, variables, seal)
    assert baseline._is_stored(tmp_path, spec, False)
    assert not baseline._is_stored(tmp_path, spec, True)


# --- any field of a request -----------------------------------------------------------------------

#: What a sweep can have instead.
OTHERS = {
    "metrics": [[], ["residual_rms"], ["peak_voltage", "residual_rms"], ["settling_time"]],
    "robustness": [[x] for x in MARGINS],
    "fidelity": ["linear", "full"],
    "by": ["peak_voltage", "residual_rms[link=2]"],
    "links": [[2], [1, 2, 3]],
    "environments": [["gain"]],
    "over": ["mean", 0.5],
    "repeats": [2],
    "seed": [1],
    "where": ["gain > 0.3", "gain > 0", "gain < 2"],
    "subject_to": ["gain_margin > 2", "gain > 0.3"],
    "method": ["zip", "random"],
    "axes": [
        {"gain": [*GAINS, 1.3]},
        {"gain": GAINS[1:]},
        {"gain": GAINS[::-1]},
        {"gain": GAINS, "link_subsets": ["1+2+3", "1"]},
        {"gain": GAINS, "control.feedback": "all"},
        {"gain": [1.33, 0.55, *GAINS]},
    ],
}


def near(value):
    """Another value of its kind."""
    if isinstance(value, bool):
        return not value
    if isinstance(value, int):
        return value + random.choice((-1, 1))
    if isinstance(value, float):
        return value * 1.01 if value else 0.001
    if isinstance(value, str):
        return random.choice(("none", "auto", "ideal", "linear", "zv", value + "x"))
    if isinstance(value, (list, tuple)) and value:
        return [near(value[0]), *value[1:]]
    return [1.0]


def changed_at_random():
    """A request with one field changed; a valid one."""
    while True:
        data = request()
        if random.random() < 0.5:
            name = random.choice(list(OTHERS))
            data["sweep"][name] = random.choice(OTHERS[name])
            what = f"sweep.{name} = {data['sweep'][name]}"
        elif random.random() < 0.1:
            data["title"] = what = "another"
        else:
            fields = parse_sweep(data).study.model_dump(mode="json")
            section = random.choice([x for x, part in fields.items() if isinstance(part, dict)])
            if not fields[section]:
                continue
            name = random.choice(list(fields[section]))
            own = data.setdefault(section, {})
            own[name] = near(fields[section][name])
            what = f"{section}.{name} = {own[name]}"
        try:
            build_table(parse_sweep(data))
        except StudyError:
            continue
        return what, data


def equal(a, b):
    """Whether a resumed sweep holds what a new one does."""
    if a.variables.keys() != b.variables.keys() or a.baseline.keys() != b.baseline.keys():
        return False
    for name, variable in b.variables.items():
        mine, other = a[name], variable.data
        if other.dtype.kind != "f":
            if not np.array_equal(mine, other):
                return False
        elif not np.allclose(mine, other, rtol=1e-9, atol=0, equal_nan=True):
            return False
    return True


def resume_at_random(seed, count, finished, begun, tmp_path):
    random.seed(seed)
    refused = 0
    for k in range(count):
        what, data = changed_at_random()
        resumed, fresh = tmp_path / f"resumed{k}", tmp_path / f"fresh{k}"
        shutil.copytree(random.choice((finished, begun)), resumed)
        before = contents(resumed)
        try:
            run(data, resumed, resume=True)
        except StudyError as error:
            assert contents(resumed) == before, what
            print(f"{what}: {error}")
            refused += 1
        else:
            run(data, fresh)
            assert equal(read_sweep(resumed), read_sweep(fresh)), what
            shutil.rmtree(fresh)
        shutil.rmtree(resumed)
    return refused


def test_a_field_changed_at_random_is_refused_or_right(finished, begun, tmp_path):
    assert 0 < resume_at_random(3, 4, finished, begun, tmp_path) < 4


@pytest.mark.long
@pytest.mark.timeout(3600)
def test_a_hundred_fields_changed_at_random_are_refused_or_right(finished, begun, tmp_path):
    refused = resume_at_random(1, 100, finished, begun, tmp_path)
    print(f"100 resumes: {refused} refused, {100 - refused} as a new folder")
    assert 20 < refused < 90


# --- renamed and removed folders ------------------------------------------------------------------

MOVED = "was renamed or removed while work went on in it"


def taken_over(out, begun):
    """Rename a folder, and begin another under its name; its files."""
    out.rename(out.with_name("renamed"))
    shutil.copytree(begun, out)
    return contents(out)


@pytest.mark.parametrize("moment", ["first chunk", "last chunk", "join", "publish"])
def test_a_sweep_whose_folder_was_renamed_leaves_the_new_one_alone(
    moment, begun, tmp_path, monkeypatch
):
    out, theirs, count = tmp_path / "s", [], []

    def after(owner, name, number):
        call = getattr(owner, name)

        def then(*given, **more):
            found = call(*given, **more)
            count.append(name)
            if len(count) == number:
                theirs.append(taken_over(out, begun))
            return found

        monkeypatch.setattr(owner, name, then)

    if moment == "join":
        after(run_module, "keep_baseline", 1)
    elif moment == "publish":
        after(run_module, "merge", 1)
    else:
        after(folders.SweepFolder, "write_chunk", 1 if moment == "first chunk" else 2)
    with pytest.raises(StudyError, match=MOVED):
        run(request(), out)
    assert contents(out) == theirs[0]
    monkeypatch.undo()
    done = len(finished_cases(tmp_path / "renamed").case_id)
    assert done > 0
    assert run(request(), tmp_path / "renamed", resume=True).n_run == len(GAINS) - done
    read_sweep(tmp_path / "renamed")


def test_a_sweep_whose_folder_was_removed_says_so(tmp_path, monkeypatch):
    write = folders.SweepFolder.write_chunk

    def then(self, *given):
        write(self, *given)
        shutil.rmtree(self.path)

    monkeypatch.setattr(folders.SweepFolder, "write_chunk", then)
    with pytest.raises(StudyError, match=MOVED):
        run(request(), tmp_path / "s")
    assert not (tmp_path / "s").exists()


def write_report(out):
    with publish(out) as staging:
        (staging / "report.html").write_text("x")


def write_progress(out):
    with replacing(out / "progress.npz") as temporary:
        temporary.write_text("x")


def tuning(out):
    return working("tune", out, {}, ("descend",), progress=False)


@pytest.mark.parametrize(
    "write", [write_report, write_progress, lambda out: write_store(out / "x.h5", {}, {})]
)
@pytest.mark.parametrize("opened", [partial(locked_folder, verb="sweep"), tuning])
@pytest.mark.parametrize("is_inside", [False, True])
def test_whatever_is_written_into_a_reserved_folder(write, opened, is_inside, tmp_path):
    """Of any command; into a folder of a stage in it, too."""
    out = tmp_path / "s"
    with pytest.raises(StudyError, match=MOVED), opened(out):
        (out / "stage").mkdir()
        write(out / "stage" if is_inside else out)
        out.rename(tmp_path / "renamed")
        (out / "stage").mkdir(parents=True)
        (out / LOCK).write_text("")
        write(out / "stage" if is_inside else out)
    assert sorted(x.name for x in out.rglob("*")) == [LOCK, "stage"]
    write(out)  # nobody reserves it any more


def test_what_takes_long_to_write_is_looked_at_again(tmp_path):
    """Content made while the folder was renamed does not appear in the new one."""
    out = tmp_path / "s"
    with (
        pytest.raises(StudyError, match=MOVED),
        locked_folder(out, "certify"),
        replacing(out / "a.h5") as temporary,
    ):
        out.rename(tmp_path / "renamed")
        out.mkdir()
        (out / LOCK).write_text("")
        temporary.write_text("x")
    assert [x.name for x in out.iterdir()] == [LOCK]


def test_the_lock_of_another_process_stays(tmp_path):
    """What is refused removes its lock; not the one of who has the name by now."""
    out = tmp_path / "s"
    with pytest.raises(StudyError, match=MOVED), locked_folder(out, "sweep"):
        out.rename(tmp_path / "renamed")
        out.mkdir()
        (out / LOCK).write_text("")
        raise StudyError("refused")
    assert (out / LOCK).exists()


def test_a_chunk_has_a_temporary_name_of_its_process(tmp_path, monkeypatch):
    """Of two that write to one folder nonetheless, none removes the other's."""
    seen = []
    replace = folders.os.replace
    monkeypatch.setattr(
        "studies.publish.os.replace",
        lambda a, b: (seen.append(Path(a).name), replace(a, b)),
    )
    folders.SweepFolder(tmp_path).write_chunk({"status": [0]})
    assert len(seen) == 1 and f".{folders.os.getpid()}-" in seen[0]


# --- readers --------------------------------------------------------------------------------------


def joining(folder, call, at):
    """`call`, before which a sweep joins its chunks the first time; at: where its results are."""

    def then(*given, **more):
        if at.exists():
            at.rename(folder / RESULTS)
            shutil.rmtree(folder / CHUNKS)
        return call(*given, **more)

    return then


@pytest.mark.parametrize("moment", ["gather", "finished_cases", "build_table", "read_baseline"])
def test_a_sweep_that_joins_its_chunks_is_read_again(moment, tmp_path, monkeypatch):
    folder, _ = sweep_folder(tmp_path)
    wanted = read_sweep(folder)
    results_file = folder / RESULTS
    (folder / CHUNKS).mkdir()
    name = f"000000-{folders.file_hash(results_file)}.h5"
    shutil.copy(results_file, folder / CHUNKS / name)
    results_file.rename(tmp_path / "joined")
    race = joining(folder, getattr(results, moment), tmp_path / "joined")
    monkeypatch.setattr(results, moment, race)
    found = read_sweep(folder)
    assert (found["status"] == wanted["status"]).all() and not found.notes
    assert (found["residual_rms"] == wanted["residual_rms"]).all()


def test_a_fault_of_the_folder_is_no_race(tmp_path, monkeypatch):
    """It is reported at the first attempt."""
    folder, _ = sweep_folder(tmp_path)
    (folder / RESULTS).write_bytes(b"x")
    count, read = [], results._read
    monkeypatch.setattr(results, "_read", lambda *given: (count.append(1), read(*given))[1])
    with pytest.raises(StudyError, match="damaged"):
        read_sweep(folder)
    assert len(count) == 1


JOIN = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import studies
studies.configure()
from studies.engine.folder import SweepFolder, finished_cases, read_manifest
from studies.engine.stored import manifest_attributes, merge
from studies.job import locked_folder
from studies.space.spec import parse_sweep
from studies.space.table import build_table
for folder in sorted(Path(sys.argv[2]).iterdir()):
    manifest = read_manifest(folder)
    table = build_table(parse_sweep(manifest["spec"]))
    with locked_folder(folder, "sweep"):
        opened = SweepFolder(folder)
        opened.begin(manifest)
        merge(folder, table, finished_cases(folder), manifest_attributes(manifest))
        time.sleep(0.3)  # for readers that have just listed the chunks
        opened.publish()
"""


@pytest.mark.long
@pytest.mark.timeout(1800)
def test_reads_beside_sweeps_that_join_have_no_error(begun, tmp_path):
    """Of 20 chunks, in other processes than the reader's."""
    chunk = next((begun / CHUNKS).glob("*.h5"))
    for k in range(100):
        shutil.copytree(begun, tmp_path / "s" / f"{k:02d}")
        for n in range(1, 20):  # each once more: cases count once
            name = f"{n:06d}{chunk.name[6:]}"
            shutil.copy(chunk, tmp_path / "s" / f"{k:02d}" / CHUNKS / name)
    command = [sys.executable, "-c", JOIN, str(TOP), str(tmp_path / "s")]
    with subprocess.Popen(command) as process:
        reads, wanted = 0, len(finished_cases(begun).case_id)
        for folder in sorted((tmp_path / "s").iterdir()):
            while (folder / CHUNKS).exists() and process.poll() is None:
                assert (read_sweep(folder)["status"] >= 0).sum() == wanted
                reads += 1
    print(f"{reads} reads beside 100 joins")
    assert process.returncode == 0 and reads >= 200
