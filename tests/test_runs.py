"""A single run: steps it needs, statuses that must not read ok, ratios from its own first pass."""

import subprocess
import sys

import numpy as np
import pytest

from jaxmodel import status
from studies.engine.preflight import check_run
from studies.engine.runs import run_study
from studies.errors import StudyError
from tests.test_batch import short_study

SMALL = {"link__modes": 2, "control__modes": 2}


def judged(**changes):
    return run_study(short_study(**SMALL, **changes), has_record=False, has_loop=False)


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
        check_run(short_study(**SMALL, **changes))
    assert words in str(caught.value)


def test_a_blind_controller_is_not_ok():
    found = judged(electronics__conditioner_bias=100.0, control__links=(False, False, False))
    assert found.status == status.CLIPPED
    assert found.result.metrics.clipped_fraction == 1


def test_a_run_that_stops_has_no_metrics():
    found = judged(initial__load_deflection=(0.03, 0.03, 0.03))
    assert found.status == status.DIVERGED
    assert np.all(np.isnan(found.result.metrics.residual_rms))


def test_ratios_of_the_own_run():
    """Two passes in one: uncontrolled for the ratios (24), then controlled with them."""
    found = judged(control__ratio_source="own_run", control__ratio_exponent=0.5)
    off = judged(control__links=(False, False, False))
    ratio = off.result.metrics.energy_ratio
    np.testing.assert_allclose(ratio[:, 0], 1)
    assert np.all((ratio[:, 1] > 0) & (ratio[:, 1] < 1))
    rows = tuple(map(tuple, np.sqrt(ratio).tolist()))
    given = judged(control__ratios=rows)
    a, b = found.result.metrics.control_energy, given.result.metrics.control_energy
    np.testing.assert_allclose(a, b, rtol=1e-9)
    assert abs(judged().result.metrics.control_energy / b - 1) > 1e-6


def test_configure_comes_first():
    code = "from studies.study.spec import paper_study; from studies.engine.runs import run_study\n"
    code += "run_study(paper_study())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 1 and "studies.configure() must be called first" in done.stderr
