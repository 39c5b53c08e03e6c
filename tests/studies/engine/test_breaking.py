"""The smallest change that breaks a design: the changed loop, its slopes, the search, the words."""

import jax
import jsonschema
import numpy as np
import pytest
from scipy.linalg import eig, expm, matrix_balance
from threadpoolctl import threadpool_limits

from jaxmodel.changes import MachineChange, changed_case
from jaxmodel.linear import linearise, resting
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import analogue_plant, closed_loop
from studies.commands import settings
from studies.documents import schema
from studies.engine import breaking
from studies.engine.breaking import smallest_change
from studies.engine.controller import fixed_controller
from studies.engine.nearest import Loops, _pulled, growth, nearest_unstable
from studies.errors import StudyError
from studies.results.labelled import plain
from studies.space.machines import TOLERANCES, parse_tolerances
from studies.study.cases import as_arrays, build_case, build_structure
from tests.canonical import MACHINE, study_of
from tests.evolution import cma_es

#: One patch on each link: fewer states, fewer eigenvalues.
STUDY = study_of(
    MACHINE,
    patches__centers=[[0.1]] * 3,
    control__modes=1,
    control__ratios=[[1.0]] * 3,
    control__gain_factor=0.05,
)


evaluated = jax.jit(closed_loop, static_argnums=0)


def rest():
    patches = np.zeros((3, 1))
    return MachineChange(
        stiffness=np.zeros(3),
        damping=np.zeros(3),
        payload=np.zeros(()),
        patch=patches,
        delay=np.zeros(()),
        actuator=patches,
        sensor=patches,
        joint_inertia=np.zeros(3),
    )


class Design:
    """A design, its changed loops as functions of a vector in tolerances, and its limits."""

    def __init__(self, study):
        self.fixed = fixed_controller(study)
        self.structure, self.case = breaking._machine(self.fixed)
        self.pose = np.array(study.motion.waypoints[0], float)
        self.unit, self.lower, self.upper = (
            np.concatenate([np.ravel(x) for x in part])
            for part in breaking._limits(self.structure, self.case, TOLERANCES)
        )
        law = self.fixed.controller
        self.changed = breaking._ChangedLoops(self.structure, self.case, self.pose, law, self.unit)
        self.loops = Loops(self.changed.matrix, self.changed.slope, self.lower, self.upper)

    def transition(self, change):
        return np.asarray(
            breaking._transition(
                self.structure, self.case, self.pose, self.fixed.controller, change
            )[0]
        )


@pytest.fixture(scope="module")
def design():
    return Design(STUDY)


@pytest.fixture(scope="module")
def found(design):
    return smallest_change(design.fixed)


def poles(matrix, count=40):
    value = np.linalg.eigvals(matrix)
    return np.sort(np.abs(value))[::-1][:count]


# --- the changed loop -----------------------------------------------------------------------------


def test_without_change_the_loop_is_the_design_s(design):
    loop = evaluated(design.structure, design.case, design.pose, design.fixed.controller)
    wanted = np.asarray(loop.open + loop.feedback)
    np.testing.assert_allclose(poles(design.transition(rest())), poles(wanted), rtol=1e-9)


def test_a_changed_machine_is_that_of_its_case(design):
    """Physical changes as the case's own numbers, with the controller of the nominal one."""
    rng = np.random.default_rng(0)
    change = rest()._replace(
        stiffness=rng.normal(0, 0.1, 3),
        damping=rng.normal(0, 0.3, 3),
        payload=np.array(0.05),
        patch=rng.normal(0, 1e-3, (3, 1)),
    )
    case = changed_case(design.case, change)
    loop = evaluated(design.structure, case, design.pose, design.fixed.controller)
    wanted = np.asarray(loop.open + loop.feedback)
    np.testing.assert_allclose(poles(design.transition(change)), poles(wanted), rtol=1e-9)
    beam = case.machine.beam
    np.testing.assert_allclose(beam.stiffness_factor, np.exp(change.stiffness), rtol=1e-12)


def test_gains_of_channels_are_gains_of_the_controller(design):
    """All actuators and sensors together are a factor on all gains where nothing is fed through."""
    study = STUDY.change(control__feedthrough_factor=0.0)
    fixed = fixed_controller(study)
    structure, case = breaking._machine(fixed)
    ones = np.ones((3, 1))
    change = rest()._replace(actuator=np.log(1.3) * ones, sensor=np.log(1.1) * ones)
    matrix = breaking._transition(structure, case, design.pose, fixed.controller, change)[0]
    loop = evaluated(structure, case, design.pose, fixed.controller)
    wanted = np.asarray(loop.open + 1.43 * loop.feedback)
    np.testing.assert_allclose(poles(np.asarray(matrix)), poles(wanted), rtol=1e-8)


def analogue_of(design):
    smooth = design.structure._replace(is_smooth=True)

    def evaluate(case):
        loop = prepare(smooth, case).loop
        plant = linearise(smooth, loop, design.pose, resting(smooth, case))
        whole = analogue_plant(smooth, plant, case)
        return whole.state, whole.enters

    return jax.jit(evaluate)(design.case)


@pytest.fixture(scope="module")
def analogue(design):
    return analogue_of(design)


@pytest.mark.parametrize("delay", [0.3, 1.0, 1.6])
def test_a_delay_is_a_later_edge_of_the_hold(design, analogue, delay):
    """Beside a simulation: the plant over parts of a sample by SciPy, commands one by one."""
    a, b = np.asarray(analogue[0]), np.asarray(analogue[1])[:, :3]
    n = len(a)
    held = np.zeros((n + 3, n + 3))
    held[:n, :n], held[:n, n:] = a, b
    _, (size, _) = matrix_balance(held, permute=False, separate=True)
    period = float(design.case.electronics.period)
    volts = 1 / np.abs(b / size[:n, None] * period).max()  # which move the states by their size
    whole, share = int(delay), delay % 1
    parts = [
        expm(held / size[:, None] * size * t * period) * size[:, None] / size
        for t in (share, 1 - share)
    ]
    matrix = design.transition(rest()._replace(delay=np.array(delay)))
    rng = np.random.default_rng(0)
    state = rng.normal(size=len(matrix))
    state *= np.concatenate([size[:n], np.full(len(state) - n, volts)])
    x = state[:n]
    # the newest command is the controller's, older ones follow the plant's state, newest first
    latest = [state[-3:], *np.split(state[n : n + 9], 3)]
    commands = latest[whole : whole + 2][::-1]
    for part, command in zip(parts, commands, strict=True):
        x = (part @ np.concatenate([x, command]))[:n]
    moved = matrix @ state
    np.testing.assert_allclose(moved[:n] / size[:n], x / size[:n], atol=1e-9)
    if share:  # and the share of the sample matters
        other = design.transition(rest()._replace(delay=np.array(delay + 0.1))) @ state
        assert np.abs(other[:n] / size[:n] - x / size[:n]).max() > 0.1


def test_slopes_of_the_growth_are_its_differences(design):
    rng = np.random.default_rng(1)
    x = np.clip(rng.normal(0, 1, len(design.unit)), 0.9 * design.lower, 0.9 * design.upper)
    matrix = design.changed.matrix(x)
    value, left, right = eig(matrix, left=True)
    k = np.argmax(np.abs(value))
    w, v = left[:, k].conj(), right[:, k]
    slope = design.changed.slope(x, np.real(np.outer(w, v) / (w @ v * value[k])))
    direction = rng.normal(size=len(x)) * (design.upper > 0)
    step = 1e-4
    ends = [growth(design.changed.matrix(x + s * step * direction)) for s in (1, -1)]
    np.testing.assert_allclose(slope @ direction, (ends[0] - ends[1]) / (2 * step), rtol=1e-4)


# --- the search -----------------------------------------------------------------------------------


def oscillators(distances):
    """Loops whose growth is known: one pair of poles per distance, each moved by its own number."""
    p = len(distances)

    def matrix(x):
        whole = np.zeros((2 * p, 2 * p))
        for k, (distance, value) in enumerate(zip(distances, x, strict=True)):
            turn = 0.5 + 0.3 * k
            size = np.exp(0.01 * (value - distance))
            at = slice(2 * k, 2 * k + 2)
            c, s = size * np.cos(turn), size * np.sin(turn)
            whole[at, at] = [[c, -s], [s, c]]
        return whole

    def slope(x, weight):
        each = []
        for k in range(p):
            at = slice(2 * k, 2 * k + 2)
            each.append(0.01 * np.sum(weight[at, at] * matrix(x)[at, at]))
        return np.array(each)

    return matrix, slope


def test_the_nearest_of_known_limits_is_found():
    matrix, slope = oscillators([7.0, 3.0, 9.0])
    free = np.full(3, np.inf)
    x = nearest_unstable(Loops(matrix, slope, -free, free))
    np.testing.assert_allclose(x, [0, 3, 0], atol=2e-3)
    # with that one held, the next
    x = nearest_unstable(Loops(matrix, slope, -free, np.array([np.inf, 2.0, np.inf])))
    np.testing.assert_allclose(x, [7, 0, 0], atol=5e-3)
    assert nearest_unstable(Loops(matrix, slope, -free, np.full(3, 2.0))) is None
    matrix, slope = oscillators([-1.0, 2.0])
    np.testing.assert_array_equal(nearest_unstable(Loops(matrix, slope, -free[:2], free[:2])), 0)


def test_the_smallest_change_is_on_the_limit(design, found):
    x = np.concatenate([np.ravel(part) for part in found.change]) / design.unit
    np.testing.assert_allclose(np.linalg.norm(x), found.distance, rtol=1e-9)
    assert np.all((x >= design.lower - 1e-9) & (x <= design.upper + 1e-9))
    # by the machine's own case, if channels and delay did not change, else by the changed loop
    assert growth(design.transition(found.change)) > 0
    for share in (0.25, 0.5, 0.75, 0.9, 0.995):
        assert growth(design.changed.matrix(share * x)) < 0
    assert np.argmax([abs(part.size) for part in found.parts]) == 0


def test_of_channels_that_act_one_at_a_time_the_first_to_break_counts(design, found, monkeypatch):
    """Wherever it is among them: here after one that nothing breaks and one that takes twice it."""
    nearest = np.concatenate([np.ravel(part) for part in found.change]) / design.unit
    limits = iter([None, 2 * nearest, nearest])
    monkeypatch.setattr(breaking, "linear_parts", lambda law: [(slice(None), law)] * 3)
    monkeypatch.setattr(breaking, "nearest_unstable", lambda loops: next(limits))
    assert smallest_change(design.fixed).text == found.text


@pytest.mark.parametrize(("below", "wanted"), [(0.5, 0.45), (1.2, 0.45), (0.4, None)])
def test_of_two_limits_on_a_ray_the_nearer_one_counts(below, wanted):
    """Unstable from 0.45 to 1.5 alone."""
    limit = np.array([3.0])
    loops = Loops(lambda x: np.eye(1) * (1 + (x - 0.45) * (1.5 - x)), None, -limit, limit)
    found = _pulled(loops, np.ones(1), below)
    assert found is None if wanted is None else found == pytest.approx(wanted, rel=1e-3)


def shell(design, distance, count, rng):
    """Random changes at a distance: of all numbers, of few, or near the coordinate axes."""
    points = rng.normal(size=(count, len(design.unit)))
    points *= rng.random(points.shape) < rng.choice([0.1, 0.3, 1.0], (count, 1))
    points *= design.upper > 0
    points /= np.linalg.norm(points, axis=1, keepdims=True).clip(1e-9)
    return np.clip(distance * points, design.lower, design.upper)


def test_no_random_change_that_is_smaller_breaks_it(design, found):
    """All at 1/1.05 of the distance: a smaller one that breaks it would show on the way as well."""
    points = shell(design, found.distance / 1.05, 150, np.random.default_rng(0))
    assert max(growth(design.changed.matrix(x)) for x in points) < 0


# --- words and commands ---------------------------------------------------------------------------


def test_the_words(found):
    text = found.text
    assert text.startswith(f"the smallest change that breaks it, {found.distance:.3g} tolerances: ")
    assert found.parts[0].text in text and text.endswith(f"unstable is then {found.breaking}")
    words = [
        breaking._words("patch", (0, 1), 1.8e-3),
        breaking._words("stiffness", (2,), np.log(0.96)),
        breaking._words("delay", (), 0.5),
        breaking._words("sensor", (1, 0), np.log(1.1)),
        breaking._words("payload", (), -0.02),
        breaking._words("joint_inertia", (0,), 2e-6),
    ]
    assert [" ".join(pair) for pair in words] == [
        "patch 2 of link 1 1.8 mm towards C",
        "E of link 3 -4 %",
        "delay 0.5 samples late",
        "sensor 1 of link 2 +10 %",
        "platform 0.02 kg lighter",
        "J_C of link 1 +2e-06 kg m2",
    ]


def test_an_unstable_design_needs_no_change():
    found = smallest_change(fixed_controller(STUDY.change(control__gain_factor=20.0)))
    assert found.distance == 0 and "it is unstable as it is, by" in found.text


def test_tolerances_are_numbers_by_name():
    found = parse_tolerances(settings("--tolerance", ["patch=2e-3", "delay = 0"]))
    assert found == TOLERANCES._replace(patch=2e-3, delay=0.0)
    with pytest.raises(StudyError, match="--tolerance = 'pach'.*did you mean 'patch'"):
        parse_tolerances({"pach": 1.0})
    with pytest.raises(StudyError, match="--tolerance payload = '-1'; allowed: .* from 0 .kg."):
        parse_tolerances({"payload": "-1"})
    with pytest.raises(StudyError, match="at least one number"):
        parse_tolerances(dict.fromkeys(MachineChange._fields, 0.0))


@pytest.mark.parametrize("kind", MachineChange._fields)
def test_what_does_not_change_stays(design, kind):
    """The search keeps to these limits: see above."""
    tolerances = TOLERANCES._replace(**{kind: 0.0})
    found = breaking._limits(design.structure, design.case, tolerances)
    for limits in found:
        fixed = [name for name in limits._fields if not np.any(getattr(limits, name))]
        assert kind in fixed


def test_patches_stay_on_their_links_and_apart():
    three = study_of(MACHINE)
    towards_b, towards_c = breaking._free_way(build_structure(three), as_arrays(build_case(three)))
    np.testing.assert_allclose(towards_b, np.tile([0.035, 0.01, 0.01], (3, 1)), atol=1e-12)
    np.testing.assert_allclose(towards_c, np.tile([0.01, 0.01, 0.035], (3, 1)), atol=1e-12)


def test_the_record_is_that_of_its_schema(found):
    whole = schema("certify")["properties"]["smallest_change"]
    jsonschema.validate(plain(found), whole)


# --- campaigns ------------------------------------------------------------------------------------


def random_study(rng):
    """A design that is stable, of any gains, filters, damping and patches."""
    centers = np.array([0.05, 0.1, 0.15]) + rng.uniform(-0.008, 0.008, 3)
    return study_of(
        MACHINE,
        control__gain_factor=float(np.exp(rng.normal(-0.5, 0.7))),
        electronics__antialias_hz=float(rng.choice([1000.0, 2000.0, 4000.0])),
        link__damping_ratio=float(10 ** rng.uniform(-2.5, -1.7)),
        patches__centers=tuple(centers),
    )


def check_against_references(seed, n_samples, n_steps):
    """Random changes at the distance over 1.05, and CMA-ES from zero: ratio of the distances.

    NaN if there is nothing to compare.
    """
    rng = np.random.default_rng(seed)
    design = Design(random_study(rng))
    x = nearest_unstable(design.loops)
    if not np.any(x):  # unstable as it is
        return np.nan
    distance = float(np.linalg.norm(x))
    with threadpool_limits(1, "blas"):
        for point in shell(design, distance / 1.05, n_samples, rng):
            assert growth(design.changed.matrix(point)) < 0
        price = 3 * distance / abs(growth(design.changed.matrix(0 * x)))

        def cost(y):
            inside = np.clip(y, design.lower, design.upper)
            value = growth(design.changed.matrix(inside))
            penalty = price * max(0.0, -value) if np.isfinite(value) else price
            return float(np.linalg.norm(inside) + np.linalg.norm(inside - y) + penalty)

        other = cma_es(cost, 0 * x, distance / 5, n_steps, seed)
        other = np.clip(other, design.lower, design.upper)
        if growth(design.changed.matrix(other)) < -1e-4:  # it has not arrived
            return np.nan
    return distance / float(np.linalg.norm(other))


@pytest.mark.long
@pytest.mark.timeout(7200)
def test_smallest_changes_of_random_designs_beside_cma_es():
    """50 designs: no worse than 1.05 times what samples and CMA-ES find."""
    ratios = [check_against_references(seed, 2000, 4000) for seed in range(50)]
    assert np.isfinite(ratios).sum() >= 30 and np.nanmax(ratios) <= 1.05, ratios
