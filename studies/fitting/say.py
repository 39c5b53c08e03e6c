"""What a fit tells: its verdict, how well values are known, and what the data cannot tell."""

from __future__ import annotations

import numpy as np

from studies.errors import printable
from studies.fitting.estimate import Fitted, is_at_bound, is_good
from studies.fitting.kinds.contract import Line
from studies.fitting.plots import drawings
from studies.fitting.spec import named_unit, shown_unit, shown_value
from studies.fitting.statistics import REGION, UNKNOWN, Answer, Direction, Misfit, region_rise
from studies.show.listing import Rows
from studies.show.report import Chapter, Drawing, Report, chapter, machine
from studies.show.units import count_text

#: Experiments in the report.
SHOWN = 5
#: Remedies of a misfit that are told.
SHOWN_REMEDIES = 3
#: Correlations from this size on are named [1].
STRONG = 0.95
#: The verdict on a fit without a fault.
GOOD = "The model explains the data within their noise, and every parameter is identifiable."


def say(fitted: Fitted) -> Report:
    """What a fit tells."""
    drawn, is_fine = drawings(fitted), is_good(fitted)
    first, *others = [GOOD] * is_fine + sentences(fitted)
    proposed = "; the next experiment is proposed below" if fitted.experiments else ""
    next_steps = f"mend what is said above before the values are used{proposed}."
    if is_fine:
        next_steps = """in this folder, `studies simulate fitted.toml --out run.h5 --report` for the
        fitted machine, `studies tune fitted_tune.toml --out tuned` for a design that suits all
        machines that the data leave possible."""
    return Report(
        title=f"{fitted.spec.study.title or 'untitled study'}: fit",
        result=[first if is_fine else f"**{first}**", *others],
        question=_question(fitted),
        next_steps=next_steps,
        top=[machine(fitted.study), drawn.get("fit"), drawn.get("numbers")],
        chapters=[
            _values(fitted),
            _data(fitted, drawn),
            chapter("Correlations", drawn.get("correlations")),
            chapter("Profiles", drawn.get("profiles")),
            _samples(fitted, drawn),
            _unknown(fitted),
            _experiments(fitted),
        ],
        files={"Study file": fitted.study},
    )


def _question(fitted: Fitted) -> str:
    spec, kept = fitted.spec, sum(not x.is_checked for x in fitted.comparisons)
    held_out = f" (and {len(fitted.checks)} held out)" if fitted.checks else ""
    known = count_text(len(spec.priors), "parameter")
    beforehand = f" and what is known of {known} beforehand" if spec.priors else ""
    data = f"{count_text(kept, 'measurement')}{held_out}{beforehand}"
    return f"""{count_text(len(fitted.names), "parameter")} from {data}; multi-start from
    {count_text(fitted.solution.rated, "starting point")}, the best {spec.fit.refine} followed to
    the end."""


def value_rows(fitted: Fitted) -> Rows:
    """Name, value, standard deviation, unit, 95 % interval, and where the value came to lie."""
    rows, u, answer = [], fitted.solution.best.u, fitted.answer
    for k, name in enumerate(fitted.names):
        value, sigma, interval = answer.values[k], answer.sigma[k], answer.interval[k]
        span, digits = fitted.spec.free.numbers[k].span, _digits(value, sigma)
        is_cut = np.isclose(interval, [span.low, span.high], rtol=1e-9).any()
        at = "at its bound" if is_at_bound(u[k]) else "interval ends at a bound" * bool(is_cut)
        if sigma >= 0.99 * UNKNOWN * abs(fitted.spec.free.slopes(u)[k]):
            at = "not identifiable"
        factor, unit = shown_unit(name)
        low, high = (f"{factor * x:.{digits}g}" for x in interval)
        shown = f"{factor * value:.{digits}g}", f"{factor * sigma:.2g}", unit
        rows.append([name, *shown, f"{low} to {high}", at])
    return Rows(["parameter", "value", "sigma", "unit", "95 %", ""], rows)


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
    lines += [f"Not predicted: {cell(x)}." for x in fitted.unpredicted]
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
    other = ", ".join(
        f"{fitted.names[k]} = {shown_value(fitted.names[k], values[k], '.5g')}" for k in moved
    )
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
    for k, u in enumerate(fitted.solution.best.u):
        name, span = fitted.names[k], fitted.spec.free.numbers[k].span
        if is_at_bound(u):
            side, end = ("lower", span.low) if u < 0.5 else ("upper", span.high)
            lines.append(
                f"Parameter {name} ended at its {side} bound, {shown_value(name, end, 'g')}: widen "
                "fit.free, or take the value as a limit."
            )
    return lines


def undetermined(fitted: Fitted) -> list[str]:
    """Sentences on parameters that are not identifiable, group by group."""
    lines = []
    for places, members in _groups(fitted.answer):
        if len(members) == 1:
            lines.append(describe_direction(members[0], fitted.names))
            continue
        names, count = [fitted.names[k] for k in sorted(places)], len(places) - len(members)
        determined = (
            f", which determine {count_text(count, 'combination')} of these {len(names)} "
            f"parameters. Fix {len(members)} of them, or state what is known by mean and sigma"
        )
        more = determined if count else ""
        lines.append(f"Parameters {_listed(names)} are not identifiable from these data{more}.")
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


def _listed(names: list[str]) -> str:
    """ "a, b and c"."""
    return f"{', '.join(names[:-1])} and {names[-1]}"


def describe_direction(direction: Direction, names: tuple[str, ...]) -> str:
    """What the data do not tell."""
    parts = direction.named()
    if len(parts) == 1:
        return f"Parameter {names[parts[0]]} is not identifiable from these data."
    sign = [("up" if direction.parts[k] > 0 else "down") for k in parts]
    moves = ", ".join(f"{names[k]} {s}" for k, s in zip(parts, sign, strict=True))
    return (
        f"Parameters {_listed([names[k] for k in parts])} are not identifiable from these data: "
        f"moved together ({moves}), they change the model's answers by less than the noise. "
        "Measure something else, fix one, or state what is known of it by mean and sigma."
    )


def _correlated(fitted: Fitted) -> list[str]:
    """Pairs that are hardly apart, but for those of one group that is not identifiable."""
    matrix, names = fitted.answer.correlation, fitted.names
    groups = [x for x, _ in _groups(fitted.answer)]
    return [
        f"Parameters {names[k]} and {names[i]} are strongly correlated ({matrix[i, k]:.3f}): a "
        "combination of both is known much better than either."
        for i in range(len(matrix))
        for k in range(i)
        if abs(matrix[i, k]) > STRONG and not any({i, k} <= x for x in groups)
    ]


def cell(name: str) -> str:
    """A user's name on one line, without control sequences."""
    return printable(" ".join(name.split()))


def _values(fitted: Fitted) -> Chapter | None:
    others = f"""Other starting points led to other optima; their chi square is larger by the first
    column. By more than {region_rise(len(fitted.names)):.3g}, they lie outside the data's region of
    {100 * REGION:g} %:"""
    interval = "comes from the profiles below" if fitted.profiles else "is 1.96 sigma to each side"
    rows = _others(fitted)
    return chapter(
        "Values",
        value_rows(fitted),
        f"The interval {interval}, and ends at the bounds.",
        others if rows else None,
        Rows(["rise of chi square", *map(named_unit, fitted.names)], rows),
    )


def _others(fitted: Fitted) -> list[list[str]]:
    """Optima elsewhere, with the rise of their chi square."""
    rows, factors = [], [shown_unit(name)[0] for name in fitted.names]
    for one in fitted.solution.others:
        shown = fitted.spec.free.values(one.u) * factors
        rows.append([f"{fitted.solution.rise(one):.3g}", *(f"{x:.4g}" for x in shown)])
    return rows


def _data(fitted: Fitted, drawn: dict[str, Drawing]) -> Chapter | None:
    heads = ["measurement", "values", "chi square/value (noise: 1)"]
    heads += ["correlation of neighbours (noise: 0)", "like noise"]
    misfits = [_misfit(x) for x in fitted.answer.misfits]
    misfits += [_misfit(x, " (held out)") for x in fitted.checks]
    numbers = []
    for one in fitted.comparisons:
        part = one.part
        if isinstance(part, Line):
            continue
        notes = (*part.notes, *[""] * (len(part.labels) - len(part.notes)))
        columns = zip(*part[:4], part.away, notes, strict=True)
        for label, measured, model, sigma, far, note in columns:
            text = f"{measured:.6g}", f"{sigma:.2g}", f"{model:.6g}", f"{far:+.1f}"
            numbers.append([cell(one.title), label, *text, note])
    more = ["measurement", "value", "measured", "sigma", "model", "residual [sigma]", ""]
    return chapter(
        "Data and model",
        Rows(heads, misfits),
        Rows(more, numbers),
        drawn.get("stabilisation"),
    )


def _misfit(one: Misfit, which: str = "") -> list[str]:
    neighbours = "-" if np.isnan(one.autocorrelation) else f"{one.autocorrelation:.2f}"
    square = f"{one.square / max(one.size, 1):.3g}"
    is_noise = "yes" if one.is_noise else "no"
    return [cell(one.name) + which, str(one.size), square, neighbours, is_noise]


def _samples(fitted: Fitted, drawn: dict[str, Drawing]) -> Chapter | None:
    if fitted.posterior is None:
        return None
    rows, samples = [], fitted.posterior
    for k, name in enumerate(fitted.names):
        digits = _digits(fitted.answer.values[k], fitted.answer.sigma[k])
        quantiles = np.quantile(samples.values[:, k], [0.025, 0.5, 0.975]) * shown_unit(name)[0]
        worth = f"{samples.effective[k]:.0f}", f"{samples.reduction[k]:.3f}"
        rows.append([named_unit(name), *(f"{x:.{digits}g}" for x in quantiles), *worth])
    heads = ["parameter", "2.5 %", "50 %", "97.5 %", "independent samples", "scatter of chains"]
    return chapter(
        "Samples",
        f"""{count_text(len(samples.values), "sample")} from the posterior. Chains that agree have a
        scatter below 1.05.""",
        drawn.get("samples"),
        Rows(heads, rows),
    )


def unknown_numbers(fitted: Fitted) -> dict[str, dict[str, float]]:
    """By measurement, what nobody knew of it: gain [1], delay [s], offset [its unit]."""
    each = (x for x in fitted.problem.measurements if x.unknown)
    return {x.name: x.found(fitted.answer.values) for x in each}


def _unknown(fitted: Fitted) -> Chapter | None:
    rows = []
    for name, found in unknown_numbers(fitted).items():
        units = ("gain", 1.0), ("delay", 1e3), ("offset", 1.0)
        texts = (f"{factor * found[x]:.4g}" if x in found else "" for x, factor in units)
        rows.append([cell(name), *texts])
    heads = ["measurement", "gain", "delay [ms]", "offset"]
    return chapter("Unknown numbers of measurements", Rows(heads, rows))


def _experiments(fitted: Fitted) -> Chapter | None:
    if not fitted.experiments:
        return None
    own, rows = fitted.spec.fit.next, []
    before = float(np.sqrt(np.linalg.eigvalsh(fitted.answer.covariance)[-1]))
    for one in fitted.experiments[: max(SHOWN, own.count)]:
        pose = f"({', '.join(f'{x:.3g}' for x in one.pose)})"
        told = ["yes" if one.tells_apart else "no"] if fitted.rivals else []
        rows.append([one.text, pose, f"{one.widest / before:.3g}", *told])
    heads = ["measurement", "pose (m, m, rad)", "sigma then/now"]
    widest = " and ".join(fitted.names[k] for k in fitted.answer.directions[0].named())
    at_once = " All of these at once: each sigma is that after all of them."
    return chapter(
        "Next experiment",
        f"""What would narrow most the least certain parameters: {widest}. Responses run from 85 to
        115 % of the first modes' frequencies with {own.sigma_percent:.3g} % noise; frequencies are
        good to 0.3 %, damping ratios to 10 %.{at_once if own.count > 1 else ""}""",
        Rows([*heads, *["excludes other optima"] * bool(fitted.rivals)], rows),
    )
