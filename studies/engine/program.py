"""What comes before and after the steps of a chunk, the same for all executors.

A chunk's leaves are split into those that vary from case to case and those that all cases share,
which are computed once. With a `place`, parameters set some numbers of each case, and everything
that depends on them has tangents.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial, wraps
from threading import Lock
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure, with_ratio
from jaxmodel.metrics import Metrics
from jaxmodel.parameters import Array
from jaxmodel.simulate import Outline, Result, Start, begin, conclude
from studies.engine.plan import Layout
from studies.kernels.equations import Function, call_of, literal, trace

#: How often a program was traced in this process; tests use it to count compilations.
TRACES: list[Structure] = []
#: Puts parameters (p,) into a case; pass the same object every time to avoid recompiling.
Place = Callable[[Case, Array], Case]

_ALONE = Lock()


def one_at_a_time(function: Callable[..., Any]) -> Callable[..., Any]:
    """A program that runs alone, to its end, and returns NumPy arrays.

    Of two concurrent runs of programs with an eigenvalue problem (basis loaded), XLA's CPU client
    occasionally never finishes one (jax 0.10), even if nobody waits for the other's results.
    """

    @wraps(function)
    def alone(*given: Any) -> Any:
        with _ALONE:
            return jax.tree.map(np.asarray, function(*given))

    return alone


class Running(NamedTuple):
    """A running chunk."""

    wait: Callable[[], Result]  # until it is done; NumPy arrays
    cancel: Callable[[], None]  # cancel what has not started yet


class Executor(Protocol):
    """Runs chunks of one group."""

    structure: Structure
    compile_time: float  # [s], 0 before the first chunk

    @property
    def name(self) -> str: ...

    def start(self, cases: Case) -> Running:
        """Start a chunk.

        Args:
            cases: from `chunk_cases`, `layout.size` of them.
        """
        ...


class Split(NamedTuple):
    """Leaves of a Case, split into those that vary and those that all cases share."""

    tree: Any
    is_varying: tuple[bool, ...]
    varying: list[np.ndarray]  # cases first
    shared: list[np.ndarray]


def split_cases(cases: Case, layout: Layout, structure: Structure, has_own_ratio: bool) -> Split:
    """Leaves of a chunk's cases.

    Args:
        cases: leaves with a leading axis, all cases or 1.
        layout: of the chunk.
        structure: of the cases.
        has_own_ratio: EMC ratios come from an uncontrolled pass.
    """
    if has_own_ratio:  # the same program for both passes, which differ in ratios and links
        shape = (layout.size, 3, structure.n_controlled)
        cases = with_ratio(cases, np.broadcast_to(cases.control.ratio, shape))
        links = np.broadcast_to(cases.control.link_mask, shape[:2])
        cases = cases._replace(control=cases.control._replace(link_mask=links))
    leaves, tree = jax.tree.flatten(cases)
    leaves = [np.asarray(leaf) for leaf in leaves]
    is_varying = tuple(len(leaf) == layout.size for leaf in leaves)
    return Split(
        tree,
        is_varying,
        [leaf for leaf, varies in zip(leaves, is_varying, strict=True) if varies],
        [leaf[0] for leaf, varies in zip(leaves, is_varying, strict=True) if not varies],
    )


def lane_blocks(split: Split, layout: Layout) -> list[list[np.ndarray]]:
    """Leaves that vary, cut into blocks of lanes."""
    starts = range(0, layout.size, layout.lanes)
    return [[leaf[k : k + layout.lanes] for leaf in split.varying] for k in starts]


def joined(tree: Any, is_varying: tuple[bool, ...], varying: list[Any], shared: list[Any]) -> Any:
    """The tree rebuilt from varying and shared leaves."""
    sources = {True: iter(varying), False: iter(shared)}
    return jax.tree.unflatten(tree, [next(sources[varies]) for varies in is_varying])


class Program(NamedTuple):
    """What a compiled program depends on; hashable."""

    structure: Structure
    layout: Layout
    tree: Any  # of a Case
    is_varying: tuple[bool, ...]
    place: Place | None = None  # if set, the parameters are the last varying leaf


class StartParts(NamedTuple):
    """A Start leaf by leaf: which leaves vary from case to case, and their shapes."""

    tree: Any
    is_varying: tuple[bool, ...]
    shapes: tuple[tuple[int, ...], ...]  # of one case
    is_moving: tuple[bool, ...]  # depends on the parameters


def begin_case(program: Program, own: list[Any], common: list[Any]) -> Start:
    """The start of one case."""
    if program.place is None:
        case = joined(program.tree, program.is_varying, own, common)
    else:
        *own, parameters = own
        case = joined(program.tree, program.is_varying, own, common)
        case = program.place(case, parameters)
    return _begin(program.structure, case)


#: Traced once for all programs that start a case.
_begin = jax.jit(begin, static_argnums=0)


def chosen(
    program: Program, parts: StartParts, wanted: bool, own: list[Any], common: list[Any]
) -> list[Any]:
    """Varying or shared leaves of a case's start."""
    leaves = jax.tree.leaves(begin_case(program, own, common))
    return [x for x, varies in zip(leaves, parts.is_varying, strict=True) if varies == wanted]


def begin_block(program: Program, parts: StartParts, own: list[Any], common: list[Any]) -> Start:
    """The start of a block of cases, lanes last, as part of a compiled program.

    Args:
        program, parts: of the cases.
        own: leaves that vary, cases first.
        common: those that do not.

    Returns:
        Start with state and outline of every case; other shared leaves have a last axis of 1.
    """
    varies: Start = jax.tree.unflatten(parts.tree, parts.is_varying)
    lanes = len(own[0])
    own_parts = jax.vmap(partial(chosen, program, parts, True), (0, None), -1)(own, common)
    same = chosen(program, parts, False, [x[0] for x in own], common)
    start: Start = joined(parts.tree, parts.is_varying, own_parts, [x[..., None] for x in same])

    def whole(x: Any, is_wide: bool) -> Any:
        return x if is_wide else jnp.broadcast_to(x, (*x.shape[:-1], lanes))

    return start._replace(
        state=jax.tree.map(whole, start.state, varies.state),
        outline=jax.tree.map(whole, start.outline, varies.outline),
    )


@one_at_a_time
@partial(jax.jit, static_argnums=(0, 1))
def prepare(program: Program, parts: StartParts, own: list[Any], common: list[Any]) -> list[Any]:
    """The leaves that vary, lanes last."""
    return jax.vmap(partial(chosen, program, parts, True), (0, None), -1)(own, common)


# run once, so compiled without optimisation: saves a quarter of two to four seconds
@one_at_a_time
@partial(jax.jit, static_argnums=(0, 1), compiler_options={"xla_backend_optimization_level": 0})
def prepare_shared(
    program: Program, parts: StartParts, own: list[Any], common: list[Any]
) -> list[Any]:
    """The shared leaves, from any one case."""
    return chosen(program, parts, False, own, common)


@one_at_a_time
@partial(jax.jit, static_argnums=(0, 1))
def prepare_tangents(
    program: Program, parts: StartParts, own: list[Any], common: list[Any], directions: Array
) -> list[Any]:
    """Tangents of the moving leaves along directions (n, p) of parameters, (n, ..., lanes)."""

    def one(own: list[Any], common: list[Any]) -> list[Any]:
        *fixed, parameters = own

        def moving(parameters: Array) -> list[Any]:
            return _moving(program, parts, [*fixed, parameters], common)

        along = partial(jax.jvp, moving, (parameters,))
        return jax.vmap(lambda direction: along((direction,))[1])(directions)

    return jax.vmap(one, (0, None), -1)(own, common)


@one_at_a_time
@partial(jax.jit, static_argnums=(0, 1))
def prepare_gradients(
    program: Program, parts: StartParts, own: list[Any], common: list[Any], cotangents: list[Any]
) -> Array:
    """Gradients of some numbers by the parameters, (n, lanes, p).

    Args:
        program, parts: of the cases.
        own, common: as in `prepare`.
        cotangents: of the moving leaves, numbers first and lanes last.
    """

    def one(own: list[Any], common: list[Any], cotangents: list[Any]) -> Array:
        *fixed, parameters = own

        def moving(parameters: Array) -> list[Any]:
            return _moving(program, parts, [*fixed, parameters], common)

        (found,) = jax.vmap(jax.vjp(moving, parameters)[1])(cotangents)
        return found

    return jax.vmap(one, (0, None, -1), 1)(own, common, cotangents)


def _moving(program: Program, parts: StartParts, own: list[Any], common: list[Any]) -> list[Any]:
    """Leaves of a case's start that depend on the parameters."""
    leaves = jax.tree.leaves(begin_case(program, own, common))
    return [x for x, moves in zip(leaves, parts.is_moving, strict=True) if moves]


def find_parts(program: Program, own: list[Any], common: list[Any]) -> StartParts:
    """Trace a case's start.

    Args:
        program: what to trace.
        own, common: leaves of one case that vary, and that do not.
    """
    traced, shapes = trace(partial(begin_case, program), own, common)
    given = traced.inputs[: len(own)]
    moving = given[-1:] if program.place else []
    return StartParts(
        jax.tree.structure(shapes),
        tuple(_dependence(traced, given)),
        tuple(traced.shapes),
        tuple(_dependence(traced, moving)),
    )


def _dependence(function: Function, given: Iterable[Any]) -> list[bool]:
    """Which results depend on any of the given inputs."""
    depends = set(given)

    def is_one(atom: Any) -> bool:
        return literal(atom) is None and atom in depends

    for equation in function.equations:
        touched = [is_one(atom) for atom in equation.invars]
        inner = call_of(equation)
        if inner is not None:
            own = zip(inner.inputs, touched, strict=True)
            found = _dependence(inner, [x for x, yes in own if yes])
        else:
            found = [any(touched)] * len(equation.outvars)
        depends.update(x for x, yes in zip(equation.outvars, found, strict=True) if yes)
    return [is_one(out) for out in function.outputs]


@jax.jit
@partial(jax.vmap, in_axes=(-1, -1, -1))
def conclude_all(outline: Any, code: Any, state: Any) -> Result:
    """Results of cases whose start and last state have lanes last."""
    return conclude(outline, code, state)


@jax.jit
@partial(jax.vmap, in_axes=(-1, -1, -1, -1, -1))
def conclude_slopes(outline: Outline, code: Array, state: Any, turn: Outline, slope: Any) -> Any:
    """Results, and tangents of the metrics, (cases, p, ...).

    Args:
        outline, code, state: as in `conclude`, lanes last.
        turn, slope: tangents of outline and state, directions first.
    """

    def judged(outline: Outline, state: Any) -> tuple[Any, ...]:
        result = conclude(outline, code, state)
        return result.metrics, result

    def along(turn: Outline, slope: Any) -> tuple[Any, ...]:
        _, tangent, result = jax.jvp(judged, (outline, state), (turn, slope), has_aux=True)
        return result, tangent

    return jax.vmap(along, out_axes=(None, 0))(turn, slope)


@jax.jit
@partial(jax.vmap, in_axes=(-1, -1, -1, 1), out_axes=-1)
def conclude_gradients(outline: Outline, code: Array, state: Any, cotangents: Metrics) -> Any:
    """Cotangents of outline and state, numbers first and lanes last.

    Args:
        outline, code, state: as in `conclude`, lanes last.
        cotangents: of the metrics, (numbers, cases, ...).
    """

    def judged(outline: Outline, state: Any) -> Metrics:
        return conclude(outline, code, state).metrics

    return jax.vmap(jax.vjp(judged, outline, state)[1])(cotangents)
