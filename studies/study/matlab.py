"""MAT files (version 4 to 7), read in a process of their own with limits."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from studies.reading import LARGEST, parse_npz, read_bytes

#: The program that reads; not imported, since it needs SciPy.
READER = Path(__file__).with_name("unpack_mat.py")
#: Time to read a file [s].
PATIENCE = 60


def read_mat(path: Path, struct: str = "", most: int = LARGEST) -> dict[str, np.ndarray]:
    """Numbers and texts of a MAT file by name; matrices keep their two dimensions.

    Args:
        path: the file.
        struct: whose fields are meant, "" for the variables themselves.
        most: bytes that they may be together.

    Raises:
        OSError: not there, not readable, no regular file, too large.
        ValueError: damaged, of MATLAB 7.3, or no such struct.

    Example:
        >>> read_mat(Path("controller.mat"))["A"].shape  # doctest: +SKIP
        (4, 4)
    """
    content = read_bytes(path)
    command = [sys.executable, "-I", str(READER), *([struct] if struct else [])]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command, input=content, capture_output=True, timeout=PATIENCE, env=environment
        )
    except subprocess.TimeoutExpired:
        raise ValueError(f"damaged: not read within {PATIENCE} s") from None
    if done.returncode:
        lines = done.stderr.decode(errors="replace").splitlines()
        raise ValueError(lines[-1] if done.returncode == 1 and lines else "damaged")
    return {name[1:]: x for name, x in parse_npz(done.stdout, most).items()}
