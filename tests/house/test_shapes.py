"""Arrays of a run have the axes that fields of the model are annotated with."""

from __future__ import annotations

import ast
import re
import sys
from functools import reduce
from importlib import import_module
from operator import or_
from types import NoneType, UnionType
from typing import Any, NamedTuple, Union, get_args, get_origin, get_type_hints

import jax
import jaxtyping
import numpy as np
import pytest
from jaxtyping import AbstractArray, Num, Shaped, jaxtyped

from jaxmodel.linear import linearise
from jaxmodel.loop import step
from jaxmodel.metrics import METRICS, Sizes
from jaxmodel.parameters import PerLink
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import assembled_modes, loop_response
from jaxmodel.sampled_loop import loop_matrices
from jaxmodel.sampled_response import plant_response
from jaxmodel.shaper import zvd
from jaxmodel.simulate import begin, conclude
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study
from tests import TOP

#: Sizes that cannot be taken for one another, but those of links and pose: a five-bar has two.
AXES = {"links": 3, "pose": 3, "R": 5, "Q": 6, "C": 2, "K": 4, "S": 7}
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
#: With much that a study can have beyond the default.
FULL = {
    "control__position_gain": (10.0, 10.0),
    "control__notch_hz": (300.0, 300.0),
    "drive__ripple": 1.0,
    "electronics__adc_noise": 1e-3,
    "electronics__amplifier_hz": 1000.0,
    "electronics__sensor_highpass_hz": 1.0,
    "machine__joint_friction": 1e-3,
    "patches__hysteresis": 0.1,
}
#: What annotations name, for arrays of NumPy.
NAMES = {name: getattr(jaxtyping, name) for name in ("Complex", "Int", "Num", "Shaped")}
NAMES["Array"] = np.ndarray
NAMES["PerLink"] = reduce(or_, (Num[np.ndarray, x.__metadata__[0]] for x in get_args(PerLink)))
#: A line with an array or no field, whose comment has a shape: "[m], (3, C); None: ..".
_FIELD = re.compile(
    r"^ +(\w+: .*\bArray\b.*)?# (.*[\],;\w] )?\(([\w +]+,[\w +,.]*)?\)( each)?(, None.*)?($|[;:])"
)


class Right(NamedTuple):
    """Like a NamedTuple of the model."""

    each: tuple[Num[Array, "links C"], ...]
    more: Num[Array, "n+1"]
    rest: Num[Array, "n"] | None


class Wrong(NamedTuple):
    """The same with wrong annotations."""

    each: tuple[Num[Array, "C links"], ...]
    more: Num[Array, "n"]
    rest: Num[Array, "n"] | None


def hints(kind: type) -> dict[str, Any]:
    """Annotations of a class with jaxtyping's types."""
    return get_type_hints(kind, None, vars(sys.modules[kind.__module__]) | NAMES)


def fits(value: Any, hint: Any) -> bool:
    """Whether arrays have the axes of their annotation; other annotations but None fit."""
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
    is_checked = isinstance(hint, type) and issubclass(hint, tuple | NoneType)
    return not is_checked or isinstance(value, hint)


@jaxtyped(typechecker=None)
def misfits(one: tuple, axes: dict[str, int]) -> list[str]:
    """Fields of a tuple, and of those in it, whose arrays have other axes than annotated.

    The letters of `axes` mean one number everywhere, others within a NamedTuple.
    """
    assert isinstance(np.empty(tuple(axes.values())), Shaped[np.ndarray, " ".join(axes)])
    found = [
        f"{type(one).__name__}.{name}: {jax.tree.map(np.shape, getattr(one, name))} is no {hint}"
        # sums of letters after the letters
        for name, hint in sorted(hints(type(one)).items(), key=lambda x: "+" in str(x[1]))
        if not fits(getattr(one, name), hint)
    ]
    return found + [x for part in one if isinstance(part, tuple) for x in misfits(part, axes)]


def traced(study: Study) -> dict[str, Any]:
    """What a run consists of, traced but not computed."""
    structure = build_structure(study)

    def make(case):
        prepared = prepare(structure, case)
        loop, pose = prepared.loop, case.path.waypoints[0]
        with pytest.MonkeyPatch.context() as patch:  # lest it is traced twice
            patch.setattr(sys.modules[begin.__module__], "prepare", lambda *_: prepared)
            start = begin(structure, case)
        start = start._replace(inputs=jax.tree.map(lambda x: x[0], start.inputs))
        end, record = step(structure, loop, start.state, start.inputs)
        parts = {
            "case": case,
            "prepared": prepared,
            "impulses": zvd(loop.omega[0, 0], 0.0),
            "start": start,
            "end": end,
            "record": record,
            "result": conclude(start.outline, end.status, end),
        }
        if structure.n_links == 2:
            return parts
        response = loop_response(structure, case, loop, pose)
        return parts | {
            "response": response,
            "modes": assembled_modes(response),
            "plant response": plant_response(structure, case, loop, pose),
            "linear": linearise(structure, loop, pose),
            "matrices": loop_matrices(structure, case, loop, loop.controller, pose, None),
        }

    made = jax.eval_shape(make, as_arrays(build_case(study)))
    return jax.tree.map(lambda x: np.empty(x.shape, x.dtype), made)


@pytest.fixture(scope="module", params=["prrr", "five_bar"])
def made(request):
    """Traced parts of a run, and the sizes of its axes."""
    if request.param == "prrr":
        return traced(STUDY), AXES
    return traced(STUDY.change(machine__kind="five_bar", **FULL)), AXES | {"links": 2, "pose": 2}


def test_shapes_are_those_of_the_annotations(made):
    parts, axes = made
    assert [x for name, one in parts.items() for x in misfits(one, axes)] == []


def test_a_wrong_annotation_is_found():
    given = (np.empty((3, 2)), np.empty((3, 2))), np.empty(5), np.empty(4)
    assert misfits(Right(*given), AXES) == []
    found = misfits((Wrong(*given), Right(*given)), AXES)
    assert [x.split(":")[0] for x in found] == ["Wrong.each", "Wrong.rest"]


def test_annotations_can_be_read_and_comments_have_no_shapes():
    """What no run above has is spelt well, too."""
    looked = 0
    for path in sorted((TOP / "jaxmodel").rglob("*.py")):
        text = path.read_text(encoding="utf-8")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.ClassDef) and "NamedTuple" in map(ast.unparse, node.bases):
                module = import_module(".".join(path.relative_to(TOP).with_suffix("").parts))
                found = hints(vars(module)[node.name])
                looked += sum("jaxtyping" in str(hint) for hint in found.values())
                lines = ast.get_source_segment(text, node).splitlines()
                assert not [line for line in lines if _FIELD.match(line)], node.name
    assert looked > 600


def test_metrics_have_their_dims(made):
    parts, axes = made
    found = parts["result"].metrics
    count = found.spectral_density.shape[-1]
    sizes = Sizes(*(axes[x] for x in "SRC"), count, axes["links"], axes["pose"])
    for name, value in found.items():
        assert np.shape(value) == tuple(sizes.axes[axis] for axis in METRICS[name].dims), name
