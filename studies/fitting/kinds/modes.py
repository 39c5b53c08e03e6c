"""Natural frequencies and damping ratios, of the machine at a pose or of a link between held ends.

Measured shapes pair the modes: by the part of a measured shape that lies in the span of the
model's modes near one frequency (subspace MAC), so that three nearly equal modes may mix.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
import scipy
from pydantic import Field

from studies.errors import StudyError, field_error
from studies.fitting.bench import Bench, Modes, PlantAt, Pose
from studies.fitting.decays import Diagram
from studies.fitting.kinds.contract import DataEntry, Measurement, Models, Numbers
from studies.fitting.kinds.entry import PoseEntry, Positive, each
from studies.study.signals import Signal, signal_name
from studies.study.spec import described

#: Modes closer than this share one subspace [1].
NEAR = 0.03
#: Measured shapes less alike than this to any of the model's are refused (subspace MAC) [1].
ALIKE = 0.5
#: Modes closer than this are one: their shapes are any of a subspace [1].
EQUAL = 1e-6
#: Shapes whose largest voltage is below this have no direction [V].
SMALLEST = 1e-100
TWO_PI = 2 * np.pi


class ModesEntry(PoseEntry):
    """Natural frequencies and damping ratios."""

    frequency_hz: tuple[Positive, ...] = described(..., "Hz", "measured", min_length=1)
    sigma_hz: Positive | tuple[Positive, ...] = described(
        ..., "Hz", "standard deviation, of all or of each"
    )
    damping_ratio: tuple[Annotated[float, Field(ge=0, lt=1)], ...] = described(
        (), "1", "measured; 0: not known"
    )
    damping_sigma: Positive | tuple[Positive, ...] | None = described(
        None, "1", "standard deviation, of all or of each"
    )
    shapes: tuple[tuple[float, ...], ...] = described(
        (), "-", "of each mode, the voltages of all sensors in any scale; they pair the modes"
    )
    ends: Literal["machine", "held"] = described(
        "machine", "-", "the machine at the pose, or one link between held joints"
    )
    link: int = described(1, "1", "with ends = 'held'", ge=1, le=3)

    def measurement(self, models: Models, path: str) -> Measurement:
        bench, count = models.bench, len(self.frequency_hz)
        for name, ends in (("link", "machine"), ("pose", "held")):
            if name in self.model_fields_set and self.ends == ends:
                raise StudyError(f"{path}.{name}: has no meaning with ends = {ends!r}")
        if "damping_sigma" in self.model_fields_set and not self.damping_ratio:
            raise StudyError(f"{path}.damping_sigma: has no meaning without damping_ratio")
        # without shapes, modes are known by their order
        if not self.shapes and list(self.frequency_hz) != sorted(self.frequency_hz):
            allowed = "ascending frequencies where no shapes are given"
            raise field_error(f"{path}.frequency_hz", self.frequency_hz, allowed, "Hz")
        damping = sigma = None
        if self.damping_ratio:
            damping = each(self.damping_ratio, count, f"{path}.damping_ratio")
            damping[damping == 0] = np.nan
            if self.damping_sigma is None:
                raise StudyError(f"{path}.damping_sigma: missing beside damping_ratio")
            sigma = each(self.damping_sigma, count, f"{path}.damping_sigma")
        measured = Measured(
            frequency=np.array(self.frequency_hz),
            sigma=each(self.sigma_hz, count, f"{path}.sigma_hz"),
            damping=damping,
            damping_sigma=sigma,
            shapes=self._shapes(bench, path) if self.shapes else None,
        )
        if self.ends == "machine":
            return MachineModes(self, bench, measured, self.at(models.study))
        if count > bench.structure.n_modes:
            allowed = f"at most link.modes = {bench.structure.n_modes} frequencies"
            raise field_error(f"{path}.frequency_hz", self.frequency_hz, allowed)
        return HeldModes(self, bench, measured, self.link - 1)

    def _shapes(self, bench: Bench, path: str) -> np.ndarray:
        count, size = len(self.frequency_hz), bench.study.n_links * bench.n_patches
        if self.ends == "held":
            raise StudyError(f"{path}.shapes: allowed with ends = 'machine' only")
        if len(self.shapes) != count or any(len(x) != size for x in self.shapes):
            raise StudyError(
                f"{path}.shapes: {len(self.shapes)} lists; allowed: {count} lists of {size} "
                "voltages, link by link and patch by patch"
            )
        shapes = np.array(self.shapes, complex)
        largest = np.abs(shapes).max(axis=1, keepdims=True)
        if not np.all(largest > SMALLEST):
            raise StudyError(f"{path}.shapes: one of them is zero")
        return np.asarray(shapes / largest)


class Measured(NamedTuple):
    """Measured modes."""

    frequency: np.ndarray  # [Hz], (k,)
    sigma: np.ndarray  # [Hz], (k,)
    damping: np.ndarray | None  # [1], (k,), nan where not known
    damping_sigma: np.ndarray | None  # [1], (k,)
    shapes: np.ndarray | None  # of what was measured, complex, (k, c)


class ModelModes(NamedTuple):
    """The model's modes that belong to the measured ones, and derivatives if asked for."""

    frequency: np.ndarray  # [Hz], (k,)
    damping: np.ndarray  # [1], (k,)
    by_frequency: np.ndarray | None  # (k, p)
    by_damping: np.ndarray | None  # (k, p)
    mode: np.ndarray  # which of the model's, the lowest 0, (k,)
    mac: np.ndarray | None  # subspace MAC [1], (k,); None without shapes


class Seen(NamedTuple):
    """What shapes are made of."""

    signals: tuple[Signal, ...]
    orders: tuple[int, ...]  # derivatives by time of each

    def shapes(self, bench: Bench, plant: PlantAt) -> np.ndarray:
        """Of the model's modes, in any scale, (c, m)."""
        rows = [plant.output(x, x.row(bench.n_patches, bench.stations))[0] for x in self.signals]
        times = plant.modes.pole ** np.array(self.orders)[:, None]
        return np.stack(rows) @ plant.modes.shape * times


class _Modes(Measurement):
    """Measured frequencies, then those damping ratios that are known."""

    kind = "modes"
    diagram: Diagram | None = None  # where they come from raw records

    def __init__(self, entry: DataEntry, bench: Bench, modes: Measured) -> None:
        super().__init__(entry, modes.frequency, modes.sigma)
        self._bench = bench
        self.use(modes)

    def use(self, modes: Measured) -> None:
        """Compare the model with these modes from now on."""
        self._modes, self._damped = modes, np.zeros(0, int)
        self.measured, self.sigma = modes.frequency, modes.sigma
        if modes.damping is not None and modes.damping_sigma is not None:
            self._damped = np.flatnonzero(np.isfinite(modes.damping))
            self.measured = np.append(modes.frequency, modes.damping[self._damped])
            self.sigma = np.append(modes.sigma, modes.damping_sigma[self._damped])
        self.labels = (
            *(f"mode {k + 1} [Hz]" for k in range(len(modes.frequency))),
            *(f"damping {k + 1} [1]" for k in self._damped),
        )

    def stretched(self, factor: float, damping: float = 1.0) -> Self:
        """The same with frequencies and damping ratios times a factor each."""
        other, own = copy.copy(self), self._modes
        own = own._replace(frequency=factor * own.frequency, sigma=factor * own.sigma)
        if own.damping is not None and own.damping_sigma is not None:
            own = own._replace(
                damping=damping * own.damping, damping_sigma=damping * own.damping_sigma
            )
        other.use(own)
        return other

    @abstractmethod
    def model_modes(self, values: np.ndarray, has_slopes: bool) -> ModelModes:
        """The model's modes at some values of the parameters, (p,)."""

    def predict(self, values: np.ndarray, has_slopes: bool) -> tuple[np.ndarray, Any]:
        model = self.model_modes(values, has_slopes)
        value = np.append(model.frequency, model.damping[self._damped])
        if model.by_frequency is None or model.by_damping is None:
            return value, None
        return value, np.concatenate([model.by_frequency, model.by_damping[self._damped]])

    def compare(self, values: np.ndarray) -> Numbers:
        model = self.model_modes(values, False)
        notes = [f"mode {k + 1} of the model" for k in model.mode]
        if model.mac is not None:
            notes = [f"{x}, shape {y:.3f} of 1" for x, y in zip(notes, model.mac, strict=True)]
        return Numbers(
            labels=self.labels,
            measured=self.measured,
            model=self.predict(values, False)[0],
            sigma=self.sigma,
            notes=tuple(notes),
            diagram=self.diagram,
        )

    def sanity_error(self, values: np.ndarray) -> str:
        try:
            model = self.model_modes(values, False)
        except StudyError as error:
            return str(error)
        if model.mac is not None and model.mac.min() < ALIKE:
            k = int(model.mac.argmin())
            return (
                f"the shape of mode {k + 1} ({self._modes.frequency[k]:g} Hz) is only "
                f"{model.mac[k]:.2f} alike to any of the model's (1: the same): check order "
                "and signs of what was measured: of voltages link by link and patch by patch"
            )
        ratio = float(np.median(model.frequency / self._modes.frequency))
        if not 0.1 < ratio < 10:
            return (
                f"the model's frequencies are {ratio:.3g} times the measured ones at the starting "
                "point; frequencies are in Hz: check unit and starting point"
            )
        return ""


class HeldModes(_Modes):
    """Modes of one link between held joints, in their order."""

    def __init__(self, entry: DataEntry, bench: Bench, modes: Measured, link: int) -> None:
        super().__init__(entry, bench, modes)
        self._link = link

    def model_modes(self, values: np.ndarray, has_slopes: bool) -> ModelModes:
        count = len(self._modes.frequency)
        frequency, damping, *slopes = (
            x[self._link, :count] for x in self._bench.held(values, has_slopes)
        )
        by_frequency, by_damping = slopes or (None, None)
        return ModelModes(
            frequency=frequency,
            damping=damping,
            by_frequency=by_frequency,
            by_damping=by_damping,
            mode=np.arange(count),
            mac=None,
        )


class MachineModes(_Modes):
    """Modes of the machine at a pose, held by its drive."""

    def __init__(
        self,
        entry: DataEntry,
        bench: Bench,
        modes: Measured,
        pose: Pose,
        seen: Seen | None = None,
        diagram: Diagram | None = None,
    ) -> None:
        """
        Args:
            entry, bench, modes: what is measured, and its model.
            pose: where.
            seen: what shapes are made of; None: the voltages of all sensors.
            diagram: of modes from raw records.
        """
        super().__init__(entry, bench, modes)
        self._pose, self._seen, self.diagram = pose, seen, diagram

    @property
    def n_channels(self) -> int:
        """Numbers in a shape, 0 without shapes."""
        return 0 if self._modes.shapes is None else self._modes.shapes.shape[1]

    def channel(self, k: int) -> str:
        """What a number of a shape was measured by."""
        if self._seen is not None:
            return signal_name(self._seen.signals[k])
        link, patch = divmod(k, self._bench.n_patches)
        return signal_name(Signal("sensor", link, patch, np.nan))

    def exchanged(self, j: int, k: int) -> Self:
        """The same with two numbers of every shape exchanged."""
        other, own = copy.copy(self), self._modes
        assert own.shapes is not None
        order = np.arange(self.n_channels)
        order[[j, k]] = k, j
        other.use(own._replace(shapes=own.shapes[:, order]))
        return other

    def model_modes(self, values: np.ndarray, has_slopes: bool) -> ModelModes:
        plant = self._bench.plant(self._pose, values, has_slopes)
        if self._seen is None:
            shapes = plant.value.sensor @ plant.modes.shape
        else:
            shapes = self._seen.shapes(self._bench, plant)
        pairs = pair_modes(self._modes, plant.modes, shapes)
        pole = plant.modes.pole[pairs.mode]
        size = np.abs(pole)
        by_frequency = by_damping = None
        if plant.slope is not None:
            paired = Modes(pole, pairs.shape, pairs.dual)
            by_frequency, by_damping = mode_slopes(paired, plant.slope.state)
        order = np.argsort(np.abs(plant.modes.pole), stable=True)
        return ModelModes(
            frequency=size / TWO_PI,
            damping=-pole.real / size,
            by_frequency=by_frequency,
            by_damping=by_damping,
            mode=np.argsort(order)[pairs.mode],
            mac=None if self._modes.shapes is None else pairs.mac,
        )


def mode_slopes(modes: Modes, change: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of frequencies [Hz] and damping ratios, (k, p).

    Args:
        modes: k of them.
        change: derivatives of the matrix A, (n, n, p).
    """
    pole = modes.pole
    by = np.einsum("kmp,mk->kp", np.einsum("kn,nmp->kmp", modes.dual, change), modes.shape)
    real, imag, size = pole.real[:, None], pole.imag[:, None], np.abs(pole)[:, None]
    by_size = (real * by.real + imag * by.imag) / size
    return by_size / TWO_PI, -by.real / size + real / size**2 * by_size


class Pairs(NamedTuple):
    """The model's mode for each measured one."""

    mode: np.ndarray  # (k,)
    shape: np.ndarray  # its right eigenvector, (n, k)
    dual: np.ndarray  # and left one, (k, n)
    mac: np.ndarray  # subspace MAC [1], (k,); 1 without shapes


def pair_modes(measured: Measured, modes: Modes, seen: np.ndarray) -> Pairs:
    """Find the model's modes that belong to the measured ones.

    Args:
        measured: with shapes, or without: then the nearest frequencies in their order.
        modes: of the model.
        seen: shapes of the model's modes, of what was measured, (c, m).

    Raises:
        StudyError: more measured modes than the model has.
    """
    frequency = np.abs(modes.pole) / TWO_PI
    if len(frequency) < len(measured.frequency):
        raise StudyError(f"has more modes than the model's {len(frequency)}; raise link.modes")
    apart = np.abs(np.log(frequency[None] / measured.frequency[:, None]))
    if measured.shapes is None:
        _, mode = scipy.optimize.linear_sum_assignment(apart)
        mode = mode[np.argsort(frequency[mode])]  # crossed pairs may be as near, but not as alike
        return Pairs(mode, modes.shape[:, mode], modes.dual[mode], np.ones(len(mode)))
    mac = np.array(
        [
            [_share(shape, seen[:, _near(frequency, k, NEAR)]) for k in range(len(frequency))]
            for shape in measured.shapes
        ]
    )
    own = np.abs(measured.shapes.conj() @ (seen / np.linalg.norm(seen, axis=0))) ** 2
    own /= np.linalg.norm(measured.shapes, axis=1)[:, None] ** 2
    # of modes in one subspace the likest, unless frequencies say otherwise
    _, mode = scipy.optimize.linear_sum_assignment(-mac - 0.1 * own + 0.3 * np.minimum(apart, 1.0))
    right, left = modes.shape[:, mode].copy(), modes.dual[mode].copy()
    for k, m in enumerate(mode):
        same = _near(frequency, m, EQUAL)
        if same.sum() > 1:  # the direction in their subspace that was measured
            part = np.linalg.lstsq(seen[:, same], measured.shapes[k], rcond=None)[0]
            part = part / np.linalg.norm(part)
            right[:, k] = modes.shape[:, same] @ part
            left[k] = part.conj() @ modes.dual[same]
    return Pairs(mode, right, left, mac[np.arange(len(mode)), mode])


def _near(frequency: np.ndarray, k: int, share: float) -> np.ndarray:
    return np.abs(frequency / frequency[k] - 1) <= share


def _share(shape: np.ndarray, span: np.ndarray) -> float:
    """Share of a shape's square that lies in the span of others [1]."""
    q, _ = np.linalg.qr(span)
    return float(np.linalg.norm(q.conj().T @ shape) ** 2 / np.linalg.norm(shape) ** 2)
