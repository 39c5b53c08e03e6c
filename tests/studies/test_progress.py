"""Progress of long commands: which phase they are in, and what is left of it."""

import io
import os
import subprocess
import sys
import time

import numpy as np
import pytest
from rich.console import Console

from studies import config
from studies.engine import progress
from studies.engine.progress import Reporter
from studies.phases import Phases, duration_text
from tests.canonical import TINY, text_of

NAMES = ("compile", "run", "join", "draw")


@pytest.fixture
def clock(monkeypatch):
    """A clock that the test sets [s]."""
    now = [0.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def shown(steps, **options):
    console = Console(file=io.StringIO(), width=200, **options)
    with Phases(console, NAMES) as phases:
        steps(phases)
    return console.file.getvalue()


def test_every_phase_is_named_with_the_time_since_the_start(clock):
    def steps(phases):
        phases.begin("compile", "program 1 of 1")
        clock[0] = 200.0
        phases.begin("join")

    lines = shown(steps).splitlines()
    assert lines == [
        "compile (1 of 4), 0 s since the start: program 1 of 1",
        "join (3 of 4), 3 min since the start",
    ]


def test_the_time_left_says_which_phases_it_does_not_cover(clock):
    """And counts only what this call has done."""

    def steps(phases):
        for name in ("run", "draw"):
            phases.begin(name, done=3)
            phases.advance(3, 5, "3/5")
            clock[0] += 5.0
            phases.advance(4, 5, "4/5", 2.0 if name == "draw" else 0.0)
            phases.advance(5, 5, "5/5")

    lines = shown(steps).splitlines()
    assert lines[1:4] == ["3/5", "4/5; about 5 s left in this phase, then join, draw", "5/5"]
    assert lines[5:] == ["3/5", "4/5; about 7 s left", "5/5"]


def test_the_time_left_is_what_is_typical_times_what_this_machine_needed(clock):
    said, typical = (
        Console(file=io.StringIO(), width=200),
        {"run": 100.0, "join": 40.0, "draw": 10.0},
    )
    with Phases(said, typical) as phases:
        phases.begin("run")
        clock[0] = 50.0
        phases.begin("join", "files")
        clock[0] = 280.0
        phases.begin("draw")
    assert said.file.getvalue().splitlines() == [
        "run (1 of 3), 0 s since the start: about 2 min left",
        "join (2 of 3), 50 s since the start: files; about 25 s left",
        "draw (3 of 3), 5 min since the start: about 20 s left",
    ]


def test_a_terminal_has_one_line_for_all_phases():
    def steps(phases):
        phases.begin("compile")
        phases.begin("run")
        phases.advance(1, 2, "1/2 cases")
        phases.say("a line above it")

    text = shown(steps, force_terminal=True)
    assert "run (2 of 4)" in text and "1/2 cases" in text and "a line above it" in text
    assert "since the start" not in text and "\x1b[" in text


def test_the_time_left_of_a_sweep_includes_programs_that_are_not_compiled_yet(clock):
    console = Console(file=io.StringIO(), width=200)
    reporter = Reporter(Phases(console, NAMES), "run", 100, 20, programs=3)
    reporter.compiling()
    clock[0] = 30.0
    reporter.compiled("kernel", 30.0)
    clock[0] = 40.0
    reporter.chunk(np.zeros(20, int))  # 2 cases/s: 30 s for the others and 2 x 30 s of compiling
    text = console.file.getvalue()
    assert "compile (1 of 4), 0 s since the start: program 1 of 3" in text
    assert "40/100 cases, 2 cases/s, all ok; about 90 s left in this phase, then join" in text
    reporter.chunk(np.zeros(60, int))
    assert "100/100 cases" in console.file.getvalue().splitlines()[-1]
    assert "left" not in console.file.getvalue().splitlines()[-1]


def test_quiet_phases_say_nothing():
    console = Console(file=io.StringIO(), force_terminal=True)
    with Phases(console, NAMES, is_quiet=True) as phases:
        phases.begin("run")
        phases.advance(1, 2, "1/2")
        phases.say("text")
    assert console.file.getvalue() == ""


def test_durations_in_words():
    assert [duration_text(x) for x in (40, 180, 7800)] == ["40 s", "3 min", "2 h 10 min"]


@pytest.mark.long
def test_a_first_command_says_at_once_what_it_waits_for(tmp_path):
    """And nothing of it the second time."""
    (tmp_path / "cache").mkdir(mode=0o700)
    (tmp_path / "tiny.toml").write_text(text_of(TINY))
    environment = {**os.environ, "JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}
    command = [sys.executable, "-m", "studies.cli", "simulate", str(tmp_path / "tiny.toml")]
    told = []
    for _ in range(2):
        began = time.monotonic()
        with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=environment) as run:
            first = run.stderr.readline()
            waited = time.monotonic() - began
            told.append(first + run.stderr.read())
        assert run.returncode == 0
        if len(told) == 1:
            assert waited < 10 and "the first commands on a machine compile" in first
            assert "compiling simulate" in told[0] and "compiling loops" in told[0]
    assert "compiling" not in told[1]


def test_a_part_of_a_command_with_phases_leaves_them_shown():
    """What is compiled after it is announced by the command's own phases."""
    console = Console(file=io.StringIO())
    assert not config.shows_phases
    with Phases(console, NAMES):
        with Phases(console, NAMES, is_quiet=True):
            assert config.shows_phases
        assert config.shows_phases
    assert not config.shows_phases
