"""One case of a study: `Case` holds the traced numbers, `Structure` what shapes the program.

Cases of equal structure stack into one batch and share one compilation.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.lazy import jnp
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.motion import Path
from jaxmodel.parameters import Array, Machine
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
        """Coordinates of a link: its modes, and its elongation if it has one."""
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
        """Plant steps in a sample: `substeps`, before and after a command changes."""
        return self.substeps * (2 if self.is_delayed else 1)


class Control(NamedTuple):
    """Controller settings; masks are 1 or 0."""

    n_active: Array  # number of controlled modes, ()
    link_mask: Array  # controlled links, (3,)
    mode_mask: Array  # controlled modes of each link, (3, C)
    omega: Array  # nominal frequencies of the assembled links [rad/s]; 0: its basis's, (3, C)
    velocity_gain: Array  # k_d of mode 1 [N s/m] or [1/s], (3,); SRF: [s]
    position_gain: Array  # k_p of mode 1 [N/m] or [1/s2], (3,); SRF: [1]
    ratio: Array  # EMC ratios (24) [1], (3, C)
    damping: Array  # added damping ratio specified [1]; negative: none, (3, C)
    pole_decay: Array  # alpha-bar asked [1/s]; 0: none asked, (3, C)
    pole_frequency: Array  # beta-bar asked [rad/s]; 0: the mode's own, (3, C)
    gain_factor: Array  # factor on the loop gain, whatever the law [1], ()
    is_per_mass: Array  # 1: gains in 1/s and 1/s2, 0: in N s/m and N/m, ()
    feedthrough_factor: Array  # share of the residual modes' feed-through compensated [1], ()
    notch: Array  # frequency of the links' notch filters [rad/s]; 0: none, (3,)
    notch_depth: Array  # their gain there [1], (3,)
    notch_width: Array  # stop band over frequency [1], (3,)
    parameters: dict[str, Array]  # the law's own, by name, (3,) each
    system: StateSpace | None = None  # controller from a file


class Electronics(NamedTuple):
    """Sampling, converters and the velocity estimate."""

    period: Array  # T [s], ()
    antialias: Array  # corner of the Butterworth filter [rad/s], ()
    sensor_highpass: Array  # corner 1/(R C) of a patch into its amplifier [rad/s], ()
    amplifier_lag: Array  # time constant of the actuators' amplifiers [s], ()
    delay: Array  # from a sample to its command on the actuators [samples], ()
    unmodelled_delay: Array  # more of it, which the controller does not know [samples], ()
    conditioner_gain: Array  # ADC volt per sensor volt [1], ()
    conditioner_bias: Array  # [V], ()
    adc_range: Array  # full scale, from 0 [V], ()
    adc_levels: Array  # 2^bits [1], ()
    adc_noise: Array  # rms, at the ADC input [V], ()
    voltage_limit: Array  # actuator limit [V], ()
    estimator: Array  # index in `estimator.KINDS`, ()
    highpass: Array  # [rad/s], ()
    lowpass_ratio: Array  # kappa [1], (C,)
    lowpass_zeta: Array  # [1], (C,)
    difference_cutoff: Array  # [rad/s], ()


class Shaping(NamedTuple):
    """Input shaper of the reference, one entry per shaped frequency."""

    kind: Array  # position in `shaper.SHAPERS`, ()
    omega: Array  # [rad/s], 0: mode 1 of the nominal model, (n,)
    zeta: Array  # [1], (n,)
    tolerance: Array  # V of the EI family [1], ()
    is_exact: Array  # 1: impulses split exactly for their mode, 0: linearly, ()


class Drive(NamedTuple):
    """Drives and their disturbances; (3,) or ()."""

    kp: Array  # [N/m]
    kd: Array  # [N s/m]
    model_mass: Array  # platform and payload that computed torque assumes, over the true [1], ()
    force_limit: Array  # [N]
    coulomb_friction: Array  # [N]
    friction_speed: Array  # speed of the tanh [m/s]
    viscous_friction: Array  # [N s/m]
    lag: Array  # dead time from a command to the motors' force [s], ()
    ripple: Array  # seeded force ripple, rms [N]
    pulse_force: Array  # disturbance [N], (3,)
    pulse_start: Array  # [s], ()
    pulse_length: Array  # [s], ()
    is_locked: Array  # 1: drives held (bases with Y(L) = 0), ()
    parameters: dict[str, Array]  # the drive's own, by name


class Load(NamedTuple):
    """Force and moment on the platform at its reference point [N, N, N m]."""

    wrench: Array  # steady; the run starts in equilibrium with it, (3,)
    pulse: Array  # disturbance on top, (3,)
    pulse_start: Array  # [s], ()
    pulse_length: Array  # [s], ()


class Initial(NamedTuple):
    """State at t = 0 beyond rest at the first way-point."""

    modal: Array  # q [m], (3, R)
    load_station: Array  # where a static transverse load bends the links [m], ()
    load_deflection: Array  # chord deflection there [m], (3,)


class Windows(NamedTuple):
    """Windows, limits and stations of the metrics."""

    residual_delay: Array  # from the end of the shaped command [s], ()
    residual_length: Array  # [s], ()
    settling_band: Array  # chord deflection [m], ()
    saturation_limit: Array  # tolerated fraction of saturated samples [1], ()
    arrival_tolerance: Array  # tolerated rms error of a joint's place in the window [m], ()
    singularity_margin: Array  # tolerated distance of link angles from 0 and 90 deg [rad], ()
    condition_limit: Array  # tolerated condition number [1], ()
    stations: Array  # where chord deflection is taken, over the links' lengths [1], (S,) or (3, S)


class Case(NamedTuple):
    """Every number of one closed-loop run."""

    machine: Machine
    n_modes: Array  # plant modes per link in use, ()
    path: Path
    shaping: Shaping
    control: Control
    electronics: Electronics
    drive: Drive
    load: Load
    initial: Initial
    windows: Windows
    seed: Array  # of ADC noise and ripple, ()


def uncontrolled(case: Case) -> Case:
    """The same case, or cases, with no link controlled."""
    return case._replace(control=case.control._replace(link_mask=0 * case.control.link_mask))


def with_ratio(case: Case, ratio: Array) -> Case:
    """The same case, or cases, with other EMC ratios (24) [1], (..., 3, C)."""
    ratio = jnp.asarray(ratio, jnp.result_type(float))
    return case._replace(control=case.control._replace(ratio=ratio))
