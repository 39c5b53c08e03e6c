"""Machines that controllers are tuned and judged on: what differs among them, and by how much."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies.study.paths import known_field
from studies.study.spec import Study

#: Fields that differ among machines, and by how many percent at most; those that are 0 stay 0.
SPREAD = {
    "link.stiffness_factor": 5.0,
    "machine.platform_mass": 20.0,
    "load.mass": 20.0,
    "link.joint_inertia_b": 20.0,
    "link.joint_inertia_c": 20.0,
}


def spread_of(study: Study) -> dict[str, float]:
    """What differs among a design's machines: field and percent."""
    fields = {name: known_field(name, study, "laws") for name in SPREAD}
    return {name: SPREAD[name] for name, value in fields.items() if np.any(value)}


def with_noise(study: Study) -> Study:
    """The design, with noise of one step of the converter [V rms] where it states none."""
    if study.electronics.adc_noise > 0:
        return study
    return study.change(electronics__adc_noise=study.electronics.adc_step)


def machines_of(study: Study, count: int, seed: int) -> list[dict[str, Any]]:
    """Machines to judge on: fields of the study and their values, drawn by Latin hypercube.

    Each has its own noise, the same for all controllers.

    Args:
        study: the design.
        count: how many machines.
        seed: of the draw.
    """
    from scipy.stats import qmc

    spread = spread_of(study)
    sizes = {name: study.n_links if name.startswith("link.") else 1 for name in spread}
    points = qmc.LatinHypercube(sum(sizes.values()), rng=seed).random(count)
    machines: list[dict[str, Any]] = [{"run.seed": study.run.seed + 1 + k} for k in range(count)]
    first = 0
    for name, size in sizes.items():
        factor = 1 + spread[name] / 100 * (2 * points[:, first : first + size] - 1)
        first += size
        value = known_field(name, study, "laws")
        each = factor * (study.each_link(value) if size > 1 else value)
        for machine, row in zip(machines, each.tolist(), strict=True):
            machine[name] = row if size > 1 else row[0]
    for machine in machines:
        machine["drive.model_mass"] = _known_mass(study, machine)
    return machines


def _known_mass(study: Study, machine: dict[str, Any]) -> float:
    """Mass of platform and payload that computed torque goes on to assume, over a machine's."""
    own = study.machine.platform_mass + study.load.mass
    true = machine["machine.platform_mass"] + machine.get("load.mass", 0.0)
    return study.drive.model_mass * own / true
