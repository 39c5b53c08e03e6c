"""Same seed, same numbers: on any cores, in any chunks, by kernel or scan, on any Python."""

import os
import subprocess
import sys

import numpy as np
import pytest

from tests import TOP

#: Runs a sweep with noise, of every kind of link subset; arguments: variation, where numbers go.
SCRIPT = """
import os, sys
variation, out = sys.argv[1:]
if variation == "one core":
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
if variation == "narrow vectors":
    os.environ["XLA_FLAGS"] = "--xla_cpu_max_isa=AVX2"
import numpy as np
import studies
studies.configure()
from studies.engine import plan
from studies.kernels import llvm, native
from studies.space.spec import parse_sweep
if variation == "small chunks":
    plan.LANES, plan.LARGEST_CHUNK = 8, 24
if variation == "scan":
    llvm.is_available = lambda: False
if variation == "narrow vectors":
    narrow = native.this_processor().without("avx512")
    native.this_processor = lambda: narrow
from studies.engine.results import read_sweep
from tests.sweeps import run_sweep
spec = parse_sweep({
    "run": {"duration": 0.025, "seed": 3},
    "link": {"modes": 3},
    "electronics": {"adc_noise": 0.002},
    "motion": {"waypoints": [[0, 0, 0.5236], [0, 0.002, 0.5236]], "move_time": 0.01},
    "shaper": {"kind": "zv"},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.01},
    "sweep": {
        "axes": {"controlled_modes": [1, 2], "link_subsets": ["none", "2", "1+2+3"]},
        "blocks": [{"method": "sobol", "count": 8, "axes": {"placement": {"kind": "per_link"}}}],
    },
})
done = run_sweep(spec, out)
assert ("scan" in done.executor) == (variation == "scan"), done.executor
data = read_sweep(out)
arrays = {name: x.data for name, x in data.variables.items() if x.dims[:1] == ("case",)}
np.savez(out + ".npz", **{k: v for k, v in arrays.items() if v.dtype.kind in "bifS"})
"""
#: Largest difference, relative to the largest value of a metric.
TOLERANCE = 1e-9


def numbers(folder, variation, python=sys.executable):
    """Results of the sweep, computed in a process of its own."""
    out = folder / variation.replace(" ", "_")
    environment = os.environ | {"PYTHONPATH": str(TOP)}
    environment.pop("XLA_FLAGS", None)  # those of this process suit its own version of XLA
    done = subprocess.run(
        [python, "-c", SCRIPT, variation, str(out)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=500,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    with np.load(f"{out}.npz") as file:
        return dict(file)


def check_same(first, second):
    assert first.keys() == second.keys() and len(first) > 20
    for name, array in first.items():
        if array.dtype.kind != "f":
            np.testing.assert_array_equal(array, second[name], err_msg=name)
            continue
        np.testing.assert_array_equal(np.isnan(array), np.isnan(second[name]), err_msg=name)
        size = np.nanmax(np.abs(array)) if np.isfinite(array).any() else 0.0
        difference = np.nan_to_num(np.abs(array - second[name]))
        assert difference.max() <= TOLERANCE * size, name


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    return numbers(tmp_path_factory.mktemp("numbers"), "as usual")


def test_the_comparison_can_fail():
    rng = np.random.default_rng(0)
    first = {f"metric {k}": rng.normal(size=(8, 3)) for k in range(20)}
    first |= {"status": np.arange(8), "missing": np.where(np.arange(8) < 4, np.nan, 1.0)}
    check_same(first, first)
    for name, array in (
        ("metric 3", first["metric 3"] * (1 + 1e-8)),
        ("status", first["status"] + 1),
        ("missing", np.ones(8)),
    ):
        with pytest.raises(AssertionError):
            check_same(first, first | {name: array})


@pytest.mark.long  # in short: tests/studies/engine/test_sweeps.py, whose cases have noise
@pytest.mark.parametrize("variation", ["small chunks", "one core", "scan", "narrow vectors"])
def test_numbers_are_the_same(expected, variation, tmp_path):
    check_same(expected, numbers(tmp_path, variation))


@pytest.mark.long  # in short: `make smoke` runs core tests on other Pythons
@pytest.mark.parametrize("version", ["3.12", "3.13"])
def test_so_they_are_on_another_python(expected, version, tmp_path):
    python = TOP / f".venv-{version}" / "bin" / "python"  # left there by `make smoke`
    if not python.exists():
        pytest.skip(f"no environment of Python {version}; `make smoke` makes it")
    check_same(expected, numbers(tmp_path, "as usual", str(python)))
