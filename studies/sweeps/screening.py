"""How well a sweep's screen ranked: the linear model against the full one, on random cases."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from studies.engine.results import SweepData, direction, meets, metric_values
from studies.engine.screen import audited, in_order
from studies.errors import StudyError
from studies.show.figures import styled
from studies.show.units import readable
from studies.sweeps.show import label, shown_metric, unit_of_metric

#: The best cases, which the screen should not lose: this share of the random ones.
GOOD = 0.01


class ScreenCheck(NamedTuple):
    """What a screen kept and what it lost."""

    by: str
    n_cases: int  # of the sweep
    n_passed: int  # best ones of the linear model, all of them run
    n_random: int  # random cases with a value of both models
    correlation: float  # Spearman's, of both models' values among them [1]
    n_good: int  # the best random cases by the full model
    n_found: int  # those among them that passed

    @property
    def text(self) -> str:
        """In two sentences."""
        return (
            f"The screen ran {self.n_passed} of {self.n_cases} cases, the best by the linear "
            f"model's {self.by}. On {self.n_random} random cases the rank correlation with the "
            f"full model is {self.correlation:.2f}, and {self.n_found} of the {self.n_good} best "
            "of them by the full model passed the screen."
        )


def check_screen(data: SweepData) -> ScreenCheck | None:
    """Compare both models on random cases; None without a screen, or if nothing passed it."""
    screen = data.spec.screen
    if screen is None or not {"screen_value", screen.metric} <= set(data.variables):
        return None
    order = _order(data)
    passed = order[: _n_passed(data, order)]
    rows = _random(data, order)
    is_fine = meets(data, screen.subject_to, "sweep.screen.subject_to")[rows]
    rows = rows[is_fine & (data["status"][rows] == status.OK)]
    value = metric_values(data, screen.entry)[rows]
    sign = -1 if direction(screen.by) == "largest" else 1
    n_good = min(len(rows), max(1, round(min(GOOD, screen.keep) * len(rows))))
    good = rows[np.argsort(sign * value, kind="stable")][:n_good]
    return ScreenCheck(
        by=screen.entry,
        n_cases=data.n_cases,
        n_passed=len(passed),
        n_random=len(rows),
        correlation=_rank_correlation(data["screen_value"][rows], value),
        n_good=n_good,
        n_found=int(np.isin(good, passed).sum()),
    )


def _order(data: SweepData) -> np.ndarray:
    screen = data.spec.screen
    assert screen is not None
    return in_order(
        data["screen_status"], data["screen_value"], np.array(data["case_id"], "S16"), screen
    )


def _n_passed(data: SweepData, order: np.ndarray) -> int:
    """How far down the order every case was run."""
    is_left = data["status"][order] < 0
    return int(np.argmax(is_left)) if is_left.any() else len(order)


def _random(data: SweepData, order: np.ndarray) -> np.ndarray:
    """The random cases that have a value of the full model."""
    assert data.spec.screen is not None
    rows = audited(data.n_cases, order, data.spec)
    value = metric_values(data, data.spec.screen.entry)
    return rows[np.isfinite(value[rows])]


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """Spearman's; NaN for fewer than three pairs."""
    if len(a) < 3:
        return float("nan")
    ranks = [np.argsort(np.argsort(x, kind="stable")) for x in (a, b)]
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def draw_screen(data: SweepData) -> Figure:
    """The full model's values over the linear one's.

    Raises:
        StudyError: no screen, or no case to draw.
    """
    screen = data.spec.screen
    if screen is None or "screen_value" not in data.variables:
        raise StudyError("sweep.screen: none in this sweep")
    by = screen.entry
    order, value = _order(data), shown_metric(data, by)
    factor = readable(unit_of_metric(data, by))[0]
    linear = factor * data["screen_value"]
    is_fine = (data["status"] == status.OK) & np.isfinite(value) & np.isfinite(linear)
    passed = order[: _n_passed(data, order)]
    groups = [(_random(data, order), "random cases", "C1"), (passed, "passed the screen", "C0")]
    if not is_fine.any():
        raise StudyError("no case of status ok to draw")
    with styled():
        figure = Figure(figsize=(5.2, 4.2))
        axes = figure.subplots()
        for rows, name, colour in groups:
            rows = rows[is_fine[rows]]
            axes.plot(linear[rows], value[rows], ".", ms=3, color=colour, label=name)
        ends = [np.nanmin(linear[is_fine]), np.nanmax(linear[is_fine])]
        axes.plot(ends, ends, color="0.6", lw=0.8, label="equal", zorder=0)
        if min(ends[0], value[is_fine].min()) > 0:
            axes.set(xscale="log", yscale="log")
        axes.set(xlabel=f"linear model: {label(data, by)}", ylabel=f"full model: {label(data, by)}")
        axes.legend()
    return figure
