"""Names of the figures of a sampled loop, known without JAX; `jaxmodel.robustness` finds them."""

from __future__ import annotations

import numpy as np

from jaxmodel.parameters import Array

#: Minimum number of plant modes for a margin: uncontrolled modes limit the gains [1].
MARGIN_MODES = 12
#: Margins above the first are reported as it, those below the second as 0 [1].
HIGHEST, LOWEST = 64.0, 1e-6
#: Lower limits of a loop, 0: it is unstable; upper ones, its largest singular values.
MARGINS = ("disk_margin", "phase_margin", "delay_margin")
PEAKS = ("sensitivity_peak", "control_effort_peak", "disturbance_deflection_peak")
#: The search for a delay ends here [samples]; a phase margin is at most 180 deg.
MOST_DELAY, MOST_PHASE = 16.0, 180.0


def guaranteed_range(disk_margin: Array) -> tuple[Array, Array]:
    """Gain [dB] and phase [deg] by which every actuator may err at once, either way.

    (2 + alpha)/(2 - alpha) and 2 atan(alpha/2) (Seiler, Packard and Gahinet 2020, sigma = 0).

    Args:
        disk_margin: alpha, 0 to 2 [1].
    """
    alpha = np.minimum(disk_margin, 2.0)
    with np.errstate(divide="ignore"):
        gain = 20 * np.log10((2 + alpha) / (2 - alpha))
    return gain, np.rad2deg(2 * np.arctan(alpha / 2))
