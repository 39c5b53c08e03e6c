"""Cases as one JAX function: begin, all steps, conclude.

Every run without trajectories goes through it: sweeps, tunings, benchmarks and users' own programs
(`studies.batched`). XLA prepares and judges a block of cases; a traced kernel steps them, called by
XLA through its foreign function interface (`studies.kernels.bridge`), or a scan where there is no
kernel. The function can be part of other programs and has derivatives in both modes.

A block's numbers come in three parts: `free`, by which it can be differentiated, and `own`, both
with cases first, and `shared`, which all cases have in common and which are computed once.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterable
from functools import cached_property, partial
from hashlib import sha256
from threading import Lock
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.loop import State, step
from jaxmodel.metrics import Metrics
from jaxmodel.simulate import Outline, RunResult, Start, begin, conclude
from studies import sources
from studies.config import device_now, is_keeping, processor
from studies.engine.programs import is_plain, kept_data, modules_of, program, quick_options
from studies.errors import NoKernelError, warn_of_scan
from studies.kernels import bridge, gpu, llvm, native
from studies.kernels.differentiable import DifferentiableLoop
from studies.kernels.equations import Function, call_of, literal, trace
from studies.kernels.traced import InputLeaf

#: How often the steps were traced in this process; tests use it to count compilations.
TRACES: list[Structure] = []
#: Makes one case of its free, own and shared numbers; hashable, and equal if it does the same.
Build = Callable[[Any, Any, Any], Case]
#: Functions kept in memory.
KEPT_FUNCTIONS = 8
#: More plant steps per sample than this would make the kernel's code too long.
KERNEL_SUBSTEPS = 4
#: How the steps are made, in words.
STEPPERS = {"kernel": "traced kernel", "gpu": "GPU kernel", "scan": "XLA scan"}

#: Programs that are not kept on disk: functions cannot be, and kernels of tangents have no name
#: before they are traced.
_NOT_KEPT = ("prepare_vjp", "finish_vjp", "finish_jvp")
_FUNCTIONS: dict[Any, BlockFunction] = {}
#: Cases prepared side by side on a core: what each is to follow then stays in its cache.
GROUP = 16


def stepper(structure: Structure) -> str:
    """The fastest way to step cases of a structure here, a key of `STEPPERS`."""
    if not llvm.is_available() or structure.plant_steps > KERNEL_SUBSTEPS:
        return "scan"
    if processor() == "cpu":
        return "kernel" if bridge.is_available() else "scan"
    return "gpu" if processor() == "cuda" else "scan"


class StartParts(NamedTuple):
    """A Start leaf by leaf: which leaves vary from case to case, and their shapes."""

    tree: Any
    is_varying: tuple[bool, ...]
    shapes: tuple[tuple[int, ...], ...]  # of one case
    is_moving: tuple[bool, ...]  # depends on the free numbers

    def joined(self, varying: Iterable[Any], shared: Iterable[Any]) -> Start:
        """The start rebuilt from its varying and its shared leaves."""
        sources = {True: iter(varying), False: iter(shared)}
        start: Start = jax.tree.unflatten(self.tree, [next(sources[x]) for x in self.is_varying])
        return start


class BlockFunction:
    """Results of a block of cases as a JAX function of their numbers."""

    def __init__(
        self,
        structure: Structure,
        build: Build,
        free: Any,
        own: Any,
        shared: Any,
        kind: str,
        is_many: bool = False,
    ) -> None:
        """
        Args:
            structure: of the cases.
            build: makes one of them.
            free, own: numbers of a block, or of one as large; only the first case is looked at.
            shared: numbers of all cases.
            kind: how to step, a key of `STEPPERS`.
            is_many: there are so many blocks that compiling longer pays.

        Raises:
            NoKernelError: the steps use what kernels do not support.
        """
        self.structure, self.build, self.kind, self._is_many = structure, build, kind, is_many
        self.lanes = len(jax.tree.leaves((free, own))[0])
        self._numbers, self._names = shared, _names(structure, build, kind, free, own, shared)
        first = [*jax.tree.map(lambda x: x[0], (free, own)), shared]
        self.parts: StartParts = kept_data(
            self._names and ["parts", *self._names],
            lambda: _find_parts(self._begin, *first),
            __name__,
        )
        self._programs: dict[str, Any] = {}
        self._compiling = Lock()
        common = self._program("shared", partial(self._leaves, False), *first)
        self.shared = [np.asarray(x, order="C") for x in common]
        TRACES.append(structure)
        loops: dict[str, Callable[[], Any]]
        loops = {"kernel": self._kernel, "gpu": self._gpu, "scan": lambda: None}
        self._step_all = loops[kind]()

    # --- the parts, as JAX functions -------------------------------------------------------------

    def __call__(self, free: Any, own: Any) -> RunResult:
        """Results of `lanes` cases."""
        return self.finish(self.prepare(free, own, self._numbers), self.shared)

    def prepare(self, free: Any, own: Any, shared: Any) -> list[Any]:
        """Those leaves of the cases' starts that vary, lanes last."""
        if device_now().platform != "cpu" or self.lanes % GROUP:
            return self._prepared(0, free, own, shared)

        def split(x: Any) -> Any:
            return jnp.reshape(x, (len(x) // GROUP, GROUP, *x.shape[1:]))  # also of empty lists

        def joined(x: Any) -> Any:
            return jnp.moveaxis(x, 0, -2).reshape(*x.shape[1:-1], self.lanes)

        groups = jax.tree.map(split, (free, own))
        each = jax.lax.map(lambda group: self._prepared(0, group[0], group[1], shared), groups)
        return [joined(x) for x in each]

    def _prepared(self, free_axis: int | None, free: Any, own: Any, shared: Any) -> list[Any]:
        """As `prepare`; free numbers without an axis are those of all cases."""
        each = jax.vmap(partial(self._leaves, True), (free_axis, 0, None), -1)
        leaves: list[Any] = each(free, own, shared)
        return leaves

    def finish(self, varying: list[Any], shared: list[Any]) -> RunResult:
        """Results of cases from the leaves of their starts.

        Args:
            varying: lanes last.
            shared: those of all cases.
        """
        start = self.parts.joined(varying, [jnp.asarray(x)[..., None] for x in shared])
        varies: Start = jax.tree.unflatten(self.parts.tree, self.parts.is_varying)
        first, outline = (
            jax.tree.map(self._broadcast, tree, variation)
            for tree, variation in ((start.state, varies.state), (start.outline, varies.outline))
        )
        if self._step_all is None:
            last = self._scan(start, first)
        else:
            inputs = jax.tree.map(
                lambda x, is_wide: x if is_wide else x[..., 0], start.inputs, varies.inputs
            )
            read = zip(jax.tree.leaves(start.loop), jax.tree.leaves(varies.loop), strict=True)
            leaves = [*(x for x, is_read in read if is_read), *jax.tree.leaves(inputs)]
            last = jax.tree.unflatten(
                jax.tree.structure(first), self._step_all([*leaves, *jax.tree.leaves(first)])
            )
        return _conclude(outline, first.status, last)

    def _broadcast(self, x: Any, is_wide: bool) -> Any:
        return x if is_wide else jnp.broadcast_to(x, (*x.shape[:-1], self.lanes))

    def _begin(self, free: Any, own: Any, shared: Any) -> Start:
        return _begin(self.structure, self.build(free, own, shared))

    def _leaves(self, is_varying: bool, free: Any, own: Any, shared: Any) -> list[Any]:
        """Varying or shared leaves of a case's start."""
        leaves = jax.tree.leaves(self._begin(free, own, shared))
        return [x for x, v in zip(leaves, self.parts.is_varying, strict=True) if v == is_varying]

    @property
    def operations(self) -> Counter[str]:
        """Operations of one sample by kind, if a kernel runs on this processor."""
        steps = self._step_all
        if not isinstance(steps, DifferentiableLoop):
            return Counter()
        return steps.plain.operations()

    # --- the steps -------------------------------------------------------------------------------

    def _kernel(self) -> Callable[[list[Any]], list[Any]]:
        arguments = *self.loop_arguments(), _real(), self.structure.n_steps, self.lanes
        name = ""
        if self._names and is_keeping():
            code = sources.digest(__name__, *modules_of(self._names))  # makes shared constants
            name = sha256(repr((self._names, code)).encode()).hexdigest()
        return DifferentiableLoop(*arguments, bridge.CpuCall, name)

    def _gpu(self) -> Callable[[list[Any]], list[Any]]:
        arguments = *self.loop_arguments(), _real(), self.structure.n_steps, self.lanes
        return DifferentiableLoop(*arguments, gpu.GpuCall)

    def _scan(self, start: Start, first: State) -> State:
        """Cases along the last axis; XLA fuses little of a step under `vmap`."""

        def body(at: State, inputs: Any) -> tuple[State, None]:
            return step(self.structure, start.loop, at, inputs)[0], None

        last: State = jax.lax.scan(body, first, start.inputs)[0]
        return last

    def loop_arguments(
        self,
    ) -> tuple[Callable[..., Any], list[Any], list[InputLeaf], list[InputLeaf]]:
        """Step, constants, inputs and state for `trace_loop`; shared constants are known ones."""
        parts, structure = self.parts, self.structure
        kinds = zip(parts.shapes, parts.is_varying, parts.is_moving, strict=True)
        leaves = [InputLeaf(*kind) for kind in kinds]
        start: Start = jax.tree.unflatten(parts.tree, range(len(leaves)))
        trees = [jax.tree.structure(part) for part in start[:3]]
        shared = iter(self.shared)
        values = [leaf if leaf.is_varying else next(shared) for leaf in leaves]

        def sample(constants: list[Any], row: list[Any], carried: list[Any]) -> list[Any]:
            loop, inputs, state = (
                jax.tree.unflatten(tree, x)
                for tree, x in zip(trees, (constants, row, carried), strict=True)
            )
            return jax.tree.leaves(step(structure, loop, state, inputs)[0])

        inputs = [leaves[k] for k in jax.tree.leaves(start.inputs)]
        state = [leaves[k] for k in jax.tree.leaves(start.state)]
        return (
            sample,
            [values[k] for k in jax.tree.leaves(start.loop)],
            [leaf._replace(shape=leaf.shape[1:]) for leaf in inputs],
            [leaf._replace(is_varying=True) for leaf in state],
        )

    # --- compiled --------------------------------------------------------------------------------

    def run(self, free: Any, own: Any) -> RunResult:
        """Results of a block, JAX arrays; may be called from several threads."""
        varying = self._program("prepare", self.prepare, free, own, self._numbers)
        return self._finished("finish", self.finish, varying)

    def linearise(self, free: Any, own: Any) -> tuple[RunResult, Callable[[Any], Any]]:
        """Results of a block, and the function that pulls cotangents of its metrics back.

        Returns:
            results; a function of cotangents with numbers first, which returns the gradients of
            these numbers by the free ones, numbers first.
        """
        arguments = free, own, self._numbers
        varying, pull_start = self._program("prepare_vjp", self._prepare_vjp, *arguments)
        result, pull_end = self._finished("finish_vjp", self._finish_vjp, varying)

        def pull_back(cotangents: Any) -> Any:
            began = time.perf_counter()
            (at_start,) = jax.block_until_ready(_pull(pull_end, cotangents))
            self._note_run(began)
            return jax.block_until_ready(_pull(pull_start, at_start))[0]

        return result, pull_back

    def jacobian(self, free: Any, own: Any) -> tuple[RunResult, Metrics]:
        """Results of a block whose cases share their free numbers, and derivatives by these.

        Args:
            free: one case's, (p,).
            own: of the block.

        Returns:
            results; derivatives of the metrics, (p, lanes, ...).
        """
        varying, tangents = self._program(
            "prepare_jvp", self._prepare_jvp, free, own, self._numbers
        )
        return self._finished("finish_jvp", self._finish_jvp, varying, tangents)

    def _finished(
        self, name: str, function: Callable[..., Any], varying: list[Any], *others: Any
    ) -> Any:
        program = self._compiled(name, function, varying, self._on_device, *others)
        began = time.perf_counter()
        result = jax.block_until_ready(program(varying, self._on_device, *others))
        self._note_run(began)
        return result

    def _note_run(self, began: float) -> None:
        if isinstance(self._step_all, DifferentiableLoop):
            self._step_all.note_run(time.perf_counter() - began)

    def _program(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Result of a program that prepares cases."""
        return jax.block_until_ready(self._compiled(name, function, *arguments)(*arguments))

    def _compiled(self, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
        is_quick = self.kind == "kernel" and not name.startswith("finish")  # which steps
        effort = int(self._is_many and name == "prepare")  # others run once, or as fast without

        def lower() -> Any:
            options = quick_options(effort) if is_quick else None
            return jax.jit(function, compiler_options=options).lower(*arguments)

        with self._compiling:
            if name not in self._programs:
                if self._names and name not in _NOT_KEPT:
                    names = [name, effort, *self._names]
                    self._programs[name] = program(names, list(arguments), lower, __name__)
                else:
                    self._programs[name] = lower().compile()
            return self._programs[name]

    def compile(self, free: Any, own: Any, is_differentiated: bool = False) -> None:
        """Compile the programs that `run`, or `linearise`, needs."""
        arguments = free, own, self._numbers
        if is_differentiated:
            varying, _ = self._compiled("prepare_vjp", self._prepare_vjp, *arguments).out_info
            self._compiled("finish_vjp", self._finish_vjp, varying, self._on_device)
        else:
            varying = self._compiled("prepare", self.prepare, *arguments).out_info
            self._compiled("finish", self.finish, varying, self._on_device)

    @cached_property
    def _on_device(self) -> list[Any]:
        return list(jax.device_put(self.shared))

    def _movement(
        self, free_axis: int | None, own: Any, shared: Any
    ) -> Callable[[Any], tuple[list[Any], list[Any]]]:
        """Leaves that move as a function of the free numbers, and all that vary."""

        def moving(free: Any) -> tuple[list[Any], list[Any]]:
            leaves = self._prepared(free_axis, free, own, shared)
            return self._moving(leaves), leaves

        return moving

    def _judged(
        self, varying: list[Any], shared: list[Any]
    ) -> Callable[[list[Any]], tuple[Metrics, RunResult]]:
        """Metrics as a function of the leaves that move, and the results."""

        def judged(moving: list[Any]) -> tuple[Metrics, RunResult]:
            own = iter(moving)
            each = zip(varying, self._varying_moves, strict=True)
            result = self.finish([next(own) if moves else x for x, moves in each], shared)
            return result.metrics, result

        return judged

    def _prepare_vjp(self, free: Any, own: Any, shared: Any) -> Any:
        _, pull_back, leaves = jax.vjp(self._movement(0, own, shared), free, has_aux=True)
        return leaves, pull_back

    def _finish_vjp(self, varying: list[Any], shared: list[Any]) -> Any:
        judged = self._judged(varying, shared)
        _, pull_back, result = jax.vjp(judged, self._moving(varying), has_aux=True)
        return result, pull_back

    def _prepare_jvp(self, free: Any, own: Any, shared: Any) -> Any:
        _, push, leaves = jax.linearize(self._movement(None, own, shared), free, has_aux=True)
        return leaves, jax.vmap(push)(jnp.eye(len(free)))

    def _finish_jvp(self, varying: list[Any], shared: list[Any], tangents: list[Any]) -> Any:
        judged = self._judged(varying, shared)
        _, push, result = jax.linearize(judged, self._moving(varying), has_aux=True)
        return result, jax.vmap(push)(tangents)

    @cached_property
    def _varying_moves(self) -> list[bool]:
        pairs = zip(self.parts.is_varying, self.parts.is_moving, strict=True)
        return [moves for varies, moves in pairs if varies]

    def _moving(self, varying: list[Any]) -> list[Any]:
        return [x for x, moves in zip(varying, self._varying_moves, strict=True) if moves]


def block_function(
    structure: Structure,
    build: Build,
    free: Any,
    own: Any,
    shared: Any,
    kind: str = "",
    is_many: bool = False,
) -> BlockFunction:
    """The function of a block, made once per process for the same numbers shared by all cases.

    Args:
        structure, build, free, own, shared: as for `BlockFunction`.
        kind: key of `STEPPERS`; default: the fastest.
        is_many: as there.

    Raises:
        NoKernelError: no such kernel.
    """
    kind = kind or stepper(structure)
    shapes = tuple(np.shape(x) for x in jax.tree.leaves((free, own)))
    numbers = tuple((np.shape(x), np.asarray(x).tobytes()) for x in jax.tree.leaves(shared))
    key = structure, build, shapes, numbers, kind, is_many, _real(), native.this_processor()
    if key not in _FUNCTIONS:
        while len(_FUNCTIONS) >= KEPT_FUNCTIONS:
            del _FUNCTIONS[next(iter(_FUNCTIONS))]
        _FUNCTIONS[key] = BlockFunction(structure, build, free, own, shared, kind, is_many)
    return _FUNCTIONS[key]


def fastest_function(
    structure: Structure, build: Build, free: Any, own: Any, shared: Any
) -> BlockFunction:
    """As `block_function`; where the kernel is not supported it warns and takes XLA's scan."""
    try:
        return block_function(structure, build, free, own, shared)
    except NoKernelError as error:
        warn_of_scan(error)
        return block_function(structure, build, free, own, shared, "scan")


def _names(
    structure: Structure, build: Build, kind: str, free: Any, own: Any, shared: Any
) -> list[Any]:
    """What a function's programs are kept under; none if a user's function makes its cases."""
    if jax.tree.leaves(free) and not is_plain(getattr(build, "place", build)):
        return []
    digest = sha256()
    for x in jax.tree.leaves(shared):
        digest.update(repr(np.shape(x)).encode() + np.asarray(x).tobytes())
    shapes = [[np.shape(x) for x in jax.tree.leaves(numbers)] for numbers in (free, own)]
    return [structure, build, kind, str(_real()), shapes, digest.hexdigest()]


def _real() -> Any:
    return jax.dtypes.canonicalize_dtype(np.float64)


#: Traced once for all programs that start a case.
_begin = jax.jit(begin, static_argnums=0)


@jax.jit
@partial(jax.vmap, in_axes=(-1, -1, -1))
def _conclude(outline: Outline, code: Any, last: State) -> RunResult:
    """Results of cases whose outline and last state have lanes last; cases first."""
    return conclude(outline, code, last)


@jax.jit
def _pull(pull_back: Callable[[Any], Any], cotangents: Any) -> Any:
    return jax.vmap(pull_back)(cotangents)


def _find_parts(begin_case: Callable[..., Start], free: Any, own: Any, shared: Any) -> StartParts:
    """Trace a case's start."""
    traced, shapes = trace(begin_case, free, own, shared)
    moving = traced.inputs[: len(jax.tree.leaves(free))]
    varying = traced.inputs[: len(jax.tree.leaves((free, own)))]
    return StartParts(
        jax.tree.structure(shapes),
        tuple(_dependence(traced, varying)),
        tuple(traced.shapes),
        tuple(_dependence(traced, moving)),
    )


def _dependence(function: Function, inputs: Iterable[Any]) -> list[bool]:
    """Which results depend on any of these inputs."""
    depends = set(inputs)

    def is_one(atom: Any) -> bool:
        return literal(atom) is None and atom in depends

    for equation in function.equations:
        touched = [is_one(atom) for atom in equation.invars]
        inner = call_of(equation)
        if inner is not None:
            own = zip(inner.inputs, touched, strict=True)
            results = _dependence(inner, [x for x, yes in own if yes])
        else:
            results = [any(touched)] * len(equation.outvars)
        depends.update(x for x, yes in zip(equation.outvars, results, strict=True) if yes)
    return [is_one(out) for out in function.outputs]
