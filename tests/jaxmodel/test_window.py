"""Where the residual window begins: when the drive has settled, by its poles."""

import numpy as np
import pytest

import studies
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.study.cases import build_case, build_structure
from studies.study.numbers import build_cases
from studies.study.spec import Study
from studies.study.window import (
    SETTLED,
    residual_delay,
    settling_time,
    with_own_window,
    with_window,
)
from studies.tuning.spec import parse_tuning
from tests.bare import parse_study

STRUCK = {"pulse_force": [20.0, -10.0, 5.0], "pulse_start": 0.002, "pulse_length": 0.002}
REST = [[0.0, 0.0, 0.5236]]
MACHINES = {
    "default": {},
    "other assembly, little damping": {"machine__assembly": "outward", "drive__kd": 20.0},
    "three links, payload": {
        "link__length": (0.2, 0.22, 0.21),
        "machine__guide_offsets": (-0.01, 0.0, 0.0),
        "load__mass": 0.3,
        "load__inertia": 1e-4,
        "load__offset": (0.02, -0.01),
        "motion__waypoints": ((0, 0, 0.5236), (0.005, 0.01, 0.55)),
    },
}


@pytest.mark.parametrize("changes", MACHINES.values(), ids=MACHINES)
def test_the_drive_has_settled_by_the_poles_of_the_flexible_machine(changes):
    study = Study().change(link__modes=3, **changes)
    modes = studies.modes(study, pose=study.motion.waypoints[-1])
    decay = (2 * np.pi * modes.frequency * modes.damping_ratio)[:3]  # the drive's modes are lowest
    assert settling_time(study) == pytest.approx(np.log(1 / SETTLED) / decay.min(), rel=0.01)
    assert 0 <= residual_delay(study) - settling_time(study) < 1e-3


def test_an_overdamped_drive_settles_by_its_slow_pole():
    study = Study().change(drive__kp=100.0, drive__kd=400.0)
    # far below the other pole, each mode follows k_d s + k_p = 0
    assert settling_time(study) == pytest.approx(np.log(1 / SETTLED) * 400 / 100, rel=0.01)


def test_a_number_is_taken_as_it_is():
    assert residual_delay(Study().change(metrics__residual_delay=0.0123)) == 0.0123


def test_nothing_settles_where_nothing_moves_the_sliders():
    assert residual_delay(Study().change(motion__waypoints=REST)) == 0.0
    assert residual_delay(Study().change(drive__locked=True)) == 0.0


def test_the_window_waits_for_disturbances():
    wait = settling_time(Study())
    struck = parse_study({"motion": {"waypoints": REST}, "drive": STRUCK})
    assert residual_delay(struck) == pytest.approx(0.004 + wait, abs=1e-3)
    late = parse_study({"drive": STRUCK | {"pulse_start": 0.2}})  # 4 moves of 0.03 s
    assert residual_delay(late) == pytest.approx(0.202 - 0.12 + wait, abs=1e-3)
    assert residual_delay(parse_study({"drive": STRUCK})) == pytest.approx(wait, abs=1e-3)


@pytest.mark.parametrize(
    ("drive", "words"), [({"kd": 0.0}, "drive.kd = 0.0"), ({"kp": 0.0}, "drive.kp = 0.0")]
)
def test_a_drive_that_never_settles_is_refused(drive, words):
    with pytest.raises(StudyError, match=words) as told:
        check_run(parse_study({"drive": drive, "link": {"modes": 1}}))
    assert "metrics.residual_delay = 'auto'" in str(told.value)
    with pytest.raises(StudyError, match=words):
        parse_sweep({"drive": drive, "sweep": {"axes": {"drive.kd": [5.0, 60.0]}}})
    assert np.isinf(build_case(parse_study({"drive": drive})).windows.residual_delay)
    check_run(
        parse_study({"drive": drive, "metrics": {"residual_delay": 0.03}, "link": {"modes": 1}})
    )


def test_a_drive_that_settles_too_late_is_told_its_time():
    drive = {"kp": 1e-9, "kd": 60.0}
    with pytest.raises(
        StudyError, match=r"drive.kd = 60.*settles within 100 s.*it takes [0-9.e+]+ s"
    ):
        check_run(parse_study({"drive": drive, "link": {"modes": 1}}))


def test_a_run_without_room_for_it_is_refused_in_words():
    with pytest.raises(StudyError, match="0.026 s in which the drive settles"):
        check_run(Study().change(run__duration=0.15, link__modes=1))
    with pytest.raises(StudyError, match="0.03 s in which the drive settles"):
        check_run(
            parse_study(
                {"run": {"duration": 0.02}, "motion": {"waypoints": REST}} | {"drive": STRUCK}
            )
        )


def test_all_cases_have_the_window_of_the_baseline():
    data = {"sweep": {"axes": {"drive.kd": [5.0, 60.0]}}}
    spec = parse_sweep(data)
    assert spec.study == with_window(Study())
    table = build_table(spec)
    case = build_cases(table.study, table.fields, build_structure(table.study))
    assert case.windows.residual_delay.tolist() == [residual_delay(Study())]
    free = {"control.gain_factor": {"from": 0.1, "to": 2.0}}
    tuning = parse_tuning({"tune": {"free": free, "objective": {"residual_rms": 1.0}}})
    assert tuning.study == with_window(Study())


@pytest.mark.parametrize("values", [["auto", 0.0], ["auto"]])
def test_auto_is_no_value_of_an_axis(values):
    with pytest.raises(StudyError, match="'auto'; allowed: numbers in an axis"):
        build_table(parse_sweep({"sweep": {"axes": {"metrics.residual_delay": values}}}))


@pytest.mark.parametrize(
    ("drive", "axis"),
    [
        (STRUCK, {"motion.move_time": [0.03, 0.05]}),
        (STRUCK, {"drive.pulse_start": [0.05, 0.3]}),
        ({}, {"drive.pulse_force": [[0.0, 0.0, 0.0], [20.0, 0.0, 0.0]]}),
    ],
)
def test_one_window_must_suit_the_disturbances_of_all_cases(drive, axis):
    data = {"drive": drive, "sweep": {"axes": axis}}
    with pytest.raises(StudyError, match="a number where .* varies"):
        build_table(parse_sweep(data))
    build_table(parse_sweep(data | {"metrics": {"residual_delay": 0.3}}))
    harmless = {"drive.pulse_force": [[10.0, 0.0, 0.0], [20.0, 0.0, 0.0]], "drive.kp": [1e4, 2e4]}
    build_table(parse_sweep({"drive": STRUCK, "sweep": {"axes": harmless}}))


def test_a_machine_that_was_found_has_its_own_window():
    """What a fit starts from settles at another time than what it finds."""
    found = with_window(Study()).change(drive__kd=90.0)
    own = residual_delay(Study().change(drive__kd=90.0))
    assert residual_delay(found) != own == residual_delay(with_own_window(found, {}))
    given = {"metrics": {"residual_delay": 0.02}}
    assert with_own_window(found, given) == found
