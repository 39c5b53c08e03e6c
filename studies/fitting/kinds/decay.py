"""Raw records of a machine that rings, or that chance shakes: their modes."""

from __future__ import annotations

from typing import Literal

import numpy as np

from studies.errors import StudyError, field_error
from studies.fitting.decays import DecaySettings, decay_modes
from studies.fitting.kinds.contract import Measurement, Models
from studies.fitting.kinds.entry import (
    GIVEN,
    ORDERS,
    FileEntry,
    Percent,
    PoseEntry,
    Quantity,
    signal_sizes,
)
from studies.fitting.kinds.modes import MachineModes, Measured, Seen
from studies.study.signals import OUTPUTS, Signal, parse_signal
from studies.study.spec import Study, described


class DecayEntry(FileEntry, PoseEntry):
    """Raw time records of a machine that rings or moves by chance, which become its modes."""

    outputs: tuple[str, ...] = described(
        ..., "-", "what is measured; several pair the modes by their shapes", min_length=1
    )
    time: str = described("time", "-", "column [s], evenly spaced")
    values: tuple[str, ...] = described((), "-", "columns; default: named as the outputs")
    quantity: Quantity = described(
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

    def signals(self, study: Study, path: str) -> tuple[Signal, ...]:
        moving = {x: form for x, form in OUTPUTS.items() if x != "motor"}
        sizes = signal_sizes(study)
        return tuple(
            parse_signal(x, moving, *sizes, f"{path}.outputs[{j}]")
            for j, x in enumerate(self.outputs)
        )

    def measurement(self, models: Models, path: str) -> Measurement:
        read, signals = self.reader(models, path), self.signals(models.study, path)
        columns = self.values or self.outputs
        if len(columns) != len(signals):
            allowed = f"{len(signals)} columns, one of each output"
            raise field_error(f"{path}.values", columns, allowed)
        if len(set(signals)) < len(signals):
            raise field_error(f"{path}.outputs", self.outputs, "each output once")
        if len({*columns, self.time}) <= len(columns):
            allowed = "each column once, without that of the time"
            raise field_error(f"{path}.values", columns, allowed)
        if "quantity" in self.model_fields_set and all(x.kind in GIVEN for x in signals):
            text = f"has no meaning for {self.outputs[0]!r}; leave it out"
            raise StudyError(f"{path}.quantity: {text}")
        time, *recorded = map(read, (self.time, *columns))
        settings = DecaySettings(
            segment=self.segment_s,
            is_ambient=self.excitation == "ambient",
            band=(self.from_hz, self.to_hz),
        )
        found = decay_modes(time, np.column_stack(recorded), settings, path)
        share = self.sigma_percent / 100  # of a pole's size, to any side
        measured = Measured(
            frequency=found.frequency,
            sigma=np.hypot(found.sigma, share * found.frequency),
            damping=found.damping,
            damping_sigma=np.hypot(found.damping_sigma, share),
            shapes=found.shapes if len(signals) > 1 else None,
        )
        seen = Seen(signals, tuple(GIVEN.get(x.kind, ORDERS[self.quantity]) for x in signals))
        pose = self.at(models.study)
        return MachineModes(self, models.bench, measured, pose, seen, found.diagram)
