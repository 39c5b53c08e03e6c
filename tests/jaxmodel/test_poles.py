"""Pole placement: asked poles are obtained on the nominal link, gains follow in closed form."""

from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

from jaxmodel.case import Case
from jaxmodel.laws.contract import acting_channels
from jaxmodel.laws.poles import _is_flat
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.prepare import design_controller
from jaxmodel.status import OK, UNPLACEABLE
from studies.engine.controller import fixed_controller
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.poles import PoleReport, _matched, _relative_distance, difference, pole_rows
from studies.engine.results import read_sweep
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.space.spec import parse_sweep
from studies.space.table import build_table, case_study
from studies.study.cases import as_arrays, build_case
from studies.study.spec import Study
from tests.bare import parse_study
from tests.jaxmodel.kept import bases_of, design_of, nominal_of, prepared
from tests.jaxmodel.kept import without_run as arrays
from tests.sweeps import run_sweep

#: Of links whose laws have a model.
DRAINED = {"amplifier_hz": 3_000.0, "sensor_highpass_hz": 5.0}
#: Added damping ratios by mode.
BY_MODE = [[0.2, 0.03, 0.01], [0.15, 0.02, 0.005], [0.1, 0.0, 0.02]]


def study_with(law: str = "imsc", decay: object = 100.0, **changes: object) -> Study:
    control = {"law": law, "pole_decay": decay} | changes.pop("control", {})
    return parse_study({"control": control, "link": {"modes": 3}} | changes)


def nearest_poles(asked: np.ndarray, matrix: np.ndarray, period: float) -> np.ndarray:
    """Of every mode, the loop's eigenvalue nearest to the asked one, as s [1/s]."""
    found = np.empty_like(asked)
    for link, mode in np.ndindex(*asked.shape):
        block = matrix[link, mode if matrix.shape[1] > 1 else 0]
        z = np.linalg.eigvals(block)
        at = np.argmin(np.abs(z - np.exp(asked[link, mode] * period)))
        found[link, mode] = np.log(z[at]) / period
    return found


def random_poles(case: Case, rng: np.random.Generator, omega: np.ndarray) -> Case:
    """Decays of 0.002 to 0.3 omega, frequencies of 0.85 to 1.2 omega."""
    decay = omega * np.exp(rng.uniform(np.log(0.002), np.log(0.3), omega.shape))
    frequency = omega * rng.uniform(0.85, 1.2, omega.shape)
    return case._replace(control=case.control._replace(pole_decay=decay, pole_frequency=frequency))


@pytest.mark.parametrize("n_sets", [30, pytest.param(200, marks=pytest.mark.long)])
@pytest.mark.parametrize(
    ("law", "changes"),
    [
        ("imsc", {}),
        (
            "imsc",
            {
                "electronics": {"sensor_highpass_hz": 3.0, "amplifier_hz": 3000.0},
                "control": {"feedthrough_factor": 0.6},
            },
        ),
        ("observer", {"electronics": DRAINED}),
    ],
)
def test_random_poles_are_obtained_on_the_nominal_link(law, changes, n_sets):
    """Sets of nine, to 1e-9 of their size."""
    study = study_with(law, **changes)
    structure, case = arrays(study)
    omega = _omega(structure, case)
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(n_sets):
        asked, matrix = map(np.asarray, nominal_of(structure, random_poles(case, rng, omega)))
        found = nearest_poles(asked, matrix, float(case.electronics.period))
        worst = max(worst, np.max(np.abs(found - asked) / np.abs(asked)))
    assert worst < 1e-9


def _omega(structure, case):
    return np.asarray(bases_of(structure, case).believed_omega)


def _gains(structure, case):
    law = design_of(structure, case).controller.feedback
    return np.asarray(law.velocity_gain), np.asarray(law.position_gain)


def test_gains_agree_with_an_independent_loop():
    """Mode, filter, hold, delay and estimates by SciPy's exponential and polynomials, to 1e-8."""
    study = study_with(decay=[[150.0, 80.0, 90.0], [100.0, 70.0, 80.0], [60.0, 90.0, 200.0]])
    structure, case = arrays(study)
    design = design_of(structure, case)
    law, nominal = jax.tree.map(np.asarray, (design.controller.feedback, design.nominal))
    period, corner = float(case.electronics.period), float(case.electronics.antialias)
    static = nominal.observer @ nominal.feedthrough @ nominal.synthesizer
    for i, j in np.ndindex(3, 3):
        omega, mass = nominal.omega[i, j], nominal.modal_mass[i, j]
        a = np.zeros((4, 4))  # q, q', z, z' of the filtered coordinate, and force [N]
        a[0, 1] = a[2, 3] = 1.0
        a[1, :2] = -(omega**2), -0.02 * omega
        a[3, [0, 2, 3]] = corner**2, -(corner**2), -np.sqrt(2) * corner
        b = np.array([0.0, 1 / mass, 0.0, corner**2 * static[i, j, j]])
        whole = np.zeros((5, 5))
        whole[:4, :4], whole[:4, 4] = a, b
        held = expm(whole * period)
        e = law.estimator
        first, denominator = e.first, e.denominator
        top = np.polymul([first[0][i, j], first[1][i, j]], _numerator(law, i, j))
        low = np.polymul([1.0, first[2][i, j]], [1.0, denominator[0][i, j], denominator[1][i, j]])
        # controller: force = -top/low seen; next: delayed by a sample
        size = len(low) - 1
        companion = np.zeros((size, size))
        companion[0], companion[1:, :-1] = -low[1:], np.eye(size - 1)
        out, through = top[1:] - top[0] * low[1:], top[0]
        loop = np.zeros((5 + size, 5 + size))
        look = np.zeros(5)
        look[2] = 1.0
        loop[:4, :5] = held[:4]
        loop[4, :5], loop[4, 5:] = -through * look, -out
        loop[5, :5] = look
        loop[5:, 5:] = companion
        poles = np.linalg.eigvals(loop)
        decay = study.control.pole_decay[i][j]
        wanted = np.exp((-decay + 1j * np.sqrt(omega**2 - decay**2)) * period)
        assert np.abs(poles - wanted).min() < 1e-8


def _numerator(law, i, j):
    velocity = np.array([n[i, j] for n in law.estimator.velocity])
    position = np.array([n[i, j] for n in law.estimator.position])
    return law.velocity_gain[i, j] * velocity + law.position_gain[i, j] * position


def test_modes_without_a_decay_follow_the_ratios():
    """alpha_j = zeta omega_j + r_j (alpha_1 - zeta omega_1); a ratio of 0 is no gain."""
    ratios = [[1.0, 0.5, 0.0], [1.0, 0.3, 2.0], [1.0, 0.0, 0.1]]
    decay = [[150.0], [100.0, 77.0], [60.0]]
    study = study_with(decay=decay, control={"ratios": ratios})
    structure, case = arrays(study)
    asked, matrix = map(np.asarray, nominal_of(structure, case))
    omega = _omega(structure, case)
    first = np.array([150.0, 100.0, 60.0])[:, None] - 0.01 * omega[:, :1]
    wanted = 0.01 * omega + np.array(ratios) * first
    wanted[1, 1] = 77.0
    np.testing.assert_allclose(-asked.real, wanted, rtol=1e-12)
    np.testing.assert_allclose(np.abs(asked), omega, rtol=1e-12)
    found = nearest_poles(asked, matrix, float(case.electronics.period))
    np.testing.assert_allclose(found, asked, rtol=1e-9)
    velocity, position = _gains(structure, case)
    assert velocity[0, 2] == position[0, 2] == velocity[2, 1] == 0.0
    assert np.all(velocity[[0, 1, 1, 2], [1, 1, 2, 2]] != 0)


def test_continuous_feedback_has_the_gains_of_the_paper():
    """(22)-(23), less the structural damping that is there already."""
    control = {"feedback": "ideal", "pole_frequency_hz": [[120.0, 0.0], [0.0, 470.0], [125.0]]}
    study = study_with(decay=90.0, control=control)
    structure, case = arrays(study)
    omega = _omega(structure, case)
    velocity, position = _gains(structure, case)
    mass = study.link.density * study.link.width * study.link.thickness * study.link.length / 2
    beta = np.sqrt(omega**2 - 90.0**2)
    for at, hertz in (((0, 0), 120.0), ((1, 1), 470.0), ((2, 0), 125.0)):
        beta[at] = 2 * np.pi * hertz
    np.testing.assert_allclose(velocity, mass * 2 * (90.0 - 0.01 * omega), rtol=1e-9)
    wanted = mass * (90.0**2 + beta**2 - omega**2)
    np.testing.assert_allclose(position, wanted, rtol=1e-9, atol=1e-6)


def test_gains_are_differentiable():
    """By decays and frequencies, forward against differences, 1e-6."""
    study = study_with(decay=[[150.0, 80.0, 90.0]] * 3)
    structure, case = arrays(study)
    bases = bases_of(structure, case)
    omega = bases.believed_omega

    def gains(x):
        control = case.control._replace(
            pole_decay=case.control.pole_decay * jnp.exp(x[0]),
            pole_frequency=omega * jnp.exp(x[1]),
        )
        changed = case._replace(control=control)
        law = design_controller(structure, changed, bases).controller.feedback
        found = jnp.stack([law.velocity_gain, law.position_gain])
        return found, found

    both, h = jax.jit(jax.jacfwd(gains, has_aux=True)), 1e-5  # one program for both
    slope = both(np.zeros(2))[0]
    for k in range(2):
        step = h * np.eye(2)[k]
        wanted = (both(step)[1] - both(-step)[1]) / (2 * h)
        scale = np.abs(wanted).max()
        np.testing.assert_allclose(slope[..., k], wanted, rtol=1e-6, atol=1e-7 * scale)


@pytest.mark.parametrize(
    ("law", "changes", "code"),
    [
        ("imsc", {"pole_decay": 100.0}, OK),
        # whatever the law, by the same function
        pytest.param("observer", {"pole_decay": 700.0}, OK, marks=pytest.mark.long),
        ("imsc", {"pole_decay": 800.0}, UNPLACEABLE),  # mode 1 vibrates at 719 rad/s
        pytest.param("observer", {"pole_decay": 800.0}, UNPLACEABLE, marks=pytest.mark.long),
        ("imsc", {"pole_decay": 800.0, "mode_mask": [[False, True, True]] * 3}, OK),
        ("imsc", {"pole_decay": 50.0, "pole_frequency_hz": [[5e3]] * 3}, UNPLACEABLE),
        ("imsc", {"pole_decay": 800.0, "pole_frequency_hz": [[1e-4]] * 3}, UNPLACEABLE),  # in phase
        ("imsc", {"pole_decay": [[20.0]] * 3, "ratios": [[1.0, -9.0, 1.0]] * 3}, UNPLACEABLE),
    ],
)
def test_what_cannot_be_placed_is_a_status(law, changes, code):
    study = study_with(law, control=changes, electronics=DRAINED if law == "observer" else {})
    structure, case = arrays(study)
    found = prepared(structure, case)
    assert int(found.status) == code
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(found.loop.controller.feedback))


@pytest.mark.parametrize(
    ("control", "message"),
    [
        ({"law": "lqr", "pole_decay": 100.0}, "control.law = 'lqr'; allowed: imsc, modified_imsc,"),
        ({"pole_decay": -1.0}, "control.pole_decay"),
        ({"pole_decay": [1.0, 2.0]}, "control.pole_decay"),
        ({"pole_decay": [[1.0], [2.0]]}, "allowed: .* or 3 lists, each of finite numbers"),
        ({"pole_decay": [[1.0, 2.0, 3.0, 4.0]] * 3}, "allowed: one list a link of 1 to 3 entries"),
        ({"pole_decay": [[], [1.0], [1.0]]}, "allowed: one list a link of 1 to 3 entries"),
        (
            {"pole_frequency_hz": [[100.0]] * 3},
            "where control.pole_frequency_hz is given",
        ),
        ({"pole_decay": 9.0, "pole_frequency_hz": 100.0}, "one list a link by mode, where"),
        ({"law": "lqr", "damping": 0.1}, "modified_imsc, observer, with control.damping"),
        ({"damping": -0.1}, "control.damping = -0.1; allowed: a finite number >= 0 and < 1"),
        ({"damping": 0.99}, "control.damping = 0.99; allowed: below 0.99, 1 less link.damping"),
        ({"damping": [0.1, 0.2]}, "control.damping"),
        ({"damping": [[0.1], [0.2]]}, "control.damping.*, or 3 lists, each of finite numbers"),
        ({"damping": 0.2, "pole_decay": 9.0}, "pole_decay = 9.0: control.damping = 0.2 decides"),
        (
            {"damping": 0.2, "pole_frequency_hz": [[99.0]] * 3},
            "pole_frequency_hz = .*: control.damping",
        ),
        (
            {"damping": 0.2, "velocity_gain": [3.0, 3.0, 3.0]},
            "velocity_gain = .*: control.damping = 0.2 decides the gains; leave one",
        ),
    ],
)
def test_poles_that_make_no_sense_are_refused(control, message):
    with pytest.raises(StudyError, match=message):
        parse_study({"control": control})


def test_poles_are_apart_by_the_larger_share_of_decay_and_frequency():
    specified = np.array([-600 + 800j, -600 + 800j, -600 - 800j])  # 1000 in size
    found = np.array([-900 + 800j, -660 + 1000j, -600 - 800j])
    np.testing.assert_allclose(_relative_distance(found, specified), [0.5, 0.2, 0.0])


@pytest.mark.parametrize("kind", MECHANISMS)
def test_every_mechanism_takes_damping_instead_of_the_gains_that_it_has_by_default(kind):
    data = {"machine": {"kind": kind}, "control": {"damping": 0.1}}
    assert parse_study(data).control.damping == 0.1
    data["control"]["velocity_gain"] = [9.0] * MECHANISMS[kind].n_links
    with pytest.raises(StudyError, match="velocity_gain.*decides the gains"):
        parse_study(data)


@pytest.mark.parametrize("rate", [4_500.0, 10_000.0, 40_000.0])
def test_the_observers_loop_has_the_poles_of_continuous_feedback(rate):
    """From the study's gains, at any sample rate, on the model of the link."""
    electronics = {"sample_rate_hz": rate, "antialias_hz": 1_500.0} | DRAINED
    gains = {"velocity_gain": (1.0, 2.0, 3.0), "position_gain": (0.0, 200.0, -300.0)}
    study = study_with("observer", [], control=gains, electronics=electronics)
    structure, case = arrays(study)
    assert not structure.has_poles
    structure = structure._replace(has_poles=True)  # as a case among others that have some
    _, matrix = map(np.asarray, nominal_of(structure, case))
    nominal = jax.tree.map(np.asarray, design_of(structure, case).nominal)
    ratio = np.array(study.control.ratios)
    velocity = np.array(gains["velocity_gain"])[:, None] * ratio / nominal.modal_mass
    position = np.array(gains["position_gain"])[:, None] * ratio / nominal.modal_mass
    damping, square = 0.01 * nominal.omega + velocity / 2, nominal.omega**2 + position
    wanted = -damping + 1j * np.sqrt(square - damping**2)
    found = nearest_poles(wanted, matrix, 1 / rate)
    np.testing.assert_allclose(found, wanted, rtol=1e-8)


#: Three different links with a payload off centre.
OWN_LINKS = {
    "link": {
        "length": [0.20, 0.22, 0.21],
        "thickness": [2e-3, 2.2e-3, 2e-3],
        "youngs_modulus": [70e9, 68e9, 72e9],
    },
    "patches": {"centers": [[0.05, 0.10, 0.15], [0.055, 0.11, 0.165], [0.05, 0.105, 0.155]]},
    "load": {"mass": 0.1, "offset": [0.01, 0.005]},
}


@pytest.mark.parametrize(
    ("machine", "dampings"),
    [
        (OWN_LINKS, [0.2, BY_MODE]),
        # a payload without mass: the default machine
        pytest.param(
            {"load": {"mass": 0.0, "offset": [0.01, 0.005]}}, [0.2], marks=pytest.mark.long
        ),
    ],
    ids=["links", "default"],
)
def test_added_damping_is_obtained_on_any_machine(machine, dampings):
    """0.2 of mode 1, others by (24): to 1e-9 on the nominal link, 5 % assembled, margin > 2.

    Natural frequencies are kept. By mode, each gets its own.
    """
    ratio = np.array(Study().control.ratios)
    for damping in dampings:
        link = machine.get("link", {}) | {"modes": 3}
        study = parse_study({**machine, "link": link, "control": {"damping": damping}})
        structure, case = arrays(study)
        asked, matrix = map(np.asarray, nominal_of(structure, case))
        found = nearest_poles(asked, matrix, float(case.electronics.period))
        omega = _omega(structure, case)
        added = 0.2 * ratio * omega[:, :1] / omega if damping == 0.2 else np.array(damping)
        np.testing.assert_allclose(np.abs(found), omega, rtol=1e-9)
        np.testing.assert_allclose(-found.real / np.abs(found), 0.01 + added, rtol=1e-9)
        if damping == 0.2:
            report = loop_report(structure, case, np.array(study.motion.waypoints[0]))
            assert report.is_stable and report.gain_margin > 2
            np.testing.assert_allclose(report.damping_ratio[0], 0.21, rtol=0.05)


def test_added_damping_leaves_modes_alone_where_it_is_none():
    """0 is no gain, whatever the links' own damping; modes beyond a list follow the ratios."""
    study = parse_study(
        {
            "link": {"modes": 3, "damping_ratio": 0.0},
            "control": {"damping": [[0.2, 0.0], [0.0], [0.1, 0.05, 0.0]]},
        }
    )
    structure, case = arrays(study)
    found = prepared(structure, case)
    assert int(found.status) == OK
    is_on = np.asarray(found.loop.controller.feedback.velocity_gain) != 0
    np.testing.assert_array_equal(is_on, [[True, False, True], [False] * 3, [True, True, False]])


def test_added_damping_is_an_axis_of_a_sweep():
    """One number, one a link, lists by mode and entries of them: each case is its own study's."""
    two = [row[:2] for row in BY_MODE]
    axes = {"control.damping": [0.1, [0.1, 0.2, 0.0], two], "control.modes": [2, 3]}
    _check_cases({"sweep": {"axes": axes}})
    entry = {"control.damping[1]": [0.0, 0.3]}
    _check_cases({"control": {"damping": 0.1}, "sweep": {"axes": entry}})
    entry = {"control.damping[1][1]": [0.0, 0.3]}
    _check_cases({"control": {"damping": BY_MODE}, "sweep": {"axes": entry}})


def _check_cases(data: dict) -> None:
    table = build_table(parse_sweep(data))
    (group,) = plan_groups(table, np.arange(len(table)), local_layout)
    assert group.structure.has_poles and group.structure.has_position_gain
    together = chunk_cases(table, np.arange(len(table)), group.structure, len(table)).control
    for k in range(len(table)):
        alone = build_case(case_study(table, k)).control.damping
        one = together.damping[k if len(together.damping) > 1 else 0]
        np.testing.assert_array_equal(one[:, : alone.shape[1]], alone)


def test_decays_and_damping_ratios_are_shown_in_their_units():
    poles = np.full((3, 1), 720 * (-0.21 + 1j * np.sqrt(1 - 0.21**2)))
    omega = np.full((3, 1), 720.0)
    (row, *_) = pole_rows(PoleReport(poles, poles, poles, 1.0, True, omega, omega))
    assert row == ["1", "1", *["zeta 0.21, 114.6 Hz"] * 3]
    (row, *_) = pole_rows(PoleReport(poles, poles, poles, 1.0, False, omega, omega))
    assert row == ["1", "1", *["151.2 1/s, 112 Hz"] * 3]


@pytest.mark.parametrize(
    ("law", "electronics"),
    [
        ("observer", DRAINED),
        pytest.param("imsc", DRAINED, marks=pytest.mark.long),
        pytest.param("observer", {"amplifier_hz": 2_000.0}, marks=pytest.mark.long),
        pytest.param("observer", {"sensor_highpass_hz": 5.0}, marks=pytest.mark.long),
    ],
)
def test_exports_and_certificates_get_the_controller_that_runs(law, electronics):
    """With poles, amplifiers and drained patches, which are part of the design."""
    study = study_with(law, [160.0, 120.0, 90.0], electronics=electronics)
    structure, case = arrays(study)
    runs = design_of(structure, case).controller
    exported = fixed_controller(study).controller
    near = partial(np.testing.assert_allclose, rtol=1e-9, atol=1e-12)
    jax.tree.map(near, exported.feedback, runs.feedback)


#: Modes without a gain, where the law's model has more damping than the links.
FIRST_ALONE = {
    "law": "observer",
    "decay": [[160.0]] * 3,
    "link": {"modes": 3, "damping_ratio": 0.001},
    "control": {"ratios": [[1.0, 0, 0]] * 3},
    "electronics": DRAINED,
}


def test_observers_give_modes_no_gain_whatever_the_links_damping():
    """A ratio of 0 is no gain: commands of a link are those of mode 1's force alone."""
    design = jax.tree.map(np.asarray, design_of(*arrays(study_with(**FIRST_ALONE))))
    feedback = design.controller.feedback
    for link in range(3):
        every = [feedback.direct[link], feedback.leave[link].reshape(3, -1)]
        for part in every:
            left, size, _ = np.linalg.svd(part)
            assert size[0] > 0 and size[1] < 1e-10 * size[0]
            first = design.nominal.synthesizer[link][:, 0]
            assert abs(left[:, 0] @ first) == pytest.approx(np.linalg.norm(first), rel=1e-10)


@pytest.mark.long  # in short: above
def test_observers_leave_modes_alone_whatever_the_links_damping():
    study = study_with(**FIRST_ALONE)
    structure, case = arrays(study)
    report = loop_report(structure, case, np.array(study.motion.waypoints[0]))
    assert report.is_stable and report.gain_margin > 2
    assert np.all((report.damping_ratio[1:] > 0.0009) & (report.damping_ratio[1:] < 0.0015))


#: Decays of a sweep, and how many modes are controlled.
DECAYS = {
    "control.pole_decay": [50.0, 200.0, [[150.0, 80.0], [100.0], [60.0]]],
    "control.modes": [2, 3],
}


def test_poles_are_axes_of_a_sweep():
    """One number, lists by mode and entries of them; each case has the gains of its own study."""
    table = build_table(parse_sweep({"link": {"modes": 3}, "sweep": {"axes": DECAYS}}))
    (group,) = plan_groups(table, np.arange(6), local_layout)
    assert group.structure.has_poles and group.structure.n_controlled == 3
    together = group.structure._replace(n_steps=1)
    for k in range(6):
        case = jax.tree.map(lambda x: np.asarray(x)[0], chunk_cases(table, [k], together, 1))
        study = case_study(table, k)
        for found, alone in zip(_gains(together, case), _gains(*arrays(study)), strict=True):
            n = alone.shape[1]
            assert n == study.control.modes and np.any(alone != 0)
            np.testing.assert_allclose(found[:, :n], alone, rtol=1e-9)
            assert not np.any(found[:, n:])
    assert len(table) == 6


@pytest.mark.long  # in short: above
def test_runs_of_a_sweep_over_poles(tmp_path):
    """Each case is the run of its own study."""
    short = {
        "run": {"duration": 0.04},
        "link": {"modes": 3},
        "motion": {"waypoints": [[0.0, 0.0, 0.5236]]},
        "shaper": {"kind": "none"},
        "drive": {"pulse_force": [20.0, -10.0, 15.0], "pulse_length": 0.0005},
        "metrics": {"residual_delay": 0.003, "residual_length": 0.03},
    }
    spec = parse_sweep({**short, "sweep": {"axes": DECAYS}})
    run_sweep(spec, tmp_path / "sweep")
    found = read_sweep(tmp_path / "sweep")
    table, rms = found.table, found["residual_modal_rms"]
    assert len(table) == 6 and np.all(found["status"] == OK)
    for k in range(6):
        alone = run_study(case_study(table, k), has_record=False, has_loop=False).result.metrics
        np.testing.assert_allclose(rms[k], alone.residual_modal_rms, rtol=1e-6, atol=1e-15)
    assert rms[0].max() > 1.2 * rms[2].max()  # 200 1/s leave less than 50


def test_assembled_poles_are_matched_to_links_and_differences_are_said():
    """Reports, rows and sentences, from made-up poles."""
    asked = np.array([[-160 + 700j, -80 + 2800j], [-100 + 700j, np.nan], [-50 + 700j, np.nan]])
    zeta = np.array([[0.08, 0.22, 0.15]])
    poles = 2 * np.pi * 114.0 * (-zeta[0] + 1j * np.sqrt(1 - zeta[0] ** 2))
    np.testing.assert_array_equal(_matched(asked[:, 0], poles), poles[[1, 2, 0]])
    assembled = asked * 1.001
    assembled[1, 0] = -110 + 710j
    omega = np.abs(asked)
    found = PoleReport(asked, asked, assembled, 1.0, False, omega, omega)
    rows = pole_rows(found)
    assert [row[:2] for row in rows] == [["1", "1"], ["1", "2"], ["1", "3"], ["2", "1"]]
    assert rows[1][2] == "100 1/s, 111.4 Hz" and rows[1][4] == "110 1/s, 113 Hz"
    assert "most in mode 1 of link 2: 110 1/s, 113 Hz instead of 100 1/s, 111.4" in difference(
        found
    )
    assert "coupled by the platform" in difference(found)
    wrong = difference(found._replace(model_omega=1.1 * omega))
    assert "model mismatch" in wrong and "coupled" not in wrong
    other = PoleReport(asked, 1.1 * asked, 1.1 * asked, 2.0, False, omega, omega)
    assert difference(other) == (
        "Poles are placed for control.gain_factor = 1; with 2, the nominal link has others. The "
        "assembled machine has all of them as on the nominal link, to 2 %."
    )
    same = PoleReport(asked, 1.1 * asked, asked, 1.0, False, omega, omega)
    assert difference(same).startswith("The nominal link does not have them")
    assert difference(same).endswith("all of them as specified, to 2 %.")


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
def test_estimates_in_phase_place_no_poles_whatever_their_size(size):
    turned = np.exp(1j * np.array([0.0, 0.5e-4, 2e-4, 1.0, np.pi - 0.5e-4]))
    np.testing.assert_array_equal(
        _is_flat((0.3 - 2j) * np.ones(5), size * (0.3 - 2j) * turned),
        [True, True, False, False, True],
    )


def test_channels_act_where_links_and_modes_are_chosen():
    """Of the modes that the model has."""
    links, modes = [True, False, True], [[True, False, True], [True] * 3, [False, True, True]]
    study = study_with(decay=[], control={"links": links, "mode_mask": modes})
    known = SimpleNamespace(mask=np.array([[1.0, 1.0, 0.0]] * 3))
    found = acting_channels(as_arrays(build_case(study)), known)
    np.testing.assert_array_equal(found, [[1, 0, 0], [0, 0, 0], [0, 1, 0]])
