"""Machines as they may be: which of their numbers nobody knows exactly, and by how much.

The one place for such figures: what breaks a design, which machines laws are tuned and judged on,
what certificates and proofs allow for. Tunings and sweeps may name others.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import product
from typing import NamedTuple

import numpy as np

from jaxmodel.changes import MachineChange
from studies.errors import StudyError, field_error, nearest
from studies.study.paths import known_field
from studies.study.spec import Study


class Uncertain(NamedTuple):
    """A number of the machine."""

    field: str
    unit: str  # of the tolerance; "1": of the natural logarithm of a factor
    tolerance: float | None  # how far it may well be off as built; None: no such change is sought
    why: str = ""
    percent: float = 0.0  # by which it differs at most among machines that laws are judged on
    proven: tuple[float, float] | None = None  # between which proofs hold


UNCERTAIN = {
    "stiffness": Uncertain(
        field="link.stiffness_factor",
        unit="1",
        tolerance=0.05,
        why="thickness within 1.7 %",
        percent=5.0,
        proven=(0.95, 1.05),
    ),
    "damping": Uncertain("link.damping_ratio", "1", 0.2, "seldom known better"),
    "platform_mass": Uncertain("machine.platform_mass", "kg", None, percent=20.0),
    "payload": Uncertain("load.mass", "kg", 0.02, percent=20.0, proven=(0.0, 0.1)),
    "joint_inertia_b": Uncertain("link.joint_inertia_b", "kg m2", None, percent=20.0),
    "joint_inertia": Uncertain("link.joint_inertia_c", "kg m2", 1e-6, percent=20.0),
    "patch": Uncertain("patches.centers", "m", 1e-3, "glued by hand"),
    "delay": Uncertain("electronics.unmodelled_delay", "samples", 0.25, proven=(0.0, 1.0)),
    "actuator": Uncertain("patches.actuator_factor", "1", 0.05, "d31 of one batch"),
    "sensor": Uncertain("patches.sensor_factor", "1", 0.05, "d31 of one batch"),
}
#: One unit of each kind of change, and its unit.
TOLERANCES = MachineChange(**{x: UNCERTAIN[x].tolerance for x in MachineChange._fields})
UNITS = MachineChange(**{x: UNCERTAIN[x].unit for x in MachineChange._fields})
#: Fields that differ among machines that laws are judged on, by so many percent at most.
SPREAD = {x.field: x.percent for x in UNCERTAIN.values() if x.percent}
#: Ranges of proofs: factor on the links' stiffness [1], extra delay [samples], payload beyond the
#: study's [kg].
BOX = tuple(UNCERTAIN[x].proven or (0.0, 0.0) for x in ("stiffness", "delay", "payload"))


class ModelMismatch(NamedTuple):
    """How a plant departs from the controller's model."""

    sensor: float = 1.0  # true sensor length over the one in the controller's model [1]
    actuator: float = 1.0  # the same for actuators [1]
    frequency: float = 1.0  # true frequencies of the bare links over those of the study [1]
    joint_inertia: float | None = None  # true J_C [kg m2]; None: the study's

    def __str__(self) -> str:
        words = []
        if (self.sensor, self.actuator) != (1, 1):
            words.append(f"sensors x {self.sensor:g}, actuators x {self.actuator:g}")
        if self.frequency != 1:
            words.append(f"frequencies x {self.frequency:g}")
        if self.joint_inertia is not None:
            words.append(f"J_C = {self.joint_inertia:g} kg m2")
        return ", ".join(words) or "as modelled"


def patch_lengths(lengths: tuple[float, ...]) -> tuple[ModelMismatch, ...]:
    """Sensors and actuators with these lengths relative to the model's [1]."""
    return tuple(ModelMismatch(*pair) for pair in product(lengths, repeat=2))


#: Mismatches of certificates: patches, the links' stiffness, the joints (none, and as measured).
MISMATCHES = (
    *patch_lengths((0.8, 1.0, 1.25)),
    ModelMismatch(frequency=0.9),
    ModelMismatch(frequency=1.1),
    ModelMismatch(joint_inertia=0.0),
    ModelMismatch(joint_inertia=1.1e-5),
)


def drawn_machines(
    study: Study, spread: Mapping[str, float], count: int, seed: int
) -> dict[str, np.ndarray]:
    """Numbers of machines that differ, by Latin hypercube: columns by field, (count, ...).

    Args:
        study: the nominal machine.
        spread: field, or entry of one, and by how many percent it differs at most.
        count: machines.
        seed: of the draw.
    """
    from scipy.stats import qmc

    shift = 2 * qmc.LatinHypercube(len(spread), rng=seed).random(count) - 1
    return {
        name: np.multiply.outer(1 + percent / 100 * shift[:, k], known_field(name, study))
        for k, (name, percent) in enumerate(spread.items())
    }


def parse_tolerances(given: Mapping[str, float | str] | None) -> MachineChange:
    """`TOLERANCES` with others by their names; 0: this number does not change.

    Raises:
        StudyError: unknown name, or no number from 0.
    """
    tolerances = TOLERANCES
    for name, value in (given or {}).items():
        if name not in MachineChange._fields:
            allowed = f"{', '.join(MachineChange._fields)}, each as NAME=VALUE"
            hint = nearest(name, MachineChange._fields)
            raise field_error("--tolerance", name, allowed, hint=hint)
        try:
            number = float(value)
        except (TypeError, ValueError, OverflowError):
            number = np.nan
        if not 0 <= number < np.inf:
            unit = getattr(UNITS, name)
            raise field_error(f"--tolerance {name}", value, "a number from 0", unit)
        tolerances = tolerances._replace(**{name: number})
    if not any(tolerances):
        raise StudyError("--tolerance: all are 0; allowed: at least one number that may change")
    return tolerances
