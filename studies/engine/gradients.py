"""Metrics of a chunk and their derivatives by parameters of each case.

Forward mode carries tangents along with the state: derivatives of all metrics, at a cost that grows
with the parameters. Reverse mode pulls a number that is computed from the metrics back through
the steps: its gradient, at a cost that does not (docs/performance.md).

- `KernelAdjoint`: reverse mode by the traced kernel.
- `KernelGradients`: forward mode by the traced kernel, `DIRECTIONS` tangents at once.
- `ScanGradients`: `jax.jvp` of the reference; everywhere.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.metrics import Metrics
from jaxmodel.parameters import Array
from jaxmodel.simulate import Result, Start, simulate
from studies.config import processor
from studies.engine.plan import Layout
from studies.engine.program import (
    TRACES,
    Place,
    Program,
    Split,
    conclude_all,
    conclude_gradients,
    conclude_slopes,
    joined,
    lane_blocks,
    prepare,
    prepare_gradients,
    prepare_tangents,
    split_cases,
)
from studies.engine.steps import (
    AdjointSteps,
    Ready,
    Steps,
    compile_adjoint,
    compile_steps,
    fits_kernel,
    start_block,
)
from studies.errors import NoKernelError, warn_of_scan
from studies.kernels.adjoint import RECORD

#: Tangents per pass of the kernel. More of them share the state's own arithmetic (1: 31 gradients/s
#: by 9 numbers on a core, 3: 49) but take longer to compile (3 s, 5 s).
DIRECTIONS = 3
#: Number of parameters from which the kernel's reverse mode costs less than its forward mode.
REVERSE_FROM = 4


class Differentiated(Protocol):
    """A chunk, ready for gradients."""

    @property
    def result(self) -> Result:
        """Cases first, NumPy arrays."""
        ...

    def pull_back(self, cotangents: Metrics) -> np.ndarray:
        """Gradients of some numbers by the parameters, (n, cases, p).

        Args:
            cotangents: derivatives of the numbers by the metrics, (n, cases, ...).

        Returns:
            0 for cases whose run did not finish.
        """
        ...


class ChunkSlopes(NamedTuple):
    """A chunk and its derivatives; NumPy arrays."""

    result: Result  # cases first
    metrics: Metrics  # derivatives, (cases, p, ...); 0 if a run did not finish

    def pull_back(self, cotangents: Metrics) -> np.ndarray:
        """As `Differentiated.pull_back`."""

        def part(slope: np.ndarray, by: np.ndarray) -> np.ndarray:
            cases, p = slope.shape[:2]
            return np.einsum(
                "cpe,nce->ncp", slope.reshape(cases, p, -1), by.reshape(*by.shape[:2], -1)
            )

        parts = jax.tree.map(lambda x, y: part(x, np.asarray(y)), self.metrics, cotangents)
        return np.asarray(sum(jax.tree.leaves(parts)))


class Gradients(Protocol):
    """Differentiates chunks of one group."""

    @property
    def name(self) -> str: ...

    @property
    def mode(self) -> str:
        """ "forward" or "reverse"."""
        ...

    @property
    def compile_time(self) -> float:
        """[s], 0 before the first chunk."""
        ...

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> Differentiated:
        """Run a chunk.

        Args:
            cases: `layout.size` of them; fields set by the parameters are overwritten.
            parameters: (layout.size, p).
            is_used: requested derivatives; others can be anything, (layout.size, p).
        """
        ...


def make_gradients(
    structure: Structure, layout: Layout, place: Place, n_parameters: int
) -> Gradients:
    """The fastest way to differentiate a few numbers that are computed from a group's metrics.

    Args:
        structure: of the group.
        layout: of its chunks.
        place: puts parameters into a case.
        n_parameters: how many of them a case has that are used.
    """
    if processor() != "cpu" or not fits_kernel(structure):
        return ScanGradients(structure, layout, place)
    mode = KernelAdjoint if n_parameters >= REVERSE_FROM else KernelGradients
    return KernelOrScanGradients(mode, structure, layout, place)


class KernelOrScanGradients:
    """Gradients by kernels; by XLA's scan, with a warning, if the group has no kernel."""

    def __init__(
        self,
        kernel: Callable[[Structure, Layout, Place], Gradients],
        structure: Structure,
        layout: Layout,
        place: Place,
    ) -> None:
        """
        Args:
            kernel: makes the gradients to try.
            structure, layout, place: as for `make_gradients`.
        """
        self._scan = partial(ScanGradients, structure, layout, place)
        self._chosen = kernel(structure, layout, place)

    @property
    def name(self) -> str:
        return self._chosen.name

    @property
    def mode(self) -> str:
        return self._chosen.mode

    @property
    def compile_time(self) -> float:
        return self._chosen.compile_time

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> Differentiated:
        try:
            return self._chosen.evaluate(cases, parameters, is_used)
        except NoKernelError as error:
            warn_of_scan(error)
            self._chosen = self._scan()
            return self._chosen.evaluate(cases, parameters, is_used)


def _split(cases: Case, parameters: np.ndarray, layout: Layout, structure: Structure) -> Split:
    split = split_cases(cases, layout, structure, False)
    real = jax.dtypes.canonicalize_dtype(np.float64)
    return split._replace(varying=[*split.varying, np.asarray(parameters, real)])


def _program(made: KernelAdjoint | KernelGradients | ScanGradients, split: Split) -> Program:
    """What gradients are taken of."""
    return Program(
        structure=made.structure,
        layout=made.layout,
        tree=split.tree,
        is_varying=split.is_varying,
        place=made.place,
    )


class KernelGradients:
    """Blocks of lanes on a pool of threads, each stepped once for every few directions."""

    name, mode = "traced kernel", "forward"

    def __init__(self, structure: Structure, layout: Layout, place: Place) -> None:
        self.structure, self.layout, self.place = structure, layout, place
        self.compile_time = 0.0
        self._steps: Steps | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> ChunkSlopes:
        split = _split(cases, parameters, self.layout, self.structure)
        program = _program(self, split)
        blocks = lane_blocks(split, self.layout)
        if self._steps is None:
            started = time.perf_counter()
            self._steps = compile_steps(program, split, min(DIRECTIONS, parameters.shape[1]))
            given = program, self._steps.parts, blocks[0], split.shared
            prepare(*given)
            prepare_tangents(*given, np.eye(self._steps.directions, parameters.shape[1]))
            self.compile_time = time.perf_counter() - started
        one = partial(_slopes, program, self._steps, shared=split.shared)
        used = np.ones_like(parameters, bool) if is_used is None else is_used
        done = list(self._pool.map(one, blocks, np.split(used, len(blocks))))
        whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *done)
        return ChunkSlopes(*jax.tree.map(np.asarray, conclude_slopes(*whole)))


def _slopes(
    program: Program, steps: Steps, block: list[Any], used: Array, shared: list[Any]
) -> tuple[Any, ...]:
    """(outline, status at the start, last state, tangents of outline and state), lanes last."""
    ready, n = start_block(program, steps, block, shared), block[-1].shape[1]
    passes = [k for k in range(0, n, steps.directions) if used[:, k : k + steps.directions].any()]
    slope, turn, state = (_zeros(n, x) for x in (ready.state, ready.outline, ready.state))
    for k in passes or [0]:
        state = jax.tree.map(np.copy, ready.state)
        outline, along = _pass(program, steps, block, shared, ready, state, k)
        for whole, part in ((slope, along), (turn, outline)):
            for x, y in zip(jax.tree.leaves(whole), jax.tree.leaves(part), strict=True):
                x[k : k + steps.directions] = y[: n - k]
    return ready.outline, ready.state.status, state, turn, slope


def _pass(
    program: Program,
    steps: Steps,
    block: list[Any],
    shared: list[Any],
    ready: Ready,
    state: Any,
    k: int,
) -> tuple[Any, ...]:
    """Step a block once, `state` in place; tangents of outline and state from direction k on."""
    count = steps.directions
    directions = np.eye(count, block[-1].shape[1], k, dtype=block[-1].dtype)
    turning = iter(prepare_tangents(program, steps.parts, block, shared, directions))
    found = [next(turning) if moves else None for moves in steps.parts.is_moving]
    turn: Start = jax.tree.unflatten(steps.parts.tree, [_Tangent(x) for x in found])
    along = jax.tree.map(partial(_filled, count), ready.state, turn.state)
    steps.run.run(
        [
            *ready.loop,
            *_moving(turn.loop),
            *ready.inputs,
            *_by_sample(turn.inputs),
            *jax.tree.leaves(state),
            *jax.tree.leaves(along),
        ],
        program.structure.n_steps,
        program.layout.lanes,
    )
    return jax.tree.map(partial(_filled, count), ready.outline, turn.outline), along


class _Tangent:
    """Tangents of a leaf, or None: a leaf of a tree even if it is None."""

    def __init__(self, array: Any) -> None:
        self.array = None if array is None else np.asarray(array, order="C")


def _zeros(n: int, tree: Any) -> Any:
    return jax.tree.map(lambda x: np.zeros((n, *x.shape), x.dtype), tree)


def _filled(n: int, x: np.ndarray, tangent: _Tangent) -> np.ndarray:
    """Tangents along all directions of a pass, zeros where a leaf does not move."""
    return np.zeros((n, *x.shape), x.dtype) if tangent.array is None else tangent.array.copy()


def _moving(tree: Any) -> list[np.ndarray]:
    found = (tangent.array for tangent in jax.tree.leaves(tree))
    return [array for array in found if array is not None]


def _by_sample(tree: Any) -> list[np.ndarray]:
    """The same for inputs, of which the kernel reads one row per sample."""
    return [np.asarray(x.swapaxes(0, 1), order="C") for x in _moving(tree)]


# --- reverse mode ---------------------------------------------------------------------------------


class KernelAdjoint:
    """Blocks of lanes on a pool of threads, stepped to the end and then back for every number."""

    name, mode = "traced kernel", "reverse"

    def __init__(self, structure: Structure, layout: Layout, place: Place) -> None:
        self.structure, self.layout, self.place = structure, layout, place
        self.compile_time = 0.0
        self._steps: AdjointSteps | None = None
        self._pool = ThreadPoolExecutor(layout.devices)

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> PulledBack:
        split = _split(cases, parameters, self.layout, self.structure)
        program = _program(self, split)
        if self._steps is None:
            started = time.perf_counter()
            self._steps = compile_adjoint(program, split)
            prepare(program, self._steps.parts, lane_blocks(split, self.layout)[0], split.shared)
            self.compile_time = time.perf_counter() - started
        return PulledBack(program, self._steps, split, self._pool)


class _Block(NamedTuple):
    """A block of lanes after its run."""

    varying: list[np.ndarray]
    ready: Ready
    states: list[list[np.ndarray]]  # leaves at the start of every piece, and at the end


class PulledBack:
    """A chunk stepped by the kernel, as `Differentiated`."""

    def __init__(
        self,
        program: Program,
        steps: AdjointSteps,
        split: Split,
        pool: ThreadPoolExecutor,
    ) -> None:
        self._program, self._steps, self._pool = program, steps, pool
        self._shared, self._lanes = split.shared, program.layout.lanes
        n, row = program.structure.n_steps, 8 * steps.kept * self._lanes
        length = max(1, RECORD // max(row, 1))
        self._bounds = [*range(0, n, length), n]
        self._blocks = list(pool.map(self._stepped, lane_blocks(split, program.layout)))
        given = [(b.ready.outline, b.ready.state.status, self._last(b)) for b in self._blocks]
        whole = jax.tree.map(lambda *x: np.concatenate(x, axis=-1), *given)
        self.result: Result = jax.tree.map(np.asarray, conclude_all(*whole))

    def pull_back(self, cotangents: Metrics) -> np.ndarray:
        cotangents = jax.tree.map(np.asarray, cotangents)
        wanted = [(x != 0).reshape(*x.shape[:2], -1).any(-1) for x in jax.tree.leaves(cotangents)]
        turns = _turns(np.any(wanted, axis=0) & np.isin(self.result.status, status.FINISHED))
        starts = range(0, self._program.layout.size, self._lanes)
        rows = [slice(k, k + self._lanes) for k in starts]
        done = self._pool.map(
            lambda block, part: self._gradients(block, turns[:, part], part, cotangents),
            self._blocks,
            rows,
        )
        return np.concatenate(list(done), axis=1)

    def _last(self, block: _Block) -> Any:
        return jax.tree.unflatten(jax.tree.structure(block.ready.state), block.states[-1])

    def _stepped(self, varying: list[np.ndarray]) -> _Block:
        ready = start_block(self._program, self._steps, varying, self._shared)
        block = _Block(varying, ready, [jax.tree.leaves(ready.state)])
        room = self._room(block)
        for piece in range(len(self._bounds) - 1):
            block.states.append(self._step(block, piece, room)[0])
        return block

    def _room(self, block: _Block) -> np.ndarray:
        """For the record of any piece."""
        samples = self._bounds[1] - self._bounds[0]
        return np.empty((samples, self._steps.kept, self._lanes), block.states[0][0].dtype)

    def _step(
        self, block: _Block, piece: int, room: np.ndarray
    ) -> tuple[list[np.ndarray], np.ndarray]:
        """State after a piece of a block's run, and its record."""
        begin, end = self._bounds[piece : piece + 2]
        state, record = [x.copy() for x in block.states[piece]], room[: end - begin]
        inputs = [x[begin:end] for x in block.ready.inputs]
        leaves = [*block.ready.loop, *inputs, *state, record]
        self._steps.forward.run(leaves, end - begin, self._lanes)
        return state, record

    def _gradients(
        self, block: _Block, turns: np.ndarray, part: slice, cotangents: Metrics
    ) -> np.ndarray:
        """Gradients of a block's numbers, (n, lanes, p).

        Args:
            block: of lanes.
            turns: which number each lane is pulled back from in each turn, -1: none.
            part: the block's place among the cases.
            cotangents: of all cases.
        """
        found = np.zeros((len(turns), *block.varying[-1].shape))
        count = int((turns >= 0).any(axis=1).sum())
        if not count:
            return found
        at_end = jax.tree.map(lambda x: _in_turn(turns, x[:, part]), cotangents)
        given = block.ready.outline, block.ready.state.status, self._last(block), at_end
        outline, state = map(jax.tree.leaves, conclude_gradients(*given))
        start = self._at_start(block, outline, state, count)
        leaves = self._program, self._steps.parts, block.varying, self._shared
        gradients = prepare_gradients(*leaves, start)
        turn, lane = np.nonzero(turns >= 0)
        found[turns[turn, lane], lane] = gradients[turn, lane]
        return found

    def _at_start(
        self, block: _Block, outline: list[Any], state: list[Any], count: int
    ) -> list[np.ndarray]:
        """Cotangents of the leaves of a start that move, numbers first.

        Args:
            block: of lanes.
            outline, state: cotangents of a block's outline and last state.
            count: numbers to pull back; further ones are 0.
        """
        parts = self._steps.parts
        state = [np.array(x, order="C") for x in state]
        leaf: Start = jax.tree.unflatten(parts.tree, range(len(parts.shapes)))

        def moving(tree: Any) -> list[int]:
            return [k for k in jax.tree.leaves(tree) if parts.is_moving[k]]

        def sums(tree: Any) -> list[np.ndarray]:
            shapes = (parts.shapes[k] for k in moving(tree))
            return [np.zeros((len(state[0]), *x, self._lanes), state[0].dtype) for x in shapes]

        loop, rows = sums(leaf.loop), sums(leaf.inputs)
        room = self._room(block)
        for piece in reversed(range(len(self._bounds) - 1)):
            begin, end = self._bounds[piece : piece + 2]
            inputs = [x[begin:end] for x in block.ready.inputs]
            record = self._step(block, piece, room)[1]
            for k in range(count):
                own = [x[k] for x in (*state, *loop)] + [x[k, begin:end] for x in rows]
                leaves = [*block.ready.loop, *inputs, record, *own]
                self._steps.backward.run(leaves, end - begin, self._lanes)
        ends = dict(
            zip(jax.tree.leaves((leaf.state, leaf.outline)), [*state, *outline], strict=True)
        )
        return [*loop, *rows, *(np.asarray(ends[k]) for k in moving((leaf.state, leaf.outline)))]


def _turns(is_wanted: np.ndarray) -> np.ndarray:
    """The numbers that each case is pulled back from, in turn; -1: none.

    Args:
        is_wanted: (numbers, cases).

    Returns:
        (numbers, cases).
    """
    turns = np.full(is_wanted.shape, -1)
    number, case = np.nonzero(is_wanted)
    turns[(np.cumsum(is_wanted, axis=0) - 1)[number, case], case] = number
    return turns


def _in_turn(turns: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Cotangents (numbers, lanes, ...) in the order of the turns."""
    found = np.take_along_axis(
        x, np.maximum(turns, 0).reshape(*turns.shape, *[1] * (x.ndim - 2)), 0
    )
    return np.where((turns >= 0).reshape(*turns.shape, *[1] * (x.ndim - 2)), found, 0.0)


# --- XLA ------------------------------------------------------------------------------------------


def _metrics(
    program: Program, own: list[Any], common: list[Any], parameters: Array
) -> tuple[Any, ...]:
    case = joined(program.tree, program.is_varying, own, common)
    assert program.place is not None
    result = simulate(program.structure, program.place(case, parameters))
    return result.metrics, result


@partial(jax.jit, static_argnums=0)
def _forward(
    program: Program, own: list[Any], parameters: Array, common: list[Any]
) -> tuple[Any, ...]:
    TRACES.append(program.structure)

    def one(case: tuple[Any, ...]) -> tuple[Any, ...]:
        own, parameters = case

        def along(direction: Array) -> tuple[Any, ...]:
            function = partial(_metrics, program, own, common)
            _, tangent, result = jax.jvp(function, (parameters,), (direction,), has_aux=True)
            return result, tangent

        unit = jnp.eye(parameters.size, dtype=parameters.dtype)
        return jax.vmap(along, out_axes=(None, 0))(unit)

    return jax.lax.map(one, (own, parameters), batch_size=program.layout.lanes)


class ScanGradients:
    """Forward mode through the reference, one block of lanes after another."""

    name, mode = "XLA scan", "forward"

    def __init__(self, structure: Structure, layout: Layout, place: Place) -> None:
        self.structure, self.layout, self.place = structure, layout, place
        self.compile_time = 0.0
        self._compiled: Any = None

    def evaluate(
        self, cases: Case, parameters: np.ndarray, is_used: np.ndarray | None = None
    ) -> ChunkSlopes:
        split = _split(cases, parameters, self.layout, self.structure)
        *own, parameters = split.varying
        if self._compiled is None:
            program = _program(self, split)
            started = time.perf_counter()
            self._compiled = _forward.lower(program, own, parameters, split.shared).compile()
            self.compile_time = time.perf_counter() - started
        return ChunkSlopes(*jax.tree.map(np.asarray, self._compiled(own, parameters, split.shared)))
