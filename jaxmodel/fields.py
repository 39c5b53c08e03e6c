"""The fields of study files that are numbers or choices, with the values of the paper's run.

`fields.json` is written from the schema of files (`make reference`).
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import Any


@cache
def fields() -> dict[str, dict[str, Any]]:
    """What each field of a file is: the paper's value, unit, limits, names of its choices."""
    text = Path(__file__).with_name("fields.json").read_text(encoding="utf-8")
    found: dict[str, dict[str, Any]] = json.loads(text)
    return found
