"""`studies laws`: candidates, what they are judged on, and whether an order is certain."""

import json
from dataclasses import replace
from threading import Event
from time import sleep
from types import SimpleNamespace
from unittest import mock

import jax
import jsonschema
import numpy as np
import pytest

from jaxmodel.drives import DRIVES
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import check_law
from jaxmodel.loop_figures import MARGINS
from jaxmodel.table import PartError
from studies.documents import schema
from studies.engine.chunks import distinct_loops, judge_cases
from studies.engine.columns import named
from studies.engine.margins import judge_loops
from studies.engine.results import SweepData
from studies.errors import StudyError
from studies.laws import candidates, judging
from studies.laws import run as laws
from studies.laws.candidates import (
    AS_GIVEN,
    Contender,
    _drive_candidate,
    drive_candidates,
    law_candidate,
    law_candidates,
)
from studies.laws.findings import Combination, beyond_budget, find, verdict
from studies.laws.judging import (
    FIGURES,
    MOVES,
    SHOWN,
    Judged,
    breaking_text,
    changes,
    judging_sweep,
    longer,
    read_judged,
)
from studies.laws.machines import machines_of, spread_of, with_noise
from studies.laws.ranking import rank
from studies.laws.say import say
from studies.laws.tuning import (
    Budget,
    Quality,
    Tuned,
    _quality,
    make_budget,
    tune_candidate,
    tuning_of,
)
from studies.laws.verb import compare
from studies.results.labelled import plain
from studies.space.table import build_table
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from studies.study.spec import Study
from studies.study.window import with_window
from studies.tuning.optimise import _fresh_progress
from tests.bare import paper_study, parse_study
from tests.canonical import MACHINE, study_of
from tests.jobs import quiet_job
from tests.pages import tables_of

#: A run long enough for control to tell.
STUDY = study_of(MACHINE, run__duration=0.12, motion__move_time=0.05, metrics__residual_length=0.03)
STUDY = with_window(STUDY.change(metrics__residual_delay=paper_study().metrics.residual_delay))


@pytest.fixture(scope="module")
def own_law():
    """The candidate with the study's own law."""
    return law_candidate(STUDY, LAWS[STUDY.control.law])


def test_ratios_are_geometric_means_and_certain_ones_stay_apart():
    rng = np.random.default_rng(0)
    size = np.exp(rng.normal(size=(1, 40, 3)))  # of machine and move, the same for all
    noise = np.exp(0.1 * rng.normal(size=(3, 40, 3)))
    ranking = rank(size * noise * np.array([2.0, 1.0, 1.001]).reshape(3, 1, 1))
    assert ranking.ratio[0] == pytest.approx(2.0, rel=0.05)
    assert not ranking.is_tied[0] and ranking.low[0] > 1.8
    assert ranking.is_tied[1] and ranking.is_tied[2]
    assert ranking.share.sum() == pytest.approx(1.0) and ranking.share[0] == 0


def test_an_interval_covers_the_true_ratio_as_often_as_it_says():
    hits = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        figure = np.exp(0.3 * rng.normal(size=(2, 25, 1))) * np.array([1.0, 1.5]).reshape(2, 1, 1)
        ranking = rank(figure, seed)
        hits += ranking.best == 0 and ranking.low[1] <= 1.5 <= ranking.high[1]
    assert 88 <= hits <= 99  # 95 % of 100, and bootstrap intervals are a little short


def test_an_interval_is_of_95_percent():
    """Of many machines, 1.96 standard deviations of the mean to either side."""
    noise = np.random.default_rng(0).normal(size=400)
    figure = np.exp([np.zeros(400), 1 + 0.3 * noise / noise.std()])[:, :, None]
    ranking = rank(figure)
    width = np.log(ranking.high[1] / ranking.low[1])
    assert width == pytest.approx(2 * 1.96 * 0.3 / np.sqrt(400), rel=0.06)


def test_a_lost_run_takes_a_controller_out():
    ranking = rank(np.array([[[1.0], [np.nan]], [[2.0], [2.0]]]))
    assert ranking.best == 1 and np.isnan(ranking.ratio[0]) and ranking.share[0] == 0
    assert rank(np.full((2, 2, 1), np.nan)).best == -1


def test_every_law_and_drive_is_a_candidate(own_law):
    """Without state_space, with the design's law twice."""
    with mock.patch.object(
        candidates, "law_candidate", lambda _, law: own_law._replace(name=law.name)
    ):
        found = {x.name: x.free for x in law_candidates(STUDY)}
    given = found.pop(f"{LAWS['imsc'].text}, {AS_GIVEN}")
    assert set(found) == set(LAWS) - {"state_space"}
    assert {x.partition("[")[0] for x in set(own_law.free) - set(given)} == {"control.ratios"}
    with mock.patch.object(candidates, "_decisive", lambda *_: []):
        drives = drive_candidates(STUDY)
    assert [x.settings["drive.kind"] for x in drives] == list(DRIVES)
    own_drive = _drive_candidate(STUDY, DRIVES[STUDY.drive.kind])
    assert set(own_drive.free) == {"drive.kp", "drive.kd"}
    assert_tunable(own_law)


@pytest.mark.long
def test_every_candidate_is_tunable_by_its_own_numbers():
    for candidate in (*law_candidates(STUDY), *drive_candidates(STUDY)):
        assert_tunable(candidate)


def assert_tunable(candidate):
    spec = tuning_of(STUDY, candidate, Budget(50.0, 0.4))
    (family,) = spec.moving
    free = {spec.free.numbers[k].key for k in np.flatnonzero(family.is_free)}
    assert free == set(candidate.free)


def test_all_controllers_meet_the_same_machines_and_moves():
    machines = machines_of(STUDY, 5, 1)
    designs = [STUDY, STUDY.change(control__law="lqg"), STUDY.change(drive__kp=1e4)]
    table = build_table(judging_sweep(STUDY, designs, machines))
    assert len(table) == 3 * 5 * len(MOVES)
    stiffness = table.columns["link.stiffness_factor"].reshape(3, 5, len(MOVES), 3)
    np.testing.assert_array_equal(stiffness, np.broadcast_to(stiffness[:1], stiffness.shape))
    assert np.all(np.abs(stiffness - 1) <= 0.05) and np.ptp(stiffness[0, :, 0]) > 0.05
    mass = table.values("machine.platform_mass") / STUDY.machine.platform_mass
    assert 0.8 <= mass.min() < mass.max() <= 1.2


def test_machines_differ_in_what_a_design_has():
    assert set(spread_of(STUDY)) == {"link.stiffness_factor", "machine.platform_mass"}
    loaded = STUDY.change(
        load__mass=0.1,
        link__basis="loaded",
        link__joint_inertia_c=1e-5,
        load__wrench=(1.0, 0.0, 0.0),
    )
    assert set(spread_of(loaded)) == {*spread_of(STUDY), "load.mass", "link.joint_inertia_c"}
    machines = machines_of(loaded, 4, 0)
    inertia = np.array([machine["link.joint_inertia_c"] for machine in machines])
    assert inertia.shape == (4, 3) and np.all(np.abs(inertia / 1e-5 - 1) <= 0.2)
    assert len({machine["run.seed"] for machine in machines}) == 4
    own = loaded.machine.platform_mass + loaded.load.mass
    for machine in machines:  # computed torque goes on to assume what the design says
        true = machine["machine.platform_mass"] + machine["load.mass"]
        assert machine["drive.model_mass"] * true == pytest.approx(own)


def test_noise_is_that_of_the_design_or_one_step_of_its_converter():
    electronics = STUDY.electronics
    step = electronics.adc_range / 2**electronics.adc_bits
    assert with_noise(STUDY).electronics.adc_noise == step
    noisy = STUDY.change(electronics__adc_noise=1e-3)
    assert with_noise(noisy) == noisy


def assert_kept(law):
    """A law on a design with specified poles."""
    gain = Study().control.velocity_gain  # as by default: the damping decides
    placed = STUDY.change(control__damping=0.1, control__velocity_gain=gain)
    candidate = law_candidate(placed, law)
    assert candidate.study(placed).control.law == candidate.settings["control.law"] == law.name
    tuning_of(placed, candidate, Budget(50.0, 0.4))


@pytest.mark.parametrize("name", ["srf", "ppf"])
def test_specified_poles_leave_out_no_law(name):
    """Of patches and of modes whose poles it cannot place, with its own numbers alone."""
    with mock.patch.object(candidates, "_decisive", lambda *_: []):
        assert_kept(LAWS[name])


@pytest.mark.long
def test_specified_poles_leave_out_no_law_at_all():
    for name in set(LAWS) - {"state_space"}:
        assert_kept(LAWS[name])


def test_the_slowest_move_fits_into_the_run():
    study = STUDY.change(run__duration=0.095)
    assert longer(study).run.duration == pytest.approx(0.095 + 0.25 * 0.05)
    parse_study(
        longer(study).model_dump() | {"motion": study.motion.model_dump() | {"move_time": 0.0625}}
    )


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"control__feedback": "ideal"}, "control.feedback"),
        ({"control__links": (False, False, False)}, "control.links"),
        ({"control__gain_factor": 0.0}, "control.gain_factor"),
    ],
)
def test_a_design_without_controller_is_refused(fields, message, tmp_path):
    with pytest.raises(StudyError, match=message):
        compare(STUDY.change(**fields), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_damaged_tuning_is_not_a_law_that_fails(own_law, tmp_path):
    file = tmp_path / "imsc.npz"
    file.write_bytes(b"no archive")
    with pytest.raises(StudyError, match="damaged"):
        tune_candidate(STUDY, own_law, Budget(50.0, 0.4), file, print)


def test_a_tuning_that_fails_ends_those_beside_it(tmp_path):
    begun, ended = Event(), Event()

    def tune(study, candidate, budget, file, say):
        if candidate.name == "bad":
            assert begun.wait(10)
            raise StudyError("bad")
        begun.set()
        try:
            for _ in range(100):
                say("an iteration")
                sleep(0.02)
        except KeyboardInterrupt:
            ended.set()
            raise

    pair = [Contender(name, {}, {}, {}) for name in ("bad", "good")]
    told = quiet_job(tmp_path, ("tune",))
    with (
        mock.patch.multiple(
            laws, law_candidates=lambda _: pair, drive_candidates=lambda _: [], tune_candidate=tune
        ),
        pytest.raises(StudyError, match="bad"),
    ):
        laws._tune(STUDY, Budget(50.0, 0.4), told, None)
    assert ended.wait(5)


def test_what_says_how_far_a_tuning_has_come(own_law):
    spec = tuning_of(STUDY, own_law, Budget(50.0, 0.4, starts=3, iterations=8))
    p = len(spec.free.numbers)
    at = _fresh_progress(spec, np.full((3, p), 0.5))
    place = np.full((3, p), 0.5)
    place[0, -1] = 1.0
    objective = np.full((8, 3), 0.9)
    objective[2], objective[7] = 0.625, (0.5, 0.52, 0.55)
    violation = np.zeros_like(objective)
    objective[6], violation[6] = 0.1, 0.5  # does not count
    at = at._replace(
        iteration=np.array(8),
        best_place=place,
        best_objective=np.array([0.5, 0.52, 0.55]),
        best_limits=np.full_like(at.best_limits, -0.1),
        history=np.stack([objective, violation], axis=-1),
    )
    wanted = Quality(0.5, 2, 0.2, (spec.free.numbers[-1].name,))
    found = _quality(spec, at)
    assert plain(found.replace(late_gain=round(found.late_gain, 12))) == plain(wanted)
    unkept = at._replace(history=np.stack([objective, violation + 1], axis=-1))
    assert np.isnan(_quality(spec, unkept).late_gain)


def test_changes_rebuild_a_design():
    other = STUDY.change(
        control__law="lqg", control__laws={"lqg": {"voltage_weight": 1e-7}}, drive__kd=50.0
    )
    assert changes(STUDY, other) == {
        "control.law": "lqg",
        "control.laws.lqg.voltage_weight": 1e-7,
        "drive.kd": 50.0,
    }


def test_cases_that_differ_in_motion_alone_share_a_loop():
    columns = {
        "motion.move_time": np.array([0.05, 0.04, 0.05, 0.04]),
        "control.gain_factor": np.array([0.5, 0.5, 1.0, 1.0]),
        "run.seed": np.arange(4),
    }
    structure = build_structure(STUDY)
    cases = build_cases(STUDY, columns, structure)
    first, own = distinct_loops(cases)
    np.testing.assert_array_equal(first, [0, 2])
    np.testing.assert_array_equal(own, [0, 0, 1, 1])
    whole = jax.tree.map(lambda x: np.broadcast_to(x, (4, *x.shape[1:])), cases)
    found, wanted = judge_cases(structure, cases), judge_loops(structure, whole)
    np.testing.assert_allclose(found.gain_margin, wanted.gain_margin, rtol=1e-6)
    np.testing.assert_allclose(found.least_damping, wanted.least_damping, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("drive.kp", [2e4, 2e4, 1e4]),
        ("electronics.antialias_hz", [2e3, 2e3, 1e3]),
        ("load.mass", [0.0, 0.0, 0.1]),
        ("link.modes", [3, 3, 2]),
    ],
)
def test_cases_that_differ_in_their_machine_have_loops_of_their_own(name, values):
    columns = {name: np.array(values)}
    first, own = distinct_loops(build_cases(STUDY, columns, build_structure(STUDY, columns)))
    np.testing.assert_array_equal(first, [0, 2])
    np.testing.assert_array_equal(own, [0, 0, 1])


def test_what_breaks_is_told_of_the_machine_with_the_least_gain_margin():
    machine = np.repeat([0, 1, 2], len(MOVES))  # of each case
    columns = {
        "gain_margin": np.array([np.nan, 3.0, 1.5])[machine],
        "breaking_mode": np.array([np.nan, 1.0, 2.0])[machine],
        "breaking_frequency": np.array([np.nan, 100.0, 200.0])[machine],
        "pose_error_peak": np.zeros((9, 3)),
        "pose_error_rms": np.zeros((9, 3)),
    }
    names = (*MARGINS, "status", *FIGURES, *SHOWN)
    arrays = dict.fromkeys(names, np.zeros(9)) | columns
    variables = {name: named(name, x, "case") for name, x in arrays.items()}
    data = SweepData(variables, {}, None, SimpleNamespace(origin=np.arange(9)))
    with mock.patch.object(judging, "read_sweep", lambda _: data):
        (text,) = read_judged(None, 1, 3).breaking
    assert text == "mode 2 of the links, 200 Hz"


def test_what_breaks_in_words():
    assert breaking_text(np.nan, np.nan) == ""
    assert breaking_text(10.0, 1214.0) == "mode 10 of the links, 1.21e+03 Hz"
    assert breaking_text(0.0, 25.0) == "the platform on its drive, 25 Hz"
    assert breaking_text(np.nan, 0.0) == "grows without oscillating"
    assert breaking_text(np.nan, 30.0) == "30 Hz"


def test_budget_from_the_command_line():
    for bad in ({"voltage": -1.0}, {"voltage": 1e3}, {"margin": 2.5}, {"margin": float("nan")}):
        with pytest.raises(StudyError, match=f"--{next(iter(bad))}"):
            make_budget(STUDY, **({"voltage": 20.0, "margin": 0.4} | bad))
    with pytest.raises(StudyError, match="--voltage: the design's loop is unstable"):
        make_budget(study_of(MACHINE, control__gain_factor=20.0), None, 0.4)


def made_up(margin, energy=0.0):
    """A comparison whose controllers have gain margins (N, M), as if run without control."""
    shape = (*np.shape(margin), len(MOVES))
    judged = Judged(
        metrics={name: np.ones(shape) for name in (*FIGURES, *SHOWN)}
        | {"control_energy": np.full(shape, energy)},
        status=np.zeros(shape, int),
        margins=dict.fromkeys(MARGINS, np.ones(shape[:2])) | {"gain_margin": np.array(margin)},
        breaking=[""] * len(margin),
    )
    still = STUDY.change(control__feedback="none")
    entries = [Combination(str(k), "", "", still, "", 1) for k in range(len(margin))]
    return find(STUDY, Budget(50.0, 0.4), [], judged, entries)


def test_a_controller_that_one_machine_makes_unstable_is_out():
    findings = made_up([[1.2, 0.9, 1.5], [1.2, 1.0, np.nan]])
    assert findings.controllers[0].reason == "unstable on 1 of 3 machines"
    assert findings.competing == [1]


def test_a_verdict_is_checked_by_every_other_figure():
    text = " ".join(verdict(made_up([[2.0, 2.0], [3.0, 3.0]])))
    for words in list(FIGURES.values())[1:]:
        assert f"By {words} the verdict stands." in text


def test_the_rms_voltage_is_that_of_each_actuator():
    """Three on each of three links, at 2 V all the time."""
    energy = 9 * 2.0**2 * longer(STUDY).run.duration
    table = say(made_up([[2.0, 2.0]], energy)).chapters[0].parts[0]
    assert table.rows[0][table.heads.index("rms voltage, mean [V]")] == "2"


def tuned(candidate, study):
    return Tuned(candidate, study, "", 1, Quality(0.7, 3, np.nan, ("drive.kp",)))


@pytest.fixture
def compared(tmp_path):
    """A comparison of two laws and a drive as if tuned; no program depends on what is replaced."""
    factors = {"weak": 0.1, "strong": 0.6}
    tunings = [
        tuned(Contender(name, {}, {}, {}), STUDY.change(control__gain_factor=x))
        for name, x in factors.items()
    ]
    drive = tuned(Contender("PD", {}, {}, {}, is_drive=True), STUDY)
    with mock.patch.multiple(laws, _tune=lambda *arguments: [*tunings, drive], MACHINES=2):
        yield compare(STUDY, tmp_path / "out", voltage=50.0, progress=False)


def test_a_comparison_writes_a_page_whose_order_is_that_of_the_runs(tmp_path, compared):
    findings = compared
    assert findings.name(findings.ranking.best) == "strong + PD"
    document = json.loads((tmp_path / "out" / "laws.json").read_text())
    jsonschema.validate(document, schema("compare"))
    names = [entry["controller"]["name"] for entry in document["controllers"]]
    assert names[:2] == ["strong + PD", "weak + PD"]
    own = findings.judged.metrics["residual_rms"]
    wanted = np.exp(np.log(own[2] / own[3]).mean())  # weak over strong, by the definition
    weak = next(x for x in document["controllers"] if x["controller"]["name"] == "weak + PD")
    assert weak["ratio"]["residual_rms"][0] == pytest.approx(wanted)
    page = (tmp_path / "out" / "report.html").read_text()
    (table,) = tables_of(page)["Their tunings"]
    row = [cells[table["candidate"].index("PD")] for cells in table.values()]
    assert row == ["PD", "1", "0.700", "3 of 4", "-", "drive.kp"]
    assert document["tunings"][2] == {
        "name": "PD",
        "numbers_tuned": 1,
        "quality": {
            "objective": 0.7,
            "n_alike": 3,
            "late_gain": None,
            "at_bound": ["drive.kp"],
        },
    }
    assert "strong + PD" in page
    strong = document["controllers"][0]
    for name, value in strong["margins"].items():
        assert value == findings.judged.margins[name][3].min()  # of the machines
    for name in ("gain_margin", "disk_margin"):
        less, more = (findings.judged.margins[name][k] for k in (3, 2))
        assert less.max() < more.min()
    assert 0 < strong["rms_voltage"] < strong["peak_voltage"]
    assert strong["residual_rms"] == pytest.approx(np.exp(np.log(own[3]).mean()))
    assert beyond_budget(findings, 3) == ""
    tight = replace(findings, budget=findings.budget.replace(voltage=1e-3, margin=1.99))
    text = beyond_budget(tight, 3)
    assert "(tuned to 0.001 V)" in text and "a disk margin below 1.99 on" in text
    html = findings._repr_html_()
    assert "strong + PD" in html and html.count("data:image/png;base64,") == 1
    with pytest.raises(StudyError, match="begun with another budget"):
        compare(STUDY, tmp_path / "out", voltage=40.0, resume=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"design": 3}, "law 'x': design = 3; expected a function"),
        ({"channel": "link"}, "law 'x': channel = 'link'; allowed: 'mode', 'patch' or 'none'"),
        ({"parameters": "a"}, "expected a tuple of Parameter"),
    ],
)
def test_descriptions_of_laws_are_checked(change, message):
    check_law(LAWS["imsc"])
    with pytest.raises(PartError, match=message):
        check_law(LAWS["imsc"]._replace(name="x", **change))
