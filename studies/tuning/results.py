"""What a tuning found, as labelled arrays (`tune.h5`) and as study files."""

from __future__ import annotations

import numpy as np

from jaxmodel.metrics import METRICS
from studies.space.table import as_numbers
from studies.store import Variable
from studies.study.entries import links_text, parse_entries
from studies.study.labels import STATUS_LABEL
from studies.study.paths import field_unit, parse_entry
from studies.tuning.check import JudgedDesign, fresh_columns, patch_centers
from studies.tuning.loop_figures import LOOP_UNITS
from studies.tuning.references import ALONE, WITHOUT
from studies.tuning.report import TuneFindings
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
    return {
        **_settings(spec),
        **_starts(spec, findings),
        **_fresh(spec, findings),
        **_random(findings),
        **_references(spec, findings),
    }


def _text(values: list[str], axis: str, text: str) -> Variable:
    return Variable(np.array(values), (axis,), "1", text)


def _settings(spec: TuneSpec) -> dict[str, Variable]:
    numbers, axis = spec.free.numbers, ("free",)
    low, high, start = (
        np.array(x)
        for x in zip(*((f.span.low, f.span.high, f.start) for f in numbers), strict=True)
    )
    settings = {
        "free": _text([f.name for f in numbers], "free", "free parameter"),
        "free_unit": _text([free_unit(f.key) for f in numbers], "free", "its unit"),
        "free_low": Variable(low, axis, "1", "lower bound, in the parameter's unit"),
        "free_high": Variable(high, axis, "1", "upper bound, in the parameter's unit"),
        "free_study": Variable(start, axis, "1", "the baseline's value, in the parameter's unit"),
        "family": _text([family.name for family in spec.families], "family", "family"),
    }
    if spec.limit_names:
        limits = [[str(x.limits[name]) for name in spec.limit_names] for x in spec.families]
        settings["limit"] = _text(list(spec.limit_names), "limit", "what is limited")
        settings["family_limit"] = Variable(
            np.array(limits), ("family", "limit"), "1", "limit; baseline: its value"
        )
    return settings


def _starts(spec: TuneSpec, findings: TuneFindings) -> dict[str, Variable]:
    at = findings.at
    family = [spec.moving[k] for k in at.family]
    values = spec.free.values(at.best_place)
    centers = [patch_centers(spec, *pair) for pair in zip(family, values, strict=True)]
    whole = at.history[: int(at.iteration)]
    is_best = np.zeros(len(family), bool)
    is_best[[at.winner(k) for k in range(len(spec.moving))]] = True
    axis, trial = ("start",), ("iteration", "start")
    starts = {
        "start_family": _text([x.name for x in family], "start", "family of the starting point"),
        "is_best": Variable(is_best, axis, "1", "best of its family"),
        "value": Variable(
            values,
            ("start", "free"),
            "1",
            "best value from each starting point, in the parameter's unit",
        ),
        "patch_center": Variable(
            np.array(centers), ("start", "link", "patch"), "m", "centres of the patches then"
        ),
        "objective": Variable(
            at.best_objective, axis, "1", "best objective from each starting point"
        ),
        "is_frozen": Variable(at.is_frozen, axis, "1", "stopped, a run did not finish"),
        "linear_residual": Variable(
            findings.linear, axis, "m", "linear residual vibration of the best design"
        ),
        "trial_objective": Variable(whole[..., 0], trial, "1", "objective of each trial"),
        "trial_excess": Variable(whole[..., 1], trial, "1", "largest excess of each trial"),
    }
    if spec.limit_names:
        starts["excess"] = Variable(
            at.best_limits,
            ("start", "limit"),
            "1",
            "negative: satisfied; value over limit - 1 of a metric in the worst scenario, for the "
            "loop a smooth figure that has the same sign, on the worst machine of the tuning",
        )
    return starts


def _fresh(spec: TuneSpec, findings: TuneFindings) -> dict[str, Variable]:
    axis, both = ("scenario",), ("family", "scenario")
    fresh = {}
    for name, column in fresh_columns(spec).items():
        array = as_numbers(column, spec.study.n_links)
        dims = tuple(f"{name}_{k}" for k in range(1, array.ndim))
        entry = parse_entry(name)
        unit = field_unit(entry.field) if entry else "1"
        fresh[name] = Variable(array, (*axis, *dims), unit, name)

    def each(field: str) -> np.ndarray:
        return np.stack([getattr(design, field) for design in findings.judged])

    fresh["fresh_objective"] = Variable(each("objective"), both, "1", "objective, fresh machines")
    fresh["fresh_status"] = Variable(each("status"), both, *STATUS_LABEL)
    fresh["baseline_status"] = Variable(findings.baseline.status, axis, *STATUS_LABEL)
    links = links_text(spec.counted_links, spec.study.n_links)
    for name, baseline in findings.baseline.metrics.items():
        unit = METRICS[name.partition("[")[0]].unit
        values = np.stack([design.metrics[name] for design in findings.judged])
        text = name if parse_entries(name).names_a_link else f"{name}, largest of {links}"
        fresh[f"fresh_{name}"] = Variable(values, both, unit, f"{text}, fresh machines")
        fresh[f"baseline_{name}"] = Variable(
            baseline, axis, unit, f"{text}, fresh machines, the baseline"
        )
        values = np.array([design.own_run.metrics[name] for design in findings.judged])
        fresh[f"file_{name}"] = Variable(values, ("family",), unit, f"{text}, as the file runs")
        before = np.array(findings.baseline.own_run.metrics[name])
        fresh[f"file_baseline_{name}"] = Variable(
            before, (), unit, f"{text}, the baseline's file as it runs"
        )
    if findings.baseline.loop is not None:
        for name in dict.fromkeys((*OF_EVERY_LOOP, *spec.loop_names)):
            label = f"{name.replace('_', ' ')} of the linearised loop, nominal machine"
            values = np.array([_loop_figure(design, name) for design in findings.judged])
            fresh[name] = Variable(values, ("family",), LOOP_UNITS[name], label)
            baseline = np.array(_loop_figure(findings.baseline, name))
            fresh[f"baseline_{name}"] = Variable(
                baseline, (), LOOP_UNITS[name], f"{label}, the baseline"
            )
    return fresh | _fresh_loops(spec, findings)


def _fresh_loops(spec: TuneSpec, findings: TuneFindings) -> dict[str, Variable]:
    """Figures of the loop that the objective or a limit names, on the fresh machines."""
    of_scenario, variables = loop_machines(spec, fresh_columns(spec)).of_scenario, {}
    for name in filter(findings.baseline.fresh_loop.__contains__, spec.loop_names):
        label, unit = f"{name.replace('_', ' ')} of the linearised loop", LOOP_UNITS[name]
        values = np.stack([design.fresh_loop[name][of_scenario] for design in findings.judged])
        variables[f"fresh_{name}"] = Variable(
            values, ("family", "scenario"), unit, f"{label}, fresh machines"
        )
        variables[f"fresh_baseline_{name}"] = Variable(
            findings.baseline.fresh_loop[name][of_scenario],
            ("scenario",),
            unit,
            f"{label}, fresh machines, the baseline",
        )
    return variables


def _loop_figure(judged: JudgedDesign, name: str) -> float:
    return float("nan") if judged.loop is None else float(getattr(judged.loop, name))


def _random(findings: TuneFindings) -> dict[str, Variable]:
    search = findings.searched
    if search is None:
        return {}
    return {
        "search_objective": Variable(
            search.objective, ("sample",), "1", "objective of random designs"
        ),
        "search_linear_residual": Variable(
            search.linear, ("sample",), "m", "linear residual vibration of random designs"
        ),
    }


def _references(spec: TuneSpec, findings: TuneFindings) -> dict[str, Variable]:
    """No control, and the gain factor alone."""
    links, references = links_text(spec.counted_links, spec.study.n_links), {}
    scan, axis = findings.references.scan, ("scanned",)
    designs = findings.references.uncontrolled, findings.references.gain_alone
    for label, text, design in zip(
        ("uncontrolled", "gain_alone"), (WITHOUT, ALONE), designs, strict=True
    ):
        if design is None:
            continue
        references[f"{label}_objective"] = Variable(
            design.objective, ("scenario",), "1", f"objective, fresh machines, {text}"
        )
        references[f"{label}_status"] = Variable(design.status, ("scenario",), *STATUS_LABEL)
        for name, values in design.metrics.items():
            unit = METRICS[name.partition("[")[0]].unit
            what = name if parse_entries(name).names_a_link else f"{name}, largest of {links}"
            references[f"{label}_{name}"] = Variable(
                values, ("scenario",), unit, f"{what}, fresh machines, {text}"
            )
            references[f"file_{label}_{name}"] = Variable(
                np.array(design.own_run.metrics[name]),
                (),
                unit,
                f"{what}, the baseline's run, {text}",
            )
    if scan is not None:
        best = scan.gain_factor[scan.best] if scan.best >= 0 else np.nan
        references |= {
            "gain_alone_factor": Variable(np.array(best), (), "1", f"control.gain_factor, {ALONE}"),
            "scanned_gain_factor": Variable(scan.gain_factor, axis, "1", "control.gain_factor"),
            "scanned_objective": Variable(
                scan.objective, axis, "1", "objective with that gain factor alone"
            ),
            "scanned_excess": Variable(
                scan.excess, axis, "1", "largest excess over limits of metrics then, 0: kept"
            ),
        }
    return references
