"""Modes, responses and spectra of the machine at a pose, or of a held link."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from studies.errors import StudyError, field_error
from studies.fitting.decays import DecaySettings, decay_modes
from studies.fitting.entries import common
from studies.fitting.entries.common import (
    GIVEN,
    ORDERS,
    Models,
    ascending,
    each,
    noise_of,
    pose_of,
    reader,
    real,
    signals_of,
    unit_of,
    unknown,
)
from studies.fitting.kinds.contract import Measurement, Noise
from studies.fitting.kinds.modes import (
    HeldModes,
    MachineModes,
    Measured,
    Seen,
    check_ascending,
)
from studies.fitting.kinds.response import ComplexResponse, Magnitude, Spectrum
from studies.fitting.records import RecordSettings, recorded_response
from studies.fitting.spec import (
    DecayEntry,
    FitSpec,
    ModesEntry,
    RecordEntry,
    ResponseEntry,
    ShakenEntry,
    SpectrumEntry,
)
from studies.study.signals import INPUTS, Signal

#: Shapes whose largest voltage is below this have no direction [V].
SMALLEST = 1e-100


def make_modes(spec: FitSpec, models: Models, entry: ModesEntry, path: str) -> Measurement:
    """Measured modes of the machine or of a held link."""
    count = len(entry.frequency_hz)
    written = entry.model_fields_set
    for name, ends in (("link", "machine"), ("pose", "held")):
        if name in written and entry.ends == ends:
            raise StudyError(f"{path}.{name}: has no meaning with ends = {ends!r}")
    if "damping_sigma" in written and not entry.damping_ratio:
        raise StudyError(f"{path}.damping_sigma: has no meaning without damping_ratio")
    check_ascending(entry.frequency_hz, bool(entry.shapes), path)
    damping = sigma = shapes = None
    if entry.damping_ratio:
        damping = each(entry.damping_ratio, count, f"{path}.damping_ratio")
        damping[damping == 0] = np.nan
        if entry.damping_sigma is None:
            raise StudyError(f"{path}.damping_sigma: missing beside damping_ratio")
        sigma = each(entry.damping_sigma, count, f"{path}.damping_sigma")
    if entry.shapes:
        size = models.bench.study.n_links * models.bench.n_patches
        if entry.ends == "held":
            raise StudyError(f"{path}.shapes: allowed with ends = 'machine' only")
        if len(entry.shapes) != count or any(len(x) != size for x in entry.shapes):
            raise StudyError(
                f"{path}.shapes: {len(entry.shapes)} lists; allowed: {count} lists of {size} "
                "voltages, link by link and patch by patch"
            )
        shapes = np.array(entry.shapes, complex)
        largest = np.abs(shapes).max(axis=1, keepdims=True)
        if not np.all(largest > SMALLEST):
            raise StudyError(f"{path}.shapes: one of them is zero")
        shapes = shapes / largest
    measured = Measured(
        frequency=np.array(entry.frequency_hz),
        sigma=each(entry.sigma_hz, count, f"{path}.sigma_hz"),
        damping=damping,
        damping_sigma=sigma,
        shapes=shapes,
    )
    if entry.ends == "held":
        if count > models.bench.structure.n_modes:
            raise field_error(
                f"{path}.frequency_hz",
                entry.frequency_hz,
                f"at most link.modes = {models.bench.structure.n_modes} frequencies",
            )
        return HeldModes(entry.name, entry.check, models.bench, measured, entry.link - 1)
    return MachineModes(entry.name, entry.check, models.bench, measured, pose_of(spec, entry))


def make_decay(spec: FitSpec, models: Models, entry: DecayEntry, path: str) -> Measurement:
    """Modes from recorded free decays or ambient vibration."""
    read, signals = reader(spec, entry, path), signals_of(spec, entry, path)
    columns = entry.values or entry.outputs
    if len(columns) != len(signals):
        raise field_error(f"{path}.values", columns, f"{len(signals)} columns, one of each output")
    if len(set(signals)) < len(signals):
        raise field_error(f"{path}.outputs", entry.outputs, "each output once")
    if len({*columns, entry.time}) <= len(columns):
        raise field_error(f"{path}.values", columns, "each column once, without that of the time")
    is_own = [x.kind in GIVEN for x in signals]
    if "quantity" in entry.model_fields_set and all(is_own):
        raise StudyError(f"{path}.quantity: has no meaning for {entry.outputs[0]!r}; leave it out")
    time, *recorded = (real(read(x), x, path) for x in (entry.time, *columns))
    settings = DecaySettings(
        segment=entry.segment_s,
        is_ambient=entry.excitation == "ambient",
        band=(entry.from_hz, entry.to_hz),
    )
    found = decay_modes(time, np.column_stack(recorded), settings, path)
    share = entry.sigma_percent / 100  # of a pole's size, to any side
    measured = Measured(
        frequency=found.frequency,
        sigma=np.hypot(found.sigma, share * found.frequency),
        damping=found.damping,
        damping_sigma=np.hypot(found.damping_sigma, share),
        shapes=found.shapes if len(signals) > 1 else None,
    )
    orders = tuple(GIVEN.get(x.kind, ORDERS[entry.quantity]) for x in signals)
    seen = Seen(signals, orders)
    pose = pose_of(spec, entry)
    return MachineModes(entry.name, entry.check, models.bench, measured, pose, seen, found.diagram)


def _shaken(
    spec: FitSpec, models: Models, entry: ShakenEntry, signals: tuple[Signal, ...], path: str
) -> tuple[Any, ...]:
    """What measurements of a shaken machine begin with: which, where, from what to what."""
    ends, order = (signals[0], signals[1]), _order(entry, signals, path)
    return entry.name, entry.check, models.bench, pose_of(spec, entry), ends, order


def make_response(spec: FitSpec, models: Models, entry: ResponseEntry, path: str) -> Measurement:
    """A frequency response."""
    read, signals = reader(spec, entry, path), signals_of(spec, entry, path)
    frequency = real(read(entry.frequency), entry.frequency, path)
    _check_frequency(frequency, entry, path)
    if entry.magnitude:
        if entry.unknown:
            raise StudyError(f"{path}.unknown: has no meaning for a magnitude")
        measured = real(read(entry.magnitude), entry.magnitude, path)
        if np.any(measured < 0):
            raise StudyError(f"{path}: column {entry.magnitude!r} has negative magnitudes; in dB?")
    else:
        measured = _complex(read, entry, path)
    arguments = (
        *_shaken(spec, models, entry, signals, path),
        frequency,
        measured,
        noise_of(entry, measured, path),
        _unit(signals, entry.quantity),
    )
    if entry.magnitude:
        return Magnitude(*arguments)
    return ComplexResponse(*arguments, unknown=unknown(entry.unknown))


def make_record(spec: FitSpec, models: Models, entry: RecordEntry, path: str) -> Measurement:
    """A frequency response from raw records."""
    read, signals = reader(spec, entry, path), signals_of(spec, entry, path)
    names = entry.time, entry.source, entry.value
    time, source, output = (real(read(x), x, path) for x in names)
    settings = RecordSettings(
        segment=entry.segment_s,
        has_window=entry.window == "hann",
        is_h2=entry.estimator == "H2",
        band=(entry.from_hz, entry.to_hz),
    )
    found = recorded_response(time, source, output, settings, path)
    if len(found.frequency) > common.MOST_ROWS:
        longest = entry.segment_s * common.MOST_ROWS / len(found.frequency)
        raise field_error(
            f"{path}.segment_s",
            entry.segment_s,
            f"up to {longest:.3g} for this band: a fit takes up to {common.MOST_ROWS} frequencies",
            "s",
        )
    return ComplexResponse(
        *_shaken(spec, models, entry, signals, path),
        found.frequency,
        found.value,
        Noise(found.sigma, entry.sigma_percent / 100),
        _unit(signals, entry.quantity),
        unknown=unknown(entry.unknown),
    )


def _complex(read: Callable[[str], np.ndarray], entry: ResponseEntry, path: str) -> np.ndarray:
    if entry.file.lower().partition("::")[0].endswith((".uff", ".unv")):
        return read("value").astype(complex)
    value = read(entry.real)
    if np.iscomplexobj(value):
        return value
    return value + 1j * real(read(entry.imag), entry.imag, path)


def _check_frequency(
    frequency: np.ndarray, entry: ResponseEntry | SpectrumEntry, path: str
) -> None:
    ascending(frequency, f"column {entry.frequency!r}", path)
    if frequency[0] < 0 or frequency[-1] > 1e5:
        raise StudyError(
            f"{path}: frequencies from {frequency[0]:g} to {frequency[-1]:g}; allowed: "
            "0 to 100000 [Hz]"
        )


def _order(entry: ShakenEntry, signals: tuple[Signal, ...], path: str) -> int:
    """Derivatives by time that the output has."""
    if signals[1].kind not in GIVEN:
        return ORDERS[entry.quantity]
    if "quantity" in entry.model_fields_set:
        raise StudyError(f"{path}.quantity: has no meaning for {entry.output!r}; leave it out")
    return GIVEN[signals[1].kind]


def _unit(signals: tuple[Signal, ...], quantity: str) -> str:
    return f"{unit_of(signals[1], quantity)}/{INPUTS[signals[0].kind][1]}"


def make_spectrum(spec: FitSpec, models: Models, entry: SpectrumEntry, path: str) -> Measurement:
    """A power spectrum."""
    read, signals = reader(spec, entry, path), signals_of(spec, entry, path)
    frequency, density = (real(read(x), x, path) for x in (entry.frequency, entry.density))
    _check_frequency(frequency, entry, path)
    keep = frequency > 0  # the mean says nothing about white noise
    frequency, density = frequency[keep], density[keep]
    if np.any(density <= 0):
        raise StudyError(
            f"{path}: column {entry.density!r} has values that are not positive; in dB?"
        )
    return Spectrum(
        entry.averages,
        *_shaken(spec, models, entry, signals, path),
        frequency,
        density,
        Noise(0.0, 0.0),
        "any",
    )
