"""What a comparison of laws and drives tells: which controller, and how sure that is."""

from __future__ import annotations

import numpy as np

from jaxmodel import status
from studies.laws import plots
from studies.laws.document import MARGINS, ControllerFigures, figures_of, order
from studies.laws.findings import LawFindings, beyond_budget, verdict
from studies.laws.judging import MOVES
from studies.laws.machines import spread_of
from studies.laws.ranking import CONFIDENCE
from studies.laws.tuning import AGREE, LATE, Tuned
from studies.show.listing import Rows
from studies.show.report import Chapter, Items, Report, chapter, drawing, machine
from studies.show.units import count_text, number
from studies.study.margin import delay_text, margin_text

HEADS = (
    "controller",
    "residual rms, geometric mean [µm]",
    "over the best (95 %)",
    "settling, median [ms]",
    "platform error while moving, geometric mean [µm]",
    "largest voltage [V]",
    "rms voltage, mean [V]",
    "control energy, mean [V² s]",
    "note",
)
FIGURE_TEXT = {"gain_margin": lambda x: margin_text(x, 3), "delay_margin": delay_text}
LOOP_HEADS = (
    "controller",
    "disk margin, worst [1]",
    "gain margin, worst [1]",
    "phase margin, worst [deg]",
    "delay margin, worst [samples]",
    "breaks first, on the machine with the least gain margin",
    "multiplications per sample",
    "tuned parameters",
)
TUNING_HEADS = (
    "candidate",
    "tuned parameters",
    "objective over the given design's",
    f"starting points within {100 * AGREE:.0f} % of the best",
    f"gain of the last {LATE} iterations",
    "at a bound",
)


def say(findings: LawFindings) -> Report:
    """What a comparison tells."""
    study, budget = findings.study, findings.budget
    return Report(
        title=f"{study.title or 'untitled study'}: which controller?",
        result=verdict(findings),
        question=f"""which control law should this machine have, if all of them may use the same
        voltage ({budget.voltage:.4g} V) and must keep the same disk margin
        ({budget.margin:.3g})?""",
        next_steps="""each tuned controller is a study file in this folder: `studies certify`
        certifies it, `studies export` writes it for a real-time controller.""",
        top=[drawing(plots.comparison, findings, name="laws"), drawing(plots.grid, findings)],
        chapters=[*_controllers(findings), _tunings(findings), _method(findings)],
        files={"Study file": study},
    )


def _controllers(findings: LawFindings) -> list[Chapter | None]:
    """The competition, best first, then the others; and their loops."""
    each = {k: figures_of(findings, k) for k in order(findings)}
    rows = [_row(findings, k, one) for k, one in each.items()]
    loops = [_loop_row(one) for one in each.values()]
    return [
        chapter("The controllers", Rows(list(HEADS), rows)),
        chapter("Their loops", Rows(list(LOOP_HEADS), loops)),
    ]


def _tunings(findings: LawFindings) -> Chapter | None:
    failed = [f"{one.candidate.name}: {one.reason}" for one in findings.failed]
    return chapter(
        "Their tunings",
        """Starting points that disagree, a gain that goes on and numbers at a bound say that longer
        tuning or wider bounds may do better: each controller's study file is a start for `studies
        tune`.""",
        Rows(list(TUNING_HEADS), [_tuning_row(findings, x) for x in findings.tuned]),
        "Not among them:" if failed else "",
        Items(failed),
    )


def _method(findings: LawFindings) -> Chapter | None:
    budget, noise = findings.budget, findings.study.electronics.adc_noise
    machines, moves = findings.judged.status.shape[1:]
    spread = (f"{name} within {x:.3g} %" for name, x in spread_of(findings.study).items())
    times = ", ".join(f"{share:.3g}" for share in MOVES)
    return chapter(
        "How they were compared",
        f"""Each law was tuned on the design's drive, each drive with the design's law, for residual
        vibration (drives also for the platform's error while moving) within the limits, on
        {count_text(budget.machines, "machine")}: {count_text(budget.starts, "starting point")} and
        {count_text(budget.iterations, "iteration")} for each. Combinations were not tuned again.
        Those that cannot keep the limits are listed, but not ranked.""",
        f"""All were then judged on {count_text(machines, "machine")} that none had been tuned on
        ({", ".join(spread)}, link by link where it is a link's), each in
        {count_text(moves, "move")} of {times} times the design's move time, each machine with its
        own noise ({number(noise, "V")} V rms at the converter). A ratio is the geometric mean over
        machines and moves; its interval ({100 * CONFIDENCE:.3g} %) comes from resampling the
        machines. "Tied" means that it includes 1.""",
        machine(findings.study),
    )


def _row(findings: LawFindings, k: int, one: ControllerFigures) -> list[str]:
    incidents = _incidents(findings.judged.status[k])
    parts = one.controller.reason, incidents, beyond_budget(findings, k)
    note = "; ".join(filter(None, parts))
    is_limited = one.peak_voltage >= findings.study.electronics.voltage_limit
    return [
        one.controller.name,
        number(one.residual_rms, "m"),
        _ratio(findings, k),
        number(one.settling_time, "s"),
        number(one.pose_error_peak, "m"),
        number(one.peak_voltage, "V") + (" (the limit)" if is_limited else ""),
        f"{one.rms_voltage:.3g}",
        f"{one.control_energy:.3g}",
        note or "-",
    ]


def _incidents(codes: np.ndarray) -> str:
    """What happened in how many runs, in words; "" if all are in order."""
    found, counts = np.unique(codes[codes != status.OK], return_counts=True)
    each = zip(found.tolist(), counts.tolist(), strict=True)
    return "; ".join(f"{status.REASONS[code]} in {n} of {codes.size} runs" for code, n in each)


def _loop_row(one: ControllerFigures) -> list[str]:
    texts = [FIGURE_TEXT.get(name, "{:.3g}".format)(x) for name, x in one.margins.items()]
    return [
        one.controller.name,
        *(["-"] * len(MARGINS) if one.products is None else texts),
        one.breaking or "-",
        "-" if one.products is None else str(one.products),
        str(one.controller.n_free),
    ]


def _tuning_row(findings: LawFindings, one: Tuned) -> list[str]:
    """What says how far a candidate's tuning has come."""
    cells = ["-"] * 4
    if one.quality is not None:
        found = one.quality
        cells = [
            f"{found.objective:.3f}",
            f"{found.n_alike} of {findings.budget.starts}",
            "-" if np.isnan(found.late_gain) else f"{100 * found.late_gain:.1f} %",
            ", ".join(found.at_bound) or "-",
        ]
    return [one.candidate.name, str(one.n_free), *cells]


def _ratio(findings: LawFindings, k: int) -> str:
    """Ratio to the best, with its interval, of a controller in the competition."""
    rows, ranking = findings.competing, findings.ranking
    if k not in rows or not np.isfinite(ranking.ratio[rows.index(k)]):
        return "-"
    place = rows.index(k)
    if place == ranking.best:
        return "1"
    return (
        f"{ranking.ratio[place]:.2f} ({ranking.low[place]:.2f} to {ranking.high[place]:.2f})"
        f"{', tied' if ranking.is_tied[place] else ''}"
    )
