"""What a tuning found, as labelled arrays (`tune.h5`) and as study files."""

from __future__ import annotations

import numpy as np

from jaxmodel.metrics import METRICS
from studies.results.labelled import Variable, Variables
from studies.space.table import as_numbers
from studies.study.entries import links_text, parse_entries
from studies.study.labels import STATUS_LABEL
from studies.study.paths import field_unit, parse_entry
from studies.tuning.check import JudgedDesign, fresh_columns, patch_centers
from studies.tuning.findings import TuneFindings
from studies.tuning.loop_figures import LOOP_UNITS
from studies.tuning.references import ALONE, WITHOUT
from studies.tuning.scenarios import loop_machines
from studies.tuning.spec import TuneSpec

#: Figures of the linearised loop that are always there.
OF_EVERY_LOOP = ("gain_margin", "slowest_decay", "spillover")


def free_unit(key: str) -> str:
    """Unit of a free parameter, by the name it has in the file."""
    entry = parse_entry(key)
    return field_unit(entry.field) if entry and "." in entry.field else "1"


def variables(spec: TuneSpec, findings: TuneFindings) -> dict[str, Variable]:
    """All starts, the best design of each family on fresh machines, random designs."""
    made = Variables()
    _put_settings(made, spec)
    _put_starts(made, spec, findings)
    _put_fresh(made, spec, findings)
    _put_loops(made, spec, findings)
    _put_references(made, spec, findings)
    if (search := findings.searched) is not None:
        made.put("search_objective", search.objective, "1", "objective of random designs", "sample")
        text = "linear residual vibration of random designs"
        made.put("search_linear_residual", search.linear, "m", text, "sample")
    return made


def _put_settings(made: Variables, spec: TuneSpec) -> None:
    numbers, own = spec.free.numbers, "in the parameter's unit"
    made.put("free", [f.name for f in numbers], "1", "free parameter", "free")
    made.put("free_unit", [free_unit(f.key) for f in numbers], "1", "its unit", "free")
    made.put("free_low", [f.span.low for f in numbers], "1", f"lower bound, {own}", "free")
    made.put("free_high", [f.span.high for f in numbers], "1", f"upper bound, {own}", "free")
    start = [f.start for f in numbers]
    made.put("free_study", start, "1", f"the baseline's value, {own}", "free")
    made.put("family", [x.name for x in spec.families], "1", "family", "family")
    if spec.limit_names:
        made.put("limit", list(spec.limit_names), "1", "what is limited", "limit")
        limits = [[str(x.limits[name]) for name in spec.limit_names] for x in spec.families]
        text = "limit; baseline: its value"
        made.put("family_limit", limits, "1", text, "family", "limit")


def _put_starts(made: Variables, spec: TuneSpec, findings: TuneFindings) -> None:
    at = findings.at
    family = [spec.moving[k] for k in at.family]
    values = spec.free.values(at.best_place)
    centers = [patch_centers(spec, *pair) for pair in zip(family, values, strict=True)]
    whole = at.history[: int(at.iteration)]
    is_best = np.zeros(len(family), bool)
    is_best[[at.winner(k) for k in range(len(spec.moving))]] = True
    names = [x.name for x in family]
    made.put("start_family", names, "1", "family of the starting point", "start")
    made.put("is_best", is_best, "1", "best of its family", "start")
    text = "best value from each starting point, in the parameter's unit"
    made.put("value", values, "1", text, "start", "free")
    text = "centres of the patches then"
    made.put("patch_center", centers, "m", text, "start", "link", "patch")
    text = "best objective from each starting point"
    made.put("objective", at.best_objective, "1", text, "start")
    made.put("is_frozen", at.is_frozen, "1", "stopped, a run did not finish", "start")
    text = "linear residual vibration of the best design"
    made.put("linear_residual", findings.linear, "m", text, "start")
    trial = "iteration", "start"
    made.put("trial_objective", whole[..., 0], "1", "objective of each trial", *trial)
    made.put("trial_excess", whole[..., 1], "1", "largest excess of each trial", *trial)
    if spec.limit_names:
        text = (
            "negative: satisfied; value over limit - 1 of a metric in the worst scenario, for the "
            "loop a smooth figure that has the same sign, on the worst machine of the tuning"
        )
        made.put("excess", at.best_limits, "1", text, "start", "limit")


def _put_fresh(made: Variables, spec: TuneSpec, findings: TuneFindings) -> None:
    """The best designs and the baseline on fresh machines, and as their files run."""
    axis, both = "scenario", ("family", "scenario")
    for name, column in fresh_columns(spec).items():
        array = as_numbers(column, spec.study.n_links)
        entry = parse_entry(name)
        dims = (axis, *(f"{name}_{k}" for k in range(1, array.ndim)))
        made.put(name, array, field_unit(entry.field) if entry else "1", name, *dims)
    judged, baseline = findings.judged, findings.baseline
    text = "objective, fresh machines"
    made.put("fresh_objective", np.stack([x.objective for x in judged]), "1", text, *both)
    made["fresh_status"] = Variable(np.stack([x.status for x in judged]), both, *STATUS_LABEL)
    made["baseline_status"] = Variable(baseline.status, (axis,), *STATUS_LABEL)
    for name, values in baseline.metrics.items():
        unit, text = _unit_and_text(spec, name)
        each = np.stack([x.metrics[name] for x in judged])
        made.put(f"fresh_{name}", each, unit, f"{text}, fresh machines", *both)
        made.put(f"baseline_{name}", values, unit, f"{text}, fresh machines, the baseline", axis)
        own = [x.own_run.metrics[name] for x in judged]
        made.put(f"file_{name}", own, unit, f"{text}, as the file runs", "family")
        before, text = baseline.own_run.metrics[name], f"{text}, the baseline's file as it runs"
        made.put(f"file_baseline_{name}", before, unit, text)


def _unit_and_text(spec: TuneSpec, name: str) -> tuple[str, str]:
    links = links_text(spec.counted_links, spec.study.n_links)
    text = name if parse_entries(name).names_a_link else f"{name}, largest of {links}"
    return METRICS[name.partition("[")[0]].unit, text


def _put_loops(made: Variables, spec: TuneSpec, findings: TuneFindings) -> None:
    """Figures of the loop: of the nominal machine, and on fresh ones those that count."""
    judged, baseline = findings.judged, findings.baseline
    if baseline.loop is not None:
        for name in dict.fromkeys((*OF_EVERY_LOOP, *spec.loop_names)):
            unit = LOOP_UNITS[name]
            text = f"{name.replace('_', ' ')} of the linearised loop, nominal machine"
            made.put(name, [_loop_figure(x, name) for x in judged], unit, text, "family")
            own = _loop_figure(baseline, name)
            made.put(f"baseline_{name}", own, unit, f"{text}, the baseline")
    of_scenario = loop_machines(spec, fresh_columns(spec)).of_scenario
    for name in filter(baseline.fresh_loop.__contains__, spec.loop_names):
        unit = LOOP_UNITS[name]
        text = f"{name.replace('_', ' ')} of the linearised loop, fresh machines"
        each = np.stack([x.fresh_loop[name][of_scenario] for x in judged])
        made.put(f"fresh_{name}", each, unit, text, "family", "scenario")
        own, text = baseline.fresh_loop[name][of_scenario], f"{text}, the baseline"
        made.put(f"fresh_baseline_{name}", own, unit, text, "scenario")


def _loop_figure(judged: JudgedDesign, name: str) -> float:
    return float("nan") if judged.loop is None else float(getattr(judged.loop, name))


def _put_references(made: Variables, spec: TuneSpec, findings: TuneFindings) -> None:
    """No control, and the gain factor alone."""
    references, axis = findings.references, "scenario"
    designs = references.uncontrolled, references.gain_alone
    labels = zip(("uncontrolled", "gain_alone"), (WITHOUT, ALONE), designs, strict=True)
    for label, what, design in labels:
        if design is None:
            continue
        text = f"objective, fresh machines, {what}"
        made.put(f"{label}_objective", design.objective, "1", text, axis)
        made[f"{label}_status"] = Variable(design.status, (axis,), *STATUS_LABEL)
        for name, values in design.metrics.items():
            unit, text = _unit_and_text(spec, name)
            made.put(f"{label}_{name}", values, unit, f"{text}, fresh machines, {what}", axis)
            own, text = design.own_run.metrics[name], f"{text}, the baseline's run, {what}"
            made.put(f"file_{label}_{name}", own, unit, text)
    if (scan := references.scan) is not None:
        best = scan.gain_factor[scan.best] if scan.best >= 0 else np.nan
        made.put("gain_alone_factor", best, "1", f"control.gain_factor, {ALONE}")
        made.put("scanned_gain_factor", scan.gain_factor, "1", "control.gain_factor", "scanned")
        text = "objective with that gain factor alone"
        made.put("scanned_objective", scan.objective, "1", text, "scanned")
        text = "largest excess over limits of metrics then, 0: kept"
        made.put("scanned_excess", scan.excess, "1", text, "scanned")
