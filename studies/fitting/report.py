"""The report of a fit: what was found, how well it is known, and what the data cannot tell."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from markupsafe import Markup

from studies.errors import printable
from studies.fitting.estimate import Fitted, is_at_bound, is_good
from studies.fitting.kinds.contract import Line, Numbers
from studies.fitting.plots import MOST
from studies.fitting.spec import number_unit
from studies.fitting.statistics import REGION, UNKNOWN, Answer, Direction, Misfit, region_rise
from studies.show.pages import old_page as page

#: Experiments in the report.
SHOWN = 5
#: Remedies of a misfit that are told.
SHOWN_REMEDIES = 3
#: Correlations from this size on are named [1].
STRONG = 0.95
#: The verdict on a fit without a fault.
GOOD = "The model explains the data within their noise, and every parameter is identifiable."


def summary(fitted: Fitted) -> str:
    """Some lines: the verdict, the values, and what else is to be known of them."""
    verdict, *others = statements(fitted)
    lines = [
        f"{name} = {value} +- {sigma} {unit} (95 %: {interval})".replace("  ", " ")
        for name, value, sigma, unit, interval, _ in value_rows(fitted)
    ]
    return "\n".join([verdict, *lines, *others])


def statements(fitted: Fitted) -> list[str]:
    """The verdict, then what else is to be known."""
    return [GOOD] * is_good(fitted) + sentences(fitted)


def report(fitted: Fitted, images: Path | None = None) -> str:
    """The page of a fit.

    Args:
        fitted: the fit.
        images: folder with its figures; None: a page without.
    """
    first, *others = statements(fitted)
    return page(
        "fitting/report.html",
        images,
        fitted.study,
        fitted=fitted,
        spec=fitted.spec,
        answer=fitted.answer,
        rows=value_rows(fitted),
        is_good=is_good(fitted),
        first=first,
        others_said=others,
        misfits=[_misfit(x) for x in fitted.answer.misfits],
        checks=[_misfit(x) for x in fitted.checks],
        others=_others(fitted),
        posterior=_posterior(fitted),
        single=_single(fitted),
        experiments=_experiments(fitted),
        own=fitted.spec.fit.next,
        unknown=_unknown(fitted),
        widest=" and ".join(fitted.names[k] for k in fitted.answer.directions[0].named()),
        has_diagram=any(
            isinstance(x.part, Numbers) and x.part.diagram is not None for x in fitted.comparisons
        ),
        lines=sum(isinstance(x.part, Line) for x in fitted.comparisons),
        kept=sum(not x.is_checked for x in fitted.comparisons),
        has_entries=any("[" in name for name in fitted.names),
        most=MOST,
        region=REGION,
        limit=region_rise(len(fitted.names)),
    )


def _unit(name: str) -> str:
    """Of a parameter, "" for 1."""
    unit = number_unit(name)
    return "" if unit == "1" else unit


def value_rows(fitted: Fitted) -> list[list[str]]:
    """Name, value, standard deviation, unit, 95 % interval, and where the value came to lie."""
    rows = []
    u = fitted.solution.best.u
    for k, name in enumerate(fitted.names):
        value, sigma = fitted.answer.values[k], fitted.answer.sigma[k]
        low, high = fitted.answer.interval[k]
        digits = _digits(value, sigma)
        ends = np.array(
            [fitted.spec.free.numbers[k].span.low, fitted.spec.free.numbers[k].span.high]
        )
        at = "interval ends at a bound" if np.isclose([low, high], ends, rtol=1e-9).any() else ""
        at = "at its bound" if is_at_bound(u[k]) else at
        if fitted.answer.sigma[k] >= 0.99 * UNKNOWN * abs(fitted.spec.free.slopes(u)[k]):
            at = "not identifiable"
        rows.append(
            [
                name,
                f"{value:.{digits}g}",
                f"{sigma:.2g}",
                _unit(name),
                f"{low:.{digits}g} to {high:.{digits}g}",
                at,
            ]
        )
    return rows


def _digits(value: float, sigma: float) -> int:
    """Significant digits of a value that show two of its standard deviation."""
    if sigma <= 0 or value == 0:
        return 6
    return int(np.clip(np.floor(np.log10(abs(value) / sigma)) + 3, 2, 10))


def sentences(fitted: Fitted) -> list[str]:
    """What a reader must know before he uses the values, the gravest first."""
    answer = fitted.answer
    lines = [*_rivals(fitted), *_remedies(fitted), *_unexplained(answer)]
    if answer.freedom == 0:
        lines.append(
            "There are as many unknowns as data: they are met whatever the model, which is not "
            "tested."
        )
    if answer.is_too_close:
        lines.append(
            f"The data are met more closely than their noise allows: chi square is "
            f"{answer.chi_square:.3g} with {answer.freedom} degrees of freedom. The stated noise "
            "is too large, and so are the uncertainties."
        )
    lines += [*undetermined(fitted), *_correlated(fitted), *_at_bounds(fitted)]
    lines += [cell(x) + "." for x in fitted.unpredicted]
    if fitted.fault:
        lines.append(f"The fitted study does not run as it is: {fitted.fault}.")
    if fitted.posterior is not None and not fitted.posterior.is_settled:
        worst = int(np.argmax(fitted.posterior.reduction))
        lines.append(
            f"The chains of samples do not agree yet, least on {fitted.names[worst]} (scatter "
            f"{fitted.posterior.reduction[worst]:.2f}, wanted: below 1.05); raise fit.samples."
        )
    if not fitted.solution.best.is_converged:
        lines.append("The search ended before it converged; raise fit.iterations.")
    if fitted.experiment_fault:
        lines.append(f"No next experiment could be computed: {fitted.experiment_fault}.")
    return lines


def _remedies(fitted: Fitted) -> list[str]:
    """What would mend a misfit."""
    if fitted.is_diagnosed and not fitted.remedies:
        return [
            "Nothing that was tried would mend it: the usual faults of measurements, fields of the "
            "machine that are fixed here, links that differ, more modes."
        ]
    return [
        f"Chi square would be {one.after:.4g} in place of {one.before:.4g} if this is so: "
        f"{cell(one.text)}."
        for one in fitted.remedies[:SHOWN_REMEDIES]
    ]


def _rivals(fitted: Fitted) -> list[str]:
    """That other optima are as good, and where the nearest is."""
    if not fitted.rivals:
        return []
    first, values = fitted.rivals[0], fitted.problem.free.values(fitted.rivals[0].u)
    low, high = fitted.answer.interval.T
    moved = np.flatnonzero((values < low) | (values > high))
    other = ", ".join(f"{fitted.names[k]} = {values[k]:.5g}" for k in moved)
    count = len(fitted.rivals)
    optima = f"{count} other optima lie" if count > 1 else "another optimum lies"
    what = "the best of them with" if count > 1 else "with"
    samples = " Samples are drawn about the best optimum alone." if fitted.posterior else ""
    return [
        f"Not identifiable: {optima} in the data's region of {100 * REGION:g} %, {what} {other} "
        f"(chi square rises by {fitted.solution.rise(first):.2g}; see the other optima). Measure "
        f"something in which they differ, at another pose or with shapes.{samples}"
    ]


def _unexplained(answer: Answer) -> list[str]:
    """Measurements whose residuals are not the stated noise."""
    lines = []
    bad = [x for x in answer.misfits if not x.is_noise and not x.is_correlated]
    if bad or not (answer.is_explained or answer.correlated):
        bad.sort(key=lambda x: -x.square / max(x.size, 1))
        which = f" Not met: {'; '.join(cell(x.name) for x in bad)}." if bad else ""
        lines.append(
            f"The model does not explain the data: chi square is {answer.chi_square:.4g} with "
            f"{answer.freedom} degrees of freedom.{which} Uncertainties assume a right model and "
            "are too small here; look at the residuals, at the model's bases and modes, and at "
            "the stated noise."
        )
    return lines + [
        f"The noise of {cell(one.name)} is correlated from one value to the next "
        f"({one.autocorrelation:.2f}), as of data sampled faster than their noise changes: the "
        f"values are not independent, and uncertainties are about {one.understated:.2g} times "
        f"those given here. Keep one value in {one.thin} of those fitted: by thin, or by shorter "
        "segments of a record."
        for one in (() if bad else answer.correlated)  # a wrong model correlates the others, too
    ]


def _at_bounds(fitted: Fitted) -> list[str]:
    """Numbers that would go further if they could."""
    lines = []
    for name, u, number in zip(
        fitted.names, fitted.solution.best.u, fitted.spec.free.numbers, strict=True
    ):
        if not is_at_bound(u):
            continue
        side, end = ("lower", number.span.low) if u < 0.5 else ("upper", number.span.high)
        value = f"{end:g} {_unit(name)}".rstrip()
        lines.append(
            f"{name} ended at its {side} bound, {value}: widen fit.free, or take the value as a "
            "limit."
        )
    return lines


def undetermined(fitted: Fitted) -> list[str]:
    """Sentences on parameters that are not identifiable, group by group."""
    lines = []
    for names, members in _groups(fitted.answer):
        if len(members) == 1:
            lines.append(describe_direction(members[0], fitted.names))
            continue
        if len(names) == len(members):
            lines.append(f"{_listed(fitted, names)} are not identifiable from these data.")
            continue
        count = len(names) - len(members)
        lines.append(
            f"{_listed(fitted, names)} are not identifiable from these data, which determine "
            f"{count} combination{'s' if count > 1 else ''} of these {len(names)} parameters. Fix "
            f"{len(members)} of them, or state what is known by mean and sigma."
        )
    return lines


def _groups(answer: Answer) -> list[tuple[set[int], list[Direction]]]:
    """Directions that are not identifiable, and their parameters; those that share some are one."""
    groups: list[tuple[set[int], list[Direction]]] = []
    for one in answer.undetermined:
        names, members = set(one.named()), [one]
        for other in [x for x in groups if x[0] & names]:
            names, members = names | other[0], [*other[1], *members]
            groups.remove(other)
        groups.append((names, members))
    return groups


def _listed(fitted: Fitted, names: set[int]) -> str:
    """ "a, b and c"."""
    every = [fitted.names[k] for k in sorted(names)]
    return f"{', '.join(every[:-1])} and {every[-1]}"


def describe_direction(direction: Direction, names: tuple[str, ...]) -> str:
    """What the data do not tell."""
    parts = direction.named()
    if len(parts) == 1:
        return f"{names[parts[0]]} is not identifiable from these data."
    sign = [("up" if direction.parts[k] > 0 else "down") for k in parts]
    moves = ", ".join(f"{names[k]} {s}" for k, s in zip(parts, sign, strict=True))
    listed = " and ".join([", ".join(names[k] for k in parts[:-1]), names[parts[-1]]])
    return (
        f"{listed} are not identifiable from these data: moved together ({moves}), they change "
        "the model's answers by less than the noise. Measure something else, "
        "fix one, or state what is known of it by mean and sigma."
    )


def _correlated(fitted: Fitted) -> list[str]:
    """Pairs that are hardly apart, but for those of one group that is not identifiable."""
    matrix, names = fitted.answer.correlation, fitted.names
    groups = [x for x, _ in _groups(fitted.answer)]
    return [
        f"{names[k]} and {names[i]} are strongly correlated ({matrix[i, k]:.3f}): a combination of "
        "both is known much better than either."
        for i in range(len(matrix))
        for k in range(i)
        if abs(matrix[i, k]) > STRONG and not any({i, k} <= x for x in groups)
    ]


def cell(name: str) -> str:
    """A user's name on one line, without control sequences."""
    return printable(" ".join(name.split()))


def _misfit(one: Misfit) -> list[str]:
    autocorrelation = "-" if np.isnan(one.autocorrelation) else f"{one.autocorrelation:.2f}"
    return [
        cell(one.name),
        str(one.size),
        f"{one.square / max(one.size, 1):.3g}",
        autocorrelation,
        "yes" if one.is_noise else Markup("<b>no</b>"),
    ]


def _single(fitted: Fitted) -> list[list[str]]:
    """Measured numbers that stand alone, and the model's."""
    rows = []
    for one in fitted.comparisons:
        part = one.part
        if isinstance(part, Line):
            continue
        notes = (*part.notes, *[""] * (len(part.labels) - len(part.notes)))
        columns = zip(*part[:4], part.away, notes, strict=True)
        for label, measured, model, sigma, far, note in columns:
            text = f"{measured:.6g}", f"{sigma:.2g}", f"{model:.6g}", f"{far:+.1f}"
            rows.append([cell(one.title), label, *text, note])
    return rows


def _others(fitted: Fitted) -> list[list[str]]:
    """Optima elsewhere, with the rise of their chi square."""
    rows: list[list[str]] = []
    for one in fitted.solution.others:
        values = fitted.spec.free.values(one.u)
        rows.append([f"{fitted.solution.rise(one):.3g}", *(f"{x:.4g}" for x in values)])
    return rows


def _posterior(fitted: Fitted) -> list[list[str]]:
    """Quantiles of the samples, and what they are worth."""
    if fitted.posterior is None:
        return []
    rows, samples = [], fitted.posterior
    for k, name in enumerate(fitted.names):
        digits = _digits(fitted.answer.values[k], fitted.answer.sigma[k])
        quantiles = np.quantile(samples.values[:, k], [0.025, 0.5, 0.975])
        text = [f"{x:.{digits}g}" for x in quantiles]
        rows.append([name, *text, f"{samples.effective[k]:.0f}", f"{samples.reduction[k]:.3f}"])
    return rows


def unknown_numbers(fitted: Fitted) -> dict[str, dict[str, float]]:
    """By measurement, what nobody knew of it: gain [1], delay [s], offset [its unit]."""
    each = (x for x in fitted.problem.measurements if x.unknown)
    return {x.name: x.found(fitted.answer.values) for x in each}


def _unknown(fitted: Fitted) -> list[list[str]]:
    rows = []
    for name, found in unknown_numbers(fitted).items():
        delay = f"{1e3 * found['delay']:.4g}" if "delay" in found else ""
        rest = [f"{found[x]:.4g}" if x in found else "" for x in ("gain", "offset")]
        rows.append([cell(name), rest[0], delay, rest[1]])
    return rows


def _experiments(fitted: Fitted) -> list[list[Any]]:
    before = float(np.sqrt(np.linalg.eigvalsh(fitted.answer.covariance)[-1]))
    rows = []
    for one in fitted.experiments[: max(SHOWN, fitted.spec.fit.next.count)]:
        pose = ", ".join(f"{x:.3g}" for x in one.pose)
        told = "yes" if one.tells_apart else "no"
        rows.append(
            [
                one.text,
                f"({pose})",
                f"{one.widest / before:.3g}",
                *([told] if fitted.rivals else []),
            ]
        )
    return rows
