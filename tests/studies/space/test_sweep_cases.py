"""From a sweep file to its table of cases: designs, conditions, ids; and what is refused."""

from functools import partial

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxmodel.numbers import case_of
from studies.engine.results import read_sweep
from studies.errors import StudyError
from studies.space.methods import morris_points, saltelli_points
from studies.space.spec import load_sweep
from studies.space.table import build_table, case_study
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.fields import Fields, padded
from studies.study.numbers import build_cases, study_numbers
from tests.bare import parse_sweep
from tests.canonical import MACHINE
from tests.sweeps import BASE, MIXED, run_sweep, small, small_spec


def table_of(sweep, **sections):
    return build_table(small_spec(sweep, **sections))


def test_grid_is_every_combination_in_order():
    table = table_of({"axes": {"gain": [1.0, 2.0], "drive.kp": [1e4, 2e4, 3e4]}})
    np.testing.assert_array_equal(table.columns["control.gain_factor"], [1, 1, 1, 2, 2, 2])
    np.testing.assert_array_equal(table.columns["drive.kp"], [1e4, 2e4, 3e4] * 2)


def test_blocks_nest():
    pairs = {"method": "zip", "axes": {"gain": [1.0, 2.0], "drive.kd": [10.0, 20.0]}}
    listed = {"method": "list", "cases": [{"drive.kp": 1e4}, {"drive.force_limit": 50.0}]}
    table = table_of({"axes": {"move_time": [0.01, 0.012]}, "blocks": [pairs, listed]})
    assert len(table) == 2 * 2 * 2
    rows = set(
        zip(*(table.columns[n].tolist() for n in ("control.gain_factor", "drive.kd")), strict=True)
    )
    assert rows == {(1.0, 10.0), (2.0, 20.0)}
    # what a listed case does not name keeps the base study's value
    assert set(table.columns["drive.force_limit"].tolist()) == {1e3, 50.0}


def test_log_range_and_whole_numbers():
    axes = {
        "gain": {"from": 0.1, "to": 10, "count": 3, "scale": "log"},
        "plant_modes": {"from": 2, "to": 5, "count": 4},
    }
    table = table_of({"axes": axes})
    np.testing.assert_allclose(np.unique(table.columns["control.gain_factor"]), [0.1, 1, 10])
    assert table.columns["link.modes"].dtype.kind == "i"
    assert set(table.columns["link.modes"].tolist()) == {2, 3, 4, 5}


@pytest.mark.parametrize("method", ["random", "latin_hypercube", "sobol"])
def test_sampled_points_fill_their_ranges_and_can_be_continued(method):
    def columns(count):
        extra = {"size": 32} if method == "latin_hypercube" else {}
        axes = {
            "gain": {"from": 1, "to": 100, "scale": "log"},
            "control.velocity_gain[1]": {"from": -2, "to": 2},
            "controlled_modes": {"from": 1, "to": 3},
            "shaper": ["zv", "ei"],
        }
        return table_of({"method": method, "count": count, "axes": axes, **extra})

    few, many = columns(32), columns(64)
    for name in few.columns:
        np.testing.assert_array_equal(few.columns[name], many.columns[name][:32])
    np.testing.assert_array_equal(few.case_id, many.case_id[:32])
    gain = np.log10(many.columns["control.gain_factor"])
    assert 0 <= gain.min() < 0.3 and 1.7 < gain.max() <= 2
    assert abs(gain.mean() - 1) < 0.2
    assert set(many.columns["control.modes"].tolist()) == {1, 2, 3}
    assert set(many.columns["shaper.kind"].tolist()) == {"zv", "ei"}
    study = case_study(many, 5)
    assert study.control.velocity_gain[1] == many.columns["control.velocity_gain[1]"][5]
    assert study.control.velocity_gain[0] == 1.55


@pytest.mark.parametrize("kind", ["same", "mirrored", "per_link"])
def test_placements_fit_on_the_link(kind):
    axes = {"placement": {"kind": kind}}
    table = table_of({"method": "sobol", "count": 128, "axes": axes})
    centers = table.columns["patches.centers"]
    assert centers.shape == ((128, 3, 3) if kind == "per_link" else (128, 3))
    assert centers.min() >= 0.015 and centers.max() <= 0.185
    assert np.diff(centers, axis=-1).min() >= 0.03 - 1e-12
    assert np.ptp(centers[..., 0]) > 0.05
    if kind == "mirrored":
        np.testing.assert_allclose(centers + centers[:, ::-1], 0.2)


def test_placements_on_a_grid_of_candidates():
    table = table_of({"axes": {"placement": {"kind": "same", "candidates": 8}}})
    centers = table.columns["patches.centers"]
    assert np.diff(centers, axis=1).min() >= 0.03 - 1e-12
    assert set(np.round(centers.ravel(), 9)) <= set(np.round(np.linspace(0.015, 0.185, 8), 9))
    assert len(table) == 20  # of 56 triples, those two steps apart: C(6, 3)


def test_ready_made_axes_of_links_and_modes():
    subsets = table_of({"axes": {"link_subsets": "all"}})
    assert len(subsets) == 8 and subsets.columns["control.links"].shape == (8, 3)
    masks = table_of({"axes": {"link_mode_masks": "all"}})
    assert len(masks) == 512 and masks.columns["control.mode_mask"].shape == (512, 3, 3)
    error = table_of({"axes": {"frequency_error": [-0.3, 0.0, 0.3]}})
    np.testing.assert_allclose(error.columns["link.stiffness_factor"], [0.49, 1, 1.69])
    kinds = table_of({"axes": {"shaper": "all"}})
    assert len(kinds) == 8
    frequency = table_of({"axes": {"shaper_frequency": [90.0, 120.0]}})
    assert case_study(frequency, 1).shaper.frequencies_hz == (120.0,)


def test_conditions_leave_cases_out():
    sweep = {"axes": {"controlled_modes": [1, 2, 3], "plant_modes": [2, 3], "gain": [0.5, 1.0]}}
    for where, count in (
        ("control.modes <= link.modes", 10),
        ("control.modes in [1, 3] and not link.modes == 2", 4),
        ("1 < controlled_modes <= 3 or gain * 2 > 1.5", 10),
        ("abs(gain - 1) < 0.1 and max(link.modes, 3) == 3", 6),
        ("drive.kp == 2e4 and control.links[0] and shaper.kind == 'zv'", 12),
    ):
        assert len(table_of(sweep | {"where": where})) == count, where


def test_id_and_seed_belong_to_the_case_not_to_the_sweep():
    one = table_of({"axes": {"gain": [0.25, 0.5, 1.0]}})
    other = table_of({"axes": {"gain": [1.0, 0.25], "drive.kp": [2e4, 3e4]}})
    shared = set(one.case_id.tolist()) & set(other.case_id.tolist())
    assert len(shared) == 2  # kp = 2e4 is the base study's value
    for case_id in shared:
        a = int(np.flatnonzero(one.case_id == case_id)[0])
        b = int(np.flatnonzero(other.case_id == case_id)[0])
        assert one.seed[a] == other.seed[b]
        assert case_study(one, a) == case_study(other, b)
    whole = table_of({"axes": {"control.velocity_gain": [[1.55, 9.0, 1.7]]}})
    entry = table_of({"axes": {"control.velocity_gain[1]": [9.0]}})
    np.testing.assert_array_equal(whole.case_id, entry.case_id)
    reseeded = table_of({"axes": {"gain": [0.25, 0.5, 1.0]}}, run={"duration": 0.025, "seed": 1})
    assert not set(one.case_id.tolist()) & set(reseeded.case_id.tolist())
    swept = table_of({"axes": {"gain": [0.25, 0.5, 1.0], "run.seed": [1]}})
    np.testing.assert_array_equal(swept.case_id, reseeded.case_id)
    np.testing.assert_array_equal(swept.seed, reseeded.seed)
    assert len(np.unique(one.seed)) == 3


@pytest.mark.parametrize(
    ("sweep", "count"),
    [
        ({"repeats": 3}, 3),
        pytest.param({}, 1, marks=pytest.mark.long),
        pytest.param({"axes": {"run.duration": [0.025, 0.03]}}, 2, marks=pytest.mark.long),
    ],
)
def test_cases_that_differ_in_no_number_run(sweep, count, tmp_path):
    """They share every array, seeds included, as long as there is no noise."""
    done = run_sweep(parse_sweep(MACHINE | {"sweep": sweep}), tmp_path / "sweep")
    assert done.n_run == count
    rms = read_sweep(tmp_path / "sweep")["structural_rms"]
    assert len(rms) == count and np.isfinite(rms).all()


def test_doubles_are_found_by_columns_as_by_ids():
    spec = small_spec({"method": "random", "count": 60, "axes": {"gain": [0.5, 0.7, 0.9]}})
    by_id = build_table(spec, np.arange(60))
    by_column = build_table(spec, np.arange(60), has_ids=False)
    assert len(by_id) == 3 and by_id.n_double == 57
    for name in ("row", "origin", "case_id", "seed"):
        np.testing.assert_array_equal(getattr(by_id, name), getattr(by_column, name))


def test_repeats_have_seeds_of_their_own_and_doubles_run_once():
    table = table_of({"axes": {"gain": [0.5, 1.0]}, "repeats": 3})
    assert len(table) == 6 and len(np.unique(table.seed)) == 6
    double = table_of({"method": "list", "cases": [{"drive.kp": k} for k in (1e4, 2e4, 1e4)]})
    assert len(double) == 2 and double.n_double == 1
    np.testing.assert_array_equal(double.origin, [0, 1, 0])


def test_arrays_of_many_cases_equal_those_of_each():
    sweep = {
        "method": "random",
        "count": 12,
        "axes": {
            "placement": {"kind": "per_link"},
            "plant_modes": [2, 3],
            "controlled_modes": [1, 2, 3],
            "link_subsets": "all",
            "control.ratios": [[[1.0], [1.0], [1.0]], [[1, 0.5, 0.1], [1, 0.2], [1.0]]],
            "control.velocity_gain[2]": {"from": 1, "to": 5},
            "control.ratio_exponent": {"from": 0, "to": 2},
            "shaper": "all",
            "move_time": {"from": 0.01, "to": 0.012},
            "machine.assembly": "all",
            "electronics.lowpass_ratio": [[3.0], [2.0, 1.5]],
            "frequency_error": {"from": -0.2, "to": 0.2},
            "initial.modal": [[], [[1e-4], [], [0, 1e-5]]],
        },
    }
    table = table_of(sweep)
    structure = build_structure(case_study(table, 0))._replace(n_modes=3, n_controlled=3)
    columns = table.fields | {"run.seed": table.seed}
    together = build_cases(table.study, columns, structure)
    for k in range(12):
        study = case_study(table, k)
        alone = build_cases(study, {}, structure)
        for a, b in zip(leaves(together), leaves(alone), strict=True):
            np.testing.assert_allclose(a[k if len(a) > 1 else 0], b[0], rtol=1e-12)
    assert as_arrays(build_case(table.study)).control.ratio.shape == (3, 3)


def leaves(tree):
    import jax

    return jax.tree.leaves(tree)


@pytest.mark.parametrize("name", ["gains", "links", "mistuning", "models", "placement"])
def test_the_map_from_names_to_the_model_is_jax(name):
    """Traced and mapped over the numbers that vary it gives what it gives with NumPy."""
    table = build_table(load_sweep(f"studies/specs/{name}.toml"))
    columns = {**table.fields, "run.seed": table.seed}
    structure = build_structure(table.study, columns)
    numbers = study_numbers(table.study, structure, columns)
    is_own = jax.tree.map(lambda x: len(x) > 1, numbers)
    assert 0 < sum(jax.tree.leaves(is_own)) < 12
    axes = jax.tree.map(lambda own: 0 if own else None, is_own)
    mapped = jax.vmap(partial(case_of, structure), (axes,))
    given = jax.tree.map(lambda x, own: x if own else x[0], numbers, is_own)
    for x, y in zip(
        jax.tree.leaves(jax.jit(mapped)(given)),
        jax.tree.leaves(case_of(structure, numbers)),
        strict=True,
    ):
        np.testing.assert_allclose(x, np.broadcast_to(y, x.shape), rtol=1e-14)


def test_an_entry_that_is_a_list_can_vary():
    table = table_of({"axes": {"motion.waypoints[1]": [[0.0, 0.003, 0.5], [0.0, 0.001, 0.5]]}})
    found = Fields(table.study, table.fields).numbers("motion.waypoints")
    np.testing.assert_array_equal(found[:, 1], [[0.0, 0.003, 0.5], [0.0, 0.001, 0.5]])
    np.testing.assert_array_equal(found[:, 0], [table.study.motion.waypoints[0]] * 2)


def test_ragged_lists_are_padded():
    array = padded([((1.0,), (2.0, 3.0)), ((4.0, 5.0, 6.0), ())], 2)
    assert array.shape == (2, 2, 3)
    assert np.isnan(array[0, 0, 1]) and array[1, 0, 2] == 6 and np.isnan(array[1, 1]).all()
    np.testing.assert_array_equal(padded([2.0, (3.0, 4.0)], 2), [[2.0, 2.0], [3.0, 4.0]])


def test_designs_for_sensitivity():
    points = saltelli_points(np.random.default_rng(0).random((4, 6))).reshape(4, 5, 3)
    for a, b, *mixed in points:
        for i, row in enumerate(mixed):
            np.testing.assert_array_equal(row, np.where(np.arange(3) == i, b, a))
    rows = morris_points(10, 4, 4, 0).reshape(10, 5, 4)
    assert rows.min() >= 0 and rows.max() <= 1
    step = np.abs(np.diff(rows, axis=1))
    np.testing.assert_allclose(np.sort(step, axis=2)[..., -1], 2 / 3)
    np.testing.assert_allclose(np.sort(step, axis=2)[..., :-1], 0, atol=1e-12)
    assert np.all(np.sum(step > 0, axis=1) == 1)
    # of three levels the middle one leads to both ends
    rows = morris_points(40, 1, 3, 0).reshape(40, 2)
    assert set(rows[rows[:, 0] == 0.5, 1]) == {0.0, 1.0}


@pytest.mark.parametrize(
    ("name", "count"),
    [
        ("placement", 4096),
        ("gains", 216),
        ("links", 48),
        ("spillover", 120),
        ("robustness", 400),
        ("mistuning", 507),
        ("models", 90),
    ],
)
def test_ready_sweeps_are_valid(name, count):

    table = build_table(load_sweep(name))
    assert len(table) == count
    case_study(table, len(table) - 1)


def range_of(**changes):
    return {"axes": {"gain": {"from": 1, "to": 2, "count": 3} | changes}}


REFUSED = [
    ({"axes": {"control.gain_facto": [1]}}, "did you mean 'control.gain_factor'?"),
    ({"axes": {"gain_factor": [1]}}, "did you mean 'control.gain_factor'?"),
    ({"axes": {"gain": []}}, "sweep.axes.gain = []; allowed: a list of values, a range"),
    ({"axes": {"gain": 3}}, "sweep.axes.gain = 3; allowed: a list of values"),
    ({"axes": {"gain": "al"}}, "sweep.axes.gain = 'al'; allowed: a list"),
    ({"axes": {"gain": "all"}}, "'all' for a choice or a switch only"),
    ({"axes": {"gain": [-1.0]}}, "control.gain_factor = -1.0; allowed: a finite number >= 0"),
    ({"axes": {"gain": ["x"]}}, "control.gain_factor = 'x'; allowed: a finite number"),
    ({"axes": {"gain": [float("nan")]}}, "allowed: a finite number"),
    (range_of(to=1), "sweep.axes.gain.to = 1.0; allowed: more than sweep.axes.gain.from = 1"),
    (range_of(to=float("inf")), "sweep.axes.gain.to = inf; allowed: a finite number"),
    (range_of(to=1e9), "control.gain_factor = 1000000000.0; allowed: a finite number >= 0 and <="),
    (range_of(frm=1), "did you mean 'sweep.axes.gain.from'?"),
    (range_of(scale="lg"), "allowed: 'linear' or 'log'"),
    (
        range_of(scale="log")
        | {"axes": {"gain": {"from": 0, "to": 1, "count": 2, "scale": "log"}}},
        "more than 0 on a log scale",
    ),
    (range_of(count=0), "a range needs count"),
    (range_of(count=10**9), "sweep.axes.gain.count = 1000000000; allowed: a whole number"),
    ({"axes": {"plant_modes": {"from": 1.5, "to": 3, "count": 2}}}, "whole numbers at both ends"),
    ({"axes": {"plant_modes": [2.5]}}, "link.modes = 2.5; allowed: a whole number"),
    ({"axes": {"control.velocity_gain[3]": [1.0]}}, "no such entry"),
    ({"axes": {"control.velocity_gain[x]": [1.0]}}, "unknown field"),
    ({"axes": {"control.velocity_gain": [[1.0, 2.0]]}}, "allowed: 3 finite numbers"),
    ({"axes": {"shaper": ["ie"]}}, "shaper.kind = 'ie'; allowed"),
    ({"axes": {"link_subsets": ["1+4"]}}, "sweep.axes.link_subsets = '1+4'; allowed: none, 1"),
    ({"axes": {"placement": "all"}}, "sweep.axes.placement = 'all'; allowed: a section with"),
    ({"axes": {"placement": {"kind": "mirored"}}}, "did you mean 'mirrored'?"),
    ({"axes": {"placement": {"kind": "same"}}}, "a range needs count"),
    ({"axes": {"frequency_error": [-1.5]}}, "allowed: more than -1"),
    ({"axes": {"gain": [1.0], "control.gain_factor": [2.0]}}, "control.gain_factor varies twice"),
    ({"axes": {"control.links": [[True] * 3], "control.links[0]": [False]}}, "as a whole and by"),
    ({"method": "gird", "axes": {"gain": [1.0]}}, "did you mean 'grid'?"),
    ({"method": "sobol", "axes": {"gain": [1.0]}}, "sweep.count = 0; allowed: 1 or more"),
    ({"method": "sobol", "count": 4}, "sweep.axes = {}; allowed: one axis or more"),
    ({"count": 4, "axes": {"gain": [1.0]}}, "sweep.count = 4; allowed: 0"),
    ({"method": "list"}, "sweep.cases"),
    ({"method": "list", "cases": [{"gain": 1.0}]}, "write the field it stands for"),
    ({"method": "zip", "axes": {"gain": [1.0], "drive.kp": [1.0, 2.0]}}, "axes of one length"),
    ({"method": "latin_hypercube", "count": 5, "size": 2, "axes": {"gain": [1.0]}}, "a multiple"),
    ({"blocks": [{}]}, "sweep.blocks.0 = {}"),
    ({"blocks": [{"method": "grid", "axs": {}}]}, "sweep.blocks.0.axs"),
    ({"blocks": [{"method": "morris", "count": 2, "axes": {"gain": [1.0]}}]}, "stand alone"),
    (
        {
            "axes": {
                "gain": {"from": 1, "to": 2, "count": 10**4},
                "drive.kp": {"from": 1, "to": 2, "count": 10**4},
            }
        },
        "1e+08 cases; allowed: up to 10000000",
    ),
    ({"where": "gain >", "axes": {"gain": [1.0]}}, "not a condition"),
    ({"where": "gian > 1", "axes": {"gain": [1.0]}}, "unknown field; did you mean 'gain'?"),
    ({"where": "gain", "axes": {"gain": [1.0]}}, "gives no true or false"),
    ({"where": "gain == 'x'", "axes": {"gain": [1.0]}}, "mixes text and numbers"),
    ({"where": "gain > 5", "axes": {"gain": [1.0]}}, "true for none of 1 cases"),
    ({"where": "__import__('os').system('x')", "axes": {"gain": [1.0]}}, "cannot be used here"),
    ({"where": "(lambda: 1)() > 0", "axes": {"gain": [1.0]}}, "cannot be used here"),
    ({"where": "control.links > 1", "axes": {"gain": [1.0]}}, "a list; name one entry"),
    ({"where": "9**9**9**9 > 1 and " * 60 + "1 > 0", "axes": {}}, "characters; allowed: up to"),
    ({"metrics": ["residual"], "axes": {"gain": [1.0]}}, "sweep.metrics = 'residual'"),
    ({"repeats": 0, "axes": {"gain": [1.0]}}, "sweep.repeats = 0; allowed: a whole number >= 1"),
    ({"axes": {"patches.centers": [[0.05], [0.05, 0.1]]}}, "lists of different shape"),
    ({"axes": {"placement": {"candidates": 2}}}, "so many that 3 patches fit on them apart"),
    (range_of(to=10**400), "allowed: a finite number"),
    ({"axes": {"frequency_error": [10**400]}}, "allowed: a list of finite numbers"),
    ({"axes": {"patches.centers[0]": {"from": -1e308, "to": 1e308, "count": 3}}}, "<= 1e+150"),
    ({"axes": {"x" * 9999: [1]}}, "unknown field"),
    ({"axes": {"a\nb": [1]}}, "unknown field"),
    ({"axes": {"link.joint_inertia_b": [0.0, 1e-5]}}, "link.basis = 'pinned_pinned'; allowed"),
    ({"axes": {" control.gain_factor": [0.1, 0.2]}}, "did you mean 'control.gain_factor'?"),
    ({"method": "list", "cases": [{"control.gain_factor ": 0.2}]}, "unknown field; did you mean"),
    ({"axes": {"motion.move_time": [[]]}}, "as many as there are moves"),
    ({"axes": {"motion.dwell": [[0.01, 0.02]]}}, "as many as there are moves"),
    ({"axes": {"drive.locked": "all"}}, "locked drives follow no path"),
    (
        {"axes": {"control.velocity_gain": [[1.0, 1.0, 1.0]], "motion.waypoints[1]": [[0.0]]}},
        "motion.waypoints",
    ),
    ({"axes": {"control.velocity_gain[" + "1" * 5000 + "]": [1.0]}}, "unknown field"),
    (
        {"axes": {"gain": {"from": 1, "to": 2, "count": 20}}, "repeats": 10**6},
        "sweep.repeats = 1000000; allowed: at most 500000 with 20 cases",
    ),
    ({"axes": {"run.duration": [100.0], "electronics.sample_rate_hz": [1e6]}}, "1e+08 samples"),
    (
        {"axes": {"control.laws.ppf.filter_damping": [0.1, 0.2]}},
        "no case selects the part whose field",
    ),
    ({"axes": {"machine.kinds.rrr.crank_length": [0.1, 0.2]}}, "no case selects the part whose"),
    (
        {
            "method": "sobol",
            "count": 4,
            "axes": {"placement": {"kind": "per_link"}},
            "where": "patches.centers[0] > 0.01",
        },
        "name one entry of it, such as patches.centers[0][0]",
    ),
]


@pytest.mark.parametrize(("sweep", "words"), REFUSED, ids=range(len(REFUSED)))
def test_a_bad_sweep_is_refused_in_one_clear_line(sweep, words):
    from studies.engine.stored import kept_metrics

    with pytest.raises(StudyError) as caught:
        spec = small_spec(sweep)
        kept_metrics(spec)
        build_table(spec)
    message = str(caught.value)
    assert words in message, message
    assert "\n" not in message and len(message) < 1200


@pytest.mark.parametrize("values", [[0.5, 0.6], {"from": 0.5, "to": 0.6, "count": 3}])
@pytest.mark.parametrize("name", ["guide_side", "slider_mass", "guide_offsets[1]"])
def test_an_axis_that_the_mechanism_does_not_read_is_refused(name, values):
    sweep = {"axes": {f"machine.{name}": values}}
    with pytest.raises(StudyError, match=r"machine.* = .*: machine.kind = 'rrr' has no such part"):
        build_table(parse_sweep({"machine": {"kind": "rrr"}, "sweep": sweep}))


@pytest.mark.parametrize("depth", [30, 300, 3000])
def test_deep_nesting_is_refused(depth):
    blocks, values = {"axes": {"gain": [1.0]}}, [1.0]
    for _ in range(depth):
        blocks, values = {"blocks": [blocks]}, [values]
    for sweep in (blocks, {"axes": {"gain": values}}):
        with pytest.raises(StudyError):
            build_table(parse_sweep(BASE | {"sweep": sweep}))


def test_a_study_is_no_sweep_and_a_sweep_no_study(tmp_path):
    from studies.study.spec import load_study

    with pytest.raises(StudyError, match="sweep: missing"):
        parse_sweep(BASE)
    path = tmp_path / "sweep.toml"
    path.write_text("[sweep.axes]\ngain = [1.0]\n")
    assert len(build_table(load_sweep(path))) == 1
    with pytest.raises(StudyError, match="run it with studies sweep"):
        load_study(path)


# Anything that TOML can hold, put anywhere in a valid sweep.
scalars = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=8),
    st.sampled_from(["all", "sobol", "grid", "list", "gain", "log", "placement", "gain[0]"]),
)
anything = st.recursive(
    scalars,
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=8), inner, max_size=3)
    ),
    max_leaves=6,
)
KEYS = (
    "method",
    "axes",
    "blocks",
    "cases",
    "count",
    "size",
    "levels",
    "where",
    "repeats",
    "seed",
    "metrics",
    "axs",
)
AXES = (
    "gain",
    "placement",
    "link_subsets",
    "link_mode_masks",
    "shaper_frequency",
    "plant_modes",
    "frequency_error",
    "control.ratios",
    "control.links[1]",
    "motion.waypoints",
    "run.seed",
    "run.duration",
    "link.basis",
    "patches.centers",
    "initial.modal",
    "shaper",
    "nonsense",
)


@settings(max_examples=200, deadline=None, database=None, derandomize=True)
@given(
    st.one_of(
        st.tuples(st.sampled_from(KEYS), anything).map(lambda kv: MIXED | {kv[0]: kv[1]}),
        st.tuples(st.sampled_from(AXES), anything).map(lambda kv: {"axes": {kv[0]: kv[1]}}),
        st.tuples(st.sampled_from(AXES), anything, st.sampled_from(["sobol", "zip", "random"])).map(
            lambda kv: {"axes": {kv[0]: kv[1]}, "method": kv[2], "count": 3}
        ),
        anything,
    )
)
def test_any_sweep_is_spread_or_refused(sweep):
    """Malformed or not: cases, or one clear line; nothing else."""
    try:
        table = build_table(parse_sweep(small(sweep)))
    except StudyError as error:
        assert str(error) and "\n" not in str(error)
    else:
        assert len(table) >= 1


def test_single_precision_keeps_only_metrics_that_it_holds():
    from studies.engine.stored import kept_metrics

    axes = {"axes": {"gain": [1.0]}}
    held = ["structural_rms", "control_energy"]
    with jax.enable_x64(False):
        assert kept_metrics(small_spec(axes | {"metrics": held})) == held
        lost = ["peak_voltage", "residual_rms"]  # all of them are named
        for metrics, named in (
            ([], r"\[\]"),
            ([*held, *lost], r"\['peak_voltage', 'residual_rms'\]"),
        ):
            with pytest.raises(StudyError, match=f"sweep.metrics = {named}; allowed: with float32"):
                kept_metrics(small_spec(axes | {"metrics": metrics}))
    assert "residual_rms" in kept_metrics(small_spec(axes))
