"""Compiled programs, kept on disk: a warm start neither traces nor compiles them.

XLA's own cache saves compiling, but JAX must trace and lower a program before it can look there,
which takes most of a warm start. A program here is found by its function, its static arguments, the
shapes of the others, and everything else that it depends on: the code of the function's module and
of all that it imports (`sources.digest`), versions, processor and flags. It is kept beside the
kernels, under the user's key (`studies.kernels.compilation`).

Only commands without parts of the user's own keep programs (`config.keep_programs`): no name tells
what a session of Python has changed by hand in a module, or what files a user's law has read.
"""

from __future__ import annotations

import gc
import os
import pickle
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import fields, is_dataclass
from functools import cache, cached_property, update_wrapper
from pathlib import Path
from threading import Lock, RLock
from typing import Any

import jax
import jaxlib
import numpy as np
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from studies import config, sources
from studies.config import device_now, is_keeping, on_host, processor_text, without_jax_cache
from studies.kernels import native
from studies.kernels.compilation import ObjectCache
from studies.space.free import Placing

_LOCK = Lock()
#: Held while a program is made, by its name: others are made meanwhile.
_MAKING: defaultdict[str, RLock] = defaultdict(RLock)
#: Compiled programs hold some memory mappings each, and LLVM ends a process that wants more than
#: the 65,530 of Linux. Programs of a sweep or tuning take up to 10,000.
MOST_MAPPINGS = 20_000
#: Mappings that stayed when programs were last dropped: of those in use.
_STAYED = [0]
#: Compiled programs of this process, by name.
_PROGRAMS: dict[str, Any] = {}


@cache
def quick_options(effort: int = 0) -> dict[str, Any]:
    """Compiler options for programs on this machine's cores.

    With effort 0 XLA takes a fifth of its default time, for a few cases; with 1 three quarters, for
    programs that then run in about a third of the time. Not for every program: a scan over time
    runs seven times slower, and a derivative with many shared terms can take minutes to compile.
    """
    found: dict[str, Any] = {"xla_backend_optimization_level": effort}
    quicker = found | {"xla_cpu_use_fusion_emitters": False}
    with on_host():
        lowered = jax.jit(lambda: 0).lower()
    try:
        lowered.compile(compiler_options=quicker)
    except (RuntimeError, ValueError):  # an option that this jaxlib does not know, as 0.11
        return found
    return quicker


class KeptFunction:
    """A function whose programs are kept, made by `kept_jit`; they run on this machine's cores."""

    def __init__(
        self, function: Callable[..., Any], static: tuple[int, ...], is_quick: bool
    ) -> None:
        update_wrapper(self, function)
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._static = static  # ascending
        self._is_quick = is_quick
        self._function = function
        self._inner = jax.jit(function, static_argnums=static)  # as a part of another program

    @cached_property
    def _jit(self) -> Any:
        options = quick_options() if self._is_quick else None
        return jax.jit(self._function, static_argnums=self._static, compiler_options=options)

    def __call__(self, *arguments: Any) -> Any:
        fixed, free = self._split(arguments)
        if any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(free)):
            return self._inner(*arguments)
        with on_host():
            if not self._is_kept(fixed):
                return self._jit(*arguments)
            return self._kept(fixed, free, arguments)(*free)

    def program(self, *arguments: Any) -> Callable[..., Any]:
        """The program for arguments like these, a function of those that are not static.

        Called often, it saves finding it anew.
        """
        fixed, free = self._split(arguments)
        if not self._is_kept(fixed):
            return lambda *free: self(*self._join(fixed, free))
        with on_host():
            return self._kept(fixed, free, arguments)

    def _is_kept(self, fixed: list[Any]) -> bool:
        return is_keeping() and all(map(is_plain, fixed))

    def _kept(self, fixed: list[Any], free: list[Any], arguments: tuple[Any, ...]) -> Any:
        names = [self._name, *fixed]
        return program(names, free, lambda: self._jit.lower(*arguments), self.__module__)

    def _split(self, arguments: tuple[Any, ...]) -> tuple[list[Any], list[Any]]:
        free = [x for k, x in enumerate(arguments) if k not in self._static]
        return [arguments[k] for k in self._static], free

    def _join(self, fixed: list[Any], free: tuple[Any, ...]) -> list[Any]:
        arguments = list(free)
        for k, x in zip(self._static, fixed, strict=True):
            arguments.insert(k, x)
        return arguments


def kept_jit(
    static_argnums: int | tuple[int, ...] = (), is_quick: bool = False
) -> Callable[[Callable[..., Any]], KeptFunction]:
    """`jax.jit` whose programs are kept, and run on this machine's cores: GPUs are for many cases.

    Args:
        static_argnums: arguments that are part of the program. With others than numbers, texts,
            `...`, tuples of them and `Placing`, the program is not kept: no name tells a function
            from another.
        is_quick: compiled with `quick_options`.

    Example:
        >>> @kept_jit(static_argnums=0)
        ... def power(n: int, x: jax.Array) -> jax.Array:
        ...     return x**n
    """
    static = (static_argnums,) if isinstance(static_argnums, int) else static_argnums
    return lambda function: KeptFunction(function, static, is_quick)


def is_plain(x: Any) -> bool:
    """Whether the `repr` of a static argument names it in every process."""
    if isinstance(x, Placing):
        return is_plain(x.arguments)
    if isinstance(x, tuple):
        return all(map(is_plain, x))
    return x is None or x is ... or isinstance(x, bool | int | float | str)


def program(names: list[Any], arguments: list[Any], lower: Callable[[], Any], module: str) -> Any:
    """A compiled program: of this process, from disk, or compiled now and kept.

    Args:
        names: tell it from all others, by their `repr`.
        arguments: of its calls.
        lower: traces and lowers it.
        module: has the code, itself or among its imports; but for that of functions in `names`.

    Returns:
        The program, a function of `arguments`.
    """
    leaves, tree = jax.tree.flatten(arguments)
    shapes = [str(jax.typeof(x)) for x in leaves]
    name = repr((names, tree, shapes, str(device_now()), is_keeping()))
    with _LOCK:
        making = _MAKING[name]
    with making:
        found = _PROGRAMS.get(name)
        if found is None:
            modules = module, *modules_of(names)
            label = str(names[0]).rpartition(".")[2].strip("_").replace("_", " ")
            found = _PROGRAMS[name] = _load_or_compile(name, label, lower, modules)
        return found


def drop_programs(share: float = 1.0) -> None:
    """Forget compiled programs before they become too many; those in use stay.

    What stays counts once more, or a process with many in use would make its programs at each call.

    Args:
        share: of the most that may be, from which on they go [1].
    """
    if _mappings() > share * MOST_MAPPINGS + _STAYED[0]:
        _PROGRAMS.clear()
        jax.clear_caches()
        gc.collect()
        _STAYED[0] = min(_mappings(), MOST_MAPPINGS)


def _mappings() -> int:
    """Memory mappings of this process; 0 where the system does not list them."""
    try:
        return Path("/proc/self/maps").read_bytes().count(b"\n")
    except OSError:
        return 0


def _load_or_compile(
    name: str, label: str, lower: Callable[[], Any], modules: Iterable[str]
) -> Any:
    if not is_keeping():
        return lower().compile()
    entry = ObjectCache("program", name, *environment(*modules))
    content = entry.take()
    if content and (loaded := _load(content)) is not None:
        return loaded
    config.tell_wait(f"compiling {label}, which is kept for later runs ...")
    lowered = lower()
    with without_jax_cache():
        compiled = lowered.compile()
    with suppress(RuntimeError):  # XLA cannot write every program, and keeping only saves time
        payload, *trees = serialize(compiled)
        # not every tree's structure can be pickled, but a tree of numbers
        examples = [jax.tree.unflatten(tree, range(tree.num_leaves)) for tree in trees]
        entry.keep(pickle.dumps((payload, *examples)))
    return compiled


def kept_data(names: list[Any], make: Callable[[], Any], module: str) -> Any:
    """Data that can be pickled: from disk, or made now and kept.

    Args:
        names: everything they depend on but the code, by `repr`; none: they are not kept.
        make: makes them.
        module: as for `program`.
    """
    if not names or not is_keeping():
        return make()
    entry = ObjectCache("data", repr(names), *environment(module, *modules_of(names)))
    if content := entry.take():
        return pickle.loads(content)
    data = make()
    entry.keep(pickle.dumps(data))
    return data


def environment(*modules: str) -> tuple[str, ...]:
    """All that programs of these modules depend on, whatever they compute."""
    return (
        sources.digest(__name__, *modules),
        jax.__version__,
        jaxlib.version.__version__,
        *native.this_processor(),
        processor_text(),
        os.environ.get("XLA_FLAGS", ""),
        str(jax.local_devices()),
        str(jax.dtypes.canonicalize_dtype(float)),
    )


def modules_of(names: Any) -> Iterator[str]:
    """Modules of the functions that names hold."""
    if callable(names):
        yield names.__module__
    if is_dataclass(names):
        names = [getattr(names, field.name) for field in fields(names)]
    if isinstance(names, list | tuple):
        for name in names:
            yield from modules_of(name)


def _load(content: bytes) -> Any:
    """A program from disk; None if it cannot be used."""
    try:
        _initialise_lapack()
        payload, *examples = pickle.loads(content)
        in_tree, out_tree = map(jax.tree.structure, examples)
        return deserialize_and_load(payload, in_tree, out_tree, execution_devices=[device_now()])
    except Exception:  # whatever a newer jaxlib raises: the cache only saves time
        return None


@cache
def _initialise_lapack() -> None:
    """JAX loads LAPACK when it first lowers a call of it."""
    jax.jit(jax.numpy.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), np.float64))
