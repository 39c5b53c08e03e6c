"""Points of sampled sweeps: their seeds, the strata they fill, how often each value comes."""

import numpy as np
import pytest

from studies.space.methods import METHODS
from studies.space.table import build_table
from tests.sweeps import small_spec

#: Methods that draw points, and what a block of 64 rows of two axes says.
SAMPLED = {
    "random": {"count": 64},
    "latin_hypercube": {"count": 64, "size": 32},
    "sobol": {"count": 64},
    "morris": {"count": 16},
    "saltelli": {"count": 16},
}
UNIT = {"from": 0.0, "to": 1.0}
AXES = {"control.velocity_gain[0]": UNIT, "control.velocity_gain[1]": UNIT}


def points(method, seed=0, axes=AXES, **more):
    """Where the cases lie in the unit square, in their order, (n, 2)."""
    sweep = {"method": method, "seed": seed, "axes": axes, **SAMPLED[method], **more}
    table = build_table(small_spec(sweep))
    return np.stack([table.columns[name] for name in axes], axis=1)[table.origin]


def share_of_equal(a, b):
    """Share of the rows that two sets of points have in common."""
    kept = {tuple(row) for row in np.round(a, 12)}
    return np.mean([tuple(row) in kept for row in np.round(b, 12)])


def test_these_are_all_methods_that_draw():
    assert set(SAMPLED) == {name for name, one in METHODS.items() if one.points is not None}


@pytest.mark.parametrize("method", SAMPLED)
def test_points_belong_to_the_seed(method):
    one, same, other = (points(method, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, same)
    # grids of a few levels have points in common, but not in this order
    assert np.mean(np.all(one == other, axis=1)) < 0.5
    if method != "morris":
        assert share_of_equal(one, other) == 0


@pytest.mark.parametrize("method", SAMPLED)
def test_axes_of_a_block_are_independent(method):
    found = points(method)
    assert abs(np.corrcoef(found.T)[0, 1]) < 0.35
    assert np.mean(found[:, 0] == found[:, 1]) < 0.5


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_nested_blocks_draw_points_of_their_own(method):
    """Blocks of equal size in one another and side by side: none repeats another's numbers."""

    def block(k, **more):
        axes = {f"control.velocity_gain[{k}]": UNIT}
        return {"method": method, "count": 8, "axes": axes, **more}

    inner = block(1, blocks=[block(2)])
    further = {"method": method, "count": 8, "axes": {"drive.kd": {"from": 0.0, "to": 1.0}}}
    table = build_table(small_spec(block(0, seed=5, blocks=[inner, further])))
    names = [*(f"control.velocity_gain[{k}]" for k in range(3)), "drive.kd"]
    drawn = [np.unique(np.round(table.columns[name], 12)) for name in names]
    assert [len(x) for x in drawn] == [8] * 4 and len(table) == 8**4
    assert len(np.unique(np.concatenate(drawn))) == 32


def test_every_latin_hypercube_fills_every_stratum_with_points_of_its_own():
    found = points("latin_hypercube", count=128, size=32)
    parts = found.reshape(4, 32, 2)
    for part in parts:
        for axis in range(2):
            assert sorted((32 * part[:, axis]).astype(int)) == list(range(32))
    assert len(np.unique(parts.reshape(4, -1), axis=0)) == 4
    strata = [tuple((32 * part[:, 0]).astype(int)) for part in parts]
    assert len(set(strata)) == 4
    whole = points("latin_hypercube", count=64, size=64)
    assert sorted((64 * whole[:, 0]).astype(int)) == list(range(64))
    first = points("latin_hypercube", count=32, size=32)
    np.testing.assert_array_equal(first, parts[0])


def test_sobol_points_are_balanced():
    """Of 64 points each 1/64 of an axis has one, and each square of 1/8 too."""
    found = points("sobol")
    for axis in range(2):
        assert sorted((64 * found[:, axis]).astype(int)) == list(range(64))
    assert len({tuple(row) for row in (8 * found).astype(int)}) == 64
    np.testing.assert_array_equal(points("sobol", count=40), found[:40])


def test_random_points_are_uniform_without_strata():
    found = points("random", count=1024)
    for axis in range(2):
        counts = np.bincount((32 * found[:, axis]).astype(int), minlength=32)
        assert 20 < counts.var() < 50 and abs(found[:, axis].mean() - 0.5) < 0.03


def test_a_morris_design_takes_one_step_a_row():
    found = points("morris", count=30, levels=4).reshape(30, 3, 2)
    levels = np.array([0, 1 / 3, 2 / 3, 1])
    assert np.abs(found[..., None] - levels).min(axis=-1).max() < 1e-12
    moved = np.abs(np.diff(found, axis=1))
    np.testing.assert_allclose(np.sort(moved, axis=2), np.tile([0, 2 / 3], (30, 2, 1)), atol=1e-12)
    first = np.argmax(moved[:, 0], axis=1)
    assert np.all(np.argmax(moved[:, 1], axis=1) == 1 - first)  # each axis once
    assert 8 < first.sum() < 22 and len(np.unique(found[:, 0], axis=0)) > 8


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_every_value_comes_as_often(method):
    """Whole numbers, also the ends of the range, and choices."""
    axes = {
        "control.modes": {"from": 1, "to": 3},
        "shaper.kind": ["none", "zv", "ei"],
        "control.velocity_gain[0]": UNIT,
    }
    sweep = {"method": method, "count": 960, "axes": axes}
    table = build_table(small_spec(sweep))
    spread = 60 if method == "random" else 3
    for name in ("control.modes", "shaper.kind"):
        values, counts = np.unique(table.columns[name], return_counts=True)
        assert len(values) == 3 and np.all(np.abs(counts - 320) <= spread), (name, counts)


def test_ranges_are_linear_or_logarithmic_to_their_ends():
    axes = {
        "gain": {"from": 0.01, "to": 100.0, "scale": "log"},
        "drive.kd": {"from": 10.0, "to": 30.0},
    }
    table = build_table(small_spec({"method": "sobol", "count": 256, "axes": axes}))
    u = (np.log10(table.columns["control.gain_factor"]) + 2) / 4
    v = (table.columns["drive.kd"] - 10) / 20
    for x in (u, v):
        assert sorted((256 * x).astype(int)) == list(range(256))
    grid = build_table(small_spec({"axes": {n: x | {"count": 5} for n, x in axes.items()}}))
    np.testing.assert_allclose(
        np.unique(grid.columns["control.gain_factor"]), [0.01, 0.1, 1, 10, 100], rtol=1e-12
    )
    np.testing.assert_allclose(np.unique(grid.columns["drive.kd"]), [10, 15, 20, 25, 30])


def test_a_saltelli_design_swaps_one_axis_a_row():
    """Base points A and B of one Sobol sequence, then A with each axis of B."""
    found = points("saltelli").reshape(16, 4, 2)
    a, b = found[:, 0], found[:, 1]
    np.testing.assert_array_equal(found[:, 2], np.stack([b[:, 0], a[:, 1]], axis=1))
    np.testing.assert_array_equal(found[:, 3], np.stack([a[:, 0], b[:, 1]], axis=1))
    for column in (*a.T, *b.T):
        assert sorted((16 * column).astype(int)) == list(range(16))
    assert share_of_equal(a, b) == 0
