"""Float32 on request, and one controlled mode: a run of both against float64."""

import subprocess
import sys

import numpy as np

from jaxmodel import status
from studies.engine.runs import run_study
from tests.canonical import TINY, study_of

STUDY = study_of(TINY, control__modes=1, control__gain_factor=0.1)
SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from studies import config
config.configure("float32")
config.keep_programs()
from studies.engine.runs import run_study
from tests.studies.test_precision import STUDY
result = run_study(STUDY, has_record=False, has_loop=False).result
rms = result.metrics.residual_rms
print(rms.dtype, int(result.status), *map(float, rms.ravel()))
"""


def test_float32_runs_and_agrees_with_float64(pytestconfig):
    whole = run_study(STUDY, has_record=False, has_loop=False).result
    assert whole.metrics.residual_rms.dtype == np.float64
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT, str(pytestconfig.rootpath)],
        capture_output=True,
        text=True,
        timeout=300,
        check=True,
    )
    kind, code, *values = done.stdout.split()
    assert kind == "float32" and int(code) == int(whole.status) == status.OK
    wanted = whole.metrics.residual_rms.ravel()
    error = np.abs(np.array(values, float) - wanted).max() / wanted.max()
    assert error < 0.02, error
    assert error > 0  # two precisions, not one
