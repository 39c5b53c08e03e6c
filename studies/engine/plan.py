"""How a table of cases is run: grouped by program, split into chunks of equal size."""

from __future__ import annotations

import os
import resource
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import Case, Structure
from jaxmodel.numbers import OF_STRUCTURE, in_working_precision
from jaxmodel.prepare import COUPLED_STEP_LIMIT, STIFFNESS_LIMIT, coupled_rate, drive_rate
from studies.config import processor
from studies.engine.preflight import SUBSTEP_LIMIT, mechanics_at, step_counts
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.kernels.cpu import LANE_BYTES
from studies.kernels.gpu import BLOCK
from studies.space.table import CaseTable, loose_study
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from studies.threads import serial_blas

#: Fields that change the program; each combination of their values is compiled separately.
STATIC = (
    "run.model",
    "link.basis",
    "link.shortening",
    "link.stretch",
    "link.axial_inertia",
    "link.static_correction",
    "control.basis",
    "control.feedback",
    "control.law",
    "drive.kind",
    "machine.kind",
    "run.substeps",
    "run.smooth",
    "run.duration",
    "electronics.sample_rate_hz",
)
#: More programs than this are rejected.
PROGRAM_LIMIT = 64
#: From so many cases on, programs that prepare them are worth compiling longer.
MANY = 8192
#: Cases side by side on one device: enough to fill vectors, few enough to fit into its cache.
LANES = 64
#: On a GPU: enough for all its threads.
GPU_LANES = 2**15
#: Samples times cases per chunk: a few seconds of work on two cores.
CHUNK_WORK = 2**22
#: Most cases in a chunk.
LARGEST_CHUNK = 8192
#: Cases whose poles are computed together.
POLE_BATCH = 256


class Layout(NamedTuple):
    """Shape of a chunk: devices x blocks x lanes."""

    devices: int
    blocks: int  # run one after the other on a device
    lanes: int  # run side by side

    @property
    def size(self) -> int:
        """Cases in a chunk."""
        return self.devices * self.blocks * self.lanes

    def filled(self, count: int) -> np.ndarray:
        """Which of `count` cases each place holds: all, then the last one again, (size,)."""
        return np.minimum(np.arange(self.size), count - 1)


class Chunk(NamedTuple):
    """Cases that are run together."""

    rows: np.ndarray  # of the table, (k,)
    is_too_stiff: np.ndarray  # as in `Group`, (k,)


class Group(NamedTuple):
    """Cases that share a program."""

    structure: Structure
    rows: np.ndarray  # of the table, (m,)
    is_too_stiff: np.ndarray  # drive or ideal feedback too stiff for any allowed step, (m,)
    layout: Layout
    is_judged: bool = True  # gain margins and damping of every loop
    robustness: tuple[str, ...] = ()  # further figures of every loop

    def chunks(self) -> list[Chunk]:
        """All of them, chunk by chunk."""
        size = self.layout.size
        return [
            Chunk(self.rows[k : k + size], self.is_too_stiff[k : k + size])
            for k in range(0, len(self.rows), size)
        ]


def plan_groups(
    table: CaseTable,
    rows: np.ndarray,
    lay_out: Callable[[int, Structure], Layout],
    metrics: tuple[str, ...] = (),
    is_linear: bool = False,
    is_judged: bool = True,
    robustness: tuple[str, ...] = (),
) -> list[Group]:
    """Group cases by program and lay out their chunks.

    Args:
        table: all cases.
        rows: those to run.
        lay_out: shape of the chunks for this many cases of a structure.
        metrics: those to keep; () for all.
        is_linear: run the linear model.
        is_judged: judge the loops.
        robustness: figures of `jaxmodel.robustness` to judge them by as well.

    Raises:
        StudyError: too many programs.
    """
    keys = np.zeros(len(table), int)
    for name in STATIC:
        if name in table.columns:
            _, position = np.unique(table.columns[name], return_inverse=True)
            keys = keys * (position.max() + 1) + position
    # sizes come from the whole table, so that an extended or resumed sweep runs the same program
    distinct = np.unique(keys)
    if len(distinct) > PROGRAM_LIMIT:
        swept = ", ".join(name for name in STATIC if name in table.columns)
        raise StudyError(
            f"sweep: {len(distinct)} combinations of {swept}, each of which needs a compilation; "
            f"allowed: up to {PROGRAM_LIMIT}"
        )
    groups = []
    for key in distinct:
        members = np.flatnonzero(keys == key)
        structure = _structure(table, members)._replace(
            metrics=_accumulated(table, metrics), is_linear=is_linear
        )
        requested = rows[np.isin(rows, members)]
        if len(requested) == 0:
            continue
        counts, is_too_stiff = _plant_steps(table, structure, members)
        place = np.searchsorted(members, requested)
        for count in np.unique(counts[place]):
            chosen = counts[place] == count
            stepped = structure._replace(substeps=int(count))
            layout = lay_out(int(chosen.sum()), stepped)
            group = Group(
                structure=stepped,
                rows=requested[chosen],
                is_too_stiff=is_too_stiff[place][chosen],
                layout=layout,
                is_judged=is_judged,
                robustness=robustness,
            )
            groups.append(group)
    return groups


def _accumulated(table: CaseTable, kept: tuple[str, ...]) -> tuple[str, ...]:
    """Metrics that runs must accumulate for the ones kept; () for all."""
    if not kept:
        return ()
    has_own = (table.values("control.ratio_source") == "own_run").any()
    return tuple(sorted({*kept} | ({"energy_ratio"} if has_own else set())))


def _structure(table: CaseTable, members: np.ndarray) -> Structure:
    """Sizes of the largest case, choices of all of them."""
    columns = {x: column[members] for x, column in table.fields.items() if x in OF_STRUCTURE}
    shared = loose_study(table, int(members[0]), (*STATIC, "patches.centers"))
    return build_structure(shared, columns)


def chunk_cases(table: CaseTable, rows: np.ndarray, structure: Structure, size: int) -> Case:
    """Arrays of a chunk, filled up to `size` with its last case; leading axis `size` or 1.

    Args:
        table: all cases.
        rows: cases of the chunk, at most `size`.
        structure: of their group.
        size: cases per call of the program.

    Returns:
        Case of NumPy arrays in the working precision.
    """
    filled = np.concatenate([rows, np.full(size - len(rows), rows[-1])])
    columns = {name: column[filled] for name, column in table.fields.items()}
    # ids, and seeds from them, take as long as all else here
    columns["run.seed"] = table.seed[filled] if structure.has_noise else np.zeros(size, np.int64)
    return in_working_precision(build_cases(table.study, columns, structure))


@kept_jit(static_argnums=0)
def _mechanics(structure: Structure, cases: Case) -> Any:
    """State matrices at every way-point of every case, (n, poses, s, s)."""

    def one(case: Case) -> Any:
        return jax.vmap(lambda pose: mechanics_at(structure, case, pose))(case.path.waypoints)

    return jax.vmap(one)(cases)


def _plant_steps(
    table: CaseTable, structure: Structure, members: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Plant steps per sample of each case, and which cases are too stiff for any allowed number."""
    rate = _of_cases(table, structure, members, _DRIVE, partial(_drive_rate, structure.drive))
    if structure.feedback == "ideal":
        rate = np.maximum(rate, _pole_decay(table, structure, members))
    period = 1 / table.values("electronics.sample_rate_hz")[members]
    needed = np.maximum(np.ceil(rate * period / STIFFNESS_LIMIT), 1)
    written = int(table.values("run.substeps")[members[0]])
    is_too_stiff = needed > (written or SUBSTEP_LIMIT)
    is_explicit = structure.has_stretch or structure.has_joint_friction
    if is_explicit or not BASES[structure.basis].is_on_chord:
        coupled = _of_cases(table, structure, members, _COUPLED, partial(_coupled_rate, structure))
        needed = np.maximum(needed, np.ceil(coupled * period / COUPLED_STEP_LIMIT))
    counts = np.full(len(members), written) if written else step_counts(needed)
    return np.where(is_too_stiff, written or 1, counts), is_too_stiff


#: Columns that `drive_rate` depends on.
_DRIVE = ("drive.", "machine.")


#: Columns that `coupled_rate` depends on.
_COUPLED = ("link.", "patches.", "machine.", "load.", "motion.", "drive.locked")


_drive_rate = kept_jit(static_argnums=0)(drive_rate)
_coupled_rate = kept_jit(static_argnums=0)(coupled_rate)


def _of_cases(
    table: CaseTable,
    structure: Structure,
    members: np.ndarray,
    names: tuple[str, ...],
    rate: Callable[[Case], Any],
) -> np.ndarray:
    """A rate of each case [1/s], (m,), that depends on columns with these beginnings alone."""
    columns = {n: c[members] for n, c in table.fields.items() if n.startswith(names)}
    case = build_cases(table.study, columns, structure)
    is_many = [len(leaf) > 1 for leaf in jax.tree.leaves(case)]
    if not any(is_many):
        return np.full(len(members), float(rate(jax.tree.map(lambda x: x[0], case))))
    axes = jax.tree.map(lambda x: 0 if len(x) > 1 else None, case)
    shared = jax.tree.map(lambda x: x if len(x) > 1 else x[0], case)
    return np.asarray(jax.vmap(rate, (axes,))(shared))


def _pole_decay(table: CaseTable, structure: Structure, members: np.ndarray) -> np.ndarray:
    """Fastest decay |Re lambda| of each case at its way-points [1/s], (m,)."""
    fastest = np.zeros(len(members))
    for start in range(0, len(members), POLE_BATCH):
        rows = members[start : start + POLE_BATCH]
        cases = chunk_cases(table, rows, structure, POLE_BATCH)
        whole = jax.tree.map(lambda x: np.repeat(x, POLE_BATCH // len(x), axis=0), cases)
        small = structure._replace(n_steps=1, substeps=1)
        matrices = np.asarray(_mechanics(small, whole))[: len(rows)]
        is_finite = np.isfinite(matrices).all(axis=(1, 2, 3))
        safe = np.where(is_finite[:, None, None, None], matrices, 0.0)
        fastest[start : start + len(rows)] = np.abs(np.linalg.eigvals(safe).real).max(axis=(1, 2))
    return fastest


def local_layout(n: int, structure: Structure, most: int = 0) -> Layout:
    """Chunk shape that suits this process.

    Args:
        n: number of cases.
        structure: of the cases.
        most: cases side by side on a device; 0: as many as suit a sweep.
    """
    devices = len(jax.local_devices())
    # a case's command takes most memory: references at every point of every step
    points = structure.n_steps * (2 * structure.plant_steps + 1)
    lane_bytes = points * structure.n_pose * 8 * 8 + 2**16
    lanes, unit = most or most_lanes(), lane_unit()
    while lanes > unit and devices * lanes * lane_bytes > memory_budget():
        lanes //= 2
    per_device = -(-n // devices)
    lanes = min(lanes, -(-per_device // unit) * unit)
    work = structure.n_steps * structure.plant_steps
    preferred = min(max(CHUNK_WORK // work, 1), LARGEST_CHUNK)
    blocks = max(min(preferred, n) // (devices * lanes), 1)
    return Layout(devices, blocks, lanes)


def even_layout(n: int) -> Layout:
    """A chunk of n cases or slightly more, split evenly among all devices.

    Args:
        n: number of cases.
    """
    devices, unit = len(jax.local_devices()), lane_unit()
    lanes = min(most_lanes(), -(-n // (unit * devices)) * unit)
    return Layout(devices, -(-n // (devices * lanes)), lanes)


def most_lanes() -> int:
    """Cases side by side on a device."""
    return LANES if processor() == "cpu" else GPU_LANES


def lane_unit() -> int:
    """Lanes come in multiples of this: one vector of the processor, one block of threads."""
    if processor() != "cpu":
        return BLOCK
    return int(LANE_BYTES // jax.dtypes.canonicalize_dtype(np.float64).itemsize)


def padded_rows(count: int, unit: int) -> np.ndarray:
    """Numbers of `count` rows, the last one repeated until `unit` divides how many there are."""
    return np.minimum(np.arange(-(-count // unit) * unit), count - 1)


def in_parts(
    evaluate: Callable[[np.ndarray], Any], count: int, size: int, cores: int | None
) -> Any:
    """Arrays of rows from those of parts of equal size, which cores take in turn.

    Args:
        evaluate: makes a tree of arrays (size, ...) of rows (size,).
        count: of rows; the last one fills the last part up.
        size: of a part.
        cores: how many take parts.
    """
    rows = padded_rows(count, size)
    split = np.split(rows, len(rows) // size)
    with serial_blas(), ThreadPoolExecutor(cores) as pool:  # each thread waits for its part
        parts = list(pool.map(lambda x: jax.tree.map(np.asarray, evaluate(x)), split))
    return jax.tree.map(lambda *x: np.concatenate(x)[:count], *parts)


def memory_budget() -> int:
    """Memory available for the arrays of a chunk: a quarter of the device's [bytes]."""
    if processor() != "cpu":
        devices = jax.local_devices()
        return len(devices) * (devices[0].memory_stats() or {}).get("bytes_limit", 2**32) // 4
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 4


def peak_memory() -> int:
    """Peak memory of this process [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
