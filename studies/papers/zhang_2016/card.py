"""The card: its runs on two machines, beside the paper's numbers.

One machine is fitted to the measurements, the other is the nominal one.
"""

from __future__ import annotations

import numpy as np

from studies.job import Job
from studies.papers.card import CardResult, PaperCard, PaperOutcome
from studies.papers.zhang_2016 import tables
from studies.papers.zhang_2016.cases import PaperCase, fitted_study, paper_cases, run_cases
from studies.papers.zhang_2016.claims import CLAIMS, LEFT_OPEN, judge
from studies.papers.zhang_2016.context import Context, Machines
from studies.papers.zhang_2016.measures import measure
from studies.papers.zhang_2016.say import say
from studies.papers.zhang_2016.store import paper_variables
from studies.show.listing import Rows
from studies.study.labels import describe
from studies.study.spec import Study, paper_study


def evaluate(fitted: Study, nominal: Study, cases: list[PaperCase], job: Job) -> Machines:
    """Run the cases.

    Args:
        fitted: the machine of the measurements, which runs the compared cases.
        nominal: the machine that runs all cases.
        cases: from `paper_cases`.
        job: whose phase says what is done.

    Raises:
        StudyError: as `run_cases`.
    """
    compared = _compared(cases)
    first = job.part("fitted machine", lambda: run_cases(fitted, compared, job.say))
    second = job.part("nominal machine", lambda: run_cases(nominal, cases, job.say))
    return Machines(
        Context("fitted machine", first, measure(first)),
        Context("nominal machine", second, measure(second)),
    )


def result_of(machines: Machines) -> CardResult:
    """What the card writes of its runs."""
    verdicts = judge(machines)
    return CardResult(
        study=machines.nominal.runs.study,
        outcome=PaperOutcome(
            card=CARD.name,
            title=CARD.title,
            source=CARD.source,
            read=CARD.read,
            claims=verdicts,
            left_open=CARD.left_open,
        ),
        tables=_tables(machines),
        made=say(CARD, verdicts, machines),
        stores={
            name: (context.runs.study, paper_variables(context.runs, context.measures))
            for name, context in zip(Machines._fields, machines, strict=True)
        },
    )


def _compared(cases: list[PaperCase]) -> list[PaperCase]:
    return [case for case in cases if case.is_compared]


def _tables(machines: Machines) -> dict[str, Rows]:
    """Every comparison with the paper in one table, and the outcome of every run."""
    compared = [
        *tables.frequency_rows(machines),
        *tables.table_1_rows(machines),
        *tables.settling_rows(machines),
        *tables.ratio_rows(machines),
        *tables.platform_rows(machines),
    ]
    runs = [
        [context.name, case.name, case.links_text, str(case.modes), describe(int(code))]
        for context in machines
        for case, code in zip(context.runs.cases, np.asarray(context.runs.status), strict=True)
    ]
    return {
        "comparison": Rows(["quantity", *tables.COLUMNS[1:]], compared),
        "runs": Rows(["machine", "case", "links", "modes", "status"], runs),
    }


def _run(job: Job) -> CardResult:
    return result_of(evaluate(fitted_study(), paper_study(), paper_cases(), job))


CARD = PaperCard(
    name="zhang_2016",
    title="active vibration control and coupled vibration of a 3-PRR with three flexible links",
    source=(
        "Q. Zhang et al., Active Vibration Control and Coupled Vibration Analysis of a Parallel "
        "Manipulator with Multiple Flexible Links, Shock and Vibration, 2016, article 7474085, "
        "doi:10.1155/2016/7474085"
    ),
    read="Read as a whole; numbers that stand in its figures only were not read off.",
    claims=CLAIMS,
    left_open=LEFT_OPEN,
    run=_run,
)
