"""One case of a study: `Case` holds the traced numbers, `Structure` what shapes the program.

Cases of equal structure stack into one batch and share one compilation.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.motion import Path
from jaxmodel.parameters import Array, Machine, Num, PerLink
from jaxmodel.state_space import StateSpace

#: States of a motor that follows late.
MOTOR_ORDER = 3


class Structure(NamedTuple):
    """Static and hashable: array sizes and the few choices that change the program."""

    mechanism: str = "prrr"  # name in `jaxmodel.mechanisms.MECHANISMS`
    n_modes: int = 8  # R, plant modes per link (upper bound; `Case.n_modes` may be fewer)
    n_controlled: int = 3  # C, controlled modes per link (upper bound; `Control.n_active`)
    n_patches: int = 3  # K, patch pairs per link
    n_steps: int = 8000  # samples in the run
    substeps: int = 1  # plant steps per sample
    n_frequencies: int = 9  # points of the power spectral density per controlled mode
    basis: str = "pinned_pinned"  # of the plant
    has_shortening: bool = True  # bent links have shorter chords (none in basis pinned_free)
    is_distributed: bool = False  # every point of a bent link moves inwards, not half of it with C
    has_stretch: bool = False  # links lengthen (in bases whose ends are on the chord)
    has_static_correction: bool = True  # static response of the modes that are left out
    is_coupled: bool = True  # False: kineto-elastodynamics, bending does not act back
    has_wrench: bool = False  # force and moment on the platform
    has_payload_offset: bool = False  # the payload's centre of mass is off the reference point
    controller_basis: str = "pinned_pinned"
    feedback: str = "sampled"  # "sampled", "ideal" or "none"
    law: str = "imsc"  # name in `jaxmodel.laws.LAWS`
    drive: str = "pd"  # name in `jaxmodel.drives.DRIVES`
    has_sensor_highpass: bool = False  # patches drained by their amplifiers' inputs
    has_amplifier: bool = False  # actuators behind amplifiers of finite bandwidth
    has_delay: bool = False  # commands arrive later or earlier than after one sample
    has_notch: bool = False  # notch filters before the feedback
    has_hysteresis: bool = False  # of the actuators, near their voltage limit
    has_noise: bool = False  # seeded ADC noise and force ripple
    has_friction: bool = False  # Coulomb friction of the drives
    has_joint_friction: bool = False  # pin joints rub
    has_drive_lag: bool = False  # motors follow their commands late
    has_poles: bool = False  # gains follow from poles
    has_position_gain: bool = True  # feedback of modal positions, not of velocities alone
    metrics: tuple[str, ...] = ()  # to accumulate; (): all of them
    is_linear: bool = False  # mechanics to first order about rest at the last way-point
    is_smooth: bool = False  # for gradients: noise instead of rounding, limits with round corners

    @property
    def n_links(self) -> int:
        """Flexible links, each with an actuated joint."""
        return MECHANISMS[self.mechanism].n_links

    @property
    def n_pose(self) -> int:
        """Coordinates of the platform."""
        return MECHANISMS[self.mechanism].n_pose

    @property
    def n_coordinates(self) -> int:
        """Coordinates of a link, which are its modes and, if it has one, its elongation."""
        return self.n_modes + self.has_stretch

    @property
    def n_motors(self) -> int:
        """States of motors that follow late."""
        return MOTOR_ORDER * self.n_links * self.has_drive_lag

    @property
    def n_sensors(self) -> int:
        """Patch pairs of the machine."""
        return self.n_links * self.n_patches

    def without_run(self) -> Structure:
        """Machine, controller and electronics: what a loop about rest depends on."""
        return self._replace(
            n_steps=1,
            substeps=1,
            n_frequencies=1,
            has_hysteresis=False,
            has_noise=False,
            metrics=(),
            is_linear=False,
            is_smooth=True,
        )

    @property
    def is_delayed(self) -> bool:
        """Whether commands change within samples."""
        return self.has_delay and self.feedback == "sampled"

    @property
    def plant_steps(self) -> int:
        """Plant steps in a sample, `substeps` before and as many after a command changes."""
        return self.substeps * (2 if self.is_delayed else 1)


class Control(NamedTuple):
    """Controller settings; masks are 1 or 0."""

    n_active: Num[Array, ""]  # number of controlled modes
    link_mask: Num[Array, "links"]  # controlled links
    mode_mask: Num[Array, "links C"]  # controlled modes of each link
    # nominal frequencies of the assembled links [rad/s]; 0: its basis's
    omega: Num[Array, "links C"]
    velocity_gain: Num[Array, "links"]  # k_d of mode 1 [N s/m] or [1/s]; SRF: [s]
    position_gain: Num[Array, "links"]  # k_p of mode 1 [N/m] or [1/s2]; SRF: [1]
    ratio: Num[Array, "links C"]  # EMC ratios (24) [1]
    damping: Num[Array, "links C"]  # added damping ratio specified [1]; negative: none
    pole_decay: Num[Array, "links C"]  # alpha-bar asked [1/s]; 0: none asked
    pole_frequency: Num[Array, "links C"]  # beta-bar asked [rad/s]; 0: the mode's own
    gain_factor: Num[Array, ""]  # factor on the loop gain, whatever the law [1]
    is_per_mass: Num[Array, ""]  # 1: gains in 1/s and 1/s2, 0: in N s/m and N/m
    feedthrough_factor: Num[Array, ""]  # share of the residual modes' feed-through compensated [1]
    notch: Num[Array, "links"]  # frequency of the links' notch filters [rad/s]; 0: none
    notch_depth: Num[Array, "links"]  # their gain there [1]
    notch_width: Num[Array, "links"]  # stop band over frequency [1]
    parameters: dict[str, Num[Array, "links"]]  # the law's own, by name
    system: StateSpace | None = None  # controller from a file


class Electronics(NamedTuple):
    """Sampling, converters and the velocity estimate."""

    period: Num[Array, ""]  # T [s]
    antialias: Num[Array, ""]  # corner of the Butterworth filter [rad/s]
    sensor_highpass: Num[Array, ""]  # corner 1/(R C) of a patch into its amplifier [rad/s]
    amplifier_lag: Num[Array, ""]  # time constant of the actuators' amplifiers [s]
    delay: Num[Array, ""]  # from a sample to its command on the actuators [samples]
    unmodelled_delay: Num[Array, ""]  # more of it, which the controller does not know [samples]
    conditioner_gain: Num[Array, ""]  # ADC volt per sensor volt [1]
    conditioner_bias: Num[Array, ""]  # [V]
    adc_range: Num[Array, ""]  # full scale, from 0 [V]
    adc_levels: Num[Array, ""]  # 2^bits [1]
    adc_noise: Num[Array, ""]  # rms, at the ADC input [V]
    voltage_limit: Num[Array, ""]  # actuator limit [V]
    estimator: Num[Array, ""]  # index in `estimator.KINDS`
    highpass: Num[Array, ""]  # [rad/s]
    lowpass_ratio: Num[Array, "C"]  # kappa [1]
    lowpass_zeta: Num[Array, "C"]  # [1]
    difference_cutoff: Num[Array, ""]  # [rad/s]


class Shaping(NamedTuple):
    """Input shaper of the reference, one entry per shaped frequency."""

    kind: Num[Array, ""]  # position in `shaper.SHAPERS`
    omega: Num[Array, "n"]  # [rad/s], 0: mode 1 of the nominal model
    zeta: Num[Array, "n"]  # [1]
    tolerance: Num[Array, ""]  # V of the EI family [1]
    is_exact: Num[Array, ""]  # 1: impulses split exactly for their mode, 0: linearly


class Drive(NamedTuple):
    """Drives and their disturbances."""

    kp: PerLink  # [N/m]
    kd: PerLink  # [N s/m]
    # platform and payload that computed torque assumes, over the true [1]
    model_mass: Num[Array, ""]
    force_limit: PerLink  # [N]
    coulomb_friction: PerLink  # [N]
    friction_speed: PerLink  # speed of the tanh [m/s]
    viscous_friction: PerLink  # [N s/m]
    lag: Num[Array, ""]  # dead time from a command to the motors' force [s]
    ripple: PerLink  # seeded force ripple, rms [N]
    pulse_force: Num[Array, "links"]  # disturbance [N]
    pulse_start: Num[Array, ""]  # [s]
    pulse_length: Num[Array, ""]  # [s]
    is_locked: Num[Array, ""]  # 1: drives held (bases with Y(L) = 0)
    parameters: dict[str, PerLink]  # the drive's own, by name


class Load(NamedTuple):
    """Force and moment on the platform at its reference point [N, N, N m]."""

    wrench: Num[Array, "pose"]  # steady; the run starts in equilibrium with it
    pulse: Num[Array, "pose"]  # disturbance on top
    pulse_start: Num[Array, ""]  # [s]
    pulse_length: Num[Array, ""]  # [s]


class Initial(NamedTuple):
    """State at t = 0 beyond rest at the first way-point."""

    modal: Num[Array, "links R"]  # q [m]
    load_station: Num[Array, ""]  # where a static transverse load bends the links [m]
    load_deflection: Num[Array, "links"]  # chord deflection there [m]


class Windows(NamedTuple):
    """Windows, limits and stations of the metrics."""

    residual_delay: Num[Array, ""]  # from the end of the shaped command [s]
    residual_length: Num[Array, ""]  # [s]
    settling_band: Num[Array, ""]  # chord deflection [m]
    saturation_limit: Num[Array, ""]  # tolerated fraction of saturated samples [1]
    arrival_tolerance: Num[Array, ""]  # tolerated rms error of a joint's place in the window [m]
    singularity_margin: Num[Array, ""]  # tolerated distance of link angles from 0 and 90 deg [rad]
    condition_limit: Num[Array, ""]  # tolerated condition number [1]
    # where chord deflection is taken, over the links' lengths [1]
    stations: Num[Array, "S"] | Num[Array, "links S"]


class Case(NamedTuple):
    """Every number of one closed-loop run."""

    machine: Machine
    n_modes: Num[Array, ""]  # plant modes per link in use
    path: Path
    shaping: Shaping
    control: Control
    electronics: Electronics
    drive: Drive
    load: Load
    initial: Initial
    windows: Windows
    seed: Num[Array, ""]  # of ADC noise and ripple


def uncontrolled(case: Case) -> Case:
    """The same case, or cases, with no link controlled."""
    return case._replace(control=case.control._replace(link_mask=0 * case.control.link_mask))


def with_ratio(case: Case, ratio: Array) -> Case:
    """The same case, or cases, with other EMC ratios (24) [1], (..., 3, C)."""
    ratio = jnp.asarray(ratio, jnp.result_type(float))
    return case._replace(control=case.control._replace(ratio=ratio))
