"""Float64, one CPU device per core and kept programs for every test.

Tests compile much and run little, so the code generators of XLA and of the kernels leave their
optimisations out here: the same programs, compiled in a third of the time. Programs are kept in
`.pytest_cache/programs`, for both workers and for the next run, as commands keep them for users;
while `monkeypatch` has patched a module of the packages, nothing is kept or taken from there. What
`unittest.mock` patches must therefore be part of no program.
"""

from __future__ import annotations

import os
from pathlib import Path
from types import ModuleType
from typing import Any

import jaxlib
import pytest
from threadpoolctl import threadpool_limits

from studies import config
from studies.engine import function, programs
from studies.engine.programs import drop_programs

pytest_plugins = ["tests.budget"]

# threads of BLAS wait for each other's turns where other workers have the cores; children, too
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
threadpool_limits(1, "blas")
FLAGS = "--xla_backend_optimization_level=0"
# without the threshold for small loops, which takes a sixth of the time to compile
FLAGS += " --xla_backend_extra_options=xla_cpu_use_multi_output_fusion"
# nor passes over loops, nor modules split for threads that have no processor: another sixth
FLAGS += " --xla_cpu_parallel_codegen_split_count=1 --xla_disable_hlo_passes="
FLAGS += "simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking"
if jaxlib.__version__.startswith("0.10."):  # unknown flags stop XLA
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"
KEPT = Path(__file__).parent / ".pytest_cache" / "programs"
KEPT.mkdir(mode=0o700, parents=True, exist_ok=True)
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(KEPT))
config.configure()
# what must be compiled depends on what earlier runs have kept
config.tell_wait = lambda text: None
# tables as wide as they need to be, wherever the tests run
os.environ["COLUMNS"] = "240"

#: Limit of a long campaign [s]; that of every other test stands in pyproject.toml.
LONG = 600


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """More time for long campaigns."""
    for item in items:
        if item.get_closest_marker("long") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(LONG))


def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> None:
    """Drop compiled programs between files, before they become too many within one."""
    if nextitem is not None and nextitem.fspath != item.fspath:
        drop_programs(0.5)


# --- programs that are kept, and those that must not be ------------------------------------------

#: What has patched a module of the packages and has not undone it.
_PATCHING: set[pytest.MonkeyPatch] = set()
_PLAIN = {name: getattr(pytest.MonkeyPatch, name) for name in ("setattr", "setitem", "undo")}
#: Whether programs are kept at all: not where it counts which tests execute what.
IS_KEEPING = os.environ.get("STUDIES_TESTS_KEEP", "1") == "1"


def _keep() -> None:
    config._keeps_programs = IS_KEEPING and not _PATCHING


def _is_of_packages(target: Any) -> bool:
    """Whether what is patched may be traced; a dictionary cannot tell."""
    if isinstance(target, dict):
        return True
    name = target if isinstance(target, str) else getattr(target, "__module__", "")
    name = target.__name__ if isinstance(target, ModuleType) else name
    return str(name).partition(".")[0] in ("jaxmodel", "studies")


def _patching(name: str) -> Any:
    def patched(self: pytest.MonkeyPatch, target: Any, *others: Any, **options: Any) -> None:
        if target is not os.environ and _is_of_packages(target):
            _PATCHING.add(self)
            _keep()
        _PLAIN[name](self, target, *others, **options)

    return patched


def _undo(self: pytest.MonkeyPatch) -> None:
    _PLAIN["undo"](self)
    _PATCHING.discard(self)
    _keep()


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Keep programs again after a test of a user's own parts, which stop it for a process."""
    _keep()


pytest.MonkeyPatch.setattr = _patching("setattr")  # type: ignore[method-assign]
pytest.MonkeyPatch.setitem = _patching("setitem")  # type: ignore[method-assign]
pytest.MonkeyPatch.undo = _undo  # type: ignore[method-assign]
config.keep_programs = _keep
_keep()


@pytest.fixture
def fresh_programs(monkeypatch: pytest.MonkeyPatch) -> None:
    """For tests that count or look at what is traced: nothing made before is used."""
    monkeypatch.setattr(programs, "_PROGRAMS", {})
    monkeypatch.setattr(function, "_FUNCTIONS", {})


@pytest.fixture(scope="session", autouse=True)
def readable_figures() -> Any:
    """Asserts that the text of every figure that any test writes can be read on its page."""
    from matplotlib.figure import Figure

    from tests.pages import READABLE, smallest_text

    plain = Figure.savefig

    def checked(figure: Figure, *args: Any, **options: Any) -> None:
        plain(figure, *args, **options)
        size, text = smallest_text(figure)
        assert options.get("format") != "png" or size >= READABLE, f"{text!r}: {size:.1f} px"

    Figure.savefig = checked  # type: ignore[method-assign]
    yield
    Figure.savefig = plain  # type: ignore[method-assign]
