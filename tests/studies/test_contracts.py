"""Contracts: what is in the tables works everywhere, and so does what users add to them."""

from __future__ import annotations

import os
import re
import shutil
import tomllib
from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law, acting_channels, modal_feedback
from jaxmodel.metrics import METRICS, Metric, Total
from jaxmodel.table import Parameter, PartError, Table, is_real
from studies import config, sources
from studies.cli import main
from studies.cluster.runner import run_chunk
from studies.engine.columns import PER_CASE
from studies.engine.design import Design
from studies.engine.executor import Executor
from studies.engine.folder import DECISIVE
from studies.engine.margins import judge_loops
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.results import read_sweep
from studies.engine.runs import run_study
from studies.errors import StudyError
from studies.export.request import ExportResult
from studies.export.run import export_design
from studies.export.targets import TARGETS, Target
from studies.extensions import VARIABLE, extend
from studies.laws.tuning import descend
from studies.screen.workers import run_shard
from studies.space.methods import METHODS
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.store import read_store
from studies.study.cases import build_case, build_structure
from studies.study.labels import RESERVED
from studies.study.template import study_template
from studies.tuning.spec import parse_tuning
from studies.tuning.workers import evaluate_part
from tests import TOP
from tests.bare import parse_study
from tests.canonical import MACHINE, study_of, text_of

DOCS = TOP / "docs" / "how-to" / "own-parts.md"
SMALL = text_of(MACHINE)
small = partial(study_of, MACHINE, control__modes=2)
OWN = SMALL + (
    '[control]\nlaw = "even_damping"\nmodes = 2\ngain_factor = 0.5\nlinks = [true, false, false]\n'
    '[drive]\nkind = "stiffening"\n'
)
SWEEP = (
    OWN
    + """
[sweep]
method = "diagonal"
count = 6
metrics = ["turning", "residual_rms"]
[sweep.axes]
"control.laws.even_damping.constant" = { from = 0.2, to = 2.0 }
move_time = { from = 0.025, to = 0.03 }
"""
)
TUNE = (
    OWN
    + """
[tune]
objective = { residual_rms = 1.0, turning = 0.1 }
iterations = 2
starts = 1
free = { "control.laws.even_damping.constant" = { from = 0.2, to = 4.0 } }
"""
)


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """The tables with the parts of the docs in them."""
    blocks = re.findall("```python\n(.*?)```", DOCS.read_text(), re.DOTALL)
    yield from taken_in(tmp_path_factory.mktemp("own") / "own_parts.py", "\n".join(blocks))


def taken_in(file, text):
    """A file of parts while its tables hold them; afterwards they are as before."""
    file.write_text(text)
    tables = (LAWS, DRIVES, METRICS, METHODS, TARGETS)
    before = [dict(table._entries) for table in tables]
    extend(file)
    extend(file)  # again: nothing happens
    yield file
    for table, entries in zip(tables, before, strict=True):
        table._entries = entries
    sources.OUTSIDE.remove(file)
    os.environ.pop(VARIABLE, None)
    jax.clear_caches()


def written(tmp_path, text):
    path = tmp_path / "file.toml"
    path.write_text(text)
    return str(path)


def run(capsys, own, *arguments):
    main(["--with", str(own), *map(str, arguments)])
    return capsys.readouterr().out


#: Settings with which every law that comes with the package has a stable loop on this move.
GAINS = {"srf": {"velocity_gain": (2e-4,) * 3}, "ppf": {"gain_factor": 0.2}}


#: That need no file; for the other see test_state_space.py.
ALONE = [name for name in LAWS if name != "state_space"]


def settled(name):
    return small(
        control__law=name, **{f"control__{key}": x for key, x in GAINS.get(name, {}).items()}
    )


@pytest.mark.long  # in short: the laws in tests/jaxmodel, and a user's own below
@pytest.mark.parametrize("name", ALONE)
def test_every_law_runs_and_is_judged(name):
    """By name alone: single run, judgement of batches."""
    study = settled(name)
    found = run_study(study, has_record=False)
    assert found.loop.is_stable
    assert found.loop.damping_ratio[0].max() > 1.2 * study.link.first_damping
    cases = jax.tree.map(lambda x: np.asarray(x)[None], build_case(study))
    batch = judge_loops(build_structure(study), cases)
    np.testing.assert_allclose(batch.gain_margin[0], found.loop.gain_margin, rtol=0.02)


@pytest.mark.parametrize(  # of the others, the tests of exports have some
    "name", [x if x == "modified_imsc" else pytest.param(x, marks=pytest.mark.long) for x in ALONE]
)
def test_every_law_is_exported(name, tmp_path, capsys):
    """Code in fixed point, proved bit by bit."""
    target = "c-fixed" if shutil.which("cc") else "json"
    path = written(tmp_path, study_template(settled(name)))
    main(["export", path, "--target", target, "--out", str(tmp_path / "out")])
    assert "verified: " in capsys.readouterr().out


@pytest.mark.long
def test_laws_are_a_choice_like_any_other(tmp_path):
    """All of them in one sweep, each with its own margin; the short one sweeps a user's law."""
    text = SMALL + '[sweep]\n[sweep.axes]\n"control.law" = "all"\ngain = [1.0]\n'
    main(["sweep", written(tmp_path, text), "--out", str(tmp_path / "sweep"), "--no-progress"])
    data = read_sweep(tmp_path / "sweep")
    assert list(data["control.law"]) == ALONE
    margin = dict(zip(ALONE, data["gain_margin"], strict=True))
    assert margin["imsc"] == pytest.approx(margin["modified_imsc"], rel=1e-3)
    assert len({round(float(x), 3) for x in margin.values()}) == len(ALONE) - 1


def test_own_law_drive_and_metric_in_single_runs(own):
    """The drive is stiffer than PD where its errors are large, 0.1 mm."""
    study = parse_study(tomllib.loads(OWN))

    def found(**changes):
        one = study.change(**changes)
        return run_study(one, has_record=False, has_loop=False).result.metrics

    weak = found()
    strong = found(control__laws={"even_damping": {"constant": (3.0, 3.0, 3.0)}})
    linear = found(drive__kinds={"stiffening": {"cubic": 0.0}})
    assert 0 < float(weak.turning) != float(strong.turning)
    assert weak.pose_error_peak[1] < 0.99 * linear.pose_error_peak[1]


def test_own_parts_in_a_sweep(own, tmp_path, capsys):
    said = run(capsys, own, "sweep", written(tmp_path, SWEEP), "--out", tmp_path / "sweep")
    assert "traced kernel" in said
    data = read_sweep(tmp_path / "sweep")
    constant = data["control.laws.even_damping.constant"]
    share = (np.arange(6) + 0.5) / 6
    np.testing.assert_allclose(constant, 0.2 + 1.8 * share)
    np.testing.assert_allclose(data["motion.move_time"], 0.025 + 0.005 * share)
    assert np.all(data["turning"] > 0) and data.variables["turning"].units == "rad s"
    assert np.all(np.diff(data["damping_ratio"][:, 0]) > 0)
    check_scan(data)
    assert "even_damping" in run(capsys, own, "show", tmp_path / "sweep")
    text = run(capsys, own, "best", tmp_path / "sweep", "--by", "turning")
    assert "turning [rad s]" in text


def check_scan(data):
    """XLA's scan equals the kernel of the sweep within 1e-9."""
    table = build_table(parse_sweep(tomllib.loads(SWEEP)))
    group = plan_groups(table, np.arange(len(table)), local_layout)[0]
    structure = group.structure._replace(metrics=("turning", "residual_rms"))
    cases = chunk_cases(table, group.rows, structure, group.layout.size)
    found = Executor(structure, group.layout, kind="scan").start(cases).wait().metrics
    for name in ("turning", "residual_rms"):
        np.testing.assert_allclose(found[name][:6], data[name], rtol=1e-9)


@pytest.mark.long  # in short: its parameter varies in a sweep, traced as in a tuning
def test_own_law_is_tuned_by_gradient(own, tmp_path, capsys):
    run(capsys, own, "tune", written(tmp_path, TUNE), "--out", tmp_path / "tuned", "--no-progress")
    arrays, _ = read_store(tmp_path / "tuned" / "tune.h5")
    objective = arrays["fresh_objective"].data
    assert np.all(np.isfinite(objective))
    study = tomllib.loads((tmp_path / "tuned" / "tuned.toml").read_text())
    assert study["control"]["laws"]["even_damping"]["constant"] != 1.0


def test_own_parameters_can_be_tuned(own):
    (free,) = parse_tuning(tomllib.loads(TUNE)).free.names
    assert free == "control.laws.even_damping.constant"


def test_own_target_is_written(own, tmp_path, capsys):
    run(capsys, own, "export", written(tmp_path, OWN), "--target", "csv", "--out", tmp_path / "out")
    rows = (tmp_path / "out" / "flexlink.csv").read_text().splitlines()
    assert len(rows) == 2 and rows[0].startswith("link 1, mode 1,")


@pytest.mark.long  # in short: the target of a user's own, and laws of the package in fixed point
def test_own_law_becomes_c(own, tmp_path, capsys):
    text = run(
        capsys, own, "export", written(tmp_path, OWN), "--target", "c", "--out", tmp_path / "c"
    )
    assert "verified" in text or shutil.which("cc") is None


def test_what_is_taken_or_empty_is_refused(tmp_path):
    with pytest.raises(StudyError, match="metric 'residual_rms': this name is taken"):
        extend(metrics=[METRICS["residual_rms"]._replace(text="another")])
    refused = (
        ("", "none of the lists laws"),
        ("1/0", "ZeroDivisionError"),
        ("raise SystemExit(3)", "SystemExit: 3"),
        ("laws = 5", "laws = 5; expected a list"),
        ("methods = ['sobol']", "method 'sobol': expected a Method"),
    )
    for k, (text, message) in enumerate(refused):
        path = tmp_path / f"part{k}.py"
        path.write_text(text)
        with pytest.raises(StudyError, match=message):
            extend(path)
    with pytest.raises(StudyError, match="no such file"):
        extend(tmp_path / "none.py")


@pytest.mark.parametrize("name", ["a b", "items", "_a", ""])
def test_names_that_are_none_are_refused(name):
    table: Table[Metric] = Table("metric", METRICS.values())
    with pytest.raises(ValueError, match="letters, digits"):
        table.add(METRICS["residual_rms"]._replace(name=name))


def stiff(structure, case, nominal):
    """Positions alone."""
    position = 20.0 * nominal.modal_mass * nominal.omega * acting_channels(case, nominal)
    return modal_feedback(case, nominal, 0 * nominal.omega, position)


@pytest.mark.long  # in short: margins of position feedback, in test_margins
def test_position_gains_of_an_own_law_are_fed_back(monkeypatch):
    monkeypatch.setitem(LAWS._entries, "stiff", Law("stiff", "stiff", "mode", stiff))
    study = small(control__law="stiff")
    found = run_study(study, has_record=False).result.metrics
    none = run_study(study.change(control__gain_factor=0.0), has_record=False).result.metrics
    assert np.max(found.peak_voltage) > 0.1 and np.max(none.peak_voltage) == 0


BETWEEN = Parameter("share", 0.5, "1", "share", 0.0, 1.0)
BEYOND = BETWEEN._replace(default=2.0)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"laws": [LAWS["imsc"]._replace(name="x", channel="wheel")]}, "channel = 'wheel'"),
        ({"laws": [LAWS["imsc"]._replace(name="x", design="imsc")]}, "design = 'imsc'"),
        (
            {"laws": [LAWS["imsc"]._replace(name="x", parameters="a")]},
            "expected a tuple of Parameter",
        ),
        (
            {"laws": [LAWS["imsc"]._replace(name="x", parameters=(BETWEEN, BETWEEN))]},
            "parameter 'share'; expected a unique name",
        ),
        (
            {"laws": [LAWS["imsc"]._replace(name="x", parameters=(BEYOND,))]},
            "'share': default 2; allowed: 0 to 1",
        ),
        ({"metrics": [METRICS["residual_rms"]._replace(name="x", dims=("leg",))]}, "axis 'leg'"),
        *(
            ({"metrics": [METRICS["residual_rms"]._replace(name=name)]}, f"metric '{name}': files")
            for name in ("status", "gain_margin", "case_id", "link_subsets")
        ),
    ],
)
def test_parts_that_do_not_keep_their_contract_are_refused(part, message):
    with pytest.raises(StudyError, match=re.escape(message)):
        extend(**part)
    assert "x" not in LAWS and "x" not in METRICS


@pytest.mark.parametrize(
    ("force", "message"),
    [
        (None, "drive 'bad': force returns None; expected real numbers of shape (3,)"),
        ("x", "drive 'bad': force returns 'x'"),
        (np.zeros(5), "expected real numbers of shape (3,)"),
        (np.full(3, np.nan), "drive.kind = 'bad'; allowed: a drive whose force has finite slopes"),
    ],
)
def test_drives_give_forces(monkeypatch, force, message):
    def answer(drive, memory, error, is_smooth):
        return force * error.position if np.shape(force) == (3,) else force

    monkeypatch.setitem(DRIVES._entries, "bad", DriveLaw("bad", "bad", answer))
    study = small(drive__kind="bad")
    with pytest.raises((StudyError, PartError), match=re.escape(message)):
        run_study(study, has_record=False)


def test_totals_are_numbers(monkeypatch):
    text = Total("text", (), lambda totals, at: "x")
    bad = Metric("bad", (), "m", "bad", (text,), lambda totals, ending: totals["text"])
    monkeypatch.setitem(METRICS._entries, "bad", bad)
    with pytest.raises(PartError, match="total 'text': 'x' after a sample; expected numbers"):
        run_study(small(), has_record=False)


@pytest.mark.parametrize("result", [None, ExportResult(None, None, None)])
def test_targets_give_texts(monkeypatch, tmp_path, result):
    monkeypatch.setitem(TARGETS._entries, "bad", Target("bad", "bad", lambda job: result))
    with pytest.raises(StudyError, match="--target bad: it returns .*; expected an ExportResult"):
        export_design(Design(small(), {}), "bad", tmp_path / "out")


@pytest.mark.parametrize("value", [None, "a", 1j, np.array(["a"]), np.ones(2) * 1j])
def test_metrics_are_real_numbers(value):
    assert not is_real(value) and is_real(1) and is_real(0.5) and is_real(np.ones(2))


def test_names_of_files_are_reserved():
    assert set(PER_CASE) <= set(RESERVED) and not set(RESERVED) & set(METRICS)


WRONG = """
import jax.numpy as jnp
import numpy as np
from jaxmodel.laws.contract import Law, modal_feedback
from jaxmodel.metrics import Metric, Total
from studies.export.request import ExportResult
from studies.export.targets import Target
from studies.space.methods import Method

def wide(structure, case, nominal):
    return modal_feedback(case, nominal, jnp.ones((3, 7)), jnp.ones((3, 7)))

def asks(structure, case, nominal):
    if case.control.gain_factor > 0.1:
        raise RuntimeError

def turns(structure, case, nominal):
    one = jnp.ones((3, structure.n_controlled))
    return modal_feedback(case, nominal, 1j * one, one)

laws = [Law(f.__name__, f.__name__, "mode", f) for f in (wide, asks, turns)]
total = Total("pose_sum", (), lambda totals, at: at.sample.pose_error)
metrics = [Metric("drift", (), "m", "drift", (total,), lambda totals, ending: totals["pose_sum"])]
methods = [
    Method("nowhere", "nowhere", ("count",), lambda asked: np.full((2, asked.dimensions), np.nan)),
    Method("none", "none", ("count",), lambda asked: np.zeros((0, asked.dimensions))),
]

def up(job):
    return ExportResult({"../up.txt": ""}, None, None)

targets = [Target("up", "up", up)]
"""


@pytest.fixture(scope="module")
def wrong(tmp_path_factory):
    """A file of parts that load, and fail."""
    yield from taken_in(tmp_path_factory.mktemp("wrong") / "wrong_parts.py", WRONG)


POSE_SUM = "total 'pose_sum': shape (3,) after a sample, () before"


@pytest.mark.parametrize(
    ("changes", "command", "message"),
    [
        (
            {"control__law": "wide"},
            "simulate",
            "velocity_gain has shape (3, 7); expected (3, 2)",
        ),
        (
            {"control__law": "asks"},
            "simulate",
            "wrong_parts.py, line 14: TracerBool",
        ),
        ({"control__law": "turns"}, "simulate", "velocity_gain is complex; expected real numbers"),
        ({}, "simulate", POSE_SUM),
        pytest.param({}, "sweep", POSE_SUM, marks=pytest.mark.long),
        ({"sweep": "nowhere"}, "sweep", "sweep.method = 'nowhere': gives float64 of shape (2, 1)"),
        ({"sweep": "none"}, "sweep", "sweep.method = 'none': gives float64 of shape (0, 1)"),
        ({}, "export --target up", "it makes '../up.txt'; expected a plain file name"),
    ],
)
def test_own_parts_that_fail_are_named(wrong, changes, command, message, tmp_path, capsys):
    """In one line, and without a file."""
    method = changes.pop("sweep", "sobol")
    study = small(**changes)
    text = study_template(study)
    if command == "sweep":
        text += (
            f'[sweep]\nmethod = "{method}"\ncount = 2\nmetrics = ["drift"]\n'
            "[sweep.axes]\ngain = { from = 0.1, to = 0.2 }\n"
        )
    name, *options = command.split()
    out = tmp_path / ("run.h5" if name == "simulate" else "out")
    with pytest.raises(SystemExit) as stopped:
        run(capsys, wrong, name, written(tmp_path, text), *options, "--out", out)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and message in error and error.count("\n") == 1
    assert not list(tmp_path.glob("*.txt")) and not (out.is_dir() and list(out.glob("*.txt")))


def test_every_source_of_a_number_is_in_the_digest(tmp_path):
    """A copy with one file changed has another digest; a report's text does not matter."""
    for package in sources.PACKAGES:
        shutil.copytree(
            sources.TOP / package, tmp_path / package, ignore=shutil.ignore_patterns("__pycache__")
        )
    sweeps = DECISIVE
    workers = tuple(one.__module__ for one in (run_chunk, run_shard, evaluate_part, descend))
    before = {roots: sources.digest(*roots, top=tmp_path) for roots in (sweeps, workers)}
    for name, roots in (
        ("jaxmodel/laws/ppf.py", sweeps),
        ("jaxmodel/laws/__init__.py", sweeps),
        ("studies/engine/preflight.py", sweeps),
        ("studies/engine/fidelity.py", sweeps),
        ("studies/study/consistency.py", sweeps),
        ("studies/kernels/derivatives.py", sweeps),
        ("studies/engine/function.py", workers),
        ("studies/tuning/objective.py", workers),
    ):
        path = tmp_path / name
        text = path.read_bytes()
        path.write_bytes(text + b"\n# changed\n")
        assert sources.digest(*roots, top=tmp_path) != before[roots], name
        path.write_bytes(text)
    report = tmp_path / "studies" / "sweeps" / "say.py"
    report.write_bytes(report.read_bytes() + b"\n")
    assert all(sources.digest(*roots, top=tmp_path) == x for roots, x in before.items())


def test_modules_that_a_file_of_parts_imports_count_as_its_code(tmp_path, monkeypatch):
    (tmp_path / "helper_of_parts.py").write_text("SCALE = 1.0\n")
    (tmp_path / "parts_with_helper.py").write_text("import helper_of_parts\n\nlaws = []\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sources, "OUTSIDE", [])
    monkeypatch.setenv(VARIABLE, "")
    monkeypatch.setattr(config, "_keeps_programs", True)
    extend(tmp_path / "parts_with_helper.py")
    names = [path.name for path in sources.OUTSIDE]
    assert names == ["parts_with_helper.py", "helper_of_parts.py"]
    assert not config.is_keeping()
    before = sources.digest("jaxmodel")
    (tmp_path / "helper_of_parts.py").write_text("SCALE = 0.0\n")
    assert sources.digest("jaxmodel") != before
