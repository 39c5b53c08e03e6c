"""What a tuned design has to beat: no control, and the best gain factor alone."""

from unittest import mock

import numpy as np
import pytest

from studies.engine import function
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.engine.runs import run_study
from studies.tuning import loop_figures, references
from studies.tuning.check import fresh_columns
from studies.tuning.loop_figures import machine_figures
from studies.tuning.references import (
    ALONE,
    WITHOUT,
    compare,
    reference_lines,
    resolution_lines,
    scan_gain,
)
from studies.tuning.scenarios import scenario_columns, tuned_machines
from tests.tunings import EVERY_KIND, GAIN, tuning

FREE = {"control.velocity_gain[0]": EVERY_KIND["control.velocity_gain"]}
LIMITS = {"peak_voltage": 10.0, "gain_margin": 40.0}


def scenario(spec, columns, k, **more):
    """The baseline on one machine of a tuning."""
    return spec.study.change(
        run__seed=int(columns["run.seed"][k]),
        link__youngs_modulus=float(columns["link.youngs_modulus"][k]),
        **more,
    )


def metrics_of(study):
    return run_study(study, has_record=False, has_loop=False).result.metrics


@pytest.fixture(scope="module")
def compared():
    """A tuning of another gain, and what it has to beat."""
    spec = tuning(
        FREE,
        limits=LIMITS,
        starts=1,
        scenarios={"count": 2, "check": 2, "spread": {"link.youngs_modulus": 5.0}},
    )
    with (
        mock.patch.object(references, "COUNT", 7),
        mock.patch.object(loop_figures, "MARGIN_MODES", 4),  # a third of the time to compile
        mock.patch.object(function, "_FUNCTIONS", {}) as made,
    ):
        found = compare(spec, [spec.study], lambda text: None)
        assert len(made) == 1  # the scan takes the program of the fresh machines
        scan = found[2].scan
        machines = tuned_machines(spec).columns
        loops = [
            machine_figures(
                spec,
                spec.study.change(control__gain_factor=float(g)),
                machines,
                ("gain_margin",),
            )
            for g in scan.gain_factor
        ]
    return spec, found, loops


def test_the_gain_factor_alone_is_the_best_feasible_of_all(compared):
    spec, (_, _, found), loops = compared
    scan, columns = found.scan, scenario_columns(spec, 2, 0)
    assert len(scan.gain_factor) == 8 and 1.0 in scan.gain_factor
    objective, peaks = np.empty((8, 2)), np.empty((8, 2))
    for k in range(2):
        own = metrics_of(scenario(spec, columns, k))
        for row, gain in enumerate(scan.gain_factor.tolist()):
            one = metrics_of(scenario(spec, columns, k, control__gain_factor=gain))
            objective[row, k] = np.sqrt(np.mean(one.residual_rms**2) / np.mean(own.residual_rms**2))
            peaks[row, k] = one.peak_voltage.max()
    np.testing.assert_allclose(scan.objective, objective.mean(axis=1), rtol=1e-9)
    is_kept = peaks.max(axis=1) <= LIMITS["peak_voltage"]
    np.testing.assert_array_equal(scan.excess == 0, is_kept)
    is_safe = np.array([x["gain_margin"].min() for x in loops]) >= LIMITS["gain_margin"]
    value = objective.mean(axis=1)
    best = [
        np.nanargmin(np.where(ok, value, np.nan)) for ok in (value > 0, is_kept, is_kept & is_safe)
    ]
    assert scan.best == best[2] and len(set(best)) == 3  # each limit rules out a better one


def test_a_gain_factor_beyond_a_limit_is_no_best_one():
    """Of made-up figures: more gain is better, and above 1 exceeds a limit."""

    def known(spec, runs, values):
        return 1 / values, np.where(values > 1, 0.1, 0.0)

    with mock.patch.object(references, "_evaluate", known):
        scan = scan_gain(tuning(FREE, limits={"peak_voltage": 10.0}, starts=1), None)
    assert scan.gain_factor[scan.best] == 1 < scan.gain_factor[-1]


def test_what_is_compared_is_what_its_own_file_gives(compared):
    """On the fresh machines and on the baseline's own; no control is another program here."""
    spec, (own, judged, found), _ = compared
    columns = fresh_columns(spec)
    gain = float(found.scan.gain_factor[found.scan.best])
    assert judged == [] and [name for name, _ in found.designs] == [WITHOUT, ALONE]
    for one, change in (
        (found.uncontrolled, {"control__feedback": "none"}),
        (found.gain_alone, {"control__gain_factor": gain}),
    ):
        alone = metrics_of(spec.study.change(**change))
        runs = [metrics_of(scenario(spec, columns, k, **change)) for k in range(2)]
        for name in ("residual_rms", "settling_time", "peak_voltage"):
            np.testing.assert_allclose(one.own_run.metrics[name], alone[name].max(), rtol=1e-9)
            wanted = [run[name].max() for run in runs]
            np.testing.assert_allclose(one.metrics[name], wanted, rtol=1e-9)
    assert found.uncontrolled.metrics["peak_voltage"].max() == 0 and found.uncontrolled.loop is None
    np.testing.assert_array_equal(own.objective, 1.0)
    without, alone = reference_lines(spec, own, found)
    before = f"instead of {1e6 * own.own_run.metrics['residual_rms']:.4g} µm"
    assert without.endswith(
        f"residual_rms {1e6 * found.uncontrolled.own_run.metrics['residual_rms']:.4g} {before}"
    )
    assert alone.startswith(f"the best gain_factor alone, {gain:.4g} instead of 1 (of 8 values")
    assert f"{found.gain_alone.objective.mean():.4f} of the baseline's" in alone
    assert alone.endswith(before)


def test_deflections_below_one_adc_step_are_named(compared):
    spec, (own, _, found), _ = compared
    np.testing.assert_allclose(found.adc_step, frame_of(*check_run(spec.study)).adc_step)
    designs = [own, found.uncontrolled, found.gain_alone]
    assert resolution_lines(spec, designs, found.adc_step) == []
    values = sorted(one.own_run.metrics["residual_rms"] for one in designs)
    between = np.array([9.0, values[1] * 1.001, 9.0])
    (line,) = resolution_lines(spec, designs, between)
    told = f"one ADC step of {1e6 * between[1]:.3g} µm: the controller cannot measure these"
    assert line.startswith("residual_rms of 2 of these 3 designs are below") and told in line


@pytest.mark.parametrize(
    ("free", "sections", "scenarios"),
    [
        (GAIN, {}, {}),  # it is what is tuned
        (FREE, {"links": (False,) * 3}, {}),
        (FREE, {"feedback": "none"}, {}),
        (FREE, {"gain_factor": 0.0}, {}),
        (FREE, {}, {"spread": {"control.gain_factor": 5.0}}),  # it differs between machines
    ],
)
def test_the_gain_factor_is_left_out_where_it_says_nothing(free, sections, scenarios):
    spec = tuning(free, starts=1, scenarios=scenarios)
    changes = {f"control__{name}": value for name, value in sections.items()}
    assert scan_gain(spec._replace(study=spec.study.change(**changes)), None) is None
