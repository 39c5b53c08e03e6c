"""`studies init`: a study file with every field, its unit, its meaning and its default."""

from __future__ import annotations

from typing import Any

from pydantic import BaseModel

from studies.spec import Study


def study_template() -> str:
    """A complete commented study file that reads back as the default study."""
    lines = ["# Study file: every field with its default. SI units unless the name says otherwise.", ""]
    study = Study()
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
    extra = info.json_schema_extra
    unit = extra.get("unit", "") if isinstance(extra, dict) else ""
    limits = [
        f"{sign} {getattr(item, key):g}"
        for item in info.metadata
        for key, sign in (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
        if getattr(item, key, None) is not None
    ]
    choices = [repr(v) for v in getattr(info.annotation, "__args__", ()) if isinstance(v, str)]
    allowed = ", ".join(limits) or " | ".join(choices)
    note = f"{info.description} [{unit}]" + (f"; {allowed}" if allowed else "")
    return [f"# {note}", f"{name} = {toml_value(getattr(section, name))}"]


def toml_value(value: Any) -> str:
    """A Python value as TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, (tuple, list)):
        return "[" + ", ".join(toml_value(v) for v in value) + "]"
    return repr(value)
