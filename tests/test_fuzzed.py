"""Inputs that `tests/fuzz.py` has found to end in something other than a message."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import savemat

from studies.errors import StudyError
from studies.fitting.tables import read_columns

DATA = Path(__file__).parent / "data" / "fuzzed"


def test_a_measurement_that_crashes_the_reader_of_mat_files_is_refused():
    """SciPy's, which thus runs in a process of its own."""
    with pytest.raises(StudyError, match=r"file: .*crash.mat cannot be read"):
        read_columns("crash.mat", DATA, "file")


def test_names_of_variables_are_not_those_of_arguments(tmp_path):
    values = np.arange(3.0)
    savemat(tmp_path / "x.mat", {"file": values, "allow_pickle": values + 1j})
    found = read_columns("x.mat", tmp_path, "file")
    assert list(found) == ["file", "allow_pickle"]
    np.testing.assert_array_equal(found["allow_pickle"], values + 1j)
