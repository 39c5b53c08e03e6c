"""Labelled results of one run: axes, trajectories, metrics and judgement, for its file."""

from __future__ import annotations

import json
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from jaxmodel.bases import find_bases
from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.delay import command_change, true_delay
from jaxmodel.hysteresis import added_voltage, advance_plays, design_hysteresis
from jaxmodel.loop_figures import MARGIN_MODES
from jaxmodel.prepare import left_out_deflection, spectrum_frequencies
from jaxmodel.simulate import RunResult
from studies import config
from studies.engine.columns import RECORD, axis_variables, named
from studies.engine.poles import PoleReport
from studies.engine.programs import kept_jit
from studies.engine.runs import Run
from studies.results.labelled import Variable, Variables
from studies.store import axis_sizes
from studies.study.labels import STATUS_LABEL
from studies.study.spec import Study


def metric_variables(result: RunResult, *axes: str) -> dict[str, Variable]:
    """Labelled metrics of a run, or of runs along some axes."""
    return {name: named(name, np.asarray(data), *axes) for name, data in result.metrics.items()}


#: Labelled as in the files of sweeps.
_OF_RESULTS = (
    "bad_time",
    "command_end",
    "sensor_condition",
    "actuator_condition",
    "singularity_distance",
)


@kept_jit(static_argnums=0)
def _spectrum_frequencies(structure: Structure, case: Case) -> Any:
    return spectrum_frequencies(structure, find_bases(structure, case))


def result_variables(run: Run) -> dict[str, Variable]:
    """What a run ended like: its metrics, and what its cases have in the files of sweeps."""
    of_cases = {name: named(name, getattr(run.result, name)) for name in _OF_RESULTS}
    return of_cases | metric_variables(run.result)


def run_variables(run: Run) -> dict[str, Variable]:
    """Contents of a run's file: axes, trajectories (if kept), metrics, judgement."""
    frequency = np.asarray(_spectrum_frequencies(run.structure, run.case))
    variables = {
        "spectrum_frequency": Variable(
            frequency,
            ("link", "controlled_mode", "spectrum_point"),
            "Hz",
            "frequency of spectral_density",
        ),
        "status": Variable(np.array(run.status), (), *STATUS_LABEL),
        **result_variables(run),
        **loop_variables(run),
    }
    if run.result.record is not None:
        kept = run.result.record._asdict() | {"chord_deflection": chord_deflection(run)}
        variables |= {name: named(name, kept[name]) for name in RECORD}
    return variables | axis_variables(run.study, axis_sizes(variables))


def loop_variables(run: Run) -> Variables:
    """Judgement of a run's linearised loop, its poles and its margins on the way; {} for none."""
    found = Variables()
    if (loop := run.loop) is not None:
        text = "of the linearised sampled loop"
        found.put("loop_spectral_radius", loop.spectral_radius, "1", text)
        text = f"common gain factor before instability, {MARGIN_MODES} plant modes or more"
        found.put("gain_margin", loop.gain_margin, "1", text)
        tracked = "tracked_mode", "tracked_pole"
        text = "frequencies of the lowest link modes under control, three of each order"
        found.put("loop_frequency", loop.frequency_hz, "Hz", text, *tracked)
        found.put("loop_damping_ratio", loop.damping_ratio, "1", "their damping ratios", *tracked)
        found |= {name: named(name, value) for name, value in (loop.robustness or {}).items()}
    if run.poles is not None:
        texts = ("specified", "of the nominal link's loop", "of the assembled machine's loop")
        modes = "link", "controlled_mode"
        for name, text, pole in zip(PoleReport._fields, texts, run.poles[:3], strict=False):
            found.put(f"{name}_pole_decay", -pole.real, "s-1", f"decay of the poles {text}", *modes)
            hertz, text = np.abs(pole.imag) / (2 * np.pi), f"frequency of the poles {text}"
            found.put(f"{name}_pole_frequency", hertz, "Hz", text, *modes)
    if (motion := run.motion) is not None:
        text = "start of the unshaped motion, and extremes of N"
        found.put("motion_time", motion.time, "s", text, "instant")
        text = "tension N in the links then"
        found.put("motion_axial_force", motion.axial_force, "N", text, "instant", "link")
        text = "gain margin as if the instant lasted"
        found.put("motion_gain_margin", motion.gain_margin, "1", text, "instant")
    return found


def chord_deflection(run: Run) -> np.ndarray:
    """Mid-span deflection relative to the chord B-C [m], (n_steps, 3).

    From the plant's modes and, for those it leaves out, the voltages on the actuators.
    """
    middle = run.study.each_link(run.study.link.length)[:, None] / 2
    per_mode, per_volt = map(np.asarray, _deflections_at(run.structure, run.case, middle))
    record = run.result.record
    assert record is not None
    bent = np.einsum("tir,ir->ti", record.modal_coordinate, per_mode[:, 0])
    if run.structure.has_static_correction:
        bent = bent + np.einsum("tik,ik->ti", _acting_voltage(run), per_volt[:, 0])
    return bent


@kept_jit(static_argnums=0)
def _deflections_at(structure: Structure, case: Case, places: np.ndarray) -> tuple[Any, Any]:
    """Per modal coordinate [1], and what the kept modes leave out per volt [m/V], (3, n, ...)."""
    machine = case.machine
    shape = build_basis(structure.basis, machine.beam, machine.patches, structure.n_modes, places)
    return shape.deflection_at, left_out_deflection(case, shape)


def _acting_voltage(run: Run) -> np.ndarray:
    """By which the actuators act, behind their amplifiers, at the samples [V], (n_steps, 3, K)."""
    assert run.result.record is not None
    command = np.asarray(run.result.record.actuator_voltage)
    if not run.structure.has_amplifier:
        return command + _added_voltage(run, command[:, None])[:, 0]
    electronics = run.case.electronics
    # of a sample, the share until its command changes to that of the next one
    share = 1.0
    if run.structure.is_delayed:
        share = float(command_change(true_delay(electronics)).share) or 1.0
    kept, later, until = (
        np.exp(-x * electronics.period / electronics.amplifier_lag) for x in (1.0, 1 - share, share)
    )
    voltage = scipy.signal.lfilter([1 - later, later - kept], [1.0, -kept], command, axis=0)
    at_change = command + until * (voltage - command)
    return voltage + _added_voltage(run, np.stack([voltage, at_change], axis=1))[:, 0]


def _added_voltage(run: Run, voltage: np.ndarray) -> np.ndarray:
    """What hysteresis adds to voltages between which they do not turn [V], (n_steps, n, 3, K)."""
    if run.structure.feedback != "sampled" or not run.structure.has_hysteresis:
        return np.zeros_like(voltage)
    width, limit = run.case.machine.patches.hysteresis, run.case.electronics.voltage_limit
    operators = design_hysteresis(width, limit)
    n_links, n_patches = voltage.shape[2:]

    def move(plays: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = advance_plays(operators, plays, v)
        return after, added_voltage(operators, after)

    start = jnp.zeros((len(operators.play), n_links, n_patches))
    _, added = jax.lax.scan(move, start, jnp.reshape(voltage, (-1, n_links, n_patches)))
    return np.asarray(added).reshape(voltage.shape)


def run_attributes(study: Study) -> dict[str, Any]:
    """A file's record of its origin: study, versions, device, precision."""
    return {
        "title": study.title,
        "study": json.dumps(study.model_dump(mode="json")),
        **{name.replace("-", "_"): fact for name, fact in config.origin().items()},
    }
