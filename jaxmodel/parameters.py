"""The physical description of one machine: nested NamedTuples of numbers, all of them traced.

Nothing here is derived and nothing is static, so `jax.vmap`, `jax.grad` and `jax.jit` run over any
field. Per-link quantities have shape (3,); a scalar stands for three equal links. `paper_machine()`
is the machine of the paper.
"""

from __future__ import annotations

from typing import Any, NamedTuple

Array = Any  # a JAX or NumPy array, or a Python number


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
    joint_inertia_b: Array  # rotary inertia J_B at the actuated joint [kg m2]
    joint_inertia_c: Array  # rotary inertia J_C at the platform joint [kg m2]


class Patches(NamedTuple):
    """Pairs of sensor and actuator, which share a centre on opposite faces of the link.

    Actuators are piezo patches; sensors, too, or strain gauges on the bare face. () or (3,) each,
    except the centres and factors of single patches. The controller knows no such factor.
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
    gauge_factor: Array = 2.1  # relative change of resistance over strain [1]
    gauge_noise: Array = 0.0  # of the bridge's amplifier, rms [V]
    hysteresis: Array = 0.0  # width of the actuators' loop, see `jaxmodel.hysteresis` [1], ()
    sensor_factor: Array = 1.0  # true over nominal volts of each sensor [1], () or (3, K)
    actuator_factor: Array = 1.0  # true over nominal force of each actuator [1], () or (3, K)
    strain_limit: Array = 4e-4  # tolerated strain of the ceramics [1], ()
    is_gauge: Array = 0.0  # 1: sensors are strain gauges, 0: piezo patches
    bridge: Array = 2500.0  # amplified bridge voltage per relative change of resistance [V]
    # 1: an actuator is a force at its distance from the section's own neutral axis, 0: a moment
    # as if no sensor were opposite
    is_force: Array = 0.0
    is_paired: Array = 0.0  # 1: actuators on both faces, of opposite polarity; 0: on one


class Damping(NamedTuple):
    """Structural damping of the links' modes: given ratios, and their continuation.

    Beyond the last given mode n, zeta_j = zeta_n (omega_j/omega_n)^p: p = 0 for a
    constant ratio, -1 for damping in proportion to mass, 1 to stiffness.
    """

    ratio: Array  # zeta by mode, the last one repeated where a link has fewer [1], (3, n)
    count: Array  # how many are given, (3,)
    exponent: Array  # p [1], ()
    stretch: Array = 0.01  # zeta of longitudinal modes at 1.5 kHz, in proportion to frequency [1]


class Machine(NamedTuple):
    """All physical data of the mechanism with its patches."""

    geometry: Any  # a mechanism's, see `jaxmodel.mechanisms.contract`
    masses: Masses
    beam: Beam
    patches: Patches
    damping: Damping
    joint_friction: Array = 0.0  # T, Coulomb torque at both joints of a link [N m], ()
    joint_friction_speed: Array = 0.02  # of its tanh [rad/s], ()

    @property
    def n_links(self) -> int:
        """Flexible links."""
        return int(self.patches.center.shape[-2])
