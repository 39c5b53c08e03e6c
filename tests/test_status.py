"""Statuses of runs that end, but not as a designer would have it."""

import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.parameters import HOME
from studies.runs import run_study
from studies.spec import paper_study

STUDY = paper_study().change(
    link__modes=2, control__modes=2, run__duration=0.08, shaper__kind="none",
    motion__waypoints=(HOME, (0.0, 0.01, HOME[2])), motion__move_time=0.04,
    metrics__residual_length=0.02, metrics__residual_delay=0.01,
)  # fmt: skip


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
        ({"metrics__singularity_margin": 0.5}, status.NEAR_SINGULAR),
    ],
)
def test_a_run_that_ends_badly_says_so(changes, code):
    found = run(**changes)
    assert found.status == code
    assert np.isfinite(found.result.metrics.residual_rms).all()  # its numbers stay


def test_forces_along_the_links_are_those_of_the_rigid_motion():
    """N reaches 4.5 N for 10 mm in 0.05 s; what the links would stretch by then."""
    metrics = run(motion__move_time=0.05, control__feedback="none").result.metrics
    highest = max(metrics.peak_tension.max(), metrics.peak_compression.max())
    assert 3.0 < highest < 6.0
    assert 0.1e-6 < metrics.stretch_error_peak[:2].max() < 2 * highest * 0.2 / 1.4e6
