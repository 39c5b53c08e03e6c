"""A single run: steps it needs, how it ends, statuses that must not read ok, ratios of its own."""

from functools import partial
from types import SimpleNamespace

import jax
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.bases import find_bases
from jaxmodel.defaults import HOME
from jaxmodel.prepare import _is_too_fast
from jaxmodel.simulate import _share_on
from studies import config
from studies.engine.preflight import _check_load, check_run
from studies.engine.runs import _simulate, run_study
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_structure
from tests.studies.engine.test_batch import short_study

#: Runs of all tests here have one length and two modes, so that they share two programs: links
#: with and without shortening.
SMALL = {"link__modes": 2, "control__modes": 2, "run__duration": 0.08}
#: A move that ends well, if little is left.
FAST = {
    "shaper__kind": "none",
    "motion__waypoints": (HOME, (0.0, 0.01, HOME[2])),
    "motion__move_time": 0.04,
    "metrics__residual_length": 0.02,
    "metrics__residual_delay": 0.01,
}
UNCONTROLLED = {"control__links": (False, False, False)}


def judged(**changes):
    return run_study(short_study(**SMALL | changes), has_record=False, has_loop=False)


def test_stiff_drive_gets_the_steps_it_needs():
    assert check_run(short_study(**SMALL, drive__kd=5000.0))[0].substeps == 2
    assert check_run(short_study(**SMALL))[0].substeps == 1


@pytest.mark.long
def test_stiff_drive_runs_as_with_many_steps():
    """A brake of 5000 N s/m is unstable at one step per sample; many more steps are the truth."""
    automatic = judged(drive__kd=5000.0)
    assert automatic.structure.substeps == 2
    fine = judged(drive__kd=5000.0, run__substeps=20)
    a, b = automatic.result.metrics.residual_rms, fine.result.metrics.residual_rms
    assert automatic.status == fine.status == status.OK
    assert np.abs(a - b).max() < 1e-3 * b.max()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"drive__kd": 5000.0, "run__substeps": 1}, "run.substeps = 1; allowed: 2 to 200"),
        ({"drive__coulomb_friction": 1e3}, "drive.coulomb_friction = 1000.0; allowed: small"),
        (
            {"metrics__residual_delay": 0.0, "metrics__residual_length": 1e-5},
            "metrics.residual_length = 1e-05; allowed: 0.0001 to",
        ),
        ({"drive__locked": True}, "motion.waypoints = "),
        ({"run__duration": 1e-5}, "run.duration"),
    ],
)
def test_what_no_run_can_do_is_refused(changes, words):
    with pytest.raises(StudyError) as caught:
        check_run(short_study(**SMALL | changes))
    assert words in str(caught.value)


def test_a_blind_controller_is_not_ok():
    found = judged(electronics__conditioner_bias=100.0, **UNCONTROLLED)
    assert found.status == status.CLIPPED
    assert found.result.metrics.clipped_fraction == 1


def test_a_run_that_stops_has_no_metrics():
    found = judged(initial__load_deflection=(0.03, 0.03, 0.03))
    assert found.status == status.DIVERGED
    assert np.all(np.isnan(found.result.metrics.residual_rms))


def test_ratios_of_the_own_run():
    """Two passes in one: uncontrolled for the ratios (24), then controlled with them."""
    found = judged(control__ratio_source="own_run", control__ratio_exponent=0.5)
    off = judged(**UNCONTROLLED)
    ratio = off.result.metrics.energy_ratio
    np.testing.assert_allclose(ratio[:, 0], 1)
    assert np.all((ratio[:, 1] > 0) & (ratio[:, 1] < 1))
    rows = tuple(map(tuple, np.sqrt(ratio).tolist()))
    given = judged(control__ratios=rows)
    a, b = found.result.metrics.control_energy, given.result.metrics.control_energy
    np.testing.assert_allclose(a, b, rtol=1e-9)
    assert abs(judged().result.metrics.control_energy / b - 1) > 1e-6


def test_a_sound_run_is_ok_and_says_how_far_it_stays_from_singular_poses():
    found = judged(**FAST)
    assert found.status == status.OK
    # guide 3: h = 0.1732 m + y, and gamma = arcsin(h/L) at most
    nearest = np.pi / 2 - np.arcsin((0.3 / 3**0.5 + 0.01) / 0.2)
    np.testing.assert_allclose(found.result.singularity_distance, nearest, rtol=1e-4)
    assert found.result.metrics.motor_saturated_fraction == 0


@pytest.mark.parametrize(
    ("changes", "code"),
    [
        ({"drive__force_limit": 0.1}, status.NOT_ARRIVED),  # a machine that hardly moves
        ({"drive__force_limit": 15.0}, status.MOTORS_SATURATED),
        (
            {
                "motion__waypoints": (HOME, (0.0, 0.0266, HOME[2])),
                "motion__move_time": 0.06,
                "metrics__residual_length": 0.01,
                "metrics__residual_delay": 0.005,
                "electronics__conditioner_gain": 0.01,  # within the range of the ADC
            }
            | UNCONTROLLED,
            status.NEAR_SINGULAR,
        ),
        ({"metrics__arrival_tolerance": 1e-9}, status.NOT_ARRIVED),
        (
            {"load__mass": 2.5, "motion__move_time": 0.03} | UNCONTROLLED,
            status.OVERLOADED,
        ),
        pytest.param(  # a model that cannot buckle says so, too
            {"load__wrench": (200.0, 0.0, 0.0), "link__shortening": False} | UNCONTROLLED,
            status.OVERLOADED,
            marks=pytest.mark.long,
        ),
        ({"metrics__singularity_margin": 0.5}, status.NEAR_SINGULAR),
        ({"patches__strain_limit": 2e-5}, status.STRAINED),
    ],
)
def test_a_run_that_ends_badly_says_so(changes, code):
    found = judged(**FAST | changes)
    assert found.status == code
    assert np.isfinite(found.result.metrics.residual_rms).all()  # its numbers stay


def test_modes_damped_beyond_critical_are_refused():
    changes = {"link__damping_ratio": 0.3, "link__damping_law": "stiffness"}
    with pytest.raises(StudyError, match="link.damping_ratio = 0.3; allowed: ratios .* up to 1.2"):
        judged(**FAST, **changes)
    study = short_study(**SMALL, **FAST, **changes)
    found = _simulate(build_structure(study), as_arrays(build_case(study)), False)
    assert found.status == status.OVERDAMPED


@pytest.mark.parametrize(
    ("start", "length"), [(0.01, 0.0), (0.01, 1e-5), (0.01003, 1e-5), (0.01, 1.5e-4), (0.0, 1.0)]
)
def test_pulses_keep_their_impulse(start, length):
    time = 1e-4 * np.arange(400)
    share = np.asarray(_share_on(time, start, length))
    acts = min(start + length, 0.04) - start
    np.testing.assert_allclose(share.sum() * 1e-4, acts, rtol=1e-9, atol=1e-15)
    assert np.all((share >= 0) & (share <= 1 + 1e-9))
    first = np.flatnonzero(share)
    assert first.size == 0 or time[first[0]] <= start + 1e-12


def test_forces_along_the_links_are_those_of_the_rigid_motion():
    """N reaches 4.5 N for 10 mm in 0.05 s; what the links would stretch by then."""
    metrics = judged(**FAST | {"motion__move_time": 0.05} | UNCONTROLLED).result.metrics
    highest = max(metrics.peak_tension.max(), metrics.peak_compression.max())
    assert 3.0 < highest < 6.0
    assert 0.1e-6 < metrics.stretch_error_peak[:2].max() < 2 * highest * 0.2 / 1.4e6


def test_configure_comes_first(monkeypatch):
    monkeypatch.setattr(config, "_is_configured", False)  # as after an import: see test_config
    with pytest.raises(StudyError, match=r"studies\.configure\(\) must be called first"):
        run_study(short_study())


def test_filters_beyond_half_the_sample_rate_are_too_fast_for_a_sampled_loop():
    study = short_study(**SMALL)
    structure, case = build_structure(study), as_arrays(build_case(study))
    corner = 1.01 * np.pi / case.electronics.period
    fast = case._replace(electronics=case.electronics._replace(antialias=corner))

    @partial(jax.jit, static_argnums=0)
    def found(structure, case):
        return _is_too_fast(structure, case, find_bases(structure, case))

    assert not found(structure, case) and found(structure, fast)
    assert not found(structure._replace(feedback="ideal"), fast)


def test_a_load_is_refused_for_the_link_that_it_compresses_most():
    share = np.array([[0.5, 0.2, 0.1], [0.3, 1.5, 1.1]])  # of the critical force, by way-point
    prepared = SimpleNamespace(steady_load=share, critical_force=np.array([10.0, 20.0, 30.0]))
    with pytest.raises(
        StudyError, match=r"critical force, 20 N \(here link 2: 30 N at way-point 2"
    ):
        _check_load(short_study(), prepared)
    _check_load(short_study(), SimpleNamespace(steady_load=0.6 * share))


def test_a_loop_of_thick_patches_is_judged():
    """Sensors of 40 V/um: the exponential of plant and filters was NaN, and with it the verdict."""
    study = short_study(
        **SMALL | FAST, patches__thickness=0.005, electronics__conditioner_gain=0.0005
    )
    run = run_study(study, has_record=False)
    assert run.status == status.OK
    assert run.loop.gain_margin > 1


def test_a_loop_without_a_verdict_is_never_ok(monkeypatch):
    """Whatever else the run was: an unstable loop would pass."""

    def fail(*_):
        raise np.linalg.LinAlgError("Array must not contain infs or NaNs")

    monkeypatch.setattr("studies.engine.runs.run_report", fail)
    run = run_study(short_study(**SMALL | FAST), has_record=False)
    assert run.status == status.UNJUDGED
    assert run.loop is None
    assert "no verdict on stability" in status.REASONS[run.status]
