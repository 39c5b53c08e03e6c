"""A sweep's results as an xarray dataset; importing xarray takes a second, so commands do not."""

from __future__ import annotations

from dataclasses import replace
from math import prod
from typing import TYPE_CHECKING

import numpy as np

from studies.engine.columns import PER_CASE
from studies.engine.results import SweepData, swept_names
from studies.results.labelled import Variable
from studies.space.spec import BlockNode
from studies.space.table import all_columns
from studies.store import axis_sizes, variable_labels, with_coordinates

if TYPE_CHECKING:
    import xarray

#: Dimensions of axes whose values are lists.
_DIMENSIONS = {"patches.centers": "placement", "shaper.frequencies_hz": "shaper_frequency"}


def as_dataset(data: SweepData) -> xarray.Dataset:
    """Results of a sweep, finished or not, under the names of the sweep file.

    The dimensions of a full grid are its axes, as in `load("gains").data.sel({"gain": 2.0})`.
    Of zipped, listed or sampled axes, and of a grid that `where` has thinned out, there is one
    dimension `case` with the axes as coordinates along it. Links and modes count from 1.

    Args:
        data: of the sweep.

    Returns:
        Metrics, `status` as a code and `status_text` in words, with units and long names as
        attributes. Cases that have not run have status -1 and NaN.
    """
    import xarray

    data = _whole_grid(data)
    variables = data.variables | {"status_text": _words(data.variables["status"])}
    coordinates = {"case", "case_id", "seed", "repeat", *data.table.columns, *axis_sizes(variables)}
    axes = _grid_axes(data)
    if axes:
        shape = tuple(int(code.max()) + 1 for code in axes.values())
        order = np.argsort(np.ravel_multi_index(tuple(axes.values()), shape))
        for name, variable in variables.items():
            if variable.dims[:1] == ("case",):
                rows = variable.data[order]
                grid = rows.reshape(*shape, *rows.shape[1:])
                variables[name] = variable._replace(data=grid, dims=(*axes, *variable.dims[1:]))
                if name in coordinates:
                    variables[name] = _along_own_axes(name, variables[name], len(shape))
        variables = with_coordinates(variables)
    labels = {name: value for name, value in data.attributes.items() if name != "coordinates"}
    labels |= {"notes": " ".join(data.notes)} if data.notes else {}
    arrays = {name: (v.dims, v.data, variable_labels(v)) for name, v in variables.items()}
    dataset = xarray.Dataset(arrays, attrs=labels)
    return dataset.set_coords(sorted(coordinates & arrays.keys()))


def _whole_grid(data: SweepData) -> SweepData:
    """With the cases of a grid that repeat others, which were run once."""
    spec, table = data.spec, data.table
    if not (table.n_double and _is_grid(spec.root)) or table.n_dropped:
        return data
    columns = {x: np.repeat(y, spec.sweep.repeats, 0) for x, y in all_columns(spec).items()}
    variables = {
        name: v._replace(data=v.data[table.origin]) if v.dims[:1] == ("case",) else v
        for name, v in data.variables.items()
    }
    for name, column in columns.items():
        if name in variables and column.dtype != object:
            variables[name] = variables[name]._replace(data=column)
    return replace(data, variables=variables, cases=table)


def _words(code: Variable) -> Variable:
    """How the cases ended, in words."""
    codes, which = np.unique(code.data, return_inverse=True)
    words = PER_CASE["status"][-1]
    texts = np.array([words.get(number, f"status {number}") for number in codes.tolist()])
    return Variable(texts[which], code.dims, code.units, code.long_name)


def _grid_axes(data: SweepData) -> dict[str, np.ndarray]:
    """Dimensions of a full grid, and the position of each case along them; {} for anything else."""
    if not _is_grid(data.spec.root):
        return {}
    axes = {}
    for name in swept_names(data):
        column = data[name]
        dimension = _DIMENSIONS.get(name, name)
        if column.ndim > 1 and dimension == name:
            return {}
        _, first, which = np.unique(column, return_index=True, return_inverse=True, axis=0)
        axes[dimension] = np.argsort(np.argsort(first))[which]
    if data["repeat"].any():
        axes["repeat"] = data["repeat"]
    shape = [int(code.max()) + 1 for code in axes.values()]
    places = set(zip(*(code.tolist() for code in axes.values()), strict=True))
    return axes if data.n_cases == len(places) == prod(shape) else {}


def _is_grid(node: BlockNode) -> bool:
    return node.block.method == "grid" and all(map(_is_grid, node.children))


def _along_own_axes(name: str, variable: Variable, count: int) -> Variable:
    """A coordinate without those of the first `count` dimensions that it does not depend on."""
    data, dims = variable.data, list(variable.dims)
    for dimension in variable.dims[:count]:
        axis = dims.index(dimension)
        first = np.take(data, [0], axis)
        is_same = (data == first) | ((data != data) & (first != first))  # NaN equals NaN here
        if dimension != name and np.all(is_same):
            data = first.squeeze(axis)
            dims.remove(dimension)
    return variable._replace(data=data, dims=tuple(dims))
