"""A tuning in its folder: `tune.json` (what was asked for), `progress.npz` (where it stands),
`tune.h5` (every start), `tuned.toml` (the study with the best numbers, one file for each family),
`report.md` and its figures.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from studies import config
from studies.errors import StudyError
from studies.figures import save
from studies.runs import run_attributes
from studies.store import Variable, check_target, replacing, write_store
from studies.sweeps.folder import locked_folder, make_manifest
from studies.sweeps.results import metric_label, variable_name
from studies.template import study_template
from studies.tuning import plots
from studies.tuning.audit import audit
from studies.tuning.check import judge, search, tuned_study
from studies.tuning.evaluate import Evaluator
from studies.tuning.optimise import Progress, excess, optimise, start_families
from studies.tuning.report import Findings, report, unkept
from studies.tuning.spec import TuneSpec

MANIFEST, PROGRESS, RESULTS = "tune.json", "progress.npz", "tune.h5"
TUNED, REPORT = "tuned.toml", "report.md"


def make_evaluator(spec: TuneSpec) -> Evaluator:
    """Evaluator of all starts."""
    return Evaluator(spec, [spec.moving[k] for k in start_families(spec)])


def run_tuning(
    spec: TuneSpec, out: Path, is_resumed: bool, console: Console, is_quiet: bool = False
) -> Findings:
    """Tune, check the result on fresh scenarios, and write it.

    Args:
        spec: what is free and what for.
        out: folder.
        is_resumed: go on with the tuning that is there.
        console: where progress goes.
        is_quiet: no progress.

    Returns:
        What was found.

    Raises:
        StudyError: the folder holds something else or cannot be written to; a fault of the study;
            limits that contradict one another (everything is written all the same).
    """
    config.require_configured()
    manifest = make_manifest(spec.data, sorted(Path(__file__).parent.glob("*.py")))

    def say(text: str) -> None:
        if not is_quiet:
            console.print(text, soft_wrap=True)

    with open_tuning(out, manifest, is_resumed) as before:
        evaluator = make_evaluator(spec)

        def keep(at: Progress) -> None:
            save_progress(out / PROGRESS, at)
            say(_told(spec, at))

        at = optimise(spec, evaluator, before, keep)
        lost = [f.name for k, f in enumerate(spec.moving) if not _has_finished(at, k)]
        if lost:
            raise StudyError(
                f"tune.starts: no start of {', '.join(lost)} finished a run; the study with what "
                "the family sets should be one that does (try studies simulate)"
            )
        say("comparing derivatives with differences, running the results on fresh machines")
        found = find(spec, evaluator, at)
        _write(spec, found, out)
    faults = unkept(spec, at)
    if faults:
        raise StudyError("tune.limits: not kept together; " + "; ".join(faults))
    return found


def _has_finished(at: Progress, family: int) -> bool:
    return bool(np.isfinite(at.best_objective[at.family == family]).any())


def _told(spec: TuneSpec, at: Progress) -> str:
    parts = []
    for k, family in enumerate(spec.moving):
        best = at.winner(k)
        if not np.isfinite(at.best_objective[best]):
            parts.append(f"{family.name} -")
            continue
        beyond = excess(at.best_limits[[best]])[0]
        mark = f" (limit {100 * beyond:+.1f} %)" if beyond > 0 else ""
        parts.append(f"{family.name} {at.best_objective[best]:.4f}{mark}")
    lost = f"; {at.is_frozen.sum()} starts frozen" if at.is_frozen.any() else ""
    return f"{int(at.iteration)}/{spec.tune.iterations} best: {', '.join(parts)}{lost}"


def find(spec: TuneSpec, evaluator: Evaluator, at: Progress) -> Findings:
    """Judge where a tuning ended."""
    values = spec.free.values(at.best_place)
    winners = [at.winner(k) for k in range(len(spec.moving))]
    designs = [spec.study] + [
        tuned_study(spec, family, values[winners[k]] if k < len(winners) else values[0])
        for k, family in enumerate(spec.families)
    ]
    own, *judged = judge(spec, designs)
    main = int(np.flatnonzero(at.family == spec.main)[0])
    linear = np.concatenate([
        evaluator.linear.screen(
            int(np.flatnonzero(at.family == k)[0]),
            np.where(family.is_free, values[at.family == k], np.nan),
        )[1]
        for k, family in enumerate(spec.moving)
    ])  # fmt: skip
    last = evaluator.evaluate(values)
    searched = None
    if spec.tune.samples:
        searched = search(spec, lambda chosen: evaluator.linear.screen(main, chosen))
    best = at.best_place[at.winner(spec.main)]
    audited = audit(spec, np.stack([(spec.free.places() + best) / 2, best]))
    return Findings(
        at,
        own,
        judged,
        audited,
        linear,
        last.residual,
        searched,
        evaluator.run_time,
        evaluator.runs,
    )


def _write(spec: TuneSpec, found: Findings, out: Path) -> None:
    at = found.at
    for k, family in enumerate(spec.moving):
        values = spec.free.values(at.best_place[at.winner(k)])
        name = TUNED if len(spec.moving) == 1 else f"tuned_{_file_name(family.name)}.toml"
        with replacing(out / name) as temporary:
            text = study_template(tuned_study(spec, family, values))
            temporary.write_text(text, encoding="utf-8")
    write_store(out / RESULTS, _variables(spec, found), run_attributes(spec.study))
    save(plots.descent(spec, found), out, "descent")
    save(plots.gains(spec, found), out, "gains")
    for limit in spec.metric_limits[:1]:
        save(plots.front(spec, found, spec.tune.pareto.get("limit", limit)), out, "front")
    with replacing(out / REPORT) as temporary:
        temporary.write_text(report(spec, found), encoding="utf-8")


def _file_name(name: str) -> str:
    return re.sub(r"[^A-Za-z0-9.]+", "_", name).strip("_")


@contextmanager
def open_tuning(out: Path, manifest: dict[str, Any], is_resumed: bool) -> Iterator[Progress | None]:
    """Make or check the folder and lock it; gives where an interrupted tuning stands.

    Raises:
        StudyError: not writable, in use, holds something else or a tuning that does not fit.
    """
    with locked_folder(out, "tuning"):
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
                now = json.loads(json.dumps(manifest[key]))
                if not isinstance(old, dict) or old.get(key) != now:
                    raise StudyError(
                        f"--out {out}: was begun with another {what}; name a new folder"
                    )
            yield load_progress(out / PROGRESS)
            return
        if is_resumed:
            raise StudyError(f"--out {out}: no tuning to resume there")
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(manifest, indent=1), encoding="utf-8")
        yield None


def save_progress(path: Path, at: Progress) -> None:
    """Write where a tuning stands, whole or not at all."""
    arrays = {f"descent_{k}": leaf for k, leaf in enumerate(at.descent)}
    arrays |= {name: getattr(at, name) for name in at._fields if name != "descent"}
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
            count = sum(name.startswith("descent_") for name in data.files)
            state = tuple(data[f"descent_{k}"] for k in range(count))
            rest = {name: data[name] for name in Progress._fields if name != "descent"}
            return Progress(**rest, descent=state)
    except (OSError, ValueError, KeyError, zipfile.BadZipFile):
        raise StudyError(f"{path}: damaged; name a new folder") from None


def _variables(spec: TuneSpec, found: Findings) -> dict[str, Variable]:
    at, limits, seen = found.at, spec.limit_names, found.searched
    own, all_judged = found.own, np.stack([one.objective for one in found.judged])
    variables = {
        "free": Variable(np.array(spec.free.names), ("free",), "1", "free number"),
        "family": Variable(
            np.array([family.name for family in spec.families]), ("family",), "1", "family"
        ),
        "start_family": Variable(at.family, ("start",), "1", "family of each start"),
        "value": Variable(
            spec.free.values(at.best_place), ("start", "free"), "1", "best value of each start, in "
            "the unit of its field",
        ),
        "objective": Variable(at.best_objective, ("start",), "1", "best objective of each start"),
        "is_frozen": Variable(at.is_frozen, ("start",), "1", "stopped, a run did not finish"),
        "linear_residual": Variable(
            found.linear, ("start",), "m", "linear residual vibration of the best design"
        ),
        "history": Variable(
            at.history, ("iteration", "start", "figure"), "1",
            "objective, then largest value over limit - 1, at each iteration",
        ),
        "fresh_objective": Variable(
            all_judged, ("family", "scenario"), "1", "objective of the best design, fresh machines"
        ),
        "fresh_status": Variable(
            np.stack([one.status for one in found.judged]), ("family", "scenario"), "1", "status"
        ),
    }  # fmt: skip
    for name in own.metrics:
        label, unit = variable_name(name), metric_label(name.partition("[")[0])[1]
        values = np.stack([one.metrics[name] for one in found.judged])
        variables[f"fresh_{label}"] = Variable(values, ("family", "scenario"), unit, name)
        variables[f"own_{label}"] = Variable(
            own.metrics[name], ("scenario",), unit, f"{name} of the study itself"
        )
    if limits:
        variables["limit"] = Variable(np.array(limits), ("limit",), "1", "limit")
        variables["excess"] = Variable(
            at.best_limits, ("start", "limit"), "1", "value over limit - 1, negative: kept"
        )
    if seen is not None:
        variables["search_objective"] = Variable(
            seen.objective, ("sample",), "1", "objective of random designs"
        )
        variables["search_linear_residual"] = Variable(
            seen.linear, ("sample",), "m", "linear residual vibration of random designs"
        )
    return variables
