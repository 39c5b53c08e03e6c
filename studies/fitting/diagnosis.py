"""What would mend a misfit: a fault of one or all measurements, or a field that is fixed.

Faults that are made when data are taken (`faults`: polarity, unit, delay, a cable in the wrong
socket) are tried one by one at each measurement, where the fit ended and where it began; the best
of them is accepted only if a new fit with it is far better. Fixed fields are rated by the score
test (Rao 1948), chi square's fall by its slopes, and the best of them freed.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.loop_figures import MARGIN_MODES
from studies.errors import StudyError
from studies.fitting.faults import Fault, fault_of
from studies.fitting.kinds.contract import Measurement
from studies.fitting.measurements import make_bench, make_measurements
from studies.fitting.problem import Problem, make_problem
from studies.fitting.solve import descend_all, follow
from studies.fitting.spec import FitSpec, number_unit, parse_fit, shown_value
from studies.fitting.statistics import misfit
from studies.space.free import plain_numbers
from studies.study.paths import free_fields, known_field, parts_of
from studies.study.spec import DESIGN, MACHINE

#: A remedy is told if it lowers chi square by this factor [1].
BETTER = 3.0
#: Faults of one kind are one where their sizes differ by no more than this [1].
ALIKE = 0.1
#: Times that faults are sized anew.
RESIZED = 3
#: Evaluations of a new fit; fixed fields that are freed, the best first.
ITERATIONS, FREED = 25, 3
#: Stiffness of the links, and by how much it is parted at first, of the way between its bounds [1].
STIFFNESS, SPREAD = ("link.stiffness_factor", "link.youngs_modulus"), 0.05
#: Sections of the study with fields of the machine.
SECTIONS = ("machine", "link", "patches", "load", "drive", "electronics")
#: Where fields that are zero are searched, by unit.
FROM_ZERO = {"kg": 0.2, "kg m2": 2e-5, "m": 2e-3, "N s/m": 100.0, "Hz": 10.0}


class Remedy(NamedTuple):
    """Something that would mend a misfit."""

    text: str
    before: float  # chi square
    after: float  # of a fit with it


def diagnose(spec: FitSpec, problem: Problem, u: np.ndarray) -> tuple[Remedy, ...]:
    """What would mend a misfit, the most effective first; none if nothing does.

    Args:
        spec: of the fit.
        problem: its residuals.
        u: where it ended, (p,).
    """
    found = [
        *_of_data(problem, u),
        *_of_fields(spec, problem, u),
        *_of_links(spec, problem, u),
        *_of_modes(spec, problem, u),
    ]
    found = [x for x in found if x.after * BETTER < x.before]
    return tuple(sorted(found, key=lambda x: x.after))


def _square(problem: Problem, u: np.ndarray) -> float:
    return float(np.sum(problem.residual(u) ** 2))


# --- the data -------------------------------------------------------------------------------------


def _of_data(problem: Problem, u: np.ndarray) -> list[Remedy]:
    """Faults of measurements, all undone together.

    They are sized once more where the best fit without them ended.
    """
    start, before = problem.free.places(), _square(problem, u)
    best: Remedy | None = None
    places = [u, start]
    for at in places:
        values = problem.free.values(at)
        mended, faults = list[Measurement](), list[tuple[str, Fault]]()
        for one in problem.measurements:
            fault = None if _is_noise(one, values) else fault_of(one, values, BETTER)
            mended.append(one if fault is None else fault.mended)
            if fault is not None:
                faults.append((one.name, fault))
        if not faults:
            continue
        other = problem._replace(measurements=tuple(mended))
        optimum = min(
            descend_all(other, [at, start], ITERATIONS), key=lambda x: x.cost, default=None
        )
        if optimum is not None and (best is None or 2 * optimum.cost < best.after):
            best = Remedy(_fault_words(faults, len(mended)), before, 2 * optimum.cost)
            if len(places) <= RESIZED:
                places.append(optimum.u)
    return [] if best is None else [best]


def _is_noise(one: Measurement, values: np.ndarray) -> bool:
    return bool(misfit(one, one.residual(values, False)).is_noise)


def _fault_words(faults: list[tuple[str, Fault]], every: int) -> str:
    """Faults of one kind and nearly one size are one fault."""
    groups: list[list[tuple[str, Fault]]] = []
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
        which = "every measurement" if len(group) == every > 1 else names
        parts.append(f"{which}: {group[0][1].text.format(size)}")
    return "; ".join(parts)


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
        text = f"{name}, which is fixed at {shown_value(name, own)}, is {shown_value(name, value)}"
        found.append(Remedy(text, before, 2 * float(done.cost)))
    return found


def _of_links(spec: FitSpec, problem: Problem, u: np.ndarray) -> list[Remedy]:
    """A free field of the links whose value may differ from link to link."""
    if problem.has_motions:  # takes minutes
        return []
    found = []
    for field in STIFFNESS:
        section, _, name = field.partition(".")
        if field not in spec.fit.free or isinstance(getattr(spec.study.link, name), tuple):
            continue
        own = [getattr(spec.study.link, name)] * spec.study.n_links
        links = dict(spec.data.get(section, {})) | {name: own}
        try:
            apart = _problem_of(parse_fit(spec.data | {section: links}, spec.folder))
        except StudyError:  # the parameters have no place there
            continue
        place = dict(zip(problem.free.names, u, strict=True))
        at = np.array([place.get(x, place.get(x.partition("[")[0])) for x in apart.free.names])
        starts = [np.clip(at + SPREAD * turn, 1e-9, 1 - 1e-9) for turn in _spreads(apart, field)]
        after = min((2 * x.cost for x in descend_all(apart, starts, ITERATIONS)), default=np.inf)
        text = f"the links differ in {field} (a list of three in the study)"
        found.append(Remedy(text, _square(problem, u), after))
    return found


def _spreads(apart: Problem, field: str) -> Iterator[np.ndarray]:
    """Directions in which a field's numbers part: every order of the links."""
    own = [k for k, name in enumerate(apart.free.names) if name.partition("[")[0] == field]
    for order in permutations((-1.0, 0.0, 1.0)):
        turn = np.zeros(len(apart.free.names))
        turn[own] = order
        yield turn


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


def _problem_of(spec: FitSpec) -> Problem:
    bench = make_bench(spec)
    return make_problem(spec, bench, make_measurements(spec, bench))


def _wide_problem(whole: FitSpec, u: np.ndarray) -> tuple[Problem, np.ndarray]:
    """The problem with more free numbers, and the place in it where the fit ended."""
    wide = _problem_of(whole)
    at = whole.free.places()
    at[: len(u)] = u
    values = whole.free.values(at)
    for one in wide.measurements:
        one.reweigh(values)
    return wide, np.clip(at, 1e-9, 1 - 1e-9)
