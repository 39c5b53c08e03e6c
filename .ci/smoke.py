"""The main job and the core tests on every other supported Python that this machine has.

    .venv/bin/python .ci/smoke.py [--limit SECONDS]

Each Python gets an environment of its own, `.venv-VERSION`, and they run side by side. Exit code 1
if one fails or the time is over; 0 if there is no other Python, which is said.
"""

from __future__ import annotations

import argparse
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from studies.config import TESTED

TOP = Path(__file__).resolve().parents[1]
SUPPORTED = TESTED["python"]
#: Where version managers keep interpreters, below the home folder or the root.
PLACES = (
    ".pyenv/versions/*/bin",
    ".local/share/uv/python/*/bin",
    ".local/share/mise/installs/python/*/bin",
    ".asdf/installs/python/*/bin",
    "miniconda3/envs/*/bin",
    "miniforge3/envs/*/bin",
    "opt/hostedtoolcache/Python/*/x64/bin",
    "opt/python/*/bin",
    "usr/local/bin",
    "usr/bin",
)
#: Kernels, batches, the foreign function interface, tuning: the quick ones of their tests.
FILES = ("equations", "kernel", "tangents", "batch", "batched", "tuning")
TESTS = (
    "test_equations and not gradients and not sweep",
    "translated",
    "not_a_number",
    "every_operation",
    "order_and_neighbours",
    "bad_members",
    "equals_the_scan",
    "both_modes",
    "goes_downhill",
)


def pythons() -> dict[str, Path]:
    """Other supported interpreters with venv, one for each version."""
    own = "{}.{}".format(*sys.version_info)
    found: dict[str, Path] = {}
    for path in candidates():
        version = path.name.removeprefix("python")
        if version != own and version not in found and is_usable(path, version):
            found[version] = path
    return found


def candidates() -> Iterator[Path]:
    """Everything that looks like a supported interpreter."""
    folders = map(Path, os.environ.get("PATH", "").split(os.pathsep))
    roots = [Path.home(), Path("/")]
    managed = (folder for root in roots for place in PLACES for folder in root.glob(place))
    pyenv = Path(os.environ.get("PYENV_ROOT", "/nonexistent")).glob("versions/*/bin")
    for folder in (*folders, *pyenv, *managed):
        for version in SUPPORTED:
            if (path := folder / f"python{version}").exists():
                yield path


def is_usable(path: Path, version: str) -> bool:
    """Whether an interpreter starts, is of that version and can make environments."""
    code = "import sys, ensurepip, venv; print('{}.{}'.format(*sys.version_info))"
    try:
        done = subprocess.run([path, "-c", code], capture_output=True, text=True, timeout=30)
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0 and done.stdout.strip() == version


class Smoke:
    """What runs on one Python, until a time of the monotonic clock."""

    def __init__(self, version: str, python: Path, until: float) -> None:
        self.version, self.python, self.until = version, python, until
        self.folder = TOP / f".venv-{version}"
        self.work = Path(tempfile.mkdtemp(prefix=f"smoke-{version}-"))

    def run(self) -> str:
        """Run everything; returns what failed, "" if nothing."""
        started = time.monotonic()
        try:
            self.install()
            facts = self.main_job()
            facts += self.tests()
        except AssertionError as error:
            return f"Python {self.version}: {error}"
        finally:
            shutil.rmtree(self.work, ignore_errors=True)
        print(f"smoke: Python {self.version}: {facts}; {time.monotonic() - started:.0f} s")
        return ""

    def install(self) -> None:
        """Make the environment."""
        if not (self.folder / "bin" / "python").exists():
            self.call(self.python, "-m", "venv", self.folder)
        quiet = ("--quiet", "--disable-pip-version-check", "--no-compile")
        wanted = ("-c", "constraints.txt", "-e", ".[test]")
        self.call(self.folder / "bin" / "python", "-m", "pip", "install", *quiet, *wanted)

    def main_job(self) -> str:
        """Sweep, report, rank and draw; the sweep must use the traced kernel."""
        spec = self.work / "placement.toml"
        text = (TOP / "studies" / "specs" / "placement.toml").read_text(encoding="utf-8")
        small = text.replace("count = 4096", "count = 64")
        assert small != text, "placement.toml has no count of 4096"
        spec.write_text(small, encoding="utf-8")
        out = self.work / "placement"
        said = self.studies("sweep", spec, "--out", out, "--report")
        assert "executor: traced kernel" in said, f"the sweep ran without the kernel:\n{said}"
        assert "64/64 cases" in said, f"cases are missing:\n{said}"
        self.studies("best", out, "--by", "residual_rms", "--count", "3")
        self.studies("plot", out, "--out", self.work / "best.png")
        python = self.folder / "bin" / "python"
        untested = self.call(
            python, "-c", "import studies.config as c; print(c.untested())"
        ).strip()
        assert untested == "none", f"add to studies.config.TESTED what runs here: {untested}"
        code = "import jax, numpy; print('JAX', jax.__version__, 'NumPy', numpy.__version__)"
        return self.call(python, "-c", code).strip()

    def tests(self) -> str:
        """The core tests; returns the closing line."""
        files = [f"tests/test_{name}.py" for name in FILES]
        chosen = " or ".join(f"({name})" for name in TESTS)
        pytest = (self.folder / "bin" / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider")
        said = self.call(*pytest, *files, "-k", chosen)
        return ", " + said.strip().splitlines()[-1]

    def studies(self, *arguments: object) -> str:
        return self.call(self.folder / "bin" / "studies", *arguments)

    def call(self, *command: object) -> str:
        """Run a command to its end or the time limit; returns what it printed."""
        process = subprocess.Popen(
            list(map(str, command)),
            cwd=TOP,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        name = " ".join(Path(str(x)).name for x in command[:4])
        try:
            said, _ = process.communicate(timeout=max(1.0, self.until - time.monotonic()))
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            raise AssertionError(f"{name}: not done within the time limit") from None
        assert process.returncode == 0, f"{name}: exit code {process.returncode}\n{said[-4000:]}"
        return said


def main() -> None:
    parser = argparse.ArgumentParser(description="Main job and core tests on other Pythons.")
    parser.add_argument("--limit", type=float, default=360.0, help="time for all of them [s]")
    limit = parser.parse_args().limit
    found = pythons()
    if not found:
        print(f"smoke: no Python of {', '.join(SUPPORTED)} here beside {sys.version.split()[0]}")
        return
    until = time.monotonic() + limit
    runs = [Smoke(version, path, until) for version, path in sorted(found.items())]
    with ThreadPoolExecutor(len(runs)) as pool:
        failures = [text for text in pool.map(Smoke.run, runs) if text]
    for text in failures:
        print(f"smoke: {text}")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
