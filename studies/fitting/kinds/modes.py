"""Natural frequencies and damping ratios, of the machine at a pose or of a link between held ends.

Measured shapes pair the modes: by the part of a measured shape that lies in the span of the
model's modes near one frequency (subspace MAC), so that three nearly equal modes may mix.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from studies.errors import StudyError, field_error
from studies.fitting.bench import Bench, Modes, PlantAt
from studies.fitting.kinds.contract import Curve, Residual

#: Modes closer than this share one subspace [1].
NEAR = 0.03
#: Modes closer than this are one: their shapes are any of a subspace [1].
EQUAL = 1e-6
TWO_PI = 2 * np.pi


class Measured(NamedTuple):
    """Measured modes."""

    frequency: np.ndarray  # [Hz], (k,)
    sigma: np.ndarray  # [Hz], (k,)
    damping: np.ndarray | None  # [1], (k,), nan where not known
    damping_sigma: np.ndarray | None  # [1], (k,)
    shapes: np.ndarray | None  # voltages of the sensors, (k, 3 K)


class HeldModes:
    """Modes of one link between held joints, in their order."""

    kind, is_ordered, n_hidden = "modes", False, 0

    def __init__(
        self, name: str, is_checked: bool, bench: Bench, measured: Measured, link: int
    ) -> None:
        self.name, self.is_checked = name, is_checked
        self._bench, self._measured, self._link = bench, measured, link

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        frequency, damping, *slopes = self._bench.held(values, has_slopes)
        n = len(self._measured.frequency)
        first = [x[self._link, :n] for x in slopes]
        return _residual(
            self._measured,
            frequency[self._link, :n],
            damping[self._link, :n],
            first[0] if has_slopes else None,
            first[1] if has_slopes else None,
        )

    def reweigh(self, values: np.ndarray) -> None:
        pass  # its noise is no share

    def curve(self, values: np.ndarray) -> Curve:
        return _curve(self._measured, self._frequencies(values))

    def complaint(self, values: np.ndarray) -> str:
        return _scale_complaint(self._measured, self._frequencies(values))

    def _frequencies(self, values: np.ndarray) -> np.ndarray:
        return self._bench.held(values, False)[0][self._link, : len(self._measured.frequency)]


class MachineModes:
    """Modes of the machine at a pose, held by its drive."""

    kind, is_ordered, n_hidden = "modes", False, 0

    def __init__(
        self,
        name: str,
        is_checked: bool,
        bench: Bench,
        measured: Measured,
        pose: tuple[float, float, float],
    ) -> None:
        self.name, self.is_checked = name, is_checked
        self._bench, self._measured, self._pose = bench, measured, pose

    def residual(self, values: np.ndarray, has_slopes: bool) -> Residual:
        plant, pole, pairs = self._paired(values, has_slopes)
        slopes: list[np.ndarray | None] = [None, None]
        if plant.slope is not None:
            turned = np.einsum("kn,nmp->kmp", pairs.dual, plant.slope.state)
            by = np.einsum("kmp,mk->kp", turned, pairs.shape)  # of the poles
            size = (pole.real[:, None] * by.real + pole.imag[:, None] * by.imag) / np.abs(pole)[
                :, None
            ]
            ratio = (
                -by.real / np.abs(pole)[:, None] + (pole.real / np.abs(pole) ** 2)[:, None] * size
            )
            slopes = [size / TWO_PI, ratio]
        return _residual(self._measured, np.abs(pole) / TWO_PI, -pole.real / np.abs(pole), *slopes)

    def reweigh(self, values: np.ndarray) -> None:
        pass  # its noise is no share

    def curve(self, values: np.ndarray) -> Curve:
        return _curve(self._measured, self._frequencies(values))

    def _paired(self, values: np.ndarray, has_slopes: bool) -> tuple[PlantAt, np.ndarray, Pairs]:
        """The plant, its poles that belong to the measured modes, and how they were paired."""
        plant = self._bench.plant(self._pose, values, has_slopes)
        modes = plant.modes
        pairs = pair_modes(self._measured, modes, plant.value.sensor)
        return plant, modes.pole[pairs.mode], pairs

    def _frequencies(self, values: np.ndarray) -> np.ndarray:
        return np.abs(self._paired(values, False)[1]) / TWO_PI

    def complaint(self, values: np.ndarray) -> str:
        try:
            return _scale_complaint(self._measured, self._frequencies(values))
        except StudyError as error:
            return str(error)


class Pairs(NamedTuple):
    """The model's mode for each measured one."""

    mode: np.ndarray  # (k,)
    shape: np.ndarray  # its right eigenvector, (n, k)
    dual: np.ndarray  # and left one, (k, n)
    likeness: np.ndarray  # subspace MAC [1], (k,); 1 without shapes


def pair_modes(measured: Measured, modes: Modes, sensor: np.ndarray) -> Pairs:
    """Find the model's modes that belong to the measured ones.

    Args:
        measured: with shapes, or without: then the nearest frequencies in their order.
        modes: of the model.
        sensor: voltages of the sensors, rows over the state, (3 K, n).

    Raises:
        StudyError: more measured modes than the model has.
    """
    frequency = np.abs(modes.pole) / TWO_PI
    if len(frequency) < len(measured.frequency):
        raise StudyError(f"has more modes than the model's {len(frequency)}; raise link.modes")
    apart = np.abs(np.log(frequency[None] / measured.frequency[:, None]))
    if measured.shapes is None:
        row, mode = linear_sum_assignment(apart)
        return Pairs(mode, modes.shape[:, mode], modes.dual[mode], np.ones(len(row)))
    seen = sensor @ modes.shape  # (3 K, m)
    likeness = np.array(
        [
            [_share(shape, seen[:, _near(frequency, k, NEAR)]) for k in range(len(frequency))]
            for shape in measured.shapes
        ]
    )
    own = np.abs(measured.shapes.conj() @ (seen / np.linalg.norm(seen, axis=0))) ** 2
    own /= np.linalg.norm(measured.shapes, axis=1)[:, None] ** 2
    # of modes in one subspace the likest, unless frequencies say otherwise
    _, mode = linear_sum_assignment(-likeness - 0.1 * own + 0.3 * np.minimum(apart, 1.0))
    right, left = modes.shape[:, mode].copy(), modes.dual[mode].copy()
    for k, m in enumerate(mode):
        same = _near(frequency, m, EQUAL)
        if same.sum() > 1:  # the direction in their subspace that was measured
            part = np.linalg.lstsq(seen[:, same], measured.shapes[k], rcond=None)[0]
            part = part / np.linalg.norm(part)
            right[:, k] = modes.shape[:, same] @ part
            left[k] = part.conj() @ modes.dual[same]
    return Pairs(mode, right, left, likeness[np.arange(len(mode)), mode])


def _near(frequency: np.ndarray, k: int, share: float) -> np.ndarray:
    return np.abs(frequency / frequency[k] - 1) <= share


def _share(shape: np.ndarray, span: np.ndarray) -> float:
    """Share of a shape's square that lies in the span of others [1]."""
    q, _ = np.linalg.qr(span)
    return float(np.linalg.norm(q.conj().T @ shape) ** 2 / np.linalg.norm(shape) ** 2)


def _residual(
    measured: Measured,
    frequency: np.ndarray,
    damping: np.ndarray,
    by_frequency: np.ndarray | None,
    by_damping: np.ndarray | None,
) -> Residual:
    value = [(frequency - measured.frequency) / measured.sigma]
    slope = [] if by_frequency is None else [by_frequency / measured.sigma[:, None]]
    if measured.damping is not None and measured.damping_sigma is not None:
        is_known = np.isfinite(measured.damping)
        sigma = measured.damping_sigma[is_known]
        value.append((damping - measured.damping)[is_known] / sigma)
        if by_damping is not None:
            slope.append(by_damping[is_known] / sigma[:, None])
    return Residual(np.concatenate(value), np.concatenate(slope) if slope else None)


def _curve(measured: Measured, found: np.ndarray) -> Curve:
    labels = tuple(f"mode {k + 1}" for k in range(len(found)))
    x = np.arange(1, len(found) + 1)
    return Curve(
        abscissa="measured mode",
        ordinate="frequency [Hz]",
        x=x,
        measured=measured.frequency,
        model=found,
        is_log=True,
        labels=labels,
    )


def _scale_complaint(measured: Measured, found: np.ndarray) -> str:
    ratio = float(np.median(found / measured.frequency))
    if not 0.1 < ratio < 10:
        return (
            f"the model's frequencies are {ratio:.3g} times the measured ones at the first guess; "
            "frequencies are in Hz: check unit and first guess"
        )
    return ""


def check_ascending(frequency: tuple[float, ...], has_shapes: bool, path: str) -> None:
    """Without shapes, modes are known by their order.

    Raises:
        StudyError: not ascending.
    """
    if not has_shapes and list(frequency) != sorted(frequency):
        raise field_error(
            f"{path}.frequency_hz",
            frequency,
            "ascending frequencies where no shapes are given",
            "Hz",
        )
