"""Sweep methods: how the axes of a block become cases, and what can be analysed afterwards.

A `Method` says which fields of a block it reads, how axes combine or which points of the unit cube
they take, how a report describes it, and which analysis its points are made for. `METHODS` is the
only list of them; `METHODS.add` adds your own.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from threading import Lock
from typing import Any, Literal, NamedTuple

import numpy as np

from jaxmodel.table import Table
from studies.errors import field_error
from studies.space.indices import elementary_effects, sobol_indices

#: Most points of one Latin hypercube, all of which are made at once.
LARGEST_CUBE = 10**7
#: Points after which SciPy's Sobol sequence ends.
LONGEST_SEQUENCE = 2**30


class SamplingRequest(NamedTuple):
    """A request to a sampling method."""

    block: Any  # `studies.space.spec.Block`: count, size, levels
    dimensions: int  # of the unit cube
    seed: int
    path: str  # of the block, for messages
    # points wanted, from 0: first, and one beyond the last. Methods that are not streamed are asked
    # for all of them
    first: int
    stop: int


class Analysis(NamedTuple):
    """Results of a design as a table, by factor."""

    names: tuple[str, ...]  # of its columns, in documents
    heads: tuple[str, ...]  # of its columns, in tables
    # most important factor first: its name, numbers, and intervals as pairs of numbers
    values: tuple[tuple[Any, ...], ...]
    n_left_out: int  # by failed cases
    what: str  # is left out
    notes: tuple[str, ...] = ()
    form: str = ".4g"  # of numbers in tables

    @property
    def rows(self) -> tuple[tuple[str, ...], ...]:
        """The values as tables show them."""
        return tuple(tuple(self._shown(value) for value in row) for row in self.values)

    def _shown(self, value: Any) -> str:
        if isinstance(value, tuple):
            return " to ".join(map(self._shown, value))
        return format(value, self.form) if isinstance(value, float) else str(value)


class Method(NamedTuple):
    """One way to expand a block."""

    name: str
    text: str  # in reports; {} is the number of points or cases
    fields: tuple[str, ...] = ()  # of a block that it reads, in addition to axes and blocks
    # points of the unit cube (n, d); the first ones stay the same when more are requested. None:
    # the axes' own values, combined as follows
    points: Callable[[SamplingRequest], np.ndarray] | None = None
    is_streamed: bool = False  # gives some of its `count` points without the others
    combine: Literal["product", "side by side"] = "product"
    # of the design's points (n, d), a metric there (n,), NaN where the case failed, and the names
    # of the factors; a design made for it cannot be combined with others
    analysis: Callable[[np.ndarray, np.ndarray, list[str]], Analysis] | None = None


# --- points ---------------------------------------------------------------------------------------


def random_points(request: SamplingRequest) -> np.ndarray:
    """Independent and uniform."""
    generator = np.random.PCG64(request.seed)
    generator.advance(request.first * request.dimensions)  # a draw for each number
    shape = request.stop - request.first, request.dimensions
    return np.random.Generator(generator).random(shape)


def hypercube_points(request: SamplingRequest) -> np.ndarray:
    """One Latin hypercube of `size` points after the other."""
    size = request.block.size or request.block.count
    if size > LARGEST_CUBE:
        raise field_error(
            f"{request.path}.size", size, f"up to {LARGEST_CUBE} points in a Latin hypercube", "1"
        )
    begins = request.first // size
    parts = [
        _cube(size, request.dimensions, request.seed, k)
        for k in range(begins, -(-request.stop // size))
    ]
    return np.concatenate(parts)[request.first - begins * size : request.stop - begins * size]


@lru_cache(maxsize=1)
def _cube(size: int, dimensions: int, seed: int, k: int) -> np.ndarray:
    """A Latin hypercube, kept for those who want it in parts."""
    from scipy.stats import qmc

    engine = qmc.LatinHypercube(dimensions, rng=np.random.default_rng([seed, k]))
    return np.asarray(engine.random(size))


def sobol_points(request: SamplingRequest) -> np.ndarray:
    """Scrambled Sobol points."""
    if request.dimensions > 21201:
        raise field_error(
            f"{request.path}.axes", request.dimensions, "up to 21201 dimensions for Sobol points"
        )
    if request.block.count > LONGEST_SEQUENCE:
        raise field_error(
            f"{request.path}.count",
            request.block.count,
            f"up to {LONGEST_SEQUENCE} Sobol points",
            "1",
        )
    sequence = _sequence(request.dimensions, request.seed)
    with sequence.lock:
        return sequence.points(request.first, request.stop)


class _Sequence:
    """A Sobol sequence that goes on from where it stands: each step over a point takes time."""

    def __init__(self, dimensions: int, seed: int) -> None:
        from scipy.stats import qmc

        rng = np.random.default_rng(seed)
        self._engine = qmc.Sobol(dimensions, scramble=True, rng=rng)
        self.lock = Lock()

    def points(self, first: int, stop: int) -> np.ndarray:
        """Points from `first` to before `stop`."""
        if self._engine.num_generated > first:
            self._engine.reset()
        if first > self._engine.num_generated:
            self._engine.fast_forward(first - self._engine.num_generated)
        if first:
            return np.asarray(self._engine.random(stop - first))
        # SciPy warns of a beginning that is not balanced, which one of a power of two is
        exponent = int(np.ceil(np.log2(max(stop, 1))))
        return np.asarray(self._engine.random_base2(exponent)[:stop])


@lru_cache(maxsize=4)
def _sequence(dimensions: int, seed: int) -> _Sequence:
    return _Sequence(dimensions, seed)


def saltelli_points(points: np.ndarray) -> np.ndarray:
    """Design for Sobol indices from (n, 2 d) points: rows A, B, A with column i of B; (n (d+2), d).

    The d + 2 rows of each base point are consecutive. Saltelli et al. 2010.
    """
    n, d = len(points), points.shape[1] // 2
    a, b = points[:, :d], points[:, d:]
    mixed = np.repeat(a[:, None], d, axis=1)
    mixed[:, np.arange(d), np.arange(d)] = b
    return np.concatenate([a[:, None], b[:, None], mixed], axis=1).reshape(n * (d + 2), d)


def morris_points(count: int, dimensions: int, levels: int, seed: int) -> np.ndarray:
    """Trajectories for elementary effects, (count (d + 1), d); Morris 1991.

    Each starts at a random grid point and changes one coordinate after another, in random order,
    by +-levels/(2 (levels - 1)). The grid includes the ends of the cube.
    """
    step = (levels // 2) / (levels - 1)
    rows = []
    for k in range(count):
        rng = np.random.default_rng([seed, k])
        start = rng.integers(0, levels, dimensions) / (levels - 1)
        sign = np.where(start + step > 1 + 1e-12, -1.0, 1.0)
        is_free = (start + step <= 1 + 1e-12) & (start - step >= -1e-12)
        sign = np.where(is_free & (rng.random(dimensions) < 0.5), -1.0, sign)
        moved = np.zeros((dimensions + 1, dimensions))
        for position, axis in enumerate(rng.permutation(dimensions)):
            moved[position + 1 :, axis] = sign[axis] * step
        rows.append(start + moved)
    return np.concatenate(rows).clip(0.0, 1.0)


# --- analyses -------------------------------------------------------------------------------------


def _morris(points: np.ndarray, value: np.ndarray, names: list[str]) -> Analysis:
    effects = elementary_effects(points, value)
    rows = [
        (names[k], *(float(x[k]) for x in effects[:3]), int(effects.n_used[k]))
        for k in np.argsort(-effects.mean_size, kind="stable")
    ]
    return Analysis(
        names=("factor", "mean_size", "mean", "deviation", "n_used"),
        heads=("factor", "mean |effect|", "mean effect", "deviation", "effects used"),
        values=tuple(rows),
        n_left_out=effects.n_left_out,
        what="effects",
    )


def _sobol(points: np.ndarray, value: np.ndarray, names: list[str]) -> Analysis:
    indices = sobol_indices(value, len(names))
    rows = [
        (
            names[k],
            float(indices.first[k]),
            tuple(indices.first_interval[k].tolist()),
            float(indices.total[k]),
            tuple(indices.total_interval[k].tolist()),
        )
        for k in np.argsort(-indices.total)
    ]
    notes = ("a first index beyond the total one: not settled yet, take more base points",)
    is_unsettled = bool(np.any(indices.first > indices.total_interval[:, 1]))
    return Analysis(
        names=("factor", "first", "first_interval", "total", "total_interval"),
        heads=("factor", "first", "95 %", "total", "95 %"),
        values=tuple(rows),
        n_left_out=indices.n_left_out,
        what="base points",
        notes=notes if is_unsettled else (),
        form=".3f",
    )


#: All methods by name.
METHODS: Table[Method] = Table(
    "method",
    [
        Method("grid", "every combination of"),
        Method("zip", "side by side", combine="side by side"),
        Method("list", "{} cases, spelt out in the file", ("cases",)),
        Method("random", "{} random points of", ("count",), points=random_points, is_streamed=True),
        Method(
            "latin_hypercube",
            "{} points of Latin hypercubes of",
            ("count", "size"),
            points=hypercube_points,
            is_streamed=True,
        ),
        Method("sobol", "{} Sobol points of", ("count",), points=sobol_points, is_streamed=True),
        Method(
            "morris",
            "{} trajectories of a Morris design of",
            ("count", "levels"),
            lambda request: morris_points(
                request.block.count, request.dimensions, request.block.levels, request.seed
            ),
            analysis=_morris,
        ),
        Method(
            "saltelli",
            "{} base points of a Saltelli design of",
            ("count",),
            lambda request: saltelli_points(
                sobol_points(request._replace(dimensions=2 * request.dimensions))
            ),
            analysis=_sobol,
        ),
    ],
)
