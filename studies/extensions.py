"""Your own laws, drives, metrics, sweep methods and export targets, from one Python file.

    laws = [Law("mine", ...)]
    drives = [DriveLaw("mine", ...)]
    metrics = [Metric("pose_speed", ...)]

`studies --with mine.py sweep ...` loads it, and so does `studies.extend("mine.py")`; a study file
alone never runs code. Workers load what the environment variable FLEXLINK_WITH names.
"""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import sysconfig
import traceback
from collections.abc import Iterable
from pathlib import Path
from shlex import quote
from types import ModuleType
from typing import Any, cast

from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.metrics import METRICS, Metric
from jaxmodel.table import PartError, Table
from studies import sources
from studies.config import stop_keeping_programs
from studies.errors import StudyError
from studies.space.methods import METHODS, Method
from studies.study.labels import RESERVED

#: Lists that a file of one's own can have.
KINDS = ("laws", "drives", "mechanisms", "metrics", "methods", "targets")
#: Where child processes find what was loaded, as paths or module names.
VARIABLE = "FLEXLINK_WITH"


def extend(
    module: str | Path = "",
    laws: Iterable[Law] = (),
    drives: Iterable[DriveLaw] = (),
    mechanisms: Iterable[Mechanism] = (),
    metrics: Iterable[Metric] = (),
    methods: Iterable[Method] = (),
    targets: Iterable[Any] = (),
) -> None:
    """Load parts of one's own; loading them again changes nothing.

    Args:
        module: Python file (`*.py`) or importable module with lists `laws`, `drives`,
            `mechanisms`, `metrics`, `methods` (of sweeps), `targets` (of exports); "" for none.
        laws, drives, mechanisms, metrics, methods, targets: further ones.

    Raises:
        StudyError: no such module, one that fails or is empty, or a name already taken.
    """
    before = set(sys.modules)
    plugin = _imported(str(module)) if str(module) else None
    for kind, added in (
        ("laws", laws),
        ("drives", drives),
        ("mechanisms", mechanisms),
        ("metrics", metrics),
        ("methods", methods),
        ("targets", targets),
    ):
        own = getattr(plugin, kind, ())
        if not isinstance(own, (list, tuple)):
            raise StudyError(f"{module}: {kind} = {own!r}; expected a list")
        for entry in [*own, *added]:
            try:
                name = str(getattr(entry, "name", ""))
                if kind == "metrics" and name in RESERVED:
                    raise PartError(f"metric {name!r}: files use this name; choose another")
                _table(kind).add(entry)
            except PartError as error:
                raise StudyError(f"{module or 'extend'}: {error}") from None
    if plugin is None:
        return
    if not any(hasattr(plugin, kind) for kind in KINDS):
        raise StudyError(f"{module}: has none of the lists {', '.join(KINDS)}")
    file = Path(str(plugin.__file__)).resolve()
    stop_keeping_programs()
    for own in dict.fromkeys([file, *_sources_of(set(sys.modules) - before)]):
        if own not in sources.OUTSIDE:
            sources.OUTSIDE.append(own)
    os.environ[VARIABLE] = os.pathsep.join(dict.fromkeys([*_requested_modules(), str(file)]))


def _sources_of(names: Iterable[str]) -> list[Path]:
    """Files of loaded modules that are neither ours nor installed."""
    files = (getattr(sys.modules.get(name), "__file__", None) for name in sorted(names))
    paths = [Path(str(file)).resolve() for file in files if str(file).endswith(".py")]
    installed = [Path(sysconfig.get_path(x)).resolve() for x in ("stdlib", "purelib", "platlib")]
    installed += [sources.TOP / package for package in sources.PACKAGES]
    return [x for x in paths if not any(x.is_relative_to(folder) for folder in installed)]


def extend_from_environment() -> None:
    """Load what the environment names, in a process started by another one."""
    for module in _requested_modules():
        if Path(module).resolve() not in sources.OUTSIDE:  # it can have another module name here
            extend(module)


def options() -> str:
    """What a command line needs before its command to load the same: "--with mine.py "."""
    return "".join(f"--with {quote(os.path.relpath(name))} " for name in _requested_modules())


def plugin_error(error: BaseException) -> str:
    """Where and why a user's own file failed, in a sentence; "" if the error is not from one.

    Args:
        error: as caught.
    """
    if isinstance(error, PartError):
        return str(error)
    for frame in reversed(traceback.extract_tb(error.__traceback__)):
        if Path(frame.filename).resolve() in sources.OUTSIDE:
            reason = (str(error).strip().splitlines() or [""])[0]
            return f"{frame.filename}, line {frame.lineno}: {type(error).__name__}: {reason}"
    return ""


def _requested_modules() -> list[str]:
    return [name for name in os.environ.get(VARIABLE, "").split(os.pathsep) if name]


def _table(kind: str) -> Table[Any]:
    if kind == "targets":  # a higher layer, whose templates and compilers only exports need
        return cast("Table[Any]", importlib.import_module("studies.export.targets").TARGETS)
    tables: dict[str, Table[Any]] = {
        "laws": LAWS,
        "drives": DRIVES,
        "mechanisms": MECHANISMS,
        "metrics": METRICS,
        "methods": METHODS,
    }
    return tables[kind]


def _imported(module: str) -> ModuleType:
    """A module by its file or name."""
    path = Path(module)
    name = path.stem if path.suffix == ".py" else module
    if path.suffix == ".py" and not path.is_file():
        raise StudyError(f"{module}: no such file")
    loaded = sys.modules.get(name)
    if path.suffix == ".py" and loaded is not None:
        if Path(str(loaded.__file__)).resolve() == path.resolve():
            return loaded
        raise StudyError(f"{module}: a module {name} is loaded already; choose another file name")
    try:
        if path.suffix != ".py":
            return importlib.import_module(module)
        spec = importlib.util.spec_from_file_location(name, path)
        assert spec is not None and spec.loader is not None
        imported = importlib.util.module_from_spec(spec)
        sys.modules[name] = imported
        spec.loader.exec_module(imported)
    except (Exception, SystemExit) as error:  # the file can do anything
        sys.modules.pop(name, None)
        raise StudyError(
            f"{module}: cannot be imported ({type(error).__name__}: {error})"
        ) from None
    return imported
