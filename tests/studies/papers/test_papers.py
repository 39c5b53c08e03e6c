"""Cards of papers: their contract, the list, and what each card finds, on small batches."""

import json
import re
from functools import partial
from types import SimpleNamespace
from unittest.mock import MagicMock, patch

import jsonschema
import numpy as np
import pytest
import scipy
from rich.console import Console

from studies.papers.card import FAILS, HOLDS, depends_on, outcome_of
from studies.papers.catalogue import CARDS, NOTEBOOKS
from studies.papers.rrr_2016 import card as rrr_card
from studies.papers.rrr_2016 import confirmation, energies, findings, thresholds
from studies.papers.rrr_2016.claims import judge
from studies.papers.rrr_2016.confirmation import confirm
from studies.papers.rrr_2016.coupling import (
    DEFINITIONS,
    after_plucks,
    coupling_ratio,
    law,
    ratio_of,
)
from studies.papers.rrr_2016.energies import (
    ALL,
    ALONE,
    LINKS,
    NONE,
    PLUCKED,
    SETTLED,
    Energies,
    _plucks,
    free_energies,
    propagator,
)
from studies.papers.rrr_2016.findings import Baseline, Effort, Kind, Sampled
from studies.papers.rrr_2016.machines import baselines, one_study, sample, varied
from studies.papers.rrr_2016.report import _falls_below
from studies.papers.rrr_2016.thresholds import DAMPING, greatest_damping, threshold
from studies.papers.run import run_card
from studies.show.document import schema
from tests import TOP
from tests.pages import text_of
from tests.studies.test_cli import refused, run


def test_cards_are_listed(capsys):
    code, out, err = run(capsys, "paper")
    assert (code, err) == (0, "")
    assert [line.partition(":")[0] for line in out.splitlines()] == [*CARDS, *NOTEBOOKS]
    for path in NOTEBOOKS.values():
        assert path in out and (TOP / path).exists()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("zhang_2061", "--out", "OUT"), "NAME = 'zhang_2061'; allowed: .*did you mean 'zhang_201"),
        (("rrr",), "NAME = 'rrr'; allowed: .*did you mean 'rrr_2016'?"),
        (("zhang_2016",), "--out: missing"),
        (("geronel_2025", "--out", "OUT"), "no card; see notebooks/9_gauges"),
        (("gupta_2010",), "no card; see notebooks/10_placement"),
        (("--out", "OUT"), "NAME: missing; allowed: zhang_2016"),
    ],
)
def test_incomplete_requests_are_refused(capsys, arguments, message):
    assert re.search(message, refused(capsys, "paper", *arguments))


@pytest.mark.parametrize("card", CARDS.values(), ids=CARDS)
def test_a_card_says_what_it_tests(card):
    assert CARDS[card.name] is card and card.work > 0
    assert card.claims and card.left_open and card.read
    texts = [claim.text for claim in card.claims]
    assert len({*texts}) == len(texts)
    assert all(all(claim) for claim in card.claims)


def test_outcomes():
    assert [outcome_of(x) for x in (True, False)] == [HOLDS, FAILS]
    assert depends_on("the mass", "holds below 1 kg") == "depends on the mass: holds below 1 kg"


# --- rrr_2016 -------------------------------------------------------------------------------------

SMALL = Effort(
    machines=256,
    poses=3,
    modes=(1,),
    drives=2,
    masses=2,
    strengths=(0.05,),
    simulated=(),
)
RRR = baselines()["3-RRR"]


@pytest.fixture(scope="module", autouse=True)
def small_batches():
    """One size of batches for all; not by monkeypatch, since programs with it may be kept."""
    with patch.object(energies, "_BATCH", 32):
        yield


def card_on_few_machines(folder, effort):
    with patch.object(thresholds, "HALVINGS", 2):
        small = rrr_card.CARD._replace(run=partial(rrr_card.evaluate, effort))
        return run_card(small, folder, Console(quiet=True))


@pytest.fixture(scope="module")
def coupled(tmp_path_factory):
    """Folder and result of the card on few machines of one of its kinds."""
    folder = tmp_path_factory.mktemp("rrr")
    with patch.object(findings, "baselines", lambda: {"3-RRR": RRR}):
        return folder, card_on_few_machines(folder, SMALL)


@pytest.mark.long  # in short: one of the kinds, with one mode
def test_one_mode_per_link_is_enough(tmp_path):
    result = card_on_few_machines(tmp_path, SMALL._replace(modes=(1, 2)))
    assert {row[0] for row in result.tables["modes"].rows} == set(baselines())
    rows = np.array([row[1:] for row in result.tables["modes"].rows], float)
    np.testing.assert_allclose(rows[::2, 1:], rows[1::2, 1:], rtol=0.01)
    assert "depends on the coupling ratio" in result.verdicts[1].outcome


def test_progress_of_the_study_ends_with_its_work():
    shares = []
    parts = ("_baseline", "_sampled", "_nearest", "damping_map", "confirm")
    with patch.multiple(findings, **{name: MagicMock() for name in parts}):
        findings.find(rrr_card.EFFORT, lambda _, share: shares.append(share))
    assert sum(shares) == rrr_card.CARD.work


def test_the_first_mode_of_each_link_is_plucked():
    """Of two: q stands behind place and velocity of the platform."""
    found = _plucks(SimpleNamespace(n_pose=3, n_links=3, n_modes=2))
    np.testing.assert_array_equal(found, np.eye(18)[:, [6, 8, 10]])


@pytest.mark.parametrize("name", baselines())
def test_studies_of_a_sample_have_its_numbers(name):
    """Mass at the near joints: of a slider, or of a crank 0.15 m long."""
    machines = sample(baselines()[name], 4, seed=1)
    study, columns = one_study(machines, 2), machines.columns
    at = {"3-PRR": "machine.slider_mass", "3-RRR": "machine.kinds.rrr.crank_inertia"}[name]
    near = columns[at][2] / {"3-PRR": 1.0, "3-RRR": 0.15**2}[name]
    omega = np.sqrt(columns["drive.kp"][2] / near)
    assert columns["drive.kd"][2] == pytest.approx(near * omega)  # half damped
    assert 0.02 <= near <= 0.5 and 71.9 <= omega <= 7190.0
    assert study.motion.waypoints == (tuple(machines.poses[2]),)
    assert study.machine.platform_mass == columns["machine.platform_mass"][2]


def test_card_writes_a_whole_folder(coupled):
    folder, result = coupled
    data = [*(f"{name}.csv" for name in result.tables), "claims.json"]
    images = [*(f"{name}.png" for name in result.figures), "machine.png"]
    assert sorted(x.name for x in folder.iterdir()) == sorted([*data, *images, "report.html"])
    found = json.loads((folder / "claims.json").read_text(encoding="utf-8"))
    jsonschema.validate(found, schema("paper"))
    assert [x["text"] for x in found["claims"]] == [x.text for x in rrr_card.CARD.claims]
    assert "depends on the coupling ratio" in found["claims"][1]["outcome"]
    text = text_of((folder / "report.html").read_text(encoding="utf-8"))
    assert all(x["found"] in text for x in found["claims"])


@pytest.fixture(scope="module")
def unlike():
    """A machine with slightly different links, out of home."""
    return varied(
        RRR,
        link_mass=np.array([20.0]),
        platform_mass=np.array([0.2]),
        near_mass=np.array([0.1]),
        drive_ratio=np.array([0.4]),
        damping=np.array([0.005]),
        added=np.array([0.05]),
        stiffness=np.array([[1.0, 1.01, 0.99]]),
        poses=np.array([[0.01, 0.02, 0.1]]),
    )


@pytest.mark.long  # in short: the linear plant runs in its place, below
def test_a_whole_simulation_confirms_the_linear_plant(unlike):
    """Sampled, nonlinear, with converters: its delay costs link 1 some damping."""
    found = confirm(unlike, 0, lambda *_: None)
    assert found.linear_ratio > 0.3
    assert found.simulated_ratio == pytest.approx(found.linear_ratio, rel=0.01)
    np.testing.assert_allclose(found.simulated[1:], found.linear[1:], atol=0.01)
    assert found.linear[1:].max() > 0.05
    assert 0.8 * found.linear[0] < found.simulated[0] < found.linear[0]


def test_plucked_runs_confirm_the_energies(unlike):
    """Sums over samples of the linear plant, by SciPy's exponential, of the runs asked for."""
    plant = free_energies(unlike.study, unlike.columns, unlike.poses, 1)

    def run(structure, cases, _):
        records = []
        for case in cases:
            assert list(case.control.link_mask[1:]) == [0, 0]
            mask = ALONE.start if case.control.link_mask[0] else NONE
            step = scipy.linalg.expm(1e-4 * plant.state[0, mask])
            states = [np.concatenate([np.zeros(6), case.initial.modal[:, 0], np.zeros(3)])]
            for _ in range(structure.n_steps):
                states.append(step @ states[-1])
            states[0] *= 0.5**0.5  # half of its energy, by the trapezoidal rule
            records.append(np.array(states)[:, 6:9, None])
        return SimpleNamespace(record=SimpleNamespace(chord_deflection_stations=np.array(records)))

    with (
        patch.object(confirmation, "run_batches", run),
        patch.multiple(confirmation, MODES=1, FOLLOWED=1.0),
    ):
        found = confirm(unlike, 0, lambda *_: None)
    assert found.linear_ratio > 0.3 and found.linear[1:].max() > 0.05
    assert found.simulated_ratio == pytest.approx(found.linear_ratio, rel=1e-3)
    np.testing.assert_allclose(found.simulated, found.linear, atol=1e-3)


@pytest.fixture(scope="module", params=["3-RRR", pytest.param("3-PRR", marks=pytest.mark.long)])
def free(request):
    """A few machines of a sample, and their energies."""
    machines = sample(baselines()[request.param], 32, seed=1)
    return machines, free_energies(machines.study, machines.columns, machines.poses, 1)


def test_energies_are_those_of_lyapunov_s_equation(free):
    """SciPy's solver, case by case; the pluck of link 2 seen at link 1 and at the platform."""
    _, energies = free
    rows = np.flatnonzero(energies.is_feasible)
    assert len(rows) > 16
    for k in rows[:8]:
        for mask in (NONE, ALL):
            state = energies.state[k, mask]
            start = np.eye(len(state))[7]
            scale = scale_of(energies)  # for the solver
            scaled = state * scale / scale[:, None]
            for place, output in ((0, np.eye(1, len(state), 6)), (3, np.eye(2, len(state)))):
                whole = scipy.linalg.solve_continuous_lyapunov(scaled.T, -output.T @ output)
                value = energies.value[k, mask, place, 1]
                np.testing.assert_allclose(value, start @ whole @ start, rtol=1e-6)


def test_propagators_of_stiff_drives(free):
    """SciPy's exponential, which does not limit its squarings."""
    _, energies = free
    size = np.abs(energies.state[:, NONE]).max(axis=(1, 2)) * energies.is_feasible
    state = energies.state[int(np.argmax(size)), NONE]
    scale = scale_of(energies)
    found = (
        np.asarray(propagator(state, SETTLED, 3, energies.omega.mean())) * scale / scale[:, None]
    )
    wanted = scipy.linalg.expm(SETTLED * state * scale / scale[:, None])
    np.testing.assert_allclose(found, wanted, atol=1e-8 * np.abs(wanted).max())


def scale_of(energies):
    """Sizes of the states (X, X', q, q') of one mode per link."""
    return np.repeat([1.0, energies.omega.mean(), 1.0, energies.omega.mean()], 3)


def test_links_on_locked_drives_are_on_their_own():
    """However light the platform: joints that stand still pass nothing on."""
    ratios = []
    for drive_ratio in (1.5, 300.0):
        machines = varied(
            RRR,
            link_mass=np.array([10.0]),
            platform_mass=np.array([0.05]),
            near_mass=np.array([0.1]),
            drive_ratio=np.array([drive_ratio]),
            damping=np.array([0.005]),
            added=np.array([0.1]),
            stiffness=np.ones((1, 3)),
            poses=np.array([[0.01, 0.01, 0.05]]),
        )
        energies = free_energies(machines.study, machines.columns, machines.poses, 1)
        ratios.append(float(coupling_ratio(energies)[0]))
    assert ratios[1] < 1e-3 < 0.1 < ratios[0]


def test_reductions_of_two_links_that_share_their_energy():
    """The law by hand: energies 1 in the plucked link, rho^2 in another, control takes those."""
    value = np.full((1, 5, 5, 6), 0.25)
    value[0, NONE, LINKS, PLUCKED] = 0.25 + 0.75 * np.eye(3)
    for i in range(3):  # with link i controlled nothing comes through it
        value[0, 1 + i] = value[0, NONE]
        value[0, 1 + i, :, i] = 0.0
    energies = Energies(np.array([True]), value, np.zeros((1, 5, 1, 1)), np.ones((1, 3)))
    assert coupling_ratio(energies)[0] == pytest.approx(0.5)
    assert after_plucks(energies)[0] == pytest.approx(1 - np.sqrt(1.25 / 1.5))
    assert law(0.5) == pytest.approx(1 - 1 / np.sqrt(1.25))
    assert law(ratio_of(0.1)) == pytest.approx(0.1)


def test_threshold_of_a_known_cloud():
    """Reductions ratio +- 0.05, uniform: quantiles at 0.1 are crossed where ratio is 0.1 -+."""
    rng = np.random.default_rng(3)
    ratio = rng.uniform(0, 0.3, 4096)
    found = threshold(ratio, ratio + rng.uniform(-0.05, 0.05, ratio.size), 0.1)
    assert found.low == pytest.approx(0.055, abs=0.01)
    assert found.middle == pytest.approx(0.1, abs=0.01)
    assert found.high == pytest.approx(0.145, abs=0.01)
    assert 0 < found.error < 0.01
    never = threshold(ratio, 0 * ratio, 0.1)
    assert np.isnan([never.low, never.middle, never.high]).all()


def test_the_low_end_of_a_threshold_is_where_it_is_first_passed():
    """A hump of high reductions at small ratios: no machines below the low end pass the level."""
    ratio = np.linspace(0, 1, 4096)
    reduction = np.where((ratio > 0.2) & (ratio < 0.4), 0.15, 0.05)
    reduction = np.where(ratio > 0.7, 0.2, reduction)
    found = threshold(ratio, reduction, 0.1)
    assert found.low == pytest.approx(0.2, abs=0.03)
    assert found.middle == pytest.approx(0.7, abs=0.03)


def test_greatest_damping_of_a_known_function():
    factor = np.array([1.0, 4.0, 1e-6, 1e6, np.nan])
    found = greatest_damping(lambda zeta: 1e-3 * factor / zeta, 0.1, len(factor))
    np.testing.assert_allclose(found[:2], [0.01, 0.04], rtol=0.01)
    assert found[2] == 0 and found[3] == DAMPING[1] and np.isnan(found[4])


def test_a_claim_without_exceptions_holds_or_fails(coupled):
    """The outcome follows the numbers: no machine calmed, or all of them."""
    kinds = {}
    for name, study in baselines().items():
        kinds[name] = kind_of(study, 0.0)
    assert judge(kinds)[1].outcome == HOLDS and judge(kinds)[3].outcome == FAILS
    for name, study in baselines().items():
        kinds[name] = kind_of(study, 0.5)
    assert judge(kinds)[1].outcome == FAILS and judge(kinds)[3].outcome == HOLDS


def kind_of(study, reduction):
    """A kind of which all machines have one reduction."""
    ones = np.ones(4)
    base = Baseline(
        ratio=ones,
        others=reduction * ones,
        itself=ones,
        every=ones,
        platform=0.1 * np.ones((4, 2)),
        converged=np.ones((1, 2)),
    )
    found = dict.fromkeys(DEFINITIONS, reduction * ones)
    sampled = Sampled(machines=None, row=None, ratio=ones, reduction=found, thresholds={})
    return Kind(study=study, baseline=base, sampled=sampled, strong=None, best=None, confirmed=[])


def test_damping_falls_below_a_limit_between_two_mass_ratios():
    """Straight in logarithms."""
    ratio, greatest = np.array([0.1, 1.0, 10.0]), np.array([0.8, 0.4, 0.1])
    assert _falls_below(ratio, greatest, 0.2) == pytest.approx(10**0.5)
    assert _falls_below(ratio, greatest, 0.05) == 10.0 and _falls_below(ratio, greatest, 0.9) == 0.0
