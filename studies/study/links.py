"""Links and their patches in a study file."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeAlias, TypeVar

from pydantic import Field

from jaxmodel.beam import BASES
from jaxmodel.hysteresis import WIDEST
from studies.study.choices import OneOf
from studies.study.section import DESIGN, MACHINE, Section, described
from studies.study.sizes import LINK

Basis = Annotated[str, OneOf(lambda: BASES)]
Zeta = Annotated[float, Field(ge=0, lt=1)]
Factor = Annotated[float, Field(ge=0, le=10)]
Number = TypeVar("Number")
#: One for each link.
OneALink: TypeAlias = Annotated[tuple[Number, ...], LINK]
#: One number for all links, or one for each.
EachLink: TypeAlias = Number | OneALink[Number]
#: One list a link, by mode or patch.
ListALink: TypeAlias = Annotated[tuple[tuple[Number, ...], ...], LINK]
#: One number for all patches or modes, one list for all links, or one list a link.
ByPatch: TypeAlias = Number | tuple[Number, ...] | ListALink[Number]
#: One number for all links, one for each, or one list a link by mode; empty: none given.
EachMode: TypeAlias = EachLink[Number] | tuple[()] | ListALink[Number]


class LinkSection(Section):
    """The flexible links; dimensions and material: one number for all, or one each."""

    basis: Basis = described(
        "loaded",
        "-",
        "modal basis of the plant: loaded has the patches' mass and stiffness and the joints' "
        "inertia; pinned_pinned and pinned_free are bare links, the paper's simplification",
    )
    modes: int = described(8, "1", "plant modes per link", ge=1, le=16)
    shortening: bool = described(
        True,
        "-",
        "geometric stiffening: bending shortens the chord, axial force acts on bending "
        "(not in pinned_free)",
    )
    stretch: bool = described(
        True,
        "-",
        "links lengthen, and patches push along them; false: the paper's model (as in pinned_free)",
    )
    stretch_damping: float = described(
        0.01,
        "1",
        "damping ratio of a longitudinal mode at 1.5 kHz, rising with frequency: a guess, fit it",
        ge=0,
        le=0.5,
        free=MACHINE,
    )
    axial_inertia: Literal["lumped", "distributed"] = described(
        "lumped",
        "-",
        "mass that bending moves along the link: half of it at the platform joint, or every point",
    )
    static_correction: bool = described(
        True, "-", "static correction for the modes left out; false: the paper's truncated model"
    )
    length: EachLink[Annotated[float, Field(ge=1e-3, le=10)]] = described(
        0.2, "m", "length L", free=DESIGN
    )
    thickness: EachLink[Annotated[float, Field(ge=1e-5, le=0.1)]] = described(
        2e-3, "m", "thickness t_b", free=DESIGN
    )
    width: EachLink[Annotated[float, Field(ge=1e-4, le=1)]] = described(
        10e-3, "m", "width", free=DESIGN
    )
    density: EachLink[Annotated[float, Field(ge=1, le=3e4)]] = described(
        2750.0, "kg/m3", "density", free=MACHINE
    )
    youngs_modulus: EachLink[Annotated[float, Field(ge=1e3, le=2e12)]] = described(
        70e9, "Pa", "E, also of the nominal model; stiffness_factor is not in it", free=MACHINE
    )
    stiffness_factor: EachLink[Annotated[float, Field(ge=1e-3, le=10)]] = described(
        1.0,
        "1",
        "model mismatch: true over nominal bending stiffness, which controller and shaper assume",
        free=MACHINE,
    )
    damping_ratio: ByPatch[Zeta] = described(
        0.01,
        "1",
        "of mode 1; or by mode, for example measured: one list for all links, or one each",
        free=MACHINE,
    )
    damping_law: Literal["constant", "mass", "stiffness"] = described(
        "constant", "-", "of further modes: same ratio, falling with frequency, or rising"
    )
    joint_inertia_b: EachLink[Annotated[float, Field(ge=0, le=1)]] = described(
        0.0, "kg m2", "at the actuated joint (basis loaded)", free=MACHINE
    )
    joint_inertia_c: EachLink[Annotated[float, Field(ge=0, le=1)]] = described(
        0.0, "kg m2", "at the platform joint (basis loaded)", free=MACHINE
    )

    @property
    def first_damping(self) -> float:
        """Damping ratio of mode 1 of link 1 [1]."""
        ratio: Any = self.damping_ratio
        while isinstance(ratio, tuple):
            ratio = ratio[0]
        return ratio


class PatchesSection(Section):
    """Pairs of sensor and piezo actuator, which share a centre on opposite faces of a link."""

    centers: tuple[float, ...] | ListALink[float] = described(
        (0.05, 0.10, 0.15),
        "m",
        "centres along the link; one list for all links, or one each",
        free=DESIGN,
    )
    sensor_length: EachLink[Annotated[float, Field(ge=1e-5, le=1)]] = described(
        0.010, "m", "sensor length", free=DESIGN
    )
    actuator_length: EachLink[Annotated[float, Field(ge=1e-5, le=1)]] = described(
        0.030, "m", "actuator length", free=DESIGN
    )
    width: EachLink[Annotated[float, Field(ge=1e-5, le=1)]] = described(
        0.010, "m", "patch width", free=DESIGN
    )
    thickness: EachLink[Annotated[float, Field(ge=1e-6, le=0.01)]] = described(
        0.2e-3, "m", "t_p", free=DESIGN
    )
    youngs_modulus: EachLink[Annotated[float, Field(ge=1e3, le=2e12)]] = described(
        66e9, "Pa", "E_p", free=MACHINE
    )
    d31: EachLink[Annotated[float, Field(ge=-1e-9, le=1e-9)]] = described(
        -180e-12, "C/N", "piezoelectric constant (its sign has no effect)", free=MACHINE
    )
    relative_permittivity: EachLink[Annotated[float, Field(ge=1, le=1e5)]] = described(
        1750.0, "1", "eps33T/eps0", free=MACHINE
    )
    density: EachLink[Annotated[float, Field(ge=0, le=3e4)]] = described(
        7800.0, "kg/m3", "density of the ceramic", free=MACHINE
    )
    sensor_factor: ByPatch[Factor] = described(
        1.0,
        "1",
        "model mismatch: true over nominal sensitivity of each sensor, which the controller does "
        "not know; one number for all, one list for all links by patch, or one list each link",
        free=MACHINE,
    )
    actuator_factor: ByPatch[Factor] = described(
        1.0, "1", "model mismatch: true over nominal force of each actuator", free=MACHINE
    )
    sensor: Literal["piezo", "strain_gauge"] = described(
        "piezo", "-", "sensors: piezo patches, or strain gauges of sensor_length on the bare face"
    )
    actuators: Literal["one face", "both faces"] = described(
        "one face",
        "-",
        "on the face opposite to the sensor; or pairs of opposite polarity, which do not lengthen "
        "links: twice the ceramic, wires and force",
    )
    gauge_factor: float = described(
        2.1, "1", "relative change of resistance over strain", gt=0, le=500, free=MACHINE
    )
    gauge_excitation: float = described(5.0, "V", "of the gauges' bridges", gt=0, le=100)
    gauge_arms: int = described(2, "1", "active arms of a bridge's four", ge=1, le=4)
    gauge_gain: float = described(1000.0, "1", "of the bridges' amplifiers", gt=0, le=1e6)
    gauge_noise: float = described(0.0, "V", "rms behind these amplifiers", ge=0, le=10)
    hysteresis: float = described(
        0.0,
        "1",
        "of the actuators: widest opening of force over voltage in cycles of +-voltage_limit, over "
        "the range of the force; soft PZT 0.1 to 0.15, 0: none",
        ge=0,
        le=WIDEST,
        free=MACHINE,
    )
    strain_limit: float = described(
        4e-4,
        "1",
        "tolerated strain of the ceramics, which crack in tension (metric patch_strain_peak)",
        gt=0,
        le=0.1,
    )
