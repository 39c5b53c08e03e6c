"""Chunks of cases, run block by block through one function (`studies.engine.function`)."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure, uncontrolled, with_ratio
from jaxmodel.metrics import Metrics
from jaxmodel.simulate import RunResult
from studies.config import processor
from studies.engine.function import STEPPERS, BlockFunction, block_function, stepper
from studies.engine.plan import Layout
from studies.engine.programs import drop_programs
from studies.errors import NoKernelError, warn_of_scan
from studies.kernels import native
from studies.kernels.llvm import is_available

#: Makes a case of a chunk's numbers, or of a case, and free parameters (p,); pass the same object
#: every time to avoid recompiling.
Place = Callable[[Any, Any], Case]


class Running(NamedTuple):
    """A running chunk."""

    wait: Callable[[], RunResult]  # until it is done; NumPy arrays
    cancel: Callable[[], None]  # cancel what has not started yet


@dataclass(frozen=True)
class CaseLeaves:
    """Makes a case of its leaves: those of its own, those shared, and free parameters, if any."""

    tree: Any  # of a Case
    is_own: tuple[bool, ...]
    place: Place | None = None

    def __call__(self, free: Any, own: list[Any], shared: list[Any]) -> Case:
        sources = {True: iter(own), False: iter(shared)}
        case: Case = jax.tree.unflatten(self.tree, [next(sources[x]) for x in self.is_own])
        return case if self.place is None else self.place(case, free)


class Executor:
    """Runs chunks of one group, and differentiates them; cases that share everything compile once.

    Kernels that a group cannot have are replaced by XLA's scan; `name` says why.
    """

    def __init__(
        self,
        structure: Structure,
        layout: Layout,
        has_own_ratio: bool = False,
        place: Place | None = None,
        kind: str = "",
        is_many: bool = False,
    ) -> None:
        """
        Args:
            structure: of the group.
            layout: of its chunks.
            has_own_ratio: EMC ratios come from an uncontrolled pass for some cases.
            place: puts free parameters into a case.
            kind: how to step, a key of `STEPPERS`; default: the fastest.
            is_many: there are so many cases that compiling longer pays.
        """
        drop_programs()
        self.structure, self.layout, self.place = structure, layout, place
        self.has_own_ratio, self._is_many = has_own_ratio, is_many
        self._kind, self._reason = kind or stepper(structure), ""
        self._function: BlockFunction | None = None
        self._pool = ThreadPoolExecutor(layout.devices)
        self.compile_time = 0.0  # [s], 0 before the first chunk

    @property
    def name(self) -> str:
        """What steps the cases, and why if it is not the fastest."""
        return STEPPERS[self._kind] + (f" ({self._reason})" if self._reason else "")

    @property
    def operations(self) -> Counter[str]:
        """Operations of one sample by kind, if a kernel runs."""
        return Counter() if self._function is None else self._function.operations

    def start(self, cases: Case) -> Running:
        """Start a chunk.

        Args:
            cases: `layout.size` of them, or leaves of length 1.
        """
        function, blocks = self._prepare(cases, ())
        futures = [self._submit(k, function.run, (), own) for k, own in enumerate(blocks)]

        def cancel() -> None:
            for future in futures:
                future.cancel()

        return Running(lambda: _join([future.result() for future in futures]), cancel)

    def differentiate(self, cases: Any, free: np.ndarray) -> Differentiated:
        """Run a chunk whose metrics can then be differentiated.

        Args:
            cases: `layout.size` of them, or what `place` makes them of.
            free: parameters, (layout.size, p).
        """
        free = np.asarray(free, jax.dtypes.canonicalize_dtype(np.float64))
        function, blocks = self._prepare(cases, free)
        parts = np.split(free, len(blocks))
        futures = [
            self._submit(k, function.linearise, part, own)
            for k, (part, own) in enumerate(zip(parts, blocks, strict=True))
        ]
        done = [future.result() for future in futures]
        result = _join([result for result, _ in done])
        return Differentiated(result, [pull for _, pull in done], free.shape[1], self._pool)

    def _submit(self, k: int, run: Callable[..., Any], *arguments: Any) -> Future[Any]:
        """Run one block; on GPUs the blocks take turns with the devices."""
        devices = jax.local_devices()
        is_one = processor() == "cpu" or len(devices) == 1
        device = nullcontext() if is_one else jax.default_device(devices[k % len(devices)])

        def on_device() -> Any:
            with device:
                return run(*arguments)

        return self._pool.submit(on_device)

    def _prepare(self, cases: Any, free: Any) -> tuple[BlockFunction, list[list[np.ndarray]]]:
        """The function of a block, and the numbers of each."""
        leaves, tree = jax.tree.flatten(self._with_own_ratio(cases))
        leaves = [np.asarray(leaf) for leaf in leaves]
        is_own = tuple(len(leaf) == self.layout.size for leaf in leaves)
        own = [leaf for leaf, yes in zip(leaves, is_own, strict=True) if yes]
        starts = range(0, self.layout.size, self.layout.lanes)
        blocks = [[leaf[k : k + self.layout.lanes] for leaf in own] for k in starts]
        if self._function is None:
            began = time.perf_counter()
            shared = [leaf[0] for leaf, yes in zip(leaves, is_own, strict=True) if not yes]
            build = CaseLeaves(tree, is_own, self.place)
            first = free[: self.layout.lanes] if self.place else (), blocks[0]
            self._function = self._compile(build, *first, shared)
            self.compile_time = time.perf_counter() - began
        return self._function, blocks

    def _with_own_ratio(self, cases: Any) -> Any:
        """The same program for both passes, which differ in ratios and links."""
        if not self.has_own_ratio:
            return cases
        shape = (self.layout.size, self.structure.n_links, self.structure.n_controlled)
        cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, shape))
        links = np.broadcast_to(cases.control.link_mask, shape[:2])
        return cases._replace(control=cases.control._replace(link_mask=links))

    def _compile(self, build: CaseLeaves, free: Any, own: Any, shared: Any) -> BlockFunction:
        """The function of a block, compiled."""

        def make(kind: str) -> BlockFunction:
            return block_function(self.structure, build, free, own, shared, kind, self._is_many)

        try:
            function = make(self._kind)
            if self._kind == "gpu":
                self._try_launch(function, free, own)
            else:
                function.compile(free, own, is_differentiated=self.place is not None)
            return function
        except NoKernelError as error:
            self._kind, self._reason = "scan", str(error)
            if self.place is not None:
                warn_of_scan(error)
            return make("scan")

    def _try_launch(self, function: BlockFunction, free: Any, own: Any) -> None:
        """Compile and run a block: only then does the GPU's driver see the kernel.

        Raises:
            NoKernelError: it fails.
        """
        try:
            run = function.run if self.place is None else function.linearise
            run(free, own)
        except RuntimeError as error:  # from JAX or the driver
            raise NoKernelError(f"the GPU kernel failed: {str(error).splitlines()[0]}") from error


def _join(parts: list[RunResult]) -> RunResult:
    return jax.tree.map(lambda *x: np.concatenate([np.asarray(one) for one in x]), *parts)


class Differentiated:
    """A chunk whose metrics can be differentiated by the free parameters of its cases."""

    def __init__(
        self,
        result: RunResult,
        pull_backs: list[Callable[[Any], Any]],
        n_parameters: int,
        pool: ThreadPoolExecutor,
    ) -> None:
        """
        Args:
            result: of all cases.
            pull_backs: of each block, from `BlockFunction.linearise`.
            n_parameters: of a case.
            pool: threads for the blocks.
        """
        self.result, self._pull_backs = result, pull_backs
        self._n_parameters, self._pool = n_parameters, pool

    def pull_back(self, cotangents: Metrics) -> np.ndarray:
        """Gradients of some numbers by the parameters, (n, cases, p).

        Args:
            cotangents: derivatives of the numbers by the metrics, (n, cases, ...).

        Returns:
            0 for cases whose run did not finish.
        """
        cotangents = jax.tree.map(np.asarray, cotangents)
        touched = [(x != 0).reshape(*x.shape[:2], -1).any(-1) for x in jax.tree.leaves(cotangents)]
        turns = _turns(np.any(touched, axis=0) & np.isin(self.result.status, status.FINISHED))
        bounds = np.linspace(0, turns.shape[1], len(self._pull_backs) + 1).astype(int)
        parts = [slice(*x) for x in pairwise(bounds)]

        def one(pull_back: Callable[[Any], Any], part: slice) -> np.ndarray:
            return self._gradients(pull_back, turns[:, part], part, cotangents)

        return np.concatenate(list(self._pool.map(one, self._pull_backs, parts)), axis=1)

    def _gradients(
        self,
        pull_back: Callable[[Any], Any],
        turns: np.ndarray,
        part: slice,
        cotangents: Metrics,
    ) -> np.ndarray:
        """Gradients of a block's numbers, (n, lanes, p); a number costs a turn, not each case's."""
        gradients = np.zeros((*turns.shape, self._n_parameters))
        count = int((turns >= 0).any(axis=1).sum())
        if not count:
            return gradients
        # whole powers of two, so that few programs are compiled
        rows = turns[: min(1 << (count - 1).bit_length(), len(turns))]
        pulled = np.asarray(
            pull_back(jax.tree.map(lambda x: _in_turn(rows, x[:, part]), cotangents))
        )
        turn, lane = np.nonzero(rows >= 0)
        gradients[rows[turn, lane], lane] = pulled[turn, lane]
        return gradients


def _turns(is_needed: np.ndarray) -> np.ndarray:
    """The numbers that each case is pulled back from, in turn; -1: none.

    Args:
        is_needed: (numbers, cases).

    Returns:
        (numbers, cases).
    """
    turns = np.full(is_needed.shape, -1)
    number, case = np.nonzero(is_needed)
    turns[(np.cumsum(is_needed, axis=0) - 1)[number, case], case] = number
    return turns


def _in_turn(turns: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Cotangents (numbers, lanes, ...) in the order of the turns."""
    index = turns.reshape(*turns.shape, *[1] * (x.ndim - 2))
    return np.where(index >= 0, np.take_along_axis(x, np.maximum(index, 0), 0), 0.0)


def executor_text() -> str:
    """What sweeps run with here, in words."""
    if not is_available():
        return "XLA scan; the traced kernel, several times faster, needs llvmlite"
    if processor() == "cpu":
        return f"traced kernel, vectors of {native.this_processor().vector_bytes} bytes"
    return STEPPERS["gpu" if processor() == "cuda" else "scan"]


def own_ratios(executor: Executor, cases: Case) -> np.ndarray:
    """EMC ratios of the cases' own uncontrolled runs, (size, 3, C)."""
    return np.asarray(executor.start(uncontrolled(cases)).wait().metrics.energy_ratio)
