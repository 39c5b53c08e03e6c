"""Writing an explorer: one HTML file with its data and script, that loads nothing else."""

from __future__ import annotations

import gzip
import json
from base64 import b64encode
from collections.abc import Callable
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from studies.config import origin
from studies.console import make_console
from studies.explorer.replays import DrawnMotion, ReplayedCase
from studies.explorer.table import ExplorerTable, shown_rows
from studies.phases import Phases
from studies.publish import EXPLORER, check_target, replacing
from studies.result import Result
from studies.show.figures import CONTROLLED, SERIES, WITHOUT
from studies.show.pages import render
from studies.show.report import Report
from studies.show.sketch import ACTUATOR, OFF, ON, SENSOR
from studies.show.units import count_text

#: The scripts of a page, in their order.
SCRIPTS = ("data", "state", "plots", "parallel", "scatter", "cases", "machine", "main")
_FOLDER = Path(__file__).parent


#: Fills in the table of a folder; tells how many of how many cases have been replayed.
Fill = Callable[[Path, Callable[[int, int], None]], ExplorerTable]


@dataclass(frozen=True, eq=False)
class Explorer(Result):
    """A page on which all cases of a folder can be looked at."""

    page: Path

    def report(self) -> Report:
        return Report("Explorer", [f"explorer: {self.page}"], "", "", [], [], {})


def write_explorer(
    folder: Path, fill: Fill, out: Path | None = None, progress: bool = False
) -> Explorer:
    """Write the page of a folder of results.

    Args:
        folder: with results.
        fill: makes the table of it.
        out: file of the page; None: in the folder.
        progress: show it.

    Raises:
        StudyError: nothing to show, or the page cannot be written.
    """
    page = out or folder / EXPLORER
    check_target(page)
    with Phases(make_console(), ("explore",), not progress) as phases:

        def on_progress(done: int, total: int) -> None:
            if phases.console.is_terminal or done == total:
                phases.advance(done, total, f"{done} of {total} run again for the page")

        phases.begin("explore")
        text = explorer_page(fill(folder, on_progress))
        with replacing(page) as temporary:
            temporary.write_text(text, encoding="utf-8")
    return Explorer(page)


def explorer_page(table: ExplorerTable) -> str:
    """The page of a table, as HTML."""
    table, outside = _representable(table)
    rows = shown_rows(table)
    packed = _Arrays()
    data = _contents(table, rows, packed)
    script = "\n".join((_FOLDER / f"{x}.js").read_text(encoding="utf-8") for x in SCRIPTS)
    script = f'"use strict";\n{script}'
    return render(
        "explorer/explorer.html",
        title=table.title,
        noun=table.noun,
        about=_about(table),
        notes=[*_thinning(table, rows), *outside, *table.notes],
        facts=origin(),
        script=Markup(script),
        digest=b64encode(sha256(script.encode()).digest()).decode(),
        data=Markup(_as_json(data)),
        arrays=packed.text(),
    )


def _about(table: ExplorerTable) -> dict[str, str]:
    """What was asked of which machine, how the runs ended, and what the page shows first."""
    codes, counts = np.unique(table.status, return_counts=True)
    endings = ", ".join(
        f"{count:,} {table.reasons[int(code)]}" for code, count in zip(codes, counts, strict=True)
    )
    ranked = f"by {table.rank}, {table.column(table.rank).better} first"
    limits = [f"{name} ≥ {least:g}" for name, least in table.conditions.items()]
    first = f"; selected at first: {' and '.join(limits)}" if limits else ""
    total = count_text(len(table.status), table.noun)
    return {**table.about, f"{table.noun}s": f"{total}: {endings}", "ranked": ranked + first}


def _representable(table: ExplorerTable) -> tuple[ExplorerTable, list[str]]:
    """The table without values that 4 bytes cannot hold, and a note on their columns."""
    limits, columns, outside = np.finfo(np.float32), [], []
    for column in table.columns:
        size = np.abs(column.value)
        is_lost = (size > limits.max) | ((size > 0) & (size < limits.tiny))
        columns.append(column._replace(value=np.where(is_lost, np.nan, column.value)))
        if is_lost.any():
            outside.append(column.name)
    names = ", ".join(outside)
    notes = [f"Some values of {names} are too large or too small for this page."] if outside else []
    return table._replace(columns=tuple(columns)), notes


def _thinning(table: ExplorerTable, rows: np.ndarray) -> list[str]:
    total = len(table.status)
    if len(rows) == total:
        return []
    return [
        f"This page shows {len(rows):,} of {total:,} {table.noun}s: the best by {table.rank}, and "
        "an even spread of the others."
    ]


def _contents(table: ExplorerTable, rows: np.ndarray, packed: _Arrays) -> dict[str, Any]:
    """What the script reads, beside the arrays."""
    place_of = {int(row): place for place, row in enumerate(rows)}
    placement = table.placement
    return {
        "noun": table.noun,
        "n": len(rows),
        "total": len(table.status),
        "columns": [
            {
                "name": column.name,
                "unit": column.unit,
                "isParameter": column.is_parameter,
                "labels": list(column.labels),
                "isLog": column.is_log,
                "better": column.better,
                "bound": _number(column.bound),
                "baseline": _number(table.baseline.get(column.name, np.nan)),
                "least": table.conditions.get(column.name),
                "value": packed.add(column.value[rows]),
            }
            for column in table.columns
        ],
        "rank": [column.name for column in table.columns].index(table.rank),
        "status": packed.add(table.status[rows]),
        "reasons": {str(code): text for code, text in table.reasons.items()},
        "names": [table.names[row] for row in rows],
        "command": table.command,
        "placement": None
        if placement is None
        else {key: packed.add(x[rows]) for key, x in placement._asdict().items()},
        "replays": [_replay(x, place_of[x.row], packed) for x in table.replays],
        "colors": {
            "controlled": CONTROLLED["color"],
            "without": WITHOUT["color"],
            "failed": SERIES[3],
            "on": ON,
            "off": OFF,
            "actuator": ACTUATOR,
            "sensor": SENSOR,
        },
    }


def _replay(replay: ReplayedCase, place: int, packed: _Arrays) -> dict[str, Any]:
    def motion(one: DrawnMotion) -> dict[str, Any]:
        return {key: packed.add(x) for key, x in one._asdict().items()}

    return {
        "row": place,
        "time": packed.add(replay.time),
        "frameTime": packed.add(replay.frame_time),
        "exaggeration": replay.exaggeration,
        "frame": packed.add(replay.frame),
        "motions": [motion(one) for one in replay.motions],
    }


class _Arrays:
    """Arrays one after another as 4-byte floats, so that a page holds one compressed text."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._length = 0

    def add(self, values: np.ndarray) -> dict[str, Any]:
        """Keep an array by columns, which compress better; where it starts, and its shape."""
        array = np.asarray(values, np.float32)
        first, self._length = self._length, self._length + array.size
        self._parts.append(np.moveaxis(array, 0, -1).tobytes())
        return {"first": first, "shape": array.shape}

    def text(self) -> str:
        return b64encode(gzip.compress(b"".join(self._parts), 6, mtime=0)).decode()


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _as_json(data: dict[str, Any]) -> str:
    """JSON that cannot end the script element it stands in."""
    text = json.dumps(data, ensure_ascii=True, allow_nan=False, separators=(",", ":"))
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")
