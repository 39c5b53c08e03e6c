"""One compiled program for all chunks of a group: vmap over lanes, blocks in turn, all devices."""

from __future__ import annotations

import time
from typing import Any

import jax
import numpy as np
from jax.sharding import PartitionSpec

from jaxmodel.case import Case, Structure
from jaxmodel.simulate import Result, simulate
from studies.runs import uncontrolled, with_ratio
from studies.sweeps.plan import Layout

#: How often a program was traced in this process; the tests count compilations with it.
TRACES: list[Structure] = []


class Executor:
    """Runs chunks of one group; compiled by its first chunk.

    What the cases share goes in once, unbatched, and so is computed once for all of them.
    """

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
        if not self.has_own_ratio:
            return self._run(cases)
        cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, self._ratio_shape))
        return self._run(cases)

    def energy_ratio(self, cases: Case) -> np.ndarray:
        """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
        ratio = np.broadcast_to(cases.control.ratio, self._ratio_shape)
        return np.asarray(self._run(uncontrolled(with_ratio(cases, ratio))).energy_ratio)

    @property
    def _ratio_shape(self) -> tuple[int, int, int]:
        return (self.layout.size, 3, self.structure.n_controlled)

    def _run(self, cases: Case) -> Result:
        leaves, tree = jax.tree.flatten(cases)
        leaves = [np.asarray(leaf) for leaf in leaves]
        is_varying = [len(leaf) == self.layout.size for leaf in leaves]
        varying = [leaf for leaf, varies in zip(leaves, is_varying, strict=True) if varies]
        shared = [leaf[0] for leaf, varies in zip(leaves, is_varying, strict=True) if not varies]
        if self._compiled is None:
            self._compile(tree, is_varying, varying, shared)
        return self._compiled(varying, shared)

    def _compile(self, tree: Any, is_varying: list[bool], varying: list, shared: list) -> None:
        started, layout = time.perf_counter(), self.layout

        def one(own: list, common: list) -> Result:
            TRACES.append(self.structure)
            sources = {True: iter(own), False: iter(common)}
            leaves = [next(sources[varies]) for varies in is_varying]
            return simulate(self.structure, jax.tree.unflatten(tree, leaves))

        def device(own: list, common: list) -> Result:
            blocks = [x.reshape((layout.blocks, layout.lanes, *x.shape[1:])) for x in own]
            done = jax.lax.map(lambda lanes: jax.vmap(one, (0, None))(lanes, common), blocks)
            return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), done)

        devices = np.array(jax.local_devices()[: layout.devices])
        each, same = PartitionSpec("cases"), PartitionSpec()
        program = jax.shard_map(
            device,
            mesh=jax.sharding.Mesh(devices, ("cases",)),
            in_specs=(each, same),
            out_specs=each,
            check_vma=False,
        )
        self._compiled = jax.jit(program).lower(varying, shared).compile()
        memory = self._compiled.memory_analysis()
        self.temporary_bytes = getattr(memory, "temp_size_in_bytes", 0) * layout.devices
        self.compile_time = time.perf_counter() - started
