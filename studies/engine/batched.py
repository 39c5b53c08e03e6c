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
from studies.engine.program import Place, Program, begin_block, conclude_all, split_cases
from studies.engine.runs import check_run
from studies.engine.steps import fits_kernel, given_loop, read_leaves, start_parts
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
        rounding, limits with round corners.

    Raises:
        StudyError: as `check_run`.
    """
    structure, case = check_run(study)
    if processor() != "cpu" or not fits_kernel(structure) or not bridge.is_available():
        return jax.vmap(lambda parameters: simulate(structure, place(case, parameters)))
    exact = _by_kernel(structure, case, place)
    if structure.is_smooth:
        return exact
    smooth = _by_kernel(structure._replace(is_smooth=True), case, place)
    found = jax.custom_jvp(exact)

    @found.defjvp
    def rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[Result, Result]:
        return exact(*primals), jax.jvp(smooth, primals, tangents)[1]

    return found


def _by_kernel(structure: Structure, case: Case, place: Place) -> Callable[[Array], Result]:
    @cache
    def compiled(lanes: int, count: int) -> Callable[[Array], Result]:
        return _program(structure, case, place, lanes, count)

    def run(parameters: Array) -> Result:
        parameters = jnp.asarray(parameters, float)
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
