"""The command line. Commands exit with code 0, or with code 2 and one message; no traceback."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable, Iterable
from contextlib import redirect_stdout
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from typer.exceptions import Abort, TyperException

from studies import __version__, documents, job
from studies.atlas.verb import atlas
from studies.bench.verb import bench
from studies.cache import KINDS, VARIABLE, Kept, cache_contents, is_shared
from studies.commands import add_verb
from studies.commission.verb import commission
from studies.config import PACKAGE, configure, keep_programs, start
from studies.console import make_console
from studies.errors import OWN_WARNINGS, StudyError, printable
from studies.explore import explore
from studies.export.verb import export
from studies.fitting.verb import fit
from studies.laws.verb import compare
from studies.papers.verb import paper
from studies.results.document import AsJson, print_document
from studies.single.verb import modes, plant, simulate
from studies.spillover.verb import certify
from studies.sweeps import reading
from studies.sweeps.verb import sweep
from studies.threads import COMPILING
from studies.tuning.verb import tune
from studies.twin.verb import twin
from studies.verify.verb import verify

app = typer.Typer(
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
if not os.environ.get("COLUMNS", "1").strip("0"):
    del os.environ["COLUMNS"]  # a width of 0 would hide all that is printed
console = make_console()

#: Exit code after Ctrl-C.
INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `studies` command."""
    if sys.stderr is None:
        sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    os.environ["MPLBACKEND"] = "agg"  # figures go to files; one for windows may be missing here
    keep_programs()
    job.command = tuple(sys.argv[1:] if arguments is None else arguments)
    if threading.current_thread() is threading.main_thread():  # what batch systems end jobs with
        signal.signal(signal.SIGTERM, signal.default_int_handler)
    if isinstance(sys.stdout, TextIOWrapper):  # what its encoding lacks is shown as an escape
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        if sys.stdout is None:
            raise StudyError("standard output: closed; send it to a file or to /dev/null")
        _check_text(job.command)
        output: Any = _Output(sys.stdout)
        with warnings.catch_warnings(), redirect_stdout(output):
            warnings.showwarning = _show_each_once()
            if app(args=arguments, standalone_mode=False) == INTERRUPTED:
                raise KeyboardInterrupt
            output.flush()
    except (StudyError, TyperException) as error:
        text = error.format_message() if isinstance(error, TyperException) else str(error)
        if text:  # empty if help was printed because no command was given
            print(f"studies: {printable(text)}", file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, Abort):
        print("studies: interrupted", file=sys.stderr)
        sys.stdout.flush()
        sys.stderr.flush()
        if _is_compiling():  # nobody waits for that; files are written whole, so none is lost
            os._exit(INTERRUPTED)
        sys.exit(INTERRUPTED)
    except Exception as error:
        from studies.extensions import plugin_error

        if not (reason := plugin_error(error)):
            raise
        print(f"studies: {printable(reason)}", file=sys.stderr)
        sys.exit(2)


class _Output:
    """Standard output whose faults, such as a full disk, are errors with one message."""

    def __init__(self, file: Any) -> None:
        self._file = file

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)

    def write(self, text: str) -> int:
        return int(self._checked(self._file.write, text))

    def flush(self) -> None:
        self._checked(self._file.flush)

    def _checked(self, call: Callable[..., Any], *arguments: str) -> Any:
        try:
            return call(*arguments)
        except OSError as error:
            # what is left would fail again when Python ends
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._file.fileno())
            if isinstance(error, BrokenPipeError):  # the reader, such as `head`, has enough
                sys.exit(1)
            reason = f"standard output: cannot be written to ({error.strerror})"
            raise StudyError(reason) from None


def _is_compiling() -> bool:
    """Whether threads still compile, which Python's own end would wait for."""
    return any(thread.name.startswith(COMPILING) for thread in threading.enumerate())


def _check_text(arguments: Iterable[str]) -> None:
    """Raise StudyError for names that are no UTF-8, which no report could print."""
    for argument in arguments:
        try:
            argument.encode()
        except UnicodeEncodeError:
            name = ascii(argument)
            raise StudyError(f"{name}: not UTF-8 text; rename the file or folder") from None


def _show_each_once() -> Callable[..., None]:
    """What shows warnings: the program's own as one line, others with their place in the code."""
    said: set[str] = set()  # the variants of a study repeat them

    def show(
        message: Warning | str,
        category: type[Warning],
        filename: str,
        lineno: int,
        file: Any = None,
        line: str | None = None,
    ) -> None:
        text = f"studies: {printable(str(message))}"
        if not issubclass(category, OWN_WARNINGS):
            text = warnings.formatwarning(message, category, filename, lineno).rstrip()
        if text not in said:
            said.add(text)
            print(text, file=sys.stderr)

    return show


def _print_version(is_requested: bool) -> None:
    if is_requested:
        print(f"{PACKAGE} {__version__}")
        raise typer.Exit()


@app.callback()
def prepare(
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Python file or module with your own laws, metrics, sweep methods or export "
            "targets",
        ),
    ] = None,
    version: Annotated[
        bool,
        typer.Option("--version", help="show the version", callback=_print_version, is_eager=True),
    ] = False,
) -> None:
    """Parameter studies of a planar 3-PRR manipulator with flexible links."""
    if own:
        configure()  # before these files use JAX
        from studies.extensions import extend

        for module in own:
            extend(module)


#: Commands with the arguments of the verb, and whether they can compute in single precision.
VERBS: dict[Callable[..., Any], bool] = {
    paper: True,
    simulate: True,
    modes: False,
    plant: False,
    verify: False,
    sweep: True,
    tune: False,
    fit: False,
    export: False,
    atlas: False,
    certify: False,
    compare: False,
    commission: False,
    twin: False,
    explore: False,
    bench: True,
}
for verb, has_precision in VERBS.items():
    add_verb(app, console, verb, has_precision)
for verb in (reading.show, reading.best, reading.plot, reading.sensitivity):
    add_verb(app, console, verb, starts=False)


@app.command()
def init(
    out: Annotated[Path | None, typer.Argument(help="file to write; default: print")] = None,
    ready: Annotated[
        str,
        typer.Option(
            "--from",
            help="copy the ready-made study, sweep or tuning of this name; or recover the study of "
            "a JSON file written by studies export, whose numbers are checked",
        ),
    ] = "",
    is_whole: Annotated[
        bool, typer.Option("--all", help="write every field with its allowed range")
    ] = False,
) -> None:
    """Write a commented study file to start from, with the default of each field."""
    from studies.study.files import ready_text
    from studies.study.template import check_new, starter_template, study_template, write_text

    if ready and is_whole:
        raise StudyError("--all: --from copies a ready-made file; leave one of them out")
    if ready.endswith(".json"):
        if out is not None:
            check_new(out)
        start()
        from studies.export.document import import_study

        text = study_template(import_study(ready))
    else:
        text = ready_text(ready) if ready else study_template() if is_whole else starter_template()
    if out is None:
        print(text, end="")
        return
    write_text(out, text)
    console.print(f"written: {out}", soft_wrap=True)


@app.command()
def info(as_json: AsJson = False) -> None:
    """Show versions, devices, precision, compilation cache, and what sweeps run with."""
    start(gpu=True)
    from studies.config import info as facts
    from studies.config import settings
    from studies.engine.executor import executor_text

    found = {**facts(), "executor": executor_text()}
    if as_json:
        print_document(settings(found))
        return
    table = Table(show_header=False)
    for name, value in found.items():
        table.add_row(name, str(value))
    console.print(table)


@app.command()
def cache(
    clear: Annotated[bool, typer.Option("--clear", help="remove these files")] = False,
    as_json: AsJson = False,
) -> None:
    """Show where compiled programs are kept, how many and how large; or remove them."""
    found = cache_contents(clear)
    if as_json:
        print_document(found)
        return
    console.print(f"folder: {found.folder}", soft_wrap=True)
    table = Table("removed" if clear else "kept", "files", "size [MiB]")
    whole = Kept("", found.files, found.bytes)
    for one in (*found.kinds, whole):
        table.add_row(KINDS.get(one.kind, "in all"), str(one.files), f"{one.bytes / 2**20:.1f}")
    console.print(table)
    if clear and is_shared():
        console.print(
            f"programs in XLA's own cache are left: {VARIABLE} names a folder where other programs "
            "may keep theirs",
            soft_wrap=True,
        )


@app.command()
def schema(
    command: Annotated[str, typer.Argument(help="whose document; default: list them")] = "",
) -> None:
    """Print the JSON schema of what a command prints with --json, or writes as JSON."""
    if command:
        print(json.dumps(documents.schema(command), indent=1))
        return
    for name in documents.DOCUMENTS:
        console.print(name)


if __name__ == "__main__":
    main()
