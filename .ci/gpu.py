"""`make gpu`: what a GPU is worth beside the cores of its machine, as a table.

Runs the tests of the GPU kernel, then each work on the GPU and on the cores, one after the other,
each in a process of its own under a time limit: nine minutes at most. Where there is no GPU, XLA's
CPU back end stands in for it with a sixteenth of the cases. The table goes into
docs/performance.md, unless it would replace a GPU's. Exits with 1 if a test fails, or both sides
differ by more than `EQUAL`.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

TOP = Path(__file__).parents[1]
PAGE = TOP / "docs" / "performance.md"
MARKS = "<!-- written by make gpu -->\n", "<!-- end -->\n"
STAND_IN = "XLA's CPU back end; no GPU here"
#: Longest of all, and of one work on one side [s].
ALL, ONE = 530.0, 90.0
#: Largest relative difference between both sides.
EQUAL = 1e-8
#: Works of `studies bench` with cases at once, and loops to judge.
WORKS = {"W0": 32768, "W1": 8448, "W8": 8448, "grad": 1024}
JUDGED = 8192
#: A sweep of short runs with margins, and one of as short ones that keeps its best.
CASES, DESIGNS = 65_536, 500_000
SWEEP = """title = "judged"
link = {{ modes = 2 }}
run = {{ duration = 0.05 }}
motion = {{ waypoints = [[0.0, 0.0, 0.5236], [0.0, 0.01, 0.5236]], move_time = 0.03 }}
metrics = {{ residual_length = 0.01, residual_delay = 0.002 }}
[sweep]
method = "sobol"
count = {count}
metrics = ["residual_rms"]
{more}
[sweep.axes]
placement = {{ kind = "same" }}
"control.gain_factor" = {{ from = 0.2, to = 2.0 }}
"""
CLI = ("-c", "from studies.cli import main; main()")


class Done(NamedTuple):
    """A work on one side."""

    said: str  # its figure, or why there is none
    results: Any = None  # what both sides should agree on


def run(arguments: list[str], is_gpu: bool, limit: float) -> tuple[str, str]:
    """Standard output of a Python command that finds no program compiled, or why there is none."""
    with tempfile.TemporaryDirectory() as cache:
        more = {"JAX_COMPILATION_CACHE_DIR": cache} | ({} if is_gpu else {"JAX_PLATFORMS": "cpu"})
        try:
            done = subprocess.run(
                [sys.executable, *arguments],
                env=os.environ | more,
                cwd=TOP,
                timeout=max(limit, 1.0),
                capture_output=True,
                text=True,
            )
        except subprocess.TimeoutExpired:
            return "", f"over {limit:.0f} s"
    if done.returncode:
        print(done.stdout[-1000:], done.stderr[-2000:], sep="\n", file=sys.stderr)
        return "", "failed"
    return done.stdout, ""


def stepped(work: str, batch: int, is_gpu: bool, limit: float) -> Done:
    """Configurations a second of a work of `studies bench`, and its time until then."""
    command = [*CLI, "bench", "--work", work, "--batch", str(batch), "--json"]
    text, fault = run(command, is_gpu, limit)
    if fault:
        return Done(fault)
    figures = json.loads(text)["figures"]
    first = figures["compile_s"] + figures["trace_s"]
    return Done(f"{figures['configs_per_s']:,.0f} after {first:.0f} s", [figures["fingerprint"]])


def judged(batch: int, is_gpu: bool, limit: float) -> Done:
    """Loops judged a second by `studies.batched`, and the time until then."""
    text, fault = run([__file__, "--judge", str(batch)], is_gpu, limit)
    if fault:
        return Done(fault)
    first, seconds, margins = json.loads(text)
    return Done(f"{batch / seconds:,.0f} after {first:.0f} s", margins)


def judge(batch: int) -> None:
    """Print the times of the first and of a later call, and margins."""
    import jax
    import numpy as np

    import studies
    from studies.space.spec import parse_sweep

    studies.configure()
    study = parse_sweep(tomllib.loads(SWEEP.format(count=1, more=""))).study
    both = jax.jit(studies.batched(study, ["control.gain_factor"], is_judged=True))
    values, times = np.geomspace(0.1, 3.0, batch)[:, None], []
    for _ in range(2):
        began = time.perf_counter()
        margins = np.asarray(jax.block_until_ready(both(values))[1].gain_margin)
        times.append(time.perf_counter() - began)
    print(json.dumps([*times, margins.tolist()]))


def swept(spec: str, is_gpu: bool, limit: float) -> Done:
    """Time of a sweep, start and compiling included."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "spec.toml"
        file.write_text(spec, encoding="utf-8")
        began = time.perf_counter()
        given = [*CLI, "sweep", str(file), "--out", str(Path(folder) / "out"), "--no-progress"]
        _, fault = run(given, is_gpu, limit)
        return Done(fault or f"{time.perf_counter() - began:.0f} s")


def works(share: int) -> dict[str, Callable[[bool, float], Done]]:
    """What is measured, by the words of its row, with this share of the cases."""

    def at_once(n: int) -> str:
        return f"{n // share:,} at once, per second"

    found: dict[str, Callable[[bool, float], Done]] = {}
    for name, batch in WORKS.items():
        found[f"{name}, {at_once(batch)}"] = lambda *a, n=name, b=batch: stepped(n, b // share, *a)
    found[f"loops judged (on one core), {at_once(JUDGED)}"] = lambda *a: judged(JUDGED // share, *a)
    keep = 'keep = 100\nmargin = 0.0\nfidelity = "linear"'
    for more, count, what in (
        ("", CASES // share, "sweep of {:,} judged cases"),
        (keep, DESIGNS // share, "sweep that keeps 100 of {:,} designs"),
    ):
        spec = SWEEP.format(count=count, more=more)
        found[what.format(count)] = lambda *a, s=spec: swept(s, *a)
    return found


def difference(a: Done, b: Done) -> float | None:
    """Largest relative difference of results, None where a side has none."""
    if a.results is None or b.results is None:
        return None
    pairs = zip(a.results, b.results, strict=True)
    return max(abs(x - y) / max(abs(x), abs(y), 1e-300) for x, y in pairs)


def devices() -> str:
    """What JAX computes on here; "" for processors."""
    ask = "import jax; d = jax.devices(); print('' if d[0].platform == 'cpu' else d[0].device_kind)"
    return run(["-c", ask], True, ONE)[0].strip()


def measure(device: str, began: float) -> tuple[list[str], bool]:
    """Lines of the table, and whether both sides agree wherever both have results."""
    side = device or STAND_IN
    lines = [
        f"| | {side} | {len(os.sched_getaffinity(0))} cores | difference |",
        "|---|---|---|---|",
    ]
    agree = True
    print(*lines, sep="\n", flush=True)
    for name, work in works(1 if device else 16).items():
        sides = [work(x, min(ONE, ALL - (time.monotonic() - began))) for x in (True, False)]
        apart = difference(*sides)
        agree &= apart is None or apart <= EQUAL
        said = "" if apart is None else f"{apart:.1e}"
        lines.append(f"| {name} | {sides[0].said} | {sides[1].said} | {said} |")
        print(lines[-1], flush=True)
    return lines, agree


def write(lines: list[str]) -> bool:
    """Put the table into the page, between its marks; whether it belongs there."""
    before, rest = PAGE.read_text(encoding="utf-8").split(MARKS[0])
    present, after = rest.split(MARKS[1])
    if STAND_IN in lines[0] and STAND_IN not in present:
        return False
    text = "\n".join(("", *lines, "", ""))
    PAGE.write_text(f"{before}{MARKS[0]}{text}{MARKS[1]}{after}", encoding="utf-8")
    return True


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--judge", type=int, help=argparse.SUPPRESS)
    if (batch := parser.parse_args().judge) is not None:
        judge(batch)
        return 0
    began = time.monotonic()
    device = devices()
    tests = ["-m", "pytest", "-q", "-x", "-n", "4", "tests/studies/kernels/test_gpu_kernel.py"]
    _, fault = run(tests, bool(device), ONE)
    print(f"tests of the GPU kernel: {fault or 'passed'}\n", flush=True)
    lines, agree = measure(device, began)
    if write(lines):
        print(f"written into {PAGE.relative_to(TOP)}")
    return int(not agree or bool(fault))


if __name__ == "__main__":
    sys.exit(main())
