"""`studies init`: a study file with every field, its unit, its meaning and its default."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from studies.errors import StudyError
from studies.store import check_target, replacing
from studies.study.explain import allowed_values, unit_of
from studies.study.spec import Study


def study_template(study: Study | None = None) -> str:
    """A complete commented study file that reads back as `study`, default: all defaults."""
    study = study or Study()
    lines = ["# Study file: every field, in SI units unless its name says otherwise.", ""]
    lines += _field(study, "title")
    for name in Study.model_fields:
        section = getattr(study, name)
        if isinstance(section, BaseModel):
            lines += ["", f"[{name}]  # {(type(section).__doc__ or '').strip()}"]
            for field in type(section).model_fields:
                lines += _field(section, field)
    return "\n".join(lines) + "\n"


def write_study(out: str | Path, study: Study | None = None) -> None:
    """Write such a file.

    Args:
        out: a new file.
        study: what it reads back as; None: all defaults.

    Raises:
        StudyError: the file exists already, or it cannot be written.
    """
    write_text(out, study_template(study))


def write_text(out: str | Path, text: str) -> None:
    """Write a new file; arguments and errors as `write_study`."""
    out = Path(out)
    check_target(out)
    if out.exists():
        raise StudyError(f"{out}: exists already; name a new file")
    with replacing(out) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _field(section: BaseModel, name: str) -> list[str]:
    info = type(section).model_fields[name]
    unit = unit_of(info)
    allowed = allowed_values(info.annotation, info.metadata)
    note = f"{info.description}{f' [{unit}]' if unit else ''}; {allowed}"
    return [f"# {note}", f"{name} = {toml_value(getattr(section, name))}"]


def toml_text(data: Mapping[str, Any], path: tuple[str, ...] = ()) -> str:
    """A dictionary as a TOML file that reads back the same, such as the file of a sweep.

    Args:
        data: as read from a file; anything nested deeper than [a.b] is written on one line.
        path: of the section; () for the whole file.
    """
    tables = [key for key, value in data.items() if isinstance(value, Mapping) and len(path) < 2]
    lines = [f"[{'.'.join(map(_key, path))}]"] if path else []
    lines += [f"{_key(key)} = {toml_value(data[key])}" for key in data if key not in tables]
    sections = [toml_text(data[key], (*path, key)) for key in tables]
    return "\n".join(["".join(f"{line}\n" for line in lines), *sections]).lstrip("\n")


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else toml_value(name)


def toml_value(value: Any) -> str:
    """A Python value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):  # JSON escapes everything TOML needs escaped, except one character
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(toml_value(entry) for entry in value) + "]"
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_key(key)} = {toml_value(value[key])}" for key in value) + " }"
    return repr(value)
