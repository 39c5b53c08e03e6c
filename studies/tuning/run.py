"""A tuning in its folder: `tune.json` (what was asked for), `progress.npz` (where it stands),
`tune.h5` (every start), `tuned.toml` (the study with the best numbers), `report.md`.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from studies import config
from studies.errors import StudyError
from studies.runs import run_attributes
from studies.store import Variable, check_target, replacing, write_store
from studies.sweeps.folder import make_manifest
from studies.template import study_template
from studies.tuning.audit import audit
from studies.tuning.check import judge, tuned_study
from studies.tuning.evaluate import Evaluator
from studies.tuning.optimise import Progress, optimise
from studies.tuning.report import report
from studies.tuning.spec import TuneSpec

MANIFEST, PROGRESS, RESULTS = "tune.json", "progress.npz", "tune.h5"
TUNED, REPORT = "tuned.toml", "report.md"


def run_tuning(
    spec: TuneSpec, out: Path, is_resumed: bool, console: Console, is_quiet: bool = False
) -> Progress:
    """Tune, check the result on fresh scenarios, and write it.

    Args:
        spec: what is free and what for.
        out: folder.
        is_resumed: go on with the tuning that is there.
        console: where progress goes.
        is_quiet: no progress.

    Returns:
        Where the tuning ended.

    Raises:
        StudyError: the folder holds something else or cannot be written to; a fault of the study.
    """
    config.require_configured()
    manifest = make_manifest(spec.data, sorted(Path(__file__).parent.glob("*.py")))
    before = _open(out, manifest, is_resumed)
    evaluator = Evaluator(spec, spec.tune.starts)

    def say(text: str) -> None:
        if not is_quiet:
            console.print(text, soft_wrap=True)

    def keep(at: Progress) -> None:
        save_progress(out / PROGRESS, at)
        k = at.winner
        lost = f", {at.is_frozen.sum()} starts frozen" if at.is_frozen.any() else ""
        worst = at.best_limits[k].max(initial=-np.inf)
        kept = "limits kept" if worst <= 0 else f"worst limit {100 * worst:+.2f} %"
        say(
            f"{int(at.iteration)}/{spec.tune.iterations} best objective "
            f"{at.best_objective[k]:.5g}, {kept}{lost}"
        )

    at = optimise(spec, evaluator, before, keep)
    if not np.isfinite(at.best_objective).any():
        raise StudyError(
            "tune.starts: no start finished a run; the study itself should be one that does "
            "(try studies simulate)"
        )
    say("comparing derivatives with differences, running the result on fresh scenarios")
    values = spec.free.values(at.best_place[at.winner])
    study = tuned_study(spec, values)
    judged = judge(spec, [spec.study, study])
    worst = audit(spec, at.best_place[at.winner][None])
    with replacing(out / TUNED) as temporary:
        temporary.write_text(study_template(study), encoding="utf-8")
    write_store(out / RESULTS, _variables(spec, evaluator, at), run_attributes(study))
    with replacing(out / REPORT) as temporary:
        text = report(spec, evaluator.limit_names, at, judged, worst)
        temporary.write_text(text, encoding="utf-8")
    return at


def _open(out: Path, manifest: dict[str, Any], is_resumed: bool) -> Progress | None:
    """Make or check the folder; where an interrupted tuning stands."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(f"--out {out}: cannot make this folder ({error.strerror})") from None
    check_target(out / RESULTS)
    path = out / MANIFEST
    if path.is_file():
        if not is_resumed:
            raise StudyError(f"--out {out}: holds a tuning already; go on with --resume")
        try:
            old = json.loads(path.read_text(encoding="utf-8"))
        except ValueError:
            raise StudyError(f"{path}: damaged") from None
        for key, what in (("spec", "tuning file"), ("code", "program")):
            if not isinstance(old, dict) or old.get(key) != json.loads(json.dumps(manifest[key])):
                raise StudyError(f"--out {out}: was begun with another {what}; name a new folder")
        return load_progress(out / PROGRESS)
    if is_resumed:
        raise StudyError(f"--out {out}: no tuning to resume there")
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
    return None


def save_progress(path: Path, at: Progress) -> None:
    """Write where a tuning stands, whole or not at all."""
    arrays = {f"adam_{k}": leaf for k, leaf in enumerate(at.adam)}
    arrays |= {name: getattr(at, name) for name in at._fields if name != "adam"}
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_progress(path: Path) -> Progress | None:
    """Where a tuning stood; None where nothing is kept.

    Raises:
        StudyError: damaged.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path) as data:
            count = sum(name.startswith("adam_") for name in data.files)
            adam = tuple(data[f"adam_{k}"] for k in range(count))
            return Progress(**{n: data[n] for n in Progress._fields if n != "adam"}, adam=adam)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise StudyError(f"{path}: damaged; name a new folder") from None


def _variables(spec: TuneSpec, evaluator: Evaluator, at: Progress) -> dict[str, Variable]:
    limits = evaluator.limit_names
    return {
        "free": Variable(np.array(spec.free.names), ("free",), "1", "free number"),
        "value": Variable(
            spec.free.values(at.best_place), ("start", "free"), "1", "best value of each start, in "
            "the unit of its field",
        ),
        "objective": Variable(at.best_objective, ("start",), "1", "best objective of each start"),
        "is_frozen": Variable(at.is_frozen, ("start",), "1", "stopped, a run did not finish"),
        "history": Variable(
            at.history, ("iteration", "start", "figure"), "1",
            "objective, then largest value over limit - 1, at each iteration",
        ),
        **({
            "limit": Variable(np.array(limits), ("limit",), "1", "limit"),
            "excess": Variable(
                at.best_limits, ("start", "limit"), "1", "value over limit - 1, negative: kept"
            ),
        } if limits else {}),
    }  # fmt: skip
