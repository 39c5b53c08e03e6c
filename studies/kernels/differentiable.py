"""Traced loops as JAX functions with derivatives in both modes, all by kernels.

A tangent runs beside the state in one loop; cotangents run back through a reversed one
(`adjoint`). Which processor the kernels are for is a matter of how they are called (`LoopCall`).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero
from jax.extend.core import Primitive
from jax.interpreters import ad, batching, mlir

from studies.kernels.adjoint import Adjoint, trace_adjoint
from studies.kernels.traced import InputLeaf, TracedLoop, trace_loop

#: Tangents per pass of a kernel. More of them share the state's own arithmetic (1: 31 gradients/s
#: by 9 numbers on a core, 3: 49) but take longer to compile (3 s, 5 s).
DIRECTIONS = 3


@dataclass(frozen=True)
class LoopCall(ABC):
    """A call of a loop's kernel from XLA; subclasses say how one processor's is called."""

    name: str  # of the kernel: everything it depends on but the code of model and kernels
    make: Callable[[], TracedLoop]  # traces the loop, where that is needed
    n_given: int  # arrays that are read only
    state: tuple[tuple[int, ...], ...]  # shapes for one case
    records: tuple[tuple[int, ...], ...]  # of one sample
    dtype: Any
    n_steps: int
    lanes: int

    #: Largest record of a block of lanes [bytes], which bounds the pieces a run is reversed in.
    RECORD: ClassVar[int]

    @classmethod
    def of_loop(cls, loop: TracedLoop, n_steps: int, lanes: int) -> Self:
        """The call of a traced loop.

        Args:
            loop: from `trace_loop`.
            n_steps: samples.
            lanes: cases side by side, a multiple of the vectors' width or of the blocks of threads.
        """
        return cls(
            name=loop.text(),
            make=lambda: loop,
            n_given=sum(len(loop.leaves[kind]) for kind in ("constant", "input")),
            state=tuple(leaf.shape for leaf in loop.leaves["state"]),
            records=tuple(leaf.shape for leaf in loop.leaves.get("record", ())),
            dtype=loop.dtype,
            n_steps=n_steps,
            lanes=lanes,
        )

    @staticmethod
    @abstractmethod
    def has_routines() -> bool:
        """Whether loops should call repeated parts as functions."""

    @abstractmethod
    def prepare(self) -> None:
        """Make the kernel.

        Raises:
            NoKernelError: the step uses what kernels do not support.
        """

    @abstractmethod
    def note_run(self, seconds: float) -> None:
        """Say how long the kernel ran."""

    @abstractmethod
    def __call__(self, arrays: Sequence[Any]) -> list[Any]:
        """State after the last sample, and records; can be part of a compiled program.

        Args:
            arrays: as for `studies.kernels.cpu.Kernel.run`, without those for records.
        """

    @property
    def shapes(self) -> list[jax.ShapeDtypeStruct]:
        """Of the results."""
        state = [(*shape, self.lanes) for shape in self.state]
        records = [(self.n_steps, *shape, self.lanes) for shape in self.records]
        return [jax.ShapeDtypeStruct(shape, self.dtype) for shape in (*state, *records)]


class DifferentiableLoop:
    """A loop as a JAX function with derivatives in both modes, all by kernels.

    Called with the arrays constants without known ones, inputs, state, lanes last, it returns the
    last state.
    """

    def __init__(
        self,
        step: Callable[..., Any],
        constants: Sequence[InputLeaf | np.ndarray],
        inputs: Sequence[InputLeaf],
        state: Sequence[InputLeaf],
        dtype: Any,
        n_steps: int,
        lanes: int,
        calls: type[LoopCall],
        name: str = "",
    ) -> None:
        """
        Args:
            step, constants, inputs, state, dtype: as for `trace_loop`; what is not marked as moving
                gets no derivatives. There is at least one input.
            n_steps, lanes: as in `LoopCall.of_loop`.
            calls: of the processor.
            name: tells the loop from all others, known numbers included, so that it need not be
                traced if its kernel is in the cache folder; default: what tracing it says.

        Raises:
            NoKernelError: the step uses what kernels do not support.
        """
        self._given = step, constants, inputs, state, dtype
        self.dtype, self.n_steps, self.lanes = dtype, n_steps, lanes
        read = [leaf for leaf in constants if isinstance(leaf, InputLeaf)]
        self.kinds = [*read, *inputs, *(leaf._replace(is_moving=True) for leaf in state)]
        self.first_input, self.first_state = len(read), len(read) + len(inputs)
        self._calls, self._name = calls, name
        # a state's size bounds what its reverse keeps of it
        row = 8 * lanes * sum(leaf.size for leaf in state)
        self._length = min(n_steps, max(1, calls.RECORD // max(row, 1)))
        self._tangents: dict[int, TracedLoop] = {}
        self._called: dict[str, LoopCall] = {}
        self._still_call(n_steps).prepare()
        self._run = jax.custom_jvp(lambda leaves: self._call(self._still_call(n_steps), leaves))
        self._run.defjvp(self._rule, symbolic_zeros=True)
        self._ahead = jax.custom_jvp(self.ahead)
        self._ahead.defjvp(_refuse_second)

    def __call__(self, leaves: Sequence[Any]) -> list[Any]:
        last: list[Any] = self._run([jnp.asarray(x, self.dtype) for x in leaves])
        return last

    def note_run(self, seconds: float) -> None:
        """Say how long a call took, so that kernels which run for long are compiled better."""
        for call in self._called.values():
            call.note_run(seconds / len(self._called))

    def _call(self, call: LoopCall, leaves: Sequence[Any]) -> list[Any]:
        self._called[call.name] = call
        return call(leaves)

    def _still_call(self, n_steps: int) -> LoopCall:
        """The call of the loop without derivatives."""
        if not self._name:
            return self._calls.of_loop(self.plain, n_steps, self.lanes)
        return self._calls(
            name=self._name,
            make=lambda: self.plain,
            n_given=self.first_state,
            state=tuple(leaf.shape for leaf in self.kinds[self.first_state :]),
            records=(),
            dtype=self.dtype,
            n_steps=n_steps,
            lanes=self.lanes,
        )

    @cached_property
    def plain(self) -> TracedLoop:
        """The loop without derivatives."""
        step, *leaves, dtype = self._given
        still = step, *map(_without_tangents, leaves), dtype
        loop: TracedLoop = outside(trace_loop, *still, 0, self._calls.has_routines())
        return loop

    def _rule(
        self, primals: tuple[list[Any]], tangents: tuple[list[Any]]
    ) -> tuple[list[Any], list[Any]]:
        (leaves,), (along,) = primals, tangents
        moving = tuple(k for k, x in enumerate(along) if not isinstance(x, SymbolicZero))
        last, starts = self._ahead(leaves)
        points = [*leaves, *jax.tree.leaves(starts)]
        linear = _Linear(self, moving, len(points))
        pushed = _LINEAR.bind(*points, *(along[k][None] for k in moving), linear=linear)
        return last, [x[0] for x in pushed]

    @cached_property
    def adjoint(self) -> Adjoint:
        adjoint: Adjoint = outside(trace_adjoint, *self._given)
        return adjoint

    def tangents(self, directions: int) -> TracedLoop:
        if directions not in self._tangents:
            arguments = *self._given, directions, self._calls.has_routines()
            self._tangents[directions] = outside(trace_loop, *arguments)
        return self._tangents[directions]

    def ahead(self, leaves: list[Any]) -> tuple[list[Any], Any]:
        """The last state, and the states at the starts of all pieces."""

        def one(state: list[Any], rows: list[Any]) -> tuple[list[Any], list[Any]]:
            arrays = [*leaves[: self.first_input], *rows, *state]
            return self._call(self._still_call(len(rows[0])), arrays), state

        whole, rest = self._pieces(leaves)
        last, starts = jax.lax.scan(one, leaves[self.first_state :], whole)
        if rest is None:
            return last, (starts,)
        return one(last, rest)[0], (starts, last)

    def _pieces(self, leaves: list[Any]) -> tuple[list[Any], list[Any] | None]:
        """Rows of the inputs by pieces of equal length, and those of a shorter last piece."""
        inputs = leaves[self.first_input : self.first_state]
        count = self.n_steps // self._length
        end = count * self._length
        whole = [x[:end].reshape(count, self._length, *x.shape[1:]) for x in inputs]
        return whole, None if end == self.n_steps else [x[end:] for x in inputs]

    def push(self, moving: Sequence[int], points: list[Any], tangents: list[Any]) -> list[Any]:
        """Tangents of the last state, (n, ...) each, from those of the moving leaves."""
        leaves, count = points[: len(self.kinds)], len(tangents[0])
        size = min(count, DIRECTIONS)
        padded = [_first_axis_padded(x, size) for x in tangents]
        parts = [x.reshape(-1, size, *x.shape[1:]) for x in padded]
        ends = 0, self.first_input, self.first_state, len(self.kinds)

        def one(part: list[Any]) -> list[Any]:
            tangent_of = dict(zip(moving, part, strict=True))
            arrays: list[Any] = []
            for axis, (first, last) in zip((0, 1, 0), pairwise(ends), strict=True):
                arrays += leaves[first:last]
                for k in range(first, last):
                    if self.kinds[k].is_moving:
                        still = jnp.zeros((size, *leaves[k].shape), self.dtype)
                        arrays.append(jnp.moveaxis(tangent_of.get(k, still), 0, axis))
            call = self._calls.of_loop(self.tangents(size), self.n_steps, self.lanes)
            results = self._call(call, arrays)
            return results[len(self.kinds) - self.first_state :]

        pushed = jax.lax.map(one, parts)
        return [x.reshape(-1, *x.shape[2:])[:count] for x in pushed]

    def pull(self, moving: Sequence[int], points: list[Any], cotangents: list[Any]) -> list[Any]:
        """Cotangents of the moving leaves from those of the last state, (n, ...) each.

        Every piece is stepped once more, with a record, and then reversed for each number.
        """
        leaves, starts = points[: len(self.kinds)], points[len(self.kinds) :]
        constants, n_state = leaves[: self.first_input], len(self.kinds) - self.first_state
        adjoint, count = self.adjoint, len(cotangents[0])

        def back(turned: list[Any], piece: tuple[list[Any], list[Any]]) -> tuple[Any, Any]:
            rows, state = piece
            inputs = [*constants, *rows]
            forward, backward = (
                self._calls.of_loop(loop, len(rows[0]), self.lanes)
                for loop in (adjoint.forward, adjoint.backward)
            )
            record = self._call(forward, [*inputs, *state])[n_state]

            def one(cotangents: list[Any]) -> list[Any]:
                return self._call(backward, [*inputs, record, *cotangents])

            results = jax.lax.map(one, turned)
            return results[: len(turned)], results[len(turned) :]

        sums = [
            jnp.zeros((count, *x.shape, self.lanes), self.dtype)
            for x in adjoint.backward.leaves["state"][n_state:]
        ]
        whole, rest = self._pieces(leaves)
        turned, by_rest = [*cotangents, *sums], None
        if rest is not None:
            turned, by_rest = back(turned, (rest, starts[n_state:]))
        turned, by_input = jax.lax.scan(back, turned, (whole, starts[:n_state]), reverse=True)
        # (pieces, numbers, rows, ...) to (numbers, samples, ...)
        by_input = [jnp.moveaxis(x, 0, 1).reshape(count, -1, *x.shape[3:]) for x in by_input]
        if by_rest is not None:
            by_input = [jnp.concatenate(x, axis=1) for x in zip(by_input, by_rest, strict=True)]
        order = [k for k, leaf in enumerate(self.kinds) if leaf.is_moving]
        by_leaf = [*turned[n_state:], *by_input, *turned[:n_state]]
        pulled = dict(zip(order, by_leaf, strict=True))
        return [pulled[k] for k in moving]


def _first_axis_padded(x: Any, size: int) -> Any:
    """Zeros at its end, so that a multiple of `size` divides it."""
    return jnp.pad(x, [(0, -len(x) % size), *[(0, 0)] * (x.ndim - 1)])


def outside(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function in a thread of its own, where no caller's program is being traced."""
    with ThreadPoolExecutor(1) as pool:
        return pool.submit(function, *arguments).result()


class _Linear(NamedTuple):
    """The tangents of a loop at a point, or, transposed, its cotangents; several at once."""

    loops: DifferentiableLoop
    moving: tuple[int, ...]  # leaves with tangents
    n_points: int  # operands that are not tangents: leaves, and states at the starts of pieces
    is_transposed: bool = False

    def shapes(self, points: Sequence[Any]) -> list[tuple[int, ...]]:
        """Of the results, for one number."""
        last = points[self.loops.first_state : len(self.loops.kinds)]
        return [x.shape for x in ([points[k] for k in self.moving] if self.is_transposed else last)]


#: JAX's operation for such maps; its own one for the purpose cannot be batched.
_LINEAR = Primitive("kernel_tangents")
_LINEAR.multiple_results = True


def _push(*args: Any, linear: _Linear) -> list[Any]:
    apply = linear.loops.pull if linear.is_transposed else linear.loops.push
    return apply(linear.moving, list(args[: linear.n_points]), list(args[linear.n_points :]))


def _abstract(*args: Any, linear: _Linear) -> list[Any]:
    count, dtype = args[linear.n_points].shape[0], args[linear.n_points].dtype
    return [jax.core.ShapedArray((count, *x), dtype) for x in linear.shapes(args)]


def _transpose(cotangents: list[Any], *args: Any, linear: _Linear) -> list[Any]:
    """Transpose: nothing for the point, and for tangents that are none."""
    points, tangents = args[: linear.n_points], args[linear.n_points :]
    seeds = [ad.instantiate_zeros(x) for x in cotangents]
    back = linear._replace(is_transposed=not linear.is_transposed)
    results = _LINEAR.bind(*points, *seeds, linear=back)
    kept = [
        x if ad.is_undefined_primal(t) else None for x, t in zip(results, tangents, strict=True)
    ]
    return [*[None] * len(points), *kept]


def _refuse_second(*_: Any, **__: Any) -> Any:
    raise NotImplementedError(
        "kernels have first derivatives only; for second ones, take jaxmodel.simulate"
    )


def _batch(args: Any, axes: Any, *, linear: _Linear) -> Any:
    """Batching: several numbers at one point together, several points one after the other."""
    n = linear.n_points
    if all(axis is None for axis in axes[:n]):
        size = next(x.shape[axis] for x, axis in zip(args, axes, strict=True) if axis is not None)
        tangents = [
            jnp.broadcast_to(x, (size, *x.shape)) if axis is None else jnp.moveaxis(x, axis, 0)
            for x, axis in zip(args[n:], axes[n:], strict=True)
        ]
        together = [x.reshape(-1, *x.shape[2:]) for x in tangents]
        results = _LINEAR.bind(*args[:n], *together, linear=linear)
        return [x.reshape(size, -1, *x.shape[1:]) for x in results], [0] * len(results)
    wide = [jnp.moveaxis(x, k, 0) for x, k in zip(args, axes, strict=True) if k is not None]

    def one(row: list[Any]) -> list[Any]:
        rest = iter(row)
        own = [x if k is None else next(rest) for x, k in zip(args, axes, strict=True)]
        return list(_LINEAR.bind(*own, linear=linear))

    results = jax.lax.map(one, wide)
    return results, [0] * len(results)


_LINEAR.def_impl(_push)
_LINEAR.def_abstract_eval(_abstract)
ad.primitive_jvps[_LINEAR] = _refuse_second
ad.primitive_transposes[_LINEAR] = _transpose
batching.primitive_batchers[_LINEAR] = _batch
mlir.register_lowering(_LINEAR, mlir.lower_fun(_push, multiple_results=True))


def _without_tangents(leaves: Sequence[Any]) -> list[Any]:
    """The same leaves without tangents."""
    return [x._replace(is_moving=False) if isinstance(x, InputLeaf) else x for x in leaves]
