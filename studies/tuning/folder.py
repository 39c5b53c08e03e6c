"""The folder of a tuning: its progress (`progress.npz`) and its designs."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np

from studies import job
from studies.errors import StudyError
from studies.publish import replacing
from studies.reading import read_npz
from studies.study.files import is_as_written, signed
from studies.study.spec import Study
from studies.study.template import study_template
from studies.tuning.optimise import Progress

PROGRESS, RESULTS = "progress.npz", "tune.h5"
#: Entries of the request that a resumed tuning must share to continue bit by bit, in words.
CHECKED = job.CHECKED | {"spec": "tuning file"}


def write_designs(out: Path, designs: dict[str, Study], written: dict[str, str]) -> dict[str, str]:
    """Write study files that differ from those written before.

    Args:
        out: the folder.
        designs: by the names of their files.
        written: texts of the files as they are, but for their titles.

    Returns:
        The same for `designs`.
    """
    texts = {name: study_template(study.change(title="")) for name, study in designs.items()}
    for name, text in texts.items():
        if written.get(name) != text:
            with replacing(out / name) as temporary:
                temporary.write_text(signed(study_template(designs[name])), encoding="utf-8")
    return texts


def refuse_edited(out: Path) -> None:
    """Raise StudyError if resuming would overwrite what somebody has edited."""
    for path in sorted(out.glob("tuned*.toml")):
        if not is_as_written(path):
            raise StudyError(
                f"{path}: edited since the tuning has written it; --resume would overwrite it: "
                "move it to another folder"
            )


def fixed_part(part: Any) -> Any:
    """What must not change: everything but the number of iterations, unless Adam uses it."""
    part = copy.deepcopy(part)
    tune = part.get("tune") if isinstance(part, dict) else None
    if isinstance(tune, dict) and tune.get("method", "lbfgs") == "lbfgs":
        tune.pop("iterations", None)
    return part


def save_progress(path: Path, at: Progress) -> None:
    """Save the progress of a tuning, whole or not at all."""
    arrays = {f"descent_{k}": leaf for k, leaf in enumerate(at.descent)}
    arrays |= {name: getattr(at, name) for name in at._fields if name != "descent"}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_progress(path: Path) -> Progress | None:
    """Saved progress of a tuning; None if there is none.

    Raises:
        StudyError: damaged.
    """
    if not path.is_file():
        return None
    try:
        data = read_npz(path)
        count = sum(name.startswith("descent_") for name in data)
        state = tuple(data[f"descent_{k}"] for k in range(count))
        rest = {name: data[name] for name in Progress._fields if name != "descent"}
        return Progress(**rest, descent=state)
    except (OSError, ValueError, TypeError, KeyError):
        raise StudyError(f"{path}: damaged; name a new folder") from None
