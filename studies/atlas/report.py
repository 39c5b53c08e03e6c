"""`report.md` of the atlas: where the paper's statements hold, and the numbers behind it."""

from __future__ import annotations

import numpy as np

from studies.atlas.attribution import shapley
from studies.atlas.claims import NO_CHANGE, one_more_link, table_1_signs, two_links
from studies.atlas.figures import ANIMATION, FIGURES
from studies.atlas.findings import Findings
from studies.atlas.platform import LINK_LABELS, OUTPUTS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.plots import length_text
from studies.atlas.subsets import TARGETS, WINDOWS, link_label, setting_label
from studies.atlas.workspace import MAP_MODES, Map
from studies.show.markdown import literal, opening, picture, table
from studies.show.sketch import CAPTION
from studies.show.units import span

LATE = WINDOWS.index("late")


def report(found: Findings, dropped: list[str]) -> str:
    """Text of the report, in Markdown.

    Args:
        found: everything.
        dropped: settings that are left out, and why.
    """
    sections = (_head, _subsets, _shares, _claims, _workspace, _platform, _motion)
    lines = [line for section in sections for line in (*section(found), "")]
    first = lines.index("## How to read it")
    lines[first:first] = [line for text in dropped for line in (f"**Left out:** {text}", "")]
    return "\n".join(lines)


def _figure(name: str) -> list[str]:
    return [picture(f"{name}.png", FIGURES[name].caption), ""]


def _percent(value: float) -> str:
    text = f"{100 * value:+.1f}"
    return f"{text if float(text) else '0.0'} %"


def _head(found: Findings) -> list[str]:
    study, subsets = found.study, found.subsets
    count, settings = subsets.status.shape[-1], len(subsets.setting)
    delay, length = study.metrics.residual_delay, study.metrics.residual_length
    return [
        "# Coupling atlas",
        "",
        *opening(
            f"{literal(study.title)}: which of the three links and {subsets.modes} modes a link "
            "are worth controlling, who "
            f"helps or hurts whom, and whether the paper's statements hold: {count} subsets in "
            f"{settings} setting{'s' if settings > 1 else ''}.",
            _came_out(found),
            "control the links that carry the largest shares below; `studies sweep links` looks at "
            "fewer subsets in more settings, `studies spillover DESIGN --out DIR` says how far the "
            "design may be trusted.",
        ),
        picture("machine.png", CAPTION),
        "",
        "## How to read it",
        "",
        f"{count} subsets of controlled links and modes "
        f"({subsets.modes} a link), "
        f"{settings} setting{'s' if settings > 1 else ''} of move time and shaper, "
        f"{subsets.status.size} runs; "
        f"gain factor {study.control.gain_factor:g}, ratios "
        + (
            "by (24) from each setting's uncontrolled run."
            if study.control.ratio_source == "own_run"
            else "as given."
        ),
        "",
        f"Two windows: *whole* is the design's residual window, {length:g} s from {delay:g} s "
        "after the command; *late* is that without its first third, in which the sliders' drive "
        "may still settle and bend the links with it. Residual of a "
        "link: rms of its chord deflection over the window and all stations; of the platform: rms "
        "error of its centre. Tables show the late window where they name none.",
        "",
        f"One ADC step is {length_text(found.adc_step.max())} of mode 1. Where a link has less "
        "than that left without control, late (setting marked †), the controller hardly sees it, "
        "and percentages of it say little.",
        "",
        *_stability(found),
    ]


def _came_out(found: Findings) -> str:
    """The answer in the setting that leaves most vibration, late window."""
    subsets = found.subsets
    link = subsets.link[:, LATE][:, subsets.link_subsets]  # (settings, 8, 3)
    rms = np.sqrt(np.mean(link**2, axis=-1))
    k = int(np.argmax(rms[:, 0]))
    alone = [1, 2, 4]
    best = min(alone, key=lambda subset: rms[k, subset])
    others = [
        100 * (link[k, 1 << i, j] / link[k, 0, j] - 1) for i in range(3) for j in range(3) if i != j
    ]
    worse = int(np.sum(one_more_link(subsets).change[k, LATE, TARGETS.index("all links")] > 1e-3))
    told = (
        f"Where most vibration is left ({found.setting(k)}), control of all links takes the "
        f"residual of the three from {length_text(rms[k, 0])} to {length_text(rms[k, 7])} rms; of "
        f"single links, link {link_label(best)} gives most ({length_text(rms[k, best])}). One "
        f"link under control changes its neighbours by {min(others):+.0f} to {max(others):+.0f} %; "
        f"of the 12 steps to one more link {worse or 'none'} make it worse."
    )
    if not found.responses.is_stable.all():
        told += " **The linearised loop is unstable, see below: these are limit cycles.**"
    return told


def _stability(found: Findings) -> list[str]:
    """What the linearised sampled loop says, which no run can."""
    radius = found.responses.radius
    if found.responses.is_stable.all():
        return [
            "The linearised sampled loop is stable at the path's first pose with no link, link "
            f"1, links 1 and 2, and all links controlled (spectral radius {radius.max():.5f} "
            "at most)."
        ]
    bad = [
        name for name, fine in zip(LINK_LABELS, found.responses.is_stable, strict=True) if not fine
    ]
    return [
        f"**Unstable**: the linearised sampled loop with controlled links {', '.join(bad)} "
        f"(spectral radius {radius.max():.5f}). Runs stay bounded by the actuators' limit; "
        "what follows describes limit cycles, not a design to use."
    ]


def _verdict(kept: int, count: int) -> str:
    """How far a statement holds that is kept in so many cases."""
    if kept == count:
        return "**Holds**"
    if kept == 0:
        return "**Does not hold**"
    return "**Holds mostly**" if kept >= 0.9 * count else "**Holds in part**"


def _claims(found: Findings) -> list[str]:
    return [
        "## Where the paper's statements hold",
        "",
        *_table_1(found),
        "",
        *_more_links(found),
        "",
        *_halved(found),
    ]


def _table_1(found: Findings) -> list[str]:
    signs = table_1_signs(found.subsets)
    on = signs.is_controlled
    rows = []
    for k, (ours, agree) in enumerate(zip(signs.ours, signs.agree, strict=True)):
        rows.append(
            [
                found.setting(k),
                f"{int(np.sum(ours[on] < 0))} of {on.sum()}",
                span(100 * ours[on], ".1f"),
                f"{int(agree[~on].sum())} of {np.sum(~on)}",
                ", ".join(f"{100 * x:+.1f}" for x in ours[~on]),
            ]
        )
    paper = signs.paper
    rows.insert(
        0,
        [
            "paper",
            f"{int(np.sum(paper[on] < 0))} of {on.sum()}",
            span(100 * paper[on], ".1f"),
            "",
            ", ".join(f"{100 * x:+.1f}" for x in paper[~on]),
        ],
    )
    fallen = signs.ours[:, on] < 0
    largest = np.abs(signs.ours[:, ~on]).max()
    deeper = bool(np.all(signs.ours[:, on] < paper[on]))
    modes = "two modes" if found.subsets.modes > 1 else "mode 1"
    return [
        "### Table 1: signs",
        "",
        "Change of the spectral peak of mode 1 against no control, as in Table 1: three links with "
        f"{modes} each, links 1 and 2 and link 1 with mode 1.",
        "",
        *table(
            (
                "setting",
                "controlled links fall",
                "by [%]",
                "uncontrolled: same sign as the paper",
                "link 3 with 1 and 2, links 2 and 3 with 1 [%]",
            ),
            rows,
        ),
        "",
        f"{_verdict(int(fallen.sum()), fallen.size)} for controlled links: {int(fallen.sum())} of "
        f"{fallen.size} fall"
        + (
            ", all of them further than the paper's: the gains add more damping here "
            "(docs/theory.md). "
            if deeper
            else ". "
        )
        + f"Signs of the uncontrolled ones agree in {int(signs.agree[:, ~on].sum())} of "
        f"{signs.agree[:, ~on].size} cases. Ours change by up to {100 * largest:.0f} %, "
        f"the paper's by {100 * np.abs(paper[~on]).max():.1f} %.",
    ]


def _more_links(found: Findings) -> list[str]:
    steps = one_more_link(found.subsets)
    rows = []
    for k in range(len(found.subsets.setting)):
        cells = []
        for window in range(len(WINDOWS)):
            for target in ("all links", "platform"):
                change = steps.change[k, window, TARGETS.index(target)]
                worst = int(np.argmax(change))
                cells.append(
                    f"{int(steps.rises[k, window, TARGETS.index(target)])} of {change.size}"
                    + (
                        f" ({steps.labels[worst]}: {_percent(change[worst])})"
                        if change[worst] > NO_CHANGE
                        else ""
                    )
                )
        rows.append([found.setting(k), *cells])
    late = steps.rises[:, LATE, [TARGETS.index("all links"), TARGETS.index("platform")]]
    is_worse = steps.change[:, LATE, :3] > NO_CHANGE
    left_alone = int(is_worse[:, ~steps.is_controlled.T].sum())
    count = 12 * len(late)
    kept = [count - int(late[:, k].sum()) for k in range(2)]
    whole = steps.rises[:, 0, TARGETS.index("all links")]
    return [
        '### "More links, better"',
        "",
        "Each of the 12 steps from one choice of links to one with a link more: how many make it "
        "worse, and the worst of them.",
        "",
        *table(
            ("setting", "whole: all links", "whole: platform", "late: all links", "late: platform"),
            rows,
        ),
        "",
        f"Late: {_verdict(kept[0], count)} for all links together ({count - kept[0]} of {count} "
        f"steps make it worse), {_verdict(kept[1], count).lower()} for the platform "
        f"({count - kept[1]} of {count}). Link by link, in {int(is_worse.sum())} of "
        f"{is_worse.size} cases a step makes a single link worse, {left_alone} times one that is "
        f"not controlled. Whole window: {int(whole.sum())} of {count} steps make the links worse."
        + _at_drive(found),
    ]


def _at_drive(found: Findings) -> str:
    """What control does to link 1 at the drive's lowest mode, if it can be said."""
    share, frequency = found.modes.share[0, :, 3], found.modes.frequency[0]
    at_drive = frequency[share > 0.5]
    if not len(at_drive) or not found.responses.is_stable[[0, -1]].all():
        return ""
    at = int(np.argmin(np.abs(found.responses.frequency - at_drive[0])))
    size = np.abs(found.responses.value[:, at, 0, 0])
    return (
        f" At {at_drive[0]:.3g} Hz, the drive's lowest mode, control of all links multiplies the "
        f"response of link 1 to slider 1 by {size[-1] / size[0]:.2f}: below the controlled modes "
        "the velocity estimate has another phase."
    )


def _halved(found: Findings) -> list[str]:
    halved = two_links(found.subsets)
    rows = []
    for k in range(len(found.subsets.setting)):
        cells = [" / ".join(_percent(x) for x in halved.change[k, w]) for w in range(len(WINDOWS))]
        rows.append([found.setting(k), *cells])
    late, whole = halved.change[:, LATE], halved.change[:, 0]
    return [
        "### Two links controlled: platform error down by more than 50 %",
        "",
        *table(("setting", *(f"{w}: links {', '.join(halved.labels)}" for w in WINDOWS)), rows),
        "",
        f"Late: {_verdict(int(np.sum(late < -0.5)), late.size).lower()}, in "
        f"{int(np.sum(late < -0.5))} of {late.size} cases (by {span(100 * late, '.0f')} %). "
        f"Whole window: {_verdict(int(np.sum(whole < -0.5)), whole.size).lower()}, in "
        f"{int(np.sum(whole < -0.5))} of {whole.size} (by {span(100 * whole, '.2g')} %).",
    ]


def _subsets(found: Findings) -> list[str]:
    subsets = found.subsets
    chosen = subsets.link_subsets
    lines = ["## Which links to control", ""]
    for window, name in enumerate(WINDOWS):
        rms = np.sqrt(np.mean(subsets.link[:, window, chosen] ** 2, axis=-1))
        rows = [[found.setting(k), *(length_text(x) for x in row)] for k, row in enumerate(rms)]
        header = ("setting", *(link_label(k) for k in range(8)))
        lines += [
            f"Residual of all three links, rms, {name} window, by controlled links:",
            "",
            *table(header, rows),
            "",
        ]
    return lines + _figure("subsets") + _figure("helps") + _figure("lattice")


def _shares(found: Findings) -> list[str]:
    subsets = found.subsets
    game = subsets.removed()[:, LATE, TARGETS.index("all links")]
    share = shapley(game)
    rows = []
    for k, (one, total) in enumerate(zip(share, game[:, -1], strict=True)):
        by_link = one.reshape(3, -1).sum(axis=1)
        beyond = one.reshape(3, -1)[:, 1:]
        rows.append(
            [
                found.setting(k),
                *(f"{100 * x:.2f}" for x in by_link),
                f"{100 * np.abs(beyond).sum():.2f}",
                f"{100 * total:.4g}",
            ]
        )
    return [
        "## Who contributes what",
        "",
        "Shapley shares of links and modes in the mean square that control of all of them takes "
        "away from all links (late window), in percent of what is there without control. Mean "
        "squares of motions that do not touch add up, so interactions are coupling.",
        "",
        *table(
            (
                "setting",
                "link 1",
                "link 2",
                "link 3",
                "modes 2 and up, sizes added",
                "removed by all",
            ),
            rows,
        ),
        "",
        *_figure("shares"),
        *_figure("interactions"),
    ]


def _workspace(found: Findings) -> list[str]:
    chart, modes = found.map, found.modes
    turn = int(np.argmin(np.abs(chart.phi - found.poses[0, 2])))
    spread, coupling = (100 * x[turn] for x in (chart.spread, chart.coupling))
    reach = np.isfinite(chart.margin).mean(axis=(1, 2))
    step = (chart.x[1] - chart.x[0]) * (chart.y[1] - chart.y[0])
    area = 1e4 * reach * chart.margin[0].size * step
    return [
        "## Along the workspace",
        "",
        f"Natural modes with the sliders on their drive, "
        f"{min(MAP_MODES, found.study.link.modes)} modes a link, no damping. "
        "The platform can reach "
        + ", ".join(
            f"{a:.0f} cm² at φ = {np.degrees(p):.0f}°" for a, p in zip(area, chart.phi, strict=True)
        )
        + f"; at its border a link stands {_border(chart)} its guide. "
        f"At φ = {np.degrees(chart.phi[turn]):.0f}° the lowest mode lies at "
        f"{_reach(chart.frequency[turn, ..., 0])} Hz, the three first bending modes at "
        f"{_reach(chart.bending[turn])} Hz, {_reach(spread)} % apart; coupling of two links' first "
        f"modes through platform and sliders is {_reach(coupling, '.2f')} %. "
        "Left alone, energy would go from link to link and back in "
        f"{_beat(modes.frequency[0], modes.order_share[0])} s; {_decay(found)}.",
        "",
        *_figure("workspace"),
        *_figure("participation"),
        *_figure("modes"),
    ]


def _reach(values: np.ndarray, digits: str = ".4g") -> str:
    return span(values[np.isfinite(values)], digits)


def _beat(frequency: np.ndarray, order_share: np.ndarray) -> str:
    """Beat of the first bending triple at the first pose [s]."""
    bending = frequency[np.argsort(-order_share[:, 0])[:3]]
    return f"{1 / np.ptp(bending):.2g}" if np.ptp(bending) > 0 else "infinitely many"


def _border(chart: Map) -> str:
    """How the nearest link stands to its guide at the border: square to it, along it, or both."""
    near = chart.margin <= np.nanpercentile(chart.margin, 5)
    gamma = chart.gamma[near]
    high = np.pi / 2 - gamma.max(axis=-1) < gamma.min(axis=-1)
    return "square to" if high.all() else "along" if not high.any() else "square to, or along,"


def _decay(found: Findings) -> str:
    """How fast structural damping ends the first bending modes."""
    rate = found.study.link.first_damping * 2 * np.pi * np.nanmedian(found.map.bending)
    return f"damping ends it in about {1 / rate:.2g} s" if rate > 0 else "nothing damps it"


def _platform(found: Findings) -> list[str]:
    runs = found.platform
    drive, vibration = runs.rms(runs.drive), runs.rms(runs.vibration)
    rows = []
    for k, setting in enumerate(RUNS):
        for name, one in (("drive", drive[k]), *zip(LINK_LABELS, vibration[k], strict=True)):
            what = "drive error" if name == "drive" else f"vibration error, controlled: {name}"
            size = np.hypot(one[:, 0], one[:, 1])
            cells = (f"{1e9 * x:.3g}" for x in (*size, *one[:, 2]))
            rows.append([setting_label(setting), what, *cells])
    peak = np.abs(found.responses.value).max(axis=1)
    shown = [(OUTPUTS[i], i) for i in range(3)]
    fall = [
        [f"slider 1 to {name.split(' [')[0]}", *map(_number, peak[:, i, 0])] for name, i in shown
    ] + [
        ["platform y to " + OUTPUTS[i].split(" [")[0], *map(_number, peak[:, i, 4])] for i in (0, 4)
    ]
    return [
        "## Rigid and elastic",
        "",
        "The platform's error is split in two: what the same drive leaves on the same machine with "
        "rigid links, and what bending links add to that (figures 5, 6, 8, 10 show the sum). Rms:",
        "",
        *table(
            (
                "setting",
                "error",
                *(f"{what}, {w}" for what in ("centre [nm]", "φ [nrad]") for w in WINDOWS),
            ),
            rows,
        ),
        "",
        *(_split(setting_label(setting), drive[k], vibration[k]) for k, setting in enumerate(RUNS)),
        "",
        *_figure("platform"),
        *_figure("vibration"),
        "Largest values of the frequency responses to forces on slider and platform [m/N], sampled "
        "loop linearised at the path's first pose:",
        "",
        *table(("from, to", *(f"controlled: {name}" for name in LINK_LABELS)), fall),
        "",
        "A dash: the loop is unstable, or a force on the platform bends the links at once, for "
        "which there is no number here.",
        "",
        *_figure("responses"),
    ]


def _number(value: float) -> str:
    return f"{value:.3g}" if np.isfinite(value) else "-"


def _split(name: str, drive: np.ndarray, vibration: np.ndarray) -> str:
    """What the split says in one setting: arrays (windows, 3) and (4, windows, 3)."""
    parts = []
    for which, window in enumerate(WINDOWS):
        rigid, free = np.hypot(*drive[which, :2]), np.hypot(*vibration[0, which, :2])
        larger = "drive" if rigid > free else "vibration"
        change = np.hypot(*vibration[-1, which, :2]) / free - 1
        turn = vibration[-1, which, 2] / vibration[0, which, 2] - 1
        parts.append(
            f"{window}, the {larger} has the larger part of the centre's error, and control of "
            f"three links changes the vibration part by {_percent(change)} (φ: {_percent(turn)})"
        )
    return f"{name}: {'; '.join(parts)}. "


def _motion(found: Findings) -> list[str]:
    return [
        "## The machine moving",
        "",
        f"The last milliseconds of the {setting_label(RUNS[-1])} move and what is left after it, "
        "slowed down 50 times.",
        "",
        picture(ANIMATION, "the machine without control and with three links controlled"),
    ]
