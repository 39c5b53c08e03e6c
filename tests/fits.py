"""Synthetic measurements of a known machine."""

import numpy as np

from studies.fitting.measurements import guess, make_bench, make_measurements
from studies.fitting.spec import parse_fit

SHORT = {
    "run": {"duration": 0.06},
    "link": {"modes": 3, "damping_ratio": 0.012},
    "control": {"modes": 2, "gain_factor": 0.4},
    "motion": {
        "waypoints": [[0.0, 0.0, 0.5235987755982988], [0.0, 0.01, 0.5235987755982988]],
        "move_time": 0.03,
    },
    "metrics": {"residual_delay": 0.002, "residual_length": 0.01},
}
ASKEW = [0.005, 0.012, 0.48]
FREE = {
    "link.youngs_modulus": {"from": 60e9, "to": 80e9},
    "link.damping_ratio": {"from": 0.002, "to": 0.04},
    "machine.platform_mass": {"from": 0.15, "to": 0.35},
}
MODES = {
    "kind": "modes",
    "pose": ASKEW,
    "frequency_hz": [1.0] * 6,
    "sigma_hz": 0.3,
    "damping_ratio": [0.01] * 6,
    "damping_sigma": 5e-4,
    "shapes": [[1.0] * 9] * 6,
}
RESPONSE = {
    "kind": "response",
    "pose": ASKEW,
    "input": "actuator 1.1",
    "output": "sensor 2.2",
    "file": "response.csv",
    "sigma_percent": 3.0,
    "sigma": 1e-5,
}
SPECTRUM = {
    "kind": "spectrum",
    "pose": ASKEW,
    "input": "slider 1",
    "output": "platform x",
    "file": "spectrum.csv",
    "averages": 64,
}
TRACE = {"kind": "trace", "output": "sensor 1.2", "file": "trace.csv", "sigma": 1e-3}
SETTLING = {
    "kind": "settling",
    "output": "sensor 1.2",
    "time_s": 0.02,
    "sigma_s": 0.002,
    "band_percent": 30.0,
}
FIGURES = {
    "kind": "figures",
    "values": {"residual_rms": 1e-6, "residual_rms[link=1]": 1e-6, "peak_voltage": 10.0},
    "sigma_percent": 5.0,
}
REDUCTION = FIGURES | {
    "of": "reduction",
    "values": {"spectral_density[link=1][controlled_mode=1]": 50.0},
    "amplitude": True,
    "take": "largest",
    "links": [True, True, False],
    "modes": 1,
}
HAMMER = RESPONSE | {
    "input": "hammer 2 at 0.07",
    "output": "deflection 3 at 0.1",
    "quantity": "acceleration",
    "sigma": 0.02,
}
ACCELEROMETER = RESPONSE | {"input": "slider 1", "output": "accelerometer 2 at 0.06 to 40"}
MOTOR = RESPONSE | {"input": "command 1", "output": "motor 1"}
MAGNITUDE = HAMMER | {"magnitude": "real"}
FREQUENCY = np.linspace(60.0, 500.0, 200)
TIME = np.linspace(0.01, 0.059, 180)


def write(folder, name, **columns):
    """A CSV file."""
    names, numbers = ",".join(columns), np.column_stack(list(columns.values()))
    np.savetxt(folder / name, numbers, delimiter=",", header=names, comments="")


def blank(folder):
    """Files of measurements that say nothing yet."""
    one, f = np.ones(len(FREQUENCY)), FREQUENCY
    write(folder, "response.csv", frequency_hz=f, real=one, imag=one)
    write(folder, "spectrum.csv", frequency_hz=f, density=one)
    write(folder, "trace.csv", time=TIME, value=np.ones(len(TIME)))


def spec_of(folder, *entries, free=None, study=None, **fit):
    """A fit of these entries."""
    data = {name: dict(x) for name, x in (SHORT | (study or {})).items()}
    return parse_fit(data | {"fit": {"free": free or FREE, "data": list(entries)} | fit}, folder)


def made(spec, bench=None):
    """Bench and measurements; bench: one that serves all entries, whose programs are compiled."""
    bench = bench or make_bench(spec)
    return bench, make_measurements(spec, bench), guess(spec)
