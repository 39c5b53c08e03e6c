"""Steps of the margin's search, on made-up crossings."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest

from jaxmodel.loci import AxisCrossing
from jaxmodel.pairs import Pair
from studies.engine import margins
from studies.engine.margins import (
    CONVERGED,
    SWEEPS,
    Crossings,
    _converge,
    _is_confirmed,
    _judged,
    _JudgedBlock,
    _rightmost,
    judge_loops,
)
from studies.engine.stability import LoopFigures
from studies.study.cases import build_cases, build_structure
from studies.study.margin import HIGHEST
from tests.bare import paper_study

# --- Newton's iteration ---------------------------------------------------------------------------


def meeting(value, omega, step):
    none = Pair(np.zeros_like(value), np.zeros_like(value))
    return AxisCrossing(
        omega=omega,
        value=value,
        cosine=np.cos(omega),
        sine=np.sin(omega),
        step=step,
        by_omega=none,
        by_value=none,
    )


@pytest.mark.parametrize(
    ("step", "value", "wanted"),
    [
        (0.0, 0.5, True),
        (0.99e-3, 0.5, True),
        (1.01e-3, 0.5, False),
        (0.1, 0.5, False),
        (2.5, 0.5, False),
        (np.nan, 0.5, False),
        (0.0, -0.5, False),
        (0.0, 0.0, False),
        (0.0, np.nan, False),
        (0.0, np.inf, False),
    ],
)
def test_an_iteration_counts_when_its_last_step_is_small(monkeypatch, step, value, wanted):
    assert CONVERGED == 1e-3
    ended = meeting(np.array([value]), np.array([300.0]), np.array([step]))
    monkeypatch.setattr(margins, "run_steps", lambda *_: ended)
    response = SimpleNamespace(period=np.array([1e-4]))
    monkeypatch.setattr(margins.jax.tree, "map", lambda function, tree: tree)
    with np.errstate(invalid="ignore"):
        _, is_met = _converge(response, Crossings(np.zeros(1, int), *np.ones((2, 1))), response)
    assert is_met.tolist() == [wanted]


def test_the_largest_value_that_was_met_counts():
    value = np.array([0.5, 9.0, 0.7, 0.2, 3.0])
    case = np.array([0, 0, 0, 1, 3])
    is_met = np.array([True, False, True, True, False])
    assert _rightmost(value, is_met, case, 4).tolist() == [2, 3, -1, -1]


def test_a_crossing_is_confirmed_within_a_fifth_in_its_own_case():
    seen = Crossings(np.array([0, 0, 1, 1, 2]), np.array([1.0, 5.0, 1.0, 1.0, 1.0]), np.zeros(5))
    found = Crossings(np.array([1, 0, 1]), np.array([1.19, 1.0, 0.2]), np.zeros(3))
    assert _is_confirmed(seen, found).tolist() == [True, False, True, True, False]
    found = found._replace(value=np.array([1.21, 0.84, 0.82]))
    assert _is_confirmed(seen, found).tolist() == [True, False, False, False, False]


# --- from crossings to margins --------------------------------------------------------------------


class Response(NamedTuple):
    """As much of a response as is looked at."""

    period: Any
    velocity_gain: Any
    position_gain: Any = None


N = 8
HERTZ = 2 * np.pi


@pytest.fixture
def judged(monkeypatch):
    """Figures and doubts from what the steps found, by case: value and frequency [Hz]."""

    def judge(seen, found, met, ends=None, weaker=1.0, again=None, lanes_lost=(), **changes):
        def crossings(rows):
            case, value, hertz = (np.array(x) for x in zip(*rows, strict=True))
            return Crossings(case, value.astype(float), HERTZ * hertz)

        calls = []

        def meets(response, start, known):
            calls.append(start)
            if len(calls) == 1:
                value, step = (np.array(x, float) for x in zip(*met, strict=True))
                return meeting(value, start.omega, step), step < CONVERGED
            value = np.zeros_like(start.value)
            for case, more in (again or {}).items():
                value[case] = more
            return meeting(value, start.omega, 0 * value), value > 0

        at_end = np.zeros(N), np.full(N, np.nan)
        for case, value in (ends or {}).items():
            at_end[0][case], at_end[1][case] = value, 0.0
        nothing, lost = np.empty(0), np.isin(np.arange(N), lanes_lost)
        patches = {
            "_sweep_axis": lambda *_: (crossings(seen), nothing, nothing, lost),
            "_refine": lambda *_: crossings(found),
            "_converge": meets,
            "_end_eigenvalues": lambda *_: at_end,
            "_filters_grow": lambda _: np.zeros(N, bool),
        }
        for name, function in patches.items():
            monkeypatch.setattr(margins, name, function)
        modes = {
            "growth": np.full(N, -1.0),
            "omega": HERTZ * np.array([110.0, 450.0, 1000.0])[:, None] * np.ones(N),
            "share": np.eye(4)[1:].T[:, :, None] * np.ones(N),  # modes 1, 2 and 3
        }
        response = Response(np.full(N, 1e-4), np.ones((3, 2, N)))
        return _judged(
            response,
            SimpleNamespace(**(modes | changes)),
            np.full(N, weaker),
            SWEEPS[0],
            np.full((N, 2), 0.25),
        )

    return judge


def test_margins_are_the_inverse_of_the_rightmost_crossings(judged):
    rows = [(0, 0.5, 450), (0, 0.25, 110), (1, 4.0, 110), (2, 0.1, 990), (3, 0.02, 450)]
    figures, is_doubtful, _ = judged(rows, rows, [(x, 0.0) for _, x, _ in rows])
    np.testing.assert_allclose(figures.gain_margin[:5], [2, 0.25, 10, 50, HIGHEST])
    np.testing.assert_allclose(figures.breaking_frequency[:4], [450, 110, 990, 450])
    assert figures.breaking_mode[:4].tolist() == [2, 1, 3, 2]
    assert np.all(np.isnan(figures.breaking_frequency[4:]))
    assert np.all(np.isnan(figures.breaking_mode[4:])) and not is_doubtful.any()
    np.testing.assert_array_equal(figures.least_damping, 0.25)


def test_what_did_not_converge_leaves_the_margin_to_another_crossing(judged):
    """Far starts: their last step was not small, however large the value where they ended."""
    rows = [(0, 0.9, 450), (0, 0.25, 110), (1, 0.8, 450)]
    figures, *_ = judged(rows, rows, [(5.0, 2.0), (0.25, 1e-4), (0.8, 0.01)])
    np.testing.assert_allclose(figures.gain_margin[:2], [4, HIGHEST])
    assert figures.breaking_mode[0] == 1


def test_strange_crossings_are_doubtful(judged):
    """Seen on the sweep, not found again, and to the right of what was found."""
    seen = [(0, 0.5, 450), (1, 3.0, 450), (1, 0.4, 110), (2, 0.3, 110), (2, 0.9, 450), (3, 0.5, 9)]
    found = [(0, 0.5, 450), (1, 0.4, 110), (2, 0.9, 450)]
    figures, is_doubtful, _ = judged(seen, found, [(0.5, 0.0), (0.4, 0.0), (0.9, 0.0)])
    assert is_doubtful.tolist() == [False, True, False, True, *[False] * 4]
    np.testing.assert_allclose(figures.gain_margin[:4], [2, 2.5, 1 / 0.9, HIGHEST])


def test_weakened_loops_get_their_own_margin(judged):
    rows = [(0, 0.5, 450), (1, 0.002, 110)]
    figures, *_ = judged(rows, rows, [(0.5, 0.0), (0.002, 0.0)], weaker=10.0)
    np.testing.assert_allclose(figures.gain_margin[:2], [0.2, 50])


def test_a_crossing_beside_the_one_found_counts_if_it_is_larger(judged):
    rows = [(0, 0.5, 450), (1, 0.25, 110)]
    figures, *_ = judged(rows, rows, [(0.5, 0.0), (0.25, 0.0)], again={0: 0.625, 1: 0.125})
    np.testing.assert_allclose(figures.gain_margin[:2], [1.6, 4])


def test_ends_of_the_axis_count_too(judged):
    rows = [(0, 0.5, 450), (1, 0.25, 110)]
    figures, *_ = judged(rows, rows, [(0.5, 0.0), (0.25, 0.0)], ends={0: 0.4, 1: 0.8, 2: 0.1})
    np.testing.assert_allclose(figures.gain_margin[:3], [2, 1.25, 10])
    assert figures.breaking_frequency[:3].tolist() == [450, 0, 0]
    assert figures.breaking_mode[0] == 2 and np.all(np.isnan(figures.breaking_mode[1:3]))


def test_machines_that_fall_by_themselves_have_no_margin(judged):
    growth = np.where(np.arange(N) == 1, 1.0, -1.0)
    rows = [(0, 0.5, 450), (1, 0.25, 110)]
    figures, *_ = judged(rows, rows, [(0.5, 0.0), (0.25, 0.0)], growth=growth)
    np.testing.assert_allclose(figures.gain_margin[:2], [2, 0])


def test_what_the_sweep_cannot_tell_is_left_to_eigenvalues(judged):
    """Where it was thrown away, and where nothing was found of gains examined much weaker."""
    rows = [(0, 0.5, 450), (1, 0.25, 110)]
    *_, is_beyond = judged(rows, rows, [(0.5, 0.0), (0.25, 0.0)], lanes_lost=[1])
    assert np.flatnonzero(is_beyond).tolist() == [1]
    *_, is_beyond = judged(rows, rows, [(0.5, 0.0), (0.25, 0.0)], weaker=20.0)
    assert not is_beyond[:2].any() and is_beyond[2:].all()


# --- two sweeps ----------------------------------------------------------------------------------


def test_doubtful_loops_are_walked_again_more_finely(monkeypatch):
    """And only they; what the finer sweep finds stays."""
    calls = []

    def block(structure, sweep, most, cases, rows):
        calls.append((SWEEPS.index(sweep), rows.tolist()))
        value = 10.0 * (1 + SWEEPS.index(sweep)) + rows
        figures = LoopFigures(
            gain_margin=value,
            breaking_frequency=value + 100,
            breaking_mode=value + 200,
            least_damping=np.stack([value] * 3, axis=1),
        )
        return _JudgedBlock(figures, np.isin(rows, [1, 4]), np.zeros(len(rows), bool))

    monkeypatch.setattr(margins, "_judge_block", block)
    study = paper_study()
    structure = build_structure(study)
    gains = {"control.gain_factor": np.linspace(0.1, 0.6, 6)}
    found = judge_loops(structure, build_cases(study, gains, structure))
    wanted = np.array([10.0, 21, 12, 13, 24, 15])
    np.testing.assert_array_equal(found.gain_margin, wanted)
    np.testing.assert_array_equal(found.breaking_frequency, wanted + 100)
    np.testing.assert_array_equal(found.breaking_mode, wanted + 200)
    np.testing.assert_array_equal(found.least_damping, np.stack([wanted] * 3, axis=1))
    assert sorted(k for sweep, rows in calls for k in rows if sweep == 0) == list(range(6))
    assert sorted(k for sweep, rows in calls for k in rows if sweep == 1) == [1, 4]
    coarse, fine = SWEEPS
    assert fine.background > coarse.background and len(fine.beside) > len(coarse.beside)
    assert fine.repeats > coarse.repeats
