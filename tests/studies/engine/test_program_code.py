"""The code that a kept program is found by: all that runs while it is traced, and no more than that
of its module and of what this imports."""

import sys
from pathlib import Path

import jax
import pytest

from studies import sources
from studies.engine import programs
from studies.engine.preflight import preflight
from studies.engine.runs import run_study
from studies.study.cases import build_case, build_structure
from studies.tuning.loop_figures import loop_figures
from tests import TOP
from tests.bare import parse_sweep, parse_tuning
from tests.canonical import TINY, study_of
from tests.sweeps import run_sweep

PACKAGES = tuple(str(TOP / package) + "/" for package in sources.PACKAGES)


@pytest.fixture
def strangers(fresh_programs, monkeypatch):
    """Files that run while a program is traced and are not in its digest, by program."""
    jax.clear_caches()  # what was traced before would not run again
    found, compiled = {}, programs._load_or_compile

    def watched(name, label, lower, modules):
        known = set(sources.closure([programs.__name__, *modules]))
        seen = set()

        def lowered():
            sys.setprofile(lambda frame, *_: seen.add(frame.f_code.co_filename))
            try:
                return lower()
            finally:
                sys.setprofile(None)

        result = compiled(name, label, lowered, modules)
        found[name[:60]] = {x for x in seen if x.startswith(PACKAGES) and Path(x) not in known}
        return result

    monkeypatch.setattr(programs, "_load_or_compile", watched)
    monkeypatch.setattr(programs.KeptFunction, "_is_kept", lambda *_: True)
    return found


def use_preflight(folder):
    study = study_of(TINY)
    preflight(build_structure(study), build_case(study))


def use_run(folder):
    run_study(study_of(TINY), has_record=False)


def use_sweep(folder):
    sweep = {"axes": {"control.gain_factor": [0.1, 0.2], "move_time": [0.01, 0.011]}}
    run_sweep(parse_sweep(TINY | {"sweep": sweep}), folder)


def use_tuning(folder):
    spec = parse_tuning(
        TINY | {"tune": {"free": {"control.gain_factor": {"from": 0.1, "to": 1.0}}}}
    )
    loop_figures(spec, spec.study)


@pytest.mark.parametrize(
    "use",
    [
        use_preflight,
        *(pytest.param(x, marks=pytest.mark.long) for x in (use_run, use_sweep, use_tuning)),
    ],
)
def test_all_code_that_is_traced_is_in_the_digest(strangers, use, tmp_path):
    use(tmp_path / "out")
    assert strangers and {name: x for name, x in strangers.items() if x} == {}


def test_code_outside_the_digest_is_seen(strangers, monkeypatch):
    """As if the function's module imported nothing."""
    monkeypatch.setattr(sources, "closure", lambda *_: [])
    use_preflight(None)
    assert any(x.endswith("prepare.py") for names in strangers.values() for x in names)
