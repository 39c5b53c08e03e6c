"""Where the command line prints: widths, closed and full outputs, backends of figures."""

import os
import subprocess
import sys

import pytest

from studies import documents

#: Runs the command line, and nothing else.
STUDIES = "from studies.cli import main; main()"


def run_process(*arguments, redirect="", **variables):
    """Exit code, standard output and standard error of a process of its own, from a shell."""
    done = subprocess.run(
        ["sh", "-c", f'"$@" {redirect}', "sh", sys.executable, "-c", STUDIES, *arguments],
        env=os.environ | {"PYTHONUNBUFFERED": ""} | variables,
        capture_output=True,
        text=True,
        timeout=120,
    )
    return done.returncode, done.stdout, done.stderr


@pytest.mark.parametrize("columns", ["0", "00", ""])
def test_a_terminal_without_width_hides_nothing(columns):
    code, out, err = run_process("schema", COLUMNS=columns)
    assert (code, err) == (0, "")
    assert out.split() == list(documents.DOCUMENTS)


@pytest.mark.parametrize("command", [["schema"], ["--version"], ["schema", "paper"]])
def test_a_closed_output_is_a_message(command):
    code, _, err = run_process(*command, redirect=">&-")
    assert code == 2
    assert err == "studies: standard output: closed; send it to a file or to /dev/null\n"


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full")
@pytest.mark.parametrize("buffered", ["", "1"])
@pytest.mark.parametrize("command", [["schema"], ["--help"], ["init"], ["cache", "--json"]])
def test_a_full_output_is_a_message(command, buffered):
    code, _, err = run_process(*command, redirect=">/dev/full", PYTHONUNBUFFERED=buffered)
    assert code == 2
    assert err == "studies: standard output: cannot be written to (No space left on device)\n"


def test_a_reader_that_has_enough_is_no_fault():
    """A pipe whose reader is gone: `head` takes what it wants."""
    code, _, err = run_process("init", redirect="| true; echo $? >&2")
    assert (code, err) == (0, "0\n")


def test_messages_find_their_way_without_standard_error():
    code, out, _ = run_process("simulate", "no_file", "--out", "x.h5", redirect="2>&-")
    assert (code, out) == (2, "")


def test_an_unknown_backend_of_figures_is_not_asked_for(tmp_path):
    code, _, err = run_process(
        "plot", str(tmp_path), "--out", str(tmp_path / "x.png"), MPLBACKEND="none_such"
    )
    assert code == 2
    assert err.startswith(f"studies: {tmp_path}: not the folder of a sweep")
