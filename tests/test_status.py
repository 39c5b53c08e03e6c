"""Statuses of runs that end, but not as a designer would have it."""

import jax
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.parameters import HOME
from jaxmodel.simulate import _share_on, simulate
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import paper_study

STUDY = paper_study().change(
    link__modes=2,
    control__modes=2,
    run__duration=0.08,
    shaper__kind="none",
    motion__waypoints=(HOME, (0.0, 0.01, HOME[2])),
    motion__move_time=0.04,
    metrics__residual_length=0.02,
    metrics__residual_delay=0.01,
)


def run(**changes):
    return run_study(STUDY.change(**changes), has_record=False, has_loop=False)


def test_a_sound_run_is_ok_and_says_how_far_it_stays_from_singular_poses():
    found = run()
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
            {"motion__waypoints": (HOME, (0.0, 0.0266, HOME[2])), "control__feedback": "none"},
            status.NEAR_SINGULAR,
        ),
        ({"metrics__arrival_tolerance": 1e-9}, status.NOT_ARRIVED),
        (
            {"load__mass": 2.5, "motion__move_time": 0.03, "control__feedback": "none"},
            status.OVERLOADED,
        ),
        (  # a model that cannot buckle says so, too
            {
                "load__wrench": (200.0, 0.0, 0.0),
                "link__shortening": False,
                "control__feedback": "none",
            },
            status.OVERLOADED,
        ),
        ({"metrics__singularity_margin": 0.5}, status.NEAR_SINGULAR),
    ],
)
def test_a_run_that_ends_badly_says_so(changes, code):
    found = run(**changes)
    assert found.status == code
    assert np.isfinite(found.result.metrics.residual_rms).all()  # its numbers stay


def test_modes_damped_beyond_critical_are_refused():
    changes = {"link__modes": 8, "link__damping_ratio": 0.02, "link__damping_law": "stiffness"}
    with pytest.raises(
        StudyError, match="link.damping_ratio = 0.02; allowed: ratios .* up to 1.28"
    ):
        run(**changes)
    study = STUDY.change(**changes)
    found = jax.jit(simulate, static_argnums=0)(
        build_structure(study), as_arrays(build_case(study))
    )
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
    metrics = run(motion__move_time=0.05, control__feedback="none").result.metrics
    highest = max(metrics.peak_tension.max(), metrics.peak_compression.max())
    assert 3.0 < highest < 6.0
    assert 0.1e-6 < metrics.stretch_error_peak[:2].max() < 2 * highest * 0.2 / 1.4e6
