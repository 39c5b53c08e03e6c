"""Commands made from verbs: names, defaults and help stand once, in signature and docstring."""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import typer
from rich.console import Console

from studies.config import start
from studies.errors import field_error
from studies.job import KINDS, refuse_existing
from studies.publish import check_folder
from studies.result import Result
from studies.results.document import print_document


class Taken(NamedTuple):
    """How a command takes an argument of a type."""

    type: Any
    read: Callable[[str, Any], Any] = lambda name, given: given


def _numbers(name: str, given: str | None) -> tuple[float, ...] | None:
    """Numbers with commas between them."""
    try:
        return None if given is None else tuple(map(float, given.split(",")))
    except ValueError:
        raise field_error(name, given, "numbers with commas between them") from None


def settings(name: str, given: list[str] | None) -> dict[str, str]:
    """NAME=VALUE, once or more often."""
    parts = [text.partition("=") for text in given or []]
    return {key.strip(): value.strip() for key, _, value in parts}


#: By the annotation of a verb; others are texts.
_TAKEN = {
    "bool": Taken(bool),
    "bool | None": Taken(bool | None),
    "float": Taken(float),
    "float | None": Taken(float | None),
    "int": Taken(int),
    "int | None": Taken(int | None),
    "str": Taken(str),
    "Sequence[float] | None": Taken(str | None, _numbers),
    "Mapping[str, float] | None": Taken(list[str] | None, settings),
}


def add_verb(
    app: typer.Typer,
    console: Console,
    verb: Callable[..., Any],
    has_precision: bool = False,
    starts: bool = True,
) -> None:
    """Add the command of a verb to the command line.

    Args:
        app, console: of the command line.
        verb: a public function; "-" stands for "_" in its options.
        has_precision: whether the command can also compute in single precision, and on GPUs.
        starts: whether it computes, and hence starts JAX.
    """
    given = inspect.signature(verb).parameters
    about, texts = documented(verb)
    options = [_option(x, texts[x.name]) for x in given.values()]
    if has_precision:
        text = "float64 or float32"
        options.append(_parameter("precision", str, "float64", typer.Option(help=text)))
    text = "print one JSON document; `studies schema` describes it"
    options.append(_parameter("as_json", bool, False, typer.Option("--json", help=text)))

    def command(precision: str = "float64", as_json: bool = False, **values: Any) -> None:
        out = values.get("out")
        if out is not None and not values.get("dry_run"):  # before JAX starts
            if texts["out"].startswith("folder"):
                check_folder(out)
            if verb.__name__ in KINDS:
                refuse_existing(Path(out), verb.__name__, values.get("resume", False))
        if starts:
            start(precision, gpu=has_precision and not values.get("workers"))
        for name, parameter in given.items():
            option = f"--{name.replace('_', '-')}"
            values[name] = _taken(parameter).read(option, values[name])
        if as_json and "progress" in given:
            values["progress"] = False
        finish(verb(**values), console, as_json)

    command.__signature__ = inspect.Signature(options)  # type: ignore[attr-defined]
    command.__annotations__ = {x.name: x.annotation for x in options}
    command.__doc__ = about
    app.command(verb.__name__)(command)


def documented(verb: Callable[..., Any]) -> tuple[str, dict[str, str]]:
    """What a docstring says of a function, and of each of its arguments."""
    about, _, rest = (inspect.getdoc(verb) or "").partition("\n\nArgs:\n")
    written = rest.partition("\n\n")[0]
    found = re.findall(r"^    (\w[\w, ]*): ((?:.|\n(?!    \w))*)", written, re.MULTILINE)
    texts = {
        x: " ".join(text.split()).rstrip(".") for names, text in found for x in names.split(", ")
    }
    return about.partition("\n\nReturns:")[0], texts


def _taken(parameter: inspect.Parameter) -> Taken:
    return _TAKEN.get(parameter.annotation, Taken(str | None))


def _option(parameter: inspect.Parameter, text: str) -> inspect.Parameter:
    """A parameter of a verb as typer takes it."""
    name, default, kind = parameter.name, parameter.default, _taken(parameter).type
    is_required = default is inspect.Parameter.empty
    if name == "what":
        kind = str if is_required else str | None
        return _parameter(name, kind, default, typer.Argument(help=text, metavar="WHAT"))
    flag = f"--{name.replace('_', '-')}"
    flags = [flag] if kind is bool and not default else []
    return _parameter(name, kind, default, typer.Option(*flags, help=text))


def _parameter(name: str, kind: Any, default: Any, option: Any) -> inspect.Parameter:
    of = inspect.Parameter.KEYWORD_ONLY
    return inspect.Parameter(name, of, default=default, annotation=Annotated[kind, option])


def finish(result: Result, console: Console, as_json: bool) -> None:
    """Print a result, and end with 1 if it is not what one asks for."""
    from studies.show.report import print_report

    if as_json:
        print_document(result.document())
    else:
        has_page = result.folder is not None and result.folder.is_dir()
        if not has_page:
            print_report(result.report(), console)
        for line in [*(result.lines() if has_page else ()), *result.told()]:
            console.print(line, soft_wrap=True)
    if result.has_failed:
        sys.exit(1)
