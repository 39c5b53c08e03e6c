"""How links lengthen: axial compliance, free extension by actuators, membrane voltage of sensors.

A patch on one face pushes with F = b_p E_p |d31| per volt, which bends its section and lengthens
it; the sensor on the other face reads extension against bending. Longitudinal modes of a link lie
far above the loop's, so one coordinate is enough, its elongation e. With the axial compliance
Lambda = int dx/EA, the tension N = (e - sum_l free_l V_l)/Lambda; sensor k adds
volts (strain_k N + sum_l local_kl V_l) to its voltage. docs/theory.md, "Patches as they are".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.beam import by_link
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Beam, Damping, Num, Patches
from jaxmodel.piezo import actuator_force, own_factors, sensor_gain
from jaxmodel.static import Pieces, link_pieces, patch_count, section_mass

#: Frequency at which `Damping.stretch` is the ratio of a longitudinal mode [rad/s].
REFERENCE = 2 * np.pi * 1500.0


class Stretch(NamedTuple):
    """Of all links; K pairs of patches each."""

    stiffness: Num[Array, "links"]  # 1/Lambda [N/m]
    damping: Num[Array, "links"]  # of the rate of e, in proportion to stiffness [N s/m]
    # int rhoA s^2 dx with the displacement s e, s(0) = 0 and s(L) = 1 [kg]
    mass: Num[Array, "links"]
    free: Num[Array, "links K"]  # elongation per volt without tension [m/V]
    strain: Num[Array, "links K"]  # mean over each sensor per newton of tension [1/N]
    local: Num[Array, "links K K"]  # the same per actuator volt without tension [1/V]
    volts: Num[Array, "links K"]  # of a sensor at such a strain of 1 [V]


def axial_stiffness(beam: Beam, patches: Patches, pieces: Pieces, has_patches: bool) -> Array:
    """E A of each piece [N], (n,).

    Args:
        beam, patches: one link's data.
        pieces: of that link.
        has_patches: patches stiffen the link (static).
    """
    stiffness = beam.youngs_modulus * beam.width * beam.thickness * jnp.ones_like(pieces.left)
    if has_patches:
        section = patches.youngs_modulus * patches.width * patches.thickness
        stiffness = stiffness + section * patch_count(patches, pieces)
    return stiffness * beam.stiffness_factor


def find_stretch(beam: Beam, patches: Patches, damping: Damping, has_patches: bool) -> Stretch:
    """Stretch of all links.

    Args:
        beam, patches: data of the links, () or (3,) fields; one row of centres per link.
        damping: `stretch` is read.
        has_patches: patches stiffen and load the links (static).
    """

    def one_link(beam: Beam, patches: Patches) -> tuple[Array, ...]:
        pieces = link_pieces(beam, patches)
        width = pieces.right - pieces.left
        soft = width / axial_stiffness(beam, patches, pieces, has_patches)
        compliance = jnp.sum(soft)
        end = jnp.cumsum(soft) / compliance
        start = end - soft / compliance
        line_mass = section_mass(beam, patches, pieces, has_patches)
        force, seen = actuator_force(patches), pieces.has_sensor * soft / patches.sensor_length
        return (
            1 / compliance,
            jnp.sum(line_mass * width * (start**2 + start * end + end**2)) / 3,
            force * (pieces.has_actuator @ soft) * (1 - patches.is_paired),
            jnp.sum(seen, axis=1),
            force * seen @ pieces.has_actuator.T * (1 - patches.is_paired),
            # what draws a sensor out bends it the other way: it reads against the bending
            -sensor_gain(patches) * patches.sensor_length,
        )

    links = by_link(beam, patches, jnp.zeros((1,)))[:2]
    seen, driven = own_factors(patches)
    stiffness, mass, free, strain, local, volts = jax.vmap(one_link)(*links)
    return Stretch(
        stiffness=stiffness,
        damping=2 * jnp.asarray(damping.stretch) / REFERENCE * stiffness,
        mass=mass,
        free=driven * free,
        strain=strain,
        local=local * driven[:, None],
        volts=volts[:, None] * seen,
    )


def held_voltage(stretch: Stretch) -> Array:
    """Sensor volts per actuator volt of links that cannot lengthen [V/V], (3, K, K)."""
    return stretch.volts[:, :, None] * held_strain(stretch)


def held_strain(stretch: Stretch) -> Array:
    """Mean strain over the sensors per actuator volt of such links [1/V], (3, K, K)."""
    tension = stretch.free * stretch.stiffness[:, None]
    return stretch.local - stretch.strain[:, :, None] * tension[:, None]
