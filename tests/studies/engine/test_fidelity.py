"""Whether the linear model ranks designs as the full one: by random designs of the user's space."""

import numpy as np
import pytest

from studies.engine import fidelity
from studies.engine.fidelity import Agreement, agreement
from studies.errors import StudyError
from studies.space.table import build_table
from tests.bare import parse_sweep
from tests.canonical import TINY

GAINS = TINY | {
    "control": {"feedback": "none"},
    "sweep": {"axes": {"link.thickness": {"from": 1e-3, "to": 3e-3, "count": 12}}},
}


def test_small_motions_are_ranked_alike():
    spec = parse_sweep(GAINS)
    found = agreement(spec, build_table(spec), "residual_rms")
    assert found.n == 12 and found.correlation > 0.95 and found.recalled == 3
    assert "12 random designs" in found.text and "3 of the best 3 in common" in found.text
    found.check("")
    assert agreement(spec, build_table(spec), "gain_margin") is None  # no run finds it


@pytest.mark.parametrize("by, sign", [("residual_rms", 1), ("-residual_rms", -1)])
def test_ranks_are_compared_by_what_comes_first(monkeypatch, by, sign):
    """Values of two models, known: reversed ranks are refused, one failed design is left out."""
    spec = parse_sweep(GAINS)
    rising = np.arange(12.0)

    def values(spec, table, rows, entry, is_linear):
        assert entry == "residual_rms" and rows.tolist() == list(range(12))
        return rising[::-1] ** 2 if is_linear else np.where(rising == 4, np.nan, rising)

    monkeypatch.setattr(fidelity, "_values", values)
    found = agreement(spec, build_table(spec), by)
    assert found == Agreement("residual_rms", 11, pytest.approx(-1.0), 0)
    with pytest.raises(StudyError, match=r"correlation of residual_rms -1.00, .*; allowed: 0.8 or"):
        found.check("Rank by another metric.")
    monkeypatch.setattr(fidelity, "_values", lambda *_: sign * rising**3)
    assert agreement(spec, build_table(spec), by).recalled == 3


def test_too_few_designs_say_nothing():
    spec = parse_sweep(GAINS)
    found = agreement(spec, build_table(spec).rows(np.arange(5)), "residual_rms")
    assert np.isnan(found.correlation) and not found.is_poor and "too few" in found.text
    found.check("")
