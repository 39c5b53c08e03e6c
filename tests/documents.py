"""The documents, and the blocks of code in them."""

import re

from tests import TOP

#: README, and the pages of the site; what `make docs` builds is no source.
PAGES = [
    TOP / "README.md",
    *(path for path in sorted((TOP / "docs").rglob("*.md")) if "_build" not in path.parts),
]
NOTEBOOKS = sorted((TOP / "notebooks").glob("*.ipynb"))


def blocks(text, language):
    """Blocks of code in that language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def page(name):
    """Text of a document, by its path from the root."""
    return (TOP / name).read_text(encoding="utf-8")
