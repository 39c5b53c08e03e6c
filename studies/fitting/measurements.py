"""From the entries of a file to measurements with their data."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.metrics import METRICS
from studies.errors import StudyError, field_error
from studies.fitting.bench import Bench
from studies.fitting.bench import Pose as At
from studies.fitting.experiment import check_candidates
from studies.fitting.kinds.contract import Measurement, Noise
from studies.fitting.kinds.figures import Compared, Figures, Runs, Switch
from studies.fitting.kinds.modes import HeldModes, MachineModes, Measured, check_ascending
from studies.fitting.kinds.motions import OFF, RECORDED, Motions
from studies.fitting.kinds.response import ComplexResponse, Magnitude, Spectrum
from studies.fitting.kinds.traces import Band, Settling, Trace
from studies.fitting.records import RecordSettings, recorded_response
from studies.fitting.spec import (
    Common,
    FiguresEntry,
    FileEntry,
    FitSpec,
    ModesEntry,
    NoiseEntry,
    OutputEntry,
    PoseEntry,
    RecordEntry,
    ResponseEntry,
    SettlingEntry,
    ShakenEntry,
    SpectrumEntry,
    ThinnedEntry,
    TraceEntry,
    own_signal,
)
from studies.fitting.tables import column, read_columns
from studies.study.cases import build_structure
from studies.study.consistency import each_link
from studies.study.entries import entry_sizes, parse_entries
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal

#: Shapes whose largest voltage is below this have no direction [V].
SMALLEST = 1e-100
#: Rows of a measurement that a fit takes: a minute or two of work.
MOST_ROWS = 20_000
#: Derivatives of the output by its quantity.
ORDERS = {"displacement": 0, "velocity": 1, "acceleration": 2}
#: The same of outputs that have one quantity.
GIVEN = {"accelerometer": 2, "motor": 0}


class Models(NamedTuple):
    """What measurements are predicted with."""

    bench: Bench
    runs: Runs
    motions: Motions


def make_bench(spec: FitSpec) -> Bench:
    """Linear machine at the poses of all entries."""
    poses: dict[At, str] = {}
    for k, entry in enumerate(spec.entries):
        is_held = isinstance(entry, ModesEntry) and entry.ends == "held"
        if isinstance(entry, PoseEntry) and not is_held:
            poses.setdefault(_pose(spec, entry), f"fit.data[{k}].pose")
    places = tuple(sorted({*_places(spec, (ShakenEntry,)), *_own_places(spec)}))
    bench = Bench(spec.study, spec.free.place, tuple(poses), places, spec.free.fields)
    for pose, path in poses.items():
        bench.check(pose, path)
    check_candidates(bench, spec.fit.next)
    return bench


def make_measurements(spec: FitSpec, bench: Bench) -> list[Measurement]:
    """Measurements of a fit, with their data.

    Raises:
        StudyError: a file that cannot be used, data that do not fit the machine.
    """
    inputs, moving = (spec.study, spec.free.place), spec.free.fields
    places = _places(spec, (TraceEntry, SettlingEntry))
    models = Models(bench, Runs(*inputs, moving), Motions(*inputs, places, moving))
    return [
        _MAKERS[type(entry)](spec, models, entry, f"fit.data[{k}]")
        for k, entry in enumerate(spec.entries)
    ]


def _pose(spec: FitSpec, entry: PoseEntry) -> At:
    return entry.pose or spec.study.motion.waypoints[0]


def _signals(spec: FitSpec, entry: Common, path: str) -> tuple[Signal, ...]:
    """Input and output of an entry, or its output."""
    if not isinstance(entry, OutputEntry):
        return ()
    sizes = build_structure(spec.study).n_patches, each_link(spec.study.link.length)
    kinds = OUTPUTS if isinstance(entry, ShakenEntry) else {x: OUTPUTS[x] for x in RECORDED}
    output = parse_signal(entry.output, kinds, *sizes, f"{path}.output")
    if not isinstance(entry, ShakenEntry):
        return (output,)
    source = parse_signal(entry.input, INPUTS, *sizes, f"{path}.input")
    what = f"{path}: responses from commands and to motors are"
    _check_drive(spec, {source.kind, output.kind}, what)
    return source, output


def _places(spec: FitSpec, kinds: tuple[type[OutputEntry], ...]) -> tuple[float, ...]:
    """Where along the links hammers and deflections of some kinds of entries are [m], ascending."""
    places = {
        signal.place
        for k, entry in enumerate(spec.entries)
        if isinstance(entry, kinds)
        for signal in _signals(spec, entry, f"fit.data[{k}]")
    }
    return tuple(sorted(x for x in places if not np.isnan(x)))


def _own_places(spec: FitSpec) -> list[float]:
    """Where the instruments of the next experiment are [m]."""
    own = spec.fit.next
    for name in (*own.inputs, *own.outputs):
        _check_drive(spec, {name.partition(" ")[0]}, f"fit.next: {name}:")
    names = [(x, "inputs") for x in own.inputs] + [(x, "outputs") for x in own.outputs]
    signals = [own_signal(spec.study, *name) for name in names]
    return [x.place for x in signals if x is not None and not np.isnan(x.place)]


def _check_drive(spec: FitSpec, kinds: set[str], what: str) -> None:
    """Refuse commands and motors, kinds of signals, of other drives than PD."""
    if kinds & {"command", "motor"} and spec.study.drive.kind != "pd":
        raise StudyError(
            f"{what} known of drive.kind = 'pd' only, which has no forward path; it is "
            f"{spec.study.drive.kind!r}"
        )


def _each(value: Any, count: int, path: str) -> np.ndarray:
    """One number for all, or one for each."""
    if isinstance(value, tuple) and len(value) != count:
        raise field_error(path, value, f"one number, or {count}")
    return np.broadcast_to(np.asarray(value, float), (count,)).copy()


def _modes(spec: FitSpec, models: Models, entry: ModesEntry, path: str) -> Measurement:
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
        damping = _each(entry.damping_ratio, count, f"{path}.damping_ratio")
        damping[damping == 0] = np.nan
        if entry.damping_sigma is None:
            raise StudyError(f"{path}.damping_sigma: missing beside damping_ratio")
        sigma = _each(entry.damping_sigma, count, f"{path}.damping_sigma")
    if entry.shapes:
        size = 3 * models.bench.n_patches
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
        sigma=_each(entry.sigma_hz, count, f"{path}.sigma_hz"),
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
    return MachineModes(entry.name, entry.check, models.bench, measured, _pose(spec, entry))


def _read(spec: FitSpec, entry: FileEntry, path: str) -> Callable[[str], np.ndarray]:
    """What reads a column; all that are read have one length."""
    columns = read_columns(entry.file, spec.folder, f"{path}.file")
    thin = entry.thin if isinstance(entry, ThinnedEntry) else 1
    thinned = {name: x[::thin] for name, x in columns.items()}
    lengths: dict[str, int] = {}

    def read(name: str) -> np.ndarray:
        rows = lengths[name] = len(columns.get(name, ()))
        if isinstance(entry, ThinnedEntry) and rows > MOST_ROWS * thin:
            raise field_error(
                f"{path}.thin",
                thin,
                f"{-(-rows // MOST_ROWS)} or more for {entry.file} of {rows} rows: a fit takes up "
                f"to {MOST_ROWS} of each measurement (of raw time records take kind = 'record')",
                "1",
            )
        values = column(thinned, name, entry.file, path)
        if len(set(lengths.values())) > 1:
            sizes = ", ".join(f"{key} {size}" for key, size in lengths.items())
            raise StudyError(
                f"{path}: columns of {entry.file} differ in length: {sizes}; allowed: one length"
            )
        return values

    return read


def _real(x: np.ndarray, name: str, path: str) -> np.ndarray:
    if np.iscomplexobj(x):
        raise StudyError(f"{path}: column {name!r} is complex; expected real numbers")
    return x


def _ascending(x: np.ndarray, what: str, path: str, least: int = 3) -> None:
    if len(x) < least:
        raise StudyError(f"{path}: {what} has {len(x)} points; allowed: {least} or more")
    if not np.all(np.diff(x) > 0):
        row = int(np.argmax(np.diff(x) <= 0)) + 2
        raise StudyError(f"{path}: {what} must ascend; row {row} does not")


def _noise(entry: NoiseEntry, value: np.ndarray, path: str) -> Noise:
    noise = Noise(entry.sigma or 0.0, (entry.sigma_percent or 0.0) / 100)
    without = np.flatnonzero(noise.sigma(value) <= 0)
    if without.size:
        raise StudyError(
            f"{path}: value {without[0] + 1} is 0, where sigma_percent alone means no noise; give "
            "sigma beside it, the noise of small values in the unit of the output"
        )
    return noise


def _shaken(
    spec: FitSpec, models: Models, entry: ShakenEntry, signals: tuple[Signal, ...], path: str
) -> tuple[Any, ...]:
    """What measurements of a shaken machine begin with: which, where, from what to what."""
    ends, order = (signals[0], signals[1]), _order(entry, signals, path)
    return entry.name, entry.check, models.bench, _pose(spec, entry), ends, order


def _response(spec: FitSpec, models: Models, entry: ResponseEntry, path: str) -> Measurement:
    read, signals = _read(spec, entry, path), _signals(spec, entry, path)
    frequency = _real(read(entry.frequency), entry.frequency, path)
    _check_frequency(frequency, entry, path)
    if entry.magnitude:
        if entry.unknown:
            raise StudyError(f"{path}.unknown: has no meaning for a magnitude")
        measured = _real(read(entry.magnitude), entry.magnitude, path)
        if np.any(measured < 0):
            raise StudyError(f"{path}: column {entry.magnitude!r} has negative magnitudes; in dB?")
    else:
        measured = _complex(read, entry, path)
    arguments = (
        *_shaken(spec, models, entry, signals, path),
        frequency,
        measured,
        _noise(entry, measured, path),
        _unit(signals, ORDERS[entry.quantity]),
    )
    if entry.magnitude:
        return Magnitude(*arguments)
    return ComplexResponse(*arguments, unknown=_unknown(entry.unknown))


def _unknown(names: tuple[str, ...]) -> tuple[str, ...]:
    """Each of them once."""
    return tuple(dict.fromkeys(names))


def _record(spec: FitSpec, models: Models, entry: RecordEntry, path: str) -> Measurement:
    read, signals = _read(spec, entry, path), _signals(spec, entry, path)
    names = entry.time, entry.source, entry.value
    time, source, output = (_real(read(x), x, path) for x in names)
    settings = RecordSettings(
        segment=entry.segment_s,
        has_window=entry.window == "hann",
        is_h2=entry.estimator == "H2",
        band=(entry.from_hz, entry.to_hz),
    )
    found = recorded_response(time, source, output, settings, path)
    if len(found.frequency) > MOST_ROWS:
        longest = entry.segment_s * MOST_ROWS / len(found.frequency)
        raise field_error(
            f"{path}.segment_s",
            entry.segment_s,
            f"up to {longest:.3g} for this band: a fit takes up to {MOST_ROWS} frequencies",
            "s",
        )
    return ComplexResponse(
        *_shaken(spec, models, entry, signals, path),
        found.frequency,
        found.value,
        Noise(found.sigma, entry.sigma_percent / 100),
        _unit(signals, ORDERS[entry.quantity]),
        unknown=_unknown(entry.unknown),
    )


def _complex(read: Callable[[str], np.ndarray], entry: ResponseEntry, path: str) -> np.ndarray:
    if entry.file.lower().partition("::")[0].endswith((".uff", ".unv")):
        return read("value").astype(complex)
    real = read(entry.real)
    if np.iscomplexobj(real):
        return real
    return real + 1j * _real(read(entry.imag), entry.imag, path)


def _check_frequency(
    frequency: np.ndarray, entry: ResponseEntry | SpectrumEntry, path: str
) -> None:
    _ascending(frequency, f"column {entry.frequency!r}", path)
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


def _unit(signals: tuple[Signal, ...], order: int) -> str:
    per = ("", "/s", "/s^2")[order]
    return f"{OUTPUTS[signals[1].kind][1]}{per}/{INPUTS[signals[0].kind][1]}"


def _spectrum(spec: FitSpec, models: Models, entry: SpectrumEntry, path: str) -> Measurement:
    read, signals = _read(spec, entry, path), _signals(spec, entry, path)
    frequency, density = (_real(read(x), x, path) for x in (entry.frequency, entry.density))
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


def _trace(spec: FitSpec, models: Models, entry: TraceEntry, path: str) -> Measurement:
    read, (signal,) = _read(spec, entry, path), _signals(spec, entry, path)
    time, value = (_real(read(x), x, path) for x in (entry.time, entry.value))
    _ascending(time, f"column {entry.time!r}", path)
    if time[0] < 0 or time[-1] > spec.study.run.duration:
        raise StudyError(
            f"{path}: times from {time[0]:g} to {time[-1]:g} s; allowed: within the run, 0 to "
            f"{spec.study.run.duration:g} [s] (run.duration)"
        )
    return Trace(
        entry.name,
        entry.check,
        models.motions.of(None),
        signal,
        time,
        value,
        _noise(entry, value, path),
        OUTPUTS[signal.kind][1],
        _unknown(entry.unknown),
    )


def _settling(spec: FitSpec, models: Models, entry: SettlingEntry, path: str) -> Measurement:
    if (entry.band is None) == (entry.band_percent is None):
        raise StudyError(f"{path}: give band [unit of the output] or band_percent [%], one of them")
    (signal,) = _signals(spec, entry, path)
    if signal.kind in ("slider", "platform", "motor"):
        forms = ", ".join(OUTPUTS[x][0] for x in ("sensor", "deflection"))
        raise field_error(f"{path}.output", entry.output, f"{forms}, which settle about 0")
    if entry.time_s > spec.study.run.duration:
        raise field_error(
            f"{path}.time_s",
            entry.time_s,
            f"within the run, at most {spec.study.run.duration:g} (run.duration)",
            "s",
        )
    share = entry.band_percent
    band = Band(entry.band or 0.0, None)
    if share is not None:
        band = Band(share / 100, models.motions.of(OFF))
    motion = models.motions.of(entry.links)
    data = motion, signal, band, entry.time_s, entry.sigma_s
    return Settling(entry.name, entry.check, *data)


def _figures(spec: FitSpec, models: Models, entry: FiguresEntry, path: str) -> Measurement:
    links, modes = entry.links or spec.study.control.links, entry.modes or spec.study.control.modes
    is_on = spec.study.control.feedback != "none" and any(links)
    if entry.of == "reduction" and not is_on:
        raise StudyError(f"{path}.of = 'reduction': no link is under control in this study")
    if modes > spec.study.control.modes:
        raise field_error(
            f"{path}.modes", modes, f"1 to control.modes = {spec.study.control.modes}"
        )
    compared = []
    for name, value in entry.values.items():
        entries = parse_entries(name, f"{path}.values", entry_sizes(spec.study))
        if entry.amplitude and entry.of != "reduction" and value < 0:
            raise field_error(f"{path}.values.{name}", value, "0 or more where amplitude = true")
        if not METRICS[entries.metric].is_differentiable:
            smooth = [x for x in METRICS if METRICS[x].is_differentiable]
            hint = "; take kind = 'settling'" if entries.metric == "settling_time" else ""
            raise StudyError(
                f"{path}.values: {name!r} has no derivative{hint}; allowed: {', '.join(smooth)}"
            )
        compared.append(
            Compared(
                entries=entries,
                switch=Switch(OFF if entry.of == "uncontrolled" else links, modes),
                is_reduction=entry.of == "reduction",
                is_amplitude=entry.amplitude,
                is_largest=entry.take == "largest",
                measured=value,
                sigma=float(_noise(entry, np.array([value]), path).sigma(np.array([value]))[0]),
                label=name,
            )
        )
    return Figures(entry.name, entry.check, models.runs, tuple(compared))


_MAKERS: dict[type[Common], Callable[..., Measurement]] = {
    ModesEntry: _modes,
    ResponseEntry: _response,
    RecordEntry: _record,
    SpectrumEntry: _spectrum,
    TraceEntry: _trace,
    SettlingEntry: _settling,
    FiguresEntry: _figures,
}


def guess(spec: FitSpec) -> np.ndarray:
    """The study's values of the parameters, (p,)."""
    return np.array([number.start for number in spec.free.numbers])
