"""The page for scripts: its example runs as written, its table names commands that there are."""

import contextlib
import io
import re
import shlex
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer

from studies.cli import app
from studies.documents import DOCUMENTS
from studies.space.spec import parse_sweep
from studies.study.template import toml_text
from tests import TOP
from tests.canonical import MACHINE
from tests.studies.test_cli import run

PAGE = (TOP / "docs" / "how-to" / "automation.md").read_text(encoding="utf-8")


def block(language):
    (text,) = re.findall(rf"^```{language}\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    return text


SWEEP = tomllib.loads(block("toml"))


@pytest.mark.parametrize(
    "study", [MACHINE | {"sweep": SWEEP["sweep"]}, pytest.param(SWEEP, marks=pytest.mark.long)]
)
def test_the_example_runs(capsys, tmp_path, monkeypatch, study):
    """In short with a smaller study."""
    monkeypatch.chdir(tmp_path)
    parse_sweep(SWEEP)
    Path("small.toml").write_text(toml_text(study))
    for line in block("sh").splitlines():
        call, target = re.fullmatch(r"(?:timeout \d+ )?(.*?)(?: > (\S+\.json))?", line).groups()
        name, *arguments = shlex.split(call)
        code, out, err = run(capsys, *arguments)
        assert (name, code, err) == ("studies", 0, ""), line
        assert out
        if target:
            Path(target).write_text(out)
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(block("python"), {})
    assert "gain factor" in printed.getvalue() and "warnings []" in printed.getvalue()
    quick_commands_need_no_jax(tmp_path / "small")


def quick_commands_need_no_jax(folder):
    """Nor drawing, nor SciPy, unless failures are looked into: they would wait seconds for it."""
    code = (
        "import sys\n"
        "from studies.cli import main\n"
        f"sweep = {str(folder)!r}\n"
        "for command in (['--help'], ['init'], ['show', sweep], ['show', sweep, '--json'],\n"
        "    ['best', '--by', 'residual_rms', sweep],\n"
        "    ['best', '--by', 'residual_rms', sweep, '--json']):\n"
        "    try:\n"
        "        main(command)\n"
        "    except SystemExit as end:\n"
        "        assert not end.code\n"
        "slow = {'jax', 'llvmlite', 'matplotlib', 'pandas', 'scipy', 'xarray'}\n"
        "print(sorted(slow & set(sys.modules)), file=sys.stderr)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr.strip()) == (0, "[]")
    assert "velocity_gain" in done.stdout


def test_calls_and_their_options_exist():
    commands = typer.main.get_command(app).commands
    rows = re.findall(r"^\| (`.*?) \|", PAGE, re.MULTILINE)
    calls = [call for row in rows for call in re.findall(r"`([^`]+)`", row)]
    assert len(calls) > 15
    for call in calls:
        name, *words = call.replace("[", "").replace("]", "").split()
        params = commands[name].params
        known = {opt for x in params for opt in (*x.opts, *x.secondary_opts)}
        assert {word for word in words if word.startswith("--")} <= known, call
    told = {call.split()[0] for call in calls if "--json" in call}
    in_files = {"commission", "comparison", "fit", "compare", "paper", "certify", "summary"}
    assert told == set(DOCUMENTS) - in_files - {"bench"}
