"""From a validated `Study` to the arrays of the model: `Structure` (static) and `Case` (traced)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import estimator, motion, shaper
from jaxmodel.beam import assembled_frequency
from jaxmodel.case import (
    Case,
    Control,
    Drive,
    Electronics,
    Initial,
    Shaping,
    Structure,
    Windows,
)  # fmt: skip
from jaxmodel.parameters import ASSEMBLIES, Beam, Geometry, Machine, Masses, Patches
from studies.consistency import patch_centers
from studies.spec import Study

TWO_PI = 2 * np.pi


def build_structure(study: Study, substeps: int | None = None) -> Structure:
    """Static part of a study.

    Args:
        study: validated study.
        substeps: plant steps per sample, where `run.substeps` leaves it open; default 1.
    """
    steps = int(round(study.run.duration * study.electronics.sample_rate_hz))
    noisy = study.electronics.adc_noise > 0 or study.drive.ripple > 0 or study.run.smooth
    n_patches = patch_centers(study).shape[1]
    return Structure(
        n_modes=study.link.modes,
        n_controlled=min(study.control.modes, n_patches),
        n_patches=n_patches,
        n_steps=max(steps, 1),
        substeps=study.run.substeps or substeps or 1,
        basis=study.link.basis,
        controller_basis=study.control.basis,
        feedback=study.control.feedback,
        law=study.control.law,
        has_feedforward=study.drive.kind == "computed_torque",
        has_noise=noisy,
        is_smooth=study.run.smooth,
    )


def build_case(study: Study) -> Case:
    """Traced part of a study, as NumPy numbers and arrays in SI units."""
    structure = build_structure(study)
    return Case(
        machine=build_machine(study),
        n_modes=study.link.modes,
        path=_path(study),
        shaping=_shaping(study),
        control=_control(study, structure),
        electronics=_electronics(study, structure),
        drive=_drive(study),
        initial=_initial(study, structure),
        windows=Windows(
            study.metrics.residual_delay,
            study.metrics.residual_length,
            study.metrics.settling_band,
            study.metrics.saturation_limit,
            study.metrics.condition_limit,
            np.array(study.metrics.stations),
        ),
        seed=study.run.seed,
    )


def as_arrays(case: Case) -> Case:
    """Every leaf as an array of the working precision (integers stay integers)."""
    real = jnp.result_type(float)

    def leaf(x):
        x = np.asarray(x)
        return jnp.asarray(x, None if np.issubdtype(x.dtype, np.integer) else real)

    return jax.tree.map(leaf, case)


def build_machine(study: Study) -> Machine:
    """Physical description of a study."""
    machine, link, patches = study.machine, study.link, study.patches
    return Machine(
        Geometry(
            machine.guide_side,
            np.array([2 * np.pi / 3, 4 * np.pi / 3, 0.0]),
            machine.joint_radius,
            np.array(ASSEMBLIES[machine.assembly]),
        ),
        Masses(machine.platform_mass, machine.platform_inertia, machine.slider_mass),
        Beam(*(getattr(link, name) for name in Beam._fields)),
        Patches(
            center=patch_centers(study),
            **{name: getattr(patches, name) for name in Patches._fields if name != "center"},
        ),
    )


def _path(study: Study) -> motion.Path:
    points = np.array(study.motion.waypoints, float)
    if len(points) == 1:  # stand still: one move to the same place
        points = np.repeat(points, 2, axis=0)
    moves = len(points) - 1
    is_still = len(study.motion.waypoints) == 1
    return motion.Path(
        points,
        np.full(moves, 1e-9)
        if is_still
        else np.broadcast_to(study.motion.move_time, (moves,)) + 0.0,
        np.zeros(moves) if is_still else np.broadcast_to(study.motion.dwell, (moves,)) + 0.0,
        motion.PROFILES.index(study.motion.profile),
    )


def _shaping(study: Study) -> Shaping:
    given = TWO_PI * np.array(study.shaper.frequencies_hz, float)
    if given.size == 0:
        given = np.asarray(assembled_frequency(build_machine(study).beam, 1))[:1, 0]
    return Shaping(
        shaper.KINDS.index(study.shaper.kind),
        given,
        np.full(given.shape, study.shaper.damping_ratio),
        study.shaper.tolerance,
        float(study.shaper.split == "exact"),
    )


def _control(study: Study, structure: Structure) -> Control:
    control, n = study.control, structure.n_controlled
    return Control(
        n_active=float(n),
        link_mask=np.array(control.links, float),
        mode_mask=_table(control.mode_mask, n, 1.0) if control.mode_mask else np.ones((3, n)),
        velocity_gain=np.array(control.velocity_gain),
        position_gain=np.array(control.position_gain),
        ratio=_table(control.ratios, n, 0.0),
        gain_factor=control.gain_factor,
        is_per_mass=float(control.gain_unit == "1/s"),
        feedthrough_factor=control.feedthrough_factor,
    )


def _table(rows, n: int, fill: float) -> np.ndarray:
    """Three rows cut or filled to n entries."""
    table = np.full((3, n), fill)
    for i, row in enumerate(rows):
        table[i, : min(n, len(row))] = row[:n]
    return table


def _electronics(study: Study, structure: Structure) -> Electronics:
    e, n = study.electronics, structure.n_controlled

    def extend(values) -> np.ndarray:
        return np.array((list(values) + [values[-1]] * n)[:n], float)

    return Electronics(
        period=1 / e.sample_rate_hz,
        antialias=TWO_PI * e.antialias_hz,
        conditioner_gain=e.conditioner_gain,
        conditioner_bias=e.conditioner_bias,
        adc_range=e.adc_range,
        adc_levels=float(2**e.adc_bits),
        adc_noise=e.adc_noise,
        voltage_limit=e.voltage_limit,
        estimator=estimator.KINDS.index(e.estimator),
        highpass=TWO_PI * e.highpass_hz,
        lowpass_ratio=extend(e.lowpass_ratio),
        lowpass_zeta=extend(e.lowpass_zeta),
        difference_cutoff=TWO_PI * e.difference_cutoff_hz,
    )


def _drive(study: Study) -> Drive:
    d = study.drive
    return Drive(
        d.kp, d.kd, d.force_limit, d.coulomb_friction, d.friction_speed, d.viscous_friction,
        d.ripple, np.array(d.pulse_force), d.pulse_start, d.pulse_length, float(d.locked),
    )  # fmt: skip


def _initial(study: Study, structure: Structure) -> Initial:
    initial = study.initial
    return Initial(
        _table(initial.modal, structure.n_modes, 0.0),
        initial.load_station,
        np.array(initial.load_deflection),
    )
