"""One compiled program for all chunks of a group: vmap over lanes, blocks in turn, all devices."""

from __future__ import annotations

import time
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxmodel.case import Case, Structure
from jaxmodel.simulate import Result, simulate
from studies.runs import uncontrolled, with_ratio
from studies.sweeps.plan import Layout

#: How often a program was traced in this process; the tests count compilations with it.
TRACES: list[Structure] = []


class Program(NamedTuple):
    """What a compiled program depends on; hashable."""

    structure: Structure
    layout: Layout
    tree: Any  # of a Case
    is_varying: tuple[bool, ...]  # per leaf: one value per case, or one for all


@partial(jax.jit, static_argnums=0)
def _run(program: Program, varying: list, shared: list) -> Result:
    """Results of a chunk; what its cases share goes in unbatched and is computed once for all."""
    layout = program.layout
    TRACES.append(program.structure)

    def one(own: list, common: list) -> Result:
        sources = {True: iter(own), False: iter(common)}
        leaves = [next(sources[varies]) for varies in program.is_varying]
        return simulate(program.structure, jax.tree.unflatten(program.tree, leaves))

    def device(own: list, common: list) -> Result:
        blocks = [x.reshape((layout.blocks, layout.lanes, *x.shape[1:])) for x in own]
        done = jax.lax.map(lambda lanes: jax.vmap(one, (0, None))(lanes, common), blocks)
        return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), done)

    devices = np.array(jax.local_devices()[: layout.devices])
    each, same = PartitionSpec("cases"), PartitionSpec()
    return jax.shard_map(
        device, mesh=Mesh(devices, ("cases",)), in_specs=(each, same), out_specs=each,
        check_vma=False,
    )(varying, shared)  # fmt: skip


class Executor:
    """Runs chunks of one group; compiled by its first chunk."""

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0  # [s]
        self.temporary_bytes = 0  # that the program needs beside its arguments
        self._compiled: Any = None

    def __call__(self, cases: Case) -> Result:
        """Start a chunk; the arrays of the result are still being computed when this returns.

        Args:
            cases: from `chunk_cases`, `layout.size` of them.
        """
        if self.has_own_ratio:  # the same program for both passes
            cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, self._ratio_shape))
        leaves, tree = jax.tree.flatten(cases)
        leaves = [np.asarray(leaf) for leaf in leaves]
        is_varying = tuple(len(leaf) == self.layout.size for leaf in leaves)
        varying = [leaf for leaf, varies in zip(leaves, is_varying, strict=True) if varies]
        shared = [leaf[0] for leaf, varies in zip(leaves, is_varying, strict=True) if not varies]
        if self._compiled is None:
            program = Program(self.structure, self.layout, tree, is_varying)
            started = time.perf_counter()
            self._compiled = _run.lower(program, varying, shared).compile()
            memory = self._compiled.memory_analysis()
            self.temporary_bytes = getattr(memory, "temp_size_in_bytes", 0) * self.layout.devices
            self.compile_time = time.perf_counter() - started
        return self._compiled(varying, shared)

    def energy_ratio(self, cases: Case) -> np.ndarray:
        """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
        return np.asarray(self(uncontrolled(cases)).energy_ratio)

    @property
    def _ratio_shape(self) -> tuple[int, int, int]:
        return (self.layout.size, 3, self.structure.n_controlled)
