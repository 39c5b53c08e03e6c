"""What the comparisons of an export say, on constructed results: nothing is compiled."""

from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import pytest

import studies
from jaxmodel.state_space import StateSpace
from studies.engine.blocks import ModalBlocks
from studies.engine.design import Design, as_design
from studies.export.floating import respond
from studies.export.request import Exported, ExportResult
from studies.export.verify import DOUBLE, WORST, Check, Verification, _limits, compare_values

NOTHING = Verification(checks=[], notes=[], runs={}, exchanges={}, counts={})
GOOD, BAD = Check("codes", "0", "0", True), Check("codes", "1", "0", False)


@pytest.mark.parametrize(
    "verified, is_good, has_failed",
    [
        (None, False, False),
        (NOTHING, False, False),
        (NOTHING._replace(checks=[GOOD]), True, False),
        (NOTHING._replace(checks=[GOOD, BAD]), False, True),
    ],
)
def test_an_export_is_good_only_if_something_was_compared(verified, is_good, has_failed):
    made = Exported(None, "json", (), ExportResult({}, None, verified), [])
    assert (made.is_good, made.has_failed) == (is_good, has_failed)


class Wires(NamedTuple):
    """What of a controller its arithmetic reads: one patch, no feed-through, no limit."""

    adc_step: np.ndarray = np.array(0.1)
    adc_bias: np.ndarray = np.array(0.0)
    adc_gain: np.ndarray = np.array(3.0)
    feedthrough: np.ndarray = np.zeros((1, 1, 1))
    voltage_limit: np.ndarray = np.array(1e30)


def of_two_poles(pole):
    """A controller of two nearly equal poles in companion form, whose output is a difference."""
    state = np.array([[pole * (2 - 1e-9), -(pole**2) * (1 - 1e-9)], [1.0, 0.0]])
    system = StateSpace(
        state=state[None, None],
        enter=np.array([[1.0], [0.0]])[None, None],
        leave=np.array([[1.0, -1.0]])[None, None],
        direct=np.zeros((1, 1, 1)),
    )
    blocks = ModalBlocks(1, np.array([0]), np.array([0]), system)
    return SimpleNamespace(channels=blocks, controller=Wires())


@pytest.mark.parametrize("pole, is_slow", [(0.5, False), (0.9999, True)])
def test_the_allowed_difference_follows_what_double_precision_rounds(pole, is_slow):
    """Slow poles add it up: the same sums in another order differ by more than 1e-12."""
    exported = of_two_poles(pole)
    codes = np.random.default_rng(0).integers(-100, 100, (5000, 1, 1))
    largest, allowed = _limits(exported, codes)
    assert largest == 0.0 and (DOUBLE < allowed < WORST if is_slow else allowed == DOUBLE)
    expected = respond(exported.channels, exported.controller, codes).command
    (one, other), _ = exported.channels.system.state[0, 0].tolist()
    values, x, old = [], 0.0, 0.0
    for volts in codes.ravel() * 0.1 / 3.0:
        values.append(x - old)
        x, old = one * x + (other * old + volts), x
    values = np.reshape(values, expected.shape)
    assert compare_values("", values, expected, allowed).is_met
    assert compare_values("", values, expected, DOUBLE).is_met is not is_slow
    assert not compare_values("", values * (1 + 1e-8), expected, allowed).is_met


def test_a_study_or_its_file_stands_for_a_design(tmp_path):
    study = studies.Study()
    (tmp_path / "mine.toml").write_text("")
    for given in (study, tmp_path / "mine.toml", str(tmp_path / "mine.toml"), Design(study, {})):
        assert as_design(given) == Design(study, {})
    with pytest.raises(studies.StudyError, match="dict; expected a study, its file, or a folder"):
        studies.export({}, tmp_path, target="json")
