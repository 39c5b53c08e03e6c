"""The file of a fit: a study, the starting point, plus `[fit]`: what is free and was measured.

Each entry of `[[fit.data]]` is a measurement of some kind with its own noise level. Numbers are in
SI units unless their names say otherwise.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any, Literal, NamedTuple

from studies.engine.preflight import check_machine, check_run
from studies.errors import StudyError, field_error, nearest, shown_name
from studies.fitting.kinds.contract import DataEntry
from studies.fitting.kinds.decay import DecayEntry
from studies.fitting.kinds.entry import FileEntry, NoiseEntry, Percent, signal_sizes
from studies.fitting.kinds.figures import FiguresEntry
from studies.fitting.kinds.modes import ModesEntry
from studies.fitting.kinds.response import RecordEntry, ResponseEntry
from studies.fitting.kinds.settling import SettlingEntry
from studies.fitting.kinds.spectrum import SpectrumEntry
from studies.fitting.kinds.trace import TraceEntry
from studies.show.units import headed, readable
from studies.space.axes import Finite, Range, WrittenRange
from studies.space.free import (
    Free,
    FreeNumbers,
    Place,
    check_twice,
    join_numbers,
    plain_numbers,
)
from studies.study.files import find_spec, read_toml
from studies.study.paths import field_unit, parse_entry, parse_section
from studies.study.signals import INPUTS, OUTPUTS, Signal, parse_signal
from studies.study.sizes import lengths
from studies.study.spec import (
    DESIGN,
    MACHINE,
    Section,
    Study,
    described,
    parse_study,
)
from studies.study.window import with_window

#: Kinds of measurements that take a run of the whole motion.
MOTIONS = ("trace", "settling", "figures")
#: Fewer samples say nothing.
FEWEST_SAMPLES = 20
#: What each kind's entry holds, and how it becomes a measurement.
ENTRIES: dict[str, type[DataEntry]] = {
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


class WrittenPrior(WrittenRange):
    """Bounds of a parameter, and what is known of it beforehand."""

    mean: Finite | None = described(None, "", "most likely value, beside sigma")
    sigma: Finite | None = described(None, "", "its standard deviation")


class Fit(Section):
    """What is free, and what was measured."""

    free: dict[str, object] = described(..., "-", "field = {from, to, scale, mean, sigma}")
    data: tuple[dict[str, object], ...] = described(..., "-", "measurements", min_length=1)
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
        return parse_signal(name, kinds, *signal_sizes(study), f"fit.next.{end}")
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
    entries: tuple[DataEntry, ...]
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
    fit = parse_section(Fit, data["fit"], "fit", sizes)
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
    parts, priors = list[tuple[list[Free], Place]](), list[Prior]()
    for name, written in fit.free.items():
        path = f"fit.free.{shown_name(name)}"
        first, roles = sum(len(numbers) for numbers, _ in parts), (DESIGN, MACHINE)
        numbers, place = plain_numbers(name, written, study, path, roles, form=WrittenPrior)
        parts.append((numbers, place))
        known = _prior(parse_section(WrittenPrior, written, path), numbers[0].span, path)
        priors += [Prior(first + k, *known) for k in range(len(numbers)) if known]
    free = join_numbers(parts)
    check_twice(free.numbers, "fit.free")
    return free, tuple(priors)


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


def _prior(known: WrittenPrior, span: Range, path: str) -> tuple[float, float] | None:
    """Mean and standard deviation of what is known of a number beforehand."""
    if (known.mean, known.sigma) == (None, None):
        return None
    if known.mean is None or known.sigma is None:
        missing = "mean" if known.mean is None else "sigma"
        raise StudyError(f"{path}.{missing}: missing; allowed: mean and sigma, or none of them")
    if not span.low <= known.mean <= span.high:
        raise field_error(f"{path}.mean", known.mean, f"{span.low:g} to {span.high:g}, its bounds")
    if known.sigma < (least := 1e-9 * (span.high - span.low)):
        raise field_error(f"{path}.sigma", known.sigma, f"{least:g} or more")
    return known.mean, known.sigma


def _entry(written: dict[str, object], k: int, study: Study) -> DataEntry:
    path = f"fit.data[{k}]"
    kind = written.get("kind")
    if not isinstance(kind, str) or kind not in ENTRIES:
        hint = nearest(kind, ENTRIES) if isinstance(kind, str) else ""
        raise field_error(f"{path}.kind", kind, ", ".join(ENTRIES), hint=hint)
    model, sizes = ENTRIES[kind], lengths(study.mechanism)
    entry = parse_section(model, written, path, sizes)
    is_bare = isinstance(entry, NoiseEntry) and entry.sigma is None and entry.sigma_percent is None
    if is_bare:
        raise StudyError(
            f"{path}: sigma or sigma_percent is missing; without it the data say nothing about "
            "uncertainty"
        )
    if isinstance(entry, ModesEntry) and entry.link > study.n_links:
        raise field_error(f"{path}.link", entry.link, f"1 to {study.n_links}", "1")
    return entry if entry.name else entry.model_copy(update={"name": f"{kind} {k + 1}"})
