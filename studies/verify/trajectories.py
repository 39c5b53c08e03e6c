"""What the drive shall follow: the reference trajectory and the input shaper."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import Case
from jaxmodel.motion import Path, sample_path
from jaxmodel.shaper import SHAPERS, Taps, design_shaper
from studies.engine.programs import kept_jit
from studies.study.held_link import first_frequency
from studies.study.spec import Study
from studies.verify.prepared import prepared
from studies.verify.rows import Assumption, largest, worst

#: Mode and tolerance for which shapers are designed: any would do.
_OMEGA, _ZETA, _TOLERANCE = 2 * np.pi * 114.4, 0.02, 0.05
#: What a shaper leaves whose frequency is known to 2e-4, as by Stodola's iteration [1].
_DETUNED = 1e-3
#: Width of the band with less than 5 % vibration over its centre frequency, undamped (Singhose,
#: Seering and Singer 1994; Vaughan, Yano and Singhose 2008) [1].
_INSENSITIVITY = {
    "zv": 0.0637,
    "zvd": 0.2871,
    "ei": 0.3994,
    "zvdd": 0.4804,
    "ei2": 0.7245,
    "ei3": 0.9639,
}


def check_trajectories(study: Study) -> list[Assumption]:
    """Reference trajectory, all shapers, and the study's on its sample grid."""
    _, case, found = prepared(study)
    return [_path(study, case), _no_vibration(), _insensitivity(), _taps(study, case, found.taps)]


@kept_jit()
def _sample(path: Path, time: Any) -> Any:
    return sample_path(path, time)


def _path(study: Study, case: Case) -> Assumption:
    """Positions, rates and accelerations at many instants, move by move."""
    path = jax.tree.map(np.asarray, case.path)
    pauses = np.broadcast_to(path.dwell, path.move_time.shape)
    starts = np.cumsum(np.append(0.0, path.move_time + pauses))[:-1]
    u = np.linspace(0.01, 0.99, 51)
    time = (starts[:, None] + u * path.move_time[:, None]).ravel()
    angle, quintic = 2 * np.pi * u, np.polynomial.Polynomial([0, 0, 0, 10, -15, 6])
    laws = {
        "cycloid": [u - np.sin(angle) / (2 * np.pi), 1 - np.cos(angle), 2 * np.pi * np.sin(angle)],
        "quintic": [quintic(u), quintic.deriv()(u), quintic.deriv(2)(u)],
    }[study.motion.profile]
    length = np.diff(path.waypoints, axis=0)[:, None]
    found = jax.tree.map(np.asarray, _sample(path, time))
    apart = [0.0]
    for order, (mine, law) in enumerate(zip(found, laws, strict=True)):
        wanted = law[:, None] * length / path.move_time[:, None, None] ** order
        wanted = wanted + (path.waypoints[:-1, None] if order == 0 else 0.0)
        if wanted.size:
            apart.append(largest(mine, wanted.reshape(mine.shape)))
    return Assumption(
        assumption="reference trajectory, its rates and accelerations",
        against=f"(25) move by move ({study.motion.profile})",
        source="Zhang, Mills and Cleghorn 2016",
        difference=worst(*apart),
        allowed=1e-9,
        left_out="" if len(path.waypoints) > 1 else "the study does not move",
    )


@kept_jit()
def _shapers(omega: Any, zeta: Any, tolerance: Any) -> Any:
    """All shapers, (kind, impulse)."""
    kinds = jnp.arange(len(SHAPERS))
    return jax.vmap(lambda kind: design_shaper(kind, omega, zeta, tolerance))(kinds)


def _vibration(
    amplitude: Any, time: Any, omega: Any, zeta: float, last: float | None = None
) -> np.ndarray:
    """Amplitude left after impulses over that after one at their end [1], (len(omega),).

    The free response of the oscillator to each impulse, as a complex number, at `last`, by default
    that of the last of them.
    """
    omega = np.atleast_1d(omega)[:, None]
    if last is None:
        last = float(np.max(np.where(np.asarray(amplitude) != 0, time, 0)))
    pole = omega * (-zeta + 1j * np.sqrt(1 - zeta**2))
    return np.abs(np.sum(amplitude * np.exp(pole * (last - time)), axis=1))


def _no_vibration() -> Assumption:
    """ZV, ZVD, ZVDD: no vibration at their mode, and none of its derivatives."""
    impulses = jax.tree.map(np.asarray, _shapers(_OMEGA, _ZETA, 0.0))
    apart, step = [], 1e-3
    for name, order in (("zv", 1), ("zvd", 2), ("zvdd", 3)):
        amplitude, time = (x[list(SHAPERS).index(name)] for x in impulses)
        at, near = _vibration(amplitude, time, np.array([1.0, 1 + step]) * _OMEGA, _ZETA)
        # near the mode, V grows with the power of its zero: pi/2 step for each
        apart += [at, abs(amplitude.sum() - 1), near - 1.05 * (np.pi / 2 * step) ** order]
    return Assumption(
        assumption="ZV, ZVD and ZVDD shapers leave no vibration, their order of zero",
        against="free responses of a damped oscillator",
        source="Singer and Seering 1990",
        difference=worst(*apart),
        allowed=1e-9,
    )


def _insensitivity() -> Assumption:
    """Bands with less than 5 % vibration, and the sum of amplitudes."""
    impulses = jax.tree.map(np.asarray, _shapers(_OMEGA, 0.0, _TOLERANCE))
    ratio, apart = np.linspace(0.2, 1.8, 8001), []
    for name, width in _INSENSITIVITY.items():
        amplitude, time = (x[list(SHAPERS).index(name)] for x in impulses)
        level = _vibration(amplitude, time, ratio * _OMEGA, 0.0)
        found = np.count_nonzero(level <= _TOLERANCE * (1 + 1e-9)) * (ratio[1] - ratio[0])
        apart += [abs(found - width) / width, abs(amplitude.sum() - 1)]
    return Assumption(
        assumption="insensitivity of ZV, ZVD, ZVDD, EI, two- and three-hump EI shapers",
        against="published bands of 5 % vibration",
        source="Singhose 1996; Vaughan et al. 2008",
        difference=worst(*apart),
        allowed=0.01,
    )


def _taps(study: Study, case: Case, taps: Taps) -> Assumption:
    """The study's shaper on its sample grid, against its impulses at their own instants."""
    shaper, time = study.shaper, taps.sample * float(case.electronics.period)
    omega = 2 * np.pi * np.array(_shaped_frequencies(study))
    amplitude, instant = np.ones(1), np.zeros(1)
    for one in omega:
        impulses = _shapers(one, shaper.damping_ratio, shaper.tolerance)
        more = [np.asarray(x)[list(SHAPERS).index(shaper.kind)] for x in impulses]
        amplitude = np.outer(amplitude, more[0]).ravel()
        instant = np.add.outer(instant, more[1]).ravel()
    zeta, last = shaper.damping_ratio, float(np.max(np.where(taps.weight != 0, time, 0)))
    left = _vibration(taps.weight, time, omega, zeta, last)
    left = left - _vibration(amplitude, instant, omega, zeta, last)
    return Assumption(
        assumption=f"the study's shaper ({shaper.kind}) on its sample grid",
        against="free responses to its impulses off the grid",
        source="Murphy and Watanabe 1992",
        difference=worst(abs(taps.weight.sum() - 1), np.abs(left)),
        # interpolating e^(j omega t) between samples, once for each shaper in series
        allowed=_DETUNED + omega.size * float(np.max(omega) * case.electronics.period) ** 2 / 8,
        left_out="" if SHAPERS[shaper.kind].length > 1 else "there is no shaper",
    )


def _shaped_frequencies(study: Study) -> tuple[float, ...]:
    """Of the modes to shape for [Hz]: mode 1 of the controller's model unless they are given."""
    if study.shaper.frequencies_hz:
        return study.shaper.frequencies_hz
    given = study.control.frequencies_hz
    if given:
        rows = given if isinstance(given[0], tuple) else (given,)
        if all(row and row[0] > 0 for row in rows):
            return (float(np.mean([row[0] for row in rows])),)
    nominal = study.change(link__stiffness_factor=1.0)
    return (float(first_frequency(nominal, BASES[study.control.basis].has_patches).mean()),)
