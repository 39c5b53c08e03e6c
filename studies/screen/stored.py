"""What a folder keeps of a screen: the request, the tally so far, and the best as a sweep."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from studies.engine.folder import SCREEN
from studies.errors import StudyError
from studies.job import keep_request, make_request
from studies.results.labelled import Variables
from studies.screen.shards import ScreenRequest
from studies.screen.tally import BUCKETS, GROWTH, LEAST, N_ENDINGS, Tally, nothing
from studies.space.axes import LABELS
from studies.space.spec import SELECTING, SPREADING, SweepSpec, parse_sweep
from studies.space.table import CaseTable, as_python
from studies.store import numbers_digest, read_store, write_store

TALLY = "screen.h5"
#: What must be the same in a folder that is gone on with.
_CHECKED = {
    "screened": "sweep",
    "shard_size": "size of shards",
    "code": "program",
    "precision": "--precision",
    "jaxlib": "version of jaxlib",
}


def begin(folder: Path, screen: ScreenRequest) -> tuple[np.ndarray, Tally]:
    """Begin a screen in a folder, or go on with it; other designs may be kept by then.

    Args:
        folder: of the screen, locked.
        screen: what is asked for.

    Returns:
        which shards are done, (n,); their tally.

    Raises:
        StudyError: the folder was begun with another screen, or its file is damaged.
    """
    request = make_request(screen.spec.data, ("studies.screen.shards",)) | _asked(screen)
    keep_request(folder / SCREEN, request, _CHECKED)
    if not (folder / TALLY).is_file():
        return np.zeros(screen.n_shards, bool), nothing(screen.axes)
    return read_tally(folder, screen)


def read_tally(folder: Path, screen: ScreenRequest) -> tuple[np.ndarray, Tally]:
    """Which shards of a screen are done, and their tally; errors as `begin`."""
    path = folder / TALLY
    try:
        variables, attributes = read_store(path)
        is_done = variables["is_done"].data > 0
        tally = Tally(**{name: variables[name].data for name in Tally._fields})
        is_own = attributes["digest"] == _digest(screen, is_done, tally)
    except (StudyError, KeyError, TypeError) as error:
        raise _damaged(path, str(error).removeprefix(f"{path}: ")) from None
    if not is_own:
        raise _damaged(path, "not what was written for these designs")
    return is_done, tally


def _asked(screen: ScreenRequest) -> dict[str, Any]:
    """What determines the tally."""
    data = screen.spec.data
    sweep = {name: x for name, x in data["sweep"].items() if name not in SELECTING}
    return {"screened": {**data, "sweep": sweep}, "shard_size": screen.shard_size}


def _digest(screen: ScreenRequest, is_done: np.ndarray, tally: Tally) -> str:
    asked = json.dumps(_asked(screen), sort_keys=True)
    return numbers_digest({"is_done": is_done, "asked": asked, **tally._asdict()})


def _damaged(path: Path, what: str) -> StudyError:
    return StudyError(f"{path}: damaged ({what}); remove it and begin again with --resume")


def write_tally(folder: Path, screen: ScreenRequest, is_done: np.ndarray, tally: Tally) -> None:
    """Replace the tally in a folder, whole or not at all.

    Raises:
        StudyError: that fails.
    """
    lower = LEAST * GROWTH ** np.arange(BUCKETS)
    names = ["all", *_interval_names(screen)]
    found = Variables()
    found.put("is_done", is_done, "1", "whether a shard is in the tally", "shard")
    found.put("endings", tally.endings, "1", "designs by status code", "ending")
    found.put("row", tally.row, "1", "number of a candidate, best first", "place")
    found.put("value", tally.value, "SI", f"{screen.entry} there", "place")
    found.put("sketch", tally.sketch, "1", "designs by value", "part", "bucket")
    found.put("part", names, "1", "which designs: interval of an axis", "part")
    found.put("bucket", lower, "SI", "least value in it; smaller ones: the first", "bucket")
    text = "status code; the last one: left out by where"
    found.put("ending", np.arange(N_ENDINGS), "1", text, "ending")
    attributes = {
        "title": screen.spec.study.title,
        "by": screen.spec.sweep.by,
        "n_designs": screen.n_designs,
        "digest": _digest(screen, is_done, tally),
    }
    write_store(folder / TALLY, found, attributes)


def _interval_names(screen: ScreenRequest) -> list[str]:
    return [
        f"{name}, interval {k + 1}"
        for name, bounds in zip(screen.axes.names, screen.axes.bounds, strict=True)
        for k in range(len(bounds) + 1)
    ]


def best_sweep(screen: ScreenRequest, kept: CaseTable, earlier: Sequence[Any] = ()) -> SweepSpec:
    """The kept designs as a sweep by the full model, best first, whose cases have the same ids.

    Args:
        screen: of the designs.
        kept: those to keep.
        earlier: cases that have run before, as `sweep.cases` lists them.
    """
    data = screen.spec.data
    # it names its cases instead
    written = {x: y for x, y in data["sweep"].items() if x not in SPREADING | {"keep", "margin"}}
    links = list(screen.spec.sweep.links)  # also where the designs kept control fewer
    sweep: dict[str, Any] = written | {"method": "list", "by": screen.entry, "links": links}
    sweep.pop("fidelity", None)
    least = screen.spec.sweep.margin
    if least:
        own = f"({sweep['subject_to']}) and " if sweep.get("subject_to") else ""
        sweep["subject_to"] = f"{own}gain_margin >= {least:g}"
    fields = {name: x for name, x in kept.fields.items() if name not in LABELS}
    cases = [
        {name: as_python(column[k]) for name, column in fields.items()} for k in range(len(kept))
    ]
    best = {**data, "sweep": sweep | {"cases": [*cases, *earlier]}}
    return parse_sweep(json.loads(json.dumps(best)))
