"""Text of the reference pages, from the command line's own help and the schema of the files.

`python docs/_ext/reference.py` writes it into the pages, below the marks that name it.
"""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, get_args, get_origin

import numpy as np
import typer
from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import studies
from jaxmodel.metrics import METRICS
from studies.cli import VERBS, app
from studies.commission.spec import Commission
from studies.documents import DOCUMENTS, schema
from studies.fitting.spec import ENTRIES, Fit, Next, WrittenPrior
from studies.space.axes import WrittenGrid, WrittenPlacement, WrittenRange
from studies.space.machines import UNCERTAIN
from studies.space.spec import Block, Sweep
from studies.study.cases import build_structure
from studies.study.explain import allowed_values, unit_of, written_fields
from studies.study.numbers import form_of, one_study
from studies.study.paths import field_choices
from studies.study.spec import OWN_FIELDS, Study, paper_study
from studies.study.template import toml_value
from studies.tuning.free import FreePlacement
from studies.tuning.spec import FamilySection, Pareto, Scenarios, Tune

#: Words for the value of an option.
_VALUES = {bool: "", int: "whole number", float: "number", str: "text"}
Fields = dict[str, FieldInfo]


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    cells = [heads, ["---"] * len(heads), *rows]
    return "\n".join(
        f"| {' | '.join(x.replace('|', chr(92) + '|') for x in row)} |" for row in cells
    )


# commands


def commands_text() -> str:
    """Every command with its arguments and options."""
    command = typer.main.get_command(app)
    parts = [_command_text(f"studies {name}", one) for name, one in command.commands.items()]
    general = "## Before the command\n\n`studies [OPTION] COMMAND ...`\n\n" + _options(command)
    return "\n\n".join([*parts, general])


def _command_text(name: str, command: Any) -> str:
    arguments = [_argument(x) for x in command.params if x.param_type_name == "argument"]
    usage = " ".join([name, *arguments, "[OPTIONS]"])
    return f"## {name}\n\n{command.help}\n\n`{usage}`\n\n{_options(command)}"


def _argument(parameter: Any) -> str:
    name = parameter.name.upper()
    return name if parameter.required else f"[{name}]"


def _flags(parameter: Any) -> str:
    return " / ".join([parameter.opts[0], *parameter.secondary_opts])


def _options(command: Any) -> str:
    return table(
        ("argument, option", "value", "meaning", "default"),
        (
            (
                f"`{_argument(x) if x.param_type_name == 'argument' else _flags(x)}`",
                _value(x),
                x.help or "",
                _default_of_option(x),
            )
            for x in command.params
        ),
    )


def _value(parameter: Any) -> str:
    kind = parameter.type_descriptor.annotation
    if get_origin(kind) is tuple:
        return f"{len(get_args(kind))} numbers"
    limits = [
        f"{sign} {value:,}"
        for sign, value in (("≥", parameter.min), ("≤", parameter.max))
        if value is not None
    ]
    return " ".join([_VALUES.get(kind, "path"), " and ".join(limits)]).strip()


def _default_of_option(parameter: Any) -> str:
    if parameter.required:
        return "required"
    is_left_out = parameter.default in (None, "", False) or parameter.is_eager
    return "" if is_left_out else f"`{parameter.default}`"


def verbs_text() -> str:
    """Every verb of Python with the command that is made from it."""
    verbs = (verb for verb in VERBS if verb.__name__ in studies.__all__)
    rows = ((f"`{verb.__name__}`", f"`studies.{_call(verb)}`") for verb in verbs)
    return table(("command", "verb"), rows)


def _call(verb: Callable[..., Any]) -> str:
    """A verb with its arguments and their defaults, and what it returns."""
    words = inspect.signature(verb)
    given = [x.replace(annotation=inspect.Parameter.empty) for x in words.parameters.values()]
    return f"{verb.__name__}{words.replace(parameters=given)}"


# fields


def fields_text() -> str:
    """Every field that a file may have."""
    parts = ["## A study", _fields_table({"title": Study.model_fields["title"]})]
    for name, info in Study.model_fields.items():
        if _is_section(info.annotation):
            parts.append(_section_text(f"[{name}]", info.annotation))
            parts += [_own_text(x) for x in OWN_FIELDS if x.startswith(f"{name}.")]
    own = {name: x for name, x in Sweep.model_fields.items() if name not in Block.model_fields}
    parts += [
        "## A sweep",
        _section_text("[sweep] and [[sweep.blocks]]", Block),
        _section_text("[sweep]", Sweep, own),
        _section_text("A range of an axis", WrittenGrid),
        _section_text("The axis placement", WrittenPlacement),
        "## A tuning",
        _section_text("[tune]", Tune),
        _section_text("A range in [tune.free]", WrittenRange),
        _section_text("placement in [tune.free]", FreePlacement),
        _section_text("[tune.families.NAME]", FamilySection),
        _section_text("[tune.pareto]", Pareto),
        _section_text("[tune.scenarios]", Scenarios),
        "## A fit",
        _section_text("[fit]", Fit),
        _section_text("A range in [fit.free]", WrittenPrior),
        _section_text("[fit.next]", Next),
    ]
    parts += [_section_text(f'[[fit.data]], kind = "{kind}"', x) for kind, x in ENTRIES.items()]
    parts += ["## A commissioning", _section_text("[commission]", Commission)]
    return "\n\n".join(parts)


def _is_section(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, BaseModel)


def _section_text(name: str, section: type[BaseModel], fields: Fields | None = None) -> str:
    meaning = (section.__doc__ or "").strip()
    return f"### `{name}`\n\n{meaning}\n\n{_fields_table(fields or written_fields(section))}"


def _fields_table(fields: Fields) -> str:
    rows = (
        (
            f"`{name}`",
            info.description or (info.annotation.__doc__ or "").strip(),
            unit_of(info),
            _allowed(info),
            _default(info),
        )
        for name, info in fields.items()
    )
    return table(("field", "meaning", "unit", "allowed", "default"), rows)


def _allowed(info: FieldInfo) -> str:
    """In words; what describes itself at length has a table of its own."""
    text = allowed_values(info.annotation, info.metadata).partition(";")[0]
    return text.replace(">=", "≥").replace("<=", "≤")


def _default(info: FieldInfo) -> str:
    if info.default is PydanticUndefined:
        return "required"
    if info.default is None:
        return "not given"
    if isinstance(info.default, BaseModel):
        return "its own section"
    return f"`{toml_value(info.default)}`"


def _own_text(place: str) -> str:
    entries = OWN_FIELDS[place]
    rows = (
        (
            f"`{entry.name}.{x.name}`",
            x.text,
            x.unit,
            f"≥ {x.low:g} and ≤ {x.high:g}",
            f"`{x.default:g}`",
        )
        for entry in entries.values()
        for x in entry.parameters
    )
    heads = ("field", "meaning", "unit", "allowed", "default")
    meaning = f"Fields of single {entries.kind}s; one number for all links, or three."
    return f"### `[{place}]`\n\n{meaning}\n\n{table(heads, rows)}"


def metrics_text() -> str:
    """Every metric of a run."""
    rows = ((f"`{x.name}`", x.text, x.unit, ", ".join(x.dims)) for x in METRICS.values())
    return table(("metric", "meaning", "unit", "axes"), rows)


def machines_text() -> str:
    """What nobody knows exactly of a machine."""
    rows = (
        (
            f"`{x.field}`",
            "" if x.tolerance is None else f"`{name}`",
            "" if x.tolerance is None else f"{x.tolerance:g} [{x.unit}]",
            x.why,
            f"{x.percent:g} %" if x.percent else "",
            f"{x.proven[0]:g} to {x.proven[1]:g}" if x.proven else "",
        )
        for name, x in UNCERTAIN.items()
    )
    return table(("field", "`--tolerance`", "one unit", "why", "laws", "proofs"), rows)


# results


def results_text() -> str:
    """Every document, with the fields and axes of its numbers."""
    return "\n\n".join(_result_text(command) for command in DOCUMENTS)


def _result_text(command: str) -> str:
    document = schema(command)
    rows = list(_rows_of(document, ""))
    head = f"## {command}\n\n{document['description']}"
    return f"{head}\n\n{table(('field', 'meaning', 'unit', 'kind'), rows)}"


def _rows_of(rule: dict[str, Any], place: str) -> Iterator[tuple[str, str, str, str]]:
    """A row of each field, and of each of what it holds."""
    for name, one in rule["properties"].items():
        if name in ("format", "format_version"):
            continue
        kind, inner = _kind(one)
        field = f"{place}{name}"
        yield f"`{field}`", one.get("description", ""), one.get("unit", ""), kind
        if inner is not None:
            yield from _rows_of(inner, f"{field}[]." if kind.startswith("list") else f"{field}.")


def _kind(rule: dict[str, Any]) -> tuple[str, dict[str, Any] | None]:
    """Kind of a value in words, and the rule of the fields it has."""
    if "anyOf" in rule:
        kinds = [_kind(one) for one in rule["anyOf"]]
        inner = next((x for _, x in kinds if x is not None), None)
        return " or ".join(dict.fromkeys(kind for kind, _ in kinds)), inner
    if "enum" in rule:
        return ", ".join(map(str, rule["enum"])), None
    if rule.get("type") == "array":
        kind, inner = _kind(rule["items"])
        return f"list of {kind}", inner
    if "properties" in rule:
        return "object", rule
    kinds = rule.get("type", "any")  # ["number", "null"] of numbers that may not be finite
    return kinds if isinstance(kinds, str) else kinds[0], None


#: What pages name in `<!-- generated: NAME -->`.
TEXTS: dict[str, Callable[[], str]] = {
    "commands": commands_text,
    "fields": fields_text,
    "machines": machines_text,
    "metrics": metrics_text,
    "results": results_text,
    "verbs": verbs_text,
}
MARK = re.compile(r"<!-- generated: (\w+) -->\n.*?<!-- end -->", re.DOTALL)


def filled(page: str) -> str:
    """A page with its marks followed by what they name."""
    return MARK.sub(
        lambda x: f"<!-- generated: {x[1]} -->\n\n{TEXTS[x[1]]()}\n\n<!-- end -->", page
    )


# fields of the model


#: Lists that can have another length, beside those of lists, of which there is one a link.
LISTS = ("motion.waypoints", "motion.move_time", "motion.dwell", "metrics.stations")
LISTS += ("electronics.lowpass_ratio", "electronics.lowpass_zeta", "machine.joint_angles_deg")
LISTS += ("shaper.frequencies_hz",)


#: What a plain list is where one list a link may be: one for all, a number a link, nothing.
_LISTS = {"list of links": "all links", "mode": "each link", "plain": "lists"}


def model_fields() -> str:
    """`jaxmodel/fields.json`: the paper's value, unit and range of each number."""
    study = paper_study()
    numbers, found = one_study(study, build_structure(study)), {}
    for name, number in numbers.items():
        section, _, leaf = name.partition(".")
        info = Study.model_fields[section].annotation.model_fields[leaf]
        array, choices = np.asarray(number), field_choices(name)
        row = {"value": array.tolist(), "shape": array.shape, "unit": unit_of(info)}
        row["allowed"] = allowed_values(info.annotation, info.metadata)
        if array.dtype.kind == "i":
            row["dtype"] = "int"
        if "true or false" in row["allowed"]:
            row |= {"limits": {"ge": 0.0, "le": 1.0}, "is_whole": True}
        if choices:
            row["choices"] = choices
        if limits := _limits_of(info.annotation, info.metadata):
            row["limits"] = limits
        of = "entries" if name in LISTS else _LISTS.get(form_of(name), "") * (array.ndim == 2)
        found[name] = row | ({"of": of} if of else {})
    rows = (f" {json.dumps(name)}: {json.dumps(row)}" for name, row in found.items())
    return "{\n" + ",\n".join(rows) + "\n}\n"


def _limits_of(annotation: Any, metadata: Iterable[Any]) -> dict[str, float]:
    """Bounds of a field's numbers."""
    found = {
        sign: float(getattr(item, sign))
        for item in (*metadata, *getattr(annotation, "__metadata__", ()))
        for part in (item, *getattr(item, "metadata", ()))
        for sign in ("ge", "gt", "le", "lt")
        if isinstance(getattr(part, sign, None), int | float)
        for item in [part]
    }
    inner = [_limits_of(x, ()) for x in get_args(annotation) if not isinstance(x, FieldInfo)]
    return found or next(filter(None, inner), {})


# members of tuples


def members_text(source: str) -> dict[str, str]:
    """What comments say about the members of a class, beside or above them, with axes by name.

    Args:
        source: of the class, whose members stand one a line:
            `mass: Num[Array, "links"]  # of a slider [kg]`.
    """
    member = r"((?:^    # .+\n)*)^    (\w+): ([^#\n]+)(?:  # (.+))?$"
    found = {}
    for above, name, annotation, beside in re.findall(member, source, re.MULTILINE):
        text = beside or " ".join(line.strip("# ") for line in above.splitlines())
        shapes = dict.fromkeys(re.findall(r'\[(?:Array|np.ndarray), "(.*?)"\]', annotation))
        axes = " or ".join(f"({', '.join(shape.split())})" for shape in shapes)
        if parts := [x for x in (text, axes) if x]:
            found[name] = ", ".join(parts)
    return found


MODEL_FIELDS = Path(__file__).parents[2] / "jaxmodel" / "fields.json"

if __name__ == "__main__":
    MODEL_FIELDS.write_text(model_fields(), encoding="utf-8")
    for path in sorted((Path(__file__).parents[1] / "reference").glob("*.md")):
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
