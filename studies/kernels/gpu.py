"""The traced loop on an Nvidia GPU: one thread per case, its state in registers.

XLA alone would launch several small kernels per sample and keep the state in memory between them;
here a case's whole run is one launch. LLVM writes the same instructions as for the CPU, on scalars,
as PTX; XLA passes PTX to the driver through its own call target. Pallas would work for small loops:
the same loop written in it gives the same results, but Triton, its compiler, traverses all
operations again for every number read or written, and had not finished W0's 2,600 operations after
nine minutes (docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxlib import version as jaxlib_version

from studies.kernels.compilation import compiling
from studies.kernels.llvm import Arguments, Writer, binding, ir
from studies.kernels.traced import TracedLoop

#: Cases per thread block: two warps, so that registers are allocated in small portions.
BLOCK = 64
#: XLA's name for a call of a PTX program, and the versions of jaxlib that are known to have it.
TARGET, KNOWN = "__gpu$xla.gpu.ptx", "0.10"
JAXLIB: str = jaxlib_version.__version__
#: The oldest GPUs the PTX supports; the driver compiles it for the actual one.
_ARCHITECTURE, _PTX = "sm_70", "+ptx63"
_TRIPLE = "nvptx64-nvidia-cuda"


def is_known() -> bool:
    """Whether this version of jaxlib calls PTX programs as this module expects."""
    return JAXLIB.startswith(f"{KNOWN}.")


def build_kernel(
    loop: TracedLoop, n_steps: int, lanes: int
) -> Callable[[Sequence[Any]], list[Any]]:
    """A JAX function of the loop's arrays that returns the state after the last sample.

    Args:
        loop: from `trace_loop`.
        n_steps: samples.
        lanes: cases side by side, a multiple of BLOCK.

    Returns:
        A function of arrays as for `studies.kernels.cpu.Kernel.run`; it can be part of a compiled
        program.
    """
    source = write_ptx(loop, n_steps, lanes)
    state = loop.leaves["state"]
    call = jax.ffi.ffi_call(
        TARGET, [jax.ShapeDtypeStruct((*leaf.shape, lanes), loop.dtype) for leaf in state]
    )
    sizes = {"grid_x": lanes // BLOCK, "block_x": BLOCK, "shared_mem_bytes": 0}
    sizes |= dict.fromkeys(("grid_y", "grid_z", "block_y", "block_z"), 1)
    numbers = {name: np.int32(size) for name, size in sizes.items()}

    def run(arrays: Sequence[Any]) -> list[Any]:
        inputs = [jnp.asarray(x, loop.dtype) for x in arrays]
        return list(call(*inputs, name="run", kernel_type="ptx", kernel_data=source, **numbers))

    return run


def write_ptx(loop: TracedLoop, n_steps: int, lanes: int) -> str:
    """The loop as a program in PTX with one entry `run(leaves..., last state...)`.

    Args:
        loop, n_steps, lanes: as in `build_kernel`.
    """
    _initialise()
    module = ThreadWriter(loop, n_steps, lanes).write()
    _add_entry(module)
    with compiling():
        target = binding.Target.from_triple(_TRIPLE).create_target_machine(
            cpu=_ARCHITECTURE, features=_PTX, opt=3
        )
        parsed = binding.parse_assembly(f'target triple = "{_TRIPLE}"\n{module}')
        optimise(parsed, target)
        return target.emit_assembly(parsed)


def optimise(module: Any, target: Any) -> None:
    """Run LLVM's own passes, which move the state from the stack to registers.

    Args:
        module: parsed.
        target: machine to optimise for.
    """
    tuning = binding.create_pipeline_tuning_options(speed_level=3)
    builder = binding.create_pass_builder(target, tuning)
    builder.getModulePassManager().run(module, builder)


class ThreadWriter(Writer):
    """Writes `case(first, leaves..., last state...)`, the run of one case."""

    def __init__(self, loop: TracedLoop, n_steps: int, lanes: int) -> None:
        super().__init__(loop, 1)
        self._n_steps, self._lanes = n_steps, lanes

    def open(self) -> Arguments:
        kinds = {**self.loop.leaves, "result": self.loop.leaves["state"]}
        count = sum(map(len, kinds.values()))
        signature = ir.FunctionType(ir.VoidType(), [self.index, *[ir.PointerType()] * count])
        function = ir.Function(self.module, signature, "case")
        first, *pointers = function.args
        for pointer in pointers:
            pointer.add_attribute("noalias")
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        rest = iter(pointers)
        bases = {kind: [next(rest) for _ in leaves] for kind, leaves in kinds.items()}
        n_steps, lanes = (ir.Constant(self.index, x) for x in (self._n_steps, self._lanes))
        return Arguments(bases, n_steps, lanes, first)


def _add_entry(module: Any) -> None:
    """Add the entry point of every thread, which finds its case."""
    case = module.globals["case"]
    case.attributes.add("alwaysinline")
    case.linkage = "internal"
    index, *pointers = case.function_type.args
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), pointers), "run")
    function.calling_convention = "ptx_kernel"
    builder = ir.IRBuilder(function.append_basic_block("entry"))
    word = ir.IntType(32)
    reader = ir.FunctionType(word, [])
    names = (f"llvm.nvvm.read.ptx.sreg.{x}" for x in ("ctaid.x", "tid.x"))
    block, thread = (builder.call(ir.Function(module, reader, name), []) for name in names)
    first = builder.add(builder.mul(block, ir.Constant(word, BLOCK)), thread)
    builder.call(case, [builder.zext(first, index), *function.args])
    builder.ret_void()


@cache
def _initialise() -> None:
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
