"""The folder of a tuning: its request (`tune.json`) and progress (`progress.npz`)."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from studies.engine.folder import TUNING, TUNINGS, locked_folder, refuse_existing
from studies.errors import StudyError
from studies.publish import check_target, replacing
from studies.reading import read_json, read_npz
from studies.study.files import is_as_written, signed
from studies.study.spec import Study
from studies.study.template import study_template
from studies.tuning.optimise import Progress

MANIFEST, PROGRESS, RESULTS = TUNING, "progress.npz", "tune.h5"
#: Entries of the manifest that a resumed tuning must share to continue bit by bit.
CHECKED = {"spec": "tuning file", "code": "program", "jaxlib": "jaxlib", "precision": "precision"}


@contextmanager
def open_tuning(out: Path, manifest: dict[str, Any], is_resumed: bool) -> Iterator[Progress | None]:
    """Create or check the folder and lock it; yields the progress of an interrupted tuning.

    Raises:
        StudyError: not writable, in use, holds something else or a different tuning.
    """
    with locked_folder(out, "tuning"):
        path, before = out / MANIFEST, None
        refuse_existing(out, TUNINGS, is_resumed)
        if path.is_file():
            try:
                old = read_json(path)
            except (OSError, ValueError):
                raise StudyError(f"{path}: damaged; name a new folder") from None
            now = json.loads(json.dumps(manifest))
            for key, what in CHECKED.items():
                if not isinstance(old, dict) or _fixed_part(old.get(key)) != _fixed_part(now[key]):
                    raise StudyError(
                        f"--out {out}: was begun with another {what}; name a new folder"
                    )
            before = load_progress(out / PROGRESS)
            if before is not None:
                _refuse_edited(out)
        for left in out.iterdir():  # only once their owner is known
            if TUNINGS.leftover.fullmatch(left.name) and left.is_file():
                left.unlink()
        check_target(out / RESULTS)
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        try:
            yield before
        except StudyError:
            if not (out / PROGRESS).exists():  # nothing to continue, so a corrected file can start
                path.unlink(missing_ok=True)
            raise


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


def _refuse_edited(out: Path) -> None:
    """Raise StudyError if resuming would overwrite what somebody has edited."""
    for path in sorted(out.glob("tuned*.toml")):
        if not is_as_written(path):
            raise StudyError(
                f"{path}: edited since the tuning has written it; --resume would overwrite it: "
                "move it to another folder"
            )


def _fixed_part(part: Any) -> Any:
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
