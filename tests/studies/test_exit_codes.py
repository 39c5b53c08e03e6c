"""What a command's exit code says, and retries on a cluster; nothing is compiled here."""

import os
import re
import threading
from collections import Counter
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from rich.console import Console

from jaxmodel import status
from studies.cluster import runner as cluster_runner
from studies.cluster.runner import AHEAD, ClusterRunner
from studies.cluster.worker import ChunkDone
from studies.engine.chunks import Done, Lost
from studies.engine.plan import Layout, plan_groups
from studies.engine.progress import Phases, Reporter
from studies.engine.results import read_sweep
from studies.single import run as single_run
from studies.space.table import build_table
from studies.spillover import run as spillover_run
from studies.sweeps import run as sweep_run
from studies.sweeps.run import Outcome
from studies.tuning import audit as audit_module
from studies.tuning.audit import ALLOWED, Disagreement, audit
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
    @contextmanager
    def losing(*_):
        yield Losing()

    monkeypatch.setattr(sweep_run, "on_workers", losing)
    out = tmp_path / "out"
    code, text, err = run(capsys, "sweep", sweep_file, "--out", out)
    assert code == 1
    remedy = f"6 of 6 cases were left out, see above; retry them with --resume --out {out}"
    assert err == f"studies: {remedy}\n"
    assert "no room" in text and "0 cases in" in text
    np.testing.assert_array_equal(read_sweep(out)["status"], -1)
    # and again, where they are lost again
    assert run(capsys, "sweep", sweep_file, "--out", out, "--resume")[0] == 1


@pytest.mark.parametrize(
    ("lost", "is_interrupted", "wanted"),
    [(0, False, 0), (2, False, 1), (0, True, 130), (2, True, 130)],
)
def test_how_a_sweep_ended(capsys, monkeypatch, sweep_file, tmp_path, lost, is_interrupted, wanted):
    def ended(spec, *_, **__):
        return Outcome(
            out=tmp_path,
            table=build_table(spec),
            n_done=6 - lost,
            n_run=3,
            compile_time=1.5,
            run_time=2.5,
            is_interrupted=is_interrupted,
            executor="kernel",
            lost=np.arange(lost),
        )

    monkeypatch.setattr(sweep_run, "run_sweep", ended)
    out = tmp_path / "out"
    code, text, err = run(capsys, "sweep", sweep_file, "--out", out)
    assert code == wanted
    assert (f"{lost} of 6 cases were left out" in err) == (lost > 0)
    resume = (
        f"{6 - lost} of 6 cases are safe; continue with: studies sweep {sweep_file} --out {out}"
    )
    assert (f"interrupted; {resume} --resume" in err) == is_interrupted
    done = r"3 cases in 2\.5 s and 1\.5 s of compiling, \d+ s with all else; results: "
    assert bool(re.search(done + re.escape(str(out / "results.h5")), text)) == (not is_interrupted)


# --- retries on a cluster -------------------------------------------------------------------------


class FakeCluster:
    """A client and the watch over it: answers by the first row of a chunk, in the order given."""

    def __init__(self, answers, workers=2):
        self.answers = {row: list(given) for row, given in answers.items()}
        self.n_workers = workers
        self.submitted, self.flying, self.most, self.with_others = [], set(), 0, []
        self.jobs = []

    def submit(self, function, job, **_):
        self.jobs.append(job)
        self.submitted.append(int(job.rows[0]))
        self.with_others.append(len(self.flying))
        future = (len(self.submitted), int(job.rows[0]))
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
        return ChunkDone(f"judged {future[1]}", "kernel", 0.0, "tcp://worker")


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
        monkeypatch.setattr(cluster_runner, "Watch", lambda *_: fake)
        runner = ClusterRunner(spec, fake, 60.0)
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
    asked = {int(job.rows[0]): (job.has_own_ratio, job.robustness) for job in fake.jobs}
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


@pytest.mark.parametrize(("ended", "wanted"), [(status.OK, 0), (status.DIVERGED, 1)])
def test_a_run_that_is_not_ok_fails(capsys, monkeypatch, ended, wanted):
    made = SimpleNamespace(status=ended)
    monkeypatch.setattr(single_run, "simulate", lambda *_: made)
    monkeypatch.setattr("studies.engine.runs.uncontrolled_twin", lambda run: None)
    monkeypatch.setattr("studies.single.say.say", lambda *_: None)
    monkeypatch.setattr("studies.show.report.print_report", lambda *_: None)
    assert run(capsys, "simulate", "paper")[0] == wanted


@pytest.mark.parametrize(("stored", "wanted"), [(status.OK, 0), (status.SATURATED, 1), (None, 0)])
def test_a_replay_that_ends_otherwise_fails(capsys, monkeypatch, stored, wanted):
    again = SimpleNamespace(study=SimpleNamespace(title="this"), status=status.OK)
    kept = SimpleNamespace(study=None, stored={} if stored is None else {"status": stored})
    monkeypatch.setattr(single_run, "load_design", lambda *_: kept)
    monkeypatch.setattr(single_run, "run_study", lambda _: again)
    found = {"residual_rms": (1e-7, 1e-6)}
    monkeypatch.setattr(single_run, "deviations", lambda *_: found)
    code, text, _ = run(capsys, "replay", "folder", "--case", "1")
    assert code == wanted and "this: ok" in text
    assert ("CAUTION: the sweep and this run end differently." in text) == bool(wanted)
    told = "largest relative difference of a metric: 1.0e-07 (residual_rms)"
    assert (told in text) == (stored is not None)
    found["gain_margin"] = (0.5, 0.02)
    code, text, _ = run(capsys, "replay", "folder", "--case", "1")
    told = "CAUTION: gain_margin differs by 50 %; allowed: 2 %."
    assert (code == 1 and told in text) == (stored is not None)


@pytest.mark.parametrize("is_kept", [False, True])
def test_a_replay_sees_strain_that_its_sweep_did_not_keep(capsys, monkeypatch, is_kept):
    again = SimpleNamespace(study=SimpleNamespace(title="this"), status=status.STRAINED)
    kept = SimpleNamespace(study=None, stored={"status": status.OK})
    found = {"patch_strain_peak": (0.0, 1e-6)} if is_kept else {}
    for name, value in (("load_design", kept), ("run_study", again), ("deviations", found)):
        monkeypatch.setattr(single_run, name, lambda *_, value=value: value)
    code, text, _ = run(capsys, "replay", "folder", "--case", "1")
    assert code == is_kept and "this: patches strained beyond patches.strain_limit" in text


@pytest.mark.parametrize("is_passed", [True, False])
def test_a_certificate_that_is_not_passed_fails(capsys, monkeypatch, is_passed, tmp_path):
    monkeypatch.setattr(
        spillover_run, "spillover_design", lambda *_: SimpleNamespace(is_passed=is_passed)
    )
    code, _, err = run(capsys, "spillover", "paper", "--out", tmp_path / "out")
    assert (code, err) == (0 if is_passed else 1, "")
