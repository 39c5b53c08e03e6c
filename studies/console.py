"""Where all output for people goes."""

from __future__ import annotations

import os
import sys
from typing import Any

from rich.console import Console
from rich.text import Text

from studies.errors import printable

#: Width of tables in redirected output; a terminal uses its own width.
FILE_WIDTH = 240


class SafeConsole(Console):
    """Prints texts of files, such as titles, without control sequences that they may hold."""

    def render_str(self, text: str, **options: Any) -> Text:
        return super().render_str(printable(text), **options)


def make_console() -> Console:
    """A console of standard output."""
    is_watched = (sys.stdout is not None and sys.stdout.isatty()) or "COLUMNS" in os.environ
    return SafeConsole(
        highlight=False,
        markup=False,  # units in brackets are not markup
        width=None if is_watched else FILE_WIDTH,
    )
