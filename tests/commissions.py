"""Machines drawn at random, richer than the model that is fitted, and how firmware does on them."""

import jax
import jax.numpy as jnp
import numpy as np

from studies.commission.spec import tuning_section
from studies.engine.controller import fixed_controller
from studies.engine.design import load_design
from studies.engine.fast_motion import find_motion, with_own_motion
from studies.engine.stability import loop_report
from studies.export.fixed import dac_step_of
from studies.export.in_the_loop import run_controller
from studies.export.run import DAC_BITS
from studies.fitting.measurements import make_bench, make_measurements
from studies.study.cases import build_case, build_structure
from studies.study.signals import INPUTS, OUTPUTS, parse_signal
from studies.tuning.spec import parse_tuning
from studies.tuning.verb import tune
from tests.bare import paper_study, parse_fit, parse_study
from tests.elements import response_of_elements
from tests.fits import write

POSE = [0.005, 0.012, 0.48]
FREQUENCY = np.concatenate([np.linspace(20, 200, 90), np.linspace(205, 600, 80)])
#: Modes of the machine, and of the model that is fitted to it.
RICH, FITTED = 12, 6
#: Noise of a response: a share of it, and of its largest value.
NOISE, FLOOR = 0.01, 1e-3
ENDS = ("input", INPUTS), ("output", OUTPUTS)
FREE = {
    "link.youngs_modulus": {"from": 60e9, "to": 80e9},
    "link.joint_inertia_c": {"from": 1e-7, "to": 5e-5, "scale": "log"},
    "link.damping_ratio": {"from": 0.002, "to": 0.05, "scale": "log"},
    "load.mass": {"from": 0.0, "to": 0.4},
    "drive.kp": {"from": 1e4, "to": 1e6, "scale": "log"},
    "drive.kd": {"from": 40.0, "to": 90.0},
    "drive.coulomb_friction": {"from": 0.0, "to": 2.0},
}


def assumed_study(n_modes=FITTED):
    """What is known before anything is measured."""
    study = paper_study()
    return study.change(
        link__modes=n_modes,
        link__basis="loaded",
        link__joint_inertia_c=5e-6,
        link__youngs_modulus=(70e9, 70e9, 70e9),
        link__damping_ratio=0.01,
        load__mass=0.05,
    )


def true_study(seed):
    """A machine: links unequal by up to 5 %, payload, joint inertia, damping, drive, friction."""
    rng, study = np.random.default_rng(seed), assumed_study(RICH)
    drive = study.drive
    return study.change(
        link__youngs_modulus=tuple(70e9 * rng.uniform(0.95, 1.05, 3)),
        link__joint_inertia_c=float(10 ** rng.uniform(-5.7, -5)),
        link__damping_ratio=float(rng.uniform(0.005, 0.02)),
        load__mass=float(rng.uniform(0, 0.2)),
        drive__kp=float(drive.kp * rng.uniform(0.8, 1.25)),
        drive__kd=float(drive.kd * rng.uniform(0.8, 1.25)),
        drive__coulomb_friction=float(rng.uniform(0, 1)),
    )


def responses():
    """Entries of the measured responses."""
    signals = [(f"actuator {i}.{k}", f"sensor {i}.{k}") for i in (1, 2, 3) for k in (1, 2)]
    signals += [("actuator 1.2", "sensor 2.2"), ("actuator 2.2", "sensor 3.2")]
    signals += [(f"command {i}", f"motor {i}") for i in (1, 2, 3)]
    return [
        {
            "kind": "response",
            "pose": POSE,
            "input": source,
            "output": output,
            "file": f"response_{k}.csv",
            "sigma_percent": 100 * NOISE,
        }
        for k, (source, output) in enumerate(signals)
    ]


def measure(folder, true, seed, delay=0.0, is_elements=False):
    """Write responses of a machine, with noise; their entries.

    Args:
        folder: for the files.
        true: the machine.
        seed: of the noise.
        delay: of all responses [s].
        is_elements: whether they are those of finite elements.
    """
    entries = responses()
    made = _by_elements(true, entries) if is_elements else _by_model(folder, true, entries)
    rng = np.random.default_rng(seed)
    for entry, exact in zip(entries, made, strict=True):
        exact = exact * np.exp(-2j * np.pi * FREQUENCY * delay)
        floor = FLOOR * np.abs(exact).max()
        sigma = np.hypot(NOISE * np.abs(exact), floor)
        noisy = exact + sigma * (rng.normal(size=(2, len(exact))).T @ [1, 1j])
        write(folder, entry["file"], frequency_hz=FREQUENCY, real=noisy.real, imag=noisy.imag)
        entry["sigma"] = float(f"{floor:.3g}")
    return entries


def _by_model(folder, true, entries):
    """Exact responses by our own model, (n, f)."""
    one = np.ones(len(FREQUENCY))
    for entry in entries:
        write(folder, entry["file"], frequency_hz=FREQUENCY, real=one, imag=one)
    start = {"link.damping_ratio": {"from": 1e-4, "to": 0.1}}
    spec = parse_fit(true.model_dump() | {"fit": {"free": start, "data": entries}}, folder)
    values = np.array([true.link.damping_ratio])
    return [one.predict(values, False)[0] for one in make_measurements(spec, make_bench(spec))]


def _by_elements(true, entries):
    """The same by finite elements."""
    signals = [
        tuple(parse_signal(entry[end], kinds, 3, np.full(3, 0.2), end) for end, kinds in ENDS)
        for entry in entries
    ]
    return response_of_elements(true, POSE, signals, FREQUENCY)


def measured_data(folder, seed, is_elements=False, **commission):
    """The file of a commissioning as a dictionary, and the machine that was measured."""
    true = true_study(seed)
    entries = measure(folder, true, seed, is_elements=is_elements)
    data = assumed_study().model_dump()
    data |= {"fit": {"free": FREE, "data": entries}, "commission": commission}
    parse_study({k: x for k, x in data.items() if k not in ("fit", "commission")})
    return data, true


def with_control_of(true, tuned):
    """The true machine, its motion and its windows with the controller of a tuned study."""
    return true.model_copy(update={x: getattr(tuned, x) for x in ("control", "electronics")})


def margin_on(true, tuned):
    """Gain margin [1] of a tuned study's fixed controller on the true machine; 0: unstable."""
    both, law = with_control_of(true, tuned), fixed_controller(tuned).controller
    structure = build_structure(both)._replace(has_position_gain=False)
    home = np.array(both.motion.waypoints[0], float)
    law = jax.tree.map(jnp.asarray, law)
    loop = loop_report(structure, build_case(both), home, 1, law=law)
    return float(loop.gain_margin) if loop.is_stable else 0.0


def residual_on(true, tuned):
    """Residual vibration [m] of the worst link with that controller behind the same DAC."""
    both, fixed = with_control_of(true, tuned), fixed_controller(tuned)
    step = dac_step_of(fixed.controller, DAC_BITS)
    run = run_controller(build_structure(both), build_case(both), fixed.controller, step)
    return float(np.max(run.result.metrics.residual_rms))


def tuned_on(true, measured, folder):
    """What the same tuning finds for the true machine, with no reserve of margin."""
    motion = find_motion(true).study
    section = tuning_section(measured, motion, {})
    section["limits"]["gain_margin"] = measured.commission.gain_margin
    tune(parse_tuning(motion.model_dump() | {"tune": section}), folder, progress=False)
    return with_own_motion(load_design(folder).study, true)
