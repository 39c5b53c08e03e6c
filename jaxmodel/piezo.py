"""Piezo patches by laminate theory, and strain gauges: sections, constants, slope differences."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Beam, Machine, Patches

VACUUM_PERMITTIVITY = 8.8541878128e-12  # [F/m]


class CrossSection(NamedTuple):
    """A laminated cross-section, added to the bare link's."""

    stiffness: Array  # bending stiffness beyond the bare link's [N m2]
    neutral_axis: Array  # shift z_n of the neutral axis from the link's mid-plane [m]


def bare_stiffness(beam: Beam) -> Array:
    """Bending stiffness E I = E b t^3/12 [N m2] of the link without patches."""
    return beam.youngs_modulus * beam.width * beam.thickness**3 / 12


def one_sided_section(beam: Beam, patches: Patches) -> CrossSection:
    """Link with one patch on one face; the neutral axis moves towards the patch.

    z_n = E_p A_p z_p/(E A + E_p A_p) with z_p = (t_b + t_p)/2; parallel-axis theorem for the rest.

    Args:
        beam: link section data, () or (3,) fields.
        patches: patch data.

    Returns:
        Section with fields shaped like the beam's.
    """
    offset = (beam.thickness + patches.thickness) / 2
    axial_beam = beam.youngs_modulus * beam.width * beam.thickness
    axial_patch = patches.youngs_modulus * patches.width * patches.thickness
    shift = axial_patch * offset / (axial_beam + axial_patch)
    own = axial_patch * patches.thickness**2 / 12
    stiffness = axial_beam * shift**2 + axial_patch * (offset - shift) ** 2 + own
    return CrossSection(stiffness, shift)


def two_sided_section(beam: Beam, patches: Patches) -> CrossSection:
    """Link with a patch on both faces; symmetric, so the neutral axis stays in the middle."""
    offset = (beam.thickness + patches.thickness) / 2
    axial_patch = patches.youngs_modulus * patches.width * patches.thickness
    stiffness = 2 * axial_patch * (offset**2 + patches.thickness**2 / 12)
    return CrossSection(stiffness, jnp.zeros_like(stiffness))


def actuator_force(patches: Patches) -> Array:
    """F = b_p E_p |d31| [N/V]: how hard an actuator pushes along its link per volt."""
    return patches.width * patches.youngs_modulus * jnp.abs(patches.d31)


def actuator_constant(beam: Beam, patches: Patches) -> Array:
    """lambda_a [N m/V] of (14): bending moment per volt of an actuator alone on its face.

    lambda_a = F ((t_b + t_p)/2 - z_n); polarity chosen so that it is positive. Of a pair on both
    faces F (t_b + t_p).
    """
    arm = (beam.thickness + patches.thickness) / 2
    one = arm - one_sided_section(beam, patches).neutral_axis
    return actuator_force(patches) * jnp.where(jnp.asarray(patches.is_paired) > 0, 2 * arm, one)


def opposite_gain(beam: Beam, patches: Patches) -> Array:
    """What an actuator's moment gains where a sensor stiffens the other face [1].

    There the neutral axis is back in the middle: (t_b + t_p)/2 over (t_b + t_p)/2 - z_n.
    """
    arm = (beam.thickness + patches.thickness) / 2
    gain = arm / (arm - one_sided_section(beam, patches).neutral_axis) - 1
    return gain * patches.is_force * (1 - patches.is_paired) * (1 - patches.is_gauge)


def sensor_capacitance(patches: Patches) -> Array:
    """Capacitance C [F] of a clamped sensor, eps33T (1 - k31^2) b_p l_s/t_p; 6.7 nF by default.

    k31^2 = d31^2 E_p/eps33T. Into an amplifier's input R it makes a high-pass of corner 1/(R C).
    """
    permittivity = patches.relative_permittivity * VACUUM_PERMITTIVITY
    coupling = patches.d31**2 * patches.youngs_modulus / permittivity
    area = patches.width * patches.sensor_length
    return permittivity * (1 - coupling) * area / patches.thickness


def sensor_constant(beam: Beam, patches: Patches) -> Array:
    """lambda_s [V/rad] of (15): voltage per slope difference over the sensor.

    `sensor_gain` times the sensor's distance z_s from the neutral axis: (t_b + t_p)/2 of a piezo
    patch, since the actuator covers the other face; of a strain gauge t_b/2 + z_n, where z_n is the
    shift of the neutral axis towards the actuator on the other face.
    """
    piezo = (beam.thickness + patches.thickness) / 2
    shift = one_sided_section(beam, patches).neutral_axis * (1 - patches.is_paired)
    is_gauge = jnp.asarray(patches.is_gauge) > 0
    return sensor_gain(patches) * jnp.where(is_gauge, beam.thickness / 2 + shift, piezo)


def sensor_gain(patches: Patches) -> Array:
    """Voltage of a sensor per length by which it is drawn out [V/m].

    Of a piezo patch, open-circuit, b_p E_p |d31|/C with the clamped capacitance C. Of a strain
    gauge of length l_g, gauge factor k, excitation U, n active arms of four and gain g,
    U g (n/4) k/l_g (Hoffmann 1989).
    """
    gauge = patches.bridge * patches.gauge_factor / patches.sensor_length
    piezo = actuator_force(patches) / sensor_capacitance(patches)
    return jnp.where(jnp.asarray(patches.is_gauge) > 0, gauge, piezo)


def own_factors(patches: Patches) -> tuple[Array, Array]:
    """`sensor_factor` and `actuator_factor` of each patch [1], (3, K) each."""
    both, shape = (patches.sensor_factor, patches.actuator_factor), jnp.shape(patches.center)
    sensor, actuator = (jnp.broadcast_to(jnp.asarray(x), shape) for x in both)
    return sensor, actuator


def patch_constants(machine: Machine) -> tuple[Array, Array]:
    """lambda_s [V/rad] and lambda_a [N m/V] of each patch with its own factor, (3, K) each."""
    beam, patches = machine.beam, machine.patches
    both = sensor_constant(beam, patches), actuator_constant(beam, patches)
    lambda_s, lambda_a = (jnp.reshape(x, (-1, 1)) for x in both)
    seen, driven = own_factors(patches)
    return lambda_s * seen, lambda_a * driven


def outer_faces(beam: Beam, patches: Patches) -> tuple[Array, Array]:
    """Heights of the ceramics' outer faces over the neutral axis at the centre of a pair [m].

    Of the actuator's and the opposite one, t_b/2 + t_p and its negative. An actuator opposite to a
    strain gauge is alone and draws the neutral axis towards itself: twice t_b/2 + t_p - z_n.
    """
    is_alone = patches.is_gauge * (1 - patches.is_paired)
    shift = one_sided_section(beam, patches).neutral_axis * is_alone
    height = beam.thickness / 2 + patches.thickness - shift
    return height, height * (2 * is_alone - 1)


def patch_ends(center: Array, length: Array) -> tuple[Array, Array]:
    """Left and right end [m] of patches of a given length [m] at `center` [m]."""
    return center - length / 2, center + length / 2


def placement_faults(patches: Patches, length: Array) -> tuple[Array, Array]:
    """Whether any patch leaves its link, and whether any two pairs of a link overlap.

    Args:
        patches: patch data, () or (3,) fields; the longer of sensor and actuator decides.
        length: link length [m], () or (3,).

    Returns:
        (is_off_link, is_overlapping), boolean scalars.
    """
    longer = jnp.maximum(patches.sensor_length, patches.actuator_length)
    center = jnp.sort(jnp.asarray(patches.center), axis=-1)
    count = center.shape[:1]
    half = jnp.broadcast_to(longer / 2, count)[:, None]
    tolerance = 1e-12  # [m], so that patches that just touch are allowed in spite of rounding
    end = jnp.broadcast_to(jnp.asarray(length), count)[:, None]
    is_off = jnp.any(center - half < -tolerance) | jnp.any(center + half > end + tolerance)
    is_overlapping = jnp.any(jnp.diff(center, axis=-1) < 2 * half - tolerance)
    return is_off, is_overlapping
