"""The linear model, and sweeps by it."""

import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.sampled_loop import closed_loop
from studies.engine.executor import Executor
from studies.engine.fidelity import rank_correlation
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import metric_values, read_sweep
from studies.engine.runs import _simulate
from studies.show.pages import page
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case, build_structure
from studies.sweeps.say import report_of
from tests.bare import paper_study
from tests.pages import text_of
from tests.studies.kernels.test_kernel import ALL_SORTS, check_equal
from tests.sweeps import HOME_PHI, narrow_blocks, run_sweep, small_spec

jax = pytest.importorskip("jax")
HOME = (0.0, 0.0, HOME_PHI)


@pytest.fixture(scope="module", autouse=True)
def narrow():
    with narrow_blocks():
        yield


def residual(study, is_linear):
    """Residual rms at the middle of each link [m], (3,)."""
    structure = build_structure(study)._replace(is_linear=is_linear, metrics=("residual_rms",))
    result = _simulate(structure, as_arrays(build_case(study)), False)
    assert int(result.status) == status.OK
    return np.asarray(result.metrics.residual_rms)[:, 1]


def blow(size):
    return {
        "motion__waypoints": (HOME,),
        "drive__pulse_force": (20.0 * size, -10.0 * size, 5.0 * size),
        "drive__pulse_start": 0.002,
        "drive__pulse_length": 0.002,
    }


def move(size):
    return {"motion__waypoints": (HOME, (0.0, 0.01 * size, HOME_PHI)), "motion__move_time": 0.03}


SHORT = {
    "run__duration": 0.08,
    "run__smooth": True,
    "link__modes": 2,
    "control__modes": 2,
    "shaper__kind": "none",
    "metrics__residual_delay": 0.005,
    "metrics__residual_length": 0.03,
}


def difference(changes):
    """Of the linear model from the full one, as a share of the largest residual."""
    study = paper_study().change(**SHORT, **changes)
    full, linear = residual(study, False), residual(study, True)
    return np.max(np.abs(linear - full)) / np.max(full)


@pytest.mark.parametrize(
    ("motion", "changes"),
    [
        (blow, {}),
        pytest.param(blow, {"load__wrench": (20.0, 10.0, 0.3)}, marks=pytest.mark.long),
        pytest.param(blow, {"link__basis": "pinned_free"}, marks=pytest.mark.long),
        pytest.param(blow, {"run__model": "ked"}, marks=pytest.mark.long),
        pytest.param(blow, {"control__feedback": "ideal"}, marks=pytest.mark.long),
        pytest.param(move, {"drive__kind": "computed_torque"}, marks=pytest.mark.long),
    ],
    ids=["blow", "load", "pinned_free", "ked", "ideal", "computed torque"],
)
def test_errors_of_the_linear_model_shrink_with_the_motion(motion, changes):
    """What is left out is of second order, so that the error falls at least with the size."""
    small_one, large_one = (difference(motion(size) | changes) for size in (1e-3, 1e-2))
    assert large_one < 5e-3
    assert 0 < small_one < 0.2 * large_one


def test_the_linear_model_is_good_enough_at_the_edge():
    """10 mm in 0.03 s; linearised at the start, or without axial forces, it is 10 to 20 % off."""
    assert difference(move(1.0)) < 0.03


@pytest.mark.long
def test_the_linear_model_has_the_poles_of_the_loop_matrices():
    """Free vibration sample by sample against powers of the exactly discretised matrix."""
    start = tuple((1e-5, 2e-6) for _ in range(3))
    study = paper_study().change(
        **SHORT
        | {"run__duration": 0.03, "metrics__residual_delay": 0.0, "metrics__residual_length": 0.02},
        motion__waypoints=(HOME,),
        initial__modal=start,
        electronics__adc_bits=24,
    )
    structure = build_structure(study)._replace(is_linear=True)
    case = as_arrays(build_case(study))
    record = _simulate(structure, case, True).record
    found = np.asarray(record.chord_deflection_stations).reshape(len(record.time), -1)
    matrices = closed_loop(structure, case, np.array(HOME))
    transition = np.asarray(matrices.open + matrices.feedback)
    x, modes, n_sensors = np.zeros(len(transition)), np.ravel(start), 9
    x[6 : 6 + modes.size] = modes
    begins = 6 + 2 * modes.size  # the filters start settled on the sensors' voltages
    sensor = np.asarray(jax.jit(_sensor_rows, static_argnums=0)(structure, case))
    x[begins : begins + n_sensors] = sensor @ x[: 6 + 2 * modes.size]
    rows, wanted = np.asarray(matrices.deflection), []
    for _ in range(len(found)):
        wanted.append(rows @ x)
        x = transition @ x
    np.testing.assert_allclose(found, wanted, atol=2e-4 * np.abs(found).max())
    assert np.abs(found[-1]).max() < 0.2 * np.abs(found[0]).max()


def _sensor_rows(structure, case):
    from jaxmodel.linear import linearise
    from jaxmodel.prepare import prepare

    return linearise(structure, prepare(structure, case).loop, np.array(HOME)).sensor


# --- sweeps ---------------------------------------------------------------------------------------

SWEEP = {
    "method": "sobol",
    "count": 64,
    "metrics": ["residual_rms"],
    "axes": {"placement": {"kind": "same"}, "gain": {"from": 0.02, "to": 0.5, "scale": "log"}},
}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same cases by either model."""
    top = tmp_path_factory.mktemp("screens")
    specs = {
        "full": small_spec(SWEEP),
        "linear": small_spec(SWEEP | {"fidelity": "linear"}),
    }
    for name, spec in specs.items():
        run_sweep(spec, top / name)
    return top


def read(folder):
    return read_sweep(folder)


def test_linear_runs_are_judged_like_others(folders):
    full, linear = read(folders / "full"), read(folders / "linear")
    np.testing.assert_allclose(linear["gain_margin"], full["gain_margin"], rtol=1e-9)
    value, other = (metric_values(data, "residual_rms") for data in (full, linear))
    assert 0 < np.nanmax(np.abs(other / value - 1)) < 0.05  # 2 mm in 10 ms
    rms, without = (data.baseline["residual_rms"].data for data in (full, linear))
    assert 1e-3 < np.abs(without / rms - 1).max() < 0.1  # and so for the run without control
    assert "All runs are of the linear model" in text_of(page(report_of(linear)))


@pytest.mark.parametrize("sorts", ["few", pytest.param("all", marks=pytest.mark.long)])
def test_kernel_equals_scan_for_the_linear_model(folders, sorts):
    """The few are those of the folders, so that their kernel has been compiled."""
    spec, metrics = small_spec(SWEEP), SWEEP["metrics"]
    if sorts == "all":
        spec, metrics = (
            small_spec(ALL_SORTS, metrics={"residual_delay": 0.0, "residual_length": 0.004}),
            ["residual_rms"],
        )
    table = build_table(spec)
    rows = np.arange(len(table))
    group = plan_groups(table, rows, local_layout, tuple(metrics), is_linear=True)[0]
    cases = chunk_cases(table, rows, group.structure, group.layout.size)
    fast, reference = (
        Executor(group.structure, group.layout, kind=kind).start(cases).wait()
        for kind in ("kernel", "scan")
    )
    assert np.sum(reference.status == status.OK) >= 8
    check_equal(fast, reference)


def test_a_linear_sample_takes_far_fewer_operations(folders):
    spec, found = small_spec(SWEEP), []
    table, rows = build_table(spec), np.arange(64)
    for is_linear in (False, True):  # as in the folders, so already compiled
        (group,) = plan_groups(table, rows, local_layout, spec.sweep.metrics, is_linear)
        made = Executor(group.structure, group.layout, kind="kernel")
        made.start(chunk_cases(table, rows, group.structure, group.layout.size)).wait()
        found.append(made.operations)
    full, linear = (sum(x.values()) - x["read"] for x in found)
    assert 0 < linear < 0.7 * full
    assert found[1]["reciprocal"] <= 3 and found[1]["sqrt"] == 0 < found[0]["sqrt"]


def test_equal_values_have_equal_ranks():
    ties = np.array([1.0, 1.0, 2.0, 3.0]), np.array([1.0, 2.0, 2.0, 4.0])
    assert rank_correlation(*ties) == pytest.approx(0.8333, abs=1e-3)
