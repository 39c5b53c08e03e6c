"""The Makefile installs into its own environment only."""

import os
import shutil
import subprocess
import sys

import pytest

from tests import TOP


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
def test_environment_left_half_made_is_made_again(tmp_path):
    # Without pyvenv.cfg, .venv/bin/python is the Python beneath it, and pip would install there.
    (tmp_path / ".venv/bin").mkdir(parents=True)
    (tmp_path / ".venv/bin/python").symlink_to(os.path.realpath(sys.executable))
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(TOP / name, tmp_path)
    command = ["make", "-n", f"PYTHON={sys.executable}", ".venv/installed"]
    run = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=True, timeout=60
    )
    assert "-m venv --clear .venv" in run.stdout
