"""The traced loop on an Nvidia GPU: one thread per case, its state in registers.

XLA alone would launch several small kernels per sample and keep the state in memory between them;
here a case's whole run is one launch. LLVM writes the same instructions as for the CPU, on scalars,
as PTX; XLA passes PTX to the driver through its own call target. Pallas would work for small loops:
the same loop written in it gives the same results, but Triton, its compiler, traverses all
operations again for every number read or written, and had not finished W0's 2,600 operations after
nine minutes (docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from studies.errors import NoKernelError
from studies.kernels.compilation import compiling
from studies.kernels.differentiable import LoopCall
from studies.kernels.llvm import Arguments, Writer, binding, ir
from studies.kernels.traced import TracedLoop

#: Cases per thread block: two warps, so that registers are allocated in small portions.
BLOCK = 64
#: XLA's name for a call of a PTX program.
TARGET = "__gpu$xla.gpu.ptx"
#: The oldest GPUs the PTX supports; the driver compiles it for the actual one.
_ARCHITECTURE, _PTX = "sm_70", "+ptx63"
_TRIPLE = "nvptx64-nvidia-cuda"


class GpuCall(LoopCall):
    """A call of a kernel for a GPU, a launch of one thread per case."""

    RECORD = 2**31

    @staticmethod
    def has_routines() -> bool:
        return False

    def prepare(self) -> None:
        if self.make().operations()["tanh"]:
            raise NoKernelError("the GPU kernel does not support tanh, which friction needs")

    def note_run(self, seconds: float) -> None:
        pass

    def __call__(self, arrays: Sequence[Any]) -> list[Any]:
        call = jax.ffi.ffi_call(TARGET, self.shapes, vmap_method="sequential")
        sizes = {"grid_x": self.lanes // BLOCK, "block_x": BLOCK, "shared_mem_bytes": 0}
        sizes |= dict.fromkeys(("grid_y", "grid_z", "block_y", "block_z"), 1)
        numbers = {name: np.int32(size) for name, size in sizes.items()}
        source = write_ptx(self.make(), self.n_steps, self.lanes)
        inputs = [jnp.asarray(x, self.dtype) for x in arrays]
        return list(call(*inputs, name="run", kernel_type="ptx", kernel_data=source, **numbers))


def write_ptx(loop: TracedLoop, n_steps: int, lanes: int) -> str:
    """The loop as a program in PTX with one entry `run(leaves..., last state..., records...)`.

    Args:
        loop, n_steps, lanes: as in `LoopCall.of_loop`.
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
    """Writes `case(first, leaves..., last state..., records...)`, the run of one case."""

    def __init__(self, loop: TracedLoop, n_steps: int, lanes: int) -> None:
        super().__init__(loop, 1)
        self._n_steps, self._lanes = n_steps, lanes

    def open(self) -> Arguments:
        leaves = self.loop.leaves
        kinds = {kind: leaves[kind] for kind in ("constant", "input", "state")}
        kinds |= {"result": leaves["state"], "record": leaves.get("record", [])}
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
