"""The page for scripts: its example runs as written, its table names commands that there are."""

import contextlib
import io
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import typer

from studies.cli import app
from studies.show.document import documented
from tests import TOP
from tests.studies.test_cli import run

PAGE = (TOP / "docs" / "how-to" / "automation.md").read_text(encoding="utf-8")


def block(language):
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return text


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("automation")


def test_the_example_runs_as_written(capsys, folder, monkeypatch):
    monkeypatch.chdir(folder)
    Path("small.toml").write_text(block("toml"))
    for line in block("sh").splitlines():
        call, target = re.fullmatch(r"(?:timeout \d+ )?(.*?)(?: > (\S+\.json))?", line).groups()
        name, *arguments = shlex.split(call)
        code, out, err = run(capsys, *arguments)
        assert (name, code, err) == ("studies", 0, ""), line
        if target:
            Path(target).write_text(out)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(block("python"), {})
    assert "gain factor" in printed.getvalue() and "warnings []" in printed.getvalue()
    reading_needs_no_jax(folder)


def reading_needs_no_jax(folder):
    """Nor SciPy, unless failures are looked into."""
    code = (
        "import sys\n"
        "from studies.cli import main\n"
        "for command in (['show'], ['best', '--by', 'residual_rms']):\n"
        "    for more in ([], ['--json']):\n"
        f"        main([*command, {str(folder / 'small')!r}, *more])\n"
        "slow = {'jax', 'llvmlite', 'matplotlib', 'pandas', 'scipy', 'xarray'}\n"
        "print(sorted(slow & set(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr.strip()) == (0, "[]")


def test_calls_and_their_options_exist():
    commands = typer.main.get_command(app).commands
    rows = re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE)
    calls = [call for row in rows for call in re.findall(r"`([^`]+)`", row)]
    assert len(calls) > 15
    for call in calls:
        name, *words = call.replace("[", "").replace("]", "").split()
        known = {opt for parameter in commands[name].params for opt in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known, call
    told = {call.split()[0] for call in calls if "--json" in call}
    assert told == set(documented()) - {
        "commission",
        "comparison",
        "fit",
        "laws",
        "paper",
        "spillover",
        "bench",
    }
