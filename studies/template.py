"""`studies init`: a study file with every field, its unit, its meaning and its default."""

from __future__ import annotations

import json
from typing import Any

from pydantic import BaseModel

from studies.explain import allowed_values, unit_of
from studies.spec import Study


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


def _field(section: BaseModel, name: str) -> list[str]:
    info = type(section).model_fields[name]
    unit = unit_of(info)
    allowed = allowed_values(info.annotation, info.metadata)
    note = f"{info.description}{f' [{unit}]' if unit else ''}; {allowed}"
    return [f"# {note}", f"{name} = {toml_value(getattr(section, name))}"]


def toml_value(value: Any) -> str:
    """A Python value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):  # JSON escapes all that TOML wants escaped but one
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(toml_value(entry) for entry in value) + "]"
    return repr(value)
