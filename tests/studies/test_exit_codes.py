"""What a command's exit code says, and retries on a cluster; nothing is compiled here."""

import os
import shlex
import threading
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

import studies
from jaxmodel import status
from studies.cluster import remote
from studies.cluster.remote import AHEAD, Remote, call
from studies.cluster.runner import ClusterRunner, run_chunk
from studies.engine.chunks import Done, Lost
from studies.engine.plan import Layout, plan_groups
from studies.engine.progress import Reporter
from studies.engine.results import read_sweep
from studies.errors import StudyError
from studies.phases import Phases
from studies.result import Result, in_folder
from studies.single import run as single_run
from studies.single.run import Simulation
from studies.space.table import build_table
from studies.spillover import run as spillover_run
from studies.sweeps import run as sweep_run
from studies.sweeps.result import SweepResult
from studies.tuning import audit as audit_module
from studies.tuning.audit import ALLOWED, Disagreement, audit
from studies.tuning.evaluate import Evaluation, Evaluator
from studies.tuning.workers import ClusterEvaluator, evaluate_part
from tests.canonical import TINY, text_of
from tests.studies.test_cli import run
from tests.sweeps import small_spec
from tests.tunings import tuning

SILENT = Console(file=open(os.devnull, "w"))  # noqa: SIM115
#: Without control there is no baseline to run.
SWEEP = text_of(
    TINY,
    control={"feedback": "none"},
    sweep={"axes": {"drive.kp": {"from": 1e4, "to": 4e4, "count": 6}}},
)


@pytest.fixture
def sweep_file(tmp_path):
    path = tmp_path / "sweep.toml"
    path.write_text(SWEEP)
    return path


# --- sweeps ---------------------------------------------------------------------------------------


class Losing:
    """A runner that gives every chunk up."""

    def layout(self, n, structure):
        return Layout(1, 1, 4)

    def run(self, table, groups, reporter, stop):
        for group in groups:
            for chunk in group.chunks():
                yield Lost(chunk, "no room")


def test_a_sweep_with_lost_cases_fails_and_says_how_to_retry(
    capsys, monkeypatch, sweep_file, tmp_path
):
    monkeypatch.setattr(sweep_run, "LocalRunner", Losing)
    out = tmp_path / "out"
    code, text, err = run(capsys, "sweep", sweep_file, "--out", out)
    assert code == 1
    again = f"studies sweep {sweep_file} --out {out} --resume"
    assert err == f"studies: 6 of 6 cases were left out, see above; retry them with: {again}\n"
    assert "no room" in text and "0 cases in" in text
    np.testing.assert_array_equal(read_sweep(out)["status"], -1)
    # and again, where they are lost again
    assert run(capsys, "sweep", sweep_file, "--out", out, "--resume")[0] == 1


@pytest.mark.parametrize(("lost", "wanted"), [(0, 0), (2, 1)])
def test_how_a_sweep_ended(capsys, monkeypatch, sweep_file, tmp_path, lost, wanted):
    def ended(spec, job, *_):
        done = SweepResult(
            n_cases=6,
            n_run=3,
            compile_time=1.5,
            run_time=2.5,
            executor="kernel",
            lost=np.arange(lost),
        )
        return in_folder(done, job.place)

    monkeypatch.setattr(sweep_run, "swept_into", ended)
    out = tmp_path / "out"
    code, text, err = run(capsys, "sweep", sweep_file, "--out", out)
    assert code == wanted
    assert (f"{lost} of 6 cases were left out" in err) == (lost > 0)
    done = f"3 cases in 2.5 s and 1.5 s of compiling; results: {out}/results.h5"
    assert done in text.splitlines()


def test_how_an_interrupted_sweep_ended(capsys, monkeypatch, sweep_file, tmp_path):
    def ended(*_):
        raise KeyboardInterrupt("4 of 6 cases are safe")

    monkeypatch.setattr(sweep_run, "swept_into", ended)
    out = tmp_path / "it's"
    code, text, err = run(capsys, "sweep", sweep_file, "--out", out)
    again = f"studies sweep {sweep_file} --out {shlex.quote(str(out))} --resume"
    assert (code, text) == (130, "")
    assert err == f"studies: 4 of 6 cases are safe; continue with: {again}\nstudies: interrupted\n"
    with pytest.raises(KeyboardInterrupt):
        studies.sweep(sweep_file, tmp_path / "new", progress=False)
    assert "safe; continue with: " in capsys.readouterr().err


# --- retries on a cluster -------------------------------------------------------------------------


class FakeCluster:
    """A client and the watch over it: answers by the first row of a chunk, in the order given."""

    def __init__(self, answers, workers=2):
        self.answers = {row: list(given) for row, given in answers.items()}
        self.n_workers = workers
        self.submitted, self.flying, self.most, self.with_others = [], set(), 0, []
        self.jobs = []

    def ncores(self):
        return range(self.n_workers)

    def submit(self, what, identity, precision, function, spec, group, has_own_ratio, **_):
        assert (what, function) == (call, run_chunk)
        self.jobs.append((group, has_own_ratio))
        self.submitted.append(int(group.rows[0]))
        self.with_others.append(len(self.flying))
        future = (len(self.submitted), int(group.rows[0]))
        self.flying.add(future)
        self.most = max(self.most, len(self.flying))
        return future

    def finished(self, pending):
        """One at a time, the latest first."""
        last = max(pending)
        self.flying.discard(last)
        return [last]

    def outcome(self, future):
        given = self.answers.get(future[1], [])
        answer = given.pop(0) if given else None
        if answer is not None:
            return answer
        return f"judged {future[1]}", "kernel", 0.0


@pytest.fixture
def on_cluster(monkeypatch):
    """What a runner yields, with which chunks, for answers by chunk."""
    gain = {"from": 0.1, "to": 1.0, "count": 10}
    spec = small_spec({"axes": {"control.ratio_source": ["given", "own_run"], "gain": gain}})
    table = build_table(spec)
    parts = (np.arange(8), ()), (np.arange(8, 20), ("delay_margin",))
    groups = [
        group
        for rows, figures in parts
        for group in plan_groups(
            table, rows, lambda n, structure: Layout(1, 1, 4), robustness=figures
        )
    ]
    assert [len(group.chunks()) for group in groups] == [2, 3]

    def outcome(answers, **options):
        fake = FakeCluster(answers, **options)
        monkeypatch.setattr(remote, "Watch", lambda *_: fake)
        runner = ClusterRunner(spec, Remote(fake, 60.0, print))
        reporter = Reporter(Phases(SILENT, ("compile", "run"), True), "run", 20)
        found = list(runner.run(table, groups, reporter, threading.Event()))
        return fake, found

    return outcome


def first_rows(found, kind):
    return sorted(int(x.chunk.rows[0]) for x in found if isinstance(x, kind))


def test_every_chunk_comes_back_once(on_cluster):
    fake, found = on_cluster({})
    assert first_rows(found, Done) == [0, 4, 8, 12, 16] == sorted(fake.submitted)
    assert {x.judged for x in found} == {f"judged {k}" for k in (0, 4, 8, 12, 16)}
    assert all(x.judged == f"judged {x.chunk.rows[0]}" for x in found)
    assert fake.most == 2 * AHEAD  # few are under way


def test_a_job_asks_for_what_the_cases_of_its_own_group_need(on_cluster):
    """Of two groups, the second has ratios from runs without control, and delay margins."""
    fake, _ = on_cluster({})
    asked = {int(group.rows[0]): (own, group.robustness) for group, own in fake.jobs}
    plain, more = (False, ()), (True, ("delay_margin",))
    assert asked == {0: plain, 4: plain, 8: more, 12: more, 16: more}


def test_a_chunk_that_fails_once_is_tried_again_alone(on_cluster):
    fake, found = on_cluster({0: ["OSError: no room"], 8: ["died"]})
    assert first_rows(found, Done) == [0, 4, 8, 12, 16] and first_rows(found, Lost) == []
    assert Counter(fake.submitted) == {0: 2, 4: 1, 8: 2, 12: 1, 16: 1}
    again = [n for k, n in enumerate(fake.with_others) if fake.submitted[k] in fake.submitted[:k]]
    assert again == [0, 0]


def test_a_chunk_that_fails_twice_is_given_up_with_the_last_reason(on_cluster):
    fake, found = on_cluster({4: ["first", "second", "third"]})
    assert first_rows(found, Done) == [0, 8, 12, 16]
    (lost,) = (x for x in found if isinstance(x, Lost))
    assert lost.reason == "second" and lost.chunk.rows.tolist() == [4, 5, 6, 7]
    assert Counter(fake.submitted)[4] == 2


def test_where_all_fail_all_are_given_up(on_cluster):
    fake, found = on_cluster({k: ["x", "y"] for k in (0, 4, 8, 12, 16)}, workers=1)
    assert first_rows(found, Lost) == [0, 4, 8, 12, 16] and len(fake.submitted) == 10
    assert fake.most == AHEAD


def evaluator_of(monkeypatch, *answers):
    """Of four starts on three workers, which give these answers, the last part first."""
    monkeypatch.setattr(Evaluator, "__init__", lambda self, spec, families: None)

    def answered(function, jobs):
        assert function is evaluate_part
        parts.extend(jobs)
        return reversed([(k, answer) for (k, _), answer in zip(jobs, answers, strict=True)])

    parts = []
    spec = tuning({"control.gain_factor": {"from": 0.0, "to": 2.0}}, starts=4)
    remote = SimpleNamespace(n_workers=3, say=lambda text: None, map=answered)
    return ClusterEvaluator(spec, remote), parts


def test_parts_of_a_tuning_come_back_in_their_order(monkeypatch):
    evaluations = [Evaluation(*[np.full(n, float(k))] * 7) for k, n in enumerate((2, 1, 1))]
    evaluator, parts = evaluator_of(monkeypatch, *evaluations)
    found = evaluator.evaluate(np.arange(4.0)[:, None], np.array([True, False, True, True]))
    assert all(np.array_equal(x, [0, 0, 1, 2]) for x in found)
    sent = [
        (families, values.tolist(), needed.tolist()) for _, (_, families, values, needed) in parts
    ]
    assert sent == [
        ((0, 0), [[0.0], [1.0]], [True, False]),
        ((0,), [[2.0]], [True]),
        ((0,), [[3.0]], [True]),
    ]


def test_a_part_of_a_tuning_that_is_given_up_ends_it(monkeypatch):
    evaluator, _ = evaluator_of(monkeypatch, None, "OSError: no room", None)
    wanted = "a part of the designs cannot be evaluated: OSError: no room; .* with --resume"
    with pytest.raises(StudyError, match=wanted):
        evaluator.evaluate(np.zeros((4, 1)))


# --- audits ---------------------------------------------------------------------------------------


def audited(*shares):
    return [
        Disagreement(
            name=f"number {k}",
            family="tuned",
            place=k,
            figure="objective",
            derivative=1.25,
            difference=1.5 + k,
            share=share,
        )
        for k, share in enumerate(shares)
    ]


@pytest.mark.parametrize(
    ("shares", "wanted"),
    [((0.0,), 0), ((ALLOWED,), 0), ((1.001 * ALLOWED,), 1), ((0.0, 0.5, 0.0), 1), ((np.inf,), 1)],
)
def test_an_audit_fails_where_one_derivative_is_wrong(capsys, monkeypatch, shares, wanted):
    monkeypatch.setattr(audit_module, "audit", lambda spec: audited(*shares))
    code, text, _ = run(capsys, "tune", "tune", "--audit")
    assert code == wanted
    said = "above" if wanted else "below"
    assert f"worst: {max(shares):.1e}, {said} {ALLOWED:g}" in text
    rows = [[cell.strip() for cell in row.split("│")[1:-1]] for row in text.splitlines()]
    rows = [row for row in rows if row and row[0].startswith("number")]
    assert rows == [
        [f"number {k}", "tuned", "objective", str(k + 1), "1.25", f"{1.5 + k:.6g}", f"{share:.1e}"]
        for k, share in enumerate(shares)
    ]


@pytest.mark.parametrize("error", [0.0, 1e-5, 1e-2])
def test_an_audit_finds_a_falsified_derivative(monkeypatch, error):
    """Of a figure exp(2 u) + u^2, u the share of the way from bound to bound."""
    spec = tuning({"control.gain_factor": {"from": 0.0, "to": 2.0}})

    def evaluated(spec, evaluator, designs):
        u = np.asarray(designs)[:, 0]
        slope = (2 * np.exp(2 * u) + 2 * u) / 2 * (1 + error)
        none = np.zeros((len(u), 0))
        return SimpleNamespace(
            objective=np.exp(2 * u) + u**2,
            slope=slope[:, None],
            limits=none,
            limit_slope=none[:, :, None],
        )

    monkeypatch.setattr(audit_module, "_evaluate", evaluated)
    monkeypatch.setattr(audit_module, "Evaluator", lambda spec, families: None)
    (one,) = audit(spec, np.array([[0.3], [0.6]]))
    assert one.share == pytest.approx(error / (1 + error), abs=1e-8)
    assert (one.share > ALLOWED) == (error > 1e-3) and one.figure == "objective"
    wanted = 2 * np.exp(1.2) + 1.2 if one.place else 2 * np.exp(0.6) + 0.6
    assert one.difference == pytest.approx(wanted, rel=1e-8)
    assert one.derivative == pytest.approx(wanted * (1 + error), rel=1e-8)


# --- single runs and certificates -----------------------------------------------------------------


@pytest.fixture
def simulated(capsys, monkeypatch):
    """Exit code and text of a run that ended so, of a case for which a sweep has these numbers."""
    monkeypatch.setattr(Simulation, "report", lambda found: found.notes)
    monkeypatch.setattr(
        "studies.show.report.print_report", lambda notes, console: console.print(*notes, sep="\n")
    )

    def ended(code, stored=None, found=None):
        for name, value in (
            ("as_design", SimpleNamespace(study=None, stored=stored or {})),
            ("run_study", SimpleNamespace(status=code)),
            ("deviations", found),
        ):
            monkeypatch.setattr(single_run, name, lambda *_, value=value, **__: value)
        return run(capsys, "simulate", "folder", "--case", "1")[:2]

    return ended


@pytest.mark.parametrize(("ended", "wanted"), [(status.OK, 0), (status.DIVERGED, 1)])
def test_a_run_that_is_not_ok_fails(simulated, ended, wanted):
    assert simulated(ended) == (wanted, "\n")


@pytest.mark.parametrize(("stored", "wanted"), [(status.OK, 0), (status.SATURATED, 1)])
def test_a_case_that_ends_otherwise_fails(simulated, stored, wanted):
    found = {"residual_rms": (1e-7, 1e-6)}
    code, text = simulated(status.OK, {"status": stored}, found)
    assert code == wanted
    assert ("CAUTION: the sweep and this run end differently." in text) == bool(wanted)
    assert "largest relative difference of a metric: 1.0e-07 (residual_rms)" in text
    found["gain_margin"] = (0.5, 0.02)
    code, text = simulated(status.OK, {"status": stored}, found)
    assert code == 1 and "CAUTION: gain_margin differs by 50 %; allowed: 2 %." in text


def test_a_case_that_failed_in_its_sweep_as_well_is_no_failure(simulated):
    code, text = simulated(status.DIVERGED, {"status": status.DIVERGED}, {})
    assert code == 0 and "CAUTION" not in text


@pytest.mark.parametrize("is_kept", [False, True])
def test_a_run_sees_strain_that_its_sweep_did_not_keep(simulated, is_kept):
    found = {"patch_strain_peak": (0.0, 1e-6)} if is_kept else {}
    assert simulated(status.STRAINED, {"status": status.OK}, found)[0] == is_kept


@pytest.mark.parametrize("is_good", [True, False])
def test_a_certificate_that_is_not_passed_fails(capsys, monkeypatch, is_good, tmp_path):
    class Made(Result):
        folder, is_good = tmp_path, None

        def lines(self):
            return ["verdict"]

    Made.is_good = is_good
    monkeypatch.setattr(spillover_run, "certified", lambda *_: Made())
    code, text, err = run(capsys, "certify", "paper", "--out", tmp_path / "out")
    assert (code, err) == (0 if is_good else 1, "") and "verdict" in text
