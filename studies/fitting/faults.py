"""Faults that are made when data are taken, and what measurements are without them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from itertools import combinations
from typing import NamedTuple, TypeVar

import numpy as np

from studies.errors import StudyError
from studies.fitting.kinds.contract import Measurement
from studies.fitting.kinds.modes import HeldModes, MachineModes
from studies.fitting.kinds.response import ComplexResponse, Magnitude
from studies.fitting.kinds.spectrum import Spectrum
from studies.fitting.kinds.trace import Trace
from studies.study.signals import Signal

#: A simple fault is as good as a more complicated one within this factor of chi square [1].
AS_GOOD = 1.3
#: Delays tried [s], and gains with a meaning of their own.
DELAYS = np.concatenate([-np.geomspace(1e-2, 2e-5, 60), np.geomspace(2e-5, 1e-2, 60)])
GAINS = {
    2 * np.pi: "2 pi",
    1 / (2 * np.pi): "1/(2 pi)",
    1 / 9.80665: "1/9.81, as of accelerations in g",
    9.80665: "9.81, as of accelerations in m/s2 with the sensitivity for g",
    1e3: "1000",
    1e-3: "1/1000",
    2.0: "2",
    0.5: "1/2",
    np.sqrt(2): "the root of 2, as of peak and rms values",
}
TWO_PI = 2 * np.pi
IN_RADIANS = "its frequencies are in rad/s"
T = TypeVar("T", bound=Measurement)
F = TypeVar("F", ComplexResponse, Magnitude, Spectrum)
G = TypeVar("G", ComplexResponse, Magnitude, Trace)


class Fault(NamedTuple):
    """A fault of a measurement."""

    text: str  # with a place for its size, if it has one
    mended: Measurement  # without it
    size: float = 0.0


def fault_of(one: Measurement, values: np.ndarray, better: float) -> Fault | None:
    """The simplest fault that, undone, brings a measurement near the model; None if none does.

    Args:
        one: the measurement.
        values: of the parameters, (p,).
        better: factor by which its chi square must fall.
    """
    rated = []
    for fault in _faults(one, values):
        try:
            square = float(np.sum(fault.mended.residual(values, False).value ** 2))
        except (StudyError, np.linalg.LinAlgError):
            continue
        rated.append((square, fault))
    own = float(np.sum(one.residual(values, False).value ** 2))
    least = min((square for square, _ in rated), default=np.inf)
    if least * better > own:
        return None
    return next((fault for square, fault in rated if square <= AS_GOOD * least), None)


def _faults(one: Measurement, values: np.ndarray) -> Iterator[Fault]:
    """Simple faults first, those with a number of their own last."""
    if isinstance(one, HeldModes | MachineModes):
        yield Fault(IN_RADIANS, one.stretched(1 / TWO_PI))
        yield Fault("its damping ratios are in percent", one.stretched(1.0, 1 / 100))
    if isinstance(one, MachineModes):
        for j, k in combinations(range(one.n_channels), 2):
            names = " and ".join(one.channel(x) for x in (j, k))
            yield Fault(f"{names} are exchanged", one.exchanged(j, k))
    if isinstance(one, Spectrum):  # of any strength
        yield Fault(IN_RADIANS, _stretched(one, values))
        yield from _other_channels(one, values)
    if isinstance(one, ComplexResponse):
        yield from _of_response(one, values)
    if isinstance(one, Magnitude):
        yield Fault(IN_RADIANS, _stretched(one, values))
        yield from _named_gains(one, values)
        yield from _other_channels(one, values)
        yield from _gain(one, values, np.abs(one.predict(values, False)[0]))
    if isinstance(one, Trace):
        yield from _of_trace(one, values)


def _of_response(one: ComplexResponse, values: np.ndarray) -> Iterator[Fault]:
    yield Fault("its polarity is reversed", _times(one, values, -1.0))
    yield Fault(
        "it is conjugated, as with exp(-j omega t)", _with(one, measured=one.measured.conj())
    )
    yield Fault(IN_RADIANS, _stretched(one, values))
    yield from _named_gains(one, values)
    yield from _other_channels(one, values)
    model, _ = one.predict(values, False)
    weight = 1 / one.sigma**2

    def turned(delay: float) -> np.ndarray:
        return np.asarray(one.measured * np.exp(2j * np.pi * one.frequency * delay))

    delay = _least(lambda x: float(np.sum(weight * np.abs(turned(x) - model) ** 2)))
    yield _late(delay, _with(one, measured=turned(delay)))
    yield from _gain(one, values, model)
    if gain := _best_gain(one, model):
        angle = -np.degrees(np.angle(gain))
        text = f"its gain is wrong by a factor of {1 / abs(gain):.4g} and {angle:.3g} deg"
        yield Fault(text, _times(one, values, gain))


def _of_trace(one: Trace, values: np.ndarray) -> Iterator[Fault]:
    yield Fault("its polarity is reversed", _times(one, values, -1.0))
    yield from _named_gains(one, values)
    for text, signal in _others(one.signal, "sensor", one.patches):
        yield Fault(text, _weighed(one, values, signal=signal))

    def shifted(delay: float) -> Trace:
        return _with(one, time=one.time - delay)

    delay = _least(lambda x: float(np.sum(shifted(x).residual(values, False).value ** 2)))
    yield _late(delay, shifted(delay))
    yield from _gain(one, values, one.predict(values, False)[0])


def _late(delay: float, mended: Measurement) -> Fault:
    text = f"it is {'late' if delay > 0 else 'early'} by {{:.3g}} ms"
    return Fault(text, mended, 1e3 * abs(delay))


def _least(square: Callable[[float], float]) -> float:
    """The delay of the least misfit [s]: the best of a grid, then of a finer one about it."""
    k = int(np.argmin([square(x) for x in DELAYS]))
    near = np.linspace(DELAYS[max(k - 1, 0)], DELAYS[min(k + 1, len(DELAYS) - 1)], 201)
    return float(near[int(np.argmin([square(x) for x in near]))])


def _named_gains(one: G, values: np.ndarray) -> Iterator[Fault]:
    for gain, name in GAINS.items():
        yield Fault(f"it is too large by a factor of {name}", _times(one, values, 1 / gain))


def _gain(one: G, values: np.ndarray, model: np.ndarray) -> Iterator[Fault]:
    if (size := abs(_best_gain(one, model))) > 0:
        yield Fault("its gain is wrong by a factor of {:.4g}", _times(one, values, size), 1 / size)


def _best_gain(one: G, model: np.ndarray) -> complex:
    """Of least squares, from measured values to the model's."""
    weight = 1 / one.sigma**2
    power = np.sum(weight * np.abs(one.measured) ** 2)
    return complex(np.sum(weight * one.measured.conj() * model) / max(power, 1e-300))


def _weighed(one: T, values: np.ndarray, **changes: object) -> T:
    """A measurement with another model, whose noise is a share of that."""
    other = _with(one, **changes)
    other.reweigh(values)
    return other


def _with(one: T, **changes: object) -> T:
    """A measurement with other data."""
    other = copy.copy(one)
    for name, value in changes.items():
        setattr(other, name, value)
    return other


def _times(one: G, values: np.ndarray, gain: complex) -> G:
    factor = gain if np.iscomplexobj(one.measured) else gain.real
    noise = one._noise._replace(fixed=abs(factor) * one._noise.fixed)  # a share of the model stays
    return _weighed(one, values, measured=factor * one.measured, _noise=noise)


def _stretched(one: F, values: np.ndarray) -> F:
    return _weighed(one, values, frequency=one.frequency / TWO_PI)


def _other_channels(
    one: ComplexResponse | Magnitude | Spectrum, values: np.ndarray
) -> Iterator[Fault]:
    """Another sensor or actuator in place of the one that the file names."""
    source, output = one.signals
    for text, signal in _others(output, "sensor", one.patches):
        yield Fault(text, _weighed(one, values, signals=(source, signal)))
    for text, signal in _others(source, "actuator", one.patches):
        yield Fault(text, _weighed(one, values, signals=(signal, output)))


def _others(own: Signal, kind: str, patches: tuple[int, int]) -> Iterator[tuple[str, Signal]]:
    """What is said of each other signal of a kind, and it; none of other kinds."""
    if own.kind != kind:
        return
    for link, patch in np.ndindex(patches):
        if (link, patch) != (own.link, own.patch):
            yield f"its {kind} is {link + 1}.{patch + 1}", own._replace(link=link, patch=patch)
