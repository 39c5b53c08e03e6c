"""Results of a sweep as an xarray dataset and as a table: axes, units, words, and old formats."""

import json
import subprocess
import sys

import numpy as np
import pytest
import xarray

import studies
from campaigns.mutations import sweep_folder
from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.dataset import as_dataset
from studies.engine.results import _worst, metric_values, read_sweep
from studies.errors import StudyError
from studies.sweeps.show import best_cases, table
from tests.studies.sweeps.test_sweep_tables import GAINS, made_up, of_links, usual

GAIN, MODES = "control.gain_factor", "control.modes"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A finished sweep of three gains and two numbers of modes, and one without its last cases."""
    return sweep_folder(tmp_path_factory.mktemp("sweeps"))


def test_axes_of_a_grid_are_dimensions(folders):
    data, flat = studies.load(folders[0]).data, read_sweep(folders[0])
    assert data.residual_rms.dims == (GAIN, MODES, "link", "station")
    assert data[GAIN].values.tolist() == [0.1, 0.5, 1.0] and data[MODES].values.tolist() == [1, 2]
    for gain, modes, case in zip(flat[GAIN], flat[MODES], flat["case"], strict=True):
        chosen = data.sel({GAIN: gain, MODES: modes})
        assert chosen.case.item() == case and chosen.case_id.item() == flat["case_id"][case]
        for name in ("residual_rms", "gain_margin", "spectral_density"):
            np.testing.assert_array_equal(chosen[name].values, flat[name][case])


def test_links_and_modes_count_from_one_and_carry_units(folders):
    data = studies.load(folders[0]).data
    for name in ("link", "mode", "controlled_mode"):
        assert data[name].values.tolist() == [1, 2, 3]
    assert data.residual_rms.attrs["units"] == "m" and data.residual_rms.attrs["long_name"]
    assert data[GAIN].attrs["units"] == "1"
    values = read_sweep(folders[0])["residual_rms"][0, 2, 1]
    one = data.residual_rms.sel({GAIN: 0.1, MODES: 1, "link": 3}).isel(station=1)
    assert one.item() == values


def test_a_table_has_a_row_per_case_and_a_column_per_name(folders):
    frame, data = studies.load(folders[0]).table(), read_sweep(folders[0])
    assert frame.index.tolist() == list(range(6)) and frame.index.name == "case"
    assert set(METRICS) | {"case_id", GAIN, MODES, "status", "gain_margin"} <= set(frame.columns)
    np.testing.assert_array_equal(frame.residual_rms, metric_values(data, "residual_rms"))
    assert frame.loc[3, "gain_margin"] == data["gain_margin"][3]
    assert frame[[GAIN, MODES]].to_numpy().tolist()[3] == [0.5, 2]
    part = studies.load(folders[1]).table()
    assert part.status.value_counts().to_dict() == {"ok": 4, "not run yet": 2}
    assert part.residual_rms.isna().sum() == 2


def test_a_table_has_a_column_per_entry_of_a_placement():
    """Of many cases, too: all at once took 322 million rows."""
    axes = {"placement": {"kind": "mirrored"}}
    data = made_up({"method": "sobol", "count": 16, "axes": axes, "repeats": 2})
    frame = table(data)
    names = [x for x in frame.columns if x.startswith("patches.centers[")]
    assert len(frame) == 32 and len(names) >= 3 and set(frame["repeat"]) == {0, 1}
    np.testing.assert_array_equal(frame[names], data["patches.centers"].reshape(32, -1))


def test_an_unfinished_sweep_says_so_in_words(folders):
    data = studies.load(folders[1]).data
    words = data.status_text.values.ravel().tolist()
    assert words == ["ok"] * 4 + ["not run"] * 2
    assert data.status.values.ravel().tolist() == [status.OK] * 4 + [-1] * 2
    assert np.isnan(data.gain_margin.values.ravel()[4:]).all()


def test_statuses_are_words():
    codes = [0, status.UNSTABLE, -1, 0, 99, 0, 0, 0]
    words = as_dataset(usual(codes=codes)).status_text.values.tolist()
    unstable = status.REASONS[status.UNSTABLE]
    assert words[:5] == ["ok", unstable, "not run", "ok", "status 99"]


def test_plain_xarray_opens_the_file_of_a_sweep(folders):
    with xarray.open_dataset(folders[0] / "results.h5", engine="h5netcdf") as data:
        assert {"case", "case_id", "seed", "repeat", GAIN, MODES, "link"} <= set(data.coords)
        chosen = data.set_xindex(GAIN).sel({GAIN: 0.5})
        assert chosen[MODES].values.tolist() == [1, 2]
        margins = read_sweep(folders[0])["gain_margin"]
        np.testing.assert_array_equal(chosen.gain_margin.values, margins[2:4])
        assert "not_run" in data.status.attrs["flag_meanings"].split()
        assert len(data[["gain_margin", "status"]].to_dataframe()) == 6


def test_zipped_axes_lie_along_the_cases():
    data = as_dataset(made_up({"method": "zip", "axes": {"gain": GAINS, "drive.kd": GAINS}}))
    assert data.status.dims == ("case",) and data.sizes["case"] == 8
    assert data[GAIN].dims == data["drive.kd"].dims == ("case",)
    assert {GAIN, "drive.kd"} <= set(data.coords)


def test_a_sample_and_a_grid_with_gaps_lie_along_the_cases():
    span = {"from": 0.1, "to": 1.0}
    for sweep, count in (
        ({"method": "sobol", "count": 4, "axes": {"gain": span}}, 4),
        ({"axes": {"gain": [0.1, 0.2], "drive.kd": [1.0, 2.0]}, "where": "gain * 5 < drive.kd"}, 3),
    ):
        data = as_dataset(made_up(sweep))
        assert data.status.dims == ("case",) and data.sizes["case"] == count


def test_repeats_are_a_dimension():
    data = as_dataset(made_up({"repeats": 3, "axes": {"gain": [0.1, 0.2]}}))
    assert data.status.dims == (GAIN, "repeat") and data.seed.dims == (GAIN, "repeat")
    assert data.repeat.values.tolist() == [0, 1, 2]


def test_axes_that_stand_for_lists_have_one_dimension():
    axes = {
        "placement": {"kind": "same", "candidates": 6},
        "link_subsets": ["1", "1+3"],
        "gain": [1.0],
    }
    data = as_dataset(made_up(axes, peak_voltage=of_links(np.arange(1.0, 41.0))))
    assert data.peak_voltage.dims == ("placement", "link_subsets", GAIN, "link")
    assert data["patches.centers"].dims == ("placement", "patch")
    assert data["control.links"].dims == ("link_subsets", "link")
    assert data[GAIN].dims == (GAIN,) and data.placement.values[0] == 1
    chosen = data.sel(link_subsets="1+3")
    assert chosen["control.links"].values.tolist() == [True, False, True]


def test_best_cases_are_a_table():
    data = usual()
    frame = best_cases(data, "residual_rms", "gain <= 0.4", count=2)
    assert frame.index.tolist() == [3, 1] and frame.index.name == "case"
    assert frame.residual_rms.tolist() == [1e-6, 3e-6] and frame[GAIN].tolist() == [0.4, 0.2]
    assert frame.columns.tolist() == [
        "case_id",
        GAIN,
        "residual_rms",
        "peak_voltage",
        "damping_ratio[controlled_mode=1]",
        "gain_margin",
    ]
    assert frame.case_id.tolist() == data["case_id"][[3, 1]].tolist()


def test_what_a_folder_holds_has_tables_and_figures(folders):
    done = studies.load(folders[0])
    frame = done.best("residual_rms", count=3)
    values = read_sweep(folders[0])["residual_rms"].reshape(6, -1).max(axis=1)
    assert frame.index.tolist() == np.argsort(values)[:3].tolist()
    assert set(done.table().status) == {"ok"}
    assert done.plot("residual_rms", x="gain").axes


def test_commands_do_without_xarray_and_pandas(folders):
    """Importing them takes longer than what `show` and `best` do."""
    code = (
        "import sys\n"
        "from studies.cli import main\n"
        "for arguments in (['show', sys.argv[1]], ['best', sys.argv[1], '--by', 'gain_margin']):\n"
        "    try:\n"
        "        main(arguments)\n"
        "    except SystemExit:\n"
        "        pass\n"
        "print(sorted({'xarray', 'pandas'} & set(sys.modules)), file=sys.stderr)\n"
    )
    arguments = [sys.executable, "-c", code, str(folders[0])]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True, timeout=120)
    assert "by gain_margin" in done.stdout and done.stderr.strip() == "[]"


@pytest.mark.parametrize("version", [None, 1, 3])
def test_results_in_another_format_are_refused_in_one_sentence(folders, tmp_path, version):
    manifest = json.loads((folders[0] / "sweep.json").read_text())
    manifest.pop("format")
    if version is not None:
        manifest["format"] = version
    (tmp_path / "sweep.json").write_text(json.dumps(manifest))
    with pytest.raises(StudyError) as caught:
        studies.load(tmp_path)
    text = str(caught.value)
    assert text.startswith(f"{tmp_path}: its results have format {version or 1}, this version ")
    assert "run the sweep again" in text and manifest["git"] in text


def test_of_a_pose_x_and_y_count():
    """Its angle has another unit."""
    error = np.array([[1e-6, 2e-6, 5e-3], [3e-6, 1e-6, 0.0]])
    assert _worst(None, error, ("case", "pose_axis")).tolist() == [2e-6, 3e-6]
