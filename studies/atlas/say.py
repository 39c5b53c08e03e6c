"""What an atlas tells: which links to control, where the paper's statements hold, and why."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import numpy as np

from studies.atlas import figures
from studies.atlas.attribution import shapley
from studies.atlas.claims import NO_CHANGE, one_more_link, table_1_signs, two_links
from studies.atlas.findings import AtlasFindings
from studies.atlas.platform import LINK_LABELS, OUTPUTS
from studies.atlas.platform import SETTINGS as RUNS
from studies.atlas.plots import length_text
from studies.atlas.subsets import CHOICES, MATTERS, TARGETS, link_label, setting_label
from studies.atlas.workspace import MAP_MODES, Map
from studies.show.listing import Rows
from studies.show.report import Chapter, Drawing, Items, Report, chapter, drawing, machine
from studies.show.units import count_text, span
from studies.study.window import residual_delay

ALL_LINKS, PLATFORM = TARGETS.index("all links"), TARGETS.index("platform")


def say(findings: AtlasFindings) -> Report:
    """What an atlas tells."""
    study, count = findings.study, len(findings.choices.setting)
    is_stable = findings.responses.is_stable.all()
    modes = findings.choices.modes
    subsets = ""
    if findings.subsets is not None:
        settings = len(findings.labels(findings.subsets))
        subsets = f", and all subsets of {3 * modes} modes of links in {settings} of them"
    excite = """ Where modes 2 and up are to matter, excite them: `studies atlas pulse --out DIR`
    has an impulse on the sliders after its move."""
    return Report(
        title="Coupling atlas",
        result=[
            *_most_vibration(findings),
            "" if is_stable else "**The linearised loop is unstable: these are limit cycles.**",
            *(f"**Left out:** {text}" for text in findings.dropped),
        ],
        question=f"""{study.title}: which of the three links are worth controlling, which links help
        or hurt each other, and whether the paper's statements hold: the 8 choices of controlled
        links in {count_text(count, "setting")}{subsets}.""",
        next_steps=f"""control the links with the largest shares below; `studies sweep links` covers
        fewer choices in more settings, `studies certify DESIGN --out DIR` shows how far to trust
        the design.{excite if modes > 1 and not subsets else ""}""",
        top=[machine(study)],
        chapters=[
            _reading(findings),
            _choices(findings),
            _contributions(findings),
            _signs(findings),
            _steps(findings),
            _pairs(findings),
            _workspace(findings),
            _errors(findings),
            _responses(findings),
            chapter(
                "The machine in motion",
                f"""The last milliseconds of the move ({setting_label(RUNS[-1])}) and the residual
                vibration after it, slowed down by a factor of 50.""",
                Drawing(
                    figures.ANIMATION,
                    "The machine without control and with three links controlled",
                    None,
                ),
            ),
        ],
        files={"Study file": study},
    )


def _by_setting(findings: AtlasFindings, cells: Iterable[Iterable[str]]) -> list[list[str]]:
    """Row of each setting: its name, and its cells."""
    labels = findings.labels(findings.choices)
    return [[label, *row] for label, row in zip(labels, cells, strict=True)]


def _change(value: float) -> str:
    """A relative change in percent, with its sign."""
    text = f"{100 * value:+.1f}"
    return f"{text if float(text) else '0.0'} %"


def _verdict(kept: int, count: int) -> str:
    how = "does not hold" if kept == 0 else "holds in part"
    if kept >= 0.9 * count:
        how = "holds" if kept == count else "holds mostly"
    return f"**{how}**"


def _all_links(findings: AtlasFindings) -> np.ndarray:
    """Residual of the three links by choice of controlled links [m], (settings, 8)."""
    return np.sqrt(np.mean(findings.links.link**2, axis=-1))


def _most_vibration(findings: AtlasFindings) -> list[str]:
    """The answer for the setting with the most residual vibration."""
    rms = _all_links(findings)
    k = int(np.argmax(rms[:, 0]))
    free, controlled = length_text(rms[k, 0]), length_text(rms[k, 7])
    best = min((1, 2, 4), key=lambda subset: rms[k, subset])
    link = findings.links.link[k]  # (8, 3)
    worse = np.sum(one_more_link(findings.links).change[k, ALL_LINKS] > NO_CHANGE)
    neighbours = [
        100 * (link[1 << i, j] / link[0, j] - 1) for i in range(3) for j in range(3) if i != j
    ]
    return [
        f"residual of the three links {controlled} rms with all of them controlled ({free} without "
        f"control, {length_text(rms[k, best])} with the best single link, link {link_label(best)}),"
        f" in the setting that leaves most vibration ({findings.labels(findings.choices)[k]})",
        f"control of one link changes the residual of its neighbours by {span(neighbours, '+.0f')} "
        f"%; adding one more controlled link makes it worse in {worse or 'none'} of 12 steps",
    ]


def _reading(findings: AtlasFindings) -> Chapter | None:
    study, responses = findings.study, findings.responses
    times = [time for time, _ in findings.choices.setting]
    delays = [1e3 * residual_delay(study.change(motion__move_time=time)) for time in times]
    window = study.metrics
    ratios = "as in the study"
    if study.control.ratio_source == "own_run":
        ratios = "by (24) from each setting's uncontrolled run"
    stability = """The linearised sampled loop is stable at the path's first pose with no link, link
    1, links 1 and 2, and all links controlled"""
    if not responses.is_stable.all():
        names = zip(LINK_LABELS, responses.is_stable, strict=True)
        stability = f"""**Unstable**: the linearised sampled loop with controlled links
        {", ".join(name for name, is_fine in names if not is_fine)}; what follows describes limit
        cycles"""
    return chapter(
        "How to read it",
        f"""Gain factor {study.control.gain_factor:g}, ratios of efficient modal control {ratios}. A
        controlled link has its {count_text(findings.choices.modes, "mode")} controlled. Residual of
        a link: rms of its chord deflection over all stations and a window of
        {1e3 * window.residual_length:.4g} ms, from {span(delays)} ms after the reference
        trajectory; of the platform: rms error of its centre, which is still mostly what the drives
        leave of their own settling.""",
        f"""One ADC step corresponds to {length_text(findings.adc_step.max())} of mode 1. In
        settings marked † a link's residual is smaller than that even without control, and
        percentages of it mean little. {stability} (spectral radius at most
        {responses.radius.max():.5f}).""",
    )


def _choices(findings: AtlasFindings) -> Chapter | None:
    residuals = (map(length_text, row[CHOICES]) for row in _all_links(findings))
    return chapter(
        "Which links to control",
        "Residual of all three links, rms, by controlled links:",
        Rows(["setting", *map(link_label, CHOICES)], _by_setting(findings, residuals)),
        drawing(figures.subsets, findings),
        drawing(figures.helps, findings),
        drawing(figures.lattice, findings),
    )


def _contributions(findings: AtlasFindings) -> Chapter | None:
    """Shapley shares of links; and of modes, where all their subsets were run."""
    modes, subsets = findings.choices.modes, findings.subsets
    game, beyond = findings.links.removed()[:, ALL_LINKS], 100 * findings.beyond_first
    cells = (
        [*(f"{100 * x:.2f}" for x in row), f"{100 * total:.4g}", f"{change:.2g}"]
        for row, total, change in zip(shapley(game), game[:, -1], beyond, strict=True)
    )
    links = ["link 1", "link 2", "link 3"]
    rows: list[list[str]] = []
    drawn: list[Drawing] = []
    text = f"""Control of modes 2 and up beside mode 1 changes a mean square by up to
    {beyond.max():.2g} % of its value without control; subsets of modes are run where that is
    more than {100 * MATTERS:.4g} %."""
    if subsets is not None:
        labels = findings.labels(subsets)
        text += f""" Shapley shares of modes 1 to {modes} of each link, from all
        {2 ** (3 * modes)} subsets:"""
        shares = 100 * shapley(subsets.removed()[:, ALL_LINKS]).reshape(-1, 3, modes)
        rows = [
            [label, *(", ".join(f"{x:.2f}" for x in link) for link in share)]
            for label, share in zip(labels, shares, strict=True)
        ]
        drawn = [drawing(figures.mode_shares, findings), drawing(figures.interactions, findings)]
    return chapter(
        "Contributions of links",
        """Shapley shares of links in the mean square that control of all of them removes from all
        links, in percent of the mean square without control. Interactions indicate coupling.""",
        Rows(
            ["setting", *links, "removed by all", "modes 2 and up change at most"],
            _by_setting(findings, cells),
        ),
        drawing(figures.shares, findings),
        text if modes > 1 else "",
        Rows(["setting", *links], rows),
        *drawn,
    )


def _signs(findings: AtlasFindings) -> Chapter | None:
    signs = table_1_signs(findings.choices)
    on, paper, ours = signs.is_controlled, 100 * signs.paper, 100 * signs.ours
    agree, fallen = signs.agree[:, ~on], int(np.sum(ours[:, on] < 0))

    def cells(change: np.ndarray, agreeing: str) -> list[str]:
        return [
            f"{np.sum(change[on] < 0)} of {on.sum()}",
            span(change[on], ".1f"),
            agreeing,
            ", ".join(f"{x:+.1f}" for x in change[~on]),
        ]

    agreeing = (f"{row.sum()} of {row.size}" for row in agree)
    deeper = ""
    if np.all(ours[:, on] < paper[on]):
        deeper = ", all of them more than in the paper, since the gains add more damping here"
    heads = ["setting", "controlled: peaks that fall", "by [%]", "uncontrolled: same sign"]
    heads.append("link 3 with 1 and 2 controlled, links 2 and 3 with 1 controlled [%]")
    rows = [["paper", *cells(paper, "")], *_by_setting(findings, map(cells, ours, agreeing))]
    return chapter(
        "The paper's Table 1: signs",
        f"""Change of the spectral peak of mode 1 relative to no control: all three links with
        {"two modes" if findings.choices.modes > 1 else "mode 1"} each, links 1 and 2 with mode 1,
        link 1 with mode 1.""",
        Rows(heads, rows),
        f"""It {_verdict(fallen, ours[:, on].size)} for controlled links: {fallen} of
        {ours[:, on].size} fall{deeper}. Uncontrolled links: signs agree in {agree.sum()} of
        {agree.size} cases, with changes of up to {np.abs(ours[:, ~on]).max():.0f} % here and
        {np.abs(paper[~on]).max():.1f} % in the paper.""",
    )


def _steps(findings: AtlasFindings) -> Chapter | None:
    steps = one_more_link(findings.links)

    def cell(change: np.ndarray) -> str:
        worst = int(np.argmax(change))
        text = f"{np.sum(change > NO_CHANGE)} of {change.size}"
        if change[worst] <= NO_CHANGE:
            return text
        return f"{text} ({steps.labels[worst]}: {_change(change[worst])})"

    single = steps.change[:, :3] > NO_CHANGE
    count = steps.change[:, ALL_LINKS].size
    links, platform = (int(steps.rises[:, k].sum()) for k in (ALL_LINKS, PLATFORM))
    cells = (map(cell, one) for one in steps.change[:, [ALL_LINKS, PLATFORM]])
    return chapter(
        'The paper\'s "more links, better"',
        """The 12 steps from one choice of links to one with an additional link: how many increase
        the residual, and the largest increase.""",
        Rows(["setting", "all links", "platform"], _by_setting(findings, cells)),
        f"""It {_verdict(count - links, count)} for all links together ({links} of {count} steps
        make it worse), and {_verdict(count - platform, count)} for the platform ({platform} of
        {count}). Link by link, a step makes a single link worse in {single.sum()} of {single.size}
        cases; in {single[:, ~steps.is_controlled.T].sum()} of these that link is not
        controlled.{_at_drive(findings)}""",
    )


def _at_drive(findings: AtlasFindings) -> str:
    """Effect of control on link 1 at the drive's lowest mode, if it can be determined."""
    share, frequency = findings.modes.share[0, :, 3], findings.modes.frequency[0]
    at_drive = frequency[share > 0.5]
    if not len(at_drive) or not findings.responses.is_stable[[0, -1]].all():
        return ""
    at = int(np.argmin(np.abs(findings.responses.frequency - at_drive[0])))
    size = np.abs(findings.responses.value[:, at, 0, 0])
    return f""" At {at_drive[0]:.3g} Hz, the drive's lowest mode, control of all links multiplies
    the response of link 1 to slider 1 by {size[-1] / size[0]:.2f}: below the controlled modes the
    phase of the velocity estimate differs."""


def _pairs(findings: AtlasFindings) -> Chapter | None:
    pairs = two_links(findings.links)
    kept = int(np.sum(pairs.change < -0.5))
    return chapter(
        "The paper's two links: platform error down by more than 50 %",
        Rows(
            ["setting", *(f"links {label}" for label in pairs.labels)],
            _by_setting(findings, (map(_change, one) for one in pairs.change)),
        ),
        f"""It {_verdict(kept, pairs.change.size)}, in {kept} of {pairs.change.size} cases (changes
        of {span(100 * pairs.change, ".0f")} %).""",
    )


def _workspace(findings: AtlasFindings) -> Chapter | None:
    """Natural modes over the workspace, at the turn of the path's first pose."""
    chart, study = findings.map, findings.study
    turn = int(np.argmin(np.abs(chart.phi - findings.poses[0, 2])))
    cell = 1e4 * (chart.x[1] - chart.x[0]) * (chart.y[1] - chart.y[0])  # [cm2]
    areas = cell * np.isfinite(chart.margin).sum(axis=(1, 2))
    reach = ", ".join(
        f"{area:.0f} cm² at φ = {phi:.0f}°"
        for area, phi in zip(areas, np.degrees(chart.phi), strict=True)
    )
    rate = study.link.first_damping * 2 * np.pi * np.nanmedian(chart.bending)
    beat = _beat(findings.modes.frequency[0], findings.modes.order_share[0])
    passing = "no energy would pass from link to link"
    if beat is not None:
        passing = f"energy would pass from link to link and back in {beat:.2g} s"
    damping = "nothing damps the vibration"
    if rate > 0:
        damping = f"damping ends the vibration in about {1 / rate:.2g} s"
    return chapter(
        "Along the workspace",
        f"""Natural modes with the sliders held by their drives, {min(MAP_MODES, study.link.modes)}
        modes per link, no damping. The platform can reach {reach}; at the border of the workspace a
        link stands {_border(chart)} to its guide. At φ = {np.degrees(chart.phi[turn]):.0f}° the
        lowest mode lies at {_reach(chart.frequency[turn, ..., 0])} Hz, the first three bending
        modes at {_reach(chart.bending[turn])} Hz, {_reach(100 * chart.spread[turn])} % apart; the
        coupling of two links' first modes through platform and sliders is
        {_reach(100 * chart.coupling[turn], ".2f")} %. Without damping, {passing}; {damping}.""",
        drawing(figures.workspace, findings),
        drawing(figures.participation, findings),
        drawing(figures.modes, findings),
    )


def _reach(values: np.ndarray, digits: str = ".4g") -> str:
    """Smallest and largest value over the reachable poses."""
    return span(values[np.isfinite(values)], digits)


def _beat(frequency: np.ndarray, order_share: np.ndarray) -> float | None:
    """Beat of the first bending triple at the first pose [s], None if it has one frequency."""
    bending = frequency[np.argsort(-order_share[:, 0])[:3]]
    return 1 / np.ptp(bending) if np.ptp(bending) > 0 else None


def _border(chart: Map) -> str:
    """A link's angle to its guide at the border."""
    near = chart.margin <= np.nanpercentile(chart.margin, 5)
    gamma = chart.gamma[near]
    high = np.pi / 2 - gamma.max(axis=-1) < gamma.min(axis=-1)
    if high.all():
        return "perpendicular"
    return "perpendicular or parallel" if high.any() else "parallel"


def _rms(findings: AtlasFindings) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Rms errors of the platform due to drive, (3,), and vibration, (4, 3), by setting."""
    runs = findings.platform
    every = zip(RUNS, runs.rms(runs.drive), runs.rms(runs.vibration), strict=True)
    return ((setting_label(setting), drive, vibration) for setting, drive, vibration in every)


def _errors(findings: AtlasFindings) -> Chapter | None:
    rows, texts = [], []
    for setting, drive, vibration in _rms(findings):
        rows.append([setting, "drive error", *_error_texts(drive)])
        for links, error in zip(LINK_LABELS, vibration, strict=True):
            rows.append([setting, f"vibration error, controlled: {links}", *_error_texts(error)])
        centre = np.hypot(vibration[:, 0], vibration[:, 1])
        larger = "drive" if np.hypot(*drive[:2]) > centre[0] else "vibration"
        texts.append(
            f"{setting}: the {larger} error is the larger part at the centre, and control of all "
            f"links changes the vibration error by {_change(centre[-1] / centre[0] - 1)} (φ: "
            f"{_change(vibration[-1, 2] / vibration[0, 2] - 1)})"
        )
    return chapter(
        "Rigid and elastic",
        """The platform error has two parts: the drive error, which the same drive has on the same
        machine with rigid links, and the vibration error, which the bending of the links adds (the
        paper's figures 5, 6, 8 and 10 show the sum). Rms values:""",
        Rows(["setting", "error", "centre [nm]", "φ [nrad]"], rows),
        Items(texts),
        drawing(figures.platform, findings),
        drawing(figures.vibration, findings),
    )


def _error_texts(rms: np.ndarray) -> list[str]:
    """Errors of centre [nm] and turn [nrad], of (3,)."""
    return [f"{1e9 * x:.3g}" for x in (np.hypot(rms[0], rms[1]), rms[2])]


def _responses(findings: AtlasFindings) -> Chapter | None:
    peak = np.abs(findings.responses.value).max(axis=1)
    shown = [("slider 1", 0, i) for i in range(3)] + [("platform y", 4, i) for i in (0, 4)]
    rows = [
        [
            f"{name} to {OUTPUTS[i].split(' [')[0]}",
            *(f"{x:.3g}" if np.isfinite(x) else "-" for x in peak[:, i, source]),
        ]
        for name, source, i in shown
    ]
    return chapter(
        "Frequency responses",
        """Peak magnitudes of the responses to forces on slider and platform [m/N], by controlled
        links; sampled loop linearised at the path's first pose. A dash: the loop is unstable, or a
        force on the platform bends the links directly, a response that is not computed here.""",
        Rows(["from, to", *LINK_LABELS], rows),
        drawing(figures.responses, findings),
    )
