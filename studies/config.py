"""JAX settings that must be made before it starts: precision, compiler flags, devices, cache.

Importing this module changes nothing; `configure` does, and `info` shows the current settings.
"""

from __future__ import annotations

import gc
import importlib.metadata
import os
import platform
import re
import sys
import warnings
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any, Literal

from studies.cache import chosen_folder, exposure, is_usable
from studies.errors import CacheWarning, StudyError, field_error, nearest
from studies.results.labelled import Labelled, labels, told
from studies.threads import SharedSetting

PACKAGE = "flexlink-studies"
PRECISIONS = ("float64", "float32")

#: Minor versions that the tests have run with, in continuous integration. JAX changes its internals
#: between them, and kernels read some.
TESTED = {
    "python": ("3.11", "3.12", "3.13"),
    "jax": ("0.10", "0.12"),
    "jaxlib": ("0.10", "0.12"),
    "numpy": ("2.4", "2.5"),
    "h5py": ("3.16",),
    "llvmlite": ("0.50",),
}

# Flags of XLA's CPU compiler for a scan over time steps vectorised over cases.
# XLA aborts on an unknown flag, so each one is tested with every supported JAX.
COMPILER_FLAGS = {
    # XLA's default is at most 256 bits; CPUs with 512 take twice the cases per instruction.
    "--xla_cpu_prefer_vector_width": "512",
    # Fewer factorisations run side by side, see `POOL`.
    "--xla_cpu_enable_concurrency_optimized_scheduler": "false",
    # None of the products and sums that XLA hands to the library YNNPACK. In large batches these
    # gave wrong numbers without a word: jaxlib 0.10.2 products of small matrices summed over more
    # than 16,384 rows (jax-ml/jax#39103), 0.11.2 NaN for pseudo-inverses of 1,536 matrices.
    "--xla_cpu_experimental_ynn_fusion_type": "",
    "--xla_backend_extra_options": ",".join(
        (
            # Without it, each state output recomputes the expressions it shares with the others.
            "xla_cpu_use_multi_output_fusion",
            # Loops up to this many bytes run as one compiled function instead of one task per
            # operation. A lower limit excludes the batched time loop. Reverse mode through a long
            # scan must then checkpoint blocks of steps: a scan that stores every step copies the
            # whole storage at each of them (measured: 30 to 100 times slower over 2000 steps).
            "xla_cpu_small_while_loop_byte_threshold=2000000",
        )
    ),
}
# Threads of XLA's CPU client, by default one per core. Factorisations of many matrices are divided
# among these threads, and the one that divides waits (jax::ParallelBatchMap, jaxlib 0.10): as many
# of them side by side as there are threads never finish. More threads make batches of
# factorisations slower (32 plants on 2 cores: 13 ms with 2 threads, 22 ms with 8 or with 64).
POOL, LEAST_THREADS, THREADS_PER_CORE = "NPROC", 64, 4
# Python looks for unreachable cycles after so many new objects. Tracing makes millions that stay:
# with Python's own numbers, a fifth of a sweep's start went into looking through them.
GARBAGE, PYTHONS_OWN = (50_000, 50, 50), ((700, 10, 10), (2000, 10, 10))
# XLA logs a compilation of more than two minutes as an error and asks for a bug report. No flag
# hides this alarm alone. From this level on, XLA logs only what ends the process; whatever fails
# still reaches the caller as a Python exception. XLA reads the level while JAX is imported.
LOG_LEVEL = ("TF_CPP_MIN_LOG_LEVEL", "3")
# XLA runs a program on one core per device, so a batch uses all cores through one device per core.
DEVICE_FLAG = "--xla_force_host_platform_device_count"


def _settings() -> Any:
    """JAX's settings; type checkers cannot see its attributes, which are created at run time."""
    import jax

    return jax.config


def configure(
    precision: str = "float64",
    devices: int | None = None,
    flags: bool = True,
    cache: bool = True,
) -> None:
    """Prepare JAX for studies; call it before the first JAX operation.

    XLA gets more threads than there are cores, through NPROC, see POOL. Python then looks for
    cyclic garbage less often, unless `gc.set_threshold` has been used before.
    If JAX has not been imported yet, XLA's alarm about slow compilations is hidden (LOG_LEVEL),
    unless the environment sets its own level. Calls with equal settings can be repeated at any
    time.

    Args:
        precision: "float64" or "float32", the default floating type.
        devices: number of CPU devices; None: as in XLA_FLAGS, otherwise one per usable core.
        flags: add COMPILER_FLAGS to XLA_FLAGS, except those the environment already sets.
        cache: keep compiled programs in JAX_COMPILATION_CACHE_DIR or the user's cache folder,
            unless others can write there (CacheWarning).

    Raises:
        StudyError: a value outside its range, or JAX has already started without the requested
            flags or devices.
    """
    if precision not in PRECISIONS:
        hint = nearest(str(precision), PRECISIONS)
        raise field_error("precision", precision, " or ".join(PRECISIONS), hint=hint)
    if devices is not None and (not isinstance(devices, int) or devices < 1):
        raise field_error("devices", devices, "a whole number from 1")

    _collect_garbage_less_often()
    os.environ.setdefault(*LOG_LEVEL)
    old_flags = os.environ.get("XLA_FLAGS", "")
    new_flags = _extended(old_flags, devices, flags)
    if not is_backend_started():
        os.environ["XLA_FLAGS"] = new_flags
        os.environ[POOL] = str(_threads(os.environ.get(POOL, "")))
    else:
        _require_in_force(old_flags, devices, flags)
    _settings().update("jax_enable_x64", precision == "float64")
    global _is_configured
    if not _is_configured:
        os.register_at_fork(after_in_child=_note_fork)
    _is_configured = True
    _set_cache(cache)


def _threads(present: str) -> int:
    """Threads of XLA's pool: enough, and at least as many as the environment asks for."""
    asked = int(present) if present.isdecimal() else 0
    return max(LEAST_THREADS, THREADS_PER_CORE * usable_cores(), asked)


def _collect_garbage_less_often() -> None:
    if gc.get_threshold() in PYTHONS_OWN:
        gc.set_threshold(*GARBAGE)


_keeps_programs = False


def keep_programs() -> None:
    """Keep the compiled programs of this process on disk, and use those that were kept.

    For commands: what a session of Python changes by hand in a module would not be noticed.
    """
    global _keeps_programs
    _keeps_programs = True


#: Whether a command shows its phases, and so what it waits for.
shows_phases = False
_told: set[str] = set()


def tell_wait(text: str) -> None:
    """Say what a command without phases waits for."""
    if _keeps_programs and not shows_phases and text not in _told:
        _told.add(text)
        print(f"studies: {text}", file=sys.stderr, flush=True)


def stop_keeping_programs() -> None:
    """For parts of the user's own: no name tells what files these have read."""
    global _keeps_programs
    _keeps_programs = False


def is_keeping() -> bool:
    """Whether compiled programs are kept, see `keep_programs`."""
    return _keeps_programs


def _leave_cache() -> Callable[[], None]:
    _turn_cache(False)
    return lambda: _turn_cache(_has_cache)


def _turn_cache(is_on: bool) -> None:
    from jax.experimental.compilation_cache.compilation_cache import reset_cache

    _settings().update("jax_enable_compilation_cache", is_on)
    reset_cache()  # what JAX has decided when it compiled first


#: Compile anew: an executable from JAX's own cache lacks what it needs to be kept elsewhere.
without_jax_cache = SharedSetting(_leave_cache)


def start(precision: str = "float64", gpu: bool = False) -> None:
    """Configure and start JAX, as every computing command does.

    gpu: compute on GPUs if JAX finds some; they are worth it for thousands of cases.

    Raises StudyError as `configure`, or if JAX cannot start.
    """
    configure(precision)
    if _has_cache and not any(chosen_folder().iterdir()):
        tell_wait("the first commands on a machine compile what they need, up to a minute each ...")
    import jax

    if not gpu:
        _settings().update("jax_platforms", "cpu")
    try:
        jax.local_devices()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).partition("\n")[0] or "no device of the platform asked for"
        names = ("JAX_PLATFORMS", "XLA_FLAGS")
        settings = ", ".join(f"{name}={os.environ.get(name, '')!r}" for name in names)
        raise StudyError(f"JAX cannot start: {reason} ({settings})") from None


def info() -> dict[str, Any]:
    """Versions and current settings, as plain values for `studies info`; starts JAX."""
    import jax

    kinds = [device.device_kind for device in jax.devices()]
    return {
        PACKAGE: _version(PACKAGE),
        "python": platform.python_version(),
        **{name: _version(name) for name in ("jax", "jaxlib", "numpy", "h5py", "llvmlite")},
        "untested_versions": untested(),
        "processor": processor_text(),
        "devices": ", ".join(f"{kinds.count(kind)} x {kind}" for kind in sorted(set(kinds))),
        "precision": "float64" if _settings().jax_enable_x64 else "float32",
        "cache": cache_folder() or "none",
        "xla_flags": os.environ.get("XLA_FLAGS", ""),
    }


class CurrentSettings(Labelled, command="info", version=2):
    """What `studies info --json` prints: versions and settings."""

    versions: dict[str, str] = told("of packages and Python, or not installed")
    untested_versions: str = told("installed, but the tests have never run with them; or none")
    processor: str = told("of this machine")
    devices: str = told("of JAX")
    precision: Literal["float64", "float32"] = told("of numbers")
    cache: str = told("folder of compiled programs, none if they are not kept")
    xla_flags: str = told("in XLA_FLAGS")
    executor: str = told("what sweeps run with")


def settings(facts: Mapping[str, Any]) -> CurrentSettings:
    """The same from `info`, with the executor."""
    others = {name: x for name, x in facts.items() if name in labels(CurrentSettings)}
    return CurrentSettings({name: x for name, x in facts.items() if name not in others}, **others)


def untested() -> str:
    """Installed versions that the tests have never run with, and those they have; or "none"."""
    present = {name: _version(name) for name in TESTED} | {"python": platform.python_version()}
    unknown = [
        f"{name} {version} (tested: {', '.join(TESTED[name])})"
        for name, version in present.items()
        if version != _ABSENT and ".".join(version.split(".")[:2]) not in TESTED[name]
    ]
    return ", ".join(unknown) or "none"


def origin() -> dict[str, str]:
    """Labels for results: versions, devices and precision; starts JAX."""
    facts = info()
    names = (PACKAGE, "python", "jax", "jaxlib", "numpy", "h5py", "devices", "precision")
    return {name: str(facts[name]) for name in names}


def cache_folder() -> str:
    """Where compiled programs are kept; "" for nowhere."""
    return (_has_cache and _settings().jax_compilation_cache_dir) or ""


_is_configured = False
#: Whether this process was forked from one in which JAX had started.
_is_stranded = False


def _note_fork() -> None:
    global _is_stranded
    _is_stranded = is_backend_started()


def processor() -> str:
    """What JAX computes on: "cpu", "cuda" for Nvidia GPUs, or another name."""
    import jax

    device = jax.local_devices()[0]
    is_cuda = "cuda" in getattr(device.client, "platform_version", "").lower()
    return "cuda" if device.platform == "gpu" and is_cuda else str(device.platform)


def hosts() -> list[Any]:
    """The devices of this machine's cores, also where JAX computes on GPUs; one per core."""
    import jax

    try:
        return list(jax.local_devices(backend="cpu"))
    except RuntimeError:  # JAX_PLATFORMS leaves them out
        return jax.local_devices()[:1]


def device_now() -> Any:
    """What programs are compiled for here: within `on_host` a core, otherwise JAX's default."""
    import jax

    return _settings().jax_default_device or jax.local_devices()[0]


def on_host() -> AbstractContextManager[Any]:
    """Programs compiled or called within it are for the cores, also where JAX computes on GPUs."""
    import jax

    is_host = processor() == "cpu"
    return nullcontext() if is_host else jax.default_device(hosts()[0])


def processor_text() -> str:
    """Name of this machine's processor and number of cores, as results of a benchmark need them."""
    try:
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8")
    except OSError:
        text = ""
    match = re.search(r"^model name\s*: (.+)$", text, re.MULTILINE)
    name = match[1].strip() if match else platform.processor() or platform.machine()
    widest = next((x for x in ("avx512f", "avx2", "asimd") if re.search(rf"\b{x}\b", text)), "")
    return f"{usable_cores()} x {name}" + (f" ({widest})" if widest else "")


def require_configured() -> None:
    """Raise StudyError unless `configure` has been called: JAX's default is single precision.

    Also in a process forked from one in which JAX has started: its threads are not there, and what
    they were to compute would be waited for without end.
    """
    if not _is_configured:
        raise StudyError(
            "studies.configure() must be called first, before any JAX operation: it sets double "
            "precision, compiler flags, devices and the compilation cache"
        )
    if _is_stranded:
        raise StudyError(
            "this process was forked from one in which JAX has started, and would wait for the "
            'other\'s threads without end; use multiprocessing.get_context("spawn")'
        )


def is_backend_started() -> bool:
    """Whether JAX has started its devices, after which compiler flags are no longer read."""
    count = _settings().jax_num_cpu_devices
    try:
        # The only public sign: JAX refuses to change this setting once it has started.
        _settings().update("jax_num_cpu_devices", count + 1)
    except RuntimeError:
        return True
    _settings().update("jax_num_cpu_devices", count)
    return False


def _extended(present: str, devices: int | None, flags: bool) -> str:
    """XLA_FLAGS with missing flags added; an explicit number of devices replaces its own."""
    required = dict(COMPILER_FLAGS) if flags else {}
    if devices is not None:
        present = re.sub(rf"{DEVICE_FLAG}=\S*", "", present)
    required[DEVICE_FLAG] = str(devices or usable_cores())
    missing = [f"{name}={value}" for name, value in required.items() if name not in present]
    return " ".join(present.split() + missing)


def _require_in_force(present: str, devices: int | None, flags: bool) -> None:
    """Raise StudyError if JAX has already started without the requested settings."""
    import jax

    lacking = [name for name in COMPILER_FLAGS if flags and name not in present]
    count = len(jax.local_devices(backend="cpu"))
    if devices not in (None, count):
        lacking.append(f"{devices} CPU devices (it has {count})")
    if lacking:
        raise StudyError(
            f"configure() came too late: JAX has already started without {', '.join(lacking)}; "
            "call it before the first JAX operation (in a notebook: restart the kernel), "
            "or accept JAX as it is with configure(flags=False): several times slower and, with "
            "jaxlib 0.10.2 to 0.11, wrong in sums over large batches"
        )


_has_cache = False


def _set_cache(cache: bool) -> None:
    """Turn the persistent cache of compiled programs on or off."""
    global _has_cache
    _has_cache = cache and is_usable(folder := chosen_folder())
    if _has_cache and (fault := exposure(folder)):
        warnings.warn(fault, CacheWarning, stacklevel=3)
        _has_cache = False
    # The cache only saves time: an unwritable home folder must not stop a study.
    _settings().update("jax_enable_compilation_cache", _has_cache)
    if _has_cache:
        _settings().update("jax_compilation_cache_dir", str(folder))
        # Reading an entry takes tens of milliseconds: not worth it for quick compilations.
        _settings().update("jax_persistent_cache_min_compile_time_secs", 0.5)


def usable_cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


_ABSENT = "not installed"


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return _ABSENT
