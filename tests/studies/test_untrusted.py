"""Files that somebody else made: whatever is in them, a message or a result; no traceback, no hang.

The short campaign reads what needs no compiled program; the long one everything that is shipped.
"""

import io
import json
import os
import shutil
import struct
import sys
import time

import h5py
import numpy as np
import pytest

from campaigns import mutations
from campaigns.mutations import KINDS, Hang, attack, originals
from studies.cli import main
from studies.engine.folder import (
    BASELINE,
    MANIFEST,
    RESULTS,
    file_hash,
    finished_cases,
    read_manifest,
)
from studies.engine.results import read_sweep
from studies.errors import StudyError
from studies.export.document import read_document
from studies.job import LOCK, locked_folder
from studies.reading import DEEPEST, LARGEST, open_hdf5, read_bytes, read_json, read_npz
from studies.study.spec import load_study

#: Cases of each kind in the short campaign, and in the long one.
SHORT = {"study": 25, "sweep": 20, "document": 20, "measurement": 15, "controller": 12}
SHORT |= {"sweep folder": 4, "MATLAB file": 2, "fit folder": 14, "tuned folder": 6}
SHORT |= {"chunks": 5, "program": 15, "outcome": 12, "scheduler": 8}
LONG = {"study": 1200, "sweep": 1000, "tuning": 900, "fit": 900, "controller": 800, "gains": 300}
LONG |= {"document": 800, "MATLAB file": 300, "measurement": 900, "sweep folder": 500}
LONG |= {"tuning folder": 400, "commissioning": 600, "tuned folder": 500, "fit folder": 500}
LONG |= {"scheduler": 300, "chunks": 500, "program": 300, "outcome": 300}


def campaign(kind, count, folder, found, first=0):
    """Faults found from `count` seeds."""
    seeds = range(first, first + count)
    return [fault for seed in seeds if (fault := attack(kind, found, folder, seed))]


def test_the_long_campaign_covers_all_kinds():
    assert set(LONG) == set(KINDS) and sum(LONG.values()) >= 10_000
    assert sum(SHORT.values()) >= 150


@pytest.mark.parametrize("kind", SHORT)
def test_changed_files_end_in_a_message(tmp_path, kind):
    found = originals(kind, tmp_path / "originals")
    assert campaign(kind, SHORT[kind], tmp_path, found) == []


@pytest.mark.long
@pytest.mark.parametrize("kind", LONG)
def test_many_changed_files_end_in_a_message(tmp_path, kind):
    found = originals(kind, tmp_path / "originals")
    for path in found:  # readable as they are
        KINDS[kind].read(path)
    assert campaign(kind, LONG[kind], tmp_path, found) == []


def test_the_campaign_notices_tracebacks_and_hangs(tmp_path, monkeypatch):
    found = originals("study", tmp_path / "originals")
    monkeypatch.setattr(mutations, "LIMIT", 0.05)
    for fault, said in ((lambda _: {}["x"], "KeyError: 'x'"), (lambda _: time.sleep(9), "Hang: ")):
        monkeypatch.setitem(KINDS, "study", KINDS["study"]._replace(read=fault))
        assert said in attack("study", found, tmp_path / "originals", 0)
        (tmp_path / "originals" / "study-0").rename(tmp_path / said[:3])
    assert not issubclass(Hang, Exception)


def test_the_campaign_notices_another_answer(tmp_path, monkeypatch):
    found, read = originals("outcome", tmp_path / "originals"), KINDS["outcome"].read
    answers = iter([{"outcome": 1}, {"outcome": 2}])
    monkeypatch.setitem(KINDS, "outcome", KINDS["outcome"]._replace(read=lambda _: next(answers)))
    assert "another answer" in attack("outcome", found, tmp_path, 0)
    monkeypatch.setitem(KINDS, "outcome", KINDS["outcome"]._replace(read=read))
    assert attack("outcome", found, tmp_path, 1) == ""


def test_a_changed_baseline_is_refused(tmp_path, sweep):
    """A bit of a number: the file is as readable as before."""
    out = tmp_path / "out"
    shutil.copytree(sweep, out)
    with h5py.File(out / BASELINE, "r+") as file:
        file["residual_rms"][...] = np.nextafter(file["residual_rms"][()], np.inf)
    with pytest.raises(StudyError, match="baseline.h5: damaged; remove it and go on with --resume"):
        read_sweep(out)


@pytest.mark.parametrize("kind", ["fifo", "device", "folder", "large"])
def test_only_regular_files_of_bounded_size_are_read(tmp_path, kind):
    path = tmp_path / "x.toml"
    if kind == "fifo":
        os.mkfifo(path)
    elif kind == "device":
        path.symlink_to("/dev/zero")
    elif kind == "folder":
        path.mkdir()
    else:
        with path.open("wb") as file:
            file.truncate(LARGEST + 1)
    said = {"large": "larger than 64 MiB", "folder": "a folder"}.get(kind, "not a regular file")
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match=said):
        read_bytes(path)
    assert len(os.listdir("/proc/self/fd")) == before
    with pytest.raises(StudyError, match=r"x.toml: cannot be read \("):
        load_study(path)


@pytest.mark.parametrize("text", [".".join("a" * 500) + " = 1", f"[{'.'.join('a' * 500)}]"])
def test_deep_tables_are_refused(tmp_path, text):
    (tmp_path / "x.toml").write_text(text)
    with pytest.raises(StudyError, match=f"nested deeper than {DEEPEST} levels"):
        load_study(tmp_path / "x.toml")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('{"a": 1, "a": 2}', "'a' occurs twice"),
        ("[" * 100 + "]" * 100, "nested deeper"),
        ("[" * 100_000, "nested deeper"),
        ('{"\\ud800": 1}', "is not text"),
        ("{", "Expecting"),
    ],
)
def test_json_that_no_reader_could_use(tmp_path, text, said):
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ValueError, match=said):
        read_json(tmp_path / "x.json")


def test_many_keys_take_no_long_time(tmp_path):
    names = ",".join(f'"k{k}": {k}' for k in range(60_000))
    (tmp_path / "x.json").write_text("{" + names + "}")
    began = time.perf_counter()
    with pytest.raises(StudyError, match="not a controller"):
        read_document(tmp_path / "x.json")
    assert time.perf_counter() - began < 5  # by comparing each with each: minutes


def test_npz_arrays_are_read_as_they_are(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3).T, "b": np.array(["x", "y"]), "c": np.array(1.5)}
    np.savez_compressed(tmp_path / "x.npz", **arrays, d=np.zeros((0, 3)), e=np.array([b"z"]))
    found = read_npz(tmp_path / "x.npz")
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
    assert found["d"].shape == (0, 3) and found["e"][0] == b"z"
    np.savez(tmp_path / "x.npz", a=np.array([{}], object))
    with pytest.raises(ValueError, match="allowed: numbers and text"):
        read_npz(tmp_path / "x.npz")


def elsewhere(file, folder):
    file["x"] = h5py.ExternalLink(str(folder / "other.h5"), "/x")


def virtual(file, folder):
    layout = h5py.VirtualLayout((3,), "f8")
    layout[:] = h5py.VirtualSource(str(folder / "other.h5"), "x", (3,))
    file.create_virtual_dataset("x", layout)


def raw(file, folder):
    file.create_dataset("x", (3,), "f8", external=[(str(folder / "raw"), 0, 24)])


def huge(file, _):
    file.create_dataset("x", (2**40,), "f8", chunks=(2**20,))


@pytest.mark.parametrize("make", [elsewhere, virtual, raw, huge])
def test_hdf5_files_keep_their_data_themselves(tmp_path, make):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = np.ones(3)
    (tmp_path / "raw").write_bytes(bytes(24))
    with h5py.File(tmp_path / "x.h5", "w") as file:
        make(file, tmp_path)
    refused = pytest.raises(ValueError, match="'x' (is a link|keeps its data|declares more)")
    with refused, open_hdf5(tmp_path / "x.h5"):
        pass


@pytest.mark.parametrize("length", [0, 2**64 - 16])
def test_texts_without_end_are_refused(tmp_path, length):
    """HDF5 adds the lengths of a heap's texts until it is at its end, and never gets there."""
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["x"] = ["some", "texts"]
    good = path.read_bytes()
    with open_hdf5(path) as file:
        assert file["x"].asstr()[()].tolist() == ["some", "texts"]
    first = good.index(b"GCOL") + 16
    number = min(length, 1)  # 0: free room
    text = struct.pack("<HHIQ", number, 1, 0, length)
    path.write_bytes(good[:first] + text + good[first + 16 :])
    with pytest.raises(ValueError, match="do not fit"), open_hdf5(path):
        pass


@pytest.mark.timeout(60)
def test_a_terabyte_without_content_is_read_at_once(tmp_path):
    path = tmp_path / "x.h5"
    with h5py.File(path, "w") as file:
        file["x"] = ["some", "texts"]
    with path.open("r+b") as longer:
        longer.truncate(2**40)  # takes no room
    with open_hdf5(path) as file:
        assert file["x"].asstr()[()].tolist() == ["some", "texts"]


@pytest.fixture(scope="module")
def sweep(tmp_path_factory):
    return originals("sweep folder", tmp_path_factory.mktemp("sweep") / "x")[0]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"results": 7}, "damaged (results is not a list)"),
        ({"given_up": {}}, "damaged (given_up is not a list)"),
        ({"spec": []}, "damaged (no sweep in it)"),
    ],
)
def test_forged_manifests_are_refused(tmp_path, sweep, change, said):
    manifest = read_manifest(sweep) | change
    (tmp_path / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(StudyError) as caught:
        read_manifest(tmp_path)
    assert said in str(caught.value)


def group(file):
    del file["status"]
    file.create_group("status")


def short(file):
    data = file["residual_rms"][:2]
    del file["residual_rms"]
    file["residual_rms"] = data


def no_spec(file):
    del file.attrs["spec"]


@pytest.mark.parametrize(
    ("change", "said"),
    [(group, "damaged"), (short, "residual_rms is not a table"), (no_spec, "spec")],
)
def test_forged_results_are_refused(tmp_path, sweep, change, said):
    """Even where the manifest vouches for them."""
    out = tmp_path / "out"
    shutil.copytree(sweep, out)
    with h5py.File(out / RESULTS, "r+") as file:
        change(file)
    manifest = read_manifest(out) | {"results": [file_hash(out / RESULTS)]}
    (out / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(StudyError, match=said):
        read_sweep(out)


def test_cases_that_its_sweep_does_not_have_are_refused(tmp_path, sweep):
    out = tmp_path / "out"
    shutil.copytree(sweep, out)
    manifest = read_manifest(out)
    manifest["spec"]["sweep"]["axes"]["gain"] = [0.1]
    with h5py.File(out / RESULTS, "r+") as file:
        file.attrs["spec"] = json.dumps(manifest["spec"])
    manifest["results"] = [file_hash(out / RESULTS)]
    (out / MANIFEST).write_text(json.dumps(manifest))
    with pytest.raises(StudyError, match="6 cases; its sweep has 2"):
        len(read_sweep(out).table)


def test_a_lock_that_is_a_pipe_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / LOCK)
    refused = pytest.raises(StudyError, match="cannot write there")
    with mutations.time_limit(5), refused, locked_folder(tmp_path, "sweep"):
        pass


def test_results_are_printed_in_any_encoding(sweep, monkeypatch):
    printed = io.BytesIO()
    monkeypatch.setattr("sys.stdout", io.TextIOWrapper(printed, encoding="ascii"))
    main(["show", str(sweep)])
    sys.stdout.flush()
    assert rb"\xb5m" in printed.getvalue()


def test_results_that_are_no_file_are_no_results(tmp_path, sweep, capsys):
    out = tmp_path / "out"
    shutil.copytree(sweep, out)
    (out / RESULTS).unlink()
    (out / RESULTS).symlink_to("/dev/zero")
    assert len(finished_cases(out).case_id) == 0
    with pytest.raises(SystemExit):
        main(["show", str(tmp_path / "nothing")])
    assert "not the folder of a sweep" in capsys.readouterr().err


def test_a_tuning_whose_columns_do_not_fit_is_damaged(tmp_path):
    (folder,) = originals("tuned folder", tmp_path / "originals")
    with h5py.File(folder / "tune.h5", "r+") as file:
        del file["objective"]
        file["objective"] = 1.0
        file["objective"].attrs.update({"units": "1", "long_name": "x"})
    with pytest.raises(StudyError, match="damaged .objective: not one value for each starting"):
        KINDS["tuned folder"].read(folder)
