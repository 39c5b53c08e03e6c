"""Float32 on request, and one controlled mode: a run of both against float64."""

import jax
import numpy as np

from jaxmodel import status
from studies.engine.runs import run_study
from tests.canonical import TINY, study_of


def run():
    return run_study(study_of(TINY), has_record=False, has_loop=False).result


def test_float32_runs_and_agrees_with_float64():
    """That `studies.configure` turns it on: tests/studies/test_config.py."""
    whole = run()
    with jax.enable_x64(False):
        single = run()
    kinds = [result.metrics.residual_rms.dtype for result in (whole, single)]
    assert kinds == [np.float64, np.float32]
    assert single.status == whole.status == status.OK
    wanted = whole.metrics.residual_rms
    error = np.abs(single.metrics.residual_rms - wanted).max() / wanted.max()
    assert error < 0.02, error
    assert error > 0  # two precisions, not one
