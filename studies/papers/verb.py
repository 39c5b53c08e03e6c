"""The verb `paper`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.papers.card import CardResult


@verb
def paper(
    what: str = "",
    out: str | Path | None = None,
    *,
    pdf: bool = False,
    resume: bool = False,
    progress: bool = True,
) -> CardResult:
    """Test what a paper claims: outcome of each claim, data, figures, open numbers.

    Args:
        what: name of a card; an error lists them.
        out: folder for the results.
        pdf: also write the figures as PDF.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        The outcome of each claim, and the numbers that decide.

    Raises:
        StudyError: no such card; the folder cannot be made or written to.

    Example:
        >>> paper("zhang_2016", "paper").table()  # doctest: +SKIP
    """
    from studies.job import checked_out, make_request, working
    from studies.papers.catalogue import find_card
    from studies.papers.run import DECISIVE, PHASES, examined

    card, out = find_card(what), checked_out(out)
    request = make_request({"card": card.name}, DECISIVE)
    with working("paper", out, request, PHASES, resume, progress) as job:
        return examined(card, job, pdf)
