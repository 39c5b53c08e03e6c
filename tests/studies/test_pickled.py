"""Results can be unpickled where JAX is not to start yet, as in a pool of processes."""

import pickle
import subprocess
import sys

import jax
import pytest

from studies.engine.controller import fixed_controller
from studies.engine.runs import run_study
from tests.canonical import TINY, study_of

UNPICKLE = """
import pickle, sys
found = pickle.load(open(sys.argv[1], "rb"))
from studies.config import configure, is_backend_started
assert not is_backend_started(), "JAX was started"
configure(devices=1)
print(found.study.title)
"""


@pytest.mark.parametrize("make", [run_study, fixed_controller])
def test_results_hold_no_arrays_of_jax(make, tmp_path):
    found = make(study_of(TINY, title="of a pool"))
    assert not [x for x in jax.tree.leaves(found) if isinstance(x, jax.Array)]
    path = tmp_path / "found.pkl"
    path.write_bytes(pickle.dumps(found))
    done = subprocess.run(
        [sys.executable, "-c", UNPICKLE, path], capture_output=True, text=True, timeout=120
    )
    assert (done.stdout, done.stderr) == ("of a pool\n", "")
