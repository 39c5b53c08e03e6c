"""Numbers of a measurement that nobody knows: gain, delay and offset, fitted beside the parameters.

They are those of least squares for any values of the parameters (variable projection, Golub and
Pereyra 1973): the derivatives of the model lose what they could have explained (Kaufman 1975), so
that uncertainties are those of a fit of all numbers together.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

GAIN, DELAY, OFFSET = "gain", "delay", "offset"
#: Delays are sought up to this size [s], first at so many places.
LONGEST, PLACES = 5e-3, 201
#: Data this many times their noise may be nothing else, rms [1].
LOUDEST = 2.0


class Adjusted(NamedTuple):
    """A model with the likeliest unknown numbers."""

    model: np.ndarray  # (n,)
    slope: np.ndarray | None  # by the parameters, (n, p)
    found: dict[str, float]  # the numbers: gain [1], delay [s], offset [unit of the signal]


def adjusted(
    names: tuple[str, ...],
    model: np.ndarray,
    slope: np.ndarray | None,
    measured: np.ndarray,
    sigma: np.ndarray,
    omega: np.ndarray | None = None,
) -> Adjusted:
    """A model times a gain, late by a delay, and with an offset.

    Args:
        names: those of the numbers that are unknown.
        model: (n,), real or complex.
        slope: its derivatives, (n, p), or None.
        measured: (n,).
        sigma: of the measured values, (n,).
        omega: of a response [rad/s], (n,); None: there is no delay.
    """
    if not names:
        return Adjusted(model, slope, {})
    delay = 0.0
    if DELAY in names:
        assert omega is not None
        delay = _delay(names, model, measured, sigma, omega)
    late = np.exp(-1j * omega * delay) if omega is not None else 1.0
    gain, offset = _linear(names, model * late, measured, sigma)
    found = {GAIN: gain, DELAY: delay, OFFSET: offset}
    if slope is not None:
        moved = {
            GAIN: model * late,
            DELAY: -1j * omega * gain * late * model if omega is not None else model,
            OFFSET: np.ones_like(model),
        }
        slope = gain * slope * np.reshape(late, (-1, 1))
        slope = _without(slope, np.stack([moved[name] for name in names], axis=1), sigma)
    return Adjusted(gain * late * model + offset, slope, {name: found[name] for name in names})


def noise_error(names: tuple[str, ...], measured: np.ndarray, sigma: np.ndarray) -> str:
    """What is wrong with data whose gain is unknown, "" if nothing: noise has any gain of 0."""
    still = np.mean(measured) if OFFSET in names else 0.0
    size = float(np.sqrt(np.mean(np.abs((measured - still) / sigma) ** 2)))
    if GAIN not in names or size > LOUDEST:
        return ""
    return f"measured is {size:.2g} times its noise: nothing that a gain could be told from"


def _delay(
    names: tuple[str, ...],
    model: np.ndarray,
    measured: np.ndarray,
    sigma: np.ndarray,
    omega: np.ndarray,
) -> float:
    """The likeliest delay [s]."""

    def square(delay: float) -> float:
        late = model * np.exp(-1j * omega * delay)
        gain, offset = _linear(names, late, measured, sigma)
        return float(np.sum(np.abs((gain * late + offset - measured) / sigma) ** 2))

    step = 2 * LONGEST / (PLACES - 1)
    places = np.linspace(-LONGEST, LONGEST, PLACES)
    first = places[int(np.argmin([square(x) for x in places]))]
    found = minimize_scalar(
        square, bounds=(first - step, first + step), method="bounded", options={"xatol": 1e-10}
    )
    return float(found.x)


def _linear(
    names: tuple[str, ...], model: np.ndarray, measured: np.ndarray, sigma: np.ndarray
) -> tuple[float, float]:
    """Gain and offset of least squares; 1 and 0 where they are known."""
    columns = [x for name, x in ((GAIN, model), (OFFSET, np.ones_like(model))) if name in names]
    if not columns:
        return 1.0, 0.0
    known = 0.0 if GAIN in names else model
    matrix = _real(np.stack(columns, axis=1) / sigma[:, None])
    solved = np.linalg.lstsq(matrix, _real((measured - known) / sigma), rcond=None)[0].tolist()
    gain = solved.pop(0) if GAIN in names else 1.0
    return gain, solved.pop(0) if OFFSET in names else 0.0


def _without(slope: np.ndarray, moved: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Derivatives less what the unknown numbers explain of them."""
    matrix, wanted = _real(moved / sigma[:, None]), _real(slope / sigma[:, None])
    share = np.linalg.lstsq(matrix, wanted, rcond=None)[0]
    return np.asarray(slope - moved @ share)


def _real(x: np.ndarray) -> np.ndarray:
    """Real above imaginary parts, where there are any."""
    return np.concatenate([x.real, x.imag]) if np.iscomplexobj(x) else x
