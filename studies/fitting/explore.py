"""A fit as a page to look at, see `studies.explorer`: the machines that the data leave possible."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from studies.engine.folder import FIT
from studies.errors import StudyError
from studies.explorer.table import Column, ExplorerTable, text_column
from studies.reading import parse_json
from studies.results.labelled import Variable
from studies.show.figures import is_wide
from studies.show.words import machine_text
from studies.store import read_store
from studies.study.spec import parse_study

OPTIMUM, MACHINE = "optimum", "possible machine"
#: How far a machine is from the best fit, in standard deviations along the correlated parameters.
DISTANCE = "distance"


def explore_fit(folder: Path, on_progress: Callable[[int, int], None]) -> ExplorerTable:
    """Optima of a fit, and the machines drawn from what its data leave possible.

    Args:
        folder: of a finished fit.
        on_progress: not called, nothing takes long.

    Raises:
        StudyError: a file that is damaged.
    """
    data, attributes = read_store(folder / FIT)
    try:
        optima, machines = data["optimum"].data, data["machine"].data
        values = np.concatenate([optima, machines])
        kinds = np.array([OPTIMUM] * len(optima) + [MACHINE] * len(machines))
        away = _distances(values - data["value"].data, data)
        rise = np.concatenate([data["optimum_rise"].data, np.full(len(machines), np.nan)])
        names = [str(name) for name in data["number"].data]
        study = parse_study(parse_json(attributes["study"]))
        parameters = [
            Column(name, "", values[:, k], is_parameter=True, is_log=is_wide(values[:, k]))
            for k, name in enumerate(names)
        ]
        return ExplorerTable(
            title=study.title,
            noun="machine",
            columns=(
                text_column("kind", kinds, is_parameter=True),
                *parameters,
                Column(DISTANCE, "", away, better="smallest"),
                Column("rise of chi square", "", rise, better="smallest"),
            ),
            status=np.zeros(len(values), int),
            reasons={0: "ok"},
            names=tuple(str(k + 1) for k in range(len(values))),
            rank=DISTANCE,
            about={"fitted": ", ".join(names), "machine": machine_text(study)},
        ).checked()
    except (LookupError, ValueError, TypeError, AttributeError) as error:
        raise StudyError(f"{folder / FIT}: damaged ({error})") from None


def _distances(gaps: np.ndarray, data: Mapping[str, Variable]) -> np.ndarray:
    """Mahalanobis distances by the fit's standard deviations and correlation, (n,)."""
    sigma, correlation = data["sigma"].data, data["correlation"].data
    scaled = gaps / np.where(sigma > 0, sigma, np.inf)
    return np.sqrt(np.maximum(np.sum(scaled * (scaled @ np.linalg.pinv(correlation)), axis=1), 0))
