"""The paper's machine."""

from __future__ import annotations

import numpy as np

from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES, GuideGeometry
from jaxmodel.parameters import Beam, Damping, Machine, Masses, Patches

#: Home pose (x [m], y [m], phi [rad]) of the paper.
HOME = (0.0, 0.0, np.pi / 6)


def paper_machine() -> Machine:
    """The paper's 3-PRR manipulator.

    Values not given in the paper (E, density, width, I_p, damping, PZT permittivity and
    density) are the estimates listed in docs/theory.md.

    Example:
        >>> paper_machine().beam.length
        0.2
    """
    return Machine(
        geometry=GuideGeometry(
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
