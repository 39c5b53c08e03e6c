"""From numbers by the names of files to the arrays of the model, and what of it they need.

The same code handles one case and many, in NumPy and in JAX: arrays may have leading axes of cases,
of length 1 where they do not vary.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any, TypeVar

import numpy as np

from jaxmodel import motion
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
from jaxmodel.laws import LAWS
from jaxmodel.lazy import jax, jnp
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from jaxmodel.parameters import Beam, Damping, Machine, Masses, Patches
from jaxmodel.table import PartError

Numbers = dict[str, Any]
Tree = TypeVar("Tree")  # a Case, or numbers
TWO_PI = 2 * np.pi
#: Where the own fields of control laws, drives and mechanisms are, `PLACE.NAME.FIELD`.
OWN_LAWS, OWN_DRIVES, OWN_MECHANISMS = "control.laws", "drive.kinds", "machine.kinds"
#: What the program needs only where one of these fields is not 0, or not its value in `NEUTRAL`;
#: of poles: given at all.
SWITCHES = {
    "has_wrench": ("load.wrench", "load.pulse"),
    "has_payload_offset": ("load.offset",),
    "has_sensor_highpass": ("electronics.sensor_highpass_hz",),
    "has_amplifier": ("electronics.amplifier_hz",),
    "has_delay": ("electronics.delay", "electronics.unmodelled_delay"),
    "has_notch": ("control.notch_hz",),
    "has_hysteresis": ("patches.hysteresis",),
    "has_noise": ("electronics.adc_noise", "drive.ripple", "patches.gauge_noise"),
    "has_friction": ("drive.coulomb_friction",),
    "has_joint_friction": ("machine.joint_friction",),
    "has_drive_lag": ("drive.lag",),
    "has_poles": ("control.damping", "control.pole_decay"),
    "has_position_gain": ("control.position_gain", "control.damping", "control.pole_decay"),
}
#: Fields whose largest values decide a structure.
OF_STRUCTURE = {"link.modes", "control.modes", *(x for names in SWITCHES.values() for x in names)}
#: Values other than 0 at which a field of `SWITCHES` needs nothing.
NEUTRAL = {"electronics.delay": 1.0}
#: Duration of a move that only pads a path with fewer moves [s].
NO_TIME = 1e-12


def is_used(field: str, values: np.ndarray) -> bool:
    """Whether values of a field of `SWITCHES` need what it switches on."""
    if field in SWITCHES["has_poles"]:  # added damping of 0 specifies poles, too; NaN is none
        return bool(np.any(values >= 0))
    return bool(np.any(values != NEUTRAL.get(field, 0.0)))


def has_stretch(value: Callable[[str], Any]) -> bool:
    """Whether links lengthen: not in bases whose ends leave the chord, nor without coupling.

    value: of a field, as in files.
    """
    is_possible = BASES[value("link.basis")].is_on_chord and value("run.model") == "coupled"
    return bool(value("link.stretch") and is_possible)


def structure_of(
    value: Callable[[str], Any], sizes: Mapping[str, Any], used: Callable[[str], bool]
) -> Structure:
    """Static part of a run, or of many.

    Args:
        value: of a field that all share, as in files.
        sizes: fields of `Structure` that are sizes of the largest case.
        used: whether a field of `SWITCHES` is needed.
    """
    steps = round(value("run.duration") * value("electronics.sample_rate_hz"))
    structure = Structure(
        mechanism=value("machine.kind"),
        n_steps=max(steps, 1),
        substeps=value("run.substeps") or 1,
        basis=value("link.basis"),
        has_shortening=value("link.shortening"),
        is_distributed=value("link.axial_inertia") == "distributed",
        has_stretch=has_stretch(value),
        has_static_correction=value("link.static_correction"),
        is_coupled=value("run.model") == "coupled",
        controller_basis=value("control.basis"),
        feedback=value("control.feedback"),
        law=value("control.law"),
        drive=value("drive.kind"),
        has_noise=value("run.smooth"),
        has_position_gain=LAWS[value("control.law")].has_position,
        is_smooth=value("run.smooth"),
    )._replace(**sizes)
    return with_used(structure, filter(used, OF_STRUCTURE))


def with_used(structure: Structure, fields: Iterable[str]) -> Structure:
    """The structure with everything that some fields, which are not 0 in all cases, need."""
    used = set(fields)
    switches: dict[str, Any] = {
        name: True for name, switching in SWITCHES.items() if not used.isdisjoint(switching)
    }
    return structure._replace(**switches)


def case_of(structure: Structure, numbers: Numbers) -> Case:
    """The model's arrays, in SI units, from numbers by the names of the file.

    The only map from fields to the model. It is JAX for numbers that are, so that it can be traced,
    mapped over cases and differentiated by any number, and NumPy for NumPy arrays. Arrays may have
    leading axes of cases, of any length where they vary and 1 where they do not.

    Args:
        structure: sizes.
        numbers: see `studies.study.numbers`.
    """
    number = numbers.__getitem__
    xp: Any = _library(numbers)
    return Case(
        machine=_machine(numbers, structure, xp),
        n_modes=number("link.modes"),
        path=_path(numbers, xp),
        shaping=_shaping(numbers, xp),
        control=_control(numbers, structure, xp),
        electronics=_electronics(numbers, structure, xp),
        drive=_drive(numbers, structure),
        load=Load(*(number(f"load.{name}") for name in Load._fields)),
        initial=Initial(
            _fill(number("initial.modal"), (structure.n_links, structure.n_modes), 0.0, xp),
            # on a link that is shorter it has no deflection
            xp.minimum(
                number("initial.load_station"), 0.999 * xp.min(number("link.length"), axis=-1)
            ),
            number("initial.load_deflection"),
        ),
        windows=Windows(*(number(f"metrics.{name}") for name in Windows._fields)),
        seed=number("run.seed"),
    )


def _drive(numbers: Numbers, structure: Structure) -> Drive:
    law = DRIVES[structure.drive]
    names = {name: name for name in Drive._fields} | {"is_locked": "locked"}
    del names["parameters"]
    return Drive(
        parameters={x.name: numbers[f"{OWN_DRIVES}.{law.name}.{x.name}"] for x in law.parameters},
        **{name: numbers[f"drive.{field}"] for name, field in names.items()},
    )


def _library(numbers: Numbers) -> Any:
    """NumPy if all numbers are NumPy's, otherwise JAX's."""
    leaves = jax.tree.leaves(numbers)
    return np if all(isinstance(x, np.ndarray | np.generic) for x in leaves) else jnp


def in_working_precision(cases: Tree) -> Tree:
    """NumPy leaves in JAX's working precision (integers stay integers)."""
    real = np.dtype(jnp.result_type(float))

    def cast(x: np.ndarray) -> np.ndarray:
        return x if np.issubdtype(x.dtype, np.integer) else x.astype(real)

    changed: Tree = jax.tree.map(cast, cases)
    return changed


def build_geometry(
    kind: str, number: Callable[[str], Any], joint_angle: Any, xp: Any
) -> tuple[Any, Any]:
    """`Geometry` of a mechanism, and the mass that moves with each near joint [kg].

    Args:
        kind: name of the mechanism.
        number: value of a field in its unit.
        joint_angle: of the platform's joints in its own axes [rad], (..., n).
        xp: NumPy or `jax.numpy`.
    """
    mechanism = MECHANISMS[kind]
    place = f"{OWN_MECHANISMS}.{mechanism.name}"
    own = {x.name: number(f"{place}.{x.name}") for x in mechanism.parameters}
    machine = {
        "guide_side": number("machine.guide_side"),
        "guide_angle": xp.radians(number("machine.guide_angles_deg")),
        "guide_offset": number("machine.guide_offsets"),
        "joint_radius": number("machine.joint_radius"),
        "joint_angle": joint_angle,
        "slider_mass": number("machine.slider_mass"),
    }
    geometry, near_mass = mechanism.build(own, machine, xp)
    _check_axes(mechanism.name, geometry, [*own.values(), *machine.values()])
    return geometry, near_mass


def _check_axes(kind: str, geometry: Any, given: list[Any]) -> None:
    """Raise PartError for an array that ignores the axis of cases, which would be read as one."""
    if np.ndim(given[-1]) < 2:
        return
    known = {1, *(np.shape(x)[0] for x in given)}
    for name, value in zip(geometry._fields, geometry, strict=True):
        shape = np.shape(value)
        if not shape or shape[0] not in known:
            raise PartError(
                f"mechanism {kind!r}: {name} of its geometry has shape {shape}; expected an axis "
                "of cases first, as what it is built from has"
            )


def _machine(numbers: Numbers, structure: Structure, xp: Any) -> Machine:
    number = numbers.__getitem__
    joint_angle = _joint_angle(numbers, xp)
    geometry, near_mass = build_geometry(structure.mechanism, number, joint_angle, xp)
    return Machine(
        geometry=geometry,
        masses=Masses(
            platform_mass=number("machine.platform_mass"),
            platform_inertia=number("machine.platform_inertia"),
            slider_mass=near_mass,
            payload_mass=number("load.mass"),
            payload_inertia=number("load.inertia"),
            payload_offset=number("load.offset") if structure.has_payload_offset else None,
        ),
        beam=Beam(*(number(f"link.{name}") for name in Beam._fields)),
        patches=Patches(
            center=number("patches.centers"),
            **{name: number(f"patches.{name}") for name in Patches._fields[1:-4]},
            is_gauge=1.0 * number("patches.sensor"),
            bridge=_bridge(numbers),
            is_force=1.0 * number("link.stretch"),
            is_paired=1.0 * number("patches.actuators"),
        ),
        damping=_damping(numbers, xp),
        joint_friction=number("machine.joint_friction"),
        joint_friction_speed=number("machine.joint_friction_speed"),
    )


def _bridge(numbers: Numbers) -> Any:
    """Amplified voltage of a bridge per relative change of an arm's resistance [V]."""
    excitation, gain = numbers["patches.gauge_excitation"], numbers["patches.gauge_gain"]
    return excitation * gain * numbers["patches.gauge_arms"] / 4


def _joint_angle(numbers: Numbers, xp: Any) -> Any:
    """psi [rad], (..., n): as given, otherwise those of the assembly."""
    of_assembly = xp.asarray(list(ASSEMBLIES.values()))[numbers["machine.assembly"]]
    angle = xp.radians(numbers["machine.joint_angles_deg"])
    return xp.where(xp.isnan(angle), of_assembly, angle) if angle.shape[-1] else of_assembly


def _damping(numbers: Numbers, xp: Any) -> Damping:
    ratio = numbers["link.damping_ratio"]  # (..., n, m)
    count = xp.maximum(xp.sum(~xp.isnan(ratio), axis=-1), 1)
    last = xp.minimum(xp.arange(ratio.shape[-1]), count[..., None] - 1)
    exponent = xp.asarray([0.0, -1.0, 1.0])[numbers["link.damping_law"]]
    ratio = xp.take_along_axis(ratio, last, axis=-1)
    return Damping(ratio, count, exponent, numbers["link.stretch_damping"])


def _path(numbers: Numbers, xp: Any) -> motion.Path:
    points = numbers["motion.waypoints"]  # (..., M, p), NaN beyond the last one
    count = xp.sum(~xp.isnan(points[..., 0]), axis=-1)
    moves = points.shape[-2] - 1
    reached = xp.minimum(xp.arange(moves + 1), count[..., None] - 1)
    points = xp.take_along_axis(points, reached[..., None], axis=-2)
    is_move = xp.arange(moves) < count[..., None] - 1

    def times(field: str, rest: float) -> Any:
        time = numbers[field]
        time = time if time.shape[-1] == 1 else _fill(time, (moves,), rest, xp)
        return xp.where(is_move, time, rest)

    return motion.Path(
        points,
        times("motion.move_time", NO_TIME),
        times("motion.dwell", 0.0),
        numbers["motion.profile"],
    )


def _shaping(numbers: Numbers, xp: Any) -> Shaping:
    omega = TWO_PI * numbers["shaper.frequencies_hz"]
    if omega.shape[-1] == 0:
        omega = xp.zeros((*omega.shape[:-1], 1))  # as in the nominal model, see `design_taps`
    zeta = numbers["shaper.damping_ratio"]
    return Shaping(
        kind=numbers["shaper.kind"],
        omega=omega,
        zeta=xp.broadcast_to(zeta[..., None], (*zeta.shape, omega.shape[-1])),
        tolerance=numbers["shaper.tolerance"],
        is_exact=numbers["shaper.split"].astype(float),
    )


def _control(numbers: Numbers, structure: Structure, xp: Any) -> Control:
    shape = (structure.n_links, structure.n_controlled)
    number, law = numbers.__getitem__, LAWS[structure.law]

    def filled(field: str, fill: float) -> Any:
        return _fill(number(field), shape, fill, xp)

    exponent = number("control.ratio_exponent")[..., None, None]
    return Control(
        n_active=number("control.modes").astype(float),
        link_mask=number("control.links"),
        mode_mask=filled("control.mode_mask", 1.0),
        omega=TWO_PI * filled("control.frequencies_hz", 0.0),
        velocity_gain=number("control.velocity_gain"),
        position_gain=number("control.position_gain"),
        ratio=signed_power(filled("control.ratios", 0.0), exponent, xp),
        damping=filled("control.damping", -1.0),
        pole_decay=filled("control.pole_decay", 0.0),
        pole_frequency=TWO_PI * filled("control.pole_frequency_hz", 0.0),
        gain_factor=number("control.gain_factor"),
        is_per_mass=number("control.gain_unit").astype(float),
        feedthrough_factor=number("control.feedthrough_factor"),
        notch=TWO_PI * number("control.notch_hz"),
        notch_depth=number("control.notch_depth"),
        notch_width=number("control.notch_width"),
        parameters={x.name: number(f"{OWN_LAWS}.{law.name}.{x.name}") for x in law.parameters},
        system=numbers.get("state_space"),
    )


def signed_power(ratio: Any, exponent: Any, xp: Any = np) -> Any:
    """|ratio|^exponent with the ratio's sign; a disabled mode (ratio 0) stays disabled."""
    size = xp.abs(ratio)
    power = xp.where(size > 0, xp.where(size > 0, size, 1.0) ** exponent, 0.0)
    # as it is, with a derivative at 0, where the exponent changes nothing
    return xp.where(exponent == 1, ratio, xp.where(ratio < 0, -power, power))


def _fill(table: Any, shape: tuple[int, ...], fill: float, xp: Any) -> Any:
    """Last axes truncated or padded to a shape; NaN marks missing entries."""
    table = table[(..., *(slice(0, n) for n in shape))]
    added = [(0, n - m) for n, m in zip(shape, table.shape[-len(shape) :], strict=True)]
    cases = [(0, 0)] * (table.ndim - len(shape))
    table = xp.pad(table, cases + added, constant_values=float("nan"))
    return xp.where(xp.isnan(table), fill, table)


def _electronics(numbers: Numbers, structure: Structure, xp: Any) -> Electronics:
    number = numbers.__getitem__

    def extended(field: str) -> Any:
        """Repeat the last entry."""
        values = number(field)
        last = xp.maximum(xp.sum(~xp.isnan(values), axis=-1) - 1, 0)
        index = xp.minimum(xp.arange(structure.n_controlled), last[..., None])
        return xp.take_along_axis(values, index, axis=-1)

    bandwidth = TWO_PI * number("electronics.amplifier_hz")
    return Electronics(
        period=1 / number("electronics.sample_rate_hz"),
        antialias=TWO_PI * number("electronics.antialias_hz"),
        # nothing drains a strain gauge
        sensor_highpass=TWO_PI
        * number("electronics.sensor_highpass_hz")
        * (1.0 - number("patches.sensor")),
        amplifier_lag=xp.where(bandwidth > 0, 1 / xp.where(bandwidth > 0, bandwidth, 1.0), 0.0),
        delay=number("electronics.delay"),
        unmodelled_delay=number("electronics.unmodelled_delay"),
        conditioner_gain=number("electronics.conditioner_gain"),
        conditioner_bias=number("electronics.conditioner_bias"),
        adc_range=number("electronics.adc_range"),
        adc_levels=2.0 ** number("electronics.adc_bits"),
        adc_noise=number("electronics.adc_noise"),
        voltage_limit=number("electronics.voltage_limit"),
        estimator=number("electronics.estimator"),
        highpass=TWO_PI * number("electronics.highpass_hz"),
        lowpass_ratio=extended("electronics.lowpass_ratio"),
        lowpass_zeta=extended("electronics.lowpass_zeta"),
        difference_cutoff=TWO_PI * number("electronics.difference_cutoff_hz"),
    )
