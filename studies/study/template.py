"""`studies init`: a study file to start from, or one with every field and its default."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from studies.errors import StudyError
from studies.publish import check_target, replacing
from studies.study.explain import allowed_values, choices_of, unit_of
from studies.study.spec import Study, parse_study

#: What an engineer changes first: all that `studies init` writes.
STARTERS = (
    "title",
    "run.duration",
    "machine.platform_mass",
    "link.length",
    "link.thickness",
    "link.width",
    "link.density",
    "link.youngs_modulus",
    "link.damping_ratio",
    "patches.centers",
    "motion.waypoints",
    "motion.move_time",
    "shaper.kind",
    "control.velocity_gain",
    "control.damping",
    "electronics.sample_rate_hz",
    "electronics.voltage_limit",
    "drive.kp",
    "drive.kd",
    "load.mass",
)
#: A longer line has its comment above.
_LONGEST_LINE = 110


def starter_template() -> str:
    """A short commented study file that reads back as the default study."""
    study = Study()
    lines = ["# Study file: what one changes first, in SI units unless its name says otherwise."]
    title = ""
    for name in STARTERS:
        *sections, field = name.split(".")
        section = getattr(study, sections[0]) if sections else study
        if sections and sections[0] != title:
            title = sections[0]
            lines += ["", f"[{title}]  # {_meaning(section)}"]
        lines += _starter(section, field)
    return "\n".join([*lines, "", "# `studies init --all` prints every field."]) + "\n"


def _starter(section: BaseModel, name: str) -> list[str]:
    info = type(section).model_fields[name]
    unit = unit_of(info)
    note = f"# {info.description}{f' [{unit}]' if unit else ''}"
    if choices_of(info.annotation, info.metadata):
        note += f"; {allowed_values(info.annotation, info.metadata)}"
    line = _assigned(section, name)
    both = f"{line}  {note}"
    return [both] if len(both) <= _LONGEST_LINE else [note, line]


def study_template(study: Study | None = None) -> str:
    """A complete commented study file that reads back as `study`, default: all defaults."""
    study = study or Study()
    lines = ["# Study file: every field, in SI units unless its name says otherwise.", ""]
    lines += _field(study, "title")
    for name in Study.model_fields:
        section = getattr(study, name)
        if isinstance(section, BaseModel):
            lines += ["", f"[{name}]  # {_meaning(section)}"]
            for field in type(section).model_fields:
                lines += _field(section, field)
    return "\n".join(lines) + "\n"


def own_text(study: Study) -> str:
    """What of a study differs from its mechanism's defaults, as a file that reads back as it."""
    base = parse_study({"machine": {"kind": study.machine.kind}}).model_dump(mode="json")
    base["machine"]["kind"] = Study().machine.kind
    return toml_text(_beyond(study.model_dump(mode="json", exclude_none=True), base))


def _beyond(data: Mapping[str, Any], base: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: _beyond(x, base[name]) if isinstance(x, Mapping) and name in base else x
        for name, x in data.items()
        if x != base.get(name)
    }


def write_study(out: str | Path, study: Study | None = None) -> None:
    """Write such a file.

    Args:
        out: a new file.
        study: what it reads back as; None: all defaults.

    Raises:
        StudyError: the file exists already, or it cannot be written.
    """
    write_text(out, study_template(study))


def check_new(out: str | Path) -> None:
    """Raise StudyError unless a new file can be written at `out`; call it before long work."""
    check_target(out)
    if Path(out).exists():
        raise StudyError(f"{out}: exists already; name a new file")


def write_text(out: str | Path, text: str) -> None:
    """Write a new file; arguments and errors as `write_study`."""
    check_new(out)
    with replacing(Path(out)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _field(section: BaseModel, name: str) -> list[str]:
    info = type(section).model_fields[name]
    unit = unit_of(info)
    allowed = allowed_values(info.annotation, info.metadata)
    note = f"{info.description}{f' [{unit}]' if unit else ''}; {allowed}"
    return [f"# {note}", _assigned(section, name)]


def _meaning(section: BaseModel) -> str:
    return (type(section).__doc__ or "").strip()


def _assigned(section: BaseModel, name: str) -> str:
    return f"{name} = {toml_value(getattr(section, name))}"


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
