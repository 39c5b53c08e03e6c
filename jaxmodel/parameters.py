"""The physical description of one machine: nested NamedTuples of numbers, all of them traced.

Nothing here is derived and nothing is static, so `jax.vmap`, `jax.grad` and `jax.jit` run over any
field. `paper_machine()` is the machine of the paper.

The package writes axes of arrays as jaxtyping does: `links` flexible links, `pose` coordinates of
the platform; R plant modes, C controlled modes and Q coordinates of a link, its modes and, if it
lengthens, its elongation; K patches and S stations on it. Other letters belong to one class.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any, NamedTuple, TypeAlias

if TYPE_CHECKING:
    from jaxtyping import Complex as Complex
    from jaxtyping import Int as Int
    from jaxtyping import Num as Num
    from jaxtyping import Shaped as Shaped
else:  # what checkers take them for; jaxtyping itself would be slow to import
    Complex = Int = Num = Shaped = Annotated

Array = Any  # a JAX or NumPy array, or a Python number
#: A scalar stands for equal links.
PerLink: TypeAlias = Num[Array, ""] | Num[Array, "links"]


class Masses(NamedTuple):
    """Rigid bodies."""

    platform_mass: Num[Array, ""]  # m_p [kg]
    platform_inertia: Num[Array, ""]  # I_p [kg m2]
    slider_mass: PerLink  # m_s [kg]
    payload_mass: Num[Array, ""] = 0.0  # [kg]
    payload_inertia: Num[Array, ""] = 0.0  # about its own centre of mass [kg m2]
    payload_offset: Num[Array, "2"] | None = None  # its centre of mass in the platform's axes [m]


class Beam(NamedTuple):
    """Flexible links of rectangular section."""

    length: PerLink  # L [m]
    thickness: PerLink  # t_b [m]
    width: PerLink  # [m]
    density: PerLink  # [kg/m3]
    youngs_modulus: PerLink  # E [Pa]
    # true bending stiffness over the one controller and shaper assume [1]
    stiffness_factor: PerLink
    joint_inertia_b: PerLink  # rotary inertia J_B at the actuated joint [kg m2]
    joint_inertia_c: PerLink  # rotary inertia J_C at the platform joint [kg m2]


class Patches(NamedTuple):
    """Pairs of sensor and actuator, which share a centre on opposite faces of the link.

    Actuators are piezo patches; sensors, too, or strain gauges on the bare face. The
    controller knows no factor of single patches.
    """

    center: Num[Array, "links K"]  # [m]
    sensor_length: PerLink  # [m]
    actuator_length: PerLink  # [m]
    width: PerLink  # [m]
    thickness: PerLink  # t_p [m]
    youngs_modulus: PerLink  # E_p [Pa]
    d31: PerLink  # [C/N]
    relative_permittivity: PerLink  # eps33T/eps0 [1]
    density: PerLink  # [kg/m3]
    gauge_factor: PerLink = 2.1  # relative change of resistance over strain [1]
    gauge_noise: PerLink = 0.0  # of the bridge's amplifier, rms [V]
    hysteresis: Num[Array, ""] = 0.0  # width of the actuators' loop, see `jaxmodel.hysteresis` [1]
    # true over nominal volts of each sensor [1]
    sensor_factor: Num[Array, ""] | Num[Array, "links K"] = 1.0
    # true over nominal force of each actuator [1]
    actuator_factor: Num[Array, ""] | Num[Array, "links K"] = 1.0
    strain_limit: Num[Array, ""] = 4e-4  # tolerated strain of the ceramics [1]
    is_gauge: PerLink = 0.0  # 1: sensors are strain gauges, 0: piezo patches
    bridge: PerLink = 2500.0  # amplified bridge voltage per relative change of resistance [V]
    # 1: an actuator is a force at its distance from the section's own neutral axis, 0: a moment
    # as if no sensor were opposite
    is_force: PerLink = 0.0
    is_paired: PerLink = 0.0  # 1: actuators on both faces, of opposite polarity; 0: on one


class Damping(NamedTuple):
    """Structural damping of the links' modes: given ratios, and their continuation.

    Beyond the last given mode n, zeta_j = zeta_n (omega_j/omega_n)^p: p = 0 for a
    constant ratio, -1 for damping in proportion to mass, 1 to stiffness.
    """

    ratio: Num[Array, "links n"]  # zeta by mode, the last one repeated where a link has fewer [1]
    count: Num[Array, "links"]  # how many are given
    exponent: Num[Array, ""]  # p [1]
    # zeta of longitudinal modes at 1.5 kHz, in proportion to frequency [1]
    stretch: Num[Array, ""] = 0.01


class Machine(NamedTuple):
    """All physical data of the mechanism with its patches."""

    geometry: Any  # a mechanism's, see `jaxmodel.mechanisms.contract`
    masses: Masses
    beam: Beam
    patches: Patches
    damping: Damping
    joint_friction: Num[Array, ""] = 0.0  # T, Coulomb torque at both joints of a link [N m]
    joint_friction_speed: Num[Array, ""] = 0.02  # of its tanh [rad/s]

    @property
    def n_links(self) -> int:
        """Flexible links."""
        return int(self.patches.center.shape[-2])
