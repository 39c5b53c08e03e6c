"""JSON documents: what reading commands print with --json, and what folders keep.

A document names its format, its numbers are in SI units under their names in files, and what is not
a finite number is null. `studies schema` prints the schema of every format.
"""

from __future__ import annotations

import json
import sys
from typing import Annotated, TypeAlias

import typer

from studies.results.labelled import Labelled, document

#: The option of every reading command.
AsJson: TypeAlias = Annotated[
    bool, typer.Option("--json", help="print one JSON document; `studies schema` describes it")
]


def json_text(result: Labelled) -> str:
    """Text of the document of a result; its format is `flexlink-COMMAND`."""
    head = {"format": f"flexlink-{result.COMMAND}", "format_version": result.VERSION}
    return json.dumps(head | document(result), indent=1, allow_nan=False) + "\n"


def print_document(result: Labelled) -> None:
    """Print a document, all that standard output gets."""
    sys.stdout.write(json_text(result))
