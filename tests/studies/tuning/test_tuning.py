"""Free numbers of a tuning, its objective and limits, and their derivatives."""

import subprocess
import sys
import textwrap
from types import SimpleNamespace
from unittest import mock

import jax
import numpy as np
import pytest

from jaxmodel.sampled_loop import summed_squares
from jaxmodel.shaper import Impulses, residual_vibration, zv
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.space.axes import Range
from studies.space.free import Free, FreeNumbers
from studies.study.cases import build_structure
from studies.tuning import linear_fidelity, loop_figures, loop_programs
from studies.tuning.check import tuned_study
from studies.tuning.evaluate import Evaluation
from studies.tuning.findings import violated_limits
from studies.tuning.folder import load_progress, save_progress
from studies.tuning.linear_fidelity import BATCH, LinearFidelity
from studies.tuning.loop_figures import machine_figures
from studies.tuning.objective import baseline_limits
from studies.tuning.optimise import (
    _fresh_progress,
    _hand_on,
    advance,
    begin,
    first_places,
    optimise,
    start_families,
)
from studies.tuning.run import make_evaluator
from studies.tuning.scenarios import scenario_columns, tuned_machines
from studies.tuning.spec import Family, Tune, TuneSpec
from tests.bare import paper_study
from tests.tunings import EACH, EVERY_KIND, GAIN, tuning

# --- objective and limits -------------------------------------------------------------------------

JUDGED = {
    "objective": {"residual_rms": 1.0, "control_energy": 0.1, "slowest_decay": 0.2},
    "limits": {
        "peak_voltage": "baseline",
        "gain_margin": 4.0,
        "slowest_decay": 20.0,
        "spillover": 1.1,
        "singularity_distance": 0.1,
    },
    "scenarios": {"count": 2, "spread": {"link.youngs_modulus": 5.0}, **EACH},
    "families": {
        "gains": {"free": ["control.gain_factor", "control.velocity_gain[0]"]},
        "all": {"set": {"shaper.kind": "zv"}},
    },
}
FREE = {
    **GAIN,
    "control.velocity_gain[0]": EVERY_KIND["control.velocity_gain"],
    "drive.kp": EVERY_KIND["drive.kp"],
    "placement": {"kind": "same"},
}
STARTS = 2


def few_modes():
    """Loops of fewer plant modes: a third of the time to compile."""
    return mock.patch.object(loop_figures, "MARGIN_MODES", 4)


@pytest.fixture(scope="module")
def judged():
    """A tuning with two families and free numbers of several kinds, and its evaluator."""
    spec = tuning(FREE, **JUDGED, starts=STARTS, iterations=6)
    with few_modes():
        return spec, make_evaluator(spec)


@pytest.fixture(scope="module")
def evaluated(judged):
    """The evaluation of a design of each family, and of its neighbours along the free numbers."""
    spec, evaluator = judged
    u = np.clip(spec.free.places() + 0.02, 0.1, 0.9)

    def at(*places):
        return evaluator.evaluate(spec.free.values(np.tile(places, (2, 1))))

    return spec, u, at(u, u), [at(u + step, u - step) for step in 1e-4 * np.eye(len(u))]


@pytest.mark.parametrize("family", [0, 1])
def test_gradients_are_those_of_central_differences(evaluated, family):
    spec, u, found, beside = evaluated
    first = family * STARTS
    assert spec.limit_names == tuple(JUDGED["limits"])
    central = []
    for part in beside:
        assert (part.status == 0).all()
        values = np.concatenate([part.objective[:, None], part.limits], axis=1)
        central.append((values[first] - values[first + 1]) / 2e-4)
    central = np.array(central)
    slopes = np.concatenate([found.slope[:, None], found.limit_slope], axis=1)[first]
    own = (slopes * spec.free.slopes(u)).T
    is_free = spec.moving[family].is_free
    assert (own[~is_free] == 0).all() and is_free.sum() == (2, 6)[family]
    largest = np.abs(central).max(axis=0)
    assert (largest[:5] > 5e-7).all() and largest[5] == 0  # gains change no link angle
    assert (np.abs(own - central)[is_free] < 1e-4 * largest + 5e-9).all()


def test_figures_can_be_recomputed_from_runs(evaluated):
    """The objective and the limit from runs of the studies themselves, one by one."""
    spec, u, found, _ = evaluated
    values = spec.free.values(u)
    columns = scenario_columns(spec, 2, 0)
    objective, excess = [], []
    for k in range(4):
        scenario = {
            "run__smooth": True,
            "run__seed": int(columns["run.seed"][k]),
            "link__youngs_modulus": float(columns["link.youngs_modulus"][k]),
            "motion__move_time": float(columns["motion.move_time"][k]),
        }
        machine = {"link.youngs_modulus": columns["link.youngs_modulus"][[k]]}
        tuned = {
            "control__gain_factor": float(values[0]),
            "control__velocity_gain": (float(values[1]), *spec.study.control.velocity_gain[1:]),
        }
        own, changed = (
            run_study(spec.study.change(**scenario, **more), has_record=False, has_loop=False)
            for more in ({}, tuned)
        )
        before, after = own.result.metrics, changed.result.metrics
        shares = [
            np.sqrt(np.mean(getattr(after, name) ** 2) / np.mean(getattr(before, name) ** 2))
            for name in ("residual_rms", "control_energy")
        ]
        with few_modes():
            loops = [
                machine_figures(spec, study, machine, ("slowest_decay",))["slowest_decay"][0]
                for study in (spec.study, spec.study.change(**tuned))
            ]
        shares.append(loops[0] / loops[1])  # more is better
        objective.append(np.dot(shares, (1.0, 0.1, 0.2)) / 1.3)
        excess.append(after.peak_voltage.max() / before.peak_voltage.max() - 1)
    assert len(set(objective)) == 4
    np.testing.assert_allclose(found.objective[0], np.mean(objective), rtol=1e-7)
    np.testing.assert_allclose(found.limits[0, 0], np.max(excess), rtol=1e-6)


def test_the_loop_of_figures_is_that_of_the_first_pose():
    case = SimpleNamespace(path=SimpleNamespace(waypoints=np.array(((1.0, 2.0), (3.0, 4.0)))))
    with mock.patch.object(loop_figures, "closed_loop", lambda *given: given[-1]):
        pose = loop_figures._closed_loop.__wrapped__(None, case)
    assert pose.tolist() == [1.0, 2.0]


def test_a_path_nearer_to_singularities_than_its_limit_violates_it():
    loop = loop_programs._Loop(None, None, None, {}, 1.0)
    for distance, x in ((0.05, 0.5), (0.1, 0.0), (0.2, -1.0)):
        with mock.patch.object(loop_programs, "distance_of_path", lambda *_, at=distance: at):
            found = loop_programs._excess(loop, ("singularity_distance",), np.array([0.1]))
        np.testing.assert_allclose(found, [x / (1 + abs(x))])


def test_limits_of_the_loop_are_those_of_the_worst_machine(evaluated):
    spec, u, found, _ = evaluated
    machines, names = tuned_machines(spec).columns, spec.loop_limits
    assert len(machines["link.youngs_modulus"]) == 2
    for position, first in ((0, 0), (1, STARTS)):
        study = tuned_study(spec, spec.moving[position], spec.free.values(u))
        with few_modes():
            loop = machine_figures(spec, study, machines, names)
        limits = found.limits[first, 1:]
        margin = loop["gain_margin"].min()
        assert (limits[0] > 0) == (margin < 4.0) and abs(margin - 4) > 0.01
        for value, excess in (
            (limits[1], 1 - loop["slowest_decay"] / 20.0),
            (limits[2], loop["spillover"] / 1.1 - 1),
            (limits[3], 1 - loop["singularity_distance"] / 0.1),
        ):
            wanted = excess.max()
            np.testing.assert_allclose(value, wanted / (1 + abs(wanted)), rtol=1e-6, atol=1e-9)


def test_a_design_that_fails_spoils_no_other(judged, evaluated):
    """A drive that no step carries makes one design's runs diverge."""
    (spec, evaluator), (_, u, wanted, _) = judged, evaluated
    values = spec.free.values(np.tile(u, (2 * STARTS, 1)))
    values[-1, 2] = 1e12
    found = evaluator.evaluate(values)
    assert np.isnan(found.objective[-1]) and (found.status[-1] != 0).all()
    for name in ("objective", "slope", "limits", "limit_slope", "status"):
        np.testing.assert_array_equal(getattr(found, name)[:-1], getattr(wanted, name)[:-1])


@pytest.mark.parametrize(
    ("tune", "message"),
    [
        ({"objective": {"slowest_decay": 1.0}}, "tune.objective.slowest_decay: the loop of"),
        ({"limits": {"slowest_decay": "baseline"}}, "tune.limits.slowest_decay = 'baseline': the"),
    ],
)
def test_a_baseline_needs_a_stable_loop_to_be_measured_against(tune, message):
    """On every machine."""
    text = " baseline is unstable on machine 2 of 2, .*; allowed: > 0 on every machine of tune"
    weak = {"count": 2, "check": 1, "machines": {"control.velocity_gain": [[3e3] * 3] * 2}}
    spec = tuning({"drive.kp": EVERY_KIND["drive.kp"]}, scenarios=weak, **tune)
    with few_modes(), pytest.raises(StudyError, match=message + ".*" + text.strip()):
        LinearFidelity(spec, list(spec.families))


@pytest.mark.long
def test_an_objective_can_be_of_the_loop_alone():
    spec = tuning(GAIN, objective={"slowest_decay": 1.0}, starts=3)
    evaluator = make_evaluator(spec)
    values = spec.free.values(spec.free.places())
    found = evaluator.evaluate(values * np.array([[1.0], [1.001], [0.999]]))
    slope = (found.objective[1] - found.objective[2]) / (0.002 * values[0])
    np.testing.assert_allclose(found.objective[0], 1.0, rtol=1e-6)
    np.testing.assert_allclose(found.slope[0, 0], slope, rtol=1e-4)
    assert (found.status == 0).all() and slope != 0


@pytest.fixture
def screened():
    """What is screened, with made-up figures: gain_factor - 1 is the largest excess of the limits,
    velocity_gain the residual, lost below 2.
    """
    seen = []

    def known(structure, names, place, numbers, limits, links, values):
        assert names == tuple(JUDGED["limits"])[1:] and len(values) == BATCH
        assert structure.n_steps == build_structure(tuning(FREE, **JUDGED).study).n_steps
        seen.extend(values)
        residual = np.where(values[:, 1] < 2, np.nan, values[:, 1])
        return values[:, :1] * 0.1 / limits - 1, residual

    with mock.patch.object(linear_fidelity, "screen_designs", known):
        yield seen


def test_the_best_of_what_is_screened_is_a_start(judged, screened):
    """That with the least residual within the limits."""
    spec, evaluator = judged
    values = spec.free.values(np.random.default_rng(0).uniform(size=(20, len(spec.free.names))))
    beyond, residual = evaluator.linear.screen(0, values)
    np.testing.assert_allclose(beyond, values[:, 0] - 1)  # 0.1 is the smallest limit
    np.testing.assert_array_equal(residual, np.where(values[:, 1] < 2, np.inf, values[:, 1]))
    del screened[:]
    places, seen = first_places(spec, evaluator), np.array(screened)
    for k, family in enumerate(spec.moving):
        own, other = places[STARTS * k : STARTS * (k + 1)]
        np.testing.assert_array_equal(own, spec.free.places())
        assert (other == own)[~family.is_free].all()
        mine = seen[BATCH * k : BATCH * (k + 1)]
        is_fine = (mine[:, 0] <= 1) & (mine[:, 1] >= 2)
        assert 0 < is_fine.sum() < BATCH
        assert spec.free.values(other)[1] == pytest.approx(mine[is_fine, 1].min(), rel=1e-12)


@pytest.mark.long  # in short: with made-up figures
def test_a_screen_says_what_an_evaluation_does():
    """On the nominal machine, of the limits of the loop."""
    spec = tuning(FREE, **JUDGED | {"scenarios": {}})
    linear = LinearFidelity(spec, list(spec.moving))
    values = spec.free.values(np.tile(np.clip(spec.free.places() + 0.02, 0.1, 0.9), (2, 1)))
    beyond, residual = linear.screen(1, values[:1])
    np.testing.assert_allclose(beyond[0], linear.evaluate(values).limits[1].max(), rtol=1e-9)
    assert np.isfinite(residual).all()
    own = linear.screen(1, spec.free.values(spec.free.places())[None])[1]
    run = run_study(spec.study, has_record=False).result.metrics.residual_rms
    counted = np.asarray(run)[np.array(spec.counted_links)]
    np.testing.assert_allclose(own, np.sqrt(np.mean(counted**2)), rtol=0.3)


@pytest.mark.usefixtures("screened")
def test_tuning_goes_downhill_within_limits(judged):
    spec, evaluator = judged
    seen = []
    end = optimise(spec, evaluator, None, seen.append)
    assert int(end.iteration) == len(seen) == spec.tune.iterations
    for family in (0, 1):
        k = end.winner(family)
        assert end.best_limits[k].max() <= 1e-3
        assert end.best_objective[k] < 0.97
    assert np.all((end.best_place >= 0) & (end.best_place <= 1))
    still = ~spec.moving[0].is_free
    own = np.broadcast_to(spec.free.places()[still], (STARTS, still.sum()))
    np.testing.assert_array_equal(end.best_place[:STARTS][:, still], own)
    assert not violated_limits(spec, end)


# --- known answers --------------------------------------------------------------------------------


class Known:
    """An evaluator of a function of the free numbers, with limits, in place of the machine."""

    def __init__(self, spec, function, limits=None):
        self.families = [spec.moving[k] for k in start_families(spec)]
        self.is_free = np.stack([family.is_free for family in self.families])
        self.linear = SimpleNamespace(screen=lambda k, values: np.zeros((2, len(values))))
        limits = limits or (lambda x: jax.numpy.zeros(0))

        def one(x):
            return *jax.value_and_grad(function)(x), limits(x), jax.jacfwd(limits)(x)

        self._evaluate = jax.jit(jax.vmap(one))

    def evaluate(self, values, needs_gradient=True):
        objective, slope, limits, change = map(np.asarray, self._evaluate(values))
        zero = np.zeros((len(values), 1))
        return Evaluation(objective, slope, limits, change, limits, zero, zero[:, 0])


def known_tuning(spans, limits=(), **tune):
    """A tuning of numbers that belong to no machine."""
    numbers = [Free(name, span, np.nan, name) for name, span in spans.items()]
    free = FreeNumbers(tuple(numbers), lambda case, values: case)
    limits = dict.fromkeys(limits, 1.0)
    family = Family("known", np.ones(len(numbers), bool), {}, limits, "")
    tune = Tune(limits=limits, **tune)
    return TuneSpec(paper_study(), tune, free, (family,), ({},), {})


def bowl(method="lbfgs", depends=(1.0, 1.0)):
    """A tuning of two numbers with a limit, its evaluator, and its start at four places."""
    spans = {name: Range(0.0, 1.0, 0, False) for name in "xy"}
    spec = known_tuning(spans, ("peak_voltage",), method=method, starts=4, iterations=8)
    share = np.array(depends)
    evaluator = Known(
        spec,
        lambda v: share @ (jax.numpy.sin(3 * v) - v) ** 2,
        lambda v: jax.numpy.stack([share @ v - 1.5]),
    )
    place = np.random.default_rng(0).uniform(size=(4, 2))
    return spec, evaluator, begin(spec, evaluator)._replace(place=place, base=place)


def test_resumed_tuning_equals_an_uninterrupted_one(tmp_path):
    """Bit by bit, through the file that is kept."""
    (spec, evaluator, at), seen = bowl(), []
    end = optimise(spec, evaluator, at, seen.append)
    save_progress(tmp_path / "progress.npz", seen[3])
    again = optimise(spec, evaluator, load_progress(tmp_path / "progress.npz"), lambda at: None)
    jax.tree.map(np.testing.assert_array_equal, again, end)
    assert len(seen) == spec.tune.iterations


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_a_start_that_fails_spoils_no_other(method):
    """It tries a shorter step, or is given up if it has never finished."""
    spec, evaluator, at = bowl(method)
    for _ in range(2):
        at = advance(spec, evaluator, at)
    others = np.arange(4) != 2

    def failing(values):
        found = evaluator.evaluate(values)
        slope = np.where(others[:, None], found.slope, np.nan)
        return found._replace(objective=np.where(others, found.objective, np.nan), slope=slope)

    broken = SimpleNamespace(evaluate=failing, is_free=evaluator.is_free)
    wanted, found = advance(spec, evaluator, at), advance(spec, broken, at)
    assert not found.is_frozen.any()
    np.testing.assert_array_equal(found.place[others], wanted.place[others])
    assert np.isnan(found.history[2, 2]).all() and np.isfinite(found.place[2]).all()
    assert found.best_objective[2] == at.best_objective[2]
    assert np.abs(found.place[2] - found.base[2]).max() < np.abs(at.place[2] - at.base[2]).max()
    no_best = np.where(others, at.best_objective, np.inf)
    lost = advance(spec, broken, at._replace(best_objective=no_best))
    assert lost.is_frozen[2] and not lost.is_frozen[others].any()
    np.testing.assert_array_equal(lost.place[others], wanted.place[others])


def test_a_number_that_changes_nothing_is_named():
    spec, evaluator, at = bowl(depends=(1.0, 0.0))
    with pytest.raises(StudyError, match=r"family 'known' neither .* depends on y; leave"):
        optimise(spec, evaluator, at, lambda at: None)


@pytest.mark.parametrize("method", ["lbfgs", pytest.param("adam", marks=pytest.mark.long)])
def test_optimal_damping_of_one_mode(method):
    """A released oscillator leaves the least integral of x^2 with zeta = 1/2."""

    def energy(values):
        omega, period = 2 * np.pi * 100, 1e-5
        rates = np.array([[0.0, 1.0], [-(omega**2), 0.0]])
        damped = rates - 2 * omega * values[0] * np.array([[0.0, 0.0], [0.0, 1.0]])
        found = summed_squares(jax.scipy.linalg.expm(damped * period), np.diag([1.0, 0.0]))
        return found.share[0, 0] * jax.numpy.exp(found.log_size) * period * 4 * omega

    spec = known_tuning({"zeta": Range(0.02, 2.0, 0, True)}, method=method, starts=3)
    end = optimise(spec, Known(spec, energy), None, lambda at: None)
    found = spec.free.values(end.best_place)
    np.testing.assert_allclose(found[end.winner(0)], 0.5, rtol=2e-3)
    # 4 omega times (1 + 4 zeta^2)/(4 zeta omega), sampled
    np.testing.assert_allclose(end.best_objective.min(), 4, rtol=5e-3)
    assert int(end.iteration) < spec.tune.iterations or method == "adam"  # stopped by itself


def test_zero_vibration_shaper_is_found_from_scratch():
    """Two impulses that leave an undamped mode at rest: halves, half a period apart."""
    omega = 2 * np.pi * 114.4

    def left(values):
        share, time = values
        impulses = Impulses(
            jax.numpy.stack([1 - share, share]), jax.numpy.stack([0.0 * time, time])
        )
        return residual_vibration(impulses, omega, 0.0) ** 2

    period = 2 * np.pi / omega
    spans = {"share": Range(0.02, 0.98, 0, False), "time": Range(0.0, 0.95 * period, 0, False)}
    spec = known_tuning(spans, starts=4)
    end = optimise(spec, Known(spec, left), None, lambda at: None)
    wanted = zv(omega, 0.0)
    np.testing.assert_allclose(
        spec.free.values(end.best_place[end.winner(0)]),
        [wanted.amplitude[1], wanted.time[1]],
        rtol=1e-3,
    )
    assert end.best_objective.min() < 1e-6


@pytest.mark.parametrize("method", ["lbfgs", "adam"])
def test_limits_hold_at_the_optimum(method):
    """Least distance from (1, 1) with x + y <= 1 and y <= 1/4: at (3/4, 1/4), both active."""
    spans = {name: Range(0.0, 1.0, 0, False) for name in "xy"}
    names = ("peak_voltage", "peak_force")
    spec = known_tuning(spans, names, method=method, starts=2, iterations=120)
    evaluator = Known(
        spec,
        lambda v: jax.numpy.sum((v - 1) ** 2),
        lambda v: jax.numpy.stack([v[0] + v[1] - 1, 4 * v[1] - 1]),
    )
    end = optimise(spec, evaluator, None, lambda at: None)
    k = end.winner(0)
    np.testing.assert_allclose(spec.free.values(end.best_place[k]), [0.75, 0.25], atol=5e-3)
    assert end.best_limits[k].max() <= 1e-3


def test_limits_that_contradict_are_named():
    """x <= 0.3 and x >= 0.6 each hold somewhere, never together; x <= -0.1 holds nowhere."""
    spans = {"x": Range(0.0, 1.0, 0, False)}
    names = ("peak_voltage", "peak_force")
    spec = known_tuning(spans, names, starts=4, iterations=10)
    for limits, message in (
        (lambda v: jax.numpy.stack([v[0] - 0.3, 0.6 - v[0]]), "by some design each, but by none"),
        (
            lambda v: jax.numpy.stack([v[0] + 0.1, 0 * v[0] - 1]),
            "peak_voltage = 1.0 is satisfied by no",
        ),
    ):
        evaluator = Known(spec, lambda v: jax.numpy.sum((v - 0.45) ** 2), limits)
        at = begin(spec, evaluator)
        place = np.array([[0.05], [0.95], [0.4], [0.5]])
        end = optimise(spec, evaluator, at._replace(place=place), lambda at: None)
        told = violated_limits(spec, end)
        assert len(told) == 1 and message in told[0] and told[0].startswith("known: ")


def test_designs_are_handed_on_along_a_front():
    """Families of a front start elsewhere but end at the best of all that keeps their limit."""
    spans = {"x": Range(0.0, 1.0, 0, False)}
    spec = known_tuning(spans, ("peak_voltage",), starts=2, iterations=12)
    base = spec.families[0]
    levels = [
        base._replace(name=str(v), limits={"peak_voltage": v}, front="known") for v in (0.4, 0.9)
    ]
    tune = spec.tune.model_copy(update={"pareto": SimpleNamespace(limit="peak_voltage")})
    spec = spec._replace(families=tuple(levels), tune=tune)
    evaluator = Known(spec, lambda v: 2 + jax.numpy.cos(14 * v[0]) - v[0])  # a valley each
    plain = evaluator.evaluate

    def evaluate(values, needs_gradient=True):
        found = plain(values)
        allowed = np.array([0.4, 0.4, 0.9, 0.9])[:, None]
        slope = np.broadcast_to(1 / allowed[..., None], (4, 1, 1))
        return found._replace(limits=values / allowed - 1, limit_slope=slope, peaks=values)

    evaluator.evaluate = evaluate
    at = begin(spec, evaluator)
    place = np.array([[0.2], [0.25], [0.21], [0.22]])  # the second family is in the wrong valley
    single = spec._replace(tune=tune.model_copy(update={"pareto": None}))
    alone = optimise(single, evaluator, at._replace(place=place), lambda at: None)
    better = np.array([[0.2], [0.25], [0.21], [0.68]])
    handed = optimise(spec, evaluator, at._replace(place=better), lambda at: None)
    assert abs(spec.free.values(alone.best_place)[alone.winner(1), 0] - 0.23) < 0.02
    assert abs(spec.free.values(handed.best_place)[handed.winner(1), 0] - 0.678) < 0.02
    # what the first family finds last is the second one's too, with the limit as that sees it
    cut = optimise(spec, evaluator, at._replace(place=place, iteration=np.array(11)), lambda at: 0)
    best, taken = cut.winner(0), cut.winner(1)
    assert cut.best_objective[taken] <= cut.best_objective[best]
    np.testing.assert_allclose(cut.best_limits[taken, 0], cut.best_peaks[taken, 0] / 0.9 - 1)


def test_a_design_is_handed_on_where_nothing_is_limited():
    """To the family that moves more: its worst start goes on from there."""
    spec = known_tuning({name: Range(0.0, 1.0, 0, False) for name in "xy"}, starts=2)
    (both,) = spec.families
    few = both._replace(name="few", is_free=np.array([True, False]))
    spec = spec._replace(families=(few, both))
    place = np.array([[0.1, 0.5], [0.2, 0.5], [0.3, 0.3], [0.4, 0.4]])
    at = _fresh_progress(spec, place)._replace(
        best_place=place, best_objective=np.array([1.0, 0.5, 0.8, 0.9])
    )
    assert at.best_limits.shape == (4, 0)
    found = _hand_on(spec, at)
    assert found.best_objective.tolist() == [1.0, 0.5, 0.8, 0.5]
    np.testing.assert_array_equal(found.place, place[[0, 1, 2, 1]])


@pytest.mark.long
def test_checked_derivatives_of_loaded_links_come_to_an_end():
    """Programs with an eigenvalue problem, run side by side, stopped every second such process."""
    code = """
        from studies.config import start
        start()
        from studies.tuning.audit import ALLOWED, audit
        from studies.tuning.spec import parse_tuning

        spec = parse_tuning({
            "link": {"basis": "loaded", "modes": 6, "joint_inertia_c": 1e-5},
            "run": {"duration": 0.16},
            "motion": {"move_time": 0.03},
            "metrics": {"residual_delay": 0.0, "residual_length": 0.02},
            "control": {"modes": 2, "basis": "pinned_free", "gain_factor": 0.1},
            "tune": {
                "free": {"control.gain_factor": {"from": 0.02, "to": 0.2}},
                "scenarios": {"count": 4, "spread": {"link.joint_inertia_c": 5}},
            },
        })
        for _ in range(6):
            assert max(x.share for x in audit(spec)) < ALLOWED
    """
    for _ in range(4):
        subprocess.run([sys.executable, "-c", textwrap.dedent(code)], check=True, timeout=150)


def test_without_limits_there_are_none_of_the_baseline():
    found = baseline_limits(SimpleNamespace(limits=()), {"residual_rms": np.ones((3, 2))})
    assert found.shape == (3, 0)
