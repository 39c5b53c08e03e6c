"""The folder of a screen: what is screened, the tally so far, and the best designs as a sweep."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from studies.engine.folder import keep_request, make_manifest
from studies.errors import StudyError
from studies.publish import REPORT, replacing
from studies.results.labelled import Variables
from studies.screen.shards import CANDIDATES, ScreenRequest
from studies.screen.tally import BUCKETS, GROWTH, LEAST, N_ENDINGS, Tally, nothing
from studies.space.axes import LABELS
from studies.space.spec import SPREADING
from studies.space.table import CaseTable, as_python
from studies.store import numbers_digest, read_store, write_store
from studies.study.template import toml_text, toml_value

REQUEST, TALLY, BEST = "screen.json", "screen.h5", "best.toml"
#: What must be the same in a folder that is gone on with.
_CHECKED = {
    "spec": "sweep",
    "by": "--by",
    "fidelity": "--fidelity",
    "shard_size": "size of shards",
    "code": "program",
    "precision": "--precision",
    "jaxlib": "version of jaxlib",
}


def begin(folder: Path, screen: ScreenRequest) -> tuple[np.ndarray, Tally]:
    """Begin a screen in a folder, or go on with it.

    Args:
        folder: of the screen, locked.
        screen: what is asked for.

    Returns:
        which shards are done, (n,); their tally.

    Raises:
        StudyError: the folder was begun with another screen, or its file is damaged.
    """
    request = make_manifest(screen.spec.data, ("studies.screen.shards",)) | _asked(screen)
    keep_request(folder / REQUEST, request, _CHECKED)
    if not (folder / TALLY).is_file():
        return np.zeros(screen.n_shards, bool), nothing(screen.axes)
    return read_tally(folder, screen)


def read_tally(folder: Path, screen: ScreenRequest) -> tuple[np.ndarray, Tally]:
    """Which shards of a screen are done, and their tally; errors as `begin`."""
    path, empty = folder / TALLY, nothing(screen.axes)
    try:
        variables, attributes = read_store(path)
        is_done = variables["is_done"].data > 0
        tally = Tally(**{name: variables[name].data for name in Tally._fields})
    except (StudyError, KeyError, TypeError) as error:
        raise _damaged(path, str(error).removeprefix(f"{path}: ")) from None
    if is_done.shape != (screen.n_shards,):
        raise _damaged(path, "number of shards")
    for name, array in tally._asdict().items():
        expected = getattr(empty, name)
        kinds = "f" if name == "value" else "iu"
        if array.dtype.kind not in kinds or array.shape[1:] != expected.shape[1:]:
            raise _damaged(path, name)
    n_done = sum(len(screen.rows(int(k))) for k in np.flatnonzero(is_done))
    if (
        tally.endings.shape != empty.endings.shape
        or tally.sketch.shape != empty.sketch.shape
        or np.any(tally.endings < 0)
        or np.any(tally.sketch < 0)
        or tally.n_designs != n_done
    ):
        raise _damaged(path, "numbers of designs")
    if attributes.get("digest") != _digest(screen, is_done, tally):
        raise _damaged(path, "not what was written for this screen")
    is_row = (tally.row >= 0) & (tally.row < screen.n_designs)
    if tally.row.shape != tally.value.shape or len(tally.row) > CANDIDATES or not is_row.all():
        raise _damaged(path, "candidates")
    return is_done, tally


def _asked(screen: ScreenRequest) -> dict[str, Any]:
    """What is asked of a screen, next to its sweep."""
    return {
        "by": screen.by,
        "fidelity": screen.spec.sweep.fidelity,
        "shard_size": screen.shard_size,
    }


def _digest(screen: ScreenRequest, is_done: np.ndarray, tally: Tally) -> str:
    asked = json.dumps({"spec": screen.spec.data, **_asked(screen)}, sort_keys=True)
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
        "by": screen.by,
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


def best_sweep(screen: ScreenRequest, kept: CaseTable) -> str:
    """The kept designs as the file of a sweep, best first, whose cases have the same ids."""
    data = screen.spec.data
    # it names its cases instead
    written = {name: x for name, x in data["sweep"].items() if name not in SPREADING}
    links = list(screen.spec.sweep.links)  # also where the designs kept control fewer
    sweep: dict[str, Any] = written | {"method": "list", "by": screen.by, "links": links}
    sweep.pop("fidelity", None)
    sections = {name: x for name, x in data.items() if name != "sweep"}
    fields = {name: x for name, x in kept.fields.items() if name not in LABELS}
    cases = [
        {name: as_python(column[k]) for name, column in fields.items()} for k in range(len(kept))
    ]
    lines = "".join(f"  {toml_value(case)},\n" for case in cases)
    return f"{toml_text({**sections, 'sweep': sweep})}cases = [\n{lines}]\n"


def write_best(folder: Path, screen: ScreenRequest, kept: CaseTable) -> None:
    """Write `best.toml`, whole or not at all, and remove what tells of an older one."""
    for stale in (REPORT, *([] if len(kept) else [BEST])):
        try:
            (folder / stale).unlink(missing_ok=True)
        except OSError as error:
            raise StudyError(f"{folder / stale}: cannot remove it ({error.strerror})") from None
    if not len(kept):
        return
    with replacing(folder / BEST) as temporary:
        temporary.write_text(best_sweep(screen, kept), encoding="utf-8")
