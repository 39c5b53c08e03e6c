"""`python .ci/code_lines.py`: lines of code by folder, without blanks, comments and docstrings."""

from __future__ import annotations

import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

TOP = Path(__file__).parents[1]
PACKAGES = ("jaxmodel", "studies")
_LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}


def code_lines(text: str) -> int:
    """Lines of a module's text that hold code."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - _docstring_lines(ast.parse(text)))


def _docstring_lines(tree: ast.Module) -> set[int]:
    lines: set[int] = set()
    documented = ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef
    for node in ast.walk(tree):
        if isinstance(node, documented) and ast.get_docstring(node, clean=False) is not None:
            docstring = node.body[0]
            lines.update(range(docstring.lineno, (docstring.end_lineno or docstring.lineno) + 1))
    return lines


def main() -> None:
    count: Counter[str] = Counter()
    for package in PACKAGES:
        for path in sorted((TOP / package).rglob("*.py")):
            folder = path.relative_to(TOP).parent.as_posix()
            count[folder] += code_lines(path.read_text(encoding="utf-8"))
    for folder, lines in sorted(count.items()):
        print(f"{lines:7d}  {folder}")
    print(f"{count.total():7d}  in all")


if __name__ == "__main__":
    main()
