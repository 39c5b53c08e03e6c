"""What is compared: each control law on the design's drive, each drive with its law.

Each has its own few numbers: the loop gain, the law's or drive's parameters, and those of the
study's common settings that its controller depends on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw, drive_gains
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law
from jaxmodel.parameters import Array
from jaxmodel.prepare import design_controller
from jaxmodel.table import Parameter
from studies.engine.controller import fixed_controller
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.space.free import numbers_in
from studies.study.paths import known_field, set_value, set_values
from studies.study.spec import Study, parse_study

#: Numbers are searched within this factor of their start, parameters inside their allowed range;
#: those of drives, whose starts are stable, within a smaller one.
REACH, SERVO = 100.0, 5.0
#: Of the design's law, a candidate that keeps the design's ratios (24).
AS_GIVEN = "ratios as given"
GAIN, RATIOS = "control.gain_factor", "control.ratios"
#: What laws are tuned for, and drives, which also have to follow the reference.
OF_LAWS = {"residual_rms": 1.0}
OF_DRIVES = {"residual_rms": 1.0, "pose_error_peak[0]": 0.5, "pose_error_peak[1]": 0.5}
#: Settings that several laws share, and where they are searched.
SHARED: dict[str, dict[str, Any]] = {
    RATIOS: {"from": 0.0, "to": 3.0},
    "electronics.highpass_hz": {"from": 5.0, "to": 200.0, "scale": "log"},
    "electronics.lowpass_ratio": {"from": 0.5, "to": 10.0, "scale": "log"},
}
#: How much a setting is changed to see whether a controller depends on it [1].
NUDGE = 1.01


class Contender(NamedTuple):
    """A law or a drive, and the numbers it is tuned by."""

    name: str  # in tables
    settings: dict[str, Any]  # fields of the study that it sets
    free: dict[str, dict[str, Any]]  # ranges by field, as in `[tune.free]`
    objective: dict[str, float]  # as in `[tune.objective]`
    is_drive: bool = False

    def study(self, study: Study) -> Study:
        """The design with this candidate in place of its own."""
        return parse_study(set_values(study, self.settings))


def law_candidates(study: Study) -> list[Contender]:
    """All laws for which a study needs no matrices of its own, the design's law among them.

    Gains of modes also with the ratios (24) of the design, where they are all free otherwise.

    Args:
        study: the design, with sampled feedback.
    """
    found = []
    for name, law in LAWS.items():
        if name != study.control.law and name == "state_space":
            continue
        one = law_candidate(study, law)
        found.append(one)
        fixed = {field: x for field, x in one.free.items() if not field.startswith(RATIOS)}
        if len(fixed) < len(one.free) and name == study.control.law:
            found.append(one._replace(name=f"{law.text}, {AS_GIVEN}", free=fixed))
    return found


def law_candidate(study: Study, law: Law) -> Contender:
    """A law on a study's machine, and the numbers that its controller depends on.

    Args:
        study: the design, with sampled feedback.
        law: which one.
    """
    settings: dict[str, Any] = {}
    if study.control.has_poles and not law.places_poles:  # first: without them any law is valid
        settings = {"control.damping": (), "control.pole_decay": ()}
    settings["control.law"] = law.name
    plain = Contender(law.text, settings, {}, OF_LAWS)
    own = plain.study(study)
    if law.channel == "patch" and law.name != study.control.law:  # its gains have another unit
        gains = np.array(study.control.velocity_gain) / _strength(*check_run(own))
        settings["control.velocity_gain"] = tuple(gains.tolist())
        own = plain.study(study)
    free = {GAIN: around(own.control.gain_factor)}
    shared = {name: bounds for field, bounds in SHARED.items() for name in _entries(own, field)}
    free |= {name: shared[name] for name in _decisive(own, shared, _of_controller)}
    free |= {f"control.laws.{law.name}.{x.name}": parameter_range(x) for x in law.parameters}
    return plain._replace(free=free)


def drive_candidates(study: Study) -> list[Contender]:
    """All drives, the design's among them.

    Args:
        study: the design.
    """
    return [_drive_candidate(study, law) for law in DRIVES.values()]


def _drive_candidate(study: Study, law: DriveLaw) -> Contender:
    settings = {"drive.kind": law.name}
    name = law.text.removeprefix("computed torque with ").removeprefix("PD with ")
    plain = Contender(name, settings, {}, OF_DRIVES, is_drive=True)
    own = plain.study(study)
    gains = {"drive.kp": own.drive.kp, "drive.kd": own.drive.kd}
    free = {name: around(gains[name], share=SERVO) for name in _decisive(own, gains, _of_drive)}
    for x in law.parameters:
        free[f"drive.kinds.{law.name}.{x.name}"] = parameter_range(x, SERVO)
    return plain._replace(free=free)


def around(
    start: float, low: float = 0.0, high: float = np.inf, share: float = REACH
) -> dict[str, Any]:
    """The range within a factor `share` of a positive start, inside what is allowed."""
    return {"from": max(start / share, low), "to": min(start * share, high), "scale": "log"}


def parameter_range(parameter: Parameter, share: float = REACH) -> dict[str, Any]:
    """Where a parameter of a law or drive is searched."""
    if parameter.default <= 0:
        return {"from": parameter.low, "to": parameter.high}
    return around(parameter.default, parameter.low, parameter.high, share)


@kept_jit(static_argnums=0)
def _strength(structure: Structure, case: Case) -> Array:
    """Damping of mode 1 of each link by a law's velocity gains of 1 [N s/m], (3,)."""
    design = design_controller(structure, case, find_bases(structure, case))
    law, nominal = design.controller.feedback, design.nominal
    assert isinstance(law, Channels)
    drives = jnp.einsum("ik,ikc->ic", nominal.actuator[:, 0], law.synthesizer)
    sees = jnp.einsum("ick,ik->ic", law.filter, nominal.sensor[:, :, 0])
    return jnp.sum(drives * sees, axis=1)


def _entries(study: Study, field: str) -> list[str]:
    """Names of the numbers in a field, which may be a list."""
    numbers = numbers_in(known_field(field, study, "laws"))
    return [field + "".join(f"[{k}]" for k in indices) for indices, _ in numbers]


def _decisive(
    study: Study, names: Iterable[str], numbers: Callable[[Study], list[Any]]
) -> list[str]:
    """Settings that change some numbers of a study; none of a study that has no such numbers."""
    try:
        before = numbers(study)
    except StudyError:  # its tuning says why
        return []

    def decides(name: str) -> bool:
        value = NUDGE * known_field(name, study, "laws")
        try:
            after = numbers(parse_study(set_value(study, name, value)))
        except StudyError:
            return False
        pairs = zip(before, after, strict=True)
        return any(not np.array_equal(a, b, equal_nan=True) for a, b in pairs)

    return [name for name in names if decides(name)]


def _of_controller(study: Study) -> list[Any]:
    return jax.tree.leaves(fixed_controller(study).controller)


def _of_drive(study: Study) -> list[Any]:
    structure, case = check_run(study)
    return list(drive_gains(DRIVES[structure.drive], case.drive))
