"""The study file: every field with unit, default and allowed range; the only place for defaults.

`load_study(path)` reads TOML into a frozen `Study`, or raises `StudyError` naming field, value,
allowed range, unit and the nearest valid name. `studies.study.cases` turns a `Study` into arrays.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, ValidationError

from jaxmodel.delay import LONGEST
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import DriveLaw
from jaxmodel.estimator import KINDS
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.prrr import PRRR
from jaxmodel.motion import PROFILES
from jaxmodel.numbers import OWN_DRIVES as OWN_DRIVES
from jaxmodel.numbers import OWN_LAWS as OWN_LAWS
from jaxmodel.numbers import OWN_MECHANISMS as OWN_MECHANISMS
from jaxmodel.shaper import SHAPERS
from jaxmodel.table import Table
from studies.errors import StudyError, field_error
from studies.study.choices import OWN, OneOf
from studies.study.consistency import check_consistency
from studies.study.explain import explain
from studies.study.files import READY, read_toml
from studies.study.links import Basis as Basis
from studies.study.links import EachLink, EachMode, LinkSection, ListALink, OneALink, PatchesSection
from studies.study.links import Zeta as Zeta
from studies.study.section import DESIGN as DESIGN
from studies.study.section import MACHINE as MACHINE
from studies.study.section import Section as Section
from studies.study.section import described as described
from studies.study.sizes import (
    COORDINATE,
    default_path,
    for_mechanism,
    lengths,
    mechanism_of,
    own_defaults,
)
from studies.study.state_space import with_matrices

#: Own fields of control laws, drives and mechanisms, by their place.
OWN_FIELDS: dict[str, Table[Law] | Table[DriveLaw] | Table[Mechanism]] = {
    OWN_LAWS: LAWS,
    OWN_DRIVES: DRIVES,
    OWN_MECHANISMS: MECHANISMS,
}
#: Value of `metrics.residual_delay` that leaves the number to `studies.study.window`.
AUTO = "auto"


# numbers within bounds, as entries of a list
Coordinate = Annotated[float, Field(ge=-10, le=10)]
Deflection = Annotated[float, Field(ge=-0.1, le=0.1)]
Force = Annotated[float, Field(ge=-1e4, le=1e4)]
Pose = Annotated[tuple[Coordinate, ...], COORDINATE]
Wrench = Annotated[tuple[Force, ...], COORDINATE]
Gain = Annotated[float, Field(ge=-1e9, le=1e9)]
NotchHertz = Annotated[float, Field(ge=0, le=1e5)]
Share = Annotated[float, Field(ge=0, le=1)]
Width = Annotated[float, Field(ge=1e-3, le=10)]
Hertz = Annotated[float, Field(ge=0.1, le=1e5)]
Time = Annotated[float, Field(ge=1e-4, le=100)]
Pause = Annotated[float, Field(ge=0, le=100)]
Degrees = Annotated[float, Field(ge=-360, le=360)]
Offset = Annotated[float, Field(ge=-1, le=1)]
Matrix = tuple[tuple[float, ...], ...]
Decay = Annotated[float, Field(gt=0, le=1e6)]
OwnOrHertz = Annotated[float, Field(ge=0, le=1e5)]


class OwnFields:
    """Annotation of `control.laws` and its like: describes what they can hold."""

    def __init__(self, place: str) -> None:
        """
        Args:
            place: in `OWN_FIELDS`.
        """
        self._place = place

    @property
    def allowed(self) -> str:
        table = OWN_FIELDS[self._place]
        tables = [
            f"{entry.name}.{x.name} ({x.text} [{x.unit}], {x.low:g} to {x.high:g}; {x.default:g})"
            for entry in table.values()
            for x in entry.parameters
        ]
        return f"tables by {table.kind}; {', '.join(tables)}"


class RunSection(Section):
    """Duration, resolution and model of the run."""

    duration: float = described(0.5, "s", "length of the run", gt=0, le=100)
    seed: int = described(0, "1", "of ADC noise and force ripple", ge=0, le=10**9)
    substeps: int = described(0, "1", "plant steps per sample; 0: as many as needed", ge=0, le=200)
    smooth: bool = described(False, "-", "smooth limits, noise instead of rounding (for gradients)")
    model: Literal["coupled", "ked"] = described(
        "coupled", "-", "ked: rigid motion bends the links, without feedback (two passes)"
    )


class MachineSection(Section):
    """Mechanism and platform."""

    kind: Annotated[str, OneOf(lambda: MECHANISMS, OWN)] = described(
        "prrr", "-", "mechanism; prrr: sliders on guides; rrr, five_bar: cranks"
    )
    kinds: Annotated[dict[str, dict[str, EachLink[float]]], OwnFields(OWN_MECHANISMS)] = described(
        {}, "-", "fields of the mechanisms, by kind"
    )
    guide_side: float = described(
        0.6, "m", "side of the guide triangle", ge=0.01, le=10, free=MACHINE
    )
    guide_angles_deg: OneALink[Degrees] = described(
        (120.0, 240.0, 0.0), "deg", "direction alpha of each guide; the platform is on its left"
    )
    guide_offsets: EachLink[Annotated[float, Field(ge=-10, le=10)]] = described(
        0.0, "m", "offset of each guide outwards from its side of the triangle"
    )
    assembly: Literal["inward", "outward"] = described(
        "inward", "-", "which of the paper's two assemblies: joints at 90, 210, 330 deg or opposite"
    )
    joint_angles_deg: tuple[()] | OneALink[Degrees] = described(
        (), "deg", "of the platform's joints in its own axes; empty: according to assembly"
    )
    joint_radius: EachLink[Annotated[float, Field(ge=1e-4, le=5)]] = described(
        round(0.12 / 3**0.5, 12),
        "m",
        "distance of the joints from the platform's reference point",
        free=MACHINE,
    )
    platform_mass: float = described(0.25, "kg", "mass m_p", ge=1e-3, le=1e3, free=DESIGN)
    platform_inertia: float = described(
        3.0e-4, "kg m2", "I_p about the reference point", ge=1e-7, le=1e2, free=DESIGN
    )
    slider_mass: EachLink[Annotated[float, Field(ge=1e-3, le=1e3)]] = described(
        0.15, "kg", "m_s of each slider", free=DESIGN
    )
    joint_friction: float = described(
        0.0,
        "N m",
        "T of T tanh(omega/omega_0) at both joints of each link; small ball bearings 5e-5 to 5e-4",
        ge=0,
        le=1,
        free=MACHINE,
    )
    joint_friction_speed: float = described(0.02, "rad/s", "omega_0", gt=0, le=10)


class MotionSection(Section):
    """The platform's path: point-to-point moves."""

    waypoints: tuple[Pose, ...] = described(
        default_path(PRRR),
        "m, m, rad",
        "poses (x, y, phi) to visit, (x, y) of a point",
        min_length=1,
        max_length=100,
    )
    move_time: Time | tuple[Time, ...] = described(0.03, "s", "t_f of each move, or one per move")
    dwell: Pause | tuple[Pause, ...] = described(0.0, "s", "pause after each move, or one per move")
    profile: Annotated[str, OneOf(lambda: PROFILES)] = described("cycloid", "-", "cycloid is (25)")


class ShaperSection(Section):
    """Input shaper on the motion."""

    kind: Annotated[str, OneOf(lambda: SHAPERS)] = described("none", "-", "ei is the paper's (13)")
    frequencies_hz: tuple[Hertz, ...] = described(
        (),
        "Hz",
        "modes to shape for, in series; empty: mode 1 of the controller's model",
        max_length=3,
        free=DESIGN,
    )
    damping_ratio: float = described(
        0.01, "1", "zeta assumed by the shaper", ge=0, lt=0.9, free=DESIGN
    )
    tolerance: float = described(0.05, "1", "V of the EI family", ge=0, lt=1, free=DESIGN)
    split: Literal["linear", "exact"] = described("linear", "-", "impulses onto the sample grid")


class ControlSection(Section):
    """Active vibration control of the links."""

    feedback: Literal["sampled", "ideal", "none"] = described(
        "sampled", "-", "digital loop, the paper's continuous state feedback, or none"
    )
    law: Annotated[str, OneOf(lambda: LAWS, OWN)] = described("imsc", "-", "control law")
    laws: Annotated[dict[str, dict[str, EachLink[float]]], OwnFields(OWN_LAWS)] = described(
        {}, "-", "fields of the laws, by law"
    )
    basis: Basis = described("loaded", "-", "modal basis of the controller's model")
    modes: int = described(3, "1", "controlled modes per link", ge=1, le=12)
    frequencies_hz: tuple[Hertz, ...] | ListALink[Hertz] = described(
        (),
        "Hz",
        "measured frequencies of the assembled links, by mode; one list for all links, or one "
        "each; others as in control.basis",
    )
    links: OneALink[bool] = described((True,) * PRRR.n_links, "-", "controlled links")
    mode_mask: tuple[()] | ListALink[bool] = described(
        (), "-", "on/off per link and controlled mode; empty: all on"
    )
    velocity_gain: OneALink[Gain] = described(
        (0.85, 0.95, 0.95),
        "N s/m, 1/s or s",
        "k_d of mode 1 per link; the paper's are 3.1, 3.5, 3.4",
        free=DESIGN,
    )
    position_gain: OneALink[Gain] = described(
        (0.0,) * PRRR.n_links, "N/m or 1/s2", "k_p of mode 1 per link (SRF: 1)", free=DESIGN
    )
    damping: EachMode[Zeta] = described(
        (),
        "1",
        "added damping ratio, beside link.damping_ratio, from which the gains follow; natural "
        "frequencies are kept: one number, or one a link, is that of mode 1, others by (24); or "
        "one list a link by mode; 0: none, empty: gains or decays as below; for "
        "gain_factor = 1, another factor scales gains, not ratios",
        free=DESIGN,
    )
    pole_decay: EachMode[Decay] = described(
        (),
        "1/s",
        "alpha of the specified poles -alpha +- j beta, from which the gains follow: one "
        "number for all modes, one a link, or one list a link by mode, others by (24)",
        free=DESIGN,
    )
    pole_frequency_hz: EachMode[OwnOrHertz] = described(
        (),
        "Hz",
        "beta/2 pi of these poles, by mode; empty or 0: the mode keeps its frequency",
        free=DESIGN,
    )
    gain_unit: Literal["N s/m", "1/s"] = described(
        "N s/m", "-", "modal force or modal acceleration"
    )
    ratios: ListALink[Gain] = described(
        ((1.0, 0.345, 0.045), (1.0, 0.304, 0.041), (1.0, 0.321, 0.038)),
        "1",
        "efficient modal control (EMC): ratios k_dj : k_d1 per link (24); missing ones are 0",
        free=DESIGN,
    )
    ratio_source: Literal["given", "own_run"] = described(
        "given", "-", "ratios as given, or from the same case's uncontrolled run by (24)"
    )
    ratio_exponent: float = described(
        1.0, "1", "exponent on the ratios: 0 makes all gains equal", ge=0, le=10
    )
    gain_factor: float = described(
        1.0,
        "1",
        "factor on the loop gain: it multiplies the controller's output, whatever the law",
        ge=0,
        le=1e3,
        free=DESIGN,
    )
    feedthrough_factor: float = described(
        0.0, "1", "subtracted share of the residual modes' feed-through", ge=0, le=1, free=DESIGN
    )
    notch_hz: OneALink[NotchHertz] = described(
        (0.0,) * PRRR.n_links,
        "Hz",
        "notch filter of each link between sensors and feedback; 0: none",
    )
    notch_depth: OneALink[Share] = described(
        (0.1,) * PRRR.n_links, "1", "its gain at that frequency", free=DESIGN
    )
    notch_width: OneALink[Width] = described(
        (0.2,) * PRRR.n_links, "1", "width of its stop band over that frequency", free=DESIGN
    )

    @property
    def has_poles(self) -> bool:
        """Whether the gains follow from specified poles."""
        return self.damping != () or self.pole_decay != ()


class StateSpaceSection(Section):
    """Your own controller for control.law = 'state_space': x_(k+1) = A x + B y, u = C x + D y."""

    # y: sensor voltages; u: actuator voltages, which go out one sample later
    file: str = described("", "-", "JSON, NPZ or MAT with A, B, C, D and dt, beside this file")
    sample_time: float = described(0.0, "s", "which must be the machine's", ge=0, le=1)
    a: Matrix = described((), "1", "A; a field replaces the file")
    b: Matrix = described((), "1/V", "B")
    c: Matrix = described((), "V", "C")
    d: Matrix = described((), "1", "D; empty: 0")
    anti_windup: Matrix = described(
        (),
        "1/V",
        "E: x_(k+1) gains E (v - u) where u is limited to v, as observers need it; empty: 0",
    )
    inputs: tuple[str, ...] = described(
        (), "-", "sensors, 'sensor LINK.PATCH'; empty: all, or those of a link for each link"
    )
    outputs: tuple[str, ...] = described((), "-", "actuators, 'actuator LINK.PATCH'; the same")


class ElectronicsSection(Section):
    """Sampling, converters, velocity estimate."""

    sample_rate_hz: float = described(10_000.0, "Hz", "f_s", gt=100, le=1e6)
    antialias_hz: float = described(
        2_000.0, "Hz", "2nd-order Butterworth corner", gt=10, le=1e6, free=DESIGN
    )
    sensor_highpass_hz: float = described(
        0.0,
        "Hz",
        "corner 1/(2 pi R C) of a patch's capacitance C (6.7 nF by default) into its "
        "amplifier's input R; 0: none",
        ge=0,
        le=1e5,
        free=MACHINE,
    )
    amplifier_hz: float = described(
        0.0, "Hz", "bandwidth (-3 dB) of the actuators' amplifiers; 0: no limit", ge=0, le=1e6
    )
    delay: float = described(
        1.0,
        "samples",
        "from a sample to its command on the actuators; the controller's model has it",
        ge=0,
        le=LONGEST,
        free=MACHINE,
    )
    unmodelled_delay: float = described(
        0.0,
        "samples",
        "more of it, unknown to the controller; both together 0 to 4",
        ge=-LONGEST,
        le=LONGEST,
        free=MACHINE,
    )
    estimator: Annotated[str, OneOf(lambda: KINDS)] = described(
        "modal_phase", "-", "velocity estimate"
    )
    highpass_hz: float = described(
        60.0, "Hz", "high-pass of modal_phase", gt=0, le=1e5, free=DESIGN
    )
    lowpass_ratio: tuple[Annotated[float, Field(gt=0.1, le=100)], ...] = described(
        (3.0, 2.0, 2.0),
        "1",
        "kappa_j, low-pass corner over omega_j; the last one repeats",
        min_length=1,
        free=DESIGN,
    )
    lowpass_zeta: tuple[Annotated[float, Field(gt=0, le=5)], ...] = described(
        (0.7, 0.7, 0.7),
        "1",
        "damping of the low-pass; the last one repeats",
        min_length=1,
        free=DESIGN,
    )
    difference_cutoff_hz: float = described(
        2_000.0, "Hz", "low-pass of the difference", gt=0, le=1e6, free=DESIGN
    )
    conditioner_gain: float = described(
        0.1, "1", "ADC volt per sensor volt", gt=0, le=1e3, free=MACHINE
    )
    conditioner_bias: float = described(1.5, "V", "bias at the ADC", ge=0, le=100)
    adc_range: float = described(3.0, "V", "full scale, from 0", gt=0, le=100)
    adc_bits: int = described(12, "1", "resolution", ge=4, le=32)
    adc_noise: float = described(0.0, "V", "rms at the ADC input", ge=0, le=10)
    voltage_limit: float = described(100.0, "V", "actuators, +-", gt=0, le=1e4)

    @property
    def adc_step(self) -> float:
        """One code of the ADC [V]."""
        return self.adc_range / 2**self.adc_bits


class DriveSection(Section):
    """Drives and disturbances."""

    kind: Annotated[str, OneOf(lambda: DRIVES, OWN)] = described(
        "pd", "-", "law of the drive; those with an observer or a sliding mode are sampled"
    )
    kinds: Annotated[dict[str, dict[str, EachLink[float]]], OwnFields(OWN_DRIVES)] = described(
        {}, "-", "fields of the drives, by kind"
    )
    kp: float = described(2e4, "N/m", "position gain Kp", ge=0, le=1e8, free=DESIGN)
    kd: float = described(60.0, "N s/m", "velocity gain Kd", ge=0, le=1e5, free=DESIGN)
    force_limit: float = described(1e3, "N", "motors, +-", gt=0, le=1e6)
    model_mass: float = described(
        1.0, "1", "platform and payload in the model of computed torque, over the true", ge=0, le=10
    )
    coulomb_friction: float = described(
        0.0, "N", "F_c of F_c tanh(v/v_0)", ge=0, le=1e3, free=MACHINE
    )
    friction_speed: float = described(1e-3, "m/s", "v_0", gt=0, le=1)
    viscous_friction: float = described(
        0.0, "N s/m", "viscous friction", ge=0, le=1e4, free=MACHINE
    )
    lag: float = described(
        0.0,
        "s",
        "dead time from a command to the motors' force: current loop and sample of the servo",
        ge=0,
        le=0.1,
        free=MACHINE,
    )
    ripple: float = described(
        0.0, "N", "seeded force ripple, rms, new at every sample", ge=0, le=1e3, free=MACHINE
    )
    pulse_force: OneALink[Force] = described(
        (0.0,) * PRRR.n_links, "N", "disturbance on the actuated joints", free=MACHINE
    )
    pulse_start: float = described(0.0, "s", "its start", ge=0, le=100)
    pulse_length: float = described(0.001, "s", "its length", ge=0, le=100)
    locked: bool = described(False, "-", "hold the actuated joints (bases with Y(L) = 0)")


class LoadSection(Section):
    """Payload of the platform, and loads on it, at its reference point (the pose)."""

    mass: float = described(0.0, "kg", "payload, added to m_p", ge=0, le=1e3, free=DESIGN)
    inertia: float = described(
        0.0,
        "kg m2",
        "payload about its own centre of mass, added to I_p",
        ge=0,
        le=1e2,
        free=DESIGN,
    )
    offset: tuple[Offset, Offset] = described(
        (0.0, 0.0), "m", "payload's centre of mass in the platform's axes"
    )
    wrench: Wrench = described(
        (0.0,) * PRRR.n_pose, "N, N, N m", "steady force and moment; the run starts in equilibrium"
    )
    pulse: Wrench = described((0.0,) * PRRR.n_pose, "N, N, N m", "disturbance on top")
    pulse_start: float = described(0.0, "s", "its start", ge=0, le=100)
    pulse_length: float = described(0.001, "s", "its length", ge=0, le=100)


class InitialSection(Section):
    """State at t = 0."""

    modal: tuple[()] | ListALink[Deflection] = described(
        (), "m", "modal coordinates per link; missing ones are 0"
    )
    load_station: float = described(0.1, "m", "where a static transverse load acts", gt=0, le=10)
    load_deflection: OneALink[Deflection] = described(
        (0.0,) * PRRR.n_links, "m", "chord deflection there, per link"
    )


class MetricsSection(Section):
    """Evaluation of a run."""

    residual_delay: Literal["auto"] | Pause = described(
        AUTO,
        "s",
        "residual window starts this long after the reference trajectory; auto: when the drive "
        "has settled to 2 %, by its poles",
    )
    residual_length: float = described(0.2, "s", "length of the residual window", gt=0, le=100)
    settling_band: float = described(
        1e-6, "m", "chord deflection that counts as settled", gt=0, le=0.1
    )
    saturation_limit: float = described(
        0.05,
        "1",
        "tolerated share of samples with an actuator, motor or ADC channel at its limit",
        ge=0,
        le=1,
    )
    arrival_tolerance: float = described(
        1e-3, "m", "tolerated rms error of the platform's joints in the residual window", gt=0, le=1
    )
    singularity_margin: float = described(
        0.05, "rad", "tolerated distance of link angles from 0 and 90 deg", ge=0, le=0.7
    )
    condition_limit: float = described(
        1e3, "1", "tolerated condition number of filter and synthesizer", ge=1, le=1e6
    )
    stations: tuple[float, ...] = described(
        (0.25, 0.5, 0.75),
        "1",
        "where chord deflection is evaluated, as fractions of each link's length",
        min_length=1,
        max_length=20,
    )


class Study(Section):
    """One study file."""

    title: str = described("study", "-", "title of the study", max_length=200, pattern="^[^\0]*$")
    run: RunSection = RunSection()
    machine: MachineSection = MachineSection()
    link: LinkSection = LinkSection()
    patches: PatchesSection = PatchesSection()
    motion: MotionSection = MotionSection()
    shaper: ShaperSection = ShaperSection()
    control: ControlSection = ControlSection()
    state_space: StateSpaceSection = StateSpaceSection()
    electronics: ElectronicsSection = ElectronicsSection()
    drive: DriveSection = DriveSection()
    load: LoadSection = LoadSection()
    initial: InitialSection = InitialSection()
    metrics: MetricsSection = MetricsSection()

    @staticmethod
    def parse(data: dict[str, Any]) -> Study:
        """A study from its sections, as `parse_study`."""
        return parse_study(data)

    def change(self, **fields: Any) -> Study:
        """Copy with other values; dots are double underscores: `change(control__gain_factor=1.0)`.

        Raises:
            StudyError: unknown field or bad value.
        """
        data = self.model_dump()
        for name, value in fields.items():
            *sections, leaf = name.split("__")
            target = data
            for section in sections:
                target = target.setdefault(section, {})
                if not isinstance(target, dict):
                    field = name.replace("__", ".")
                    raise StudyError(f"{field}: {section} is not a section of a study")
            target[leaf] = value
        return parse_study(self.with_kind(data))

    def with_kind(self, data: dict[str, Any]) -> dict[str, Any]:
        """A dictionary made from this study: of another mechanism, it has defaults of that one."""
        if data["machine"]["kind"] == self.machine.kind:
            return data
        return for_mechanism(data, Study, self.mechanism)

    @property
    def mechanism(self) -> Mechanism:
        """What is selected by `machine.kind`."""
        return MECHANISMS[self.machine.kind]

    @property
    def n_links(self) -> int:
        """Flexible links of the mechanism, each with a drive."""
        return self.mechanism.n_links

    @property
    def n_pose(self) -> int:
        """Coordinates of its platform."""
        return self.mechanism.n_pose

    def each_link(self, value: Any) -> np.ndarray:
        """A value of each link from one that may stand for all links, (n,)."""
        return np.broadcast_to(np.asarray(value, float), (self.n_links,))

    @property
    def is_controlled(self) -> bool:
        """Whether any link is controlled."""
        return self.control.feedback != "none" and any(self.control.links)

    def uncontrolled(self) -> Study:
        """The same study with no link controlled."""
        return self.change(control__links=(False,) * self.n_links)


def parse_study(data: dict[str, Any]) -> Study:
    """Validate a dictionary as a study.

    Raises:
        StudyError: first fault found, with field, value, allowed range and unit.
    """
    if not isinstance(data, dict):
        raise field_error("study", data, "a table of sections")
    data = with_matrices({name: _plain(value) for name, value in data.items()}, Path())
    try:
        study = validate(data)
    except ValidationError as error:
        raise explained(error, data) from None
    check_consistency(study)
    return study


def explained(error: ValidationError, data: dict[str, Any]) -> StudyError:
    """The first fault that `validate` found, in words."""
    mechanism = mechanism_of(data.get("machine", {}))
    return explain(error, Study, data, sizes=lengths(mechanism) if mechanism else None)


def validate(data: dict[str, Any]) -> Study:
    """A study, each field valid alone; its lists are as long as its mechanism says.

    Raises:
        ValidationError: a field that is not.
    """
    mechanism = mechanism_of(data.get("machine", {}))
    if mechanism is None:  # which is a fault of its own
        return Study.model_validate(data)
    data = dict(data)
    for (section, leaf), default in own_defaults(Study, mechanism).items():
        given = data.get(section, {})
        if isinstance(given, dict):
            data[section] = {leaf: default} | given
    return Study.model_validate(data, context=lengths(mechanism))


def _plain(value: Any) -> Any:
    """Recursively convert lists to tuples and NumPy numbers to Python's."""
    if isinstance(value, (np.ndarray, np.generic)):
        value = value.tolist()
    if isinstance(value, dict):
        return {name: _plain(entry) for name, entry in value.items()}
    return tuple(map(_plain, value)) if isinstance(value, (list, tuple)) else value


def load_study(path: str | Path) -> Study:
    """Read a study file.

    Args:
        path: TOML file, or the name of a ready-made one.

    Raises:
        StudyError: unreadable, not TOML, or not a valid study.
    """
    data = read_toml(path)
    if "sweep" in data:
        raise StudyError(f"{path}: has a section [sweep]; run it with studies sweep")
    return parse_study(data)


def paper_study() -> Study:
    """The paper's case, `studies/specs/paper.toml`."""
    return load_study(READY / "paper.toml")
