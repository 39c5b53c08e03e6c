"""A closed-loop run with every number given, the paper's, and the same with other numbers.

Numbers are called by their place in `Case`: "control.gain_factor", "machine.beam.length".
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from functools import partial
from typing import Any

import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import (
    Case,
    Control,
    Drive,
    Electronics,
    Initial,
    Load,
    Shaping,
    Structure,
    Windows,
)
from jaxmodel.drives import DRIVES
from jaxmodel.estimator import KINDS
from jaxmodel.laws import LAWS
from jaxmodel.lazy import jax, jnp
from jaxmodel.mechanisms.prrr.paper import HOME, paper_machine
from jaxmodel.motion import PROFILES, Path
from jaxmodel.parameters import Array
from jaxmodel.shaper import SHAPERS
from jaxmodel.table import PartError

#: Numbers that the program leaves out where they are 0 or None, or of value `NEUTRAL`: what of the
#: structure has them.
SWITCHES = {
    "has_wrench": ("load.wrench", "load.pulse"),
    "has_payload_offset": ("machine.masses.payload_offset",),
    "has_sensor_highpass": ("electronics.sensor_highpass",),
    "has_amplifier": ("electronics.amplifier_lag",),
    "has_delay": ("electronics.delay", "electronics.unmodelled_delay"),
    "has_notch": ("control.notch",),
    "has_hysteresis": ("machine.patches.hysteresis",),
    "has_noise": ("electronics.adc_noise", "drive.ripple", "machine.patches.gauge_noise"),
    "has_friction": ("drive.coulomb_friction",),
    "has_joint_friction": ("machine.joint_friction",),
    "has_drive_lag": ("drive.lag",),
    "has_poles": ("control.damping", "control.pole_decay"),
    "has_position_gain": ("control.position_gain", "control.damping", "control.pole_decay"),
}
NEUTRAL = {"electronics.delay": 1.0, "control.damping": -1.0}
#: Choices by name, which a case holds as positions.
NAMED: dict[str, Iterable[str]] = {
    "shaping.kind": SHAPERS,
    "path.profile": PROFILES,
    "electronics.estimator": KINDS,
}
#: The same of choices that a structure holds by name.
CHOICES: dict[str, Iterable[str]] = {
    "law": LAWS,
    "drive": DRIVES,
    "basis": BASES,
    "controller_basis": BASES,
    "feedback": ("sampled", "ideal", "none"),
}
#: Numbers that can have more or fewer entries along their first or last axis.
_LISTS = ("path.", "shaping.omega", "shaping.zeta", "machine.damping", "windows.stations")
#: Unit, smallest and largest value of numbers, others any; so wide that wrong units stand out.
RANGES: dict[str, tuple[str, float, float]] = {
    name: (unit, low, high)
    for unit, low, high, names in (
        ("m", 1e-3, 10.0, "beam.length beam.width patches.sensor_length patches.actuator_length"),
        ("m", 1e-5, 1.0, "beam.thickness patches.thickness patches.width"),
        ("m", 0.0, 10.0, "patches.center"),
        ("kg/m3", 10.0, 1e5, "beam.density patches.density"),
        ("Pa", 1e6, 1e13, "beam.youngs_modulus patches.youngs_modulus"),
        ("kg", 1e-3, 1e3, "masses.platform_mass masses.slider_mass"),
        ("kg", 0.0, 1e3, "masses.payload_mass"),
        ("1", 0.0, 1.0, "damping.ratio"),
        ("1", 0.01, 100.0, "beam.stiffness_factor"),
        ("s", 1e-4, 100.0, "path.move_time"),
        ("s", 0.0, 100.0, "path.dwell load.pulse_start load.pulse_length"),
        ("s", 1e-6, 0.01, "electronics.period"),
        ("s", 0.0, 0.1, "drive.lag electronics.amplifier_lag"),
        ("rad/s", 0.0, 1e6, "shaping.omega control.omega control.notch control.pole_frequency"),
        ("rad/s", 60.0, 1e7, "electronics.antialias"),
        ("1", 0.0, 0.9, "shaping.zeta"),
        ("1", 0.0, 1e3, "control.gain_factor"),
        ("1", 0.0, 1.0, "control.link_mask control.mode_mask shaping.tolerance"),
        ("samples", 0.0, 4.0, "electronics.delay"),
        ("V", 1e-3, 1e4, "electronics.voltage_limit electronics.adc_range"),
        ("N/m", 0.0, 1e8, "drive.kp"),
        ("N s/m", 0.0, 1e5, "drive.kd"),
    )
    for x in names.split()
    for name in [f"machine.{x}" if x.split(".")[0] in paper_machine()._fields else x]
}


def paper_case(
    values: Mapping[str, Any] | None = None, duration: float | None = None, **choices: Any
) -> tuple[Structure, Case]:
    """The paper's closed-loop run, or one with other numbers and choices.

    By default: a square of 10 mm in 0.4 s, EI shaper, IMSC of all links by gains that are stable on
    links with patches, twelve bits at 10 kHz.

    Args:
        values: as in `with_values`, but also of other sizes: path, patches, stations.
        duration: of the run [s]; default: 0.4 s more than the path.
        choices: fields of `Structure`, such as n_modes, n_controlled, law, drive, feedback; what
            some value needs is switched on.

    Returns:
        (structure, case): what is static, and a pytree of NumPy numbers to map and differentiate.

    Raises:
        ValueError: no such choice or number, or one of a wrong shape or out of range.

    Example:
        >>> structure, case = paper_case({"shaping.kind": "zvd"}, n_modes=4)
        >>> structure.n_modes, structure.n_steps
        (4, 8000)
    """
    values = dict(values or {})
    for name, value in choices.items():
        _known(name, Structure._fields, "choice")
        if name in CHOICES:
            _known(value, list(CHOICES[name]), "choice", f"{name} = ")
    machine = paper_machine()
    center = np.asarray(values.get("machine.patches.center", machine.patches.center), float)
    points = values.get("path.waypoints")
    square = np.array([[0, 0], [0, 0.01], [0.01, 0.01], [0.01, 0], [0, 0]])
    path = np.column_stack([square, np.full(5, HOME[2])]) if points is None else np.asarray(points)
    first = Structure(basis="loaded", controller_basis="loaded", has_stretch=True)._replace(
        **{
            "has_position_gain": LAWS[choices.get("law", "imsc")].has_position,
            "has_noise": choices.get("is_smooth", False),
            "n_patches": center.shape[-1],
            **choices,
        }
    )
    n_moves = max(len(path) - 1, 0)
    machine = machine._replace(
        patches=machine.patches._replace(center=center, is_force=float(first.has_stretch))
    )
    case = Case(
        machine=_spread(machine, first),
        n_modes=np.array(first.n_modes),
        path=Path(path, np.full(n_moves, 0.1), np.zeros(n_moves), np.array(0)),
        shaping=Shaping(
            kind=_position("shaping.kind", "ei"),
            omega=np.zeros(1),
            zeta=np.full(1, 0.01),
            tolerance=0.05,
            is_exact=0.0,
        ),
        control=_control(first),
        electronics=_electronics(first),
        drive=_drive(first),
        load=Load(np.zeros(3), np.zeros(3), 0.0, 1e-3),
        initial=Initial(np.zeros((3, first.n_modes)), 0.1, np.zeros(3)),
        windows=Windows(
            residual_delay=0.026,
            residual_length=0.3,
            settling_band=1e-6,
            saturation_limit=0.05,
            arrival_tolerance=1e-3,
            singularity_margin=0.05,
            condition_limit=1e3,
            stations=np.array([0.25, 0.5, 0.75]),
        ),
        seed=np.array(0),
    )
    case = jax.tree.map(np.asarray, case)
    whole = dict.fromkeys((x for names in SWITCHES.values() for x in names), True)
    case = _changed(case, values, whole, is_resized=True)
    used = {
        switch: True
        for switch, names in SWITCHES.items()
        if any(name in values and _is_used(case, name) for name in names)
    }
    length = float(np.sum(case.path.move_time) + np.sum(case.path.dwell)) + 0.4
    n_steps = round((duration or length) / float(case.electronics.period))
    return first._replace(**({"n_steps": n_steps} | used | choices)), case


def _spread(machine: Any, structure: Structure) -> Any:
    """The machine with one number for each link, and factors for each patch."""
    links, patches = (structure.n_links,), machine.patches
    each = patches._replace(
        sensor_factor=np.ones(patches.center.shape), actuator_factor=np.ones(patches.center.shape)
    )
    names = [x for x in each._fields[:9] if x != "center"]
    wide = {name: np.full(links, getattr(each, name)) for name in names}
    return machine._replace(
        beam=jax.tree.map(lambda x: np.full(links, x), machine.beam),
        patches=each._replace(**wide),
        masses=machine.masses._replace(slider_mass=np.full(links, machine.masses.slider_mass)),
    )


def _control(structure: Structure) -> Control:
    shape = structure.n_links, structure.n_controlled
    ratio = np.zeros((3, max(3, shape[1])))
    ratio[:, :3] = [[1.0, 0.345, 0.045], [1.0, 0.304, 0.041], [1.0, 0.321, 0.038]]
    return Control(
        n_active=float(structure.n_controlled),
        link_mask=np.ones(shape[0]),
        mode_mask=np.ones(shape),
        omega=np.zeros(shape),
        velocity_gain=np.array([0.85, 0.95, 0.95]),
        position_gain=np.zeros(shape[0]),
        ratio=ratio[:, : shape[1]],
        damping=np.full(shape, -1.0),
        pole_decay=np.zeros(shape),
        pole_frequency=np.zeros(shape),
        gain_factor=1.0,
        is_per_mass=0.0,
        feedthrough_factor=0.0,
        notch=np.zeros(shape[0]),
        notch_depth=np.full(shape[0], 0.1),
        notch_width=np.full(shape[0], 0.2),
        parameters={x.name: np.full(shape[0], x.default) for x in LAWS[structure.law].parameters},
    )


def _electronics(structure: Structure) -> Electronics:
    ratio = np.full(max(structure.n_controlled, 1), 2.0)
    ratio[0] = 3.0
    return Electronics(
        period=1e-4,
        antialias=2 * np.pi * 2e3,
        sensor_highpass=0.0,
        amplifier_lag=0.0,
        delay=1.0,
        unmodelled_delay=0.0,
        conditioner_gain=0.1,
        conditioner_bias=1.5,
        adc_range=3.0,
        adc_levels=4096.0,
        adc_noise=0.0,
        voltage_limit=100.0,
        estimator=_position("electronics.estimator", "modal_phase"),
        highpass=2 * np.pi * 60.0,
        lowpass_ratio=ratio,
        lowpass_zeta=np.full(len(ratio), 0.7),
        difference_cutoff=2 * np.pi * 2e3,
    )


def _drive(structure: Structure) -> Drive:
    links = structure.n_links
    return Drive(
        kp=2e4,
        kd=60.0,
        model_mass=1.0,
        force_limit=1e3,
        coulomb_friction=0.0,
        friction_speed=1e-3,
        viscous_friction=0.0,
        lag=0.0,
        ripple=0.0,
        pulse_force=np.zeros(links),
        pulse_start=0.0,
        pulse_length=1e-3,
        is_locked=0.0,
        parameters={x.name: np.full(links, x.default) for x in DRIVES[structure.drive].parameters},
    )


def with_values(structure: Structure, case: Case, values: Mapping[str, Any]) -> Case:
    """A case with other numbers; inside transformations of JAX, too.

    Args:
        structure: of the case.
        case: the numbers so far.
        values: by their place in `Case`, as numbers, arrays or, for choices, names; a number stands
            for all entries. What is no tracer is checked for its range.

    Returns:
        Case.

    Raises:
        ValueError: no such number, one of a wrong shape or out of range, or one that the program
            leaves out.

    Example:
        >>> structure, case = paper_case()
        >>> float(with_values(structure, case, {"control.gain_factor": 0.5}).control.gain_factor)
        0.5
    """
    is_on = {x: getattr(structure, switch) for switch, names in SWITCHES.items() for x in names}
    return _changed(case, values, is_on)


def _changed(
    case: Case, values: Mapping[str, Any], is_on: Mapping[str, bool], is_resized: bool = False
) -> Case:
    """`with_values`; is_on: whether the program has numbers that can be left out."""
    for name, value in values.items():
        if not is_on.get(name, True):
            switch = next(x for x, names in SWITCHES.items() if name in names)
            raise PartError(f"{name}: left out of this program; make it with {switch} = True")
        case = _replaced(case, name, name, partial(_checked, name, value, is_resized))
    return case


def _replaced(group: Any, place: str, name: str, make: Callable[[Any], Any]) -> Any:
    """A group of numbers with one replaced; place: of that in the group, name: in the case."""
    part, _, rest = place.partition(".")
    fields = group if isinstance(group, dict) else getattr(group, "_fields", ())
    _known(part, fields, "number", name.removesuffix(place))
    old = group[part] if isinstance(group, dict) else getattr(group, part)
    if not rest and (isinstance(old, dict) or hasattr(old, "_fields")):
        names = old if isinstance(old, dict) else type(old)._fields
        raise PartError(f"{name}: holds {', '.join(names)}; name one")
    new = _replaced(old, rest, name, make) if rest else make(old)
    return group | {part: new} if isinstance(group, dict) else group._replace(**{part: new})


def _checked(name: str, value: Any, is_resized: bool, old: Any) -> Array:
    """A value as an array of the shape it needs, within its range."""
    if name in NAMED and isinstance(value, str):
        return _position(name, value)
    try:
        is_traced = isinstance(value, jax.Array)
        array = value if is_traced else np.asarray(value, np.result_type(float))
    except (TypeError, ValueError):
        raise PartError(f"{name} = {value!r}; expected numbers") from None
    shape, xp = np.shape(old), jnp if is_traced else np
    is_list = old is None or (is_resized and name.startswith(_LISTS))
    if not is_list or np.ndim(array) == 0:
        try:
            array = xp.broadcast_to(array, shape)
        except ValueError:
            wanted = f"{shape} or a number" if shape else "a number"
            raise PartError(f"{name}: shape {np.shape(array)}; expected {wanted}") from None
    elif old is not None and np.ndim(array) != len(shape):
        raise PartError(f"{name}: shape {np.shape(array)}; expected {len(shape)} axes")
    unit, low, high = RANGES.get(name, ("", -np.inf, np.inf))
    if not isinstance(array, jax.core.Tracer):
        numbers = np.asarray(array)
        outside = numbers[~((numbers >= low) & (numbers <= high))]
        if len(outside):
            allowed = f"allowed: {low:g} to {high:g} {unit}" if unit else "expected numbers"
            raise PartError(f"{name} = {outside[0]:g}; {allowed}")
    return array


def _known(name: str, allowed: Any, what: str, place: str = "") -> None:
    """Raise PartError for a name that is none of those allowed."""
    if name not in allowed:
        close = get_close_matches(name, allowed, 1)
        hint = f"; did you mean {close[0]!r}?" if close else f"; allowed: {', '.join(allowed)}"
        raise PartError(f"{place}{name}: no such {what}{hint}")


def _position(name: str, value: str) -> np.ndarray:
    _known(value, list(NAMED[name]), "choice", f"{name} = ")
    return np.array(list(NAMED[name]).index(value))


def _is_used(case: Case, name: str) -> bool:
    value: Any = case
    for part in name.split("."):
        value = getattr(value, part)
    return value is not None and bool(np.any(value != NEUTRAL.get(name, 0.0)))
