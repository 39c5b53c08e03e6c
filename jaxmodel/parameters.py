"""The physical description of one machine: nested NamedTuples of numbers, all of them traced.

Nothing here is derived and nothing is static, so `jax.vmap`, `jax.grad` and `jax.jit` run over any
field. Per-link quantities have shape (3,); a scalar stands for three equal links. `paper_machine()`
is the machine of the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

Array = Any  # a JAX or NumPy array, or a Python number

#: Body angles psi [rad] of the platform joints for the two assemblies that fit the paper's text.
ASSEMBLIES = {
    "inward": (np.pi / 2, 7 * np.pi / 6, 11 * np.pi / 6),
    "outward": (3 * np.pi / 2, np.pi / 6, 5 * np.pi / 6),
}
#: Home pose (x [m], y [m], phi [rad]) of the paper.
HOME = (0.0, 0.0, np.pi / 6)


class Geometry(NamedTuple):
    """Guides and platform joints. The paper's guides are the sides of a triangle around O."""

    guide_side: Array  # a [m], ()
    guide_angle: Array  # alpha [rad], (3,)
    joint_radius: Array  # distance platform centre - C_i [m], () or (3,)
    joint_angle: Array  # psi, body angle of C_i [rad], (3,)
    guide_offset: Array = 0.0  # how much further from O than the side a guide lies [m], () or (3,)


class Masses(NamedTuple):
    """Rigid bodies."""

    platform_mass: Array  # m_p [kg], ()
    platform_inertia: Array  # I_p [kg m2], ()
    slider_mass: Array  # m_s [kg], () or (3,)
    payload_mass: Array = 0.0  # [kg], ()
    payload_inertia: Array = 0.0  # about its own centre of mass [kg m2], ()
    payload_offset: Array | None = None  # its centre of mass in the platform's axes [m], (2,)


class Beam(NamedTuple):
    """Flexible links of rectangular section, () or (3,) each."""

    length: Array  # L [m]
    thickness: Array  # t_b [m]
    width: Array  # [m]
    density: Array  # [kg/m3]
    youngs_modulus: Array  # E [Pa]
    stiffness_factor: Array  # true bending stiffness over the one controller and shaper assume [1]
    joint_inertia_b: Array  # rotary inertia J_B at the slider joint [kg m2]
    joint_inertia_c: Array  # rotary inertia J_C at the platform joint [kg m2]


class Patches(NamedTuple):
    """Pairs of sensor and actuator, which share a centre on opposite faces of the link.

    Actuators are piezo patches; sensors, too, or strain gauges on the bare face. () or (3,) each,
    except the centres.
    """

    center: Array  # [m], (3, n_patches)
    sensor_length: Array  # [m]
    actuator_length: Array  # [m]
    width: Array  # [m]
    thickness: Array  # t_p [m]
    youngs_modulus: Array  # E_p [Pa]
    d31: Array  # [C/N]
    relative_permittivity: Array  # eps33T/eps0 [1]
    density: Array  # [kg/m3]
    is_gauge: Array = 0.0  # 1: sensors are strain gauges, 0: piezo patches
    gauge_factor: Array = 2.1  # relative change of resistance over strain [1]
    bridge: Array = 2500.0  # amplified bridge voltage per relative change of resistance [V]
    gauge_noise: Array = 0.0  # of the bridge's amplifier, rms [V]
    hysteresis: Array = 0.0  # width of the actuators' loop, see `jaxmodel.hysteresis` [1], ()


class Damping(NamedTuple):
    """Structural damping of the links' modes: given ratios, and their continuation.

    Beyond the last given mode n, zeta_j = zeta_n (omega_j/omega_n)^p: p = 0 for a
    constant ratio, -1 for damping in proportion to mass, 1 to stiffness.
    """

    ratio: Array  # zeta by mode, the last one repeated where a link has fewer [1], (3, n)
    count: Array  # how many are given, (3,)
    exponent: Array  # p [1], ()


class Machine(NamedTuple):
    """All physical data of the mechanism with its patches."""

    geometry: Geometry
    masses: Masses
    beam: Beam
    patches: Patches
    damping: Damping


def paper_machine() -> Machine:
    """The paper's 3-PRR manipulator.

    Values not given in the paper (E, density, width, I_p, damping, PZT permittivity and
    density) are the estimates listed in docs/theory.md.
    """
    return Machine(
        geometry=Geometry(
            guide_side=0.6,
            guide_angle=np.array([2 * np.pi / 3, 4 * np.pi / 3, 0.0]),
            joint_radius=0.12 / np.sqrt(3.0),
            joint_angle=np.array(ASSEMBLIES["inward"]),
        ),
        masses=Masses(platform_mass=0.25, platform_inertia=3.0e-4, slider_mass=0.15),
        beam=Beam(
            length=0.2,
            thickness=2e-3,
            width=10e-3,
            density=2750.0,
            youngs_modulus=70e9,
            stiffness_factor=1.0,
            joint_inertia_b=0.0,
            joint_inertia_c=0.0,
        ),
        patches=Patches(
            center=np.tile([0.05, 0.10, 0.15], (3, 1)),
            sensor_length=0.010,
            actuator_length=0.030,
            width=0.010,
            thickness=0.2e-3,
            youngs_modulus=66e9,
            d31=-180e-12,
            relative_permittivity=1750.0,
            density=7800.0,
        ),
        damping=Damping(ratio=np.full((3, 1), 0.01), count=np.ones(3, int), exponent=0.0),
    )
