"""The search for gain margins on made-up curves: what it makes of what the steps find."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel.damping import least_controlled
from jaxmodel.gain_margin import AGAIN, CHOSEN, SWEEPS, VISITS, gain_margins
from jaxmodel.judge import _respond
from jaxmodel.loci import follow_loci
from jaxmodel.loop_figures import HIGHEST
from jaxmodel.pairs import Pair
from jaxmodel.steps import in_groups, lanes_of, scan_steps
from tests.loops import random_loops

#: Loops, and their modes [Hz].
N, MODES = 6, (110.0, 450.0, 1000.0)
HERTZ = 2 * np.pi


@pytest.fixture(scope="module")
def response():
    """A response whose lanes are told by their anti-alias filters."""
    structure, cases = random_loops(N, 1)
    shapes = jax.eval_shape(
        jax.vmap(lambda case: _respond(structure, case)[:2], out_axes=-1), cases
    )
    whole, modes = jax.tree.map(lambda x: np.ones(x.shape), shapes)
    modes = modes._replace(
        omega=HERTZ * np.array(MODES)[:, None] * np.ones(N),
        decay=np.ones((len(MODES), N)),
        growth=-np.ones(N),
    )
    return whole._replace(period=np.full(N, 1e-4), antialias=np.arange(float(N))), modes


def table(rows):
    """Values by loop, (k, N), from (loop, value), each loop's in the order given."""
    found = np.zeros((CHOSEN, N))
    for loop, value in rows:
        found[np.argmin(found[:, loop] > 0), loop] = value
    return found


@pytest.fixture
def judged(response):
    """Margins from what the steps find, by loop: crossings seen, and what each ends at."""

    def judge(seen, ends_at=(), again=(), fine=None, static=(), lost=(), strength=1.0, growth=None):
        sweeps = [table(seen), table(seen if fine is None else fine)]
        known = {round(a, 6): b for a, b in ends_at}
        beside, at_zero = dict(again), dict(static)

        def curves(loops, count, state):
            if count == VISITS:
                real = jnp.array([at_zero.get(k, 0.0) for k in range(N)])[loops]
                value = jnp.zeros_like(state.value.re).at[0].set(real)
                return state._replace(value=Pair(value, 0 * value))
            rows = sweeps[count > 20 * len(MODES) + SWEEPS[0].background]
            crossing = jnp.zeros_like(state.crossing).at[:CHOSEN].set(jnp.array(rows)[:, loops])
            far = 1e9 * jnp.isin(loops, np.array(lost, int)) * jnp.ones_like(crossing)
            return state._replace(
                value=Pair(far, 0 * far), crossing=crossing, place=HERTZ * 450.0 + 0 * crossing
            )

        def met(loops, state):
            value, step = jnp.zeros_like(state.value), jnp.full_like(state.value, 2.0)
            for row in (*sweeps[0].flat, *sweeps[1].flat):
                end = known.get(round(row, 6), row)
                is_it = jnp.abs(state.value - row) < 1e-9
                value = jnp.where(is_it, abs(end), value)
                step = jnp.where(is_it, 1e-3 * (0.9 if end > 0 else 1.1), step)
            for loop, (start, end) in beside.items():
                is_it = (loops == loop) & (jnp.abs(state.value - start) < 1e-9)
                value, step = jnp.where(is_it, end, value), jnp.where(is_it, 0.0, step)
            return state._replace(value=value, step=step)

        def steps(step, constants, inputs, state, count):
            loops = constants[0].antialias.astype(int)
            return curves(loops, count, state) if step is follow_loci else met(loops, state)

        whole, modes = response
        if growth is not None:
            modes = modes._replace(growth=growth)
        each = np.array([3.0, 2.0, 1.0])[:, None] * np.ones(N) * 1e-9
        whole_strength = np.full(N, 30.0 * strength)
        return jax.jit(lambda *x: gain_margins(*x, steps))(whole, modes, (whole_strength, each))

    return judge


def test_margins_are_the_inverse_of_the_rightmost_crossings(judged):
    found = judged([(0, 0.5), (0, 0.25), (1, 4.0), (2, 0.1), (3, 0.02)])
    np.testing.assert_allclose(found.margin, [2, 0.25, 10, 50, HIGHEST, HIGHEST])
    np.testing.assert_allclose(found.omega[:4], HERTZ * 450)
    assert np.all(np.isnan(found.omega[4:])) and found.is_known.all()
    assert not found.is_static.any()


def test_what_did_not_converge_leaves_the_margin_to_another_crossing(judged):
    """Its last step was not small, however large the value; the loop is looked at again."""
    found = judged([(0, 0.9), (0, 0.25), (1, 0.8)], [(0.9, -5.0), (0.8, -0.8)])
    np.testing.assert_allclose(found.margin[:2], [4, HIGHEST])
    assert found.is_known.tolist() == [False, False, *[True] * 4]


def test_loops_in_doubt_are_followed_again_more_finely(judged):
    """And only they: what the finer sweep finds of others is not asked for."""
    seen, fine = [(0, 0.9), (1, 0.5), (2, 0.3)], [(0, 0.7), (1, 0.6), (2, 0.3)]
    found = judged(seen, [(0.9, 0.4)], fine=fine)
    np.testing.assert_allclose(found.margin[:3], [1 / 0.7, 2, 1 / 0.3])
    assert found.is_known.all()
    coarse, again = SWEEPS
    assert again.background > coarse.background and len(again.beside) > len(coarse.beside)


def test_weakened_loops_get_their_own_margin(judged):
    found = judged([(0, 0.5), (1, 0.002)], strength=10.0)
    np.testing.assert_allclose(found.margin[:2], [0.2, 50])
    # where nothing is seen of gains examined much weaker, nothing is known
    found = judged([(0, 0.5)], strength=20.0)
    assert found.is_known.tolist() == [True, *[False] * 5]


@pytest.mark.parametrize("start", AGAIN)
def test_a_crossing_beside_the_one_found_counts_if_it_is_larger(judged, start):
    again = {0: (0.5 * start, 0.625), 1: (0.25 * start, 0.125)}
    found = judged([(0, 0.5), (1, 0.25)], again=again)
    np.testing.assert_allclose(found.margin[:2], [1.6, 4])


def test_ends_of_the_axis_count_too(judged):
    found = judged([(0, 0.5), (1, 0.25)], static={0: 0.4, 1: 0.8, 2: 0.1})
    np.testing.assert_allclose(found.margin[:3], [2, 1.25, 10])
    np.testing.assert_allclose(found.omega[:3], [HERTZ * 450, 0, 0])
    assert found.is_static.tolist() == [False, True, True, *[False] * 3]


def test_machines_that_fall_by_themselves_have_no_margin(judged):
    growth = np.where(np.arange(N) == 1, 1.0, -1.0)
    found = judged([(0, 0.5), (1, 0.25)], growth=growth)
    np.testing.assert_allclose(found.margin[:2], [2, 0])
    assert found.omega[1] == 0 and not found.is_static[1]


def test_curves_that_were_thrown_away_tell_nothing(judged):
    found = judged([(0, 0.5), (1, 0.25)], lost=[1])
    assert found.is_known.tolist() == [True, False, *[True] * 4]


# --- lanes ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("count", "size"), [(20, 8), (64 * 9, 9)], ids=["a few lanes", "many lanes"]
)
@pytest.mark.parametrize("chosen", [[], [4], [0, 3, 4, 5, 9], list(range(20))])
def test_groups_of_lanes_change_those_that_are_chosen(chosen, count, size):
    given, calls = np.arange(count, dtype=float), []

    def work(at):
        calls.append(at.shape)
        return lanes_of({"a": given, "b": np.stack([given, -given])}, at)

    mask = np.isin(np.arange(count), chosen)
    like = {"a": np.full(count, 7.0), "b": np.full((2, count), 8.0)}
    found = jax.jit(lambda mask: in_groups(work, mask, like))(mask)
    np.testing.assert_array_equal(found["a"], np.where(mask, given, 7.0))
    np.testing.assert_array_equal(found["b"], np.where(mask, [given, -given], 8.0))
    assert set(calls) == {(size,)}


def test_steps_as_a_scan():
    state = scan_steps(lambda c, row, x: c * x + row, 0.5, np.arange(3.0), np.array([8.0, 0.0]), 3)
    np.testing.assert_allclose(state, [3.5, 2.5])


def test_the_most_damped_modes_count():
    ratio = np.array([[0.1, 0.3], [0.4, 0.2], [0.2, 0.1]])
    np.testing.assert_allclose(least_controlled(ratio, np.array([2, 1])), [0.2, 0.3])
    assert np.isnan(least_controlled(ratio, np.array([0, 3]))).tolist() == [True, False]
