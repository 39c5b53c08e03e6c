"""Arrays of a run have the shapes that fields are annotated with."""

from __future__ import annotations

import ast
import re
import sys
from functools import reduce
from operator import or_
from types import NoneType, UnionType
from typing import NamedTuple, Union, get_args, get_origin, get_type_hints

import jax
import jaxtyping
import numpy as np
import pytest
from jaxtyping import AbstractArray, Num, Shaped, jaxtyped

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis
from jaxmodel.frequency_response import plant_response
from jaxmodel.linear import linearise
from jaxmodel.loop import step
from jaxmodel.metrics import METRICS, Sizes
from jaxmodel.parameters import PerLink
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import assembled_modes, loop_response
from jaxmodel.sampled_loop import loop_matrices
from jaxmodel.shaper import design_shaper
from jaxmodel.simulate import begin, simulate
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study
from tests import TOP

#: Axes with sizes that cannot be taken for one another, but for the links: a five-bar has two.
AXES = {"pose": 3, "Q": 6, "R": 5, "C": 2, "K": 4, "S": 7}
STUDY = Study().change(
    run__duration=0.05,
    link__modes=5,
    link__basis="loaded",
    control__modes=2,
    patches__centers=(0.03, 0.08, 0.12, 0.17),
    metrics__stations=(0.15, 0.25, 0.4, 0.5, 0.6, 0.75, 0.85),
    metrics__residual_delay=0.0,
    metrics__residual_length=0.005,
    motion__move_time=0.002,
    shaper__kind="none",
)
#: What the package writes in annotations, for arrays of NumPy.
NAMES = {name: getattr(jaxtyping, name) for name in ("Complex", "Int", "Num", "Shaped")}
NAMES["Array"] = np.ndarray
NAMES["PerLink"] = reduce(or_, (Num[np.ndarray, x.__metadata__[0]] for x in get_args(PerLink)))
#: A list in brackets in a comment: (3, C), (n,) or (); not a call or what explains a word.
_SHAPE = re.compile(r"#.*(?<!\w)\((?:|\w[\w +]*,[\w, +]*)\)")


def fits(value: object, hint: object) -> bool:
    """Whether arrays have the axes of their annotation."""
    parts = get_args(hint)
    if get_origin(hint) in (Union, UnionType):
        return any(fits(value, part) for part in parts)
    if get_origin(hint) is dict:
        return all(fits(one, parts[1]) for one in value.values())
    if get_origin(hint) is tuple and isinstance(value, tuple):
        parts = parts[:1] * len(value) if parts[-1] is ... else parts
        return len(parts) == len(value) and all(map(fits, value, parts))
    if isinstance(hint, type) and issubclass(hint, AbstractArray):
        return isinstance(np.asarray(value), hint)
    return not (isinstance(hint, type) and issubclass(hint, tuple | NoneType)) or isinstance(
        value, hint
    )


@jaxtyped(typechecker=None)
def misfits(one: tuple, axes: dict[str, int]) -> list[str]:
    """Fields, of tuples within a tuple as well, whose axes are others than annotated.

    A letter means one number within a NamedTuple, and one of `axes` everywhere.
    """
    assert isinstance(np.empty(tuple(axes.values())), Shaped[np.ndarray, " ".join(axes)])
    kind = type(one)
    space = vars(sys.modules[kind.__module__]) | NAMES
    hints = get_type_hints(kind, space)
    found = [
        f"{kind.__name__}.{name}: {jax.tree.map(np.shape, getattr(one, name))} is no {hint}"
        # sums of letters after the letters
        for name, hint in sorted(hints.items(), key=lambda x: "+" in str(x[1]))
        if not fits(getattr(one, name), hint)
    ]
    return found + [x for part in one if isinstance(part, tuple) for x in misfits(part, axes)]


def traced(study: Study) -> dict[str, tuple]:
    """What a run is made of, traced but not computed."""
    structure = build_structure(study)

    def make(case):
        prepared = prepare(structure, case)
        loop, pose = prepared.loop, case.path.waypoints[0]
        start = begin(structure, case)
        inputs = jax.tree.map(lambda x: x[0], start.inputs)
        response = loop_response(structure, case, loop, pose)
        return {
            "case": case,
            "prepared": prepared,
            "start": start._replace(inputs=inputs),
            "step": step(structure, loop, start.state, inputs),
            "response": response,
            "modes": assembled_modes(response),
            "plant response": plant_response(structure, case, loop, pose),
            "linear": linearise(structure, loop, pose),
        }

    made = jax.eval_shape(make, as_arrays(build_case(study)))
    return jax.tree.map(lambda x: np.empty(x.shape, x.dtype), made)


@pytest.mark.parametrize(
    ("kind", "axes"), [("prrr", {"links": 3}), ("five_bar", {"links": 2, "pose": 2})]
)
def test_shapes_are_those_of_the_annotations(kind, axes):
    for name, one in traced(STUDY.change(machine__kind=kind)).items():
        assert not misfits(one, AXES | axes), name
