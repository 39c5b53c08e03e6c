"""From studies to the arrays of the model: `Structure` (static) and `Case` (traced).

The same code handles one study and many: every leaf has a leading case axis, of length 1 if no
column makes it vary, so that a batch computes only once what its cases share.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import estimator, motion, shaper
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
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law
from jaxmodel.laws.state_space import STATE_SPACE
from jaxmodel.parameters import ASSEMBLIES, Beam, Damping, Geometry, Machine, Masses, Patches
from jaxmodel.state_space import StateSpace
from studies.study.consistency import patch_centers
from studies.study.fields import Columns, Fields, nesting
from studies.study.spec import OWN_FIELDS, Study
from studies.study.state_space import system_of
from studies.study.window import DELAY, residual_delay

TWO_PI = 2 * np.pi
#: Duration of a move that only pads a path with fewer moves [s].
NO_TIME = 1e-12


def build_structure(study: Study, substeps: int | None = None) -> Structure:
    """Static part of a study.

    Args:
        study: validated study.
        substeps: plant steps per sample if `run.substeps` leaves it open; default 1.
    """
    steps = round(study.run.duration * study.electronics.sample_rate_hz)
    noisy = study.electronics.adc_noise > 0 or study.drive.ripple > 0 or study.run.smooth
    n_patches = patch_centers(study).shape[1]
    return Structure(
        n_modes=study.link.modes,
        n_controlled=min(study.control.modes, n_patches),
        n_patches=n_patches,
        n_steps=max(steps, 1),
        substeps=study.run.substeps or substeps or 1,
        basis=study.link.basis,
        has_shortening=study.link.shortening,
        is_distributed=study.link.axial_inertia == "distributed",
        has_static_correction=study.link.static_correction,
        is_coupled=study.run.model == "coupled",
        has_wrench=any(x != 0 for x in (*study.load.wrench, *study.load.pulse)),
        has_payload_offset=any(x != 0 for x in study.load.offset),
        controller_basis=study.control.basis,
        feedback=study.control.feedback,
        law=study.control.law,
        has_feedforward=study.drive.kind == "computed_torque",
        has_sensor_highpass=study.electronics.sensor_highpass_hz > 0,
        has_amplifier=study.electronics.amplifier_hz > 0,
        has_noise=noisy,
        has_friction=study.drive.coulomb_friction > 0,
        has_poles=study.control.has_poles,
        has_position_gain=LAWS[study.control.law].has_position
        or study.control.has_poles
        or any(gain != 0 for gain in study.control.position_gain),
        is_smooth=study.run.smooth,
    )


def build_case(study: Study) -> Case:
    """Traced part of a study, as NumPy numbers and arrays in SI units."""
    return jax.tree.map(lambda x: x[0], build_cases(study, {}, build_structure(study)))


def build_cases(study: Study, columns: Columns, structure: Structure) -> Case:
    """Traced part of many studies that differ in some fields.

    Args:
        study: values of all fields that no column names.
        columns: values of the others, one per case (see `studies.study.fields`).
        structure: sizes; those of the largest case.

    Returns:
        Case whose leaves have a leading axis: the cases, or of length 1 where they do not differ.
    """
    fields = Fields(study, columns)
    number = fields.numbers
    return Case(
        machine=_machine(fields, structure),
        n_modes=number("link.modes").astype(int),
        path=_path(fields),
        shaping=_shaping(fields),
        control=_control(fields, structure),
        electronics=_electronics(fields, structure),
        drive=_drive(fields),
        load=Load(*(number(f"load.{name}") for name in Load._fields)),
        initial=Initial(
            _filled(number("initial.modal"), (3, structure.n_modes), 0.0),
            _load_station(fields),
            number("initial.load_deflection"),
        ),
        windows=Windows(
            residual_delay=_delay(fields),
            residual_length=number("metrics.residual_length"),
            settling_band=number("metrics.settling_band"),
            saturation_limit=number("metrics.saturation_limit"),
            arrival_tolerance=number("metrics.arrival_tolerance"),
            singularity_margin=number("metrics.singularity_margin"),
            condition_limit=number("metrics.condition_limit"),
            stations=number("metrics.stations"),
        ),
        seed=fields.raw("run.seed").astype(int),
    )


def _load_station(fields: Fields) -> np.ndarray:
    """Where the static load acts [m], (m,); on a link that is shorter it has no deflection."""
    shortest = fields.each_link("link.length").min(axis=1)
    return np.minimum(fields.numbers("initial.load_station"), 0.999 * shortest)


def _delay(fields: Fields) -> np.ndarray:
    """Start of the residual window [s], (m,); "auto" is that of the study without columns."""
    if DELAY in fields.columns:
        return fields.numbers(DELAY)
    return np.array([residual_delay(fields.study)])


def in_working_precision(cases: Case) -> Case:
    """NumPy leaves in JAX's working precision (integers stay integers)."""
    real = np.dtype(jnp.result_type(float))

    def cast(x: np.ndarray) -> np.ndarray:
        return x if np.issubdtype(x.dtype, np.integer) else x.astype(real)

    return jax.tree.map(cast, cases)


def as_arrays(case: Case) -> Case:
    """Every leaf as an array of the working precision (integers stay integers)."""
    real = jnp.result_type(float)

    def leaf(x: Any) -> Any:
        x = np.asarray(x)
        return jnp.asarray(x, None if np.issubdtype(x.dtype, np.integer) else real)

    return jax.tree.map(leaf, case)


def _machine(fields: Fields, structure: Structure) -> Machine:
    number, each = fields.numbers, fields.each_link
    return Machine(
        geometry=Geometry(
            guide_side=number("machine.guide_side"),
            guide_angle=np.radians(number("machine.guide_angles_deg")),
            joint_radius=each("machine.joint_radius"),
            joint_angle=_joint_angle(fields),
            guide_offset=each("machine.guide_offsets"),
        ),
        masses=Masses(
            platform_mass=number("machine.platform_mass"),
            platform_inertia=number("machine.platform_inertia"),
            slider_mass=each("machine.slider_mass"),
            payload_mass=number("load.mass"),
            payload_inertia=number("load.inertia"),
            payload_offset=number("load.offset") if structure.has_payload_offset else None,
        ),
        beam=Beam(*(each(f"link.{name}") for name in Beam._fields)),
        patches=Patches(
            center=_per_link(number("patches.centers")),
            **{name: each(f"patches.{name}") for name in Patches._fields if name != "center"},
        ),
        damping=_damping(fields),
    )


def _joint_angle(fields: Fields) -> np.ndarray:
    """psi [rad], (m, 3): as given, otherwise those of the assembly."""
    outward = fields.choices("machine.assembly", tuple(ASSEMBLIES))
    known = np.array(list(ASSEMBLIES.values()))[outward]
    given = np.radians(fields.numbers("machine.joint_angles_deg"))
    return np.where(np.isnan(given), known, given) if given.shape[1] else known


def _damping(fields: Fields) -> Damping:
    ratio = fields.numbers("link.damping_ratio")
    ratio = _per_link(ratio[:, None] if ratio.ndim == 1 else ratio)  # (m, 3, n)
    count = np.maximum(np.sum(~np.isnan(ratio), axis=2), 1)
    given = np.minimum(np.arange(ratio.shape[2]), count[:, :, None] - 1)
    law = fields.choices("link.damping_law", ("mass", "constant", "stiffness"))
    return Damping(np.take_along_axis(ratio, given, axis=2), count, law - 1.0)


def _per_link(lists: np.ndarray) -> np.ndarray:
    """One list for all links, or three, as (m, 3, K)."""
    return np.repeat(lists[:, None], 3, axis=1) if lists.ndim == 2 else lists


def _path(fields: Fields) -> motion.Path:
    points = fields.numbers("motion.waypoints")  # (m, M, 3), NaN beyond the last one
    count = np.sum(~np.isnan(points[..., 0]), axis=1)
    moves = max(points.shape[1] - 1, 1)  # a platform at rest moves to its own pose
    reached = np.minimum(np.arange(moves + 1), count[:, None] - 1)
    points = np.take_along_axis(points, reached[..., None], axis=1)
    is_move = np.arange(moves) < count[:, None] - 1

    def times(field: str, rest: float) -> np.ndarray:
        given = fields.numbers(field)
        given = given[:, None] if given.ndim == 1 else given[:, :moves]
        return np.where(is_move, np.broadcast_arrays(given, is_move)[0], rest)

    return motion.Path(
        points,
        times("motion.move_time", NO_TIME),
        times("motion.dwell", 0.0),
        fields.choices("motion.profile", tuple(motion.PROFILES)),
    )


def _shaping(fields: Fields) -> Shaping:
    given = TWO_PI * fields.numbers("shaper.frequencies_hz")
    if given.shape[1] == 0:
        given = np.zeros((len(given), 1))  # as in the nominal model, see `design_taps`
    zeta = fields.numbers("shaper.damping_ratio")
    return Shaping(
        kind=fields.choices("shaper.kind", tuple(shaper.SHAPERS)),
        omega=given,
        zeta=np.repeat(zeta[:, None], given.shape[1], axis=1),
        tolerance=fields.numbers("shaper.tolerance"),
        is_exact=fields.choices("shaper.split", ("linear", "exact")).astype(float),
    )


def _control(fields: Fields, structure: Structure) -> Control:
    shape = (3, structure.n_controlled)
    number = fields.numbers
    ratio = _filled(number("control.ratios"), shape, 0.0)
    exponent = number("control.ratio_exponent")[:, None, None]
    return Control(
        n_active=number("control.modes"),
        link_mask=number("control.links"),
        mode_mask=_filled(number("control.mode_mask"), shape, 1.0),
        omega=TWO_PI * _filled(_per_link(number("control.frequencies_hz")), shape, 0.0),
        velocity_gain=number("control.velocity_gain"),
        position_gain=number("control.position_gain"),
        ratio=powered(ratio, exponent),
        damping=_added_damping(fields, shape),
        pole_decay=fields.spread("control.pole_decay", shape),
        pole_frequency=TWO_PI * fields.spread("control.pole_frequency_hz", shape),
        gain_factor=number("control.gain_factor"),
        is_per_mass=fields.choices("control.gain_unit", ("N s/m", "1/s")).astype(float),
        feedthrough_factor=number("control.feedthrough_factor"),
        parameters=_parameters(fields, LAWS[structure.law]),
        system=_system(fields.study, structure),
    )


def _added_damping(fields: Fields, shape: tuple[int, int]) -> np.ndarray:
    """`control.damping`, (m, 3, C): one number, or one a link, is that of mode 1; -1: none."""
    is_by_mode = np.array([nesting(value) > 0 for value in fields.raw("control.damping")])
    found = fields.spread("control.damping", shape, missing=-1.0)
    return np.where(is_by_mode[:, None, None] | (np.arange(shape[1]) == 0), found, -1.0)


def _system(study: Study, structure: Structure) -> StateSpace | None:
    if structure.law != STATE_SPACE.name:
        return None
    system = system_of(study.state_space, structure.n_patches)
    return jax.tree.map(lambda x: x[None], system)


def _parameters(fields: Fields, law: Law) -> dict[str, np.ndarray]:
    names = {x.name: f"{OWN_FIELDS}.{law.name}.{x.name}" for x in law.parameters}
    return {name: fields.each_link(field) for name, field in names.items()}


def law_parameters(study: Study, law: Law) -> dict[str, np.ndarray]:
    """A law's own fields in a study, whichever law the study selects, (3,) each."""
    return {name: x[0] for name, x in _parameters(Fields(study), law).items()}


def powered(ratio: Any, exponent: Any) -> np.ndarray:
    """|ratio|^exponent with the ratio's sign; a disabled mode (ratio 0) stays disabled."""
    size = np.abs(ratio)
    power = np.where(size > 0, np.where(size > 0, size, 1.0) ** exponent, 0.0)
    return np.where(np.asarray(ratio) < 0, -power, power)


def _filled(table: np.ndarray, shape: tuple[int, ...], fill: float) -> np.ndarray:
    """(m, ...) truncated or padded to (m, *shape); NaN marks missing entries."""
    whole = np.full((len(table), *shape), np.nan)
    if table.size:
        kept = tuple(slice(0, min(a, b)) for a, b in zip(table.shape[1:], shape, strict=True))
        whole[(slice(None), *kept)] = table[(slice(None), *kept)]
    return np.where(np.isnan(whole), fill, whole)


def _electronics(fields: Fields, structure: Structure) -> Electronics:
    number = fields.numbers

    def extend(field: str) -> np.ndarray:
        """Repeat the last entry."""
        values = number(field)
        last = np.maximum(np.sum(~np.isnan(values), axis=1) - 1, 0)
        index = np.minimum(np.arange(structure.n_controlled), last[:, None])
        return np.take_along_axis(values, index, axis=1)

    bandwidth = TWO_PI * number("electronics.amplifier_hz")
    return Electronics(
        period=1 / number("electronics.sample_rate_hz"),
        antialias=TWO_PI * number("electronics.antialias_hz"),
        sensor_highpass=TWO_PI * number("electronics.sensor_highpass_hz"),
        amplifier_lag=np.where(bandwidth > 0, 1 / np.where(bandwidth > 0, bandwidth, 1.0), 0.0),
        conditioner_gain=number("electronics.conditioner_gain"),
        conditioner_bias=number("electronics.conditioner_bias"),
        adc_range=number("electronics.adc_range"),
        adc_levels=2.0 ** number("electronics.adc_bits"),
        adc_noise=number("electronics.adc_noise"),
        voltage_limit=number("electronics.voltage_limit"),
        estimator=fields.choices("electronics.estimator", estimator.KINDS),
        highpass=TWO_PI * number("electronics.highpass_hz"),
        lowpass_ratio=extend("electronics.lowpass_ratio"),
        lowpass_zeta=extend("electronics.lowpass_zeta"),
        difference_cutoff=TWO_PI * number("electronics.difference_cutoff_hz"),
    )


def _drive(fields: Fields) -> Drive:
    same = (
        "kp",
        "kd",
        "force_limit",
        "coulomb_friction",
        "friction_speed",
        "viscous_friction",
        "ripple",
        "pulse_force",
        "pulse_start",
        "pulse_length",
    )
    return Drive(*(fields.numbers(f"drive.{name}") for name in (*same, "locked")))
