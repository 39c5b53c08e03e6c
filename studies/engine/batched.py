"""A study as a JAX function of some numbers: preparation, kernel and judgement in one program.

It can be part of users' own programs (`jit`, `lax.map`, `shard_map`) and has derivatives in both
modes; the kernel's tangents and its reverse are kernels too.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.parameters import Array
from jaxmodel.simulate import Result
from studies.engine.executor import CaseLeaves, Place
from studies.engine.function import BlockFunction, stepper
from studies.engine.plan import lane_unit
from studies.engine.preflight import check_run
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
    exact = _of_batches(structure, case, place)
    if structure.is_smooth:
        return _checked(case, place, exact)
    smooth = _of_batches(structure._replace(is_smooth=True), case, place)
    rounded = jax.custom_jvp(exact)

    @rounded.defjvp
    def rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Result, Result]:
        return exact(*primals), jax.jvp(smooth, primals, tangents)[1]

    return _checked(case, place, rounded)


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


def _of_batches(structure: Structure, case: Case, place: Place) -> Callable[[Array], Result]:
    leaves, tree = jax.tree.flatten(case)
    build = CaseLeaves(tree, (False,) * len(leaves), place)

    @cache
    def function(lanes: int, count: int) -> BlockFunction:
        free = np.zeros((lanes, count), jax.dtypes.canonicalize_dtype(float))
        shared = [np.asarray(leaf) for leaf in leaves]

        def make(kind: str) -> BlockFunction:
            return BlockFunction(structure, build, free, [], shared, kind)

        try:
            return make(stepper(structure))
        except NoKernelError as error:
            warn_of_scan(error)
            return make("scan")

    def run(parameters: Array) -> Result:
        n, unit = len(parameters), lane_unit()
        rows = np.minimum(np.arange(-(-n // unit) * unit), n - 1)  # whole vectors
        one_block = bridge.outside(function, len(rows), parameters.shape[1])
        return jax.tree.map(lambda x: x[:n], one_block(parameters[rows], []))

    return run
