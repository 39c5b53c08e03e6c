"""The per-sample step is what other executors compile: short arrays, elementwise, small."""

import jax
import numpy as np
import pytest

from jaxmodel.initial import initial_state
from jaxmodel.loop import step
from jaxmodel.prepare import prepare
from jaxmodel.simulate import command
from studies.study.cases import as_arrays, build_case, build_structure
from tests.studies.engine.test_batch import short_study

ELEMENTWISE = {
    "abs",
    "add",
    "and",
    "broadcast_in_dim",
    "clamp",
    "concatenate",
    "convert_element_type",
    "cos",
    "div",
    "eq",
    "ge",
    "gt",
    "integer_pow",
    "is_finite",
    "le",
    "lt",
    "max",
    "min",
    "mul",
    "ne",
    "neg",
    "not",
    "or",
    "reduce_max",
    "reduce_or",
    "reduce_sum",
    "reshape",
    "round",
    "select_n",
    "sign",
    "sin",
    "slice",
    "sqrt",
    "stack",
    "square",
    "squeeze",
    "sub",
    "tanh",
}


@pytest.fixture(scope="module")
def parts():
    study = short_study(link__modes=4)
    structure, case = build_structure(study), as_arrays(build_case(study))

    def build(case):
        prepared = prepare(structure, case)
        outside = command(structure, case, prepared)
        start = initial_state(
            structure,
            prepared.loop,
            outside.start_pose,
            prepared.initial_q,
            outside.status,
            case.electronics.sensor_highpass,
            None,
        )
        return prepared.loop, start, jax.tree.map(lambda x: x[100], outside.inputs)

    return structure, *jax.jit(build)(case)


def primitives(jaxpr, found):
    for equation in jaxpr.eqns:
        inner = [p for p in equation.params.values() if hasattr(p, "jaxpr") or hasattr(p, "eqns")]
        for sub in inner:
            primitives(getattr(sub, "jaxpr", sub), found)
        if not inner:
            found.append(equation.primitive.name)
    return found


def test_step_is_elementwise(parts):
    structure, loop, state, inputs = parts
    traced = jax.make_jaxpr(lambda *a: step(structure, *a))(loop, state, inputs)
    found = primitives(traced.jaxpr, [])
    assert set(found) <= ELEMENTWISE, set(found) - ELEMENTWISE
    assert len(found) < 2500  # a guard against growth: what runs is what costs


def test_lanes_last_equals_single(parts):
    """The same function takes lanes in a trailing axis, without vmap."""
    structure, loop, state, inputs = parts
    lanes = 5
    factor = np.linspace(0.5, 1.5, lanes)

    def widen(x):
        return np.repeat(np.asarray(x)[..., None], lanes, axis=-1)

    wide_loop, wide_state, wide_inputs = jax.tree.map(widen, (loop, state, inputs))
    plant = wide_state.plant._replace(q=wide_state.plant.q + 1e-5 * factor)
    run = jax.jit(step, static_argnums=0)
    wide, _ = run(structure, wide_loop, wide_state._replace(plant=plant), wide_inputs)
    for k in (0, 3):
        one = state._replace(plant=state.plant._replace(q=state.plant.q + 1e-5 * factor[k]))
        single, _ = run(structure, loop, one, inputs)
        for a, b in zip(jax.tree.leaves(wide), jax.tree.leaves(single), strict=True):
            # XLA joins operations in its own ways, so entries round as the largest of a leaf does
            size = np.max(np.abs(b), initial=0.0)
            np.testing.assert_allclose(np.asarray(a)[..., k], b, rtol=0, atol=1e-12 * size + 1e-18)
