"""Why a run stops, and how it ends, on made-up last states: each limit from both sides."""

from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import loop as loop_module
from jaxmodel import metrics, status
from jaxmodel.loop import PlantState, State, _freeze_if_bad, _sample
from jaxmodel.simulate import Outline, conclude
from studies.engine.runs import judged_status


def test_every_status_has_a_number_and_a_reason_of_its_own():
    """Numbers stand in files: none may change."""
    codes = [x for name, x in vars(status).items() if name.isupper() and isinstance(x, int)]
    assert codes == list(range(27)) == list(status.REASONS)
    assert len(set(status.REASONS.values())) == 27
    assert len(set(status.REASONS.values())) == len(codes)


# --- how a run ends -------------------------------------------------------------------------------

LIMIT, TOLERANCE, CRITICAL, MARGIN, RADIUS = 0.05, 1e-3, (30.0, 20.0, 25.0), 0.1, 0.07
STRAIN = 5e-4


def ended(start=status.OK, last=status.OK, distance=1.0, **found):
    """Result of a run with some metrics, the others far from their limits."""
    values = {
        "saturated_fraction": 0.0,
        "clipped_fraction": 0.0,
        "motor_saturated_fraction": 0.0,
        "pose_error_rms": np.zeros(3),
        "peak_compression": np.zeros(3),
        "residual_rms": np.ones((3, 2)),
    } | found
    outline = Outline(
        early_time=0.25,
        command_end=0.5,
        sensor_condition=np.ones(3),
        actuator_condition=np.ones(3),
        ending=None,
        saturation_limit=LIMIT,
        arrival_tolerance=TOLERANCE,
        critical_force=np.array(CRITICAL),
        joint_radius=RADIUS,
        singularity_distance=distance,
        singularity_margin=MARGIN,
        strain_limit=STRAIN,
    )
    last = SimpleNamespace(totals=None, status=jnp.asarray(float(last)), bad_time=0.75)
    with pytest.MonkeyPatch.context() as patch:
        known = metrics.Metrics({name: jnp.asarray(x) for name, x in values.items()})
        patch.setattr(metrics, "finish", lambda totals, ending: known)
        return conclude(outline, jnp.asarray(float(start)), last)


ABOVE, BELOW = 1 + 1e-6, 1 - 1e-6
ARRIVAL = [
    (np.array([TOLERANCE, 0, 0]), "x"),
    (np.array([0, TOLERANCE, 0]), "y"),
    (np.array([0, 0, TOLERANCE / RADIUS]), "angle alone"),
    (np.array([0.6, 0.8, 0]) * TOLERANCE, "x and y"),
    (np.array([0.3 * TOLERANCE, 0.4 * TOLERANCE, 0.5 * TOLERANCE / RADIUS]), "all"),
]
LIMITS = [
    *(({"pose_error_rms": x}, status.NOT_ARRIVED) for x, _ in ARRIVAL),
    ({"saturated_fraction": LIMIT}, status.SATURATED),
    ({"clipped_fraction": LIMIT}, status.CLIPPED),
    ({"motor_saturated_fraction": LIMIT}, status.MOTORS_SATURATED),
    *(({"peak_compression": np.eye(3)[i] * CRITICAL[i]}, status.OVERLOADED) for i in range(3)),
    *(({"patch_strain_peak": STRAIN * np.eye(3)[i]}, status.STRAINED) for i in range(3)),
]


@pytest.mark.parametrize(("at_limit", "code"), LIMITS)
def test_a_run_ends_ok_up_to_each_limit_and_not_beyond(at_limit, code):
    for factor, wanted in ((BELOW, status.OK), (ABOVE, code)):
        found = ended(**{name: factor * x for name, x in at_limit.items()})
        assert found.status == wanted
        assert np.all(np.isfinite(found.metrics.residual_rms))


def test_a_path_stays_away_from_singular_poses():
    assert ended(distance=MARGIN * ABOVE).status == status.OK
    assert ended(distance=MARGIN * BELOW).status == status.NEAR_SINGULAR


def test_what_explains_the_rest_comes_first():
    """A machine that is overloaded does not arrive, and its motors are at their limit."""
    bad = {name: 2 * x for changes, _ in LIMITS for name, x in changes.items()}
    order = (
        (status.OVERLOADED, "peak_compression"),
        (status.NOT_ARRIVED, "pose_error_rms"),
        (status.MOTORS_SATURATED, "motor_saturated_fraction"),
        (status.SATURATED, "saturated_fraction"),
        (status.CLIPPED, "clipped_fraction"),
    )
    for code, name in order:
        assert ended(distance=0.0, **bad).status == code
        del bad[name]
    assert ended(distance=0.0, **bad).status == status.NEAR_SINGULAR
    assert ended(**bad).status == status.STRAINED


@pytest.mark.parametrize("code", sorted(status.REASONS))
def test_only_finished_runs_have_metrics(code):
    found = ended(last=code, saturated_fraction=1.0)
    assert found.status == (status.SATURATED if code == status.OK else code)
    has_metrics = code in (0, 5, 10, 16, 18, 19, 20, 21, 25, 26)
    assert np.all(np.isfinite(found.metrics.residual_rms)) == has_metrics
    # the time of a fault is the loop's, or where it was known beforehand the command's
    assert found.bad_time == 0.75
    assert ended(start=code, last=code).bad_time == (0.25 if code else 0.75)
    assert found.command_end == 0.5


@pytest.mark.parametrize("code", sorted(status.REASONS))
def test_an_unstable_loop_is_the_status_of_what_finished(code):
    assert judged_status(code, SimpleNamespace(is_stable=True)) == code
    is_finished = code in (0, 5, 10, 16, 18, 19, 20, 21, 25, 26)
    wanted = status.UNSTABLE if is_finished else code
    assert judged_status(code, SimpleNamespace(is_stable=False)) == wanted
    assert judged_status(code, None) == (status.UNJUDGED if is_finished else code)


# --- why a run stops ------------------------------------------------------------------------------

LENGTH = np.array([0.2, 0.25, 0.3])


class Voltage(NamedTuple):
    """As much of a controller's state as is looked at."""

    voltage: Any


def frozen(is_linear=False, before=status.OK, chain=status.OK, **changes):
    """State after a sample whose next plant state differs from rest."""
    zero, still = np.zeros((3, 2)), np.zeros(3)
    plant = PlantState(*map(jnp.asarray, (still, still, zero, zero)))
    voltage = changes.pop("voltage", np.zeros((3, 2)))
    old = State(
        plant=plant,
        controller=Voltage(jnp.ones((3, 2))),
        totals={},
        status=jnp.asarray(float(before)),
        bad_time=jnp.asarray(0.0),
    )
    new = old._replace(plant=plant._replace(**changes), controller=Voltage(jnp.asarray(voltage)))
    loop = SimpleNamespace(
        # stations at mid-span, and where only mode 2 is seen
        deflection_at=jnp.tile(jnp.array([[1.0, 0.0], [0.5, 1.0]]), (3, 1, 1)),
        plant=SimpleNamespace(length=LENGTH),
        rest=object() if is_linear else None,
    )
    inputs = SimpleNamespace(pose=still, window=SimpleNamespace(time=0.125))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_module, "chain_status", lambda *_: jnp.asarray(float(chain)))
        return _freeze_if_bad(None, loop, old, new, None, inputs)


def place(index, value, shape=(3,)):
    x = np.zeros(shape)
    x[index] = value
    return x


WILD = [
    *(("pose", place(k, sign * 0.5)) for k in range(3) for sign in (1, -1)),
    *(("q", place((i, 0), sign * 0.1 * LENGTH[i], (3, 2))) for i in range(3) for sign in (1, -1)),
    *(("q", place((i, 1), 0.1 * LENGTH[i], (3, 2))) for i in range(3)),
]


@pytest.mark.parametrize(("name", "at_limit"), WILD)
def test_a_run_diverges_half_a_metre_off_or_a_tenth_of_a_link_bent(name, at_limit):
    near, far = (frozen(**{name: factor * at_limit}) for factor in (BELOW, ABOVE))
    assert (near.status, near.bad_time) == (status.OK, 0)
    np.testing.assert_array_equal(getattr(near.plant, name), BELOW * at_limit)
    assert (far.status, far.bad_time) == (status.DIVERGED, 0.125)
    assert not np.any(getattr(far.plant, name))  # the last good state stays
    np.testing.assert_array_equal(far.controller.voltage, 1)
    np.testing.assert_array_equal(near.controller.voltage, 0)


@pytest.mark.parametrize("name", ["pose", "pose_rate", "q", "q_rate", "voltage"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_stops_a_run(name, value):
    shape = (3,) if name.startswith("pose") else (3, 2)
    found = frozen(**{name: place((1,) * len(shape), value, shape)})
    assert (found.status, found.bad_time) == (status.NON_FINITE, 0.125)
    assert all(np.all(np.isfinite(x)) for x in jax.tree.leaves(found))


def test_the_first_fault_stays():
    found = frozen(before=status.SINGULAR, pose=place(0, 3.0))
    assert (found.status, found.bad_time) == (status.SINGULAR, 0)
    assert not np.any(found.plant.pose)
    # geometry explains more than its consequence
    found = frozen(chain=status.OUT_OF_REACH, pose=place(0, 3.0))
    assert (found.status, found.bad_time) == (status.OUT_OF_REACH, 0.125)


def test_a_linear_machine_has_no_end_of_its_reach():
    assert frozen(is_linear=True, chain=status.OUT_OF_REACH).status == status.OK
    assert frozen(is_linear=True, pose=place(0, 3.0)).status == status.DIVERGED


# --- what counts as being at a limit --------------------------------------------------------------


@pytest.mark.parametrize("factor", [0.99, 1.0])
@pytest.mark.parametrize("sign", [1, -1])
def test_one_channel_at_its_limit_is_enough(factor, sign):
    is_full = float(factor == 1.0)
    zero = np.zeros((3, 2))
    loop = SimpleNamespace(
        controller=SimpleNamespace(voltage_limit=80.0),
        drive=SimpleNamespace(force_limit=np.array([10.0, 20.0, 30.0])),
        plant=SimpleNamespace(stretch=None),
        strain=None,
        axial_compliance=np.ones(3),
        observer=np.zeros((3, 1, 2)),
    )
    plant = PlantState(pose=np.zeros(3), pose_rate=np.zeros(3), q=zero, q_rate=zero)
    rates = SimpleNamespace(acceleration=SimpleNamespace(axial=np.zeros(3)), chain=None)
    inputs = SimpleNamespace(pose=np.zeros(3))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_module, "stretch_error", lambda chain, stretch: stretch)
        patch.setattr(loop_module, "deflection", lambda loop, q, voltage: q)
        for i in range(3):
            volts = place((i, 1), sign * factor * 80.0, (3, 2))
            force = place(i, sign * factor * loop.drive.force_limit[i])
            some = _sample(loop, plant, inputs, volts, volts, 0.0, (np.zeros(3),) * 2, rates)
            assert (some.is_saturated, some.is_motor_saturated) == (is_full, 0)
            some = _sample(loop, plant, inputs, zero, zero, 0.0, (force, 0 * force), rates)
            assert (some.is_saturated, some.is_motor_saturated) == (0, is_full)
