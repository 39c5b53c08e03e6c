"""`python .ci/processor_time.py`: processor time of the commands with warm caches, as a table.

Every command runs twice in a temporary folder, with a cache of compiled programs of its own; the
second run counts, user and system time of the process and its children [s]. `--against CHECKOUT`
runs the commands of another checkout in turn, for ratios. Exits with 1 if a limit is exceeded.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

TOP = Path(__file__).parents[1]
SHORT = "run = { duration = 0.2 }\nmetrics = { residual_length = 0.05 }\n"
#: The tuning of docs/tutorials/tune.md, shorter.
TUNING = """
run = { duration = 0.15 }
motion = { waypoints = [[0.0, 0.0, 0.5236], [0.0, 0.01, 0.5236]] }
metrics = { residual_length = 0.08 }
[tune]
iterations = 15
[tune.free]
"control.velocity_gain" = { from = 0.1, to = 40.0, scale = "log" }
placement = { kind = "same" }
[tune.objective]
residual_rms = 1.0
[tune.limits]
peak_voltage = "baseline"
gain_margin = 2.5
[tune.scenarios]
count = 4
spread = { "link.stiffness_factor" = 5.0 }
"""


class Timed(NamedTuple):
    """A command and its limit [s]; "{out}" is a new folder."""

    words: str
    limit: float | None = None
    is_slow: bool = False


COMMANDS = (
    Timed("modes", 1.5),
    Timed("sweep gains --dry-run", 1.5),
    Timed("show gains", 1.5),
    Timed("best gains --by residual_rms", 1.5),
    Timed("plot gains --out {out}.png", 2.5),
    Timed("simulate short.toml --out {out}.h5", 3.0),
    Timed("export paper --target c --out {out}", 6.0),
    Timed("certify paper --out {out}", 25.0),
    Timed("tune calm.toml --out {out} --no-progress", is_slow=True),
    Timed("fit paper_measured --out {out}", is_slow=True),
)
#: Limits of the first cases of a sweep [s], without and with compiled programs on disk.
FIRST_COLD, FIRST_WARM = 10.0, 3.0


class Checkout:
    """A tree of the sources, with folders and caches of its own."""

    def __init__(self, top: Path, folder: Path) -> None:
        self.folder = folder
        folder.mkdir()
        (folder / "short.toml").write_text(SHORT)
        (folder / "calm.toml").write_text(TUNING)
        self._environment = {**os.environ, "PYTHONPATH": str(top), "OPENBLAS_NUM_THREADS": "1"}
        self._environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        self._environment["XDG_CACHE_HOME"] = str(folder / "cache")
        self._outputs = 0

    def start(self, words: str) -> subprocess.Popen[bytes]:
        self._outputs += 1
        arguments = words.format(out=f"out{self._outputs}").split()
        command = [sys.executable, "-c", "from studies.cli import main; main()", *arguments]
        with open(self.folder / "log", "wb") as log:
            return subprocess.Popen(
                command, cwd=self.folder, env=self._environment, stdout=log, stderr=log
            )

    def time_command(self, words: str) -> float:
        """User and system time [s]."""
        process = self.start(words)
        _, code, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(code)
        # a certificate that is refused ends in 1
        if process.returncode not in (0, 1):
            sys.exit(
                f"{words}: exit code {process.returncode}\n{(self.folder / 'log').read_text()}"
            )
        return used.ru_utime + used.ru_stime

    def time_first_cases(self) -> float:
        """User and system time of `sweep gains` until its first cases are on disk [s]."""
        out = self.folder / "first"
        shutil.rmtree(out, ignore_errors=True)
        process = self.start("sweep gains --out first --no-progress")
        while process.poll() is None and not list(out.glob("*/*.h5")):
            time.sleep(0.02)
        seconds = process_time(process.pid) if process.returncode is None else float("nan")
        process.kill()
        process.wait()
        return seconds


def process_time(pid: int) -> float:
    """User and system time of a running process [s]."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def measure(checkouts: list[Checkout], has_slow: bool) -> bool:
    """Print the table; whether all limits of the first checkout are kept."""
    is_kept = True

    def show(name: str, seconds: list[float], limit: float | None) -> None:
        nonlocal is_kept
        is_kept &= limit is None or seconds[0] <= limit
        cells = [f"{name:40}", *(f"{x:8.2f}" for x in seconds)]
        if len(seconds) == 2:
            cells.append(f"{seconds[0] / seconds[1]:5.2f}")
        print(*cells, "" if limit is None else f"{limit:6.1f}", flush=True)

    heads = [f"{'command':40}", "  here [s]", *["other [s] ratio"] * (len(checkouts) > 1)]
    print(*heads, "limit [s]")
    show("first cases of sweep gains, cold", [x.time_first_cases() for x in checkouts], FIRST_COLD)
    for checkout in checkouts:
        checkout.time_command("sweep gains --out gains --no-progress")
    show("first cases of sweep gains, warm", [x.time_first_cases() for x in checkouts], FIRST_WARM)
    for words, limit, is_slow in COMMANDS:
        if is_slow and not has_slow:
            continue
        for checkout in checkouts:
            checkout.time_command(words)
        show(words, [x.time_command(words) for x in checkouts], limit)
    return is_kept


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--against", type=Path, help="another checkout to compare with")
    parser.add_argument("--slow", action="store_true", help="also a tuning and a fit: minutes")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        tops = [TOP] + ([options.against.resolve()] if options.against else [])
        checkouts = [Checkout(top, Path(folder) / str(k)) for k, top in enumerate(tops)]
        sys.exit(not measure(checkouts, options.slow))


if __name__ == "__main__":
    main()
