"""From the entries of a file to measurements with their data."""

from __future__ import annotations

import numpy as np

from studies.fitting.bench import Bench
from studies.fitting.experiment import check_candidates
from studies.fitting.kinds.contract import Measurement, Models
from studies.fitting.kinds.entry import PoseEntry, check_drive
from studies.fitting.kinds.modes import ModesEntry
from studies.fitting.kinds.motions import Motions
from studies.fitting.kinds.runs import Runs
from studies.fitting.spec import MOTIONS, FitSpec, own_signal


def make_bench(spec: FitSpec) -> Bench:
    """Linear machine at the poses of all entries."""
    poses: dict[tuple[float, ...], str] = {}
    for k, entry in enumerate(spec.entries):
        is_held = isinstance(entry, ModesEntry) and entry.ends == "held"
        if isinstance(entry, PoseEntry) and not is_held:
            poses.setdefault(entry.at(spec.study), f"fit.data[{k}].pose")
    places = tuple(sorted({*_places(spec, False), *_own_places(spec)}))
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
    motions = Motions(*inputs, _places(spec, True), moving)
    models = Models(
        study=spec.study,
        folder=spec.folder,
        bench=bench,
        runs=Runs(*inputs, moving),
        motions=motions,
    )
    return [x.measurement(models, f"fit.data[{k}]") for k, x in enumerate(spec.entries)]


def _places(spec: FitSpec, of_motions: bool) -> tuple[float, ...]:
    """Where along the links hammers and deflections of entries are [m], ascending."""
    places = {
        signal.place
        for k, entry in enumerate(spec.entries)
        if (entry.kind in MOTIONS) == of_motions
        for signal in entry.signals(spec.study, f"fit.data[{k}]")
    }
    return tuple(sorted(x for x in places if not np.isnan(x)))


def _own_places(spec: FitSpec) -> list[float]:
    """Where the instruments of the next experiment are [m]."""
    own = spec.fit.next
    for name in (*own.inputs, *own.outputs):
        check_drive(spec.study, {name.partition(" ")[0]}, f"fit.next: {name}:")
    names = [(x, "inputs") for x in own.inputs] + [(x, "outputs") for x in own.outputs]
    signals = [own_signal(spec.study, *name) for name in names]
    return [x.place for x in signals if x is not None and not np.isnan(x.place)]


def guess(spec: FitSpec) -> np.ndarray:
    """The study's values of the parameters, (p,)."""
    return np.array([number.start for number in spec.free.numbers])
