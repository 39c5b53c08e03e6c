"""Machines that controllers are tuned and judged on: what differs among them, and by how much."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from studies.space.machines import SPREAD, drawn_machines
from studies.study.paths import known_field
from studies.study.spec import Study


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
    spread, links = spread_of(study), range(study.n_links)
    entries = {
        name: [f"{name}[{i}]" for i in links] if name.startswith("link.") else [name]
        for name in spread
    }
    each = {entry: spread[name] for name, own in entries.items() for entry in own}
    columns = drawn_machines(study, each, count, seed)
    machines: list[dict[str, Any]] = [{"run.seed": study.run.seed + 1 + k} for k in range(count)]
    for (name, own), (k, machine) in product(entries.items(), enumerate(machines)):
        row = [float(columns[entry][k]) for entry in own]
        machine[name] = row if name.startswith("link.") else row[0]
    for machine in machines:
        machine["drive.model_mass"] = _known_mass(study, machine)
    return machines


def _known_mass(study: Study, machine: dict[str, Any]) -> float:
    """Mass of platform and payload that computed torque goes on to assume, over a machine's."""
    own = study.machine.platform_mass + study.load.mass
    true = machine["machine.platform_mass"] + machine.get("load.mass", 0.0)
    return study.drive.model_mass * own / true
