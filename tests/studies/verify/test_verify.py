"""`studies verify`: its table, and that it can fail: deliberate faults in a copy of the code."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import NamedTuple
from unittest import mock

import jsonschema
import numpy as np
import pytest
from rich.console import Console

from jaxmodel.shaper import SHAPERS, Impulses
from studies import passport
from studies.documents import schema
from studies.reference import tables
from studies.show.report import print_report
from studies.study import spec
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import load_study
from studies.verify import links, loops, machine, outside, run, stepping, trajectories
from studies.verify.prepared import prepared
from studies.verify.rows import Assumption, largest, worst, worst_relative
from studies.verify.verb import verify
from tests import TOP
from tests.bare import paper_study, parse_study
from tests.canonical import TINY, study_of, with_sections
from tests.machines import random_machine
from tests.studies.test_cli import run as call


class Fault(NamedTuple):
    """A change of one line, and the group of checks that must notice it."""

    file: str
    right: str
    wrong: str
    group: str
    is_bare: bool = True  # on links as the paper has them; otherwise on the default ones


FAULTS = {
    "sign of a Coriolis term": Fault(
        "jaxmodel/dynamics.py",
        "load_g=2 * rate * (mass * jnp.sum(q * q_rate, axis=1))",
        "load_g=-2 * rate * (mass * jnp.sum(q * q_rate, axis=1))",
        "mechanics",
    ),
    "centrifugal force doubled": Fault(
        "jaxmodel/dynamics.py",
        "push = piezo + thrown * (chain.beta_rate * chain.beta_rate)[:, None]",
        "push = piezo + 2 * thrown * (chain.beta_rate * chain.beta_rate)[:, None]",
        "mechanics",
    ),
    "no shortening": Fault(
        "jaxmodel/dynamics.py",
        "shorter, rate = jnp.sum(row * q, axis=1) / 2, jnp.sum(row * q_rate, axis=1)",
        "shorter, rate = 0 * jnp.sum(row * q, axis=1), 0 * jnp.sum(row * q_rate, axis=1)",
        "mechanics",
    ),
    "wrong S": Fault(
        "jaxmodel/beam.py",
        "shortening=wave**2 * beam.length / 2,",
        "shortening=wave**2 * beam.length / 4,",
        "links and patches",
    ),
    "coupling b of even modes": Fault(
        "jaxmodel/beam.py",
        "b=line_mass * (1 + sign) / wave,",
        "b=line_mass * (1 - sign) / wave,",
        "links and patches",
    ),
    "distributed inertia": Fault(
        "jaxmodel/dynamics.py",
        "k_gg=link.k_gg - jnp.sum(spread.turning * q, axis=1),",
        "k_gg=link.k_gg + jnp.sum(spread.turning * q, axis=1),",
        "mechanics",
    ),
    "factor 2 in the actuators' constant": Fault(
        "jaxmodel/piezo.py",
        "return actuator_force(patches) * jnp.where(",
        "return 2 * actuator_force(patches) * jnp.where(",
        "links and patches",
    ),
    "free instead of clamped capacitance": Fault(
        "jaxmodel/piezo.py",
        "return permittivity * (1 - coupling) * area / patches.thickness",
        "return permittivity * area / patches.thickness",
        "links and patches",
    ),
    "a patch off by one": Fault(
        "jaxmodel/prepare.py",
        "sensor = lambda_s[:, :, None] * jnp.swapaxes(basis.sensor_slope, 1, 2)",
        "sensor = jnp.roll(lambda_s[:, :, None] * jnp.swapaxes(basis.sensor_slope, 1, 2), 1, 1)",
        "links and patches",
    ),
    "static correction with the wrong sign": Fault(
        "jaxmodel/prepare.py",
        "return lambda_s[:, :, None] * lambda_a[:, None] * static_remainder(basis, mode_mask)[0]",
        "return -lambda_s[:, :, None] * lambda_a[:, None] * static_remainder(basis, mode_mask)[0]",
        "links and patches",
    ),
    "direct terms by patches that are all alike": Fault(
        "jaxmodel/prepare.py",
        "return lambda_s[:, :, None] * lambda_a[:, None] * static_remainder(basis, mode_mask)[0]",
        "return lambda_s[:, :1, None] * lambda_a[:, :1] * static_remainder(basis, mode_mask)[0]",
        "links and patches",
    ),
    "actuators that push along links alike": Fault(
        "jaxmodel/stretch.py",
        "free=driven * free,",
        "free=free,",
        "links and patches",
        is_bare=False,
    ),
    "amplitude of a shaper": Fault(
        "jaxmodel/shaper.py",
        "outer = (1 + tolerance) / 4",
        "outer = (1 - tolerance) / 4",
        "trajectories",
    ),
    "instants of a shaper": Fault(
        "jaxmodel/shaper.py",
        "decay = jnp.pi * zeta / jnp.sqrt(1 - jnp.square(zeta))",
        "decay = jnp.pi * zeta / jnp.sqrt(1 + jnp.square(zeta)) / 2",
        "trajectories",
    ),
    "acceleration of the reference trajectory": Fault(
        "jaxmodel/motion.py",
        "return u - sine / (2 * np.pi), 1 - jnp.cos(angle), 2 * np.pi * sine",
        "return u - sine / (2 * np.pi), 1 - jnp.cos(angle), np.pi * sine",
        "trajectories",
    ),
    "a design for a delay of two samples": Fault(
        "jaxmodel/electronics.py",
        "late = hold * jnp.exp(-1.5j * omega * period)",
        "late = hold * jnp.exp(-2.5j * omega * period)",
        "figures of others",
    ),
    "runs without a delay": Fault(
        "jaxmodel/loop.py",
        "        clipped = jnp.max(jnp.max(info.is_clipped, axis=1), axis=0)\n",
        "        clipped, voltage = jnp.max(info.is_clipped), after.voltage\n",
        "digital loop",
    ),
    "swapped links": Fault(
        "jaxmodel/controller.py",
        "after, demand = controller.feedback.step(state.feedback, measured - own)",
        "after, demand = controller.feedback.step(state.feedback, (measured - own)[::-1])",
        "figures of others",
    ),
    "half the structural damping": Fault(
        "jaxmodel/plant.py",
        "damping=2\n",
        "damping=1\n",
        "mechanics",
    ),
    "a stage of the time step": Fault(
        "jaxmodel/loop.py",
        "c = stage(a, x, slope3, h, 2 * n3 - n1)",
        "c = stage(a, x, slope3, h, 2 * n3 - n2)",
        "time steps",
    ),
    "payload without its offset": Fault(
        "jaxmodel/plant.py",
        "inertia = inertia + payload * jnp.sum(jnp.asarray(offset) ** 2)",
        "inertia = inertia + 0 * payload * jnp.sum(jnp.asarray(offset) ** 2)",
        "mechanics",
    ),
    "operands of a difference in machine code": Fault(
        "studies/kernels/graph.py",
        'self._node("sub", a, b)',
        'self._node("sub", b, a)',
        "time steps",
    ),
    "residual vibration without its root": Fault(
        "jaxmodel/metrics.py",
        "return _root(_average(totals, total, count))",
        "return _average(totals, total, count)",
        "time steps",
    ),
    "stretch read with bending": Fault(
        "jaxmodel/stretch.py",
        "force, volts = actuator_force(patches), -sensor_gain(patches)",
        "force, volts = actuator_force(patches), sensor_gain(patches)",
        "links and patches",
        is_bare=False,
    ),
    "actuators that do not push": Fault(
        "jaxmodel/stretch.py",
        "force * (pieces.has_actuator @ soft)",
        "0 * force * (pieces.has_actuator @ soft)",
        "links and patches",
        is_bare=False,
    ),
    "links as soft as without patches": Fault(
        "jaxmodel/stretch.py",
        "stiffness = stiffness + section * patch_count(patches, pieces)",
        "stiffness = stiffness + 0 * section * patch_count(patches, pieces)",
        "links and patches",
        is_bare=False,
    ),
    "half of a link's mass in its elongation": Fault(
        "jaxmodel/stretch.py",
        "(start**2 + start * end + end**2)) / 3",
        "(start**2 + start * end + end**2)) / 2",
        "links and patches",
        is_bare=False,
    ),
    "no more moment under a sensor": Fault(
        "jaxmodel/piezo.py",
        "return gain * patches.is_force",
        "return 0 * gain * patches.is_force",
        "links and patches",
        is_bare=False,
    ),
    "elongation that pulls the far joint in": Fault(
        "jaxmodel/dynamics.py",
        "return jnp.concatenate([row[:, :-1], -longer], axis=1)",
        "return jnp.concatenate([row[:, :-1], longer], axis=1)",
        "mechanics",
        is_bare=False,
    ),
    "an oscillator solved twice": Fault(
        "jaxmodel/loop.py",
        "more = coupling[:, -1] + square * state.q[:, -1]",
        "more = coupling[:, -1] + 2 * square * state.q[:, -1]",
        "time steps",
        is_bare=False,
    ),
}

_CHECK = """
import json, sys
from studies.config import start
start()
from studies.reference.tables import BARE
from studies.study.spec import parse_study
from studies.verify.run import CHECKS
machine = {
    "load": {"mass": 0.1, "inertia": 1e-4, "offset": [0.02, 0.01]},
    "patches": {"sensor_factor": [0.8, 1.1, 1.0], "actuator_factor": [[0.7, 1.0, 1.2]] * 3},
}
names = [name for name in CHECKS if name.startswith(sys.argv[1])]
changes = BARE if sys.argv[2] == "bare" else {}
rows = [row for name in names for row in CHECKS[name](parse_study(machine).change(**changes))]
print(json.dumps([row.assumption for row in rows if not row.is_passed]))
"""


def failed_rows(folder: Path, group: str, limit: float, is_bare: bool = True) -> list[str]:
    """Assumptions that fail in a group of checks of the code in a folder."""
    done = subprocess.run(
        [sys.executable, "-c", _CHECK, group, "bare" if is_bare else "whole"],
        cwd=folder,
        env={"PYTHONPATH": str(folder), "PATH": "/usr/bin:/bin", "OPENBLAS_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        timeout=limit,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout.splitlines()[-1])


def copied(folder: Path, fault: Fault | None) -> Path:
    for name in ("jaxmodel", "studies"):
        shutil.copytree(TOP / name, folder / name, ignore=shutil.ignore_patterns("__pycache__"))
    if fault is not None:
        path = folder / fault.file
        text = path.read_text()
        assert text.count(fault.right) == 1
        path.write_text(text.replace(fault.right, fault.wrong))
    return folder


@pytest.mark.long  # in short: as if two of them were in the code
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_makes_a_row_fail(name, tmp_path):
    fault = FAULTS[name]
    failed = failed_rows(copied(tmp_path, fault), fault.group, 400, fault.is_bare)
    assert failed


@pytest.mark.long
@pytest.mark.parametrize("is_bare", [True, False])
def test_the_copy_without_a_fault_passes(is_bare, tmp_path):
    assert failed_rows(copied(tmp_path, None), "", 600, is_bare) == []


REST = {"motion": {"waypoints": [[0.0, 0.0, 0.52]]}}


@pytest.mark.parametrize("points", [1, 2])
def test_steps_of_a_machine_at_rest(points):
    motion = {"waypoints": REST["motion"]["waypoints"] * points}
    error, order = stepping._steps(parse_study(with_sections(TINY, motion=motion)))
    assert error.outcome == "passed" and 0 < error.difference < 1e-6
    assert order.left_out == "the step is exact to rounding"


def test_steps_say_why_their_order_is_left_out():
    def known(structure, n_samples, case, parts, *others):
        return stepping.Stepped(np.full((n_samples, 3, 3), 1 + parts**-4.0), None)

    with mock.patch.object(stepping, "_step", known):
        study = study_of(TINY)
        _, order = stepping._steps(study)
        assert order.outcome == "passed" and order.note == "order 4.00"
        for changes, word in (
            ({"load__wrench": (1.0, 0.0, 0.0)}, "load.wrench"),
            ({"drive__coulomb_friction": 1.0}, "friction"),
        ):
            assert stepping._steps(study.change(**changes))[1].left_out.startswith(word)


@pytest.mark.long  # in short: kernels are the scan, in test_delay
@pytest.mark.parametrize("points", [1, 2])
def test_machine_code_at_rest(points):
    motion = {"waypoints": REST["motion"]["waypoints"] * points}
    row = stepping._kernel(parse_study(with_sections(TINY, motion=motion)))
    assert row.outcome == "passed" and row.allowed == 1e-8


def test_an_unstable_loop_has_no_linear_run():
    """Its run is not looked at; a stable one passes, in test_drives."""

    def made_up(study, **_):
        result = SimpleNamespace(record=())
        return SimpleNamespace(
            structure=build_structure(study), case=as_arrays(build_case(study)), result=result
        )

    with mock.patch.object(loops, "run_study", made_up):
        row = loops._release(study_of(TINY, control__gain_factor=1e3))
    assert "unstable" in row.left_out


@pytest.mark.parametrize(
    ("kind", "hertz"), [("zv", [458.0]), ("ei3", [1030.0]), ("zv", [90, 1030])]
)
def test_shapers_of_fast_modes(kind, hertz):
    shaper = {"kind": kind, "frequencies_hz": list(map(float, hertz))}
    study = parse_study(with_sections(TINY, shaper=shaper, run={"duration": 0.05}))
    _, case, found = prepared(study)
    assert trajectories._taps(study, case, found.taps).outcome == "passed"
    detuned = study.change(shaper__frequencies_hz=[2 * x for x in hertz])
    assert trajectories._taps(detuned, case, found.taps).outcome == "FAILED"


@pytest.mark.parametrize("command", ["'", "/bin/false", "no_such_compiler"])
def test_a_bad_compiler_costs_one_row(command, monkeypatch):
    monkeypatch.setenv("CC", command)
    row = loops._exported(study_of(TINY))
    assert row.assumption == "exported C controller"
    assert row.outcome == ("FAILED" if command == "/bin/false" else "left out")


CHEAP = ("links and patches", "trajectories and shapers", "mechanics")


def drawn(seed):
    """A random machine, its links bare or with patches as they are, which lengthen them."""
    shaper = {"kind": "ei_damped", "frequencies_hz": [100.0, 410.0], "split": "exact"}
    link = {"basis": ("pinned_pinned", "loaded")[seed % 2], "stretch": bool(seed % 2)}
    return random_machine(seed, link=link, shaper=shaper)


# in short: the other basis in the next test, but for the mechanics
@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.long)])
def test_random_machines_pass(seed):
    study = drawn(seed)
    rows = [row for name in CHEAP for row in run.CHECKS[name](study)]
    assert len(rows) == 13 and all(row.is_passed for row in rows), rows
    assert [row.left_out for row in rows if row.left_out] == ["link.stretch is off"] * (seed == 2)


def test_a_fault_fails_its_row():
    """Half the shortening, and another amplitude of a shaper, as if in the code."""
    shapes, shapers, ei = links._shapes, trajectories._shapers, list(SHAPERS).index("ei")

    def short(*arguments):
        basis, *others = shapes(*arguments)
        return basis._replace(shortening=basis.shortening / 2), *others

    def weak(*arguments):
        amplitude, time = map(np.array, shapers(*arguments))
        amplitude[ei, [0, 2]] -= 0.025
        return Impulses(amplitude, time)

    study = drawn(2)
    with (
        mock.patch.object(links, "_shapes", short),
        mock.patch.object(trajectories, "_shapers", weak),
    ):
        rows = [row for name in CHEAP[:2] for row in run.CHECKS[name](study)]
    assert [row.assumption.split(" ")[0] for row in rows if not row.is_passed] == [
        "modal",
        "insensitivity",
    ]


@pytest.mark.parametrize(
    ("check", "count"),
    [
        (lambda _: outside._frequencies(), 3),
        pytest.param(outside.check_outside, 11, marks=pytest.mark.long),
    ],
)
def test_figures_of_others_hold_whatever_the_study(check, count):
    rows = check(None)
    assert len(rows) == count and all(row.is_passed for row in rows), rows


@pytest.mark.long
@pytest.mark.parametrize(
    "sections",
    [
        {"link": {"basis": "pinned_free"}},
        {"link": {"basis": "loaded", "joint_inertia_c": 1.1e-5}, "control": {"law": "lqg"}},
        {"control": {"feedback": "ideal"}, "run": {"duration": 0.7}},
        {"drive": {"coulomb_friction": 1.0}, "control": {"law": "ppf"}},
        REST | {"drive": {"locked": True}, "initial": {"modal": [[1e-4], [], []]}},
    ],
    ids=["pinned_free", "loaded", "ideal", "friction", "locked"],
)
def test_other_studies_pass(sections):
    found = verify(parse_study(sections), progress=False)
    assert found.is_good, [row for row in found.rows if not row.is_passed]


# --- table, documents, exit code ------------------------------------------------------------------


def row(difference, allowed=1e-3, **more):
    return Assumption(
        assumption="x", against="y", source="Z 1990", difference=difference, allowed=allowed, **more
    )


def test_what_passes():
    assert row(1e-4).is_passed and row(1e-3).is_passed and not row(2e-3).is_passed
    assert not row(np.nan).is_passed and not row(np.inf).is_passed
    assert row(np.nan, left_out="nothing there").outcome == "left out"
    assert [row(0.0).outcome, row(1.0).outcome] == ["passed", "FAILED"]
    assert largest([1.0, 2.0], [1.0, 4.0]) == 0.5 and worst_relative([1.0, 2.0], [1.0, 4.0]) == 0.5
    assert largest([np.nan], [1.0]) == np.inf and worst_relative([np.nan], [1.0]) == np.inf
    assert largest([1e-3], [0.0]) == 1e-3
    # the built-in max passes over a NaN that is not first
    assert worst(0.0, np.nan) == worst(np.nan, 0.0) == worst([0.0, np.nan]) == np.inf
    assert worst(0.5, [0.1, 2.0]) == 2.0


def test_what_is_left_out_is_no_part_of_the_outcome():
    rows = row(1e-4), row(2e-3), row(0.0, left_out="nothing there")
    summary = run.ModelVerification(paper_study(), rows).summary
    assert (summary.rows, summary.passed, summary.failed) == (2, 1, ("x",))


def test_patches_that_see_or_do_too_much_are_noticed():
    """A link's sensors 1 % above, or actuators 2 % above, constants times slopes."""
    bends = np.array([[0.5, 2.0], [1.0, -3.0]]), np.array([[1.0, 0.5], [2.0, 4.0]])  # (K, R)
    basis = SimpleNamespace(mass=np.array([[0.5, 0.25]]))
    constants = np.full(2, 2.0), np.full(2, 3.0)  # of each patch
    sees, does = 3.0 * bends[0], 2.0 * bends[1].T / basis.mass.T
    for more, wanted in (((1.0, 1.0), 0.0), ((1.01, 1.0), 0.01 / 1.0), ((1.0, 1.02), 0.02)):
        loop = SimpleNamespace(sensor=[more[0] * sees], actuator=[more[1] * does])
        found = links._signals(loop, 0, constants, bends, basis, 0.0)
        np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-15)


def test_exported_code_that_differs_fails():
    checks = [SimpleNamespace(is_met=x, what=f"run {x}", found="1e-3") for x in (True, False)]
    with (
        mock.patch.object(loops, "find_compiler", lambda: "cc"),
        mock.patch.object(loops, "reference_run", lambda _: None),
        mock.patch.object(loops, "verify_floating", lambda *_: SimpleNamespace(checks=checks)),
    ):
        failed = loops._exported(study_of(TINY))
        checks.pop()
        passed = loops._exported(study_of(TINY))
    assert (failed.outcome, failed.note) == ("FAILED", "run False: 1e-3")
    assert (passed.outcome, passed.note) == ("passed", "")


def test_accelerations_of_the_modes_are_compared_like_those_of_the_pose(monkeypatch):
    """Of made-up accelerations of a pose of three and two modes: those of the modes are wrong."""
    found, wanted = np.ones((4, 5)), np.ones((4, 5))
    wanted[2, 4] = 1.25
    for name, result in (
        ("_plant", ({}, None)),
        ("_random_states", None),
        ("_both", (found, wanted, np.zeros(4))),
    ):
        monkeypatch.setattr(machine, name, lambda *_, result=result: result)
    structure = SimpleNamespace(
        has_shortening=True, basis="pinned_free", n_pose=3, n_modes=2, is_coupled=True
    )
    case = SimpleNamespace(machine=SimpleNamespace(beam=SimpleNamespace(length=0.2)))
    whole = SimpleNamespace(_replace=lambda **_: None)
    accelerations, closure = machine._accelerations(paper_study(), structure, case, whole)
    assert accelerations.difference == pytest.approx(0.2) and closure.is_passed


def test_residual_vibration_is_off_by_a_share_of_its_rms(monkeypatch):
    """Of a made-up run that bends 2 % too far after the moves."""
    time = np.arange(0.0, 0.3, 1e-3)
    bent = 1e-4 * np.cos(300 * time)[:, None] * np.ones(3)
    given = tables.FastMove(time, bent, np.zeros((300, 3)))
    bends = np.zeros((3000, 3, 1))
    bends[::10, :, 0] = np.where(time >= 0.2, 1.02, 1.0)[:, None] * bent
    record = SimpleNamespace(chord_deflection_stations=bends, pose=np.zeros((3000, 3)))
    monkeypatch.setattr(outside.tables, "fast_move", lambda: given)
    monkeypatch.setattr(outside, "_record", lambda _: record)
    rows = {row.assumption: row for row in outside._fast_move()}
    after = rows["residual vibration after fast moves"]
    assert after.difference == pytest.approx(0.02) and not after.is_passed
    assert rows["platform in fast moves, on its drive"].is_passed


@pytest.fixture
def checks(monkeypatch, tmp_path):
    """Checks of the command: what is put into the dictionary, instead of all."""
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    chosen = {"one": lambda _: [row(1e-4), row(0.0, left_out="nothing there")]}
    monkeypatch.setattr(run, "CHECKS", chosen)
    monkeypatch.setattr(run, "PHASES", {"one": 1.0, "two": 1.0})
    return chosen


def test_the_command(checks, capsys, tmp_path):
    code, out, _ = call(capsys, "verify")
    assert code == 0 and "1 of 1 assumptions passed" in out and "left out: x: nothing there" in out
    found = passport.find(spec.paper_study())
    assert found is not None and (found.passed, found.rows, found.failed) == (1, 1, ())

    (tmp_path / "heavy.toml").write_text("[machine]\nplatform_mass = 0.5\n")
    heavy = load_study(tmp_path / "heavy.toml")
    assert passport.find(heavy) is None
    checks["two"] = lambda _: [row(1.0, note="off")]
    code, out, _ = call(capsys, "verify", tmp_path / "heavy.toml", "--json")
    document = json.loads(out)
    jsonschema.validate(document, schema("verify"))
    assert (
        code == 1 and document["summary"]["failed"] == ["x"] and document["summary"]["passed"] == 1
    )
    assert "failed: x" in passport.find(heavy).text
    assert passport.find(spec.paper_study()).failed == ()
    # whatever its title
    assert passport.find(heavy.model_copy(update={"title": "heavy"})).failed == ("x",)


@pytest.mark.parametrize("width", [60, 80, 120])
def test_the_table_fits_the_terminal(checks, capsys, width):
    word = "pinned_pinned"
    checks["one"] = lambda _: [row(1e-4).replace(assumption=f"links ({word})", against=word)]
    print_report(verify(progress=False).report(), Console(width=width))
    text, table = capsys.readouterr().out.split("┏")
    assert f"({word})" in table and "…" not in table and "1 of 1" in text
    assert max(map(len, table.splitlines())) <= width and "1.0e-04" in table and "1e-03" in table


def test_a_verification_goes_on_where_it_was_interrupted(checks, capsys, tmp_path):
    calls, one = [], checks["one"]
    checks["one"] = lambda study: calls.append("one") or one(study)
    checks["two"] = mock.Mock(side_effect=[KeyboardInterrupt, [row(0.5)], AssertionError])
    arguments = ("verify", "--out", tmp_path / "out")
    code, _, said = call(capsys, *arguments)
    assert (
        code == 130 and f"continue with: studies verify --out {tmp_path / 'out'} --resume" in said
    )
    assert "holds a verification already" in call(capsys, *arguments)[2]
    documents = [call(capsys, *arguments, "--resume", "--json") for _ in range(2)]
    assert [code for code, *_ in documents] == [1, 1] and documents[0] == documents[1]
    assert [x["difference"] for x in json.loads(documents[0][1])["rows"]] == [1e-4, 0.0, 0.5]
    assert calls == ["one"]


def test_a_check_that_cannot_run_fails(checks, capsys):
    def broken(_):
        raise ValueError("no figures")

    checks["two"] = broken
    code, out, _ = call(capsys, "verify")
    assert code == 1 and "FAILED: two: it could not be checked: no figures" in out


def test_a_damaged_outcome_is_none(checks, capsys):
    call(capsys, "verify")
    (file,) = passport.chosen_folder().glob("passport-*")
    endless = '{"title": "", "passed": Infinity}'
    changed = file.read_text().replace('"passed": 1', '"passed": 2')
    for text in (
        changed,
        "",
        "{",
        "[1]",
        '{"title": "", "passed": "many"}',
        endless,
        "[" * 100_000,
    ):
        file.write_text(text)
        assert passport.find(spec.paper_study()) is None
    file.unlink()
    os.mkfifo(file)
    assert passport.find(spec.paper_study()) is None
