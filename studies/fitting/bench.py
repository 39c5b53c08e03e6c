"""The linear machine at the poses of all measurements, with derivatives by the parameters.

Matrices and their derivatives come from one compiled program; frequencies and responses follow from
them by linear algebra, whose derivatives are written out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property, partial
from itertools import product
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.beam import BASES
from jaxmodel.case import Structure
from jaxmodel.kinematics import path_status
from jaxmodel.numbers import Numbers, case_of, with_used
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.response import BenchPlant, bench_plant, held_modes
from studies.engine.preflight import check_pose
from studies.engine.programs import kept_jit
from studies.errors import StudyError, field_error
from studies.space.free import Place, Placing
from studies.study.cases import as_arrays, build_structure
from studies.study.labels import describe
from studies.study.numbers import one_study
from studies.study.signals import Signal
from studies.study.spec import Study

Pose = tuple[float, ...]
#: Eigenvectors of worse condition are not used [1].
WORST_CONDITION = 1e10
#: Plants computed at once.
BATCH = 32
#: Frequencies whose derivatives are computed at once.
FREQUENCIES = 100
#: A row or column of a plant, (n,), and its derivatives, (n, p).
Row = tuple[np.ndarray, np.ndarray | None]


class Modes(NamedTuple):
    """Oscillating modes: poles in the upper half plane, ascending."""

    pole: np.ndarray  # [1/s], (m,), complex
    shape: np.ndarray  # right eigenvectors, (n, m)
    dual: np.ndarray  # left eigenvectors, dual @ shape = 1, (m, n)


class Eigen(NamedTuple):
    """A = V diag(poles) V^-1."""

    pole: np.ndarray  # [1/s], (n,), complex
    right: np.ndarray  # V, (n, n)
    left: np.ndarray | None  # V^-1; None where eigenvectors are nearly dependent

    @property
    def upper(self) -> np.ndarray:
        """Which poles oscillate, one of each pair, ascending."""
        upper = np.flatnonzero(self.pole.imag > 1e-9 * np.abs(self.pole).max())
        return upper[np.argsort(np.abs(self.pole[upper]))]


class PlantAt:
    """A plant at one pose, and its derivatives by the p parameters."""

    def __init__(self, value: BenchPlant, slope: BenchPlant | None) -> None:
        """Arguments: matrices as NumPy arrays; their derivatives, (..., p), None if not wanted."""
        self.value, self.slope = value, slope

    @cached_property
    def eigen(self) -> Eigen:
        """Poles and eigenvectors, shared by all that is measured at the pose."""
        pole, right = np.linalg.eig(self.value.state)
        is_sound = np.linalg.cond(right) <= WORST_CONDITION
        return Eigen(pole, right, np.linalg.inv(right) if is_sound else None)

    @cached_property
    def modes(self) -> Modes:
        """Its oscillating modes.

        Raises:
            numpy.linalg.LinAlgError: eigenvectors that are nearly dependent.
        """
        pole, right, left = self.eigen
        if left is None:
            raise np.linalg.LinAlgError("nearly dependent eigenvectors")
        upper = self.eigen.upper
        return Modes(pole[upper], right[:, upper], left[upper])

    def output(self, signal: Signal, rows: int) -> Row:
        """Row of C, (n,), and its derivatives, (n, p); of a motor that of its slider's position."""
        if signal.kind == "accelerometer":
            turn = np.deg2rad(signal.angle)
            return _sum_of(
                (np.cos(turn), self._at("along", rows)), (np.sin(turn), self._at("across", rows))
            )
        return self._at({"platform": "pose", "motor": "slider"}.get(signal.kind, signal.kind), rows)

    def input(self, signal: Signal, column: int) -> Row:
        """Columns of B_0 and B_2, (2, n), and derivatives; a command is a force on its slider."""
        return self._at(_input_of(signal), (slice(None), slice(None), column))

    def direct(self, source: Signal, output: Signal, column: int, row: int) -> Row:
        """Entry of D, (), and its derivatives, (p,)."""
        factor = np.sin(np.deg2rad(output.angle)) if output.kind == "accelerometer" else 1.0
        if output.kind in ("accelerometer", "deflection"):
            row += len(self.value.sensor)
        elif output.kind != "sensor":
            return np.zeros(()), None if self.slope is None else np.zeros(())
        return _sum_of((factor, self._at(f"from_{_input_of(source)}", (row, column))))

    def _at(self, name: str, index: Any) -> Row:
        value = getattr(self.value, name)[index]
        return value, None if self.slope is None else getattr(self.slope, name)[index]


def _input_of(signal: Signal) -> str:
    return signal.kind if signal.kind in ("actuator", "hammer") else "slider_force"


def _sum_of(*parts: tuple[float, Row]) -> Row:
    """Sum of rows, each times a number."""
    value = sum(factor * row[0] for factor, row in parts)
    slopes = [factor * row[1] for factor, row in parts if row[1] is not None]
    return np.asarray(value), np.sum(slopes, axis=0) if slopes else None


def with_outputs_at(study: Study, place: Place, places: tuple[float, ...]) -> tuple[Study, Place]:
    """A study whose stations are measured places [m], on links of any length.

    Args:
        study: the model.
        place: puts parameters among the numbers.
        places: from the actuated joint on, the same on all links, within the shortest one [m].
    """
    longest = float(study.each_link(study.link.length).max())
    study = study.change(metrics__stations=tuple(x / longest for x in places))  # as many
    return study, Placing(_place_with_outputs, (place, places))


def _place_with_outputs(
    place: Place, places: tuple[float, ...], numbers: Numbers, values: Array
) -> Numbers:
    numbers = place(numbers, values)
    length = jnp.asarray(numbers["link.length"])
    return numbers | {"metrics.stations": jnp.asarray(places, length.dtype) / length[:, None]}


class Bench:
    """Plants at all poses that measurements need, kept for the last parameters."""

    def __init__(
        self,
        study: Study,
        place: Place,
        poses: Sequence[Pose],
        places: Sequence[float],
        moving: Sequence[str] = (),
    ):
        """
        Args:
            study: the model.
            place: puts parameters among the numbers.
            poses: where measurements were taken.
            places: positions along the links of hammers and displacement sensors [m].
            moving: fields of the parameters, which may be 0 in the study.

        Raises:
            StudyError: hammers with a basis whose ends are off the chord.
        """
        if study.drive.locked:
            raise field_error("drive.locked", True, "false where modes or responses are fitted")
        if not np.all(np.asarray(study.drive.kp) > 0):
            raise field_error(
                "drive.kp", study.drive.kp, "more than 0: the drive holds the machine", "N/m"
            )
        if places and not BASES[study.link.basis].is_on_chord:
            raise field_error("link.basis", study.link.basis, "a basis with both ends on the chord")
        self.stations = tuple(sorted(set(places))) or (
            float(study.each_link(study.link.length).min()) / 2,
        )
        study = study.change(control__feedback="none", shaper__kind="none")
        self.study, self.place = with_outputs_at(study, place, self.stations)
        self.structure = with_used(build_structure(self.study), moving)
        self.numbers = as_arrays(one_study(self.study, self.structure))
        self.n_patches = self.structure.n_patches
        self.poses = tuple(dict.fromkeys(poses))
        self._kept: dict[tuple[Pose, bool], tuple[bytes, PlantAt]] = {}

    def places(self, signals: tuple[Signal, Signal]) -> tuple[int, int]:
        """Of an input and an output among signals of their kinds."""
        source, output = (signal.row(self.n_patches, self.stations) for signal in signals)
        return source, output

    def check(self, pose: Pose, path: str) -> None:
        """Refuse a pose; path: where it is written, for messages.

        Raises:
            StudyError: out of reach or singular.
        """
        code = _reach(self.structure, self.numbers, np.array(pose))
        check_pose(self.study, path, pose, int(code))

    def plant(self, pose: Pose, values: np.ndarray, has_slopes: bool) -> PlantAt:
        """The plant at a pose for some values of the parameters, (p,).

        Raises:
            StudyError: the machine with these numbers does not reach it.
        """
        key = values.tobytes()
        for slopes in (True, False)[: 1 if has_slopes else 2]:
            kept_key, plant = self._kept.get((pose, slopes), (b"", None))
            if kept_key == key and plant is not None:
                return plant
        arguments = self.structure, self.place, self.numbers, np.array(pose), values
        slope, value = _plant_slopes(*arguments) if has_slopes else (None, _plant(*arguments))
        (value, code), slope = jax.tree.map(np.asarray, (value, slope))
        _check_reached(code, pose)
        plant = PlantAt(value, slope)
        self._kept[pose, has_slopes] = key, plant
        return plant

    def many(self, values: np.ndarray) -> list[dict[Pose, PlantAt]]:
        """Plants at `poses` for many values of the parameters, (n, p), without derivatives.

        Poses out of reach are left out.
        """
        plants: list[dict[Pose, PlantAt]] = [{} for _ in values]
        for pose, first in product(self.poses, range(0, len(values), BATCH)):
            part = np.arange(first, first + BATCH).clip(max=len(values) - 1)  # of one program
            arguments = self.structure, self.place, self.numbers, np.array(pose), values[part]
            whole, codes = jax.tree.map(np.asarray, _plant_batch(*arguments))
            for i in np.flatnonzero(codes == status.OK):  # the others are refused when needed
                plants[part[i]][pose] = PlantAt(jax.tree.map(lambda x, i=i: x[i], whole), None)
        return plants

    def keep(self, values: np.ndarray, plants: dict[Pose, PlantAt]) -> None:
        """Use these plants for some values of the parameters."""
        for pose, plant in plants.items():
            self._kept[pose, False] = values.tobytes(), plant

    def held(self, values: np.ndarray, has_slopes: bool) -> list[np.ndarray]:
        """Frequencies [Hz] and damping ratios of the links alone, (3, R), and their slopes."""
        arguments = self.structure, self.place, self.numbers, values
        slope, value = _held_slopes(*arguments) if has_slopes else ((), _held(*arguments))
        return [np.asarray(x) for x in (*value, *slope)]


def _check_reached(code: np.ndarray, pose: Pose) -> None:
    """Refuse a plant at a pose that the machine with these numbers does not reach.

    Raises:
        StudyError: naming the pose.
    """
    if int(code) != status.OK:
        at = ", ".join(f"{x:.6g}" for x in pose)
        raise StudyError(f"{describe(int(code))} at ({at}) m, m, rad with the values tried")


def with_slopes(
    function: Callable[..., Any], argument: int, is_first: bool = False
) -> Callable[..., Any]:
    """A function of the same arguments that returns derivatives by one of them, and the value.

    Args:
        function: of JAX arrays.
        argument: by which one.
        is_first: derivatives of the first part of its value only.
    """

    def both(*arguments: Any) -> tuple[Any, Any]:
        value = function(*arguments)
        return value[0] if is_first else value, value

    return jax.jacfwd(both, argnums=argument, has_aux=True)


@kept_jit(static_argnums=0)
def _reach(structure: Structure, numbers: Numbers, pose: Array) -> Array:
    plant = prepare(structure, case_of(structure, numbers)).loop.plant
    return path_status(plant, pose[None])[0]


@kept_jit(static_argnums=(0, 1))
def _plant(
    structure: Structure, place: Place, numbers: Numbers, pose: Array, values: Array
) -> tuple[BenchPlant, Array]:
    """The plant, and whether the pose is reached: kinematics are finite everywhere."""
    placed = case_of(structure, place(numbers, values))
    plant = prepare(structure, placed).loop.plant
    return bench_plant(structure, placed, pose), path_status(plant, pose[None])[0]


@kept_jit(static_argnums=(0, 1))
def _held(
    structure: Structure, place: Place, numbers: Numbers, values: Array
) -> tuple[Array, Array]:
    return held_modes(structure, case_of(structure, place(numbers, values)))


@kept_jit(static_argnums=(0, 1))
def _plant_slopes(structure: Structure, place: Place, *others: Any) -> Any:
    """Derivatives of `_plant` by the values, and what it returns."""
    return with_slopes(_plant, 4, is_first=True)(structure, place, *others)


@kept_jit(static_argnums=(0, 1))
def _held_slopes(structure: Structure, place: Place, *others: Any) -> Any:
    """Derivatives of `_held` by the values, and what it returns."""
    return with_slopes(_held, 3)(structure, place, *others)


@kept_jit(static_argnums=(0, 1))
def _plant_batch(
    structure: Structure, place: Place, numbers: Numbers, pose: Array, values: Array
) -> tuple[BenchPlant, Array]:
    return jax.vmap(partial(_plant, structure, place, numbers, pose))(values)


class FrequencyResponse(NamedTuple):
    """A frequency response and its derivatives."""

    value: np.ndarray  # (f,), complex
    slope: np.ndarray | None  # (f, p)


def response(
    plant: PlantAt, signals: tuple[Signal, Signal], at: tuple[int, int], omega: np.ndarray
) -> FrequencyResponse:
    """Frequency response of one input and one output.

    A command r acts on its slider by the drive, F = (Kp + j omega Kd) (r - rho), and this is what
    the motor's output is.

    Args:
        plant: at the pose.
        signals: input and output.
        at: their places among signals of their kinds.
        omega: [rad/s], (f,).
    """
    found = _of_plant(plant, signals, at, omega)
    source, output = signals
    if output.kind == "motor":
        found = _times(found, _drive(plant, output.link, omega), -1.0)
    if source.kind == "command":
        found = _times(found, _drive(plant, source.link, omega), 1.0)
        if output.kind == "motor" and output.link == source.link:
            own = _drive(plant, source.link, omega)
            slope = None if found.slope is None or own.slope is None else found.slope + own.slope
            found = FrequencyResponse(found.value + own.value, slope)
    return found


def _drive(plant: PlantAt, link: int, omega: np.ndarray) -> FrequencyResponse:
    """Kp + j omega Kd of a slider's drive."""
    turn = np.stack([np.ones_like(omega), 1j * omega], axis=1)  # (f, 2)
    slope = None if plant.slope is None else turn @ plant.slope.drive[:, link]
    return FrequencyResponse(turn @ plant.value.drive[:, link], slope)


def _times(one: FrequencyResponse, other: FrequencyResponse, sign: float) -> FrequencyResponse:
    """The product of two, times a sign."""
    slope = None
    if one.slope is not None and other.slope is not None:
        slope = sign * (one.slope * other.value[:, None] + other.slope * one.value[:, None])
    return FrequencyResponse(sign * one.value * other.value, slope)


def _of_plant(
    plant: PlantAt, signals: tuple[Signal, Signal], at: tuple[int, int], omega: np.ndarray
) -> FrequencyResponse:
    """C (j omega - A)^-1 B + D of one input and one output, B = B_0 - omega^2 B_2.

    Its differential is dC X + Y dA X + Y dB + dD with X = (j omega - A)^-1 B and
    Y = C (j omega - A)^-1.

    Args:
        plant: at the pose.
        signals: input and output.
        at: their places among signals of their kinds.
        omega: [rad/s], (f,).
    """
    (source, by_source), output = plant.input(signals[0], at[0]), plant.output(signals[1], at[1])
    powers = np.stack([np.ones_like(omega), -(omega**2)], axis=1)
    direct = plant.direct(*signals, *at)
    pole, right, left = plant.eigen
    if left is None:  # without eigenvectors
        whole = 1j * omega[:, None, None] * np.eye(len(pole)) - plant.value.state
        x = _solve(whole, powers @ source)
        y = _solve(np.swapaxes(whole, 1, 2), output[0][None])
    else:
        resolvent = 1 / (1j * omega[:, None] - pole)
        x = (resolvent * (powers @ source @ left.T)) @ right.T
        y = (resolvent * (output[0] @ right)) @ left
    gain = x @ output[0] + direct[0]
    if plant.slope is None or by_source is None or output[1] is None or direct[1] is None:
        return FrequencyResponse(gain, None)
    slope = _both_sides(y, plant.slope.state, x) + x @ output[1] + direct[1]
    slope += np.einsum("fk,fn,knp->fp", powers, y, by_source, optimize=True)
    return FrequencyResponse(gain, slope)


def _both_sides(left: np.ndarray, change: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Y dA X at each frequency, (f, p), of (f, n), (n, n, p) and (f, n).

    Only rows of dA that change count, and a few frequencies at a time stay in the cache.
    """
    rows = np.any(change, axis=(1, 2))
    moving = change[rows].astype(complex)
    m, n, p = moving.shape
    moving, left = moving.reshape(m, n * p), left[:, rows]
    whole = np.empty((len(left), p), complex)
    for first in range(0, len(left), FREQUENCIES):
        few = slice(first, first + FREQUENCIES)
        turned = (left[few] @ moving).reshape(-1, n, p)
        whole[few] = (right[few, None] @ turned)[:, 0]
    return whole


def _solve(matrices: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solutions for right-hand sides, (f, n) or (1, n)."""
    many = np.broadcast_to(right[..., None], (*matrices.shape[:2], 1))
    return np.linalg.solve(matrices, many)[..., 0]
