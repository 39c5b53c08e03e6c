"""The outcome of `studies verify`, kept for reports that the same code makes afterwards.

It is a small file in the folder of compiled programs, found by the digest of the code that makes
numbers: any change to that code, a new version or another cache leaves a machine unverified.
"""

from __future__ import annotations

import json
import re
from contextlib import suppress
from functools import cache
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any

from studies import sources
from studies.cache import chosen_folder, is_usable
from studies.errors import StudyError
from studies.publish import replacing
from studies.reading import read_json
from studies.results.labelled import Labelled, document, told

if TYPE_CHECKING:
    from studies.study.spec import Study

#: Modules whose sources decide what numbers mean.
_DECISIVE = ("studies.engine", "studies.export", "studies.verify")
_SAFE = re.compile(r"[^\w .,:;()@+/*-]")


class Passport(Labelled):
    """What a verification found, when and where."""

    title: str = told("of the study")
    passed: int = told("rows that passed")
    rows: int = told("rows that could be checked")
    failed: tuple[str, ...] = told("assumptions of the rows that failed")
    date: str = told("ISO 8601")
    version: str = told("of this package")
    processor: str = told("on which it ran")

    @property
    def text(self) -> str:
        """In one line."""
        what = f"{self.passed} of {self.rows} assumptions passed"
        if self.failed:
            what += f" (failed: {'; '.join(self.failed)})"
        return f"{what}, {self.date}, version {self.version}, {self.processor}"


def name_of(study: Study) -> str:
    """A name for a study's values, whatever its title."""
    values = study.model_dump(mode="json", exclude={"title"})
    return sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


def keep(study: Study, passport: Passport) -> None:
    """Keep an outcome, unless there is no folder for it."""
    folder = chosen_folder()
    if not is_usable(folder):
        return
    # a full disk must not turn a verification into a failure
    with suppress(StudyError), replacing(_file(study, folder)) as temporary:
        content = document(passport)
        temporary.write_text(json.dumps(content | {"digest": _hash(content)}), encoding="utf-8")


def find(study: Study | None) -> Passport | None:
    """The outcome for a study under the present code, None if there is none."""
    if study is None:
        return None
    try:
        data: dict[str, Any] = read_json(_file(study, chosen_folder()))
        if data.pop("digest") != _hash(data):
            return None
        words = {name: _plain(data[name]) for name in ("title", "date", "version", "processor")}
        failed = tuple(map(_plain, data["failed"]))
        return Passport(passed=int(data["passed"]), rows=int(data["rows"]), failed=failed, **words)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None  # not there, or damaged: not verified


def _hash(content: dict[str, Any]) -> str:
    return sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


def _plain(text: object) -> str:
    return _SAFE.sub("", str(text))[:200]


def _file(study: Study, folder: Path) -> Path:
    return folder / f"passport-{sha256(f'{_digest()} {name_of(study)}'.encode()).hexdigest()}"


@cache
def _digest() -> str:
    return sources.digest(*_DECISIVE)
