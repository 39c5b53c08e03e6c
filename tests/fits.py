"""Synthetic measurements of a known machine."""

import numpy as np

from studies.fitting.estimate import estimate, fit_phases
from studies.fitting.kinds.modes import TWO_PI
from studies.fitting.kinds.motions import Recording
from studies.fitting.measurements import guess, make_bench, make_measurements
from studies.fitting.problem import make_problem
from studies.fitting.solve import descend
from studies.fitting.statistics import describe_fit
from tests.bare import parse_fit
from tests.jobs import quiet_job

SHORT = {
    "run": {"duration": 0.06},
    "link": {"modes": 2, "damping_ratio": 0.012},
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
#: Three links that differ, and what is free of them where faults are sought.
UNEQUAL = {"link": SHORT["link"] | {"youngs_modulus": [66e9, 70e9, 75e9]}}
FREE_OF_UNEQUAL = {
    "link.stiffness_factor": {"from": 0.8, "to": 1.2},
    "link.damping_ratio": {"from": 0.002, "to": 0.04},
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
#: At mid-span, as the stations of a bench without such instruments: its programs serve all.
HAMMER = RESPONSE | {
    "input": "hammer 2 at 0.1",
    "output": "deflection 3 at 0.1",
    "quantity": "acceleration",
    "sigma": 0.02,
}
ACCELEROMETER = RESPONSE | {"input": "slider 1", "output": "accelerometer 2 at 0.1 to 40"}
MOTOR = RESPONSE | {"input": "command 1", "output": "motor 1"}
MAGNITUDE = HAMMER | {"magnitude": "real"}
SENSORS = ["sensor 1.1", "sensor 2.1", "sensor 3.1"]
DECAY = {
    "kind": "decay",
    "pose": ASKEW,
    "file": "decay.csv",
    "outputs": SENSORS,
    "from_hz": 60.0,
    "to_hz": 300.0,
}
FREQUENCY = np.linspace(60.0, 500.0, 200)
TIME = np.linspace(0.01, 0.059, 180)


#: Step of derivatives through complex numbers, exact to rounding.
TINY_STEP = 1e-30


class Ringing:
    """A run whose outputs ring in closed form, in place of a `Motion`; parameters are `FREE`."""

    patches = (3, 3)

    def find(self, name, signal, values, has_slopes):
        """One output: its own frequency and size, by modulus, damping ratio and mass."""
        time = np.linspace(0.0, 0.06, 601)

        def value(x):
            hertz = 90.0 + 20 * signal.link + 7 * signal.patch
            omega = 2 * np.pi * hertz * np.sqrt(x[0] / 7e10 / (1 + x[2]))
            size = (5.0 + 2 * signal.link - signal.patch) / (1 + x[2])
            return size * np.exp(-10 * x[1] * omega * time) * np.sin(omega * time + signal.link)

        slope = None
        if has_slopes:
            steps = values + 1j * TINY_STEP * np.diag(values)
            slope = np.stack([value(x).imag for x in steps], axis=1) / (TINY_STEP * values)
        return Recording(time, 0.03, value(values), slope)


def fit_of(spec):
    """A fit that is not written."""
    return estimate(spec, quiet_job(None, fit_phases(spec)))


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


def posed(spec, bench=None):
    """The problem of a fit; bench: as for `made`."""
    bench, every, _ = made(spec, bench)
    return make_problem(spec, bench, every)


def followed(problem):
    """The optimum that the study leads to, without other starting points."""
    u = problem.free.places()
    for _ in range(2):  # the noise of the second is that of the first one's model
        u = descend(problem, u, 60).u
        for one in problem.measurements:
            one.reweigh(problem.free.values(u))
    return u


def answered(problem):
    """What a fit says there."""
    return describe_fit(problem, followed(problem))


def measured_modes(bench, one, values):
    """The model's own modes as if they were measured."""
    plant = bench.plant(one._pose, values, False)
    modes = plant.modes
    frequency = np.abs(modes.pole) / TWO_PI
    bending = np.flatnonzero(frequency > 60)[: len(one._modes.frequency)]
    return one._modes._replace(
        frequency=frequency[bending],
        damping=(-modes.pole.real / np.abs(modes.pole))[bending],
        shapes=(np.asarray(plant.value.sensor) @ modes.shape[:, bending]).T,
    )


def give_data(bench, one, values, rng):
    """What the model with these values would be measured as, with the noise of the measurement."""
    if one.kind == "modes":
        one.use(measured_modes(bench, one, values))
        one.measured = one.measured + one.sigma * rng.normal(size=one.measured.shape)
        return
    exact, _ = one.predict(values, False)
    if one.kind == "spectrum":
        one.measured = np.abs(exact) ** 2 * rng.gamma(64, 1 / 64, len(exact))
        return
    one.reweigh(values)
    if np.isrealobj(one.measured):
        one.measured = np.abs(exact) if np.iscomplexobj(exact) else exact
        one.measured = one.measured + one.sigma * rng.normal(size=len(exact))
    else:
        one.measured = exact + one.sigma * (rng.normal(size=(2, len(exact))).T @ [1, 1j])


def write_decays(folder, bench, values):
    """A file with three decays of 0.5 s after impulses of one actuator each."""
    rate, rng = 10000.0, np.random.default_rng(3)  # above all modes
    plant = bench.plant(tuple(ASKEW), values, False)
    pole, right, left = plant.eigen
    rows = plant.value.sensor[:: bench.n_patches]
    course = np.exp(np.outer(np.arange(5000) / rate, pole))
    parts = []
    for link in range(3):
        start = left @ plant.value.actuator[0, :, link * bench.n_patches]
        parts.append(((course * start) @ right.T @ rows.T).real)
    signals = np.concatenate(parts) / np.std(parts)
    signals += 0.002 * rng.normal(size=signals.shape)
    columns = dict(zip(SENSORS, signals.T, strict=True))
    write(folder, DECAY["file"], time=np.arange(15000) / rate, **columns)
