"""Free numbers of a tuning and what a tuning file may ask for."""

from types import SimpleNamespace
from unittest import mock

import jax
import numpy as np
import pytest

from jaxmodel.metrics import Metrics
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.numbers import one_study
from studies.study.paths import Parts, set_value
from studies.tuning import evaluate
from studies.tuning.check import fresh_columns
from studies.tuning.evaluate import Evaluator
from studies.tuning.objective import (
    ScenarioFigures,
    judge_with_cotangents,
    objective_of,
    tail_weights,
)
from studies.tuning.scenarios import lane_columns, scenario_columns, tuned_machines
from tests.bare import parse_study, parse_tuning
from tests.tunings import EVERY_KIND, GAIN, SMALL, tuning


def placed(spec, values):
    """The tuning's study with these values of its free parameters, as a case."""
    structure = build_structure(spec.study)
    return spec.free.build(structure)(one_study(spec.study, structure), np.asarray(values))


def test_free_numbers_get_to_where_the_study_would_put_them():
    """Placed into a case they give what a study file with these values gives."""
    spec = tuning(EVERY_KIND)
    values = spec.free.values(np.random.default_rng(0).uniform(0.2, 0.8, len(spec.free.names)))
    study = spec.study
    for name, value in zip(spec.free.names, values, strict=True):
        study = parse_study(set_value(study, name, float(value)))
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-13),
        placed(spec, values),
        as_arrays(build_case(study)),
    )
    assert len(values) == 1 + 3 + 2 + 6


def test_the_start_is_the_study_itself():
    spec = tuning(EVERY_KIND)
    values = dict(zip(spec.free.names, spec.free.values(spec.free.places()), strict=True))
    assert values["control.gain_factor"] == pytest.approx(spec.study.control.gain_factor)
    assert values["control.ratios[1][1]"] == pytest.approx(0.3)
    assert values["drive.kp"] == pytest.approx(2e4)


def test_slopes_are_those_of_the_values():
    spec = tuning(EVERY_KIND)
    u, step = np.random.default_rng(1).uniform(0.2, 0.8, len(spec.free.names)), 1e-6
    change = (spec.free.values(u + step) - spec.free.values(u - step)) / (2 * step)
    np.testing.assert_allclose(spec.free.slopes(u), change, rtol=1e-6)


@pytest.mark.parametrize("kind", ["same", "per_link"])
def test_patches_stay_on_the_link_and_apart(kind):
    spec = tuning({"placement": {"kind": kind}})
    case = as_arrays(build_case(spec.study))
    start = placed(spec, spec.free.values(spec.free.places())).machine.patches.center
    np.testing.assert_allclose(start, case.machine.patches.center, atol=1e-12)
    pitch, length = 0.03, 0.2
    random = np.random.default_rng(0)
    corners = (np.zeros(len(spec.free.names)), np.ones(len(spec.free.names)))
    for u in [*corners, *random.uniform(size=(50, len(spec.free.names)))]:
        center = np.asarray(placed(spec, spec.free.values(u)).machine.patches.center)
        assert center.shape == (3, 3)
        assert center.min() >= pitch / 2 - 1e-12 and center.max() <= length - pitch / 2 + 1e-12
        assert np.diff(center, axis=1).min() >= pitch - 1e-12


def test_poles_can_be_free():
    """All entries of what the study has: one number, one a link, or some modes of each link."""
    free = {
        "control.pole_decay": {"from": 5.0, "to": 500.0, "scale": "log"},
        "control.pole_frequency_hz[1][0]": {"from": 80.0, "to": 200.0},
    }
    control = {
        **SMALL["control"],
        "pole_decay": [[100.0, 90.0], [110.0], [120.0]],
        "pole_frequency_hz": [[120.0], [121.0], [122.0]],
    }
    spec = parse_tuning({**SMALL, "control": control, "tune": {"free": free}})
    assert (
        len(spec.free.names) == 5
        and spec.has_poles(spec.parts())
        and spec.has_position_gain(spec.parts())
    )
    values = np.array([10.0, 20.0, 30.0, 40.0, 100.0])
    moved = placed(spec, values).control
    np.testing.assert_array_equal(moved.pole_decay[:, :2], [[10, 20], [30, 0], [40, 0]])
    np.testing.assert_allclose(moved.pole_frequency[:, 0], 2 * np.pi * np.array([120, 100, 122]))


def test_added_damping_can_be_free():
    """One number, and one a link, are those of mode 1; lists those of their modes."""
    free = {"control.damping": {"from": 0.0, "to": 0.5}}
    for damping, values, moved in (
        (0.2, [0.1], [[0.1, -1]] * 3),
        ([0.2, 0.3, 0.1], [0.1, 0.0, 0.4], [[0.1, -1], [0, -1], [0.4, -1]]),
        ([[0.2, 0.05], [0.1], [0.1]], [0.3, 0.1, 0.2, 0.4], [[0.3, 0.1], [0.2, -1], [0.4, -1]]),
    ):
        control = {**SMALL["control"], "damping": damping}
        spec = parse_tuning({**SMALL, "control": control, "tune": {"free": free}})
        assert spec.has_poles(spec.parts()) and spec.has_position_gain(spec.parts())
        control = placed(spec, values).control
        np.testing.assert_allclose(control.damping[:, :2], moved, atol=1e-15)


def test_gains_that_poles_decide_cannot_be_free():
    control = {**SMALL["control"], "pole_decay": 100.0}
    free = {"control.velocity_gain[0]": {"from": 0.5, "to": 5.0}}
    with pytest.raises(StudyError, match="velocity_gain.*: control.pole_decay decides the gains"):
        parse_tuning({**SMALL, "control": control, "tune": {"free": free}})


def test_numbers_a_link_move_links():
    """As in the study: entry k of one number a link is link k, whatever is below it."""
    control = {**SMALL["control"], "pole_decay": [100.0, 110.0, 120.0]}
    free = {"control.pole_decay": {"from": 5.0, "to": 500.0}}
    spec = parse_tuning({**SMALL, "control": control, "tune": {"free": free}})
    moved = placed(spec, [10.0, 20.0, 30.0]).control.pole_decay
    np.testing.assert_array_equal(moved, [[10, 10], [20, 20], [30, 30]])
    one = {"control.pole_decay[1]": {"from": 5.0, "to": 500.0}}
    spec = parse_tuning({**SMALL, "control": control, "tune": {"free": one}})
    moved = placed(spec, [20.0]).control.pole_decay
    np.testing.assert_array_equal(moved, [[100, 100], [20, 20], [120, 120]])


def test_what_is_no_number_stays_as_it_is():
    free = {**EVERY_KIND, "placement": {"kind": "same"}}
    del free["patches.centers[1]"]
    spec = tuning(free)
    case = as_arrays(build_case(spec.study))
    kept = placed(spec, np.full(len(spec.free.names), np.nan))
    jax.tree.map(np.testing.assert_array_equal, kept, case)


BOTH = {"gains": {"free": ["control.gain_factor"]}, "all": {}}


def deep(n):
    """A list in a list in a list ..."""
    found = 1.0
    for _ in range(n):
        found = [found]
    return found


@pytest.mark.parametrize(
    ("tune", "message"),
    [
        ({}, "tune.free = .*; allowed: one free field or more"),
        ({"free": {"control.gainfactor": {}}}, "did you mean 'control.gain_factor'"),
        ({"free": {"run.duration": {"from": 0.1, "to": 1.0}}}, "cannot be free; fields that can"),
        (
            {"free": {"control.gain_factor": {"from": 1.5, "to": 2.0}}},
            "control.gain_factor = 1.0; allowed: 1.5 to 2, the bounds",
        ),
        ({"free": {"control.gain_factor": {"from": -1.0, "to": 2.0}}}, "a finite number >= 0"),
        ({"free": {"control.gain_factor": {"from": 2.0, "to": 1.0}}}, "= 1.0; allowed: more than"),
        ({"free": {"control.pole_decay": {"from": 1.0, "to": 2.0}}}, "one number or more, where"),
        (
            {
                "free": {
                    **GAIN,
                    "control.velocity_gain": {"from": 1.0, "to": 100.0},
                    "control.velocity_gain[0]": {"from": 1.0, "to": 100.0},
                }
            },
            "free twice",
        ),
        (
            {
                "free": {
                    "link.thickness": {"from": 1e-3, "to": 3e-3},
                    "link.thickness[0]": {"from": 1e-3, "to": 3e-3},
                }
            },
            "free twice",
        ),
        (
            {"free": {"placement": {"from": 0, "to": 1}}},
            "placement.from = 0: unknown field",
        ),
        ({"free": GAIN, "objective": {"residual": 1.0}}, "did you mean 'residual_rms'"),
        ({"free": GAIN, "objective": {"residual_rms": -1.0}}, "allowed: a finite number > 0"),
        (
            {"free": GAIN, "objective": {"gain_margin": 1.0}},
            "tune.objective: 'gain_margin' can only be a limit, it has no derivative; take disk_m",
        ),
        (
            {"free": GAIN, "objective": {"singularity_distance": 1.0}},
            "tune.objective: 'singularity_distance' can only be a limit$",
        ),
        ({"free": GAIN, "objective": {"disc_margin": 1.0}}, "did you mean 'disk_margin'"),
        (
            {
                "free": GAIN,
                "objective": {"disk_margin": 1.0},
                "families": {"one": {"set": {"control.law": "modified_imsc"}}},
            },
            "tune.objective.disk_margin: control.law 'modified_imsc' switches between loops",
        ),
        ({"free": GAIN, "objective": {"disk_margin[1]": 1.0}}, "no such entry; allowed: disk_marg"),
        ({"free": GAIN, "objective": {"disk_margin": 0.0}}, "disk_margin = 0.0; allowed: a finite"),
        ({"free": GAIN, "limits": {"disk_margin": 2.5}}, "disk_margin = 2.5; allowed: .* <= 2"),
        (
            {"free": GAIN, "limits": {"delay_margin": 17.0}},
            "= 17.0; allowed: .* <= 16",
        ),
        (
            {"free": GAIN, "scenarios": {"each": {"drive.kind": ["pd", "computed_torque"]}}},
            "each.drive.kind: is the same in all scenarios; take tune.families",
        ),
        ({"free": GAIN, "limits": {"peak_volt": 1.0}}, "did you mean 'peak_voltage'"),
        (
            {"free": GAIN, "objective": {"residual_rms[3]": 1.0}},
            r"has no such entry; allowed: residual_rms\[0 to 2\]\[0 to 2\]",
        ),
        ({"free": GAIN, "objective": {"settling_time": 1.0}}, "no derivative; take ringing_time"),
        ({"free": GAIN, "limits": {"gain_margin[0]": 2.0}}, "no such entry; allowed: gain_margin"),
        (
            {"free": GAIN, "limits": {"peak_voltage": "own"}},
            "> 0 and <= 1e\\+30, or 'baseline'",
        ),
        (
            {"free": GAIN, "limits": {"peak_voltage": 40.0, "peak_voltage[1]": 50.0}},
            r"peak_voltage\[1\] = 50 allows more than peak_voltage = 40",
        ),
        ({"free": GAIN, "scenarios": {"spread": {"link.basis": 5.0}}}, "for a number"),
        ({"free": GAIN, "scenarios": {"spread": {"electronics.adc_noise": 5.0}}}, "not 0 where"),
        ({"free": GAIN, "scenarios": {"each": {"motion.move_time": 0.03}}}, "1 or more values"),
        ({"free": GAIN, "scenarios": {"each": {"motion.move_time": [-1.0]}}}, "move_time = -1.0"),
        ({"free": GAIN, "scenarios": {"tail": 2.0}}, "tune.scenarios.tail = 2.0; allowed"),
        (
            {"free": GAIN, "families": {"one": {"free": ["control.gainfactor"]}}},
            "did you mean 'control.gain_factor'",
        ),
        ({"free": GAIN, "families": {"one": {"free": []}}}, "one or more with free parameters"),
        ({"free": GAIN, "families": {"one": {"set": {"link.modes": 3}}}}, "n_modes = 3 where"),
        (
            {"free": GAIN, "families": {"one": {"set": {"motion.move_time": 0.06}}}},
            "tune.families.one: run.duration = 0.06; allowed: 0.08 or more",
        ),
        ({"free": GAIN, "families": {"..": {}}}, "not first a sign"),
        ({"free": GAIN, "families": {"$x$": {}}}, "not first a sign"),
        ({"free": GAIN, "families": {"a b": {}, "A+B": {}}}, "'a b' is one already"),
        (
            {
                "free": GAIN,
                "families": {"a": {}, "a, peak_voltage 20": {}},
                "limits": {"peak_voltage": 50.0},
                "pareto": {"limit": "peak_voltage", "values": [20.0, 30.0], "family": "a"},
            },
            "is one already",
        ),
        (
            {
                "free": GAIN,
                "limits": {"gain_margin": 2.0},
                "pareto": {"limit": "gain_margin", "values": [1.0, 2.0]},
            },
            "one of the metrics in",
        ),
        (
            {
                "free": GAIN,
                "limits": {"peak_voltage": 50.0},
                "pareto": {"limit": "peak_voltage", "values": [1.0, 2.0], "family": []},
            },
            "family = .*; allowed: text",
        ),
        ({"free": GAIN, "scenarios": {"spread": {"run.duration": 5.0}}}, "for the machine and its"),
        (
            {"free": GAIN, "scenarios": {"machines": {"link.density": [2700.0]}}},
            "1 values; allowed: 16 or more",
        ),
        (
            {"free": GAIN, "scenarios": {"machines": {"link.density": [-1.0] * 16}}},
            r"link.density\[0\]: link.density = -1.0",
        ),
        (
            {
                "free": GAIN,
                "scenarios": {
                    "spread": {"link.density": 1.0},
                    "machines": {"link.density": [2700.0] * 16},
                },
            },
            "both in spread and in machines",
        ),
        (
            {
                "free": GAIN,
                "scenarios": {
                    "machines": {
                        "link.youngs_modulus": [7e10] * 16,
                        "link.youngs_modulus[0]": [7e10] * 16,
                    }
                },
            },
            "twice in machines",
        ),
        (
            {"free": GAIN, "scenarios": {"machines": {"link.modes": [3] * 16}}},
            "what runs by the same program",
        ),
        (
            {"free": GAIN, "scenarios": {"machines": {"drive.locked": [True] * 16}}},
            "drive.locked = true of tune.scenarios",
        ),
        (
            {
                "free": GAIN,
                "scenarios": {
                    "spread": {"link.damping_ratio": 99.0},
                    "each": {"link.damping_ratio": [0.9]},
                },
            },
            "both in",
        ),
        ({"free": GAIN, "starts": 1000, "scenarios": {"count": 1000}}, "runs at once; allowed: up"),
        (
            {
                "free": {
                    "placement": {"kind": "same"},
                    "patches.centers": {"from": 0.02, "to": 0.18},
                }
            },
            "patches.centers: placement is free too",
        ),
        ({"free": {"gain": {"from": 0.1, "to": 1.0}}}, "did you mean 'control.gain_factor'"),
        ({"free": {"link_subsets": "all"}}, "cannot be free; an axis of sweeps alone"),
        (
            {"free": GAIN, "objective": {"residual_rms[link=4]": 1.0}},
            r"allowed: \[link=1 to 3\], \[station=1 to 3\]",
        ),
        (
            {"free": {"control.pole_decy": {"from": 5.0, "to": 50.0}}},
            "did you mean 'control.pole",
        ),
        ({"free": GAIN, "objective": {"qqq": 1.0}}, "unknown metric; allowed: residual_rms, "),
        ({"free": GAIN, "limits": {"peak_voltage": deep(400)}}, "peak_voltage = .* or 'baseline'"),
        (
            {"free": GAIN, "families": {"one": {"sets": {}}}},
            "did you mean 'tune.families.one.set'",
        ),
        (
            {"free": GAIN, "pareto": {"limit": "peak_voltage", "values": [1.0, 2.0]}},
            "tune.pareto.limit = 'peak_voltage'; allowed: one of the metrics in tune.limits",
        ),
        (
            {
                "free": GAIN,
                "limits": {"peak_voltage": 50.0},
                "pareto": {"limit": "peak_voltage", "values": [1.0]},
            },
            "2 or more finite numbers",
        ),
        (
            {
                "free": GAIN,
                "limits": {"peak_voltage": 50.0},
                "pareto": {"limit": "peak_voltage", "values": [1.0, 1.0]},
            },
            "each limit once",
        ),
        (
            {
                "free": GAIN,
                "scenarios": {
                    "each": {"link.youngs_modulus": [7e10]},
                    "spread": {"link.youngs_modulus": 5.0},
                },
            },
            "both in spread",
        ),
        ({"free": GAIN, "scenarios": {"each": {"control.gain_factor": [0.5]}}}, "is free in fam"),
        (
            {"free": GAIN, "families": {"one": {"set": {"control.gain_factor": 1.0}}}},
            "tune.families.one.set: control.gain_factor is free in family 'one'",
        ),
        ({"free": GAIN, "starts_": 3}, "starts_"),
    ],
)
def test_faults_are_named(tune, message):
    with pytest.raises(StudyError, match=message):
        parse_tuning({**SMALL, "tune": tune})


@pytest.mark.parametrize(
    "name", ["saturated_fraction", "clipped_fraction", "motor_saturated_fraction"]
)
def test_shares_of_samples_can_be_limited_only(name):
    with pytest.raises(StudyError, match=f"{name} moves in steps .* limit it instead"):
        parse_tuning({**SMALL, "tune": {"free": GAIN, "objective": {name: 1.0}}})


@pytest.mark.parametrize(
    ("tail", "weights"),
    [(1.0, [0.25] * 4), (0.0, [1, 0, 0, 0]), (0.5, [0.5, 0.5, 0, 0]), (0.3, [5 / 6, 1 / 6, 0, 0])],
)
def test_tail_goes_from_the_mean_to_the_worst(tail, weights):
    np.testing.assert_allclose(tail_weights(4, tail), weights)


def test_what_all_runs_share_is_no_column():
    """It is prepared once, which takes longer than a run of some cases."""
    spec = tuning(GAIN)
    designs = [None, spec.families[0]]
    assert lane_columns(spec, scenario_columns(spec, 1, 0), designs) == {}
    assert list(lane_columns(spec, scenario_columns(spec, 2, 0), designs)) == ["run.seed"]
    fresh = lane_columns(spec, scenario_columns(spec, 1, 0, is_fresh=True), designs)
    assert (fresh["run.seed"] != spec.study.run.seed).all()


def test_three_values_are_spread_together_on_every_move():
    own = [2.0e-3, 2.1e-3, 1.9e-3]
    spec = parse_tuning(
        {
            **SMALL,
            "link": {"modes": 2, "thickness": own},
            "tune": {
                "free": GAIN,
                "scenarios": {
                    "count": 3,
                    "spread": {"link.thickness": 5.0},
                    "each": {"motion.move_time": [0.03, 0.035]},
                },
            },
        }
    )
    column = scenario_columns(spec, 3, 0)["link.thickness"]
    assert column.shape == (6, 3)
    np.testing.assert_array_equal(column[:3], column[3:])
    np.testing.assert_allclose(column[0], own)
    share = column / own
    np.testing.assert_allclose(share, share[:, :1] * np.ones(3))
    assert 0 < np.abs(share - 1).max() <= 0.05


def test_machines_fill_the_whole_spread_and_fresh_ones_are_others():
    asked = {"count": 20, "check": 20, "spread": {"link.density": 5.0}}
    spec = tuning(GAIN, scenarios=asked)
    tuned, fresh = scenario_columns(spec, 20, spec.tune.scenarios.seed), fresh_columns(spec)
    share = fresh["link.density"] / spec.study.link.density - 1
    # a Latin hypercube has one in each twentieth of -5 to 5 %
    assert -0.05 <= share.min() <= -0.045 and 0.045 <= share.max() <= 0.05
    for name in ("run.seed", "link.density"):
        assert not np.isin(fresh[name], tuned[name]).any()


def test_figures_of_the_loop_need_one():
    control = {**SMALL["control"], "feedback": "ideal"}
    for tune in ({"objective": {"disk_margin": 1.0}}, {"limits": {"disk_margin": 1.0}}):
        message = f"'sampled' where tune.{next(iter(tune))} holds disk_margin"
        with pytest.raises(StudyError, match=message):
            parse_tuning({**SMALL, "control": control, "tune": {"free": GAIN, **tune}})


def test_the_loop_of_a_machine_counts_once():
    """Neither moves nor noise change it, nor a machine that equals the nominal one."""
    each = {"motion.move_time": [0.03, 0.035]}
    alike = tuned_machines(tuning(GAIN, scenarios={"count": 3, "each": each}))
    assert alike.size == 1 and alike.of_scenario.tolist() == [0] * 6
    spread = tuned_machines(
        tuning(GAIN, scenarios={"count": 3, "each": each, "spread": {"link.density": 5.0}})
    )
    assert spread.size == 3 and spread.of_scenario.tolist() == [0, 1, 2, 0, 1, 2]
    spec = tuning(
        GAIN,
        scenarios={
            "count": 4,
            "check": 1,
            "machines": {"link.density": [2600.0, 2750.0, 2600.0, 2700.0]},
        },
    )
    given = tuned_machines(spec)
    assert spec.study.link.density == 2750.0
    np.testing.assert_array_equal(given.columns["link.density"], [2750.0, 2600.0])
    assert given.of_scenario.tolist() == [0, 1, 0, 1]


def test_parameters_of_any_law_of_a_family_make_machines_differ():
    """Also those that the baseline's law does not have."""
    spec = tuning(
        {"control.laws.lqg.voltage_weight": {"from": 1e-9, "to": 1e-3, "scale": "log"}},
        families={"lqg": {"set": {"control.law": "lqg"}}},
        scenarios={"count": 2, "spread": {"control.laws.lqg.sensor_noise": 5.0}},
    )
    assert tuned_machines(spec).size == 2


@pytest.mark.parametrize("tail", [1.0, 0.5, 0.0])
def test_the_tail_is_that_of_metrics_and_loops_together(tail):
    """By hand: of three scenarios on two machines; more of a margin is better."""
    weights = {"disk_margin": 1.0, "residual_rms": 2.0, "sensitivity_peak": 1.0}
    goal = objective_of(tuning(GAIN, objective=weights, scenarios={"tail": tail}))
    assert dict(goal.terms) == {"residual_rms": 0.5} and goal.metrics == ("residual_rms",)
    assert dict(goal.loop) == {"disk_margin": 0.25, "sensitivity_peak": 0.25}
    rms, margin, peak = np.array([2.0, 1.0, 3.0]), np.array([0.5, 2.0, 0.5]), np.array([3, 1, 3.0])

    def measured(rms, margin, peak):
        metrics = Metrics({"residual_rms": rms[:, None, None] * np.ones((3, 3))})
        return ScenarioFigures(metrics, np.stack([margin, peak], axis=1))

    one = np.ones(3)
    shares = 0.5 * rms / 4 + 0.25 * 1.0 / margin + 0.25 * peak / 2
    worst = np.sort(shares)[::-1]
    designs = jax.tree.map(lambda x: x[None], measured(rms, margin, peak))
    judged = judge_with_cotangents(
        goal, designs, measured(4 * one, one, 2 * one), np.zeros((1, 3, 0))
    )
    share = tail_weights(3, tail)
    np.testing.assert_allclose(judged.objective, [worst @ share])
    weight = share[np.argsort(np.argsort(-shares))]
    by_loop = np.stack([-0.25 * weight / margin**2, 0.125 * weight], axis=1)
    np.testing.assert_allclose(judged.cotangents.loop[0, 0], by_loop)
    unstable = designs._replace(loop=np.where([[[0], [1], [0]]], np.nan, designs.loop))
    judged = judge_with_cotangents(
        goal, unstable, measured(4 * one, one, 2 * one), np.zeros((1, 3, 0))
    )
    assert np.isnan(judged.objective).all()


def test_machines_are_given_one_by_one():
    modulus = [6.9e10, [7.0e10, 7.1e10, 7.2e10], 6.8e10, 6.7e10]
    machines = {"link.youngs_modulus": modulus, "link.density": [2690.0, 2710.0, 2705.0, 2702.0]}
    asked = {"count": 2, "check": 3, "machines": machines}
    spec = parse_tuning({**SMALL, "tune": {"free": GAIN, "scenarios": asked}})
    tuned, fresh = scenario_columns(spec, 2, 0), scenario_columns(spec, 3, 1, is_fresh=True)
    own = spec.study.link
    np.testing.assert_array_equal(tuned["link.density"], [own.density, 2690.0])
    np.testing.assert_array_equal(tuned["link.youngs_modulus"], [own.youngs_modulus, 6.9e10])
    np.testing.assert_array_equal(fresh["link.density"], machines["link.density"][1:])
    wanted = [modulus[1], [6.8e10] * 3, [6.7e10] * 3]
    np.testing.assert_array_equal(fresh["link.youngs_modulus"], wanted)


def test_moves_may_have_unequal_paths():
    home = SMALL["motion"]["waypoints"][0]
    paths = [[home, [0.0, 0.005, home[2]]], [home, [0.002, 0.0, home[2]], home]]
    data = {**SMALL, "run": {"duration": 0.1}}
    spec = parse_tuning(
        {**data, "tune": {"free": GAIN, "scenarios": {"each": {"motion.waypoints": paths}}}}
    )
    lanes = lane_columns(spec, scenario_columns(spec, 1, 0), [None, spec.families[0]])
    assert [len(path) for path in lanes["motion.waypoints"]] == [2, 3, 2, 3]


LAWS_TUNED = {
    "control.laws.lqg.voltage_weight": {"from": 1e-9, "to": 1e-6, "scale": "log"},
    "control.laws.ppf.filter_damping": {"from": 0.2, "to": 1.0},
}


def test_each_law_is_tuned_by_its_own_parameters():
    """A family that names nothing frees all but other laws' parameters."""
    families = {
        "lqg": {"set": {"control.law": "lqg"}},
        "ppf": {"set": {"control.law": "ppf"}},
        "own": {},
    }
    spec = tuning({**GAIN, **LAWS_TUNED}, families=families)
    moved = {family.name: list(family.is_free) for family in spec.families}
    assert moved["own"] == [True, False, False]
    assert moved["lqg"] == [True, True, False] and moved["ppf"] == [True, False, True]
    assert [spec.parts(family).law for family in spec.families] == ["lqg", "ppf", "imsc"]
    assert spec.parts()[:2] == ("imsc", "pd") and len(spec.studies(Parts("lqg", "pd"))) == 1
    assert spec.has_position_gain(Parts("ppf", "pd"))
    assert not spec.has_position_gain(spec.parts())


@pytest.mark.parametrize(
    ("free", "families", "message"),
    [
        (LAWS_TUNED, {"lqg": {"set": {"control.law": "lqg"}}}, "ppf.filter_damping: cannot be"),
        (
            {**GAIN, "control.laws.lqg.bending_hz": {"from": 20.0, "to": 200.0}},
            {
                "lqg": {"set": {"control.law": "lqg"}},
                "own": {"free": ["control.laws.lqg.bending_hz"]},
            },
            "families.own.free: .*'imsc'",
        ),
    ],
)
def test_parameters_belong_to_a_law(free, families, message):
    with pytest.raises(StudyError, match=message):
        tuning(free, families=families)


TWO_LAWS = {**GAIN, "control.laws.ppf.filter_damping": {"from": 0.2, "to": 1.0}}
BY_LAW = {"a": {}, "ppf": {"set": {"control.law": "ppf"}}, "b": {}}


class KnownRuns:
    """Runs whose residual is a law's size times 1 + 2 gain_factor + filter_damping."""

    SIZE, SLOPE, compile_time = {"imsc": 1.0, "ppf": 3.0}, np.array([2.0, 1.0]), 1.0

    def __init__(self, structure, layout, place):
        self._size = self.SIZE[structure.law]

    def differentiate(self, numbers, free):
        size = self._size * (1 + np.where(np.isnan(free), 1.0, free) @ self.SLOPE)
        metrics = Metrics({"residual_rms": size[:, None, None] * np.ones((3, 3))})
        result = SimpleNamespace(metrics=metrics, status=np.zeros(len(free), int))

        def pull_back(cotangents):
            by_size = np.asarray(cotangents.residual_rms).sum(axis=(2, 3))
            return by_size[..., None] * self._size * self.SLOPE

        return SimpleNamespace(result=result, pull_back=pull_back)


@mock.patch.object(evaluate, "Executor", KnownRuns)  # part of no program
def test_designs_of_laws_are_evaluated_in_order():
    """Families of two laws side by side, measured against the baseline of one of them."""
    spec = tuning(TWO_LAWS, families=BY_LAW, starts=1)
    names = [family.name for family in spec.moving]
    values = {"a": [0.3, np.nan], "ppf": [0.2, 0.4], "b": [0.6, np.nan]}
    found = Evaluator(spec, list(spec.moving)).evaluate(np.array([values[x] for x in names]))
    known = {"a": 2.6 / 4, "ppf": 3 * 1.8 / 4, "b": 3.2 / 4}
    slopes = {"a": [0.5, 0.0], "ppf": [1.5, 0.75], "b": [0.5, 0.0]}
    np.testing.assert_allclose(found.objective, [known[x] for x in names], rtol=1e-12)
    np.testing.assert_allclose(found.slope, [slopes[x] for x in names], rtol=1e-12)


@pytest.mark.long  # in short: with known runs
def test_designs_of_laws_are_evaluated_as_in_tunings_of_their_own():
    spec = tuning(TWO_LAWS, families=BY_LAW, starts=1)
    evaluator = Evaluator(spec, list(spec.moving))
    places = np.array([[0.3, 0.5], [0.2, 0.4], [0.6, 0.5]])
    found = evaluator.evaluate(spec.free.values(places))
    alone = tuning(GAIN, families={"a": {}, "b": {}}, starts=1)
    wanted = Evaluator(alone, list(alone.moving)).evaluate(alone.free.values(places[[0, 2], :1]))
    rows = [k for k, family in enumerate(spec.moving) if spec.parts(family).law == "imsc"]
    np.testing.assert_allclose(found.objective[rows], wanted.objective, rtol=1e-9)
    np.testing.assert_allclose(found.slope[rows, 0], wanted.slope[:, 0], rtol=1e-6)
    push = next(k for k, x in enumerate(spec.moving) if spec.parts(x).law == "ppf")
    step = np.array([[0, 1e-4]])
    ahead, back = (
        evaluator.evaluate(spec.free.values(places + sign * step), False) for sign in (1, -1)
    )
    width = spec.free.slopes(places[push])[1]
    difference = (ahead.objective[push] - back.objective[push]) / 2e-4
    assert found.slope[push, 1] * width == pytest.approx(difference, rel=1e-3)
