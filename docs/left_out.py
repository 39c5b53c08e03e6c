"""What the equations leave out, and how large it is: `python docs/left_out.py [STUDY]`.

Closed forms of beams, laminates and joints on the default machine and on a stubby one (links of
length over thickness 20), or on the machine of a study file, of which link 1 stands for all.
"""

import math
import sys

import numpy as np

import studies
from studies.study.links import LinkSection
from studies.study.window import drive_poles

#: Links of 200 x 20 x 10 mm that carry 2 kg on stronger drives.
STUBBY = {
    "link__thickness": 0.010,
    "link__width": 0.020,
    "patches__width": 0.020,
    "patches__thickness": 0.5e-3,
    "machine__platform_mass": 2.0,
    "machine__platform_inertia": 3e-3,
    "machine__slider_mass": 0.6,
    "drive__kp": 1.6e5,
    "drive__kd": 480.0,
}
GRAVITY, POISSON, SHEAR_FACTOR = 9.81, 0.33, 5 / 6
BEARING = 2e-4  # Coulomb torque of a small ball bearing [N m]
RADIAL = 2e7  # its radial stiffness [N/m]
EPOXY, BOND = 1e9, 50e-6  # shear modulus [Pa] and thickness [m] of the adhesive


def first(x: object) -> float:
    """Of link 1."""
    return float(np.ravel(x)[0])


def section(link: LinkSection) -> tuple[float, ...]:
    """Length, thickness, width [m], modulus [Pa] and mass per length [kg/m] of link 1."""
    size = [first(getattr(link, name)) for name in ("length", "thickness", "width")]
    return *size, first(link.youngs_modulus), first(link.density) * size[1] * size[2]


def out_of_plane(study: studies.Study) -> dict[str, float]:
    """Links clamped at both ends carry the platform across the plane."""
    length, thickness, width, modulus, line = section(study.link)
    stiffness = study.n_links * modulus * thickness * width**3 / length**3  # 12 E I/L^3 each
    carried = study.machine.platform_mass + study.load.mass
    moving = carried + study.n_links * 13 / 35 * line * length
    return {
        "bounce out of the plane [Hz]": math.sqrt(stiffness / moving) / (2 * math.pi),
        "sag under gravity [um]": 1e6 * carried * GRAVITY / stiffness,
    }


def stubbiness(study: studies.Study) -> dict[str, float]:
    """Pinned Timoshenko beams: rotary inertia and shear, against thin ones."""
    length, thickness, *_ = section(study.link)
    inertia, shear = thickness**2 / 12, 2 * (1 + POISSON) / SHEAR_FACTOR
    found = {}
    for order in (1, 3):
        wave = (order * math.pi / length) ** 2
        a, b = wave * inertia, wave * inertia * shear
        # a b w^4 - (1 + a + b) w^2 + 1 = 0, w over the frequency of a thin beam
        own = ((1 + a + b) - math.sqrt((1 + a + b) ** 2 - 4 * a * b)) / (2 * a * b)
        found[f"rotary inertia and shear, mode {order} [%]"] = 100 * (math.sqrt(own) - 1)
    return found


def joints(study: studies.Study) -> dict[str, float]:
    """Bearings hold a bent link, and are springs in line with it."""
    length, thickness, width, modulus, _ = section(study.link)
    bending = modulus * width * thickness**3 / 12 * (math.pi / length) ** 4 * length / 2
    along = modulus * width * thickness / length
    return {
        "bending that joints of 0.2 mN m hold [um]": 2e6 * math.pi * BEARING / (length * bending),
        "longitudinal modes, joints of 20 N/um [%]": 100
        * (1 / math.sqrt(1 + 2 * along / RADIAL) - 1),
    }


def adhesive(study: studies.Study) -> dict[str, float]:
    """Shear lag: what the ends of a bonded patch do not pass on (Crawley and de Luis 1987)."""
    _, thickness, _, modulus, _ = section(study.link)
    ceramic, own = first(study.patches.youngs_modulus), first(study.patches.thickness)
    ratio = modulus * thickness / (ceramic * own)
    root = math.sqrt(EPOXY / (ceramic * BOND * own) * (ratio + 6) / ratio)

    def lost(length: float) -> float:
        return -100 * math.tanh(root * length / 2) / (root * length / 2)

    return {
        "adhesive of 50 um: force of actuators [%]": lost(first(study.patches.actuator_length)),
        "adhesive of 50 um: volts of sensors [%]": lost(first(study.patches.sensor_length)),
    }


def drives(study: studies.Study) -> dict[str, float]:
    """Damping of the slowest swing on rigid links, and with motors that follow late."""
    found = {}
    for lag in (0.0, 1e-3, 2e-3):
        poles = drive_poles(study.change(drive__lag=lag))
        swing = poles[poles.imag > 1]
        slow = swing[np.argmin(np.abs(swing))]
        found[f"damping of the drives, lag {1e3 * lag:g} ms [1]"] = -slow.real / abs(slow)
    return found


def ceramics(study: studies.Study) -> dict[str, float]:
    """Lots and temperature; creep, which the controller's high-pass does not pass."""
    return {
        "loop gain, d31 12 % larger [%]": 100 * (1.12**2 - 1),
        "loop gain, capacitance 25 % larger [%]": 100 * (1 / 1.25 - 1),
        "what the controller sees of creep at 1 Hz [%]": 100 / study.electronics.highpass_hz,
    }


def rows(study: studies.Study) -> dict[str, float]:
    """All of it."""
    parts = out_of_plane, stubbiness, joints, adhesive, drives, ceramics
    return {name: value for part in parts for name, value in part(study).items()}


def main() -> None:
    """Print the table."""
    studies.configure()
    machines = {"default": studies.Study()}
    machines["stubby"] = machines["default"].change(**STUBBY)
    if len(sys.argv) > 1:
        try:
            machines = {sys.argv[1]: studies.load(sys.argv[1])}
        except studies.StudyError as error:
            sys.exit(f"left_out: {error}")
    found = [rows(study) for study in machines.values()]
    print(" " * 50 + "".join(f"{name:>12.12}" for name in machines))
    for name in found[0]:
        print(f"{name:50}" + "".join(f"{one[name]:12.3g}" for one in found))


if __name__ == "__main__":
    main()
