"""From the entries of a file to measurements with their data."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from studies.fitting.bench import Bench
from studies.fitting.bench import Pose as At
from studies.fitting.entries.common import Models, check_drive, pose_of, signals_of
from studies.fitting.entries.linear import (
    make_decay,
    make_modes,
    make_record,
    make_response,
    make_spectrum,
)
from studies.fitting.entries.motions import make_figures, make_settling, make_trace
from studies.fitting.experiment import check_candidates
from studies.fitting.kinds.contract import Measurement
from studies.fitting.kinds.figures import Runs
from studies.fitting.kinds.motions import Motions
from studies.fitting.spec import (
    Common,
    DecayEntry,
    FiguresEntry,
    FitSpec,
    ModesEntry,
    PoseEntry,
    RecordEntry,
    ResponseEntry,
    SettlingEntry,
    ShakenEntry,
    SpectrumEntry,
    TraceEntry,
    own_signal,
)


def make_bench(spec: FitSpec) -> Bench:
    """Linear machine at the poses of all entries."""
    poses: dict[At, str] = {}
    for k, entry in enumerate(spec.entries):
        is_held = isinstance(entry, ModesEntry) and entry.ends == "held"
        if isinstance(entry, PoseEntry) and not is_held:
            poses.setdefault(pose_of(spec, entry), f"fit.data[{k}].pose")
    places = tuple(sorted({*_places(spec, (ShakenEntry, DecayEntry)), *_own_places(spec)}))
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


def _places(spec: FitSpec, kinds: tuple[type[Common], ...]) -> tuple[float, ...]:
    """Where along the links hammers and deflections of some kinds of entries are [m], ascending."""
    places = {
        signal.place
        for k, entry in enumerate(spec.entries)
        if isinstance(entry, kinds)
        for signal in signals_of(spec, entry, f"fit.data[{k}]")
    }
    return tuple(sorted(x for x in places if not np.isnan(x)))


def _own_places(spec: FitSpec) -> list[float]:
    """Where the instruments of the next experiment are [m]."""
    own = spec.fit.next
    for name in (*own.inputs, *own.outputs):
        check_drive(spec, {name.partition(" ")[0]}, f"fit.next: {name}:")
    names = [(x, "inputs") for x in own.inputs] + [(x, "outputs") for x in own.outputs]
    signals = [own_signal(spec.study, *name) for name in names]
    return [x.place for x in signals if x is not None and not np.isnan(x.place)]


_MAKERS: dict[type[Common], Callable[..., Measurement]] = {
    ModesEntry: make_modes,
    ResponseEntry: make_response,
    DecayEntry: make_decay,
    RecordEntry: make_record,
    SpectrumEntry: make_spectrum,
    TraceEntry: make_trace,
    SettlingEntry: make_settling,
    FiguresEntry: make_figures,
}


def guess(spec: FitSpec) -> np.ndarray:
    """The study's values of the parameters, (p,)."""
    return np.array([number.start for number in spec.free.numbers])
