"""First frequency of links with and without their patches, by Stodola's iteration.

Says what a basis that leaves the patches out costs, without the modal bases of `jaxmodel`: a link
between pinned ends is statically determinate, so that its deflection under any load is two
integrations, of the moment and of the curvature M/(E I), whatever E I(x). Starting from a sine,
the deflection under the inertia force of the last shape converges to mode 1, and Rayleigh's
quotient of the two to its frequency (Timoshenko, Young and Weaver, Vibration Problems in
Engineering, 1974).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmodel.beam import BASES
from studies.study.consistency import patch_centers

if TYPE_CHECKING:
    from studies.study.spec import Study

#: Points along a link, and iterations; together good to 1e-4 of the frequency.
_POINTS, _ITERATIONS = 4001, 4


def first_frequency(study: Study, with_patches: bool) -> np.ndarray:
    """Frequency of mode 1 of each link between held ends [Hz], (n,).

    Args:
        study: links and patches.
        with_patches: the patches' mass and stiffness and the joints' rotary inertia count.
    """
    joints = [study.each_link(getattr(study.link, f"joint_inertia_{end}")) for end in "bc"]
    inertia = np.stack(joints, axis=1) * with_patches
    return np.array(
        [_stodola(*_line(study, i, with_patches), inertia[i]) for i in range(study.n_links)]
    )


def laminate_stiffness(
    core: float, thickness: float, skin: float, piezo: float, below: Any, above: Any
) -> Any:
    """E I of a link with patches on its faces about the neutral axis of all layers [N m2].

    Args:
        core: axial stiffness E A of the link [N].
        thickness: of the link [m].
        skin: axial stiffness of a patch [N].
        piezo: its thickness [m].
        below, above: patches on each face [1], of any shape.
    """
    height = (thickness + piezo) / 2
    axial = core + skin * (below + above)
    first = skin * height * (above - below)
    second = core * thickness**2 / 12 + skin * (height**2 + piezo**2 / 12) * (below + above)
    return second - first**2 / axial


def _line(study: Study, i: int, with_patches: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points along link i [m], its mass per length there [kg/m] and stiffness E I [N m2]."""

    def of(section: object, name: str) -> float:
        return float(study.each_link(getattr(section, name))[i])

    link, patches = study.link, study.patches
    x = np.linspace(0, of(link, "length"), _POINTS)
    faces = {"sensor_length": np.zeros_like(x), "actuator_length": np.zeros_like(x)}
    for name, cover in faces.items():
        if name == "sensor_length" and patches.sensor == "strain_gauge":
            continue  # neither heavy nor stiff
        for center in patch_centers(study)[i] if with_patches else ():
            half = of(patches, name) / 2
            # a point stands for the interval around it, of which a patch covers a share
            inside = np.clip((half - np.abs(x - center)) / x[1] + 0.5, 0, 1)
            cover += inside
    below, above = faces.values()
    if patches.actuators == "both faces":
        below = above
    thickness, width = of(link, "thickness"), of(link, "width")
    piezo, piezo_width = of(patches, "thickness"), of(patches, "width")
    ceramic = of(patches, "density") * piezo_width * piezo
    mass = of(link, "density") * width * thickness + ceramic * (below + above)
    core = of(link, "youngs_modulus") * width * thickness
    skin = of(patches, "youngs_modulus") * piezo_width * piezo
    stiffness = laminate_stiffness(core, thickness, skin, piezo, below, above)
    return x, mass, stiffness * of(link, "stiffness_factor")


def link_inertia(study: Study) -> np.ndarray:
    """Mass [kg], first moment [kg m] and inertia [kg m2] of the links about joints B, (3, n).

    With what the basis of the plant adds: patches, and rotary inertia at the joints.
    """
    basis, links = BASES[study.link.basis], []
    for i in range(study.n_links):
        x, line, _ = _line(study, i, basis.has_patches)
        weight = np.full(x.size, x[1])
        weight[[0, -1]] /= 2
        moments = (line * weight) @ x[:, None] ** np.array([0, 1, 2])
        moments[2] -= moments[0] * x[1] ** 2 / 6  # by which trapezoids exceed a parabola
        links.append(moments)
    found = np.array(links).T
    if basis.has_joints:
        link = study.link
        found[2] += study.each_link(link.joint_inertia_b) + study.each_link(link.joint_inertia_c)
    return found


def _stodola(x: np.ndarray, mass: np.ndarray, stiffness: np.ndarray, joint: np.ndarray) -> float:
    """Frequency of mode 1 [Hz]; joint: rotary inertia at both ends [kg m2], (2,)."""
    shape = np.sin(np.pi * x / x[-1])
    for _ in range(_ITERATIONS):
        couple = joint * _end_slopes(x, shape)
        moment = _between_pins(x, mass * shape)
        moment = moment + couple[0] * (1 - x / x[-1]) - couple[1] * x / x[-1]
        bent = _between_pins(x, moment / stiffness)
        slope = _end_slopes(x, bent)
        work = np.trapezoid(mass * shape * bent, x) + couple @ slope
        square = work / (np.trapezoid(mass * bent**2, x) + joint @ slope**2)
        shape = bent / np.abs(bent).max()
    return float(np.sqrt(square) / (2 * np.pi))


def _end_slopes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """y' at both ends, (2,)."""
    first, last = 4 * y[1] - 3 * y[0] - y[2], 3 * y[-1] - 4 * y[-2] + y[-3]
    return np.array([first, last]) / (2 * x[1])


def _between_pins(x: np.ndarray, load: np.ndarray) -> np.ndarray:
    """y with y'' = -load and y = 0 at both ends."""

    def integral(values: np.ndarray) -> np.ndarray:
        steps = (values[1:] + values[:-1]) / 2 * np.diff(x)
        return np.concatenate([[0.0], np.cumsum(steps)])

    twice = integral(integral(load))
    return twice[-1] * x / x[-1] - twice
