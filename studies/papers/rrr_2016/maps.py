"""How little structural damping a machine may have before control of one link calms the others.

On maps over the drives' frequency and the ratio of platform to link mass, at several poses: where
the damping that the links have is above the number on the map, links are on their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from studies.papers.rrr_2016.coupling import after_plucks, of_itself
from studies.papers.rrr_2016.energies import free_energies
from studies.papers.rrr_2016.machines import REACH, home, varied
from studies.papers.rrr_2016.thresholds import greatest_damping
from studies.study.spec import Study

#: Of the 3-PRR: platform, a near joint, a link [kg].
PLATFORM_MASS, NEAR_MASS, LINK_MASS = 0.25, 0.15, 0.011
#: Damping ratio that control adds: as the gains of the 3-PRR do, and what is tried as well, since a
#: link that is held too hard takes up less of what reaches it [1].
STRONG, STRENGTHS = 0.2, (0.02, 0.05, 0.2)
#: Control that removes less than this of the vibration of its own link is none [1].
LEAST = 0.3


class DampingMap(NamedTuple):
    """Greatest damping ratios at which the level is reached, with equal links."""

    drive_ratio: np.ndarray  # frequency of the drives over that of the links [1], (d,)
    mass_ratio: np.ndarray  # platform mass over link mass [1], (m,)
    damping: np.ndarray  # by drive, mass, pose [1]; NaN: infeasible, (d, m, p)


def damping_map(
    study: Study,
    level: float,
    drive_ratio: np.ndarray,
    mass_ratio: np.ndarray,
    n_poses: int,
    strengths: tuple[float, ...],
) -> DampingMap:
    """The map of one kind of machine.

    Args:
        study: baseline.
        level: of the reduction [1].
        drive_ratio: see `DampingMap`.
        mass_ratio: see `DampingMap`.
        n_poses: home and poses within REACH of it.
        strengths: damping ratios that control may add, of which the best one counts [1].
    """
    unit = qmc.Halton(3, rng=np.random.default_rng(0)).random(n_poses - 1)
    poses = home(study) + np.vstack([np.zeros(3), REACH * (2 * unit - 1)])
    shape = len(drive_ratio), len(mass_ratio), n_poses
    drive, mass, pose = (x.ravel() for x in np.indices(shape))
    count = drive.size

    def reduction(damping: np.ndarray) -> np.ndarray:
        found = [with_strength(damping, np.full(count, added)) for added in strengths]
        return np.max(found, axis=0)

    def with_strength(damping: np.ndarray, added: np.ndarray) -> np.ndarray:
        machines = varied(
            study,
            link_mass=PLATFORM_MASS / (LINK_MASS * mass_ratio[mass]),
            platform_mass=np.full(count, PLATFORM_MASS),
            near_mass=np.full(count, NEAR_MASS),
            drive_ratio=drive_ratio[drive],
            damping=damping,
            added=added,
            stiffness=np.ones((count, 3)),
            poses=poses[pose],
        )
        energies = free_energies(machines.study, machines.columns, machines.poses, 1)
        is_control = of_itself(energies) >= LEAST
        return np.where(
            energies.is_feasible, np.where(is_control, after_plucks(energies), 0.0), np.nan
        )

    found = greatest_damping(reduction, level, count)
    return DampingMap(drive_ratio, mass_ratio, found.reshape(shape))
