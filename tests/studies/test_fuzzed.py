"""Inputs that `campaigns/fuzz.py` has found to end in something other than a message."""

from contextlib import suppress

import numpy as np
import pytest
from scipy.io import savemat

from campaigns.fuzz import BINARY, TARGETS
from campaigns.mutations import other_words
from studies.errors import StudyError
from studies.fitting.tables import read_columns
from tests import DATA

FUZZED = DATA / "fuzzed"


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


@pytest.mark.parametrize("name", TARGETS)
def test_a_target_reads_its_seeds_and_changes_of_them(tmp_path, name):
    """So that the campaign, which needs another package, still runs when it is wanted."""
    target, rng = TARGETS[name], np.random.default_rng(0)
    seeds, read = target.seeds(), target.make(tmp_path)
    for seed in seeds[:2]:
        read(seed)
    for _ in range(6 if name not in BINARY else 0):
        text = other_words(seeds[0].decode(), rng)
        with suppress(StudyError):
            read(text.encode(errors="replace"))
