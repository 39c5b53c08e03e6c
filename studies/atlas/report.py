"""`report.md` of the atlas: where the paper's statements hold, and the numbers behind it."""

from __future__ import annotations

import numpy as np

from studies.atlas.attribution import shapley
from studies.atlas.claims import NO_CHANGE, one_more_link, table_1_signs, two_links
from studies.atlas.figures import ANIMATION, FIGURES
from studies.atlas.findings import Findings
from studies.atlas.platform import LINK_SETS, OUTPUTS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.plots import length_text
from studies.atlas.subsets import TARGETS, WINDOWS, link_label, setting_label
from studies.atlas.workspace import MAP_MODES
from studies.pages import literal, picture, table
from studies.report_context import span

LATE = WINDOWS.index("late")


def report(found: Findings, dropped: list[str]) -> str:
    """Text of the report, in Markdown.

    Args:
        found: everything.
        dropped: settings that are left out, and why.
    """
    sections = (_head, _claims, _subsets, _shares, _workspace, _platform, _motion)
    lines = [line for section in sections for line in (*section(found), "")]
    lines[2:2] = [line for text in dropped for line in (f"**Left out:** {text}", "")]
    return "\n".join(lines)


def _figure(name: str) -> list[str]:
    return [picture(f"{name}.png", FIGURES[name].caption), ""]


def _percent(value: float) -> str:
    return f"{100 * value:+.1f} %"


def _head(found: Findings) -> list[str]:
    study, subsets = found.study, found.subsets
    count = subsets.status.shape[-1]
    delay, length = study.metrics.residual_delay, study.metrics.residual_length
    return [
        "# Coupling atlas", "",
        f"{literal(study.title)}: {count} subsets of controlled links and modes "
        f"({subsets.modes} a link), "
        f"{len(subsets.setting)} settings of move time and shaper, {subsets.status.size} runs; "
        f"gain factor {study.control.gain_factor:g}, ratios "
        + ("by (24) from each setting's uncontrolled run."
           if study.control.ratio_source == "own_run" else "as given."), "",
        f"Two windows: *whole* is the design's residual window, {length:g} s from {delay:g} s "
        "after the command, in which the sliders' drive still settles at first and bends the links "
        "with it; *late* is that without its first third, the links' own vibration. Residual of a "
        "link: rms of its chord deflection over the window and all stations; of the platform: rms "
        "error of its centre. Tables show the late window where they name none.", "",
        f"One ADC step is {length_text(found.adc_step.max())} of mode 1. Where all that is left "
        "without control is less (marked †), the controller hardly sees it, and percentages say "
        "little.",
    ]  # fmt: skip


def _setting(found: Findings, k: int) -> str:
    """A setting in words, marked where the ADC hardly sees what is left without control."""
    is_small = found.subsets.link[k, LATE, 0].max() < found.adc_step.max()
    return setting_label(found.subsets.setting[k]) + (" †" if is_small else "")


def _claims(found: Findings) -> list[str]:
    return [
        "## Where the paper's statements hold", "",
        *_table_1(found), "", *_more_links(found), "", *_halved(found),
    ]  # fmt: skip


def _table_1(found: Findings) -> list[str]:
    signs = table_1_signs(found.subsets)
    on = signs.is_controlled
    rows = []
    for k, (ours, agree) in enumerate(zip(signs.ours, signs.agree, strict=True)):
        rows.append([
            _setting(found, k), f"{int(np.sum(ours[on] < 0))} of {on.sum()}",
            span(100 * ours[on], ".1f"), f"{int(agree[~on].sum())} of {np.sum(~on)}",
            ", ".join(f"{100 * x:+.1f}" for x in ours[~on]),
        ])  # fmt: skip
    paper = signs.paper
    rows.insert(0, [
        "paper", f"{int(np.sum(paper[on] < 0))} of {on.sum()}", span(100 * paper[on], ".1f"), "",
        ", ".join(f"{100 * x:+.1f}" for x in paper[~on]),
    ])  # fmt: skip
    falls = bool(np.all(signs.ours[:, on] < 0))
    largest = np.abs(signs.ours[:, ~on]).max()
    return [
        "### Table 1: signs", "",
        "Change of the spectral peak of mode 1 against no control, as in Table 1: three links with "
        "two modes each, links 1 and 2 and link 1 with mode 1.", "",
        *table(
            ("setting", "controlled links fall", "by [%]", "uncontrolled: same sign as the paper",
             "link 3 with 1 and 2, links 2 and 3 with 1 [%]"), rows,
        ), "",
        ("**Holds** for controlled links: all of them fall. " if falls
         else "**Does not hold everywhere** for controlled links. ")
        + f"Signs of the uncontrolled ones agree in {int(signs.agree[:, ~on].sum())} of "
        f"{signs.agree[:, ~on].size} cases; they depend on the move. Our uncontrolled links change "
        f"by up to {100 * largest:.0f} %, the paper's by "
        f"{100 * np.abs(paper[~on]).max():.1f} %; our controlled ones fall further because the "
        "same gains add far more damping here (docs/theory.md).",
    ]  # fmt: skip


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
                    + (f" ({steps.labels[worst]}: {_percent(change[worst])})"
                       if change[worst] > NO_CHANGE else "")
                )  # fmt: skip
        rows.append([_setting(found, k), *cells])
    late = steps.rises[:, LATE, [TARGETS.index("all links"), TARGETS.index("platform")]]
    is_worse = steps.change[:, LATE, :3] > NO_CHANGE
    left_alone = int(is_worse[:, ~steps.is_controlled.T].sum())
    verdict = "**Holds**" if not late.any() else "**Holds mostly**"
    return [
        "### \"More links, better\"", "",
        "Each of the 12 steps from one choice of links to one with a link more: how many make it "
        "worse, and the worst of them.", "",
        *table(("setting", "whole: all links", "whole: platform", "late: all links",
                "late: platform"), rows), "",
        f"{verdict} for the links' own vibration taken together (late window): "
        f"{int(late[:, 0].sum())} of {12 * len(late)} steps make the links worse, "
        f"{int(late[:, 1].sum())} the platform. **Does not hold** link by link: "
        f"in {int(is_worse.sum())} of {is_worse.size} cases a step makes a single link worse, "
        f"{left_alone} times one that is not controlled. Nor does it hold while the drive settles "
        "(whole window): there the links bend with the drive, far below their own frequency, where "
        f"the velocity estimate has another phase: at {found.modes.frequency[0, 0]:.3g} Hz, the "
        "drive's lowest mode, control of all links multiplies the response of link 1 to slider 1 "
        f"by {_below(found):.2f}.",
    ]  # fmt: skip


def _below(found: Findings) -> float:
    """Response of link 1 to slider 1 at the drive's lowest mode, controlled over uncontrolled."""
    at = int(np.argmin(np.abs(found.responses.frequency - found.modes.frequency[0, 0])))
    size = np.abs(found.responses.value[:, at, 0, 0])
    return float(size[-1] / size[0])


def _halved(found: Findings) -> list[str]:
    halved = two_links(found.subsets)
    rows = []
    for k in range(len(found.subsets.setting)):
        cells = [" / ".join(_percent(x) for x in halved.change[k, w]) for w in range(len(WINDOWS))]
        rows.append([_setting(found, k), *cells])
    late, whole = halved.change[:, LATE], halved.change[:, 0]
    return [
        "### Two links controlled: platform error down by more than 50 %", "",
        *table(("setting", *(f"{w}: links {', '.join(halved.labels)}" for w in WINDOWS)), rows),
        "",
        f"**Holds in part**: the platform's late vibration falls by more than 50 % in "
        f"{int(np.sum(late < -0.5))} of {late.size} cases (by {span(-100 * late, '.0f')} %). The "
        f"error in the whole window changes by {span(100 * whole, '.2g')} %: it is the drive's, "
        "which the patches do not reach.",
    ]  # fmt: skip


def _subsets(found: Findings) -> list[str]:
    subsets = found.subsets
    chosen = subsets.link_subsets
    lines = ["## Which links to control", ""]
    for window, name in enumerate(WINDOWS):
        rms = np.sqrt(np.mean(subsets.link[:, window, chosen] ** 2, axis=-1))
        rows = [[_setting(found, k), *(length_text(x) for x in row)] for k, row in enumerate(rms)]
        header = ("setting", *(link_label(k) for k in range(8)))
        lines += [f"Residual of all three links, rms, {name} window, by controlled links:", "",
                  *table(header, rows), ""]  # fmt: skip
    return lines + _figure("subsets") + _figure("helps") + _figure("lattice")


def _shares(found: Findings) -> list[str]:
    subsets = found.subsets
    game = subsets.removed()[:, LATE, TARGETS.index("all links")]
    share = shapley(game)
    rows = []
    for k, (one, total) in enumerate(zip(share, game[:, -1], strict=True)):
        by_link = one.reshape(3, -1).sum(axis=1)
        beyond = one.reshape(3, -1)[:, 1:]
        rows.append([
            _setting(found, k), *(f"{100 * x:.2f}" for x in by_link),
            f"{100 * np.abs(beyond).sum():.2f}", f"{100 * one.sum():.6f}", f"{100 * total:.6f}",
        ])  # fmt: skip
    return [
        "## Who contributes what", "",
        "Shapley shares of links and modes in the mean square that control of all of them takes "
        "away from all links (late window), in percent of what is there without control. Mean "
        "squares of motions that do not touch add up, so interactions are coupling.", "",
        *table(("setting", "link 1", "link 2", "link 3", "modes 2 and up, sizes added",
                "sum of shares", "removed by all"), rows), "",
        *_figure("shares"), *_figure("interactions"),
    ]  # fmt: skip


def _workspace(found: Findings) -> list[str]:
    chart, modes = found.map, found.modes
    turn = int(np.argmin(np.abs(chart.phi - found.poses[0, 2])))
    spread, coupling = (100 * x[turn] for x in (chart.spread, chart.coupling))
    reach = np.isfinite(chart.margin).mean(axis=(1, 2))
    step = (chart.x[1] - chart.x[0]) * (chart.y[1] - chart.y[0])
    area = 1e4 * reach * chart.margin[0].size * step
    return [
        "## Along the workspace", "",
        f"Natural modes with the sliders on their drive, {MAP_MODES} modes a link, no damping. "
        "The platform can reach "
        + ", ".join(f"{a:.0f} cm² at φ = {np.degrees(p):.0f}°"
                    for a, p in zip(area, chart.phi, strict=True))
        + "; beyond it a link stands square to its guide. "
        f"At φ = {np.degrees(chart.phi[turn]):.0f}° the lowest mode lies at "
        f"{_reach(chart.frequency[turn, ..., 0])} Hz, the three first bending modes at "
        f"{_reach(chart.bending[turn])} Hz, {_reach(spread)} % apart; coupling of two links' first "
        f"modes through platform and sliders is {_reach(coupling, '.2f')} %. So weak a coupling "
        "shows all the same, because the links have one frequency: energy goes from link to link "
        f"in beats of {_beat(modes.frequency[0], modes.order_share[0])} s, of which the links' "
        f"damping lets the first {_decay(found)} s be seen.", "",
        *_figure("workspace"), *_figure("participation"), *_figure("modes"),
    ]  # fmt: skip


def _reach(values: np.ndarray, digits: str = ".4g") -> str:
    return span(values[np.isfinite(values)], digits)


def _beat(frequency: np.ndarray, order_share: np.ndarray) -> str:
    """Beat of the first bending triple at the first pose [s]."""
    bending = frequency[np.argsort(-order_share[:, 0])[:3]]
    return f"{1 / np.ptp(bending):.2g}" if np.ptp(bending) > 0 else "infinitely many"


def _decay(found: Findings) -> str:
    """Time in which the first bending mode falls to 1/e by structural damping [s]."""
    rate = found.study.link.damping_ratio * 2 * np.pi * found.map.bending
    return f"{1 / np.nanmedian(rate):.2g}" if found.study.link.damping_ratio > 0 else "infinite"


def _platform(found: Findings) -> list[str]:
    runs = found.platform
    drive, vibration = runs.rms(runs.drive), runs.rms(runs.vibration)
    names = [link_label(sum(1 << i for i in range(3) if links[i])) for links in LINK_SETS]
    rows = []
    for k, setting in enumerate(RUNS):
        for name, one in (("drive", drive[k]), *zip(names, vibration[k], strict=True)):
            what = "drive error" if name == "drive" else f"vibration error, controlled: {name}"
            size = np.hypot(one[:, 0], one[:, 1])
            cells = (f"{1e9 * x:.3g}" for x in (*size, *one[:, 2]))
            rows.append([setting_label(setting), what, *cells])
    peak = np.abs(found.responses.value).max(axis=1)
    shown = [(OUTPUTS[i], i) for i in range(3)]
    fall = [
        [f"slider 1 to {name.split(' [')[0]}", *(f"{x:.3g}" for x in peak[:, i, 0])]
        for name, i in shown
    ] + [
        ["platform y to " + OUTPUTS[i].split(" [")[0], *(f"{x:.3g}" for x in peak[:, i, 4])]
        for i in (0, 4)
    ]
    return [
        "## Rigid and elastic", "",
        "The platform's error is split in two: what the same drive leaves on the same machine with "
        "rigid links, and what bending links add to that (figures 5, 6, 8, 10 show the sum). Rms:",
        "",
        *table(("setting", "error", *(f"{what}, {w}" for what in ("centre [nm]", "φ [nrad]")
                                      for w in WINDOWS)), rows), "",
        "At first the drive's error is by far the larger part, and control of the links leaves it "
        "as it is. Late, only the links' vibration is left, and control takes it away; control of "
        "one or two links may turn the platform more than before, because what the links did to "
        "it in step no longer cancels out.", "",
        *_figure("platform"), *_figure("vibration"),
        "Largest values of the frequency responses to forces on slider and platform [m/N], sampled "
        "loop linearised at the path's first pose:", "",
        *table(("from, to", *(f"controlled: {name}" for name in names)), fall), "",
        *_figure("responses"),
    ]  # fmt: skip


def _motion(found: Findings) -> list[str]:
    return [
        "## The machine moving", "",
        f"The last milliseconds of the {setting_label(RUNS[-1])} move and what is left after it, "
        "slowed down 50 times.", "",
        picture(ANIMATION, "the machine without control and with three links controlled"),
    ]  # fmt: skip
