"""What a tuning has found stands in its folder at once; no phase runs twice; figures cost none."""

import signal
import subprocess
import sys
import time
import warnings
from types import SimpleNamespace
from unittest import mock

import jax
import numpy as np
import pytest

from studies.engine.design import load_design
from studies.errors import DataWarning, FigureWarning, StudyError
from studies.job import working
from studies.show import figures
from studies.study.files import is_as_written
from studies.study.spec import load_study
from studies.tuning import audit as audit_module
from studies.tuning import plots
from studies.tuning import run as tuning_run
from studies.tuning.audit import Disagreement
from studies.tuning.check import JudgedDesign, OwnRun
from studies.tuning.folder import load_progress
from studies.tuning.loop_figures import DesignFigures
from studies.tuning.references import GainScan, References
from studies.tuning.run import tune_phases, tune_request, tuned_into
from tests.jobs import quiet_job
from tests.studies.tuning.test_tuning import Known
from tests.tunings import EVERY_KIND, GAIN, SMALL, tuning


def known(iterations=4):
    """A tuning of the small machine's gain, by a function in place of its runs."""
    spec = tuning(GAIN, starts=1, iterations=iterations, method="adam")
    evaluator = Known(spec, lambda x: (x[0] - 0.3) ** 2 + 0.1)
    evaluator.lanes = 2
    return spec, evaluator


def judged(gain_margin=2.0):
    runs = {"residual_rms": np.ones(3)}
    own = OwnRun(objective=0.5, metrics={"residual_rms": 0.5}, status=0, watched=0.01)
    figures = DesignFigures(gain_margin, 3.0, 0.1, 0.4)
    codes = np.zeros(3, int)
    return JudgedDesign(np.ones(3), runs, codes, np.ones(3), figures, own, None, {}, {})


FOUND = {
    "check": {
        "baseline": judged(),
        "judged": [judged(3.0), judged()],
        "references": References(None, GainScan(*np.ones((3, 2)), 1), judged(), None),
        "linear": np.ones(2),
        "residual": np.ones(2),
        "run_time": 0.25,
    },
    "compare derivatives": [Disagreement("x", "all", 0, "objective", 1.0, 1.0, 1e-9)],
}


def with_phases(check=None, audit=None, write=None):
    """A run of a tuning whose phases are these functions."""
    return mock.patch.multiple(
        tuning_run,
        _checked=check or (lambda *_: FOUND["check"]),
        audit=audit or (lambda *_: FOUND["compare derivatives"]),
        _write=write or (lambda *_: None),
    )


def tune(out, is_resumed=False):
    spec, evaluator = known()
    with working("tune", out, tune_request(spec), tune_phases(spec), is_resumed, False) as job:
        return tuned_into(spec, job, evaluator=evaluator)


def interrupted(after):
    """Ends the descent like Ctrl-C, so many iterations on."""
    seen, advance = [], tuning_run.optimise

    def optimise(spec, evaluator, at, keep):
        def counted(now):
            keep(now)
            seen.append(now)
            if len(seen) == after:
                raise KeyboardInterrupt

        return advance(spec, evaluator, at, counted)

    return mock.patch.object(tuning_run, "optimise", optimise)


@pytest.mark.parametrize("after", [1, 2, 3])
def test_an_interrupted_descent_leaves_its_best_design(tmp_path, after):
    with with_phases(), interrupted(after), pytest.raises(KeyboardInterrupt):
        tune(tmp_path / "out")
    spec, _ = known()
    at = load_progress(tmp_path / "out" / "progress.npz")
    found = load_design(tmp_path / "out").study
    assert found.control.gain_factor == spec.free.values(at.best_place)[at.winner(0), 0]
    assert "best so far" in found.title
    assert load_study(tmp_path / "out" / "study.toml") == spec.study


def test_phases_that_have_ended_are_not_repeated(tmp_path):
    """Interrupted in the last of them, a tuning goes on there; its findings are the same."""
    out, calls = tmp_path / "out", []

    def check(*_):
        calls.append("check")
        return FOUND["check"]

    def stopped(*_):
        raise KeyboardInterrupt

    with with_phases(check, stopped), pytest.raises(KeyboardInterrupt):
        tune(out)
    with with_phases(check):
        first = tune(out, True)
    with with_phases(stopped, stopped):
        again = tune(out, True)
    assert calls == ["check"]
    for found in (first, again):
        wanted = FOUND["check"] | {"audited": FOUND["compare derivatives"]}
        for name, value in wanted.items():
            jax.tree.map(np.testing.assert_array_equal, getattr(found, name), value)
    assert type(again.judged[0].own_run) is OwnRun
    file = out / "parts" / "check.npz"
    arrays = dict(np.load(file))
    np.savez(file, **arrays | {"x3": arrays["x3"] * 1.5})
    with with_phases(check):
        tune(out, True)
    file.write_bytes(b"damaged")
    with with_phases(check):
        tune(out, True)
    assert calls == ["check"] * 3


def test_parts_of_another_end_are_not_used(tmp_path):
    """A descent that goes on ends elsewhere."""
    with with_phases():
        tune(tmp_path / "out")
    calls, (spec, evaluator) = [], known(5)
    with with_phases(lambda *_: calls.append("check") or FOUND["check"]):
        tuned_into(spec, quiet_job(tmp_path / "out", tune_phases(spec)), evaluator=evaluator)
    assert calls


def test_a_tenth_of_the_evaluations_checks_derivatives():
    names = ["control.gain_factor", "machine.platform_mass", "drive.kp"]
    spec = tuning(
        {name: EVERY_KIND[name] for name in names},
        starts=1,
        families={"all": {}, "gain": {"free": names[:1]}},
    )
    assert audit_module._sampled(spec, 1, None) == {0: [0, 1, 2]}
    assert audit_module._sampled(spec, 1, 30) == {0: [0, 1, 2]}
    few = audit_module._sampled(spec, 1, 18)
    assert len(few[0]) == 2 and set(few[0]) <= {0, 1, 2}
    assert len(audit_module._sampled(spec, 1, 1)[0]) == 1  # never none


def test_an_edited_result_is_not_taken_for_the_tunings(tmp_path):
    """Nor overwritten by a resumed one."""
    with with_phases(), interrupted(2), pytest.raises(KeyboardInterrupt):
        tune(tmp_path / "out")
    file = tmp_path / "out" / "tuned.toml"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_design(tmp_path / "out").study == load_study(file)
    written = file.read_bytes()
    file.write_bytes(written.replace(b"\n", b"\r\n"))  # changes nothing
    assert is_as_written(file)
    edited = written.replace(b"gain_factor = ", b"gain_factor = 0.5  # ")
    file.write_bytes(edited)
    with pytest.warns(DataWarning, match="edited since the command has written it"):
        load_study(file)
    unsigned = edited.partition(b"\n")[2]
    for content in (edited, unsigned, b"hello", b"\xff"):
        file.write_bytes(content)
        with with_phases(), pytest.raises(StudyError, match="--resume would overwrite it"):
            tune(tmp_path / "out", True)
    file.write_bytes(unsigned)
    with pytest.warns(DataWarning, match="without the tuning's signature"):
        load_design(tmp_path / "out")
    file.unlink()
    file.symlink_to("elsewhere.toml")
    with with_phases(), pytest.raises(StudyError, match="--resume would overwrite it"):
        tune(tmp_path / "out", True)


def test_a_figure_that_fails_costs_no_result(tmp_path):
    """The others are there, and the page says what is missing, in the figure's place."""

    def fail():
        raise ValueError("Data cannot be log-scaled")

    with pytest.warns(FigureWarning, match="curves could not be drawn: Data cannot"):
        figures.draw(tmp_path, {"curves": fail, "empty": figures.Figure})
    assert (tmp_path / "empty.png").is_file() and not (tmp_path / "curves.png").exists()
    from studies.show.pages import _image

    assert "Data cannot be log-scaled" in _image(tmp_path, "curves", "the curves")


def test_a_descent_without_an_allowed_design_is_drawn(tmp_path):
    spec, _ = known()
    at = SimpleNamespace(least_so_far=lambda: np.full((3, 2), np.nan), family=np.zeros(2, int))
    figures.save(plots.descent(spec, SimpleNamespace(at=at)), tmp_path, "descent")
    assert (tmp_path / "descent.png").is_file()


@pytest.mark.long
def test_a_tuning_killed_at_random_moments_keeps_its_best_design(tmp_path):
    from studies.study.template import toml_text

    data = {**SMALL, "tune": {"free": GAIN, "starts": 2, "iterations": 12}}
    (tmp_path / "gain.toml").write_text(toml_text(data))
    out, random = tmp_path / "out", np.random.default_rng(5)
    command = [sys.executable, "-m", "studies.cli", "tune", str(tmp_path / "gain.toml")]
    command += ["--out", str(out), "--resume", "--no-progress"]
    kills = 0
    for wait in random.uniform(4.0, 40.0, 5):
        process = subprocess.Popen(command)
        time.sleep(wait)
        process.send_signal(signal.SIGKILL)
        kills += process.wait() == -signal.SIGKILL
        at = load_progress(out / "progress.npz")
        if at is not None:
            spec = tuning(GAIN, starts=2, iterations=12)
            best = spec.free.values(at.best_place)[at.winner(0), 0]
            assert load_design(out).study.control.gain_factor == pytest.approx(best, rel=1e-12)
    assert kills
    assert subprocess.run(command, timeout=600).returncode == 0
    assert (out / "report.html").is_file()
