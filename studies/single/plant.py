"""`studies plant`: the sampled linear plant of a design, for controllers designed elsewhere."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.sampled_loop import SampledPlant, sampled_plant
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.errors import field_error
from studies.publish import replacing
from studies.show.document import plain
from studies.study.spec import Study
from studies.study.state_space import FORMATS


class NamedPlant(NamedTuple):
    """A discrete-time plant with names of its inputs and outputs; D is zero."""

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, 3 K)
    c: np.ndarray  # (3 K, n)
    sample_time: float  # [s]
    inputs: tuple[str, ...]  # "actuator LINK.PATCH", commands [V]
    outputs: tuple[str, ...]  # "sensor LINK.PATCH", behind the anti-alias filter [V]


@kept_jit(static_argnums=0)
def _plant(structure: Structure, case: Case, pose: np.ndarray) -> SampledPlant:
    return sampled_plant(structure, case, pose)


def plant_of(study: Study) -> NamedPlant:
    """The plant from commands of the actuators to what the converters see, over one sample.

    Linearised at the first way-point, with hold, amplifiers, anti-alias filter and the sample of
    computing delay: close it by u[k] from y[k] in the same sample.

    Args:
        study: with sampled feedback.

    Returns:
        NamedPlant.

    Raises:
        StudyError: nothing is sampled, or the study cannot run.

    Example:
        >>> plant_of(paper_study()).inputs[0]
        'actuator 1.1'
    """
    if study.control.feedback != "sampled":
        raise field_error("control.feedback", study.control.feedback, "'sampled'")
    structure, case = check_run(study)
    pose = np.array(study.motion.waypoints[0], float)
    found = jax.tree.map(np.asarray, _plant(structure._replace(n_steps=1, substeps=1), case, pose))
    ports = [f"{i + 1}.{k + 1}" for i in range(3) for k in range(structure.n_patches)]
    return NamedPlant(
        a=found.state,
        b=found.enter,
        c=found.leave,
        sample_time=1 / study.electronics.sample_rate_hz,
        inputs=tuple(f"actuator {port}" for port in ports),
        outputs=tuple(f"sensor {port}" for port in ports),
    )


def write_plant(plant: NamedPlant, path: str | Path) -> None:
    """Write a plant as NPZ, MAT or JSON, by the ending of the file.

    The names are those that `[state_space]` reads: A, B, C, D, dt, inputs, outputs.

    Args:
        plant: from `plant_of`.
        path: of the file.

    Raises:
        StudyError: another ending, or a file that cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() not in FORMATS:
        raise field_error("--out", str(path), f"a file {', '.join(FORMATS)}")
    direct = np.zeros((len(plant.c), plant.b.shape[1]))
    content: dict[str, Any] = {"A": plant.a, "B": plant.b, "C": plant.c, "D": direct}
    content |= {"dt": plant.sample_time, "inputs": plant.inputs, "outputs": plant.outputs}
    with replacing(path) as temporary, open(temporary, "wb") as file:
        _write(content, path.suffix.lower(), file)


def _write(content: dict[str, Any], ending: str, file: BinaryIO) -> None:
    if ending == ".npz":
        np.savez(file, **content)
    elif ending == ".mat":
        import scipy.io

        cells = {name: np.array(content[name], object) for name in ("inputs", "outputs")}
        scipy.io.savemat(file, content | cells)
    else:
        file.write((json.dumps(plain(content)) + "\n").encode())
