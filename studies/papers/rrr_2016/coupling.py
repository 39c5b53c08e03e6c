"""How far a controlled link calms the others, by several definitions, and what foretells it.

A reduction is that of an rms value, 1 - sqrt(E_on/E_off). Over the ordered pairs (i, k) of a
controlled and another link, energies are summed, each over that of link k without control, so that
no link counts more than another.

The coupling ratio needs no control: pluck one link and compare what the others do with what it does
itself, rho^2 = mean over pairs of E_ki/E_ii. If links shared their energies and control took away
all that passes through link i, link k would lose its part rho^2/(1 + rho^2), so that

    r = 1 - 1/sqrt(1 + rho^2).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from studies.papers.rrr_2016.energies import (
    ALL,
    ALONE,
    LINKS,
    NONE,
    PLACE,
    PLUCKED,
    PUSHED,
    TURN,
    Energies,
)

#: Ordered pairs: controlled link, other link.
PAIRS = np.array([(i, k) for i in range(3) for k in range(3) if i != k])
#: Poles within this share of the links' frequency belong to links [1].
NEAR = 0.25


def coupling_ratio(energies: Energies) -> np.ndarray:
    """rho [1], (n,)."""
    value = energies.value[:, NONE, LINKS, PLUCKED]
    i, k = PAIRS.T
    return np.sqrt(np.mean(value[:, k, i] / value[:, i, i], axis=1))


def law(ratio: np.ndarray) -> np.ndarray:
    """r = 1 - 1/sqrt(1 + rho^2) [1], see above."""
    return 1 - 1 / np.sqrt(1 + np.asarray(ratio) ** 2)


def ratio_of(reduction: float) -> float:
    """rho at which `law` gives a reduction [1]."""
    return float(np.sqrt(1 / (1 - reduction) ** 2 - 1))


def _shares(energies: Energies, starts: slice) -> np.ndarray:
    """E_on/E_off of the other link of each pair after all starts at random phases, (n, 6)."""
    value = energies.value[:, :, LINKS, starts].sum(axis=-1)
    i, k = PAIRS.T
    return value[:, 1 + i, k] / value[:, NONE, k]


def after_plucks(energies: Energies) -> np.ndarray:
    """Every link plucked, one after another [1], (n,)."""
    return 1 - np.sqrt(_shares(energies, PLUCKED).mean(axis=1))


def after_own_pluck(energies: Energies) -> np.ndarray:
    """Only the other link plucked, so that control can but take up what it passes on [1], (n,)."""
    value = energies.value[:, :, LINKS, PLUCKED]
    i, k = PAIRS.T
    return 1 - np.sqrt(np.mean(value[:, 1 + i, k, k] / value[:, NONE, k, k], axis=1))


def after_pushes(energies: Energies) -> np.ndarray:
    """Impulses of the drives, once these have settled [1], (n,)."""
    return 1 - np.sqrt(_shares(energies, PUSHED).mean(axis=1))


def of_best_pair(energies: Energies) -> np.ndarray:
    """Every link plucked, the pair with the largest reduction [1], (n,)."""
    return 1 - np.sqrt(_shares(energies, PLUCKED).min(axis=1))


def of_poles(energies: Energies) -> np.ndarray:
    """From damping: an rms value falls as 1/sqrt(zeta) [1], (n,).

    Of the three poles near the links' frequency, the two least damped are those of the others; NaN
    where coupling moves them too far from there.
    """
    pole = np.linalg.eigvals(energies.state[:, :ALL])
    size = np.abs(pole)
    omega = energies.omega.mean(axis=1)[:, None, None]
    is_link = (np.abs(size / omega - 1) < NEAR) & (pole.imag > 0)
    zeta = np.sort(np.where(is_link, -pole.real / size, np.nan), axis=-1)[..., :2].mean(axis=-1)
    return 1 - np.sqrt(zeta[:, NONE] / zeta[:, ALONE].mean(axis=1))


#: What "calms" may mean, by name; the first one decides.
DEFINITIONS: dict[str, Callable[[Energies], np.ndarray]] = {
    "every link plucked, mean of all pairs": after_plucks,
    "impulses of the drives, from 50 ms after": after_pushes,
    "only the other link plucked": after_own_pluck,
    "damping of the others' poles": of_poles,
    "every link plucked, best pair": of_best_pair,
}


def of_itself(energies: Energies) -> np.ndarray:
    """Reduction of the controlled link, every link plucked, the least of three [1], (n,)."""
    value = energies.value[:, :, LINKS, PLUCKED].sum(axis=-1)
    i = np.arange(3)
    return 1 - np.sqrt((value[:, 1 + i, i] / value[:, NONE, i]).max(axis=1))


def of_all_links(energies: Energies) -> np.ndarray:
    """Reduction with all links controlled, every link plucked, the least of three [1], (n,)."""
    value = energies.value[:, :, LINKS, PLUCKED].sum(axis=-1)
    return 1 - np.sqrt((value[:, ALL] / value[:, NONE]).max(axis=1))


def of_platform(energies: Energies) -> np.ndarray:
    """Reduction of place and turn of the platform with one link controlled [1], (n, 2).

    Every link plucked; mean energy over the three choices of the controlled link.
    """
    value = energies.value[:, :, PLACE : TURN + 1, PLUCKED].sum(axis=-1)
    return 1 - np.sqrt(value[:, ALONE].mean(axis=1) / value[:, NONE])
