"""What would mend a misfit: a fault of one or all measured responses, or a field that is fixed.

Faults that are made when data are taken (polarity, unit, delay, a cable in the wrong socket) are
tried one by one at each response, where the fit ended and where it began; the best of them is
accepted only if a new fit with it is far better. Fixed fields are rated by the score test (Rao
1948), chi square's fall by its slopes, and the best of them freed.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.fitting.kinds.contract import Measurement
from studies.fitting.kinds.response import ComplexResponse
from studies.fitting.measurements import make_bench, make_measurements
from studies.fitting.problem import Problem, make_problem
from studies.fitting.solve import descend_all, follow
from studies.fitting.spec import FitSpec, number_unit, parse_fit
from studies.fitting.statistics import misfit
from studies.space.free import plain_numbers
from studies.study.margin import MARGIN_MODES
from studies.study.paths import free_fields, known_field, parts_of
from studies.study.signals import Signal
from studies.study.spec import DESIGN, MACHINE

#: A remedy is told if it lowers chi square by this factor [1].
BETTER = 3.0
#: One fault of a response is as good as a more complicated one within this factor [1].
AS_GOOD = 1.3
#: Delays tried [s], and gains with a meaning of their own.
DELAYS = np.concatenate([-np.geomspace(1e-2, 2e-5, 60), np.geomspace(2e-5, 1e-2, 60)])
GAINS = {
    2 * np.pi: "2 pi",
    1 / (2 * np.pi): "1/(2 pi)",
    9.80665: "9.81, as of accelerations in g",
    1e3: "1000",
    1e-3: "1/1000",
    2.0: "2",
    0.5: "1/2",
    np.sqrt(2): "the root of 2, as of peak and rms values",
}
#: Faults of one kind are one where their sizes differ by no more than this [1].
ALIKE = 0.1
#: Evaluations of a new fit; fixed fields that are freed, the best first.
ITERATIONS, FREED = 25, 3
#: Sections of the study with fields of the machine.
SECTIONS = ("machine", "link", "patches", "load", "drive", "electronics")
#: Where fields that are zero are searched, by unit.
FROM_ZERO = {"kg": 0.2, "kg m2": 2e-5, "m": 2e-3, "N s/m": 100.0, "Hz": 10.0}


class Remedy(NamedTuple):
    """Something that would mend a misfit."""

    text: str
    before: float  # chi square
    after: float  # of a fit with it


class _Fault(NamedTuple):
    """A fault of a response, undone."""

    text: str  # with a place for its size, if it has one
    mend: Callable[[ComplexResponse], ComplexResponse]
    size: float = 0.0


def diagnose(spec: FitSpec, problem: Problem, u: np.ndarray) -> tuple[Remedy, ...]:
    """What would mend a misfit, the most effective first; none if nothing does.

    Args:
        spec: of the fit.
        problem: its residuals.
        u: where it ended, (p,).
    """
    found = [*_of_data(problem, u), *_of_fields(spec, problem, u), *_of_modes(spec, problem, u)]
    found = [x for x in found if x.after * BETTER < x.before]
    return tuple(sorted(found, key=lambda x: x.after))


def _square(problem: Problem, u: np.ndarray) -> float:
    return float(np.sum(problem.residual(u) ** 2))


# --- the data -------------------------------------------------------------------------------------


def _of_data(problem: Problem, u: np.ndarray) -> list[Remedy]:
    """Faults of responses, all undone together."""
    start, before = problem.free.places(), _square(problem, u)
    best: Remedy | None = None
    for at in (u, start):
        values = problem.free.values(at)
        mended, faults = list[Measurement](), list[tuple[str, _Fault]]()
        for one in problem.measurements:
            fault = None
            if isinstance(one, ComplexResponse) and not _is_noise(one, values):
                fault = _fault_of(one, values)
            if fault is None:
                mended.append(one)
            else:
                assert isinstance(one, ComplexResponse)
                mended.append(fault.mend(one))
                faults.append((one.name, fault))
        if not faults:
            continue
        other = problem._replace(measurements=tuple(mended))
        optima = descend_all(other, [at, start], ITERATIONS)
        after = min((2 * x.cost for x in optima), default=np.inf)
        if best is None or after < best.after:
            every = sum(isinstance(x, ComplexResponse) for x in problem.measurements)
            best = Remedy(_fault_words(faults, every), before, after)
    return [] if best is None else [best]


def _is_noise(one: ComplexResponse, values: np.ndarray) -> bool:
    return bool(misfit(one, one.residual(values, False)).is_noise)


def _fault_words(faults: list[tuple[str, _Fault]], every: int) -> str:
    """Faults of one kind and nearly one size are one fault."""
    groups: list[list[tuple[str, _Fault]]] = []
    for name, fault in faults:
        for group in groups:
            other = group[0][1]
            is_near = abs(fault.size - other.size) <= ALIKE * abs(other.size)
            if fault.text == other.text and is_near:
                group.append((name, fault))
                break
        else:
            groups.append([(name, fault)])
    parts = []
    for group in groups:
        size = float(np.median([fault.size for _, fault in group]))
        names = ", ".join(name for name, _ in group)
        which = "every response" if len(group) == every > 1 else names
        parts.append(f"{which}: {group[0][1].text.format(size)}")
    return "; ".join(parts)


def _fault_of(one: ComplexResponse, values: np.ndarray) -> _Fault | None:
    """The simplest fault that, undone, brings a response near the model; None if none does."""
    rated = []
    for fault in _faults(one, values):
        try:
            mended = fault.mend(one)
            square = float(np.sum(mended.residual(values, False).value ** 2))
        except (StudyError, np.linalg.LinAlgError):
            continue
        rated.append((square, fault))
    if not rated:
        return None
    own = float(np.sum(one.residual(values, False).value ** 2))
    least = min(square for square, _ in rated)
    if least * BETTER > own:
        return None
    return next(fault for square, fault in rated if square <= AS_GOOD * least)


def _faults(one: ComplexResponse, values: np.ndarray) -> Iterator[_Fault]:
    """Simple faults first, those with a number of their own last."""
    yield _Fault("its polarity is reversed", _times(-1.0))
    yield _Fault("it is conjugated, as with exp(-j omega t)", _conjugated)
    yield _Fault("its frequencies are in rad/s", _stretched(1 / (2 * np.pi)))
    for gain, name in GAINS.items():
        yield _Fault(f"it is too large by a factor of {name}", _times(1 / gain))
    yield from _other_channels(one)
    model, _ = one.predict(values, False)
    weight = 1 / one.sigma**2
    delay = _best_delay(one, model, weight)
    text = f"it is {'late' if delay > 0 else 'early'} by {{:.3g}} ms"
    yield _Fault(text, _shifted(delay), 1e3 * abs(delay))
    gain = np.sum(weight * one.measured.conj() * model) / np.sum(weight * np.abs(one.measured) ** 2)
    size = abs(gain)
    if size > 0:
        yield _Fault("its gain is wrong by a factor of {:.4g}", _times(float(size)), 1 / size)
        angle = np.degrees(np.angle(gain))
        text = f"its gain is wrong by a factor of {1 / size:.4g} and {-angle:.3g} deg"
        yield _Fault(text, _times(complex(gain)))


def _best_delay(one: ComplexResponse, model: np.ndarray, weight: np.ndarray) -> float:
    """By which the response lags behind the model [s]."""
    turn = np.exp(2j * np.pi * np.multiply.outer(DELAYS, one.frequency))
    fit = np.sum(weight * np.abs(one.measured * turn - model) ** 2, axis=1)
    k = int(np.argmin(fit))
    near = np.linspace(DELAYS[max(k - 1, 0)], DELAYS[min(k + 1, len(DELAYS) - 1)], 201)
    turn = np.exp(2j * np.pi * np.multiply.outer(near, one.frequency))
    fit = np.sum(weight * np.abs(one.measured * turn - model) ** 2, axis=1)
    return float(near[int(np.argmin(fit))])


def _changed(one: ComplexResponse, measured: np.ndarray, scale: float = 1.0) -> ComplexResponse:
    other = copy.copy(one)
    other.measured, other.sigma = measured, scale * one.sigma
    return other


def _times(gain: complex) -> Callable[[ComplexResponse], ComplexResponse]:
    return lambda one: _changed(one, gain * one.measured, abs(gain))


def _conjugated(one: ComplexResponse) -> ComplexResponse:
    return _changed(one, one.measured.conj())


def _shifted(delay: float) -> Callable[[ComplexResponse], ComplexResponse]:
    return lambda one: _changed(one, one.measured * np.exp(2j * np.pi * one.frequency * delay))


def _stretched(factor: float) -> Callable[[ComplexResponse], ComplexResponse]:
    def mend(one: ComplexResponse) -> ComplexResponse:
        other = copy.copy(one)
        other.frequency = factor * one.frequency
        return other

    return mend


def _other_channels(one: ComplexResponse) -> Iterator[_Fault]:
    """Another sensor or actuator in place of the one that the file names."""
    for place, what in ((1, "sensor"), (0, "actuator")):
        own = one.signals[place]
        if own.kind != what:
            continue
        for link in range(3):
            for patch in range(one.n_patches):
                if (link, patch) != (own.link, own.patch):
                    text = f"its {what} is {link + 1}.{patch + 1}"
                    yield _Fault(text, _with_signal(place, own._replace(link=link, patch=patch)))


def _with_signal(place: int, signal: Signal) -> Callable[[ComplexResponse], ComplexResponse]:
    def mend(one: ComplexResponse) -> ComplexResponse:
        other = copy.copy(one)
        signals = list(one.signals)
        signals[place] = signal
        other.signals = (signals[0], signals[1])
        return other

    return mend


# --- fixed fields ---------------------------------------------------------------------------------


def _of_fields(spec: FitSpec, problem: Problem, u: np.ndarray) -> list[Remedy]:
    """Fixed fields of the machine whose freedom would lower chi square most."""
    before = _square(problem, u)
    whole = _freed(spec)
    if whole is None:
        return []
    count = len(spec.free.numbers)
    try:
        wide, at = _wide_problem(whole, u)
        falls = _falls(wide.residual(at), wide.jacobian(at), count)
    except (StudyError, np.linalg.LinAlgError):
        return []
    found = []
    for k in np.argsort(-falls)[:FREED]:
        number = count + int(k)
        moving = np.append(np.arange(count), number)
        try:
            done = follow(wide, at, moving, ITERATIONS, 1e-8)
        except (StudyError, np.linalg.LinAlgError):
            continue
        name = whole.free.names[number]
        place = at.copy()
        place[moving] = done.x
        value = float(whole.free.values(place)[number])
        own = whole.free.numbers[number].start
        unit = number_unit(name)
        size = f"{value:.4g} {unit}".removesuffix(" 1")
        text = f"{name}, which is fixed at {own:.4g}, is {size}"
        found.append(Remedy(text, before, 2 * float(done.cost)))
    return found


def _of_modes(spec: FitSpec, problem: Problem, u: np.ndarray) -> list[Remedy]:
    """A model of more modes."""
    modes = spec.study.link.modes
    more = min(2 * modes, MARGIN_MODES)
    if more <= modes:
        return []
    link = dict(spec.data.get("link", {})) | {"modes": more}
    try:
        richer, at = _wide_problem(parse_fit(spec.data | {"link": link}, spec.folder), u)
    except StudyError:  # it has none, as for a controller of as many
        return []
    after = min((2 * x.cost for x in descend_all(richer, [at], ITERATIONS)), default=np.inf)
    text = f"the machine has {more} modes a link, not {modes} (link.modes)"
    return [Remedy(text, _square(problem, u), after)]


def _falls(residual: np.ndarray, jacobian: np.ndarray, count: int) -> np.ndarray:
    """Fall of chi square that each further number promises beside the first `count`, (k,)."""
    own, more = jacobian[:, :count], jacobian[:, count:]
    base, _ = np.linalg.qr(own)
    more = more - base @ (base.T @ more)
    size = np.sum(more**2, axis=0)
    gain = (residual - base @ (base.T @ residual)) @ more
    is_seen = size > 1e-12 * max(float(size.max(initial=0.0)), 1e-300)
    return np.where(is_seen, gain**2 / np.where(is_seen, size, 1.0), 0.0)


def _freed(spec: FitSpec) -> FitSpec | None:
    """The fit with all fields of the machine free; None if there are no more."""
    own = {name.partition("[")[0] for name in spec.fit.free}
    more = {}
    for field in free_fields([parts_of(spec.study)], DESIGN, MACHINE):
        if field in own or field.partition(".")[0] not in SECTIONS:
            continue
        bounds = _bounds(spec, field)
        if bounds is None:
            continue
        try:
            plain_numbers(field, bounds, spec.study, "fit.free", (DESIGN, MACHINE))
        except StudyError:  # it has no such range
            continue
        more[field] = bounds
    if not more:
        return None
    free = dict(spec.data["fit"]["free"]) | more
    return parse_fit(spec.data | {"fit": spec.data["fit"] | {"free": free}}, spec.folder)


def _bounds(spec: FitSpec, field: str) -> dict[str, Any] | None:
    """A range around a field's value; None if it has none."""
    try:
        value = np.asarray(known_field(field, spec.study, "fit"), float)
        unit = number_unit(field)
    except (StudyError, TypeError, ValueError):
        return None
    if not value.size or not np.all(np.isfinite(value)) or np.any(value < 0):
        return None
    if np.all(value > 0):
        return {"from": float(0.4 * value.min()), "to": float(2.5 * value.max())}
    if unit in FROM_ZERO and not value.any():
        return {"from": 0.0, "to": FROM_ZERO[unit]}
    return None


def _wide_problem(whole: FitSpec, u: np.ndarray) -> tuple[Problem, np.ndarray]:
    """The problem with more free numbers, and the place in it where the fit ended."""
    bench = make_bench(whole)
    wide = make_problem(whole, bench, make_measurements(whole, bench))
    at = whole.free.places()
    at[: len(u)] = u
    values = whole.free.values(at)
    for one in wide.measurements:
        one.reweigh(values)
    return wide, np.clip(at, 1e-9, 1 - 1e-9)
