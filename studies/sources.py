"""Which source files determine a number: the closure of imports, and its digest."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from pathlib import Path

TOP = Path(__file__).parents[1]
PACKAGES = ("jaxmodel", "studies")

#: Files of laws, metrics, methods and targets that came from outside.
OUTSIDE: list[Path] = []


def digest(*modules: str, top: Path = TOP) -> str:
    """Hash of the sources of modules and all that they import, 16 hexadecimal digits.

    Args:
        modules: dotted names; a package stands for all its modules.
        top: folder of the packages.
    """
    hasher = sha256()
    for path in closure(modules, top):
        hasher.update(str(path.relative_to(top)).encode() + b"\0" + path.read_bytes())
    for path in OUTSIDE:
        hasher.update(path.read_bytes())
    return hasher.hexdigest()[:16]


def closure(modules: Iterable[str], top: Path = TOP) -> list[Path]:
    """Source files of modules and of all modules of these packages that they import, sorted."""
    sources: set[Path] = set()
    waiting = [path for name in modules for path in _whole(name, top)]
    while waiting:
        path = waiting.pop()
        if path not in sources:
            sources.add(path)
            waiting += [file for name in _imports(path) for file in _files(name, top)]
    return sorted(sources)


def _whole(name: str, top: Path) -> Iterable[Path]:
    """Files of a module or of a whole package."""
    folder = top.joinpath(*name.split("."))
    is_package = name.partition(".")[0] in PACKAGES and folder.is_dir()
    return sorted(folder.rglob("*.py")) if is_package else _files(name, top)


@cache
def _files(name: str, top: Path) -> tuple[Path, ...]:
    """File of a module, or of the module with a name; re-exports of packages are left out."""
    parts = name.split(".")
    if parts[0] not in PACKAGES:
        return ()
    for k in range(len(parts), 0, -1):
        at = top.joinpath(*parts[:k])
        for file in (at.with_suffix(".py"), at / "__init__.py"):
            if file.is_file():
                return (file,)
    return ()


@cache
def _imports(path: Path) -> tuple[str, ...]:
    """Names that a file imports when it runs, including those of other packages."""
    return tuple(_imported(ast.parse(path.read_bytes())))


def _imported(node: ast.AST) -> Iterator[str]:
    if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
        return
    if isinstance(node, ast.Import):
        yield from (alias.name for alias in node.names)
    elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield from (f"{node.module}.{alias.name}" for alias in node.names)
    for part in _BLOCKS:  # imports are statements: expressions need not be searched
        for inner in getattr(node, part, ()):
            yield from _imported(inner)


#: Where a statement keeps further ones.
_BLOCKS = ("body", "orelse", "handlers", "finalbody", "cases")
