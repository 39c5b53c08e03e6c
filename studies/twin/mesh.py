"""Mesh of one link, and its structural damping as a matrix on the mesh.

A study gives damping by modal ratios. No material law of a beam holds given ratios in all modes
(Kelvin-Voigt makes them rise with frequency), so the twin takes them as they are given: from the
modes of the meshed link between pinned ends, w = sum phi_j q_j with phi^t M phi = 1,

    D = sum_j 2 zeta_j omega_j (M phi_j) (M phi_j)^t,

which acts on the velocities relative to the chord. It is applied to both components of a node's
velocity alike. That makes it independent of the link's direction: a rigid motion of a straight link
is linear along the chord in both components and feels nothing, and of a bent one it feels a force
along the chord of the order (rate of turning over omega) of the damping, about 1e-2 of it, which
the link bears in tension.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy.linalg

from jaxmodel.plant import damping_ratio
from studies.twin.machine import SAME_CUT, Link

#: Fraction of a link's length where its deflection from the chord is compared [1].
MID_SPAN = 0.5


class Mesh(NamedTuple):
    """Nodes of a link from B to C, and data of the elements between them."""

    x: np.ndarray  # along the link [m], (n + 1,)
    bending: np.ndarray  # E I [N m2], (n,)
    axial: np.ndarray  # E A [N], (n,)
    line_mass: np.ndarray  # rhoA [kg/m], (n,)
    middle: int  # node at mid-span
    sensor_nodes: np.ndarray  # at both ends of each sensor, (K, 2)
    actuator_nodes: np.ndarray  # (K, 2)
    moment: np.ndarray  # of each actuator on each node [N m/V], (K, n + 1)


def mesh_link(link: Link, n_elements: int) -> Mesh:
    """Cut a link at the ends of its patches and at mid-span, then into elements.

    Args:
        link: the link.
        n_elements: elements have at most the length of the link over this number, half of it
            where patches push along the link.
    """
    middle = MID_SPAN * link.length
    cuts = np.sort(
        np.concatenate(
            [[0.0, middle, link.length], link.sensor_ends.ravel(), link.actuator_ends.ravel()]
        )
    )
    cuts = cuts[np.append(True, np.diff(cuts) > SAME_CUT * link.length)]
    size = link.length / n_elements * (1 + SAME_CUT)
    if link.push:  # cables smear jumps of their strain, at the ends of patches, over an element
        size /= 2
    parts = [np.linspace(a, b, int(np.ceil((b - a) / size)) + 1)[:-1] for a, b in pairwise(cuts)]
    x = np.append(np.concatenate(parts), link.length)
    piece = np.searchsorted(link.sections.right, (x[1:] + x[:-1]) / 2)

    def node(place: np.ndarray | float) -> np.ndarray:
        return np.abs(x - np.asarray(place)[..., None]).argmin(axis=-1)

    return Mesh(
        x=x,
        bending=link.sections.bending[piece],
        axial=link.sections.axial[piece],
        line_mass=link.sections.line_mass[piece],
        middle=int(node(middle)),
        sensor_nodes=node(link.sensor_ends),
        actuator_nodes=node(link.actuator_ends),
        moment=-np.diff(link.sections.moment[:, piece], prepend=0.0, append=0.0),
    )


def bending_matrices(mesh: Mesh, joint_inertia: tuple[float, float]) -> tuple[np.ndarray, ...]:
    """Mass and stiffness of small bending, in (w, w') of each node.

    Args:
        mesh: of a link, n elements.
        joint_inertia: J_B, J_C at its ends [kg m2].

    Returns:
        (M [kg, kg m, kg m2], K [N/m, N, N m]), (2n + 2, 2n + 2) each.
    """
    n = 2 * len(mesh.x)
    mass, stiffness = np.zeros((n, n)), np.zeros((n, n))
    for k, h in enumerate(np.diff(mesh.x)):
        at = slice(2 * k, 2 * k + 4)
        scale = np.array([1.0, h, 1.0, h])
        scales = scale[:, None] * scale
        mass[at, at] += mesh.line_mass[k] * h * _MASS * scales
        stiffness[at, at] += mesh.bending[k] / h**3 * _STIFFNESS * scales
    mass[1, 1] += joint_inertia[0]
    mass[-1, -1] += joint_inertia[1]
    return mass, stiffness


_MASS = np.array([[156, 22, 54, -13], [22, 4, 13, -3], [54, 13, 156, -22], [-13, -3, -22, 4]]) / 420
_STIFFNESS = np.array([[12.0, 6, -12, 6], [6, 4, -6, 2], [-12, -6, 12, -6], [6, 2, -6, 4]])


def held_modes(mesh: Mesh, joint_inertia: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Modes of a link between pinned ends.

    Args:
        mesh, joint_inertia: as for `bending_matrices`.

    Returns:
        (omega [rad/s], (2n,); shapes of unit modal mass, (2n + 2, 2n)).
    """
    mass, stiffness = bending_matrices(mesh, joint_inertia)
    free = np.delete(np.arange(len(mass)), [0, len(mass) - 2])
    square, vector = scipy.linalg.eigh(stiffness[np.ix_(free, free)], mass[np.ix_(free, free)])
    shapes = np.zeros((len(mass), len(free)))
    shapes[free] = vector
    return np.sqrt(square), shapes


def damping_matrix(mesh: Mesh, link: Link) -> np.ndarray:
    """Damping of a link by its modal ratios, on one component of (r, r') of each node.

    Args:
        mesh: of the link, n elements.
        link: with the ratios.

    Returns:
        [N s/m, N s, N s m], (2n + 2, 2n + 2), zero for velocities that are linear along the link.
    """
    omega, shapes = held_modes(mesh, link.joint_inertia)
    ratio = np.asarray(damping_ratio(link.damping, omega[None]))[0]
    momentum = bending_matrices(mesh, link.joint_inertia)[0] @ shapes
    relative = np.eye(len(momentum)) - _linear_part(mesh)
    momentum = relative.T @ momentum
    return (momentum * (2 * ratio * omega)) @ momentum.T


def _linear_part(mesh: Mesh) -> np.ndarray:
    """From (r, r') of all nodes to those of the straight line between the end nodes."""
    x, length = mesh.x, mesh.x[-1]
    part = np.zeros((2 * len(x), 2 * len(x)))
    part[0::2, 0], part[0::2, -2] = 1 - x / length, x / length
    part[1::2, 0], part[1::2, -2] = -1 / length, 1 / length
    return part
