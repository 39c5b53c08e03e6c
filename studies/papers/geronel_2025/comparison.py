"""The same fast move with piezo sensors and with strain gauges of growing noise.

The gauges' amplifiers are set so that both sensors give the same voltage for the same bending: then
converter and controller see no other difference than noise.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.piezo import sensor_constant
from studies.engine.batches import ProgressCallback, run_batches
from studies.engine.frame import frame_of
from studies.engine.preflight import check_run
from studies.errors import StudyError
from studies.study.cases import build_case
from studies.study.labels import describe
from studies.study.spec import Study, paper_study

#: Young's moduli of the links over the paper's, which move their frequencies [1].
MODULI = (0.5, 1.0, 2.0)
#: Rms noise at the inputs of the gauges' amplifiers [V].
NOISE = tuple(np.geomspace(3e-8, 3e-5, 7).tolist())
#: Noise too small to matter, of the gauges' amplifiers and of the converter, with which one program
#: runs all cases [V].
QUIET, UNSEEN = 1e-12, 1e-9
SEEDS = (0, 1, 2)
#: Duration of each of the moves [s].
MOVE = 0.04


class SensorComparison(NamedTuple):
    """Residual rms bending of the worst link [m]; axes: moduli, noise, seeds."""

    study: Study
    frequency: np.ndarray  # first mode of the links [Hz], (m,)
    gain: float  # of the gauges' amplifiers [1]
    noise: np.ndarray  # at their inputs [V], (n,)
    free: np.ndarray  # without control, (m,)
    piezo: np.ndarray  # (m, s)
    quiet: np.ndarray  # gauges without noise of their own, (m, s)
    gauge: np.ndarray  # (m, n, s)


def matched_gain(study: Study) -> float:
    """Gain of the gauges' amplifiers that gives the voltage of the piezo sensors [1]."""

    def constant(one: Study) -> float:
        machine = build_case(one).machine
        return float(np.max(np.asarray(sensor_constant(machine.beam, machine.patches))))

    gauges = study.change(patches__sensor="strain_gauge")
    return study.patches.gauge_gain * constant(study) / constant(gauges)


def compare(
    noise: tuple[float, ...], seeds: tuple[int, ...], on_progress: ProgressCallback
) -> SensorComparison:
    """Run all cases.

    Args:
        noise: rms at the inputs of the gauges' amplifiers [V].
        seeds: of the noise, one run each.
        on_progress: called with progress messages.

    Raises:
        StudyError: a run that ends with another status than ok or saturated.
    """
    base = paper_study().change(
        motion__move_time=MOVE,
        shaper__kind="none",
        metrics__stations=(0.5,),
        electronics__adc_noise=UNSEEN,
    )
    gain = matched_gain(base)
    levels = (QUIET, *noise)
    studies = []
    for factor in MODULI:
        piezo = _with_modulus(base, factor)
        gauges = piezo.change(patches__sensor="strain_gauge", patches__gauge_gain=gain)
        studies.append(piezo.uncontrolled())
        studies += [piezo.change(run__seed=seed) for seed in seeds]
        studies += [
            gauges.change(run__seed=seed, patches__gauge_noise=gain * level)
            for level in levels
            for seed in seeds
        ]
    built = [check_run(one) for one in studies]
    structure = built[0][0]._replace(substeps=max(one.substeps for one, _ in built))
    result = run_batches(structure, [case for _, case in built], on_progress)
    ended = set(np.asarray(result.status).astype(int).tolist())
    if bad := ended - {status.OK, status.SATURATED}:
        raise StudyError(f"gauges and piezo sensors: a run ended with {describe(min(bad))}")
    rms = np.asarray(result.metrics.residual_rms).max(axis=(1, 2))
    rows = rms.reshape(len(MODULI), 1 + (1 + len(levels)) * len(seeds))
    controlled = rows[:, 1:].reshape(len(MODULI), 1 + len(levels), len(seeds))
    first = [frame_of(*check_run(_with_modulus(base, factor))) for factor in MODULI]
    return SensorComparison(
        study=base,
        frequency=np.array([one.modal_omega[0, 0] / (2 * np.pi) for one in first]),
        gain=gain,
        noise=np.array(noise),
        free=rows[:, 0],
        piezo=controlled[:, 0],
        quiet=controlled[:, 1],
        gauge=controlled[:, 2:],
    )


def _with_modulus(study: Study, factor: float) -> Study:
    """Stiffer or softer links whose gains add the same damping ratio."""
    gains = tuple(float(gain * np.sqrt(factor)) for gain in study.control.velocity_gain)
    return study.change(
        link__youngs_modulus=float(np.max(study.link.youngs_modulus)) * factor,
        control__velocity_gain=gains,
    )


def noise_limit(noise: np.ndarray, ratio: np.ndarray, most: float) -> float:
    """Noise at which a ratio of rms values reaches `most`, on logarithmic scales [V]; NaN: nowhere.

    Args:
        noise: ascending [V], (n,).
        ratio: rms with gauges over that with piezo sensors [1], (n,).
        most: that counts as equal [1].
    """
    above = np.flatnonzero(ratio > most)
    if not above.size or above[0] == 0:
        return np.nan
    k = int(above[0])
    return float(np.exp(np.interp(most, ratio[k - 1 : k + 1], np.log(noise[k - 1 : k + 1]))))
