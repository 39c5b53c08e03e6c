"""What the paper's report reads from the runs, apart from the accumulated metrics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from studies.papers.zhang_2016.cases import PaperRuns

#: Spectra are kept up to this frequency [Hz].
TOP_HZ = 1200.0


#: A link has settled when its mid-span stays below this share of its largest deflection after the
#: command without control [1].
SETTLED = 0.05


class Measures(NamedTuple):
    """Leading axis: cases."""

    frequency: np.ndarray  # [Hz], (F,)
    spectral_density: np.ndarray  # one-sided, Hann periodogram of the run [m2/Hz], (n, 3, C, F)
    spectral_peak: np.ndarray  # largest of the metric spectral_density [m2/Hz], (n, 3, C)
    residual: np.ndarray  # rms mid-span deflection in the residual window [m], (n, 3)
    settling: np.ndarray  # of mid-span, from the command's end to SETTLED [s], (n, 3)
    counterpart: np.ndarray  # index of the uncontrolled counterpart, (n,)


def middle_station(runs: PaperRuns) -> int:
    """Index of the station nearest to mid-span."""
    return int(np.argmin(np.abs(np.array(runs.study.metrics.stations) - 0.5)))


def measure(runs: PaperRuns) -> Measures:
    """Spectra, their peaks, the residual and settling of all runs."""
    record, end = runs.result.record, np.asarray(runs.result.command_end)
    assert record is not None
    rate = runs.study.electronics.sample_rate_hz
    time = record.time[0]
    frequency, density = scipy.signal.periodogram(
        record.controlled_coordinate, rate, window="hann", axis=1
    )
    keep = frequency <= TOP_HZ
    frequency, density = frequency[keep], np.moveaxis(density[:, keep], 1, -1)
    middle = middle_station(runs)
    deflection = record.chord_deflection_stations[:, :, :, middle]
    counterpart = _counterparts(runs)
    size = np.abs(deflection)
    is_after = (time >= end[:, None])[..., None]
    limit = SETTLED * np.max(size, axis=1, where=is_after, initial=0.0)[counterpart]
    return Measures(
        frequency=frequency,
        spectral_density=density,
        spectral_peak=np.asarray(runs.result.metrics.spectral_density).max(axis=-1),
        residual=np.asarray(runs.result.metrics.residual_rms)[:, :, middle],
        settling=_settling(time, end, size, limit),
        counterpart=counterpart,
    )


def _counterparts(runs: PaperRuns) -> np.ndarray:
    off = {case.counterpart: k for k, case in enumerate(runs.cases) if not case.is_controlled}
    return np.array([off[case.counterpart] for case in runs.cases])


def _settling(time: np.ndarray, end: np.ndarray, size: np.ndarray, limit: np.ndarray) -> np.ndarray:
    """Last time after `end` at which size (n, T, 3) exceeds limit (n, 3), from `end` on."""
    is_outside = (size > limit[:, None]) & (time >= end[:, None])[..., None]
    last = np.max(np.where(is_outside, time[:, None], 0.0), axis=1)
    return np.maximum(last - end[:, None], 0.0)
