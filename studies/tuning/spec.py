"""The file of a tuning: a study plus `[tune]`, which says what is free and what it is for.

The objective is the weighted sum of metrics, each as the root of the mean square of its entries
(links, stations; an entry like `pose_error_rms[2]` is that one alone), averaged over the scenarios.
A limit holds for the largest entry of its metric in the worst scenario; `gain_margin` and
`slowest_decay` are lower limits of the linearised sampled loop at the first way-point.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError

from studies.errors import StudyError, field_error, nearest, shown
from studies.explain import explain
from studies.fields import parse_entry
from studies.spec import Section, Study, described, parse_study, read_toml
from studies.sweeps.axes import known_field
from studies.sweeps.results import metric_names
from studies.tuning.free import FreeNumbers, free_numbers

#: Limits of the linearised loop, which are lower ones: factor on all gains [1], decay rate [1/s].
LOOP_LIMITS = ("gain_margin", "slowest_decay")


class Scenarios(Section):
    """Machines that one design must suit."""

    count: int = described(1, "1", "scenarios; the first is the study itself", ge=1, le=1000)
    check: int = described(16, "1", "fresh ones, for the result", ge=1, le=10_000)
    seed: int = described(0, "1", "of the scenarios", ge=0, le=10**9)
    spread: dict[str, Any] = described({}, "-", "field = +-percent of its value")


class Tune(Section):
    """What is free, and what for."""

    free: dict[str, Any] = described({}, "-", "field = {from, to, scale}")
    objective: dict[str, Any] = described(
        {"residual_rms": 1.0}, "-", "metric = weight, in one over the metric's unit", min_length=1
    )
    limits: dict[str, Any] = described({}, "-", "metric, gain_margin or slowest_decay = limit")
    scenarios: Scenarios = Scenarios()
    starts: int = described(8, "1", "designs to begin with, the study's own first", ge=1, le=1024)
    iterations: int = described(60, "1", "steps of each start", ge=1, le=10_000)
    seed: int = described(0, "1", "of the starts", ge=0, le=10**9)


class TuneSpec(NamedTuple):
    """A tuning as asked for."""

    study: Study  # the design to begin with
    tune: Tune
    free: FreeNumbers
    data: dict[str, Any]  # as read, for the record


def load_tuning(path: str | Path) -> TuneSpec:
    """Read a tuning file.

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
    study = parse_study({name: value for name, value in data.items() if name != "tune"})
    try:
        tune = Tune.model_validate(data["tune"])
    except ValidationError as error:
        raise explain(error, Tune, data["tune"], inside="tune") from None
    for section, numbers in (("objective", tune.objective), ("limits", tune.limits)):
        for name, number in numbers.items():
            _check_metric(name, f"tune.{section}", section == "limits")
            _check_positive(number, 1e30, f"tune.{section}.{name}")
    for name, percent in tune.scenarios.spread.items():
        path = f"tune.scenarios.spread.{name}"
        value = known_field(name, study, "tune.scenarios.spread")
        if isinstance(value, bool) or not isinstance(value, float):
            raise field_error(path, percent, f"for a number; {name} is {shown(value)}")
        _check_positive(percent, 99.0, path, "%")
    if study.control.ratio_source != "given":
        raise field_error(
            "control.ratio_source", study.control.ratio_source, "'given' in a tuning", ""
        )
    if study.control.feedback != "sampled" and set(tune.limits) & set(LOOP_LIMITS):
        raise field_error(
            "control.feedback", study.control.feedback,
            "'sampled' where tune.limits holds " + " or ".join(LOOP_LIMITS),
        )  # fmt: skip
    return TuneSpec(study, tune, free_numbers(tune.free, study), data)


def _check_positive(number: Any, most: float, path: str, unit: str = "") -> None:
    is_number = isinstance(number, (int, float)) and not isinstance(number, bool)
    if not is_number or not 0 < number <= most:
        raise field_error(path, number, f"a number > 0 and <= {most:g}", unit)


def _check_metric(name: str, path: str, has_loop: bool) -> None:
    entry = parse_entry(name)
    known = [*metric_names(), *(LOOP_LIMITS if has_loop else ())]
    if entry is None or entry.field not in known:
        hint = nearest(name, known)
        raise StudyError(
            f"{path}: {name!r} is no metric" + (f"; did you mean {hint!r}?" if hint else "")
        )
