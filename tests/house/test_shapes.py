"""Arrays have the shapes that their fields' comments promise."""

from __future__ import annotations

import inspect
import re

import jax
import numpy as np
import pytest
from jaxtyping import Shaped, jaxtyped

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis
from jaxmodel.metrics import METRICS, Sizes
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import assembled_modes, loop_response
from jaxmodel.simulate import simulate
from studies.study.cases import as_arrays, build_case, build_structure
from tests.bare import paper_study

#: Sizes that cannot be taken for one another: modes, channels, patches, stations.
STUDY = paper_study().change(
    run__duration=0.05,
    link__modes=5,
    link__basis="loaded",
    control__modes=2,
    control__position_gain=(10.0, 10.0, 10.0),
    patches__centers=(0.03, 0.08, 0.12, 0.17),
    metrics__stations=(0.15, 0.25, 0.4, 0.5, 0.6, 0.75, 0.85),
    metrics__residual_delay=0.0,
    metrics__residual_length=0.005,
    motion__move_time=0.002,
    shaper__kind="none",
)
#: "name: Array  # ..., (3, C)" or "... each"; of a comment that goes on, its last line.
_FIELD = re.compile(r"^    (\w+): .*#.*?\(([\w, ]*)\)(?:;.*| each|, None .*)?$", re.MULTILINE)


def promised(kind: type) -> dict[str, str]:
    """Shapes in the comments of a class, in jaxtyping's writing."""
    return {
        name: shape.replace(",", " ").strip()
        for name, shape in _FIELD.findall(inspect.getsource(kind))
    }


@pytest.fixture(scope="module")
def made():
    """One of each, traced but not computed, with what stands before its promised axes."""
    structure = build_structure(STUDY)

    def make(case):
        loop = prepare(structure, case).loop
        response = loop_response(structure, case, loop, case.path.waypoints[0])
        stations = station_places(case)
        basis = build_basis("loaded", case.machine.beam, case.machine.patches, 5, stations)
        result = simulate(structure, case, has_record=True)
        return basis, loop.plant, loop.controller, response, assembled_modes(response), result

    shapes = jax.eval_shape(make, as_arrays(build_case(STUDY)))
    basis, plant, controller, response, modes, result = jax.tree.map(
        lambda x: np.empty(x.shape, x.dtype), shapes
    )
    return {
        "basis": (basis, ""),
        "plant": (plant, ""),
        "controller": (controller, ""),
        "response": (response, ""),
        "modes": (modes, ""),
        "result": (result, ""),
        "record": (result.record, "steps "),
    }


@jaxtyped(typechecker=None)
def test_shapes_are_those_of_the_comments(made):
    """A letter means one number everywhere: R plant modes, C channels, K patches, S stations."""
    looked = 0
    for name, (one, before) in made.items():
        for field, shape in promised(type(one)).items():
            shape = shape.replace("n_patches", "K").replace("1 + R", "orders")
            for leaf in jax.tree.leaves(getattr(one, field)):
                assert isinstance(np.asarray(leaf), Shaped[np.ndarray, before + shape]), (
                    f"{name}.{field}: {np.shape(leaf)} is not ({before}{shape})"
                )
                looked += 1
    assert looked > 60


def test_metrics_have_their_dims(made):
    sizes = Sizes(7, 5, 2, made["result"][0].metrics.spectral_density.shape[-1], 3, 3)
    for name, value in made["result"][0].metrics.items():
        wanted = tuple(sizes.axes[axis] for axis in METRICS[name].dims)
        assert np.shape(value) == wanted, name
