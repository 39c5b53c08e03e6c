"""What reading commands say of a sweep, as numbers in SI units under their names in its file.

Tables (`studies.sweeps.show`) and JSON documents (`studies.sweeps.documents`) are made of these.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from typing import Any

import numpy as np

from jaxmodel import status
from studies.engine.columns import NOT_RUN, ON_DEMAND, PER_CASE
from studies.engine.results import SweepData, metric_values, swept_names
from studies.results.labelled import Labelled, told
from studies.sweeps.environments import design_values

#: Names and values of one row.
Record = dict[str, Any]
MARGIN = "gain_margin"
#: Stand next to every metric of the cases that have them: what a design costs, and how safe it is.
BESIDE = ("peak_voltage", "damping_ratio[controlled_mode=1]", MARGIN, *ON_DEMAND)


def reason(code: int) -> str:
    """A status in words."""
    words = PER_CASE["status"][-1] | {NOT_RUN: "not run yet"}
    return str(words.get(code, f"status {code}"))


def case_records(data: SweepData, cases: np.ndarray, metrics: Iterable[str]) -> list[Record]:
    """Cases with what varies and some metrics.

    Args:
        data: the sweep.
        cases: their numbers.
        metrics: or entries of them.

    Returns:
        By case: its number, its whole id, each axis and each metric, see `design_values`.

    Raises:
        StudyError: unknown metric.
    """
    values = {name: design_values(data, name) for name in metrics}
    axes = {name: data[name] for name in swept_names(data)}
    return [
        {"case": int(k), "case_id": str(data["case_id"][k])}
        | {name: column[k] for name, column in (axes | values).items()}
        for k in cases
    ]


def with_others(data: SweepData, metrics: list[str]) -> list[str]:
    """Metrics, and what else to look at before acting on them."""
    return metrics + [name for name in BESIDE if name not in metrics and is_there(data, name)]


def is_there(data: SweepData, name: str) -> bool:
    """Whether a sweep has kept a metric, and some case has it."""
    kept = name.partition("[")[0] in data.variables
    return kept and bool(np.isfinite(metric_values(data, name)).any())


def watched(data: SweepData) -> np.ndarray:
    """Time from the end of the reference trajectory to that of the run of each case [s], (n,)."""
    return np.asarray(data.table.values("run.duration").astype(float) - data["command_end"])


def failed_cases(data: SweepData) -> np.ndarray:
    """Numbers of the cases that have run and are not ok."""
    codes = data["status"]
    return np.flatnonzero((codes != status.OK) & (codes >= 0))


def failed_records(data: SweepData, failed: np.ndarray) -> list[Record]:
    """Such cases: status, when it appeared [s], and what varies."""
    codes = data["status"]
    return [
        record
        | {
            "status": int(codes[record["case"]]),
            "status_text": reason(int(codes[record["case"]])),
            "bad_time": _bad_time(data, record["case"]),
        }
        for record in case_records(data, failed, ())
    ]


def _bad_time(data: SweepData, case: int) -> float | None:
    """When a status appeared [s], None for a case that finished."""
    is_whole = data["status"][case] in status.FINISHED
    return None if is_whole else float(data["bad_time"][case])


class StatusCount(Labelled):
    """How many cases have a status."""

    status: int = told("code, as in results.h5")
    status_text: str = told("the same in words")
    cases: int = told("how many cases")


def status_records(data: SweepData) -> list[StatusCount]:
    """Number of cases by status, most frequent first."""
    counts = Counter(data["status"].tolist()).most_common()
    return [StatusCount(code, reason(code), n) for code, n in counts]


def units(data: SweepData, names: Iterable[str]) -> dict[str, str]:
    """SI symbol of axes, metrics and entries of metrics, "1" for none."""
    found = (
        (name, data.variables.get(name) or data.variables.get(name.partition("[")[0]))
        for name in names
    )
    return {name: "1" if variable is None else variable.units for name, variable in found}
