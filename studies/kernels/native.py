"""LLVM's code generator by itself: text in, machine code out; also as a process of its own.

`python native.py` reads a line of JSON, the processor and the effort, and then the module's text
from its input, and writes the machine code. It imports llvmlite only, so it starts at once.
"""

from __future__ import annotations

import json
import platform
import subprocess
import sys
from functools import cache
from typing import Any, NamedTuple

try:
    from llvmlite import binding as binding
except ImportError:  # not on this platform
    binding = None

#: Longest time that a process of its own may take [s].
LONGEST = 300.0


class Processor(NamedTuple):
    """What machine code is for."""

    name: str
    features: str  # as LLVM writes them: "+avx2,-avx512f,..."
    triple: str

    @property
    def vector_bytes(self) -> int:
        """Size of a register: 64 with AVX-512, 32 with AVX2, 16 otherwise."""
        return 64 if self.has_masks else 32 if self._has("avx2") else 16

    @property
    def has_masks(self) -> bool:
        """Whether stores may leave lanes out and instructions spread numbers as they read them."""
        return self._has("avx512f")

    def without(self, *prefixes: str) -> Processor:
        """The same processor with fewer features, as older ones are."""
        features = self.features.split(",")
        kept = [f"-{x[1:]}" if x[1:].startswith(prefixes) else x for x in features]
        return self._replace(features=",".join(kept))

    def _has(self, feature: str) -> bool:
        return f"+{feature}" in self.features.split(",")


@cache
def this_processor() -> Processor:
    """The one that this program runs on; where LLVM is not there to say, no more than its kind."""
    if binding is None:
        return Processor(platform.machine(), "", "")
    features = binding.get_host_cpu_features().flatten()
    return Processor(binding.get_host_cpu_name(), features, binding.get_default_triple())


@cache
def initialise() -> None:
    """Prepare LLVM for this processor."""
    for part in ("initialize_native_target", "initialize_native_asmprinter"):
        getattr(binding, part)()


def target_machine(processor: Processor, effort: int) -> Any:
    """LLVM's code generator for a processor.

    Args:
        processor: what for.
        effort: its optimisation level, 0 to 3.
    """
    initialise()
    return binding.Target.from_triple(processor.triple).create_target_machine(
        cpu=processor.name, features=processor.features, opt=effort, jit=True
    )


def machine_code(text: str, processor: Processor, effort: int) -> bytes:
    """Machine code of a module, as an object file; arguments as `target_machine`."""
    machine = target_machine(processor, effort)
    code: bytes = machine.emit_object(binding.parse_assembly(text))
    return code


def machine_code_apart(text: str, processor: Processor, effort: int) -> bytes | None:
    """The same from a process of its own, since LLVM works for one thread at a time.

    Returns:
        None if that process failed.
    """
    head = json.dumps([*processor, effort])
    try:
        done = subprocess.run(
            [sys.executable, "-P", __file__],
            input=f"{head}\n{text}".encode(),
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=LONGEST,
            check=True,
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout or None


def load_code(code: bytes, processor: Processor) -> Any:
    """An engine that holds machine code."""
    machine = target_machine(processor, 0)
    engine = binding.create_mcjit_compiler(binding.parse_assembly(""), machine)
    engine.add_object_file(binding.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return engine


def _main() -> None:
    head, text = sys.stdin.buffer.read().split(b"\n", 1)
    *names, effort = json.loads(head)
    sys.stdout.buffer.write(machine_code(text.decode(), Processor(*names), effort))


if __name__ == "__main__":
    _main()
