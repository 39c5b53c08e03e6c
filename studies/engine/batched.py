"""A study as a JAX function of some numbers: preparation, kernel and judgement in one program.

It can be part of users' own programs (`jit`, `lax.map`, `shard_map`) and has derivatives in both
modes; the kernel's tangents and its reverse are kernels too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.parameters import Array
from jaxmodel.simulate import Result, simulate
from studies.config import processor
from studies.engine.plan import Layout, lane_unit
from studies.engine.preflight import check_run
from studies.engine.program import Place, Program, begin_block, conclude_all, split_cases
from studies.engine.steps import fits_kernel, given_loop, read_leaves, start_parts
from studies.errors import NoKernelError, StudyError, warn_of_scan
from studies.kernels import bridge
from studies.study.spec import Study


def batched(study: Study, place: Place) -> Callable[[Array], Result]:
    """A study's results as a JAX function of the parameters of many cases.

    A call runs its cases on one core; `jax.shard_map` divides them among several.

    Args:
        study: what all cases share.
        place: `place(case, parameters)` returns the `jaxmodel` case with the parameters of one
            case, (p,), in their places, as JAX operations.

    Returns:
        A function of parameters (n, p) that gives the results of n cases, leaves (n, ...). Its
        derivatives, forward and reverse, are those of the smooth loop: converters without
        rounding, limits with round corners. It raises StudyError for parameters of another shape
        and for a `place` that does not return such a case.

    Raises:
        StudyError: as `check_run`, or not a study or a function. Call it outside of `jit`.
    """
    if not isinstance(study, Study):
        raise StudyError(f"study: {study!r}; expected a study, as load_study returns")
    if not callable(place):
        raise StudyError(f"place: {place!r}; expected a function of a case and its parameters")
    structure, case = check_run(study)
    if processor() != "cpu" or not fits_kernel(structure) or not bridge.is_available():
        return _checked(case, place, _by_scan(structure, case, place))
    exact = _by_kernel(structure, case, place)
    if structure.is_smooth:
        return _checked(case, place, exact)
    smooth = _by_kernel(structure._replace(is_smooth=True), case, place)
    found = jax.custom_jvp(exact)

    @found.defjvp
    def rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Result, Result]:
        return exact(*primals), jax.jvp(smooth, primals, tangents)[1]

    return _checked(case, place, found)


def _checked(case: Case, place: Place, run: Callable[[Array], Result]) -> Callable[[Array], Result]:
    """The same for parameters that are what they should be."""

    def checked(parameters: Array) -> Result:
        try:
            given = jnp.asarray(parameters)
        except (TypeError, ValueError) as error:
            raise StudyError(f"parameters: not an array of numbers ({error})") from None
        if given.ndim != 2 or 0 in given.shape or jnp.iscomplexobj(given):
            raise StudyError(
                f"parameters: {given.dtype} of shape {given.shape}; expected real numbers of shape "
                "(cases, parameters), at least one of each"
            )
        given = given.astype(jax.dtypes.canonicalize_dtype(float))
        _check_place(case, place, given)
        # a number that is none must not spoil the derivatives of the cases beside it
        return run(jnp.where(jnp.isfinite(given), given, jax.lax.stop_gradient(given)))

    return checked


def _check_place(case: Case, place: Place, parameters: Array) -> None:
    row = jax.ShapeDtypeStruct(parameters.shape[1:], parameters.dtype)
    found = jax.eval_shape(place, case, row)
    if not isinstance(found, Case):
        raise StudyError(f"place: returns a {type(found).__name__}; expected the case it was given")
    for (path, one), (other, two) in zip(
        jax.tree_util.tree_leaves_with_path(found),
        jax.tree_util.tree_leaves_with_path(case),
        strict=False,
    ):
        if path != other or one.shape != np.shape(two):
            name = jax.tree_util.keystr(other)
            raise StudyError(f"place: case{name} has shape {one.shape}; expected {np.shape(two)}")


def _by_scan(structure: Structure, case: Case, place: Place) -> Callable[[Array], Result]:
    found: Callable[[Array], Result] = jax.vmap(lambda x: simulate(structure, place(case, x)))
    return found


def _by_kernel(structure: Structure, case: Case, place: Place) -> Callable[[Array], Result]:
    @cache
    def compiled(lanes: int, count: int) -> Callable[[Array], Result]:
        try:
            return _program(structure, case, place, lanes, count)
        except NoKernelError as error:
            warn_of_scan(error)
            return _by_scan(structure, case, place)

    def run(parameters: Array) -> Result:
        n, unit = len(parameters), lane_unit()
        rows = np.minimum(np.arange(-(-n // unit) * unit), n - 1)  # whole vectors
        result = compiled(len(rows), parameters.shape[1])(parameters[rows])
        return jax.tree.map(lambda x: x[:n], result)

    return run


def _program(
    structure: Structure, case: Case, place: Place, lanes: int, count: int
) -> Callable[[Array], Result]:
    """Results of exactly `lanes` cases with `count` parameters each."""
    layout = Layout(1, 1, lanes)
    split = split_cases(jax.tree.map(lambda x: np.asarray(x)[None], case), layout, structure, False)
    program = Program(
        structure=structure,
        layout=layout,
        tree=split.tree,
        is_varying=split.is_varying,
        place=place,
    )
    real = jax.dtypes.canonicalize_dtype(np.float64)
    varying = [np.zeros((lanes, count), real)]
    parts, shared = bridge.outside(start_parts, program, split._replace(varying=varying))
    given = given_loop(structure, parts, shared)
    step = bridge.differentiable(*given, real, structure.n_steps, lanes)

    def run(parameters: Array) -> Result:
        start = begin_block(program, parts, [parameters], split.shared)
        inputs = jax.tree.leaves(start.inputs)
        last = step([*read_leaves(start, parts), *inputs, *jax.tree.leaves(start.state)])
        state: Any = jax.tree.unflatten(jax.tree.structure(start.state), last)
        return conclude_all(start.outline, start.state.status, state)

    return run
