"""The wheel's main job on every supported Python here, and the core tests on all but this one.

    .venv/bin/python .ci/smoke.py [--limit SECONDS]

A wheel is built from a clean checkout of the last commit and installed into an empty environment
for each Python, `.venv-VERSION`. There, outside the repository and with an empty cache, it does
what the README begins with. They run side by side. Exit code 1 if one fails or the time is over.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

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
#: Version of this interpreter, whose core tests `make test` runs.
OWN = "{}.{}".format(*sys.version_info)
#: Kernels, batches, the foreign function interface, tuning: the quick ones of their tests.
FILES = (
    *("kernels/test_equations", "kernels/test_kernel", "kernels/test_tangents"),
    *("engine/test_batch", "engine/test_batched", "tuning/test_tuning"),
)
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
    """This interpreter, and other supported ones with venv, one for each version."""
    found = {OWN: Path(sys.executable)}
    for path in candidates():
        version = path.name.removeprefix("python")
        if version not in found and is_usable(path, version):
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

    def __init__(self, version: str, python: Path, wheel: Path, until: float) -> None:
        self.version, self.python, self.wheel, self.until = version, python, wheel, until
        self.bin = TOP / f".venv-{version}" / "bin"
        self.work = Path(tempfile.mkdtemp(prefix=f"smoke-{version}-"))

    def run(self) -> str:
        """Run everything; returns what failed, "" if nothing."""
        started = time.monotonic()
        try:
            self.call(self.python, "-m", "venv", "--clear", self.bin.parent)
            self.install(self.wheel)
            facts = self.main_job()
            if self.version != OWN:
                self.install(f"flexlink-studies[test] @ {self.wheel.as_uri()}")
                facts += self.tests()
        except AssertionError as error:
            return f"Python {self.version}: {error}"
        finally:
            shutil.rmtree(self.work, ignore_errors=True)
        print(f"smoke: Python {self.version}: {facts}; {time.monotonic() - started:.0f} s")
        return ""

    def install(self, wanted: object) -> None:
        """Install something and what it needs, in the versions of contributors."""
        quiet = ("--quiet", "--disable-pip-version-check", "--no-compile")
        constraints = ("-c", TOP / "constraints.txt")
        self.call(self.bin / "python", "-m", "pip", "install", *quiet, *constraints, wanted)

    def main_job(self) -> str:
        """The first example, a sweep with its report, its best case as a controller."""
        readme = (TOP / "README.md").read_text(encoding="utf-8")
        example = re.search("```python\n(.*?)```", readme, re.DOTALL)
        assert example, "README.md has no example in Python"
        said = self.call(self.bin / "python", "-c", example[1])
        assert "with control" in said and list(self.work.glob("*.png")), said
        said = self.studies("sweep", "gains", "--out", "gains", "--report")
        assert "executor: traced kernel" in said, f"the sweep ran without the kernel:\n{said}"
        assert "216/216 cases" in said, f"cases are missing:\n{said}"
        assert (self.work / "gains" / "report.html").stat().st_size > 1e5
        safe = ("--subject-to", "gain_margin > 2")
        best = self.document("best", "gains", "--by", "residual_rms", *safe)["cases"][0]["case"]
        target = "c" if shutil.which("cc") else "json"
        said = self.studies("export", "gains", "--case", best, "--target", target, "--out", "dsp")
        assert target == "json" or "verified: " in said, said
        kept = self.document("cache", "--clear")["kinds"]
        assert sum(kind["files"] for kind in kept), "no compiled program was kept"
        return self.versions()

    def versions(self) -> str:
        """Versions of what computes, which must be tested ones."""
        code = "import studies, studies.config as c; print(studies.__file__); print(c.untested())"
        path, untested = self.call(self.bin / "python", "-c", code).split()[:2]
        assert str(self.bin.parent) in path, f"not the wheel ran, but {path}"
        assert untested == "none", f"add to studies.config.TESTED what runs here: {untested}"
        code = "import jax, numpy; print('JAX', jax.__version__, 'NumPy', numpy.__version__)"
        return self.call(self.bin / "python", "-c", code).strip()

    def tests(self) -> str:
        """The core tests; returns the closing line."""
        files = [f"tests/studies/{name}.py" for name in FILES]
        chosen = " or ".join(f"({name})" for name in TESTS)
        pytest = (self.bin / "python", "-m", "pytest", "-q", "-p", "no:cacheprovider")
        kept = f"JAX_COMPILATION_CACHE_DIR={self.work / 'programs'}"
        said = self.call("env", kept, *pytest, *files, "-k", chosen, cwd=TOP)
        return ", " + said.strip().splitlines()[-1]

    def studies(self, *arguments: object) -> str:
        return self.call(self.bin / "studies", *arguments)

    def document(self, *arguments: object) -> Any:
        """What a command prints with --json."""
        command = (self.bin / "studies", *arguments, "--json")
        return json.loads(self.call(*command, stderr=subprocess.DEVNULL))

    def call(self, *command: object, cwd: Path | None = None, **options: Any) -> str:
        """Run a command to its end or the time limit, outside the repository."""
        environment = {name: x for name, x in os.environ.items() if name != "PYTHONPATH"}
        environment |= {"XDG_CACHE_HOME": str(self.work / "cache"), "MPLBACKEND": "agg"}
        return call(*command, until=self.until, cwd=cwd or self.work, env=environment, **options)


def call(*command: object, until: float, **options: Any) -> str:
    """Run a command to its end or a time of the monotonic clock; returns what it printed."""
    process = subprocess.Popen(
        list(map(str, command)),
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        **({"stderr": subprocess.STDOUT} | options),
    )
    name = " ".join(Path(str(x)).name for x in command[:4])
    try:
        said, _ = process.communicate(timeout=max(1.0, until - time.monotonic()))
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        raise AssertionError(f"{name}: not done within the time limit") from None
    assert process.returncode == 0, f"{name}: exit code {process.returncode}\n{said[-4000:]}"
    return said


def build_wheel(folder: Path, until: float) -> Path:
    """The wheel of a clean checkout of the last commit."""
    source, archive = folder / "source", folder / "source.tar"
    call("git", "archive", "--output", archive, "HEAD", until=until, cwd=TOP)
    shutil.unpack_archive(archive, source, filter="data")
    quiet = ("--quiet", "--disable-pip-version-check", "--no-deps")
    call(sys.executable, "-m", "pip", "wheel", *quiet, "-w", folder, source, until=until)
    (wheel,) = folder.glob("*.whl")
    return wheel


def main() -> None:
    parser = argparse.ArgumentParser(description="The wheel on all Pythons; core tests.")
    parser.add_argument("--limit", type=float, default=1800.0, help="time for all of them [s]")
    until = time.monotonic() + parser.parse_args().limit
    found = pythons()
    print(f"smoke: Python {', '.join(sorted(found))}")
    with tempfile.TemporaryDirectory() as folder:
        wheel = build_wheel(Path(folder), until)
        runs = [Smoke(version, path, wheel, until) for version, path in sorted(found.items())]
        with ThreadPoolExecutor(len(runs)) as pool:
            failures = [text for text in pool.map(Smoke.run, runs) if text]
    for text in failures:
        print(f"smoke: {text}")
    sys.exit(bool(failures))


if __name__ == "__main__":
    main()
