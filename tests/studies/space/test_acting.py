"""Fields that nothing depends on: cases that differ in them alone are one, and their runs equal."""

from unittest.mock import patch

import numpy as np
import pytest

from jaxmodel.laws import LAWS
from jaxmodel.shaper import SHAPERS
from studies.engine.results import read_sweep
from studies.space import table as tables
from studies.space.table import build_table, designs
from studies.study.fields import _LAWS, _RULES, idle_axes
from studies.study.spec import Study
from studies.sweeps.dry_run import Estimate, axes_of
from tests.canonical import MACHINE
from tests.studies.test_cli import run
from tests.sweeps import narrow_blocks, run_sweep, small_spec

NONE = [False] * 3
#: What says that a field is idle, and another value of it.
IDLE = [
    ({"control.links": NONE}, "control.velocity_gain", [3.0, 0.5, 1.0]),
    ({"control.links": NONE}, "control.position_gain", [50.0, 0.0, 20.0]),
    ({"control.links": NONE}, "control.gain_factor", 0.5),
    ({"control.links": NONE}, "control.gain_unit", "1/s"),
    ({"control.links": NONE}, "control.ratios", [[1.0, 0.5, 0.2]] * 3),
    ({"control.links": NONE}, "control.ratio_exponent", 2.0),
    ({"control.links": NONE}, "control.mode_mask", [[True, False, True]] * 3),
    ({"control.links": NONE}, "control.damping", 0.02),
    ({"control.links": NONE}, "control.pole_decay", 40.0),
    ({"control.links": NONE}, "control.feedthrough_factor", 0.5),
    ({"control.links": NONE, "control.notch_hz": [900.0] * 3}, "control.notch_depth", [0.3] * 3),
    ({}, "control.notch_depth", [0.3] * 3),
    ({}, "control.notch_width", [0.3] * 3),
    ({"shaper.kind": "none"}, "shaper.tolerance", 0.2),
    ({"shaper.kind": "zvd"}, "shaper.tolerance", 0.2),
    ({"shaper.kind": "none"}, "shaper.frequencies_hz", [90.0]),
    ({"shaper.kind": "none"}, "shaper.damping_ratio", 0.2),
    ({"shaper.kind": "none"}, "shaper.split", "exact"),
    ({}, "electronics.difference_cutoff_hz", 700.0),
    ({"electronics.estimator": "difference"}, "electronics.lowpass_ratio", [3.0]),
    ({"electronics.estimator": "difference"}, "electronics.lowpass_zeta", [0.4]),
    ({"electronics.estimator": "difference"}, "electronics.highpass_hz", 9.0),
    ({}, "patches.gauge_gain", 40.0),
    ({}, "patches.gauge_noise", 0.1),
    ({"patches.sensor": "strain_gauge"}, "electronics.sensor_highpass_hz", 5.0),
    ({}, "drive.friction_speed", 0.5),
    ({}, "machine.joint_friction_speed", 0.5),
]
IDS = [f"{name} {' '.join(given)}" for given, name, _ in IDLE]


def cases_of(idle):
    return [given | more for given, name, value in idle for more in ({}, {name: value})]


BASE = MACHINE | {"shaper": {"kind": "none", "frequencies_hz": [80.0]}}


def spec_of(idle, **sections):
    # with the default gains, in whose place `control.damping` may stand
    control = {"velocity_gain": list(Study().control.velocity_gain)} | sections.pop("control", {})
    return small_spec(
        {"method": "list", "cases": cases_of(idle)}, **BASE | sections, control=control
    )


@pytest.mark.parametrize("idle", IDLE, ids=IDS)
def test_cases_that_differ_in_nothing_that_acts_are_one(idle):
    table = build_table(spec_of([idle]))
    assert (len(table), table.n_double) == (1, 1)
    assert len(build_table(spec_of([idle]), has_ids=False)) == 1


def test_every_rule_has_a_case():
    assert all(any(x[1].startswith(names) for x in IDLE) for _, _, names in _RULES)


#: Of a pair that differs in what acts, for the comparison below.
ACTING = ({"control.links": [True, False, False]}, "control.gain_factor", 0.5)


def equal_runs(spec, folder):
    """Whether the two cases of each pair have equal results, up to rounding; all are run."""
    with patch.object(tables, "acting_columns", lambda _, columns: columns), narrow_blocks():
        run_sweep(spec, folder)
        data = read_sweep(folder)
        origin = data.table.origin
    assert np.all(origin[::2] != origin[1::2])
    names = data.variables.keys() - {"case", "case_id", "seed", *data.table.columns}
    is_equal = np.ones(len(origin) // 2, bool)
    for variable in map(data.variables.__getitem__, names):
        if variable.dims[:1] == ("case",):
            rows = variable.data[origin].reshape(len(origin), -1)
            is_equal &= np.isclose(rows[::2], rows[1::2], 1e-9, 1e-14, equal_nan=True).all(axis=1)
    return is_equal.tolist()


@pytest.mark.long  # in short: the same cases are one, above
def test_runs_of_such_cases_are_equal_and_others_are_not(tmp_path):
    found = equal_runs(spec_of([*IDLE, ACTING]), tmp_path / "runs")
    assert [IDS[k] for k in range(len(IDLE)) if not found[k]] == [] and not found[-1]


@pytest.mark.long  # the same with the other laws, a program each
@pytest.mark.parametrize("law", sorted(_LAWS - {"imsc", "state_space"}))
def test_gains_of_every_law_act_on_controlled_links_only(law, tmp_path):
    gains = IDLE[:3] if law in ("srf", "lqr", "lqg", "observer") else IDLE[:7]
    own = {f"control.laws.{law}.{x.name}": 0.9 * x.default for x in LAWS[law].parameters}
    gains = gains + [({"control.links": NONE}, name, value) for name, value in own.items()]
    found = equal_runs(spec_of([*gains, ACTING], control={"law": law}), tmp_path / "runs")
    assert all(found[:-1]) and not found[-1]


def test_laws_and_shapers_are_those_of_the_package():
    assert set(LAWS) >= _LAWS
    assert set(SHAPERS) == {"none", "zv", "zvd", "zvdd", "ei", "ei_damped", "ei2", "ei3"}


def test_what_acts_in_some_cases_makes_cases_there():
    """No link controlled: one case for all gains. An own field: where its law is selected."""
    axes = {"link_subsets": ["none", "1"], "gain": [0.5, 1.0, 2.0]}
    table = build_table(small_spec({"axes": axes}))
    assert (len(table), table.n_double) == (1 + 3, 2)
    axes = {"control.law": ["imsc", "ppf"], "control.laws.ppf.filter_damping": [0.3, 0.5, 0.6]}
    assert len(build_table(small_spec({"axes": axes}))) == 1 + 3
    axes = {"link_subsets": ["none", "1"], "placement": {"kind": "same", "candidates": 6}}
    assert build_table(small_spec({"axes": axes})).n_double == 0  # sensors are moved


def test_a_case_is_the_one_of_a_sweep_without_what_is_idle():
    few = build_table(small_spec({"axes": {"link_subsets": ["none"]}}))
    many = build_table(small_spec({"axes": {"link_subsets": ["none"], "gain": [0.5, 2.0]}}))
    assert few.case_id.tolist() == many.case_id.tolist()
    assert few.seed.tolist() == many.seed.tolist()


def test_designs_that_differ_in_nothing_that_acts_are_one():
    listed = [{"control.gain_factor": g, "load.mass": m} for g, m in ((1.0, 0.0), (2.0, 0.1))]
    sweep = {"method": "list", "cases": listed, "environments": ["load.mass"]}
    off = build_table(small_spec(sweep, control={"links": NONE}))
    assert designs(off, ["load.mass"]).tolist() == [0, 0]
    on = build_table(small_spec(sweep))
    assert len({*designs(on, ["load.mass"]).tolist()}) == 2


def test_a_law_of_a_user_may_read_anything():
    with patch("studies.study.fields._LAWS", _LAWS - {"imsc"}):
        assert build_table(spec_of(IDLE[:1])).n_double == 0


def test_axes_that_nothing_depends_on_are_named():
    axes = {"shaper.tolerance": [0.05, 0.1], "gain": [0.5, 2.0]}
    spec = small_spec({"axes": axes})  # zv
    table = build_table(spec)
    told = ["no metric depends on shaper.tolerance with shaper.kind zv"]
    assert idle_axes(table.study, table.columns) == told and table.n_double == 2


def test_dry_run_tells_them_and_each_axis_once(tmp_path, capsys, monkeypatch):
    nothing = Estimate(0.0, 0.0, 0.0, 0)
    monkeypatch.setattr("studies.sweeps.dry_run.estimate", lambda plan: nothing)
    path = tmp_path / "sweep.toml"
    path.write_text("""
[shaper]
kind = "none"
[sweep]
axes = { link_subsets = ["none"], gain = [0.5, 2.0] }
""")
    code, out, _ = run(capsys, "sweep", path, "--dry-run")
    assert code == 0 and "1 case (0 left out by where, 1 duplicates, " in out
    assert "no metric depends on control.gain_factor with control.links false" in out
    table = build_table(small_spec({"axes": {"link_subsets": "all"}}))
    assert [x.name for x in axes_of(table)] == ["link_subsets"]
