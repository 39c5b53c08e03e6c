"""Where the joints of a machine with straight links are, by trigonometry of its own.

Every carrier moves by one coordinate: the place of a slider on its rail [m], or the angle of a
crank, against the clock [rad].
"""

from __future__ import annotations

import numpy as np

from jaxmodel.mechanisms.carriers import Carrier, Crank, Rail
from studies.twin.machine import MachineData, Platform, PlatformPoint


def close_chain(machine: MachineData, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Straight links of a machine at a pose.

    Args:
        machine: the machine, n links.
        pose: (x, y, phi) of the platform, or (x, y) of a point [m, m, rad].

    Returns:
        (rho [m], (n,); B and C of each link [m], (n, 2, 2)).
    """
    far = _far_joints(machine.platform, pose, len(machine.links))
    rho, ends = np.zeros(len(far)), np.zeros((len(far), 2, 2))
    for i, (carrier, link) in enumerate(zip(machine.carriers, machine.links, strict=True)):
        if isinstance(carrier, Rail):
            rho[i], near = _on_rail(carrier, far[i], link.length)
        else:
            rho[i], near = _on_crank(carrier, far[i], link.length)
        ends[i] = near, far[i]
    return rho, ends


def lever(carrier: Carrier) -> float:
    """Way of B along its path over the carrier's coordinate: 1 of a rail [1], +-a of a crank [m].

    A force along the path is this many times as large on the coordinate.
    """
    return 1.0 if isinstance(carrier, Rail) else carrier.elbow * carrier.length


def rotation(angle: float) -> np.ndarray:
    """Axes turned by an angle [rad] as columns [1], (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def _far_joints(platform: Platform, pose: np.ndarray, count: int) -> np.ndarray:
    if isinstance(platform, PlatformPoint):
        return np.tile(pose, (count, 1))
    return np.asarray(pose[:2] + platform.joints @ rotation(pose[2]).T)


def _on_rail(rail: Rail, far: np.ndarray, length: float) -> tuple[float, np.ndarray]:
    """Pythagoras: the slider is behind the foot of C on the rail."""
    away = far - rail.start
    along = rail.direction @ away
    across = away - along * rail.direction
    rho = float(along - np.sqrt(length**2 - across @ across))
    return rho, rail.start + rho * rail.direction


def _on_crank(crank: Crank, far: np.ndarray, length: float) -> tuple[float, np.ndarray]:
    """Law of cosines, for the angle at the pivot between the crank and the line to C."""
    away = far - crank.pivot
    distance = np.hypot(*away)
    cosine = (crank.length**2 + distance**2 - length**2) / (2 * crank.length * distance)
    angle = np.arctan2(away[1], away[0]) - crank.elbow * np.arccos(cosine)
    turn = angle - crank.zero_angle
    turn -= 2 * np.pi * np.round(turn / (2 * np.pi))  # within half a turn of rho = 0
    near = crank.pivot + crank.length * rotation(angle)[:, 0]
    return float(lever(crank) * turn), near
