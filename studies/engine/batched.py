"""A study as a JAX function of some numbers: preparation, kernel and judgement in one program.

It can be part of users' own programs (`jit`, `lax.map`, `shard_map`) and has derivatives in both
modes; the kernel's tangents and its reverse are kernels too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.judge import LoopVerdicts, can_judge, judge
from jaxmodel.numbers import Numbers, case_of, with_used
from jaxmodel.parameters import Array
from jaxmodel.simulate import RunResult
from studies.engine.function import BlockFunction, fastest_function
from studies.engine.plan import STATIC, lane_unit, padded_rows
from studies.engine.preflight import check_run
from studies.engine.steps import fastest_steps
from studies.errors import StudyError
from studies.kernels.differentiable import outside
from studies.study.numbers import one_study, position, put
from studies.study.paths import known_field, overlaps
from studies.study.spec import Study

#: Numbers of modes that can be fewer than the study's, and what stands for controlled links.
COUNTS, SUBSETS = ("link.modes", "control.modes"), "link_subsets"
LABELS = {SUBSETS: "control.links"}


def batched(study: Study, names: Sequence[str], is_judged: bool = False) -> Callable[[Array], Any]:
    """A study's results as a JAX function of some of its numbers, for many cases.

    A call runs its cases on one core; `jax.shard_map` divides them among several.

    Args:
        study: what all cases share.
        names: of the numbers that vary, as in files: fields, which then have one value for all
            that they stand for, or entries of lists, such as `control.velocity_gain[0]`. Also
            `link.modes` and `control.modes`, at most those of the study; `control.links[0]` and
            alike, 1 or 0; `link_subsets`, 1, 2, 4.. for each controlled link, added up.
        is_judged: also judge the loops, see `jaxmodel.judge`.

    Returns:
        A function of values (n, p), one column a name, in the units of the file, that gives the
        results of n cases, leaves (n, ...), or a pair of these and what is judged. Its
        derivatives, forward and reverse, are those of the smooth loop: converters without
        rounding, limits with round corners. It raises StudyError for values of another shape.
        Unlike files it does not check ranges.

    Raises:
        StudyError: as `check_run`, not a study, a name that is none of its numbers, or a loop that
            only its eigenvalues judge. Call it outside of `jit`.

    Example:
        >>> run = batched(load_study("paper"), ["control.gain_factor", "drive.kp"])
        >>> run(np.array([[1.0, 2e4], [0.5, 2e4]])).metrics.residual_rms.shape
        (2, 2, 3, 3)
    """
    if not isinstance(study, Study):
        raise StudyError(f"study: {study!r}; expected a study, as load_study returns")
    positions = _positions(study, names)
    structure = with_used(check_run(study)[0], [field for field, _ in positions])
    run = _run(study, structure, positions)
    if not is_judged:
        return _check_shape(len(positions), run)
    judged = _judge_program(study, structure, positions)
    return _check_shape(len(positions), lambda values: (run(values), judged(values)))


def _run(
    study: Study, structure: Structure, positions: tuple[Any, ...]
) -> Callable[[Array], RunResult]:
    exact = _batch_program(study, structure, positions)
    if structure.is_smooth:
        return exact
    smooth = _batch_program(study, structure._replace(is_smooth=True), positions)
    rounded = jax.custom_jvp(exact)

    @rounded.defjvp
    def rule(primals: tuple[Array], tangents: tuple[Array]) -> tuple[RunResult, RunResult]:
        return exact(*primals), jax.jvp(smooth, primals, tangents)[1]

    return rounded


def _judge_program(
    study: Study, structure: Structure, positions: tuple[Any, ...]
) -> Callable[[Array], LoopVerdicts]:
    if not can_judge(structure):
        raise StudyError(
            f"is_judged: of control.feedback = {study.control.feedback!r}, control.law = "
            f"{study.control.law!r} and drive.kind = {study.drive.kind!r}, with drive.lag = "
            f"{study.drive.lag:g} s, only eigenvalues judge a loop: run_study(study).loop has them"
        )
    shared, build = one_study(study, structure), _Build(structure, positions)
    steps = fastest_steps([])
    has_links = any(field in (SUBSETS, LABELS[SUBSETS]) for field, _ in positions)
    n_active = structure.n_links if has_links else max(1, sum(study.control.links))

    def run(parameters: Array) -> LoopVerdicts:
        cases = jax.vmap(lambda free: build(free, None, shared))(parameters)
        return judge(structure, cases, steps, n_active)

    return run


def _positions(study: Study, names: Sequence[str]) -> tuple[Any, ...]:
    """Where the numbers that vary are."""
    is_list = isinstance(names, Sequence) and not isinstance(names, str)
    if not is_list or not names or not all(isinstance(name, str) for name in names):
        raise StudyError(f"names: {names!r}; expected names of numbers, such as ['drive.kp']")
    for k, name in enumerate(names):
        name = LABELS[name] if name == SUBSETS else name
        value = known_field(name, study, f"names[{k}]", [SUBSETS])
        is_number = _is_real(value) or name in COUNTS or name.startswith(LABELS[SUBSETS])
        if not is_number or name in STATIC:
            raise StudyError(f"names[{k}]: {name!r} = {value}; expected real numbers, not choices")
        if any(overlaps(name, LABELS.get(other, other)) for other in names[:k]):
            raise StudyError(f"names[{k}]: {name!r} is there twice")
    return tuple((SUBSETS, ...) if x == SUBSETS else position(study, x) for x in names)


def _is_real(value: Any) -> bool:
    """Whether it is a real number, or a list of such numbers."""
    is_list = isinstance(value, tuple) and len(value) > 0
    return all(map(_is_real, value)) if is_list else isinstance(value, float)


def _check_shape(count: int, run: Callable[[Array], Any]) -> Callable[[Array], Any]:
    """The same for values that are what they should be."""

    def checked(values: Array) -> Any:
        try:
            array = jnp.asarray(values)
        except (TypeError, ValueError, OverflowError) as error:
            raise StudyError(f"values: not an array of numbers ({error})") from None
        is_fitting = array.ndim == 2 and len(array) > 0 and array.shape[1] == count
        if not is_fitting or jnp.iscomplexobj(array):
            raise StudyError(
                f"values: {array.dtype} of shape {array.shape}; expected real numbers of shape "
                f"(cases, {count}), one case or more"
            )
        array = array.astype(jax.dtypes.canonicalize_dtype(float))
        # a NaN must not spoil the derivatives of the cases beside it
        return run(jnp.where(jnp.isfinite(array), array, jax.lax.stop_gradient(array)))

    return checked


@dataclass(frozen=True)
class _Build:
    """Makes a case of the values that vary and the study's numbers."""

    structure: Structure
    positions: tuple[Any, ...]

    def __call__(self, free: Array, own: Any, shared: Numbers) -> Case:
        numbers = shared
        for k, at in enumerate(self.positions):
            value = free[k]
            if at[0] == SUBSETS:
                at = LABELS[SUBSETS], ...
                value = jnp.floor(value / 2.0 ** jnp.arange(self.structure.n_links)) % 2
            numbers = put(numbers, at, value)
        return case_of(self.structure, numbers)


def _batch_program(
    study: Study, structure: Structure, positions: tuple[Any, ...]
) -> Callable[[Array], RunResult]:
    shared, build = one_study(study, structure), _Build(structure, positions)

    @cache
    def function(lanes: int, count: int) -> BlockFunction:
        free = np.zeros((lanes, count), jax.dtypes.canonicalize_dtype(float))
        return fastest_function(structure, build, free, [], shared)

    def run(parameters: Array) -> RunResult:
        n = len(parameters)
        rows = padded_rows(n, lane_unit())
        one_block = outside(function, len(rows), parameters.shape[1])
        return jax.tree.map(lambda x: x[:n], one_block(parameters[rows], []))

    return run
