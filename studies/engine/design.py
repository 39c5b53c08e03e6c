"""A DESIGN: a study file, a family of a tuning or a case of a sweep; each yields one study."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import status
from jaxmodel.lazy import jax
from jaxmodel.metrics import METRICS
from studies.engine.columns import ON_DEMAND, PER_CASE
from studies.engine.folder import MANIFEST, TUNING, read_manifest
from studies.engine.results import ROUNDING, SweepData, read_sweep
from studies.engine.robustness import judge_robustness
from studies.engine.run_data import metric_variables
from studies.engine.runs import Run
from studies.errors import DataWarning, StudyError, field_error, nearest
from studies.reading import read_text
from studies.space.spec import parse_sweep
from studies.space.table import build_table, case_study
from studies.study.files import SIGNATURE, find_spec
from studies.study.spec import Study, load_study

#: Largest relative differences of a case run alone in single precision, and of its loop, which
#: sweeps judge along frequencies and runs by eigenvalues [1].
SINGLE, OF_LOOPS = 1e-2, 2e-2
#: Of a loop: names of a sweep and of `LoopFigures`.
_OF_LOOP = dict.fromkeys(ON_DEMAND, "") | {
    "gain_margin": "gain_margin",
    "breaking_frequency": "breaking_frequency",
    "breaking_mode": "breaking_mode",
    "damping_ratio": "least_damping",
}
_OF_RUN = (
    "bad_time",
    "command_end",
    "sensor_condition",
    "actuator_condition",
    "singularity_distance",
)


class Design(NamedTuple):
    """One study and, for a case of a sweep, what the sweep found."""

    study: Study
    stored: dict[str, np.ndarray]  # all that the sweep has kept; {} if there is none
    case_id: str = ""  # of the case in its sweep


def as_design(given: Design | Study | str | Path, case: int | str | None = None) -> Design:
    """A design from what stands for it: a study, or what `load_design` reads; case: as there.

    Raises:
        StudyError: something else, or as `load_design`.
    """
    if isinstance(given, str | Path):
        return load_design(given, case)
    if case is not None:
        raise StudyError(f"--case {case}: for folders only; leave it out")
    if not isinstance(given, Design | Study):
        raise StudyError(
            f"{type(given).__name__}; expected a study, its file, or a folder of results"
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
        file = _tuned_file(path, case)
        study = load_study(file)  # warns of one that has been edited below its first line
        if not read_text(file).startswith(SIGNATURE):
            text = f"{file}: without the tuning's signature: edited, or of an older version"
            warnings.warn(text, DataWarning, stacklevel=2)
        return Design(study, {})
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
    names = [name for name in (*PER_CASE, *METRICS) if name in data.variables]
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


def deviations(run: Run, stored: dict[str, np.ndarray]) -> dict[str, tuple[float, float]]:
    """Differences between what a run has found and what a sweep has kept of the same case.

    Args:
        run: the run; its loop is compared if it was judged.
        stored: by name, NaN where there is nothing to compare with, such as a missing mode.

    Returns:
        By name: difference relative to the largest entry [1], and how large that may be.
    """
    found = {}
    for name, value in _numbers(run, stored).items():
        if name not in stored or value is None:
            continue
        own, reference = map(np.atleast_1d, (value, stored[name]))
        is_single = np.float32 in (own.dtype, reference.dtype)
        allowed = OF_LOOPS if name in _OF_LOOP else SINGLE if is_single else ROUNDING
        part = reference[tuple(slice(0, n) for n in own.shape)].astype(float)
        own = own[tuple(slice(0, n) for n in part.shape)]
        found[name] = _difference(own[~np.isnan(part)], part[~np.isnan(part)]), allowed
    return found


def _difference(own: np.ndarray, reference: np.ndarray) -> float:
    differs = own != reference
    if not differs.any():
        return 0.0
    if not np.isfinite((own[differs], reference[differs])).all():
        return float("inf")
    size = max(np.abs(x[np.isfinite(x)]).max() for x in (own, reference))
    return float(np.abs(own[differs] - reference[differs]).max() / size)


def _numbers(run: Run, names: Iterable[str]) -> dict[str, Any]:
    """What a sweep can keep of a run, but its status; names: that it has kept."""
    found = {name: variable.data for name, variable in metric_variables(run.result).items()}
    found |= {name: getattr(run.result, name) for name in _OF_RUN} | {
        "substeps": np.array(run.structure.substeps)
    }
    if run.loop is None:
        return found
    found |= {name: getattr(run.loop, field) for name, field in _OF_LOOP.items() if field}
    wanted = tuple(name for name in names if name in ON_DEMAND)
    one = jax.tree.map(lambda x: np.asarray(x)[None], run.case)
    margin = np.array([run.loop.gain_margin])
    more = judge_robustness(run.structure, one, wanted, margin)
    return found | {name: value[0] for name, value in more.items()}
