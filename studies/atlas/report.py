"""The report of the atlas: where the paper's statements hold, and the numbers behind it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from studies.atlas.attribution import shapley
from studies.atlas.claims import NO_CHANGE, one_more_link, table_1_signs, two_links
from studies.atlas.findings import AtlasFindings
from studies.atlas.platform import LINK_LABELS, OUTPUTS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.plots import length_text
from studies.atlas.subsets import (
    CHOICES,
    MATTERS,
    TARGETS,
    Subsets,
    link_label,
    setting_label,
)
from studies.atlas.workspace import MAP_MODES, Map
from studies.show.pages import old_page as page
from studies.show.sketch import CAPTION
from studies.show.units import span
from studies.study.window import residual_delay

ALL_LINKS, PLATFORM = TARGETS.index("all links"), TARGETS.index("platform")


def report(findings: AtlasFindings, dropped: list[str], images: Path | None = None) -> str:
    """The page of an atlas.

    Args:
        findings: from `evaluate_atlas`.
        dropped: settings left out, and why.
        images: folder with the figures; None: a page without.
    """
    stable = findings.responses.is_stable
    return page(
        "atlas/report.html",
        images,
        findings.study,
        study=findings.study,
        delays=[
            1e3 * residual_delay(findings.study.change(motion__move_time=time))
            for time, _ in findings.choices.setting
        ],
        modes=_modes(findings),
        dropped=dropped,
        most=_most_vibration(findings),
        adc_step=length_text(findings.adc_step.max()),
        is_stable=stable.all(),
        unstable=[name for name, fine in zip(LINK_LABELS, stable, strict=True) if not fine],
        radius=findings.responses.radius.max(),
        settings=len(findings.choices.setting),
        choices=[link_label(k) for k in CHOICES],
        residuals=_residuals(findings),
        shares=_shares(findings),
        signs=_signs(findings),
        steps=_steps(findings),
        at_drive=_at_drive(findings),
        pairs=_pairs(findings),
        workspace=_workspace(findings),
        runs=_runs(findings),
        errors=_error_rows(findings),
        responses=_responses(findings),
        link_sets=list(LINK_LABELS),
        filmed=setting_label(RUNS[-1]),
        sketch_caption=CAPTION,
    )


def _change(value: float) -> str:
    """A relative change in percent, with its sign."""
    text = f"{100 * value:+.1f}"
    return f"{text if float(text) else '0.0'} %"


def _by_setting(findings: AtlasFindings, cells: Iterable[Iterable[str]]) -> list[list[str]]:
    """Row of each setting.

    Args:
        findings: from `evaluate_atlas`.
        cells: of each setting, after its name.
    """
    labels = findings.labels(findings.choices)
    return [[label, *row] for label, row in zip(labels, cells, strict=True)]


def _all_links(findings: AtlasFindings) -> np.ndarray:
    """Residual of the three links by choice of controlled links [m], (settings, 8)."""
    return np.sqrt(np.mean(findings.links.link**2, axis=-1))


def _most_vibration(findings: AtlasFindings) -> dict[str, Any]:
    """The answer for the setting with the most residual vibration."""
    rms = _all_links(findings)
    k = int(np.argmax(rms[:, 0]))
    best = min((1, 2, 4), key=lambda subset: rms[k, subset])
    link = findings.links.link[k]  # (8, 3)
    change = one_more_link(findings.links).change[k, ALL_LINKS]
    return {
        "setting": findings.labels(findings.choices)[k],
        "free": length_text(rms[k, 0]),
        "controlled": length_text(rms[k, 7]),
        "best": link_label(best),
        "single": length_text(rms[k, best]),
        "neighbours": [
            100 * (link[1 << i, j] / link[0, j] - 1) for i in range(3) for j in range(3) if i != j
        ],
        "worse": np.sum(change > NO_CHANGE),
    }


def _residuals(findings: AtlasFindings) -> list[list[str]]:
    """Rows of settings: residual of the three links for each choice of controlled links."""
    return _by_setting(findings, (map(length_text, row[CHOICES]) for row in _all_links(findings)))


def _modes(findings: AtlasFindings) -> dict[str, Any]:
    """Whether modes 2 and up matter, and where all their subsets were run."""
    subsets = findings.subsets
    return {
        "count": findings.choices.modes,
        "change": 100 * findings.beyond_first,
        "matters": 100 * MATTERS,
        "labels": [] if subsets is None else findings.labels(subsets),
        "shares": [] if subsets is None else _mode_shares(findings, subsets),
    }


def _mode_shares(findings: AtlasFindings, subsets: Subsets) -> list[list[str]]:
    """Row of each setting: Shapley shares of the links' modes, link by link."""
    share = 100 * shapley(subsets.removed()[:, ALL_LINKS]).reshape(-1, 3, subsets.modes)
    return [
        [label, *(", ".join(f"{x:.2f}" for x in link) for link in row)]
        for label, row in zip(findings.labels(subsets), share, strict=True)
    ]


def _shares(findings: AtlasFindings) -> list[list[str]]:
    """Row of each setting: Shapley shares of links, and what modes beyond the first change."""
    game = findings.links.removed()[:, ALL_LINKS]
    beyond = 100 * findings.beyond_first
    cells = (
        [*(f"{100 * x:.2f}" for x in row), f"{100 * total:.4g}", f"{change:.2g}"]
        for row, total, change in zip(shapley(game), game[:, -1], beyond, strict=True)
    )
    return _by_setting(findings, cells)


def _signs(findings: AtlasFindings) -> dict[str, Any]:
    """Table 1: changes of the spectral peak [%], and how many agree."""
    signs = table_1_signs(findings.choices)
    on, paper, ours = signs.is_controlled, 100 * signs.paper, 100 * signs.ours
    agree = signs.agree[:, ~on]

    def cells(change: np.ndarray, agreeing: str) -> list[str]:
        return [
            f"{np.sum(change[on] < 0)} of {on.sum()}",
            span(change[on], ".1f"),
            agreeing,
            ", ".join(f"{x:+.1f}" for x in change[~on]),
        ]

    agreeing = (f"{row.sum()} of {row.size}" for row in agree)
    return {
        "rows": [["paper", *cells(paper, "")], *_by_setting(findings, map(cells, ours, agreeing))],
        "fallen": np.sum(ours[:, on] < 0),
        "controlled": ours[:, on].size,
        "is_deeper": np.all(ours[:, on] < paper[on]),
        "agree": agree.sum(),
        "uncontrolled": agree.size,
        "ours": np.abs(ours[:, ~on]).max(),
        "paper": np.abs(paper[~on]).max(),
    }


def _steps(findings: AtlasFindings) -> dict[str, Any]:
    """Steps to one more controlled link: how many of them increase vibration."""
    steps = one_more_link(findings.links)

    def cell(change: np.ndarray) -> str:
        worst = int(np.argmax(change))
        text = f"{np.sum(change > NO_CHANGE)} of {change.size}"
        if change[worst] <= NO_CHANGE:
            return text
        return f"{text} ({steps.labels[worst]}: {_change(change[worst])})"

    single = steps.change[:, :3] > NO_CHANGE
    shown = steps.change[:, [ALL_LINKS, PLATFORM]]
    return {
        "rows": _by_setting(findings, (map(cell, one) for one in shown)),
        "count": steps.change[:, ALL_LINKS].size,
        "links": steps.rises[:, ALL_LINKS].sum(),
        "platform": steps.rises[:, PLATFORM].sum(),
        "single": single.sum(),
        "singles": single.size,
        "left_alone": single[:, ~steps.is_controlled.T].sum(),
    }


def _at_drive(findings: AtlasFindings) -> dict[str, float] | None:
    """Effect of control on link 1 at the drive's lowest mode, if it can be determined."""
    share, frequency = findings.modes.share[0, :, 3], findings.modes.frequency[0]
    at_drive = frequency[share > 0.5]
    if not len(at_drive) or not findings.responses.is_stable[[0, -1]].all():
        return None
    at = int(np.argmin(np.abs(findings.responses.frequency - at_drive[0])))
    size = np.abs(findings.responses.value[:, at, 0, 0])
    return {"frequency": at_drive[0], "ratio": size[-1] / size[0]}


def _pairs(findings: AtlasFindings) -> dict[str, Any]:
    """Two links controlled: change of the platform's error [%]."""
    pairs = two_links(findings.links)
    return {
        "labels": [f"links {label}" for label in pairs.labels],
        "rows": _by_setting(findings, (map(_change, one) for one in pairs.change)),
        "change": 100 * pairs.change,
        "kept": np.sum(pairs.change < -0.5),
        "count": pairs.change.size,
    }


def _workspace(findings: AtlasFindings) -> dict[str, Any]:
    """Natural modes over the workspace, at the turn of the path's first pose."""
    chart = findings.map
    turn = int(np.argmin(np.abs(chart.phi - findings.poses[0, 2])))
    reach = np.isfinite(chart.margin).sum(axis=(1, 2))
    cell = 1e4 * (chart.x[1] - chart.x[0]) * (chart.y[1] - chart.y[0])  # [cm2]
    rate = findings.study.link.first_damping * 2 * np.pi * np.nanmedian(chart.bending)
    return {
        "modes": min(MAP_MODES, findings.study.link.modes),
        "areas": list(zip(cell * reach, np.degrees(chart.phi), strict=True)),
        "border": _border(chart),
        "turn": np.degrees(chart.phi[turn]),
        "lowest": _reach(chart.frequency[turn, ..., 0]),
        "bending": _reach(chart.bending[turn]),
        "spread": _reach(100 * chart.spread[turn]),
        "coupling": _reach(100 * chart.coupling[turn], ".2f"),
        "beat": _beat(findings.modes.frequency[0], findings.modes.order_share[0]),
        "decay": 1 / rate if rate > 0 else None,
    }


def _reach(values: np.ndarray, digits: str = ".4g") -> str:
    """Smallest and largest value over the reachable poses."""
    return span(values[np.isfinite(values)], digits)


def _beat(frequency: np.ndarray, order_share: np.ndarray) -> float | None:
    """Beat of the first bending triple at the first pose [s], None if it has one frequency."""
    bending = frequency[np.argsort(-order_share[:, 0])[:3]]
    return 1 / np.ptp(bending) if np.ptp(bending) > 0 else None


def _border(chart: Map) -> str:
    """A link's angle to its guide at the border: "square" to it, "along" it, or "both"."""
    near = chart.margin <= np.nanpercentile(chart.margin, 5)
    gamma = chart.gamma[near]
    high = np.pi / 2 - gamma.max(axis=-1) < gamma.min(axis=-1)
    return "square" if high.all() else "both" if high.any() else "along"


def _rms(findings: AtlasFindings) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Rms errors of the platform due to drive, (3,), and vibration, (4, 3), by setting."""
    runs = findings.platform
    every = zip(RUNS, runs.rms(runs.drive), runs.rms(runs.vibration), strict=True)
    return ((setting_label(setting), drive, vibration) for setting, drive, vibration in every)


def _error_rows(findings: AtlasFindings) -> list[list[str]]:
    """Row of each setting and part of the error."""
    rows = []
    for setting, drive, vibration in _rms(findings):
        rows.append([setting, "drive error", *_errors(drive)])
        for links, error in zip(LINK_LABELS, vibration, strict=True):
            rows.append([setting, f"vibration error, controlled: {links}", *_errors(error)])
    return rows


def _runs(findings: AtlasFindings) -> list[dict[str, Any]]:
    """What control of all links does to the errors of each setting."""
    runs = []
    for setting, drive, vibration in _rms(findings):
        centre = np.hypot(vibration[:, 0], vibration[:, 1])
        runs.append(
            {
                "setting": setting,
                "is_drive": np.hypot(*drive[:2]) > centre[0],
                "centre": _change(centre[-1] / centre[0] - 1),
                "turn": _change(vibration[-1, 2] / vibration[0, 2] - 1),
            }
        )
    return runs


def _errors(rms: np.ndarray) -> list[str]:
    """Errors of centre [nm] and turn [nrad], of (3,)."""
    return [f"{1e9 * x:.3g}" for x in (np.hypot(rms[0], rms[1]), rms[2])]


def _responses(findings: AtlasFindings) -> list[list[str]]:
    """Largest magnitudes: a row for each pair of force and motion."""
    peak = np.abs(findings.responses.value).max(axis=1)
    shown = [("slider 1", 0, i) for i in range(3)] + [("platform y", 4, i) for i in (0, 4)]
    return [
        [f"{name} to {OUTPUTS[i].split(' [')[0]}", *map(_number, peak[:, i, source])]
        for name, source, i in shown
    ]


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"
