"""The file of a tuning: a study plus `[tune]`, which defines free parameters and objective.

Everything is measured against the baseline, machine by machine and move by move:

- objective: sum of weight times the size of a metric (root of the mean square of its entries) over
  its size in the baseline's run of that scenario, or of a figure of the loop over that of the
  baseline's loop on that machine, the other way round where more is better; of the scenarios, the
  mean of the worst share;
- limits: the largest entry of a metric must not exceed the limit in any scenario; "baseline"
  stands for the baseline's value there. `gain_margin`, `slowest_decay` and the margins of
  `jaxmodel.robustness` are lower limits, `spillover` and the peaks there upper ones, of the
  linearised sampled loop at the first way-point, on every machine;
  `singularity_distance` is a lower limit on the distance of all link angles from 0 and 90 deg.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from jaxmodel.drives import DRIVES
from jaxmodel.laws import LAWS
from jaxmodel.loop_figures import MARGINS, MOST_DELAY, MOST_PHASE, PEAKS
from jaxmodel.metrics import METRICS
from jaxmodel.numbers import SWITCHES
from studies.engine.preflight import check_run
from studies.errors import StudyError, field_error, nearest, shown, shown_name
from studies.space.free import FreeNumbers
from studies.study.cases import build_structure
from studies.study.entries import controlled_links, entry_sizes, parse_entries
from studies.study.files import read_toml
from studies.study.paths import (
    Parts,
    checked_value,
    is_each_link,
    known_field,
    overlaps,
    parse_section,
    parts_of,
    set_value,
    set_values,
)
from studies.study.spec import Section, Study, described, parse_study
from studies.study.window import check_varied, with_window
from studies.tuning.free import free_numbers, writes

#: Limits that no run is needed for: those of the loop,
OF_LOOP = ("gain_margin", "slowest_decay", "spillover", *MARGINS, *PEAKS)
#: and with that of the mechanism.
LOOP_LIMITS = (*OF_LOOP, "singularity_distance")
#: Those that can be terms of an objective as well.
LOOP_TERMS = ("slowest_decay", "spillover", *MARGINS, *PEAKS)
#: Lower ones among them; the others are upper ones.
LOWER = ("gain_margin", "slowest_decay", "singularity_distance", *MARGINS)
#: Largest values of margins.
MOST = {"disk_margin": 2.0, "phase_margin": MOST_PHASE, "delay_margin": MOST_DELAY}
#: Runs in one batch.
MOST_RUNS = 50_000
#: Limit that stands for the baseline's value.
BASELINE = "baseline"
Positive = Annotated[float, Field(gt=0, le=1e30)]


class Scenarios(Section):
    """Machines and moves that one design must handle."""

    count: int = described(1, "1", "machines; the first is the nominal one", ge=1, le=1000)
    check: int = described(16, "1", "fresh machines, to judge the result", ge=1, le=10_000)
    seed: int = described(0, "1", "of the machines", ge=0, le=10**9)
    spread: dict[str, Annotated[float, Field(gt=0, le=99)]] = described(
        {}, "%", "field = +-percent of its value"
    )
    machines: dict[str, tuple[object, ...]] = described(
        {}, "-", "field = its value on each other machine; first those to tune, last those to check"
    )
    each: dict[str, Annotated[tuple[object, ...], Field(min_length=1)]] = described(
        {}, "-", "field = values; all machines run with each"
    )
    tail: float = described(1.0, "1", "share of worst scenarios that count", ge=0, le=1)

    @property
    def has_others(self) -> bool:
        """Whether machines differ from the nominal one."""
        return bool(self.spread or self.machines)


class FamilySection(Section):
    """What moves in a family of designs, and what is set."""

    free: tuple[str, ...] | None = described(None, "-", "names of tune.free; default: all")
    set: dict[str, object] = described({}, "-", "field = value")


class Pareto(Section):
    """A Pareto front: the tuning again and again with another limit."""

    limit: str = described(..., "-", "a metric in tune.limits")
    values: tuple[Positive, ...] = described(..., "-", "its limits", min_length=2)
    family: str | None = described(None, "-", "that moves along it; default: the first")


class Tune(Section):
    """Free parameters and objective."""

    free: dict[str, object] = described({}, "-", "field = {from, to, scale}")
    objective: dict[str, Positive] = described(
        {"residual_rms": 1.0},
        "-",
        "metric or figure of the loop = weight, relative to the baseline",
        min_length=1,
    )
    limits: dict[str, Positive | Literal["baseline"]] = described(
        {}, "-", "metric or figure of the loop = limit or 'baseline', on every machine"
    )
    scenarios: Scenarios = Scenarios()
    families: dict[str, FamilySection] = described(
        {}, "-", "name = {free, set}: what moves, what is set"
    )
    pareto: Pareto | None = described(None, "-", "{limit, values, family}: a Pareto front")
    method: Literal["lbfgs", "adam"] = described("lbfgs", "-", "descent method")
    starts: int = described(8, "1", "starting points of each family", ge=1, le=1024)
    iterations: int = described(60, "1", "evaluations from each starting point", ge=1, le=10_000)
    samples: int = described(0, "1", "random designs for comparison", ge=0, le=10**6)
    seed: int = described(0, "1", "of the starting points", ge=0, le=10**9)


class Family(NamedTuple):
    """Designs that move the same numbers under the same limits."""

    name: str
    is_free: np.ndarray  # which numbers move, (p,)
    columns: dict[str, Any]  # fields of the study that are overridden
    limits: dict[str, float | str]
    front: str  # name of the front it is a point of, "" for none

    def study(self, study: Study) -> Study:
        """The study with this family's settings."""
        return parse_study(set_values(study, self.columns)) if self.columns else study


class TuneSpec(NamedTuple):
    """A tuning as requested."""

    study: Study  # the reference
    tune: Tune
    free: FreeNumbers
    families: tuple[Family, ...]  # those that move something come first
    moves: tuple[dict[str, Any], ...]  # combinations of `scenarios.each`, {} if there is none
    data: dict[str, Any]  # as read, for the record

    @property
    def moving(self) -> tuple[Family, ...]:
        """Families with free parameters."""
        return tuple(family for family in self.families if family.is_free.any())

    @property
    def main(self) -> int:
        """The family with the most free parameters."""
        return int(np.argmax([family.is_free.sum() for family in self.families]))

    def parts(self, family: Family | None = None) -> Parts:
        """Law and drive of a family's designs; None: of the baseline."""
        return parts_of(self.study, {} if family is None else family.columns)

    def studies(self, parts: Parts) -> list[Study]:
        """The baseline and the families' studies, those with one law and drive."""
        every = (self.study, *(family.study(self.study) for family in self.families))
        return [study for study in every if parts_of(study) == parts]

    def has_poles(self, parts: Parts) -> bool:
        """Whether the gains of any such design follow from poles."""
        return any(study.control.has_poles for study in self.studies(parts))

    def has_position_gain(self, parts: Parts) -> bool:
        """Whether any such design feeds back positions."""
        if LAWS[parts.law].has_position or self.has_poles(parts):
            return True
        if any("position_gain" in x for number in self.free.numbers for x in writes(number)):
            return True
        return bool(np.any([study.control.position_gain for study in self.studies(parts)]))

    @property
    def counted_links(self) -> tuple[int, ...]:
        """Links over which metrics are taken if none is named, from 0: the controlled ones."""
        return controlled_links(
            [self.study, *(family.study(self.study) for family in self.families)]
        )

    @property
    def metric_terms(self) -> tuple[str, ...]:
        """Terms of the objective that are metrics of runs."""
        return tuple(name for name in self.tune.objective if name not in LOOP_TERMS)

    @property
    def loop_terms(self) -> tuple[str, ...]:
        """Terms of the objective that are figures of the linearised loop."""
        return tuple(name for name in self.tune.objective if name in LOOP_TERMS)

    @property
    def loop_names(self) -> tuple[str, ...]:
        """Figures of the linearised loop that the objective or a limit names."""
        return tuple(dict.fromkeys((*self.loop_limits, *self.loop_terms)))

    @property
    def metric_limits(self) -> tuple[str, ...]:
        """Limits on metrics of runs."""
        return tuple(name for name in self.tune.limits if name not in LOOP_LIMITS)

    @property
    def loop_limits(self) -> tuple[str, ...]:
        """Limits of the linearised loop."""
        return tuple(name for name in self.tune.limits if name in LOOP_LIMITS)

    @property
    def front_limit(self) -> str:
        """The metric whose limits span the Pareto front, "" if there is none."""
        return self.tune.pareto.limit if self.tune.pareto else ""

    @property
    def limit_names(self) -> tuple[str, ...]:
        """All limits, in the order used by evaluations."""
        return (*self.metric_limits, *self.loop_limits)


def load_tuning(path: str | Path) -> TuneSpec:
    """Read a tuning file, or the ready-made one of that name.

    Raises:
        StudyError: unreadable, not TOML, or not a valid tuning.
    """
    return parse_tuning(read_toml(path))


def parse_tuning(data: dict[str, Any]) -> TuneSpec:
    """Validate a dictionary as a tuning.

    Raises:
        StudyError: first fault found, with field, value, allowed range and unit.
    """
    if "tune" not in data:
        raise StudyError("tune: missing; a tuning is a study file with a section [tune]")
    study = with_window(
        parse_study({name: value for name, value in data.items() if name != "tune"})
    )
    tune = parse_section(Tune, data["tune"], "tune")
    _check_figures(tune, study)
    _check_spread(tune, study)
    _check_machines(tune.scenarios, study)
    _check_feedback(tune, study)
    scenarios = tune.scenarios
    check_varied(data, study, (*tune.free, *scenarios.each, *scenarios.spread, *scenarios.machines))
    free = free_numbers(tune.free, study, _parts(tune, study))
    moves = _moves(tune, study)
    families = _families(tune, study, free)
    _check_clashes(tune, free, families)
    _check_switching(tune, study, families)
    _check_size(tune, families, len(moves))
    for family in families:
        for move in moves:
            _check_family(family, move, study)
    for machine in _each_machine(tune.scenarios):
        _check_family(families[0], moves[0] | machine, study)
    return TuneSpec(study=study, tune=tune, free=free, families=families, moves=moves, data=data)


def _check_figures(tune: Tune, study: Study) -> None:
    for name in tune.objective:
        _check_metric(name, "tune.objective", LOOP_TERMS, study)
    for name, limit in tune.limits.items():
        _check_metric(name, "tune.limits", LOOP_LIMITS, study)
        most = MOST.get(name, np.inf)
        if not isinstance(limit, str) and limit > most:
            allowed = f"a number > 0 and <= {most:g} or {BASELINE!r}"
            raise field_error(f"tune.limits.{shown_name(name)}", limit, allowed)
    for name, part in tune.limits.items():
        metric = _field(name)
        whole = tune.limits.get(metric, BASELINE)
        if isinstance(whole, str) or isinstance(part, str) or name == metric:
            continue
        if part > whole:
            raise StudyError(
                f"tune.limits: {name} = {part:g} allows more than {metric} = {whole:g}, "
                "which holds for all its entries; leave one out"
            )


def _check_spread(tune: Tune, study: Study) -> None:
    for name, percent in tune.scenarios.spread.items():
        path = f"tune.scenarios.spread.{shown_name(name)}"
        value = known_field(name, study, "tune.scenarios.spread")
        numbers = value if is_each_link(name) and isinstance(value, tuple) else (value,)
        if not all(isinstance(number, float) for number in numbers):
            raise field_error(path, percent, f"for a number; {name} is {shown(value)}")
        if not any(numbers):
            raise field_error(name, value, f"not 0 where {path} is a share of it")
        if name.partition(".")[0] in ("run", "metrics", "motion"):
            raise field_error(path, percent, "for the machine and its control; each takes others")
        for share in (1 - percent / 100, 1 + percent / 100):
            checked_value(study, name, (np.array(value) * share).tolist(), path)


def _check_machines(scenarios: Scenarios, study: Study) -> None:
    needed = scenarios.count - 1 + scenarios.check
    for name, values in scenarios.machines.items():
        path = f"tune.scenarios.machines.{shown_name(name)}"
        known_field(name, study, "tune.scenarios.machines")
        _check_program(name, path)
        if name.partition(".")[0] in ("run", "metrics", "motion"):
            raise StudyError(f"{path}: allowed: the machine and its control; each takes others")
        if len(values) < needed:
            raise StudyError(
                f"{path}: {len(values)} values; allowed: {needed} or more, for "
                f"tune.scenarios.count = {scenarios.count} without the nominal machine, and for "
                f"tune.scenarios.check = {scenarios.check}"
            )
        for k, value in enumerate(values):
            checked_value(study, name, value, f"{path}[{k}]")
    sizes = {name: len(values) for name, values in scenarios.machines.items()}
    if len(set(sizes.values())) > 1:
        lengths = ", ".join(f"{shown_name(name)} {size}" for name, size in sizes.items())
        raise StudyError(
            f"tune.scenarios.machines: lists of unequal length ({lengths}); allowed: one value for "
            "each machine"
        )


def _check_program(name: str, path: str) -> None:
    """Check that a field of scenarios does not choose the law or drive.

    Raises:
        StudyError: it does.
    """
    if name in ("control.law", "drive.kind"):
        raise StudyError(f"{path}: is the same in all scenarios; take tune.families for others")


def _each_machine(scenarios: Scenarios) -> list[dict[str, Any]]:
    """What differs on each machine that is run."""
    if not scenarios.machines:
        return []
    rows = zip(*scenarios.machines.values(), strict=True)
    whole = [dict(zip(scenarios.machines, row, strict=True)) for row in rows]
    return others(whole, scenarios.count, False) + others(whole, scenarios.check, True)


def others(values: Sequence[Any], count: int, is_fresh: bool) -> list[Any]:
    """Of what is given for each other machine, what `count` machines take.

    Args:
        values: one for each machine.
        count: machines that run, the study's own among them unless they are fresh.
        is_fresh: machines to check the result, not to tune.
    """
    return list(values[-count:] if is_fresh else values[: count - 1])


def _check_feedback(tune: Tune, study: Study) -> None:
    if study.control.ratio_source != "given":
        raise field_error("control.ratio_source", study.control.ratio_source, "'given' in a tuning")
    for path, names in (("tune.limits", tune.limits), ("tune.objective", tune.objective)):
        of_loop = [name for name in names if name in OF_LOOP]
        if study.control.feedback != "sampled" and of_loop:
            raise field_error(
                "control.feedback",
                study.control.feedback,
                f"'sampled' where {path} holds " + " or ".join(of_loop),
            )


def _check_switching(tune: Tune, study: Study, families: tuple[Family, ...]) -> None:
    """A law that switches between modes has a loop for each, which no term stands for."""
    terms = [name for name in tune.objective if name in LOOP_TERMS]
    for columns in ({}, *(family.columns for family in families)):
        law = parts_of(study, columns).law
        if terms and LAWS[law].is_switching:
            raise StudyError(
                f"tune.objective.{terms[0]}: control.law {law!r} switches between loops; allowed: "
                "laws with one linear loop, or a limit instead"
            )


def _check_metric(name: str, path: str, of_loop: tuple[str, ...], study: Study) -> None:
    """Check a metric, or a figure of the loop that is one of `of_loop`."""
    if name in of_loop:
        return
    is_objective = of_loop == LOOP_TERMS
    if _field(name) in of_loop:
        raise StudyError(f"{path}: {name!r} has no such entry; allowed: {_field(name)}")
    if is_objective and _field(name) in LOOP_LIMITS:
        raise StudyError(
            f"{path}: {name!r} can only be a limit"
            + (", it has no derivative; take disk_margin" if name == "gain_margin" else "")
        )
    allowed = [*METRICS, *of_loop]
    if _field(name) not in allowed:
        hint = nearest(name, allowed)
        raise StudyError(
            f"{path}: {name!r}: unknown metric; "
            + (f"did you mean {hint!r}?" if hint else f"allowed: {', '.join(allowed)}")
        )
    if is_objective and not METRICS[_field(name)].is_differentiable:
        raise StudyError(
            f"{path}: {_field(name)} moves in steps and has no derivative"
            + ("; take ringing_time" if _field(name) == "settling_time" else "; limit it instead")
        )
    parse_entries(name, path, entry_sizes(study))


def _moves(tune: Tune, study: Study) -> tuple[dict[str, Any], ...]:
    """Combinations of values with which every machine runs."""
    columns = {}
    for name, values in tune.scenarios.each.items():
        path = f"tune.scenarios.each.{shown_name(name)}"
        known_field(name, study, "tune.scenarios.each")
        _check_program(name, path)
        columns[name] = [checked_value(study, name, value, path) for value in values]
    return tuple(
        dict(zip(columns, combination, strict=True)) for combination in product(*columns.values())
    )


def _check_clashes(tune: Tune, free: FreeNumbers, families: tuple[Family, ...]) -> None:
    """Reject fields that are set twice."""
    scenarios = tune.scenarios
    parts: dict[str, Mapping[str, object]] = {
        "spread": scenarios.spread,
        "machines": scenarios.machines,
        "each": scenarios.each,
    }
    named = [(part, name) for part, names in parts.items() for name in names]
    for (one, name), (other, second) in combinations(named, 2):
        if overlaps(name, second):
            both = name if name == second else f"{name}, {second}"
            where = f"both in {one} and in {other}" if one != other else f"twice in {one}"
            raise StudyError(f"tune.scenarios: {both} is {where}")
    for family in families:
        numbers = zip(free.numbers, family.is_free, strict=True)
        moved = {_field(x) for number, is_free in numbers if is_free for x in writes(number)}
        for where, names in (
            *((f"tune.scenarios.{part}", names) for part, names in parts.items()),
            (f"tune.families.{shown_name(family.name)}.set", family.columns),
        ):
            for name in names:
                if _field(name) in moved:
                    raise StudyError(f"{where}: {name} is free in family {family.name!r}")
                if names is family.columns and any(name in x for x in parts.values()):
                    raise StudyError(f"{where}: {name} is in tune.scenarios too")


def _check_size(tune: Tune, families: tuple[Family, ...], moves: int) -> None:
    """Check that one batch fits into memory."""
    moving = sum(bool(family.is_free.any()) for family in families)
    for what, designs, machines in (
        (
            f"tune.starts = {tune.starts} of {moving} families, tune.scenarios.count",
            1 + tune.starts * moving,
            tune.scenarios.count,
        ),
        ("tune.scenarios.check", 1 + len(families), tune.scenarios.check),
    ):
        runs = designs * machines * moves
        if runs > MOST_RUNS:
            raise StudyError(
                f"{what} = {machines}, with {moves} moves: {runs} runs at once; allowed: up to "
                f"{MOST_RUNS}"
            )


def _field(name: str) -> str:
    return name.partition("[")[0]


def _families(tune: Tune, study: Study, free: FreeNumbers) -> tuple[Family, ...]:
    everything = np.array([parts_of(study).owns(x.key) for x in free.numbers])
    if not tune.families:
        families = [
            Family(name="tuned", is_free=everything, columns={}, limits=dict(tune.limits), front="")
        ]
    else:
        families = [_family(name, x, tune, study, free) for name, x in tune.families.items()]
    if not any(family.is_free.any() for family in families):
        raise field_error("tune.families", list(tune.families), "one or more with free parameters")
    families += _front(tune, families)
    names = [label(family.name) for family in families]
    for k, name in enumerate(names):
        if name in names[:k]:
            raise field_error(
                "tune.families",
                families[k].name,
                f"names that differ in letters and digits, {families[names.index(name)].name!r} is "
                "one already",
            )
    return tuple(sorted(families, key=lambda family: not family.is_free.any()))


def label(name: str) -> str:
    """A family's name as part of a file name, unique even if case is ignored."""
    return re.sub(r"[^a-z0-9.]+", "_", name.lower()).strip("_.")


def _family(
    name: str, written: FamilySection, tune: Tune, study: Study, free: FreeNumbers
) -> Family:
    path = f"tune.families.{shown_name(name)}"
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9 _.,+=()'-]{0,59}", name):
        raise field_error(
            "tune.families",
            name,
            "names of up to 60 letters a to z, digits, spaces and _.,+=()'-, not first a sign",
        )
    names = tuple(tune.free) if written.free is None else written.free
    for free_name in names:
        if free_name not in tune.free:
            hint = nearest(free_name, tune.free)
            raise StudyError(
                f"{path}.free: {free_name!r} is not in tune.free"
                + (f"; did you mean {hint!r}?" if hint else "")
            )
    columns, own = {}, study
    for field, value in written.set.items():
        known_field(field, own, f"{path}.set")
        columns[field] = checked_value(own, field, value, f"{path}.set.{shown_name(field)}")
        own = parse_study(set_value(own, field, columns[field]))
    is_free = np.array([number.key in names for number in free.numbers])
    parts = parts_of(study, columns)
    is_other = np.array([not parts.owns(number.key) for number in free.numbers])
    for number, is_asked, is_wrong in zip(free.numbers, is_free, is_other, strict=True):
        if written.free is not None and is_asked and is_wrong:
            raise StudyError(
                f"{path}.free: {number.key!r}: the family's control.law is {parts.law!r}, its "
                f"drive.kind {parts.drive!r}"
            )
    is_free = is_free & ~is_other
    return Family(name=name, is_free=is_free, columns=columns, limits=dict(tune.limits), front="")


def _parts(tune: Tune, study: Study) -> tuple[Parts, ...]:
    """Laws and drives that designs have, each combination once."""
    every = [parts_of(study), *(parts_of(study, x.set) for x in tune.families.values())]
    return tuple(dict.fromkeys(x for x in every if x.law in LAWS and x.drive in DRIVES))


def _front(tune: Tune, families: list[Family]) -> list[Family]:
    """A family for each point of the front."""
    if not tune.pareto:
        return []
    limit, values = tune.pareto.limit, tune.pareto.values
    metrics = [name for name in tune.limits if name not in LOOP_LIMITS]
    if limit not in metrics:
        allowed = "one of the metrics in tune.limits" + (
            f": {', '.join(metrics)}" if metrics else ""
        )
        raise field_error("tune.pareto.limit", limit, allowed)
    for k, value in enumerate(values):
        if value in values[:k]:
            raise field_error(f"tune.pareto.values[{k}]", value, "each limit once")
    moving = {family.name: family for family in families if family.is_free.any()}
    name = tune.pareto.family or next(iter(moving))
    if name not in moving:
        raise field_error("tune.pareto.family", name, "one of " + ", ".join(moving))
    base = moving[name]
    return [
        base._replace(
            name=f"{name}, {limit} {value:.10g}",
            limits={**base.limits, limit: float(value)},
            front=name,
        )
        for value in sorted(values)
    ]


def _check_family(family: Family, move: dict[str, Any], study: Study) -> None:
    """Check that a family's settings run, with the baseline's program."""
    where = [f"tune.families.{shown_name(family.name)}"] if family.columns else []
    where += [f"{name} = {shown(value)} of tune.scenarios" for name, value in move.items()]
    prefix = f"{', '.join(where)}: " if where else ""
    try:
        changed = family.study(study)
        for name, value in move.items():
            changed = parse_study(set_value(changed, name, value))
        check_run(changed)
    except StudyError as error:
        raise StudyError(f"{prefix}{error}") from None
    structure, changed_structure = build_structure(study), build_structure(changed)
    kept = {"law", "drive", "has_poles", "has_position_gain", "has_noise", "substeps"}
    for field, a, b in zip(structure._fields, structure, changed_structure, strict=True):
        if a != b and field not in kept:
            switch = f"use of {' or '.join(SWITCHES[field])}" if field in SWITCHES else field
            raise StudyError(
                f"{prefix}{switch} = {shown(b)} where the study has {shown(a)}; allowed: what runs "
                "by the same program (a small value in place of none)"
            )
