"""Numbers of all shipped studies, to compare two checkouts before a large change is committed.

    python -m campaigns.before_after write OUT      (in the root of each checkout)
    python -m campaigns.before_after compare OUT OTHER

Runs every ready design, sweep and certificate, one tuning and the exported controllers. Files of
numbers must agree within 1e-12 of each array's largest entry, exported C but for its comments.
"""

from __future__ import annotations

import json
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

TOLERANCE = 1e-12
#: What names the code in JSON, and so differs.
VOLATILE = ("code", "git", "results", "study_hash")
DESIGNS = ("paper", "paper_gains", "difference", "disturbance", "measured")
SWEEPS = ("placement", "gains", "links", "mistuning", "models", "robustness", "spillover")
TUNING = "tune_placement"
TARGETS = ("json", "c", "c-fixed")


def jobs(out: Path) -> Iterator[tuple[str, ...]]:
    for name in DESIGNS:
        yield "simulate", name, "--out", str(out / f"{name}.h5")
    for name in SWEEPS:
        yield "sweep", name, "--out", str(out / f"sweep_{name}"), "--no-progress"
    yield "tune", TUNING, "--out", str(out / "tuning")
    for name in DESIGNS[:3]:
        yield "certify", name, "--out", str(out / f"certificate_{name}")
    for target in TARGETS:
        for name in ("paper", "measured"):
            yield "export", name, "--target", target, "--out", str(out / f"{target}_{name}")


def write(out: Path) -> None:
    out.mkdir(parents=True)
    for job in jobs(out):
        # a certificate that is refused ends in 1
        ended = subprocess.run(
            [sys.executable, "-c", "from studies.cli import main; main()", *job],
            stdout=subprocess.DEVNULL,
            timeout=3600,
        )
        print(*job, "->", ended.returncode, flush=True)


def compare(out: Path, other: Path) -> list[str]:
    """What differs, in words."""
    names = {path.relative_to(out) for path in out.rglob("*") if path.is_file()}
    faults = []
    for name in sorted(names):
        reader = READERS.get(name.suffix)
        if reader is None:
            continue
        if not (other / name).exists():
            faults.append(f"{name}: not there")
            continue
        one, two = reader(out / name), reader(other / name)
        faults += [f"{name}: {key} is new" for key in two.keys() - one.keys()]
        faults += [f"{name}: {key} is gone" for key in one.keys() - two.keys()]
        for key in one.keys() & two.keys():
            fault = difference(one[key], two[key])
            if fault:
                faults.append(f"{name}: {key}: {fault}")
    return faults


def difference(one: Any, two: Any) -> str:
    if not isinstance(one, np.ndarray) or one.dtype.kind not in "fc":
        return "" if np.array_equal(one, two) else "differs"
    if one.shape != two.shape:
        return f"shape {one.shape}, {two.shape}"
    if not np.array_equal(np.isfinite(one), np.isfinite(two)):
        return "finite elsewhere"
    is_there = np.isfinite(one)
    scale = np.abs(one[is_there]).max(initial=0.0)
    error = np.abs(one[is_there] - two[is_there]).max(initial=0.0)
    return f"{error / scale:.1e}" if error > TOLERANCE * scale else ""


def arrays(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        if isinstance(item, h5py.Dataset):
            found[_name_before(name)] = np.asarray(item[()])

    with h5py.File(path) as file:
        file.visititems(visit)
    return found


def _name_before(name: str) -> str:
    """A variable's name before the files took those of fields: `control_gain_factor`."""
    plain = re.sub(r"\W+", "_", name).strip("_").removeprefix("scenario_")
    return re.sub("^(link_subset|link_mode_mask)s$", r"\1", plain)


def numbers(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = {}

    def visit(name: str, item: Any) -> None:
        pairs = item.items() if isinstance(item, dict) else enumerate(item)
        for key, value in pairs:
            at = f"{name}/{key}"
            if key in VOLATILE:
                continue
            if isinstance(value, dict | list):
                visit(at, value)
            elif isinstance(value, float):
                found[at] = np.array(value)
            else:
                found[at] = value

    visit("", json.loads(path.read_text()))
    return found


def code(path: Path) -> dict[str, Any]:
    """C without its comments."""
    return {"text": re.sub(r"/\*.*?\*/|//[^\n]*", "", path.read_text(), flags=re.DOTALL)}


READERS = {".h5": arrays, ".json": numbers, ".c": code, ".h": code}

if __name__ == "__main__":
    if sys.argv[1] == "write":
        write(Path(sys.argv[2]))
    else:
        found = compare(Path(sys.argv[2]), Path(sys.argv[3]))
        print(*found or ["equal"], sep="\n")
        sys.exit(bool(found))
