"""The file of a fit: a study, the starting point, plus `[fit]`: what is free and was measured.

Each entry of `[[fit.data]]` is a measurement of some kind with its own noise level. Numbers are in
SI units unless their names say otherwise.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Field, ValidationError

from studies.engine.preflight import check_machine, check_run
from studies.errors import StudyError, field_error, nearest, shown_name
from studies.show.units import headed, readable
from studies.space.axes import Range
from studies.space.free import (
    FreeNumbers,
    check_twice,
    join_numbers,
    plain_numbers,
)
from studies.study.consistency import patch_centers
from studies.study.explain import explain
from studies.study.files import find_spec, read_toml
from studies.study.links import OneALink
from studies.study.paths import as_tuples, field_unit, parse_entry
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal
from studies.study.sizes import lengths
from studies.study.spec import (
    DESIGN,
    MACHINE,
    Pose,
    Section,
    Study,
    described,
    parse_study,
)
from studies.study.window import with_window

Positive = Annotated[float, Field(ge=1e-30, le=1e12)]
Percent = Annotated[float, Field(ge=1e-6, le=1000)]
Share = Annotated[float, Field(ge=1e-6, lt=100)]

#: Kinds of measurements that take a run of the whole motion.
MOTIONS = ("trace", "settling", "figures")
#: Fewer samples say nothing.
FEWEST_SAMPLES = 20


class Common(Section):
    """Fields of every measurement."""

    kind: str = described(..., "-", "kind of measurement")
    name: str = described("", "-", "in messages and figures; default: its number", max_length=60)
    check: bool = described(False, "-", "held out: compared, not fitted")


#: What may be unknown of a response.
Unknown = tuple[Literal["gain", "delay"], ...]


class PoseEntry(Common):
    """Fields of measurements at a pose."""

    pose: Pose | None = described(None, "m; m; rad", "of the platform; default: first way-point")


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


class OutputEntry(Common):
    """Fields of measurements of one output."""

    output: str = described(..., "-", "what is measured")


class FileEntry(Common):
    """Fields of measurements in a file of columns."""

    file: str = described(..., "-", "CSV, HDF5, MATLAB or UFF, beside this file")


class ThinnedEntry(OutputEntry, FileEntry):
    """Fields of measurements whose rows can be thinned out."""

    thin: int = described(
        1,
        "1",
        "every how many rows one is kept, where noise is alike in neighbours",
        ge=1,
        le=10**6,
    )


class NoiseEntry(Section):
    """Standard deviation of the values; both parts in quadrature."""

    sigma: Positive | None = described(None, "unit of the output", "standard deviation")
    sigma_percent: Percent | None = described(None, "%", "standard deviation over the value")


class ShakenEntry(OutputEntry, FileEntry, PoseEntry):
    """Fields of measurements of a machine that is shaken."""

    input: str = described(..., "-", "what shakes the machine")
    quantity: Literal["displacement", "velocity", "acceleration"] = described(
        "displacement", "-", "of the output: as named, or its derivative; an accelerometer has none"
    )


class ResponseEntry(ShakenEntry, ThinnedEntry, NoiseEntry):
    """A frequency response."""

    frequency: str = described("frequency_hz", "-", "column")
    real: str = described("real", "-", "column")
    imag: str = described("imag", "-", "column")
    magnitude: str = described("", "-", "column; instead of real and imaginary part")
    unknown: Unknown = described((), "-", "of gain and delay, what nobody knows")


class RecordEntry(ShakenEntry):
    """Raw time records of an input and an output, which become a frequency response."""

    time: str = described("time", "-", "column [s], evenly spaced")
    source: str = described("input", "-", "column of the input")
    value: str = described("output", "-", "column of the output")
    segment_s: Positive = described(..., "s", "length of the segments that are averaged")
    window: Literal["hann", "none"] = described(
        "hann", "-", "of segments that overlap by half; none: each is an impact that has decayed"
    )
    estimator: Literal["H1", "H2"] = described(
        "H1", "-", "H1: noise on the output; H2: noise on the input"
    )
    from_hz: float = described(0.0, "Hz", "lowest frequency that is kept", ge=0, le=1e5)
    to_hz: float = described(
        0.0, "Hz", "highest one; 0: 0.4 times the sample rate of the record", ge=0, le=1e5
    )
    unknown: Unknown = described((), "-", "of gain and delay, what nobody knows")
    sigma_percent: Percent = described(
        0.2, "%", "standard deviation over the value, beside what the coherence says"
    )


class DecayEntry(FileEntry, PoseEntry):
    """Raw time records of a machine that rings or moves by chance, which become its modes."""

    outputs: tuple[str, ...] = described(
        ..., "-", "what is measured; several pair the modes by their shapes", min_length=1
    )
    time: str = described("time", "-", "column [s], evenly spaced")
    values: tuple[str, ...] = described((), "-", "columns; default: named as the outputs")
    quantity: Literal["displacement", "velocity", "acceleration"] = described(
        "displacement",
        "-",
        "of the outputs: as named, or their derivatives; accelerometers have none",
    )
    excitation: Literal["none", "ambient"] = described(
        "none", "-", "none: it is left to ring; ambient: chance shakes it all the time"
    )
    segment_s: float = described(
        0.0, "s", "a decay each; ambient: length of the correlations; 0: as long as may be", ge=0
    )
    from_hz: float = described(0.0, "Hz", "lowest frequency of a mode", ge=0, le=1e5)
    to_hz: float = described(
        0.0, "Hz", "highest one; 0: 0.4 times the sample rate of the record", ge=0, le=1e5
    )
    sigma_percent: Percent = described(
        1e-3, "%", "standard deviation of a pole over its size, beside what the scatter says"
    )


class SpectrumEntry(ShakenEntry, ThinnedEntry):
    """A power spectrum under a white input of unknown strength."""

    frequency: str = described("frequency_hz", "-", "column")
    density: str = described("density", "-", "column, unit^2/Hz in any scale")
    averages: int = described(1, "1", "independent spectra in the mean", ge=1, le=10**6)


class TraceEntry(ThinnedEntry, NoiseEntry):
    """A signal over time of the study's motion."""

    time: str = described("time", "-", "column [s], from the start of the motion")
    value: str = described("value", "-", "column")
    unknown: tuple[Literal["gain", "offset"], ...] = described(
        (), "-", "of gain and offset, what nobody knows"
    )


class SettlingEntry(OutputEntry):
    """How long a signal takes to settle after the study's motion."""

    time_s: float = described(
        ...,
        "s",
        "from the end of the reference trajectory until it stays within the band",
        ge=0,
        le=1e4,
    )
    sigma_s: Positive = described(..., "s", "standard deviation")
    band: Positive | None = described(None, "unit of the output", "to each side of 0")
    band_percent: Share | None = described(
        None, "%", "the same, over the largest value after the reference trajectory without control"
    )
    links: OneALink[bool] | None = described(
        None, "-", "under control; default: those of the study"
    )


class FiguresEntry(Common, NoiseEntry):
    """Metrics of the study's motion, or their reduction by control."""

    values: dict[str, float] = described(
        ..., "-", "metric = value, in its unit or in percent", min_length=1
    )
    of: Literal["controlled", "uncontrolled", "reduction"] = described(
        "controlled", "-", "with control, without, or percent less with it"
    )
    amplitude: bool = described(
        False, "-", "of the square root of the metric: an amplitude where it is a power"
    )
    take: Literal["rms", "largest"] = described("rms", "-", "of several entries of a metric")
    modes: int | None = described(
        None, "1", "controlled modes; default: those of the study", ge=1, le=12
    )
    links: OneALink[bool] | None = described(
        None, "-", "under control; default: those of the study"
    )


#: Fields of each kind.
ENTRIES: dict[str, type[Common]] = {
    "modes": ModesEntry,
    "response": ResponseEntry,
    "record": RecordEntry,
    "decay": DecayEntry,
    "spectrum": SpectrumEntry,
    "trace": TraceEntry,
    "settling": SettlingEntry,
    "figures": FiguresEntry,
}


#: What is measured without an input.
MODES = "modes"
#: What a next experiment is made with if nothing is said.
USUAL = ("actuator", "slider", "hammer"), (MODES, "sensor", "deflection")


class Next(Section):
    """What the next experiment can be made with."""

    inputs: tuple[str, ...] = described(
        USUAL[0], "-", "kinds of inputs, as 'hammer', or single ones", min_length=1
    )
    outputs: tuple[str, ...] = described(
        USUAL[1], "-", "the same of outputs; 'modes': their frequencies and damping", min_length=1
    )
    sigma_percent: Percent = described(2.0, "%", "noise of a response over its value")
    floor_percent: Percent = described(0.2, "%", "noise over the largest value of a response")
    count: int = described(1, "1", "measurements that are taken at once", ge=1, le=10)


class Fit(Section):
    """What is free, and what was measured."""

    free: dict[str, Any] = described(..., "-", "field = {from, to, scale, mean, sigma}")
    data: tuple[dict[str, Any], ...] = described(..., "-", "measurements", min_length=1)
    loss: Literal["squares", "robust"] = described(
        "squares", "-", "of residuals; robust: outliers pull less"
    )
    starts: int = described(32, "1", "starting points; the first is the study", ge=1, le=10_000)
    refine: int = described(
        4,
        "1",
        "best of them that are followed; of exchanged links twice as many",
        ge=1,
        le=100,
    )
    iterations: int = described(60, "1", "evaluations from each", ge=1, le=10_000)
    profile: bool = described(True, "-", "profile the likelihood of up to six parameters")
    samples: int = described(
        0, "1", "posterior samples, with the extra 'posterior'; 0: none", ge=0, le=10**6
    )
    seed: int = described(0, "1", "of the starting points and samples", ge=0, le=10**9)
    next: Next = Next()


def own_signal(study: Study, name: str, end: str) -> Signal | None:
    """A single signal of the next experiment; None: all of a kind.

    Args:
        study: of the machine.
        name: as the file has it.
        end: `inputs` or `outputs`.

    Raises:
        StudyError: there is no such signal or kind.
    """
    kinds = {"inputs": INPUTS, "outputs": OUTPUTS}[end]
    if " " in name:
        n_patches, length = patch_centers(study).shape[1], study.each_link(study.link.length)
        return parse_signal(name, kinds, n_patches, length, f"fit.next.{end}")
    allowed = [
        *kinds,
        *([MODES] if end == "outputs" else []),
        *(form for form, _ in kinds.values()),
    ]
    if name not in allowed:
        raise field_error(f"fit.next.{end}", name, ", ".join(allowed), hint=nearest(name, allowed))
    return None


class Prior(NamedTuple):
    """What is known of a parameter beforehand: mean and standard deviation."""

    number: int  # among the free ones
    mean: float
    sigma: float


class FitSpec(NamedTuple):
    """A fit as requested."""

    study: Study  # the starting point
    fit: Fit
    free: FreeNumbers
    priors: tuple[Prior, ...]
    entries: tuple[Common, ...]
    folder: Path  # where the files of the data are
    data: dict[str, Any]  # as read, for the record

    def data_files(self) -> dict[str, str]:
        """Digests of the files with the measured data, by name; "" of those that are not there."""
        names = {
            entry.file.partition("::")[0] for entry in self.entries if isinstance(entry, FileEntry)
        }
        paths = {name: self.folder / name for name in sorted(names)}
        return {
            name: hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else ""
            for name, path in paths.items()
        }


def load_fit(path: str | Path) -> FitSpec:
    """Read a file of a fit, or the ready-made one of that name.

    Raises:
        StudyError: unreadable, not TOML, or not a valid fit.
    """
    data = read_toml(path)
    # the file of a commissioning has a fit; what follows it is not read here
    read = {name: value for name, value in data.items() if name not in ("tune", "commission")}
    return parse_fit(read if "commission" in data else data, find_spec(path).parent)


def parse_fit(data: dict[str, Any], folder: str | Path = ".") -> FitSpec:
    """Validate a dictionary as a fit.

    Args:
        data: sections of a study and `fit`.
        folder: where the files of the data are.

    Raises:
        StudyError: first fault found, with field, value, allowed range and unit.
    """
    if "fit" not in data:
        raise StudyError("fit: missing; a fit is a study file with a section [fit]")
    study = parse_study({name: value for name, value in data.items() if name != "fit"})
    sizes = lengths(study.mechanism)
    try:
        fit = Fit.model_validate(as_tuples(data["fit"]), context=sizes)
    except ValidationError as error:
        raise explain(error, Fit, data["fit"], "fit", sizes) from None
    if any(written.get("kind") in MOTIONS for written in fit.data):
        study = with_window(study)
        check_run(study)
    else:
        check_machine(study)
    if 0 < fit.samples < FEWEST_SAMPLES:
        raise field_error("fit.samples", fit.samples, f"0, or {FEWEST_SAMPLES} to 1000000")
    free, priors = _free(fit, study)
    entries = tuple(_entry(written, k, study) for k, written in enumerate(fit.data))
    if all(entry.check for entry in entries):
        raise StudyError("fit.data: every entry is held out by check = true; leave one or more in")
    return FitSpec(
        study=study,
        fit=fit,
        free=free,
        priors=priors,
        entries=entries,
        folder=Path(folder),
        data=data,
    )


def _free(fit: Fit, study: Study) -> tuple[FreeNumbers, tuple[Prior, ...]]:
    if not fit.free:
        raise field_error("fit.free", {}, "one free field or more")
    parts, priors = [], []
    for name, written in fit.free.items():
        path = f"fit.free.{shown_name(name)}"
        prior = {}
        if isinstance(written, dict):
            known_keys = ("from", "to", "scale", "mean", "sigma")
            for key in set(written) - set(known_keys):
                hint = nearest(key, known_keys)
                raise field_error(f"{path}.{key}", written[key], ", ".join(known_keys), hint=hint)
            prior = {k: written[k] for k in ("mean", "sigma") if k in written}
            written = {k: v for k, v in written.items() if k not in prior}
        parts.append(plain_numbers(name, written, study, path, (DESIGN, MACHINE)))
        priors += [(prior, path)] * len(parts[-1][0])
    free = join_numbers(parts)
    check_twice(free.numbers, "fit.free")
    return free, tuple(
        _prior(prior, k, path, free.numbers[k].span)
        for k, (prior, path) in enumerate(priors)
        if prior
    )


def number_unit(name: str) -> str:
    """Unit of a parameter, "1" for none."""
    entry = parse_entry(name)
    assert entry is not None
    return field_unit(entry.field)


def shown_unit(name: str) -> tuple[float, str]:
    """Factor and unit in which a parameter is shown: GPa for Pa; "" for none."""
    unit = number_unit(name)
    return readable(unit) if unit == "Pa" else (1.0, "" if unit == "1" else unit)


def named_unit(name: str) -> str:
    """A parameter and its unit as heads and axes have them."""
    return headed(name, shown_unit(name)[1])


def shown_value(name: str, value: float, digits: str = ".4g") -> str:
    """A value of a parameter as it is shown, with its unit."""
    factor, unit = shown_unit(name)
    return f"{factor * value:{digits}} {unit}".rstrip()


def _prior(written: dict[str, Any], k: int, path: str, span: Range) -> Prior:
    for name in ("mean", "sigma"):
        value = written.get(name)
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < 1e150:
            raise field_error(f"{path}.{name}", value, "a finite number, beside mean or sigma")
    mean, least = written["mean"], 1e-9 * (span.high - span.low)
    if not span.low <= mean <= span.high:
        raise field_error(f"{path}.mean", mean, f"{span.low:g} to {span.high:g}, its bounds")
    if written["sigma"] < least:
        raise field_error(f"{path}.sigma", written["sigma"], f"{least:g} or more")
    return Prior(k, float(written["mean"]), float(written["sigma"]))


def _entry(written: dict[str, Any], k: int, study: Study) -> Common:
    path = f"fit.data[{k}]"
    kind = written.get("kind")
    if not isinstance(kind, str) or kind not in ENTRIES:
        hint = nearest(kind, ENTRIES) if isinstance(kind, str) else ""
        raise field_error(f"{path}.kind", kind, ", ".join(ENTRIES), hint=hint)
    model, sizes = ENTRIES[kind], lengths(study.mechanism)
    try:
        entry = model.model_validate(as_tuples(written), context=sizes)
    except ValidationError as error:
        raise explain(error, model, written, path, sizes) from None
    is_bare = isinstance(entry, NoiseEntry) and entry.sigma is None and entry.sigma_percent is None
    if is_bare:
        raise StudyError(
            f"{path}: sigma or sigma_percent is missing; without it the data say nothing about "
            "uncertainty"
        )
    return entry if entry.name else entry.model_copy(update={"name": f"{kind} {k + 1}"})
