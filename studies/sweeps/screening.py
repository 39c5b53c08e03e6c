"""How well a sweep's screen ranked: the linear model against the full one, on random cases."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from jaxmodel import status
from studies.engine.columns import NOT_RUN
from studies.engine.fidelity import rank_correlation
from studies.engine.results import SweepData, direction, meets, metric_values
from studies.engine.screen import audited, in_order
from studies.show import figures
from studies.show.units import readable
from studies.sweeps.show import label, shown_metric, unit_of_metric

#: The best cases, which the screen should not lose: this share of the random ones.
GOOD = 0.01


class ScreenCheck(NamedTuple):
    """What a screen kept and what it lost."""

    by: str
    condition: str  # what cases had to meet, "" for nothing
    n_cases: int  # of the sweep
    n_aside: int  # those that did not end with status ok in the linear model
    n_passed: int  # best ones of the linear model, all of them run
    n_audited: int  # random ones that ran
    n_random: int  # those of them with status ok that meet the condition
    difference: float  # median of the linear model's relative error on them [1]
    correlation: float  # Spearman's, of both models' values among them [1]
    n_good: int  # the best random cases by the full model
    n_found: int  # those among them that passed
    is_met: bool  # by any case

    @property
    def text(self) -> str:
        """In a few sentences."""
        aside = f" and set {self.n_aside} aside that do not end well in it" if self.n_aside else ""
        until = f", until enough met {self.condition}" if self.condition else ""
        said = (
            f"The linear model ran all {self.n_cases} cases{aside}. The full model ran the "
            f"{self.n_passed} best of the others by {self.by}{until}, and {self.n_audited} random "
            "ones. "
        )
        met = f" that meet {self.condition}" if self.condition else ""
        if self.condition and not self.is_met:
            said += f"None of them meets {self.condition}, so nothing can be said of what it lost."
        elif np.isnan(self.correlation):
            said += f"Too few random cases{met} differ to say how well the screen ranks."
        else:
            said += (
                f"On {self.n_random} random cases{met} the linear model is off by "
                f"{100 * self.difference:.2g} % in the median, its rank correlation with the full "
                f"model is {self.correlation:.2f}, and {self.n_found} of the best {self.n_good} by "
                "the full model passed the screen."
            )
        if not self.condition:
            said += (
                " The screen did not look at stability; `subject_to` in its table can ask for it."
            )
        return said


def check_screen(data: SweepData) -> ScreenCheck | None:
    """Compare both models on random cases; None without a screen, or if nothing passed it."""
    screen = data.spec.screen
    if screen is None or not {"screen_value", screen.metric} <= set(data.variables):
        return None
    order = _order(data)
    passed = order[: _n_passed(data, order)]
    random = _random(data, order)
    is_met = meets(data, screen.subject_to, "sweep.screen.subject_to")
    is_met &= data["status"] == status.OK
    value = metric_values(data, screen.entry)
    rows = random[is_met[random] & np.isfinite(value[random])]
    value = value[rows]
    sign = -1 if direction(screen.by) == "largest" else 1
    n_good = min(len(rows), max(1, round(min(GOOD, screen.keep) * len(rows))))
    good = rows[np.argsort(sign * value, kind="stable")][:n_good]
    linear = data["screen_value"][rows]
    error = np.abs(linear - value) / np.maximum(np.abs(value), 1e-300)
    return ScreenCheck(
        by=screen.entry,
        condition=screen.subject_to,
        n_cases=data.n_cases,
        n_aside=int(np.sum(data["screen_status"] != NOT_RUN)) - len(order),
        n_passed=len(passed),
        n_audited=len(random),
        n_random=len(rows),
        difference=float(np.median(error)) if len(rows) else float("nan"),
        correlation=_rank_correlation(linear, value),
        n_good=n_good,
        n_found=int(np.isin(good, passed).sum()),
        is_met=bool(is_met.any()),
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
    """The random cases that the full model ran."""
    rows = audited(data.n_cases, order, data.spec)
    return rows[data["status"][rows] >= 0]


def _rank_correlation(a: np.ndarray, b: np.ndarray) -> float:
    """NaN for fewer than three different values."""
    if min(len(np.unique(x)) for x in (a, b)) < 3:
        return float("nan")
    return rank_correlation(a, b)


def draw_screen(data: SweepData) -> Figure:
    """The full model over the linear one that screened the cases."""
    assert data.spec.screen is not None
    by = data.spec.screen.entry
    order, value = _order(data), shown_metric(data, by)
    factor = readable(unit_of_metric(data, by))[0]
    linear = factor * data["screen_value"]
    is_fine = (data["status"] == status.OK) & np.isfinite(value) & np.isfinite(linear)
    passed = order[: _n_passed(data, order)]
    groups = [(_random(data, order), "random cases", "C1"), (passed, "passed the screen", "C0")]
    with figures.styled():
        figure, axes = figures.one_panel(4.2)
        for rows, name, colour in groups:
            rows = rows[is_fine[rows]]
            axes.plot(linear[rows], value[rows], ".", ms=3, color=colour, label=name)
        ends = [np.nanmin(linear[is_fine]), np.nanmax(linear[is_fine])]
        axes.plot(ends, ends, color="0.6", lw=0.8, label="equal", zorder=0)
        if min(ends[0], value[is_fine].min()) > 0:
            axes.set(xscale="log", yscale="log")
        axes.set(xlabel=f"linear model: {label(data, by)}", ylabel=f"full model: {label(data, by)}")
        figures.legend_beside(axes)
    return figure
