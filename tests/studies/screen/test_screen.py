"""The linear model, and sweeps that it screens."""

import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.sampled_loop import closed_loop
from studies.engine import screen
from studies.engine.columns import LEFT_OUT, named
from studies.engine.executor import Executor
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import metric_values, read_sweep
from studies.engine.runs import _simulate
from studies.errors import StudyError
from studies.show.pages import page
from studies.space.table import build_table
from studies.study.cases import as_arrays, build_case, build_structure
from studies.sweeps.run import make_plan, run_sweep
from studies.sweeps.say import say, write_sweep_report
from studies.sweeps.screening import _rank_correlation, check_screen
from studies.sweeps.show import ranked_cases, recommended
from tests.bare import paper_study, parse_sweep
from tests.pages import text_of
from tests.studies.engine.test_sweeps import partly_done
from tests.studies.kernels.test_kernel import ALL_SORTS, check_equal
from tests.sweeps import HOME_PHI, narrow_blocks, small, small_spec

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
SCREEN = {"by": "residual_rms", "keep": 0.125}


def screened(count=64, **screen):
    return small_spec(SWEEP | {"count": count, "screen": SCREEN | screen})


def run(spec, out, **options):
    return run_sweep(spec, out, is_quiet=True, **options)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """The same cases: all of them in full, all linear, and screened."""
    top = tmp_path_factory.mktemp("screens")
    specs = {
        "full": small_spec(SWEEP),
        "linear": small_spec(SWEEP | {"fidelity": "linear"}),
        "screened": screened(),
    }
    for name, spec in specs.items():
        run(spec, top / name)
    return top


def read(folder):
    return read_sweep(folder)


def test_a_screen_runs_the_best_of_the_linear_model(folders):
    full, linear, found = (read(folders / name) for name in ("full", "linear", "screened"))
    by_linear = metric_values(linear, "residual_rms")
    is_fine = found["screen_status"] == status.OK
    assert (is_fine >= (linear["status"] == status.OK)).all()
    np.testing.assert_allclose(found["screen_value"][is_fine], by_linear[is_fine], rtol=1e-9)
    best = np.flatnonzero(is_fine)[np.argsort(by_linear[is_fine])][:8]
    is_run = found["status"] >= 0
    assert is_run[best].all() and 8 <= is_run.sum() <= 16
    assert set(found["status"][~is_run]) == {LEFT_OUT}
    for name in ("residual_rms", "gain_margin"):
        np.testing.assert_allclose(found[name][is_run], full[name][is_run], rtol=1e-9)
        assert np.isnan(found[name][~is_run]).all()


def test_linear_runs_are_judged_like_others(folders):
    full, linear = read(folders / "full"), read(folders / "linear")
    np.testing.assert_allclose(linear["gain_margin"], full["gain_margin"], rtol=1e-9)
    value, other = (metric_values(data, "residual_rms") for data in (full, linear))
    assert 0 < np.nanmax(np.abs(other / value - 1)) < 0.05  # 2 mm in 10 ms
    rms, without = (data.baseline["residual_rms"].data for data in (full, linear))
    assert 1e-3 < np.abs(without / rms - 1).max() < 0.1  # and so for the run without control
    assert "All runs are of the linear model" in text_of(page(say(linear)))


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


def test_the_report_compares_both_models(folders):
    data = read(folders / "screened")
    checked = check_screen(data)
    assert checked.n_passed >= 8 and checked.n_cases == 64
    assert 0 < checked.n_random <= 8 and checked.correlation > 0.9
    assert 0 < checked.n_found <= checked.n_good <= checked.n_random
    write_sweep_report(folders / "screened")
    text = text_of((folders / "screened" / "report.html").read_text(encoding="utf-8"))
    assert checked.text in text and "![screen]" in text and "left out by the screen" in text
    assert (folders / "screened" / "screen.png").is_file()
    assert check_screen(read(folders / "full")) is None


#: What a condition can ask for besides: small where the metric is, so that the best lack it.
ENDS = "residual_rms[link=1][station=1]"


def ends(data):
    return metric_values(data, ENDS)


def test_a_condition_sends_the_screen_further_down(tmp_path, folders):
    limit = float(np.nanquantile(ends(read(folders / "full")), 0.7))
    run(screened(subject_to=f"{ENDS} > {limit}"), tmp_path / "s")
    found = read(tmp_path / "s")
    is_met = (found["status"] == status.OK) & (ends(found) > limit)
    assert is_met.sum() >= 8 and (found["status"] >= 0).sum() > 16
    run(screened(subject_to=f"{ENDS} < 0"), tmp_path / "none")  # runs all there are
    write_sweep_report(tmp_path / "none")
    report = text_of((tmp_path / "none" / "report.html").read_text(encoding="utf-8"))
    assert f"None of them meets {ENDS} < 0" in report and "Best by residual_rms: case" in report
    found = read(tmp_path / "none")
    np.testing.assert_array_equal(found["status"] >= 0, found["screen_status"] == status.OK)


def test_what_is_recommended_meets_the_screens_condition(tmp_path, folders):
    """Also where cases that do not meet it rank better."""
    limit = float(np.nanmedian(ends(read(folders / "full"))))
    run(screened(subject_to=f"{ENDS} > {limit}"), tmp_path / "s")
    found = read(tmp_path / "s")
    value = ends(found)
    assert (value[recommended(found, "residual_rms")] > limit).all()
    assert not (value[ranked_cases(found, "residual_rms")] > limit).all()
    write_sweep_report(tmp_path / "s")
    text = text_of((tmp_path / "s" / "report.html").read_text(encoding="utf-8"))
    assert f'--subject-to "{ENDS} > {limit} and gain_margin >= 2"' in text


def test_cases_that_saturate_do_not_meet_the_screens_condition(monkeypatch, tmp_path):
    """Although they have metrics: without enough others, the screen goes further down."""
    spec = screened(subject_to="residual_rms < 1e-6")
    table, order = build_table(spec), np.arange(64)
    first = screen.first_round(table, order, spec)
    assert len(first.first) == 8

    def further(codes):
        arrays = {"status": np.array(codes), "residual_rms": np.full((8, 3, 3), 1e-9)}
        made_up = {x: named(x, a, "case") for x, a in arrays.items()}
        monkeypatch.setattr(screen, "gather", lambda *_: made_up)
        return screen.next_round(table, order, spec, first, tmp_path)

    assert further([status.OK] * 8) is None
    more = further([status.OK] * 7 + [status.SATURATED])
    assert more is not None and len(more.first) == 12  # 1.25 * 8 * 8 / 7


def test_a_screen_without_fields_has_the_defaults():
    assert small_spec(SWEEP | {"screen": {}}).screen.keep == 0.05


def test_equal_values_have_equal_ranks():
    ties = np.array([1.0, 1.0, 2.0, 3.0]), np.array([1.0, 2.0, 2.0, 4.0])
    assert _rank_correlation(*ties) == pytest.approx(0.8333, abs=1e-3)
    assert np.isnan(_rank_correlation(np.zeros(5), np.zeros(5)))


def test_an_interrupted_screen_goes_on_where_it_was(tmp_path, folders):
    spec, out = screened(), tmp_path / "s"
    with narrow_blocks(16):  # several chunks
        stopped = partly_done(out, spec)
    assert stopped.is_interrupted and stopped.n_run == 0
    assert (read(out)["status"] < 0).all()
    done = run(spec, out, is_resumed=True)
    assert not done.is_interrupted
    whole, found = read(folders / "screened"), read(out)
    np.testing.assert_array_equal(found["status"], whole["status"])
    for name in ("residual_rms", "gain_margin", "screen_value"):
        np.testing.assert_allclose(found[name], whole[name], rtol=1e-12)
    assert not (out / "chunks").exists() and not (out / "screen").exists()
    assert run(spec, out, is_resumed=True).n_run == 0


def test_a_screened_sweep_can_be_extended(tmp_path):
    out = tmp_path / "s"
    run(screened(32), out)
    before = read(out)
    done = run(screened(64), out, is_resumed=True)
    after = read(out)
    assert done.n_run > 0 and after.n_cases == 64
    kept = before["status"] >= 0
    np.testing.assert_array_equal(after["residual_rms"][:32][kept], before["residual_rms"][kept])
    assert (after["screen_status"] >= 0).all()
    for changed in ({"by": "residual_rms[link=1]"}, {"by": "-residual_rms"}):
        with pytest.raises(StudyError, match="sweep.screen.by"):
            run(screened(64, **changed), out, is_resumed=True)
    with pytest.raises(StudyError, match="sweep.fidelity"):
        run(small_spec(SWEEP | {"fidelity": "linear"}), out, is_resumed=True)


def test_nothing_may_pass(tmp_path, capsys):
    """Faults of either model keep their status, and the commands say so in a line."""
    from studies.cli import main

    spec = parse_sweep(
        small(
            SWEEP | {"screen": SCREEN}, metrics={"residual_delay": 0.0, "residual_length": 0.024}
        )  # beyond the run
    )
    run(spec, tmp_path / "s")
    assert set(read(tmp_path / "s")["status"]) == {status.WINDOW_TOO_LONG}
    write_sweep_report(tmp_path / "s")
    main(["show", str(tmp_path / "s")])
    assert "residual window" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("sweep", "message"),
    [
        ({"screen": {"keep": 0.0}}, "sweep.screen.keep = 0.0; allowed: a finite number > 0"),
        ({"screen": {"by": "gain_margin"}}, "sweep.screen.by"),
        ({"screen": {"by": "plant_energy"}}, "one of sweep.metrics"),
        ({"screen": SCREEN, "fidelity": "linear"}, "no screen with sweep.fidelity"),
        ({"screen": {"kept": 1}}, "did you mean 'sweep.screen.keep'"),
        ({"fidelity": "lin"}, "allowed: 'full' or 'linear'"),
        ({"screen": 3}, "sweep.screen"),
        ({"screen": SCREEN, "method": "morris", "count": 4}, "needs every case"),
        ({"screen": SCREEN | {"subject_to": "gain_margn > 2"}}, "did you mean 'gain_margin'?"),
        ({"screen": SCREEN | {"subject_to": "foo > 2"}}, "foo"),
        ({"screen": SCREEN | {"subject_to": "residual_rms[link=7] < 1"}}, "[link=1 to 3]"),
        ({"screen": SCREEN | {"subject_to": "plant_energy < 1"}}, "sweep.metrics does not keep it"),
        ({"screen": SCREEN | {"by": "residual_rms[link=4]"}}, "sweep.screen.by: 'residual_rms"),
    ],
)
def test_faults_of_a_screen_are_reported_before_any_run(sweep, message):
    with pytest.raises(StudyError) as fault:
        make_plan(small_spec(SWEEP | sweep))
    assert message in str(fault.value) and "\n" not in str(fault.value)


def test_the_plan_counts_both_models():
    plan = make_plan(screened())
    assert [g.structure.is_linear for g in plan.groups] == [True, False]
    assert [len(g.rows) for g in plan.groups] == [64, 8]
    assert [g.is_judged for g in plan.groups] == [False, True]


# --- at the edge where users work -----------------------------------------------------------------

BLOW = {
    "motion": {"waypoints": [[0.0, 0.0, HOME_PHI]]},
    "drive": {
        "pulse_force": [20.0, -10.0, 5.0],
        "pulse_start": 0.002,
        "pulse_length": 0.002,
    },
}
MOVE = {"motion": {"waypoints": [[0.0, 0.0, HOME_PHI], [0.0, 0.01, HOME_PHI]], "move_time": 0.03}}


@pytest.mark.long
@pytest.mark.parametrize("motion", [BLOW, MOVE], ids=["blow", "10 mm in 0.03 s"])
def test_ninety_of_the_best_hundred_survive_a_screen(tmp_path, motion):
    """20,000 placements and gains run in full, and a screen that keeps 5 %."""
    data = {
        "run": {"duration": 0.15},
        "link": {"modes": 8},
        "shaper": {"kind": "none"},
        "metrics": {"residual_delay": 0.02, "residual_length": 0.09},
        "sweep": {
            "method": "sobol",
            "count": 20000,
            "metrics": ["residual_rms"],
            "axes": {"placement": {"kind": "same"}, "gain": {"from": 0.1, "to": 2.0}},
        },
        **motion,
    }
    run(parse_sweep(data), tmp_path / "full")
    data["sweep"]["screen"] = {"by": "residual_rms", "keep": 0.05}
    run(parse_sweep(data), tmp_path / "screened")
    full, found = read(tmp_path / "full"), read(tmp_path / "screened")
    value = metric_values(full, "residual_rms")
    order = np.lexsort((found["screen_value"], found["screen_status"] != status.OK))
    passed = np.isin(np.arange(20000), order[:1000])
    for least in (1, 2):
        rows = np.flatnonzero((full["status"] == status.OK) & (full["gain_margin"] >= least))
        best = rows[np.argsort(value[rows])][:100]
        print(f"gain margin {least} or more: {passed[best].sum()} of the best 100 pass")
        assert passed[best].sum() >= 90
