"""The way of a swept gain from its file to results.h5: the modules whose functions hold its value.

Fewer modules are fewer places to read, and to change, for a new field. Kernels are left out: they
know nothing of robots. Inside of JAX's programs the value is a tracer, which is not looked at.
"""

import dataclasses
import sys
import threading
from collections import Counter
from pathlib import Path

import jax
import numpy as np
import pytest

import jaxmodel
import studies
from studies.cli import main
from studies.study.template import toml_text
from tests.sweeps import narrow_blocks, small

#: Modules that hold the gain today. The aim is 18.
LIMIT = 31
GAINS = (0.2345678901, 0.4321098765)
#: How deep into containers and objects.
DEPTH = 4
#: Calls of one function that are looked at: a loop over cases need not be followed to its end.
CALLS = 20
ROOTS = {Path(package.__file__).parent: package.__name__ for package in (jaxmodel, studies)}


def holds(x, depth=DEPTH):
    """Whether a value is one of the gains, or holds one."""
    if isinstance(x, jax.core.Tracer):
        return False
    if isinstance(x, float):
        return x in GAINS
    if isinstance(x, np.ndarray | jax.Array):
        array = np.asarray(x)
        return array.dtype.kind == "f" and bool(np.isin(array, GAINS).any())
    if depth == 0 or isinstance(x, str | bytes | int | type(sys) | type):
        return False
    if isinstance(x, dict):
        return any(holds(value, depth - 1) for value in list(x.values()))
    if isinstance(x, list | tuple):
        return any(holds(value, depth - 1) for value in list(x))
    is_ours = type(x).__module__.partition(".")[0] in ("jaxmodel", "studies")
    if is_ours or dataclasses.is_dataclass(x):
        return any(holds(value, depth - 1) for value in list(getattr(x, "__dict__", {}).values()))
    return False


class Way:
    """Watches calls of functions of the packages, and notes where a gain is seen first."""

    def __init__(self):
        self.modules, self._names, self._calls = [], {}, Counter()

    def __call__(self, frame, event, argument):
        code = frame.f_code
        name = self._names.get(code)
        if name is None:
            name = self._names[code] = module_of(code)
        if not name or event not in ("call", "return") or name in self.modules:
            return
        self._calls[code] += event == "call"
        if self._calls[code] <= CALLS and (holds(frame.f_locals, DEPTH + 1) or holds(argument)):
            self.modules.append(name)


def module_of(code):
    """Dotted name of the module that a function of the packages is from; otherwise ""."""
    path = Path(code.co_filename)
    for folder, package in ROOTS.items():
        if path.is_relative_to(folder):
            parts = path.relative_to(folder).with_suffix("").parts
            return "" if parts[0] == "kernels" else ".".join((package, *parts))
    return ""


@pytest.fixture(autouse=True)
def small_blocks():
    with narrow_blocks():
        yield


def test_few_modules_hold_a_gain_between_its_file_and_its_results(tmp_path):
    path = tmp_path / "gains.toml"
    path.write_text(toml_text(small({"axes": {"gain": list(GAINS)}})))
    command = ["sweep", str(path), "--no-progress", "--out"]
    main([*command, str(tmp_path / "compiled")])  # calls that trace programs are not its way
    way = Way()
    threading.setprofile(way)
    sys.setprofile(way)
    try:
        main([*command, str(tmp_path / "sweep")])
    finally:
        sys.setprofile(None)
        threading.setprofile(None)
    np.testing.assert_array_equal(
        studies.load(tmp_path / "sweep").data["control.gain_factor"], GAINS
    )
    modules = dict.fromkeys(way.modules)  # two threads may note one at once
    print(f"{len(modules)} modules:", *modules, sep="\n  ")
    assert len(modules) <= LIMIT
    # what is looked at is seen: from the first module to the last
    assert {"studies.reading", "studies.store"} <= set(way.modules)
