"""Measurements of machines drawn at random, made by a richer model than the one to be fitted."""

import numpy as np

from studies.fitting.measurements import make_bench, make_measurements
from studies.fitting.spec import parse_fit
from studies.study.spec import paper_study, parse_study
from tests.fits import write

POSE = [0.005, 0.012, 0.48]
FREQUENCY = np.concatenate([np.linspace(20, 200, 90), np.linspace(205, 600, 80)])
#: Modes of the machine, and of the model that is fitted to it.
RICH, FITTED = 12, 6
#: Noise of a response: a share of it, and of its largest value.
NOISE, FLOOR = 0.01, 1e-3
FREE = {
    "link.youngs_modulus": {"from": 60e9, "to": 80e9},
    "link.joint_inertia_c": {"from": 1e-7, "to": 5e-5, "scale": "log"},
    "link.damping_ratio": {"from": 0.002, "to": 0.05, "scale": "log"},
    "load.mass": {"from": 0.0, "to": 0.4},
    "drive.kp": {"from": 1e4, "to": 1e6, "scale": "log"},
    "drive.kd": {"from": 10.0, "to": 6000.0, "scale": "log"},
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


def measure(folder, true, seed, delay=0.0):
    """Write responses of a machine, with noise; their entries. delay: of all of them [s]."""
    entries, one = responses(), np.ones(len(FREQUENCY))
    for entry in entries:
        write(folder, entry["file"], frequency_hz=FREQUENCY, real=one, imag=one)
    start = {"link.damping_ratio": {"from": 1e-4, "to": 0.1}}
    spec = parse_fit(true.model_dump() | {"fit": {"free": start, "data": entries}}, folder)
    rng, values = np.random.default_rng(seed), np.array([true.link.damping_ratio])
    for entry, one in zip(entries, make_measurements(spec, make_bench(spec)), strict=True):
        exact, _ = one.predict(values, False)
        exact = exact * np.exp(-2j * np.pi * FREQUENCY * delay)
        floor = FLOOR * np.abs(exact).max()
        sigma = np.hypot(NOISE * np.abs(exact), floor)
        noisy = exact + sigma * (rng.normal(size=(2, len(exact))).T @ [1, 1j])
        write(folder, entry["file"], frequency_hz=FREQUENCY, real=noisy.real, imag=noisy.imag)
        entry["sigma"] = float(f"{floor:.3g}")
    return entries


def measured_data(folder, seed, **commission):
    """The file of a commissioning as a dictionary, and the machine that was measured."""
    true = true_study(seed)
    entries = measure(folder, true, seed)
    data = assumed_study().model_dump()
    data |= {"fit": {"free": FREE, "data": entries}, "commission": commission}
    parse_study({k: x for k, x in data.items() if k not in ("fit", "commission")})
    return data, true
