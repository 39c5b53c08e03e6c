"""`studies plant`: the sampled linear plant of a design, and its controller, for use elsewhere."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import linear_law
from jaxmodel.laws import LAWS
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import SampledPlant, sampled_plant
from jaxmodel.state_space import used_states
from studies.engine.preflight import check_machine
from studies.engine.programs import kept_jit
from studies.engine.runs import resolved_study
from studies.errors import field_error
from studies.publish import replacing
from studies.result import Result
from studies.results.labelled import Variable, Variables, plain
from studies.show.report import Report
from studies.study.spec import Study
from studies.study.state_space import FORMATS
from studies.verbs import check_file


@dataclass(frozen=True, eq=False)
class NamedSystem(Result):
    """A linear discrete-time system between commands and sensors, with names of its ports.

    "actuator LINK.PATCH" is a command [V], "sensor LINK.PATCH" a voltage behind the anti-alias
    filter [V].
    """

    a: np.ndarray  # (n, n)
    b: np.ndarray  # (n, 3 K)
    c: np.ndarray  # (3 K, n)
    d: np.ndarray  # (3 K, 3 K)
    sample_time: float  # [s]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]

    def variables(self) -> dict[str, Variable]:
        found = Variables()
        for name, row, column in (
            ("a", "state", "from_state"),
            ("b", "state", "input"),
            ("c", "output", "from_state"),
            ("d", "output", "input"),
        ):
            found.put(name, getattr(self, name), "SI", f"matrix {name.upper()}", row, column)
        found.put("input", list(self.inputs), "1", "port", "input")
        found.put("output", list(self.outputs), "1", "port", "output")
        return found

    def report(self) -> Report:
        inputs, outputs = (f"{len(x)} {x[0].split()[0]}s" for x in (self.inputs, self.outputs))
        text = (
            f"{len(self.a)} states, {inputs} to {outputs}, {1e6 * self.sample_time:g} µs a sample"
        )
        return Report("Linear system", [text], "", "", [], [], {})


@kept_jit(static_argnums=0)
def _plant(structure: Structure, case: Case, pose: np.ndarray) -> SampledPlant:
    return sampled_plant(structure, case, pose)


def plant_of(study: Study) -> NamedSystem:
    """The plant from commands of the actuators to what the converters see, over one sample.

    Linearised at the first way-point, with hold, amplifiers, anti-alias filter and the sample of
    computing delay: close it by u[k] from y[k] in the same sample.

    Args:
        study: with sampled feedback.

    Returns:
        NamedSystem; D is zero.

    Raises:
        StudyError: nothing is sampled, or the study cannot run.

    Example:
        >>> plant_of(paper_study()).inputs[0]
        'actuator 1.1'
    """
    _check_sampled(study)
    structure, case = check_machine(study)
    pose = np.array(study.motion.waypoints[0], float)
    found = jax.tree.map(np.asarray, _plant(structure._replace(n_steps=1, substeps=1), case, pose))
    used = used_states(found.state, found.leave)  # without commands older than the delay
    a, b, c = found.state[np.ix_(used, used)], found.enter[used], found.leave[:, used]
    actuators, sensors = _ports(structure)
    return NamedSystem(
        a=a,
        b=b,
        c=c,
        d=np.zeros((len(c), b.shape[1])),
        sample_time=1 / study.electronics.sample_rate_hz,
        inputs=actuators,
        outputs=sensors,
    )


@kept_jit(static_argnums=0)
def _law(structure: Structure, case: Case) -> tuple[Array, Array, Array, Array]:
    return linear_law(prepare(structure, case).loop.controller)


def controller_of(study: Study) -> NamedSystem:
    """The controller of a study, of any law, as a linear system from sensors to commands.

    ADC and limits are left out. What `control.law = "state_space"` reads back acts alike.

    Args:
        study: with sampled feedback.

    Returns:
        NamedSystem.

    Raises:
        StudyError: nothing is sampled, the law switches its channels, or the study cannot run.

    Example:
        >>> controller_of(paper_study()).inputs[0]
        'sensor 1.1'
    """
    _check_sampled(study)
    if LAWS[study.control.law].is_switching:
        raise field_error("control.law", study.control.law, "a law whose channels act all at once")
    structure, case = check_machine(resolved_study(study))
    law = _law(structure._replace(n_steps=1, substeps=1), case)
    a, b, c, d = (np.asarray(part) for part in law)
    n = len(c)  # the commands of the sample before are states, too
    actuators, sensors = _ports(structure)
    return NamedSystem(
        a=np.block([[a, b[:, n:]], [c, d[:, n:]]]),
        b=np.vstack([b[:, :n], d[:, :n]]),
        c=np.hstack([c, d[:, n:]]),
        d=d[:, :n],
        sample_time=1 / study.electronics.sample_rate_hz,
        inputs=sensors,
        outputs=actuators,
    )


def _check_sampled(study: Study) -> None:
    if study.control.feedback != "sampled":
        raise field_error("control.feedback", study.control.feedback, "'sampled'")


def _ports(structure: Structure) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of actuators and of sensors."""
    ports = [
        f"{i + 1}.{k + 1}" for i in range(structure.n_links) for k in range(structure.n_patches)
    ]
    return tuple(f"actuator {x}" for x in ports), tuple(f"sensor {x}" for x in ports)


def write_system(system: NamedSystem, path: str | Path) -> None:
    """Write a plant or a controller as NPZ, MAT or JSON, by the ending of the file.

    The names are those that `[state_space]` reads: A, B, C, D, dt, inputs, outputs.

    Args:
        system: from `plant_of` or `controller_of`.
        path: of the file.

    Raises:
        StudyError: another ending, or a file that cannot be written.
    """
    path = Path(path)
    check_file(path, *FORMATS)
    content: dict[str, Any] = {"A": system.a, "B": system.b, "C": system.c, "D": system.d}
    content |= {"dt": system.sample_time, "inputs": system.inputs, "outputs": system.outputs}
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
