"""The reference executor: the step in a scan, compiled by XLA."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxmodel.case import Case, Structure
from jaxmodel.loop import Inputs, State, step
from jaxmodel.simulate import Result
from studies.engine.plan import Layout
from studies.engine.program import (
    TRACES,
    Program,
    Running,
    StartParts,
    begin_block,
    conclude_all,
    find_parts,
    split_cases,
)


@partial(jax.jit, static_argnums=(0, 1))
def _run(program: Program, parts: StartParts, varying: list[Any], shared: list[Any]) -> Result:
    """Results of a chunk; what its cases share is computed once."""
    layout = program.layout
    TRACES.append(program.structure)

    def block(own: list[Any], common: list[Any]) -> Result:
        """Cases along the last axis; XLA fuses little of a step under `vmap`."""
        start = begin_block(program, parts, own, common)

        def body(at: State, inputs: Inputs) -> tuple[State, None]:
            return step(program.structure, start.loop, at, inputs)[0], None

        last, _ = jax.lax.scan(body, start.state, start.inputs)
        return conclude_all(start.outline, start.state.status, last)

    def device(own: list[Any], common: list[Any]) -> Result:
        blocks = [x.reshape((layout.blocks, layout.lanes, *x.shape[1:])) for x in own]
        done = jax.lax.map(lambda lanes: block(lanes, common), blocks)
        return jax.tree.map(lambda x: x.reshape((-1, *x.shape[2:])), done)

    devices = np.array(jax.local_devices()[: layout.devices])
    each, all_same = PartitionSpec("cases"), PartitionSpec()
    return jax.shard_map(
        device,
        mesh=Mesh(devices, ("cases",)),
        in_specs=(each, all_same),
        out_specs=each,
        check_vma=False,
    )(varying, shared)


class ScanExecutor:
    """The reference step in a scan, vectorised over lanes and sharded over devices by XLA."""

    name = "XLA scan"

    def __init__(self, structure: Structure, layout: Layout, has_own_ratio: bool) -> None:
        self.structure, self.layout, self.has_own_ratio = structure, layout, has_own_ratio
        self.compile_time = 0.0
        self._compiled: Any = None

    def start(self, cases: Case) -> Running:
        split = split_cases(cases, self.layout, self.structure, self.has_own_ratio)
        if self._compiled is None:
            program = Program(self.structure, self.layout, split.tree, split.is_varying)
            started = time.perf_counter()
            parts = find_parts(program, [leaf[0] for leaf in split.varying], split.shared)
            self._compiled = _run.lower(program, parts, split.varying, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        running = self._compiled(split.varying, split.shared)
        return Running(lambda: jax.tree.map(np.asarray, running), lambda: None)
