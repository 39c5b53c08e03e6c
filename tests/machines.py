"""Random machines with three different links, as study files say them."""

import numpy as np

from jaxmodel.defaults import HOME
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from tests.bare import parse_study

ANGLES = np.array([2 * np.pi / 3, 4 * np.pi / 3, 0.0])
SIDE = 0.6


def random_machine(seed, **sections):
    """A study of a machine whose links stand at 40 to 70 deg to their guides at home.

    seed: of everything drawn. sections: what else the study says, by section.
    """
    rng = np.random.default_rng(seed)
    alpha = ANGLES + np.radians(rng.uniform(-12, 12, 3))
    psi = np.array(ASSEMBLIES["inward"]) + np.radians(rng.uniform(-15, 15, 3))
    radius, length = rng.uniform(0.055, 0.085, 3), rng.uniform(0.18, 0.26, 3)
    height = length * np.sin(np.radians(rng.uniform(40, 70, 3)))
    across = radius * np.sin(psi + HOME[2] - alpha)  # of the joints, from O
    data = {
        "machine": {
            "guide_angles_deg": np.degrees(alpha),
            "guide_offsets": height - across - SIDE / np.sqrt(12),
            "joint_radius": radius,
            "joint_angles_deg": np.degrees(psi),
            "slider_mass": rng.uniform(0.1, 0.25, 3),
        },
        "link": {
            "length": length,
            "thickness": rng.uniform(1.8e-3, 2.4e-3, 3),
            "width": rng.uniform(10e-3, 14e-3, 3),
            "density": rng.uniform(2600, 2900, 3),
            "youngs_modulus": rng.uniform(65e9, 75e9, 3),
            "stiffness_factor": rng.uniform(0.97, 1.03, 3),
            "damping_ratio": rng.uniform(0.008, 0.015, (3, 1)),
        },
        "patches": {
            "centers": length[:, None] * np.array([0.25, 0.5, 0.75]),
            "sensor_length": rng.uniform(0.008, 0.012, 3),
            "actuator_length": rng.uniform(0.024, 0.032, 3),
            "width": rng.uniform(0.007, 0.010, 3),
            "thickness": rng.uniform(0.15e-3, 0.25e-3, 3),
        },
        "load": {
            "mass": rng.uniform(0.05, 0.2),
            "inertia": rng.uniform(2e-5, 2e-4),
            "offset": rng.uniform(-0.03, 0.03, 2),
        },
    }
    for section, fields in sections.items():
        data[section] = {**data.get(section, {}), **fields}
    return parse_study(data)
