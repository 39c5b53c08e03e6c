"""Machines on which the coupling of links is measured: two baselines and samples around them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from studies.study.paths import set_values
from studies.study.spec import Study, paper_study, parse_study

#: Ratio of platform inertia over platform mass of both baselines [m2].
GYRATION = 1.2e-3
#: First mode of the links, about [rad/s]: what scales drives and gains.
OMEGA = 719.0
#: Of the drives, from which their damping follows [1].
DRIVE_DAMPING = 0.5
#: Ranges of a sample: those that are ratios of machines on a logarithmic scale.
RANGES = {
    "links' mass over the baseline's [1]": (1.0, 60.0),
    "platform mass [kg]": (0.03, 3.0),
    "mass at a near joint [kg]": (0.02, 0.5),
    "drive's frequency over the links' [1]": (0.1, 10.0),
    "structural damping ratio [1]": (0.0005, 0.03),
    "damping ratio added by control [1]": (0.02, 0.4),
    "spread of the links' stiffness [1]": (0.0001, 0.05),
}
#: Half of the ranges of poses around the baseline's [m, m, rad].
REACH = np.array([0.03, 0.03, 0.12])
#: Crank length of the 3-RRR [m].
CRANK = 0.15


class MachineSample(NamedTuple):
    """Machines of one kind; leading axis of arrays: machines."""

    study: Study
    columns: dict[str, np.ndarray]
    poses: np.ndarray  # [m, m, rad], (n, 3)


def baselines() -> dict[str, Study]:
    """The two machines that the papers speak of, by name.

    The 3-PRR is the nominal machine of its paper. Of the 3-RRR no number could be read: it has the
    same links, patches, platform mass and gains, on cranks.
    """
    cranked = {
        "title": "3-RRR with the links of the 3-PRR",
        "machine": {
            "kind": "rrr",
            "joint_radius": 0.07,
            "kinds": {"rrr": {"crank_length": CRANK}},
        },
        "motion": {"waypoints": [[0.0, 0.0, 0.0], [0.0, 0.01, 0.0]]},
    }
    return {"3-PRR": paper_study(), "3-RRR": parse_study(cranked)}


def home(study: Study) -> np.ndarray:
    """First pose of a study [m, m, rad], (3,)."""
    return np.array(study.motion.waypoints[0])


def varied(
    study: Study,
    *,
    link_mass: np.ndarray,
    platform_mass: np.ndarray,
    near_mass: np.ndarray,
    drive_ratio: np.ndarray,
    damping: np.ndarray,
    added: np.ndarray,
    stiffness: np.ndarray,
    poses: np.ndarray,
) -> MachineSample:
    """Machines with given ratios.

    Links and their patches get heavier by their width, at equal frequency and voltages. A drive's
    frequency is that of its spring under the mass at its near joint.

    Args:
        study: baseline.
        link_mass: over the baseline's [1], (n,).
        platform_mass: [kg], (n,).
        near_mass: slider, or crank and motor over the square of the crank's length [kg], (n,).
        drive_ratio: frequency of the drive over that of the links [1], (n,).
        damping: structural damping ratio [1], (n,).
        added: damping ratio that control adds to mode 1 [1], (n,).
        stiffness: bending stiffness of each link over the baseline's [1], (n, 3).
        poses: [m, m, rad], (n, 3).
    """
    drive_omega = drive_ratio * OMEGA
    columns: dict[str, np.ndarray] = {
        "link.width": np.asarray(study.link.width) * link_mass,
        "patches.width": np.asarray(study.patches.width) * link_mass,
        "machine.platform_mass": platform_mass,
        "machine.platform_inertia": GYRATION * platform_mass,
        "drive.kp": near_mass * drive_omega**2,
        "drive.kd": 2 * DRIVE_DAMPING * near_mass * drive_omega,
        "link.damping_ratio": damping,
        "link.stiffness_factor": stiffness,
        "control.velocity_gain": np.repeat(2 * added[:, None] * OMEGA, 3, axis=1),
    }
    if study.machine.kind == "rrr":
        columns["machine.kinds.rrr.crank_inertia"] = near_mass * CRANK**2
    else:
        columns["machine.slider_mass"] = near_mass
    return MachineSample(study.change(control__gain_unit="1/s"), columns, poses)


def one_study(machines: MachineSample, k: int) -> Study:
    """The study of one of the machines, at rest at its pose."""
    values = {name: column[k].tolist() for name, column in machines.columns.items()}
    study = parse_study(set_values(machines.study, values))
    return study.change(motion__waypoints=(tuple(machines.poses[k].tolist()),))


def sample(study: Study, count: int, seed: int) -> MachineSample:
    """Machines drawn from RANGES, and poses within REACH, by a scrambled Sobol sequence.

    Args:
        study: baseline.
        count: of machines, a power of 2.
        seed: of the scrambling.
    """
    n = len(RANGES)
    unit = qmc.Sobol(n + 6, rng=np.random.default_rng(seed)).random(count)
    low, high = np.log(np.array([*RANGES.values()])).T
    *ratios, spread = np.exp(low + (high - low) * unit[:, :n]).T
    names = "link_mass", "platform_mass", "near_mass", "drive_ratio", "damping", "added"
    return varied(
        study,
        **dict(zip(names, ratios, strict=True)),
        stiffness=1 + spread[:, None] * (2 * unit[:, n : n + 3] - 1),
        poses=home(study) + REACH * (2 * unit[:, n + 3 :] - 1),
    )
