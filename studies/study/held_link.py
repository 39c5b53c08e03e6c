"""First frequency of links with and without their patches, by Stodola's iteration.

Says what a basis that leaves the patches out costs, without the modal bases of `jaxmodel`: a link
between pinned ends is statically determinate, so that its deflection under any load is two
integrations, of the moment and of the curvature M/(E I), whatever E I(x). Starting from a sine,
the deflection under the inertia force of the last shape converges to mode 1, and Rayleigh's
quotient of the two to its frequency (Timoshenko, Young and Weaver, Vibration Problems in
Engineering, 1974).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from studies.study.consistency import each_link, patch_centers

if TYPE_CHECKING:
    from studies.study.spec import Study

#: Points along a link, and iterations; together good to 1e-4 of the frequency.
_POINTS, _ITERATIONS = 4001, 4


def first_frequency(study: Study, with_patches: bool) -> np.ndarray:
    """Frequency of mode 1 of each link between held ends [Hz], (3,).

    Args:
        study: links and patches; joint inertia is left out.
        with_patches: the patches' mass and stiffness count.
    """
    return np.array([_stodola(*_line(study, i, with_patches)) for i in range(3)])


def _line(study: Study, i: int, with_patches: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points along link i [m], its mass per length there [kg/m] and stiffness E I [N m2]."""

    def of(section: object, name: str) -> float:
        return float(each_link(getattr(section, name))[i])

    link, patches = study.link, study.patches
    x = np.linspace(0, of(link, "length"), _POINTS)
    faces = {"sensor_length": np.zeros_like(x), "actuator_length": np.zeros_like(x)}
    for name, cover in faces.items():
        for center in patch_centers(study)[i] if with_patches else ():
            half = of(patches, name) / 2
            # a point stands for the interval around it, of which a patch covers a share
            inside = np.clip((half - np.abs(x - center)) / x[1] + 0.5, 0, 1)
            cover += inside
    below, above = faces.values()
    thickness, width = of(link, "thickness"), of(link, "width")
    piezo, piezo_width = of(patches, "thickness"), of(patches, "width")
    ceramic = of(patches, "density") * piezo_width * piezo
    mass = of(link, "density") * width * thickness + ceramic * (below + above)
    # layers: axial stiffness per length, height of their middle, own bending stiffness
    core = of(link, "youngs_modulus") * width * thickness
    skin = of(patches, "youngs_modulus") * piezo_width * piezo
    height = (thickness + piezo) / 2
    axial = core + skin * (below + above)
    first = skin * height * (above - below)
    second = core * thickness**2 / 12 + skin * (height**2 + piezo**2 / 12) * (below + above)
    return x, mass, (second - first**2 / axial) * of(link, "stiffness_factor")


def _stodola(x: np.ndarray, mass: np.ndarray, stiffness: np.ndarray) -> float:
    shape = np.sin(np.pi * x / x[-1])
    for _ in range(_ITERATIONS):
        moment = _between_pins(x, mass * shape)
        bent = _between_pins(x, moment / stiffness)
        square = np.trapezoid(mass * shape * bent, x) / np.trapezoid(mass * bent**2, x)
        shape = bent / np.abs(bent).max()
    return float(np.sqrt(square) / (2 * np.pi))


def _between_pins(x: np.ndarray, load: np.ndarray) -> np.ndarray:
    """y with y'' = -load and y = 0 at both ends."""

    def integral(values: np.ndarray) -> np.ndarray:
        steps = (values[1:] + values[:-1]) / 2 * np.diff(x)
        return np.concatenate([[0.0], np.cumsum(steps)])

    twice = integral(integral(load))
    return twice[-1] * x / x[-1] - twice
