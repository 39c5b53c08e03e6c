"""A DESIGN: a study file, a family of a tuning or a case of a sweep; each yields one study."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.metrics import METRICS
from studies.engine.folder import MANIFEST, TUNING, read_manifest
from studies.engine.results import SweepData, read_sweep
from studies.engine.run_data import metric_variables
from studies.engine.runs import Run
from studies.errors import StudyError, field_error, nearest
from studies.space.spec import parse_sweep
from studies.space.table import build_table, case_study
from studies.study.files import find_spec
from studies.study.spec import Study, load_study


class Design(NamedTuple):
    """One study and, for a case of a sweep, what the sweep found."""

    study: Study
    stored: dict[str, np.ndarray]  # metrics and status of the sweep; {} if there is none
    case_id: str = ""  # of the case in its sweep


def as_design(given: Design | Study | str | Path) -> Design:
    """A design from what stands for it: a study, or what `load_design` reads.

    Raises:
        StudyError: something else, or as `load_design`.
    """
    if isinstance(given, str | Path):
        return load_design(given)
    if not isinstance(given, Design | Study):
        raise StudyError(
            f"design: {type(given).__name__}; expected a design, as load_design returns, a study "
            "or its file"
        )
    return Design(given, {}) if isinstance(given, Study) else given


def load_design(path: str | Path, case: int | str | None = None) -> Design:
    """Read a DESIGN.

    Args:
        path: study file, name of a ready-made one, folder of a tuning or of a sweep.
        case: for a sweep, the number of the case, or "id:" and the first digits of its id; for a
            tuning, the family, as in the names of its files.

    Raises:
        StudyError: not found, case missing or not allowed, or a case that does not stand alone.
    """
    path = Path(path)
    is_folder = path.is_dir()
    if is_folder and not any((path / name).is_file() for name in (MANIFEST, TUNING)):
        is_folder = find_spec(path) == path  # "paper" can also be the report's folder
    if not is_folder:
        path = find_spec(path)
        if case is not None:
            raise StudyError(f"--case {case}: {path} is a file; leave --case out")
        return Design(load_study(path), {})
    if (path / TUNING).is_file():
        return Design(load_study(_tuned_file(path, case)), {})
    data = read_sweep(path)
    number = _case_number(data, None if case is None else str(case), path)
    spec = parse_sweep(read_manifest(path)["spec"])
    table = build_table(spec)
    code = int(data["status"][number])
    try:
        study = case_study(table, number)
    except StudyError as error:
        raise StudyError(
            f"--case {case}: {status.REASONS.get(code, 'not run')}; it cannot run alone ({error})"
        ) from None
    steps = int(data["substeps"][number]) if "substeps" in data.variables else -1
    if steps > 0:
        study = study.change(run__substeps=steps)
    case_id = str(data["case_id"][number])
    if code < 0 or spec.sweep.fidelity == "linear":  # nothing that the full model would repeat
        return Design(study, {}, case_id)
    names = ["status", *(name for name in METRICS if name in data.variables)]
    return Design(study, {name: data[name][number] for name in names}, case_id)


def _tuned_file(path: Path, case: str | int | None) -> Path:
    """File of the requested tuned study."""
    files = {file.stem.removeprefix("tuned").lstrip("_"): file for file in path.glob("tuned*.toml")}
    if not files:
        raise StudyError(f"{path}: the tuning is not finished; continue with studies tune --resume")
    if case is None and len(files) == 1:
        return next(iter(files.values()))
    allowed = f"{', '.join(sorted(filter(None, files)))}, the families of {path}"
    if case is None:
        raise StudyError(f"--case is missing; allowed: {allowed}")
    if str(case) not in files:
        raise field_error("--case", case, allowed, hint=nearest(str(case), files))
    return files[str(case)]


def _case_number(data: SweepData, case: str | None, path: Path) -> int:
    """Number of the requested case."""
    allowed = (
        f"allowed: 0 to {data.n_cases - 1}, the cases of {path}, or id: and the first digits of a "
        "case's id"
    )
    if case is None:
        raise StudyError(f"--case is missing: {allowed}")
    if case.startswith("id:"):
        ids = data["case_id"].astype(str)
        matches = np.flatnonzero(np.char.startswith(ids, case.removeprefix("id:").lower()))
        if len(matches) != 1:
            raise StudyError(f"--case {case}: fits {len(matches)} cases of {path}; allowed: one")
        return int(matches[0])
    is_number = case.isascii() and case.isdigit() and len(case) < 20
    if not is_number or int(case) >= data.n_cases:
        raise StudyError(f"--case {case}: {allowed}")
    return int(case)


def deviation(run: Run, stored: dict[str, np.ndarray]) -> tuple[float, str]:
    """Largest difference between a run's metrics and stored ones, relative to each metric's size.

    Args:
        run: the run.
        stored: metrics of the same case; NaN where a mode does not exist.

    Returns:
        (difference [1], name of the metric); (0, "") if there is nothing to compare.
    """
    metrics = {name: variable.data for name, variable in metric_variables(run.result).items()}
    worst = (0.0, "")
    for name, reference in stored.items():
        if name == "status":
            continue
        own = np.asarray(metrics[name])
        part = np.asarray(reference)[tuple(slice(0, n) for n in own.shape)]
        size = np.nanmax(np.abs(part), initial=0.0)
        difference = np.nanmax(np.abs(own - part), initial=0.0) / size if size > 0 else 0.0
        worst = max(worst, (float(difference), name))
    return worst
