"""The store: round trip, what xarray sees, what is refused, and that nothing half-written stays."""

import resource
import subprocess
import sys
import warnings

import h5py
import numpy as np
import pytest
import xarray

from studies import store
from studies.errors import StudyError, field_error, nearest, nearest_field
from studies.results.labelled import Variable
from studies.store import LazyArray, check_target, read_store, write_store

VARIABLES = {
    "case": Variable(np.array([10, 20, 30]), ("case",), "1", "number of the case"),
    "link": Variable(np.array(["first", "zweites é"]), ("link",), "1", "name of the link"),
    "peak": Variable(
        np.array([[1.0, np.nan], [2.0, -0.0], [np.inf, 3e-310]]),
        ("case", "link"),
        "m",
        "largest tip deflection",
    ),
    "history": Variable(
        np.linspace(0, 1, 24).reshape(3, 2, 4), ("case", "link", "sample"), "m", "tip deflection"
    ),
    "narrow": Variable(np.float32([0.1, 0.2, 0.3]), ("case",), "Hz", "single precision"),
    "is_stable": Variable(np.array([True, False, True]), ("case",), "1", "whether it settled"),
    "message": Variable(np.array(["", "x\ny", "ü"], dtype=object), ("case",), "1", "what failed"),
    "code": Variable(np.array([0, -1, 0]), ("case",), "1", "how it ended", {0: "ok", -1: "no_run"}),
    "span": Variable(np.float64(0.8), (), "s", "simulated time"),
}
ATTRIBUTES = {
    "title": "Größen",
    "note": "",
    "seed": 7,
    "gain": 0.1,
    "spec": "x" * 100_000,
    "gains": [1.5, 2.5],
    "names": ["a", "bb"],
} | {f"more_{i}": i for i in range(10)}


@pytest.fixture
def path(tmp_path):
    file = tmp_path / "results.nc"
    write_store(file, VARIABLES, ATTRIBUTES)
    return file


def leftovers(folder):
    return [entry.name for entry in folder.iterdir() if entry.name.endswith(".tmp")]


def test_read_store_returns_what_was_written(path):
    variables, attributes = read_store(path)
    for name, written in VARIABLES.items():
        assert variables[name][1:] == written[1:]
        np.testing.assert_array_equal(variables[name].data, written.data)
    assert variables["narrow"].data.dtype == np.float32
    assert variables["is_stable"].data.dtype == np.int8
    assert attributes.keys() == ATTRIBUTES.keys()
    for name, written in ATTRIBUTES.items():
        np.testing.assert_array_equal(attributes[name], written)


def test_axis_without_coordinate_gets_numbers_from_one(path):
    index = read_store(path)[0]["sample"]
    assert index.dims == ("sample",) and index.units == "1"
    np.testing.assert_array_equal(index.data, np.arange(1, 5))


def test_codes_carry_their_meanings(path):
    with h5py.File(path) as file:
        labels = dict(file["code"].attrs)
    assert labels["flag_values"].tolist() == [0, -1] and labels["flag_meanings"] == "ok no_run"
    assert read_store(path)[0]["code"].flags == {0: "ok", -1: "no_run"}


def test_full_disk_leaves_the_old_file_and_no_crash(path, tmp_path):
    """A limit on the size of files stands in for a full disk; HDF5 itself would crash on it."""
    before = path.read_bytes()
    wide = {"x": Variable(np.zeros(10**6), ("sample",), "m", "too much")}
    old = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, old[1]))
    try:
        with pytest.raises(StudyError, match="cannot write it"):
            write_store(path, wide, {})
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, old)
    assert path.read_bytes() == before and [p.name for p in tmp_path.iterdir()] == [path.name]


def test_a_store_can_be_written_again_from_what_was_read(path, tmp_path):
    again = tmp_path / "again.nc"
    write_store(again, *read_store(path))
    first, second = read_store(path)[0], read_store(again)[0]
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name].data, second[name].data)


def test_xarray_opens_it_without_warnings(path):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with xarray.open_dataset(path, engine="h5netcdf") as dataset:
            dataset.load()
    assert set(dataset.coords) == {"case", "link", "sample"}
    assert dict(dataset.sizes) == {"case": 3, "link": 2, "sample": 4}
    for name, written in VARIABLES.items():
        assert dataset[name].dims == written.dims
        labels = {k: v for k, v in dataset[name].attrs.items() if not k.startswith("flag_")}
        assert labels == {"units": written.units, "long_name": written.long_name}
        np.testing.assert_array_equal(dataset[name].values, written.data)
    assert dataset.attrs["title"] == ATTRIBUTES["title"]
    assert float(dataset["peak"].sel(case=20, link="first")) == 2.0


def test_names_of_fields_are_names_of_variables(tmp_path):
    names = ("control.gain_factor", "control.velocity_gain[0]", "residual_rms[link=2]")
    column = Variable(np.array([0.5, 1.0]), ("case",), "1", "a field")
    write_store(tmp_path / "a.h5", dict.fromkeys(names, column), {"coordinates": names[0]})
    assert set(names) < set(read_store(tmp_path / "a.h5")[0])
    with xarray.open_dataset(tmp_path / "a.h5", engine="h5netcdf") as dataset:
        assert set(dataset.coords) == {"case", names[0]} and set(dataset.data_vars) == {*names[1:]}
        chosen = dataset.set_xindex(names[0]).sel({names[0]: 1.0})
        assert chosen[names[1]].item() == 1.0


def test_rows_are_written_part_by_part(tmp_path, monkeypatch):
    """Data that memory does not hold; the same numbers as from an array."""
    values = np.linspace(0, 1, 60).reshape(20, 3)
    monkeypatch.setattr(store, "BLOCK_BYTES", 100)
    monkeypatch.setattr(store, "_IN_MEMORY", 100)
    parts = []

    def read(rows):
        parts.append(rows)
        return values[rows]

    wide = Variable(LazyArray(values.shape, values.dtype, read), ("case", "link"), "m", "x")
    write_store(tmp_path / "a.h5", {"x": wide}, {})
    assert [(rows.start, rows.stop) for rows in parts] == [(k, k + 4) for k in range(0, 20, 4)]
    np.testing.assert_array_equal(read_store(tmp_path / "a.h5")[0]["x"].data, values)


def test_failed_rename_keeps_the_old_file_and_no_temporary(path, monkeypatch):
    before = path.read_bytes()

    def fail(*_):
        raise OSError("no space left")

    monkeypatch.setattr(store.os, "replace", fail)
    with pytest.raises(StudyError, match="no space left"):
        write_store(path, VARIABLES, {})
    assert path.read_bytes() == before and leftovers(path.parent) == []


def test_full_disk_is_one_message_and_leaves_nothing(tmp_path):
    code = (
        "import resource, sys, numpy as np\n"
        "from studies.results.labelled import Variable\n"
        "from studies.store import StudyError, write_store\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))\n"
        "try: write_store(sys.argv[1], {'x': Variable(np.ones(100_000), ('n',), 'm', 'x')}, {})\n"
        "except StudyError as error: print('refused', error)\n"
    )
    target = tmp_path / "big.nc"
    done = subprocess.run(
        [sys.executable, "-c", code, str(target)], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"refused {target}: cannot write it")
    assert list(tmp_path.iterdir()) == []


def test_interrupt_leaves_no_temporary(tmp_path):
    with pytest.raises(KeyboardInterrupt), store.replacing(tmp_path / "table.csv") as temporary:
        temporary.write_text("half")
        raise KeyboardInterrupt
    assert list(tmp_path.iterdir()) == []


def test_unwritable_targets_are_refused(tmp_path):
    file = tmp_path / "file"
    file.write_text("")
    for target, words in (
        (tmp_path / "absent" / "a.nc", "create it first"),
        (file / "a.nc", "is not a folder"),
        (tmp_path, "name a file"),
        ("/dev/null", "name a file"),
    ):
        with pytest.raises(StudyError, match=words):
            check_target(target)
    check_target(file)


def test_a_link_is_written_through(tmp_path):
    (tmp_path / "real.nc").write_text("")
    (tmp_path / "link.nc").symlink_to(tmp_path / "real.nc")
    write_store(tmp_path / "link.nc", VARIABLES, {})
    assert (tmp_path / "link.nc").is_symlink()
    assert read_store(tmp_path / "real.nc")[0].keys() >= VARIABLES.keys()


def test_files_that_are_no_store_are_named(tmp_path):
    (tmp_path / "text.nc").write_text("no HDF5")
    with h5py.File(tmp_path / "plain.h5", "w") as file:
        file["x"] = np.arange(3)
    for name, words in (
        ("none.nc", "no such file"),
        ("text.nc", "not a store"),
        ("plain.h5", "not a store"),
    ):
        with pytest.raises(StudyError, match=f"{name}: {words}"):
            read_store(tmp_path / name)


def test_field_error_names_value_range_unit_and_nearest():
    hint = nearest("Modal_fitler", ["modal_filter", "shaper"])
    error = field_error("plant.length", 0.5, "0.1 to 0.3", "m", hint)
    assert isinstance(error, StudyError)
    assert str(error) == (
        "plant.length = 0.5; allowed: 0.1 to 0.3 [m]; did you mean 'modal_filter'?"
    )
    assert str(field_error("method", "", "rk4")) == "method = ''; allowed: rk4"
    assert nearest("zzz", ["modal_filter"]) == ""


@pytest.mark.parametrize(
    "guess, field",
    [
        ("control.sample_rate", "electronics.sample_rate_hz"),  # like control.ratio_source as whole
        ("control.gainfactor", "control.gain_factor"),  # of its own section
        ("kp", "drive.kp"),
        ("contol.gain_factor", "control.gain_factor"),
        ("ELECTRONICS.conditionr_gain", "electronics.conditioner_gain"),
        ("zzzz.zzzz", ""),
    ],
)
def test_nearest_field_of_a_guess_that_is_wrong_in_one_part(guess, field):
    names = ["control.ratio_source", "control.gain_factor", "electronics.conditioner_gain"]
    assert nearest_field(guess, [*names, "electronics.sample_rate_hz", "drive.kp"]) == field


def test_a_name_that_no_file_can_have_is_refused(tmp_path):
    with pytest.raises(StudyError, match="cannot write there"):
        check_target(tmp_path / ("x" * 300))
