"""The cards, by name."""

from __future__ import annotations

from studies.errors import StudyError, field_error, nearest
from studies.papers.card import PaperCard
from studies.papers.zhang_2016.card import CARD as ZHANG_2016

CARDS: dict[str, PaperCard] = {card.name: card for card in (ZHANG_2016,)}
#: Papers that a notebook examines.
NOTEBOOKS = {
    "geronel_2025": "notebooks/9_gauges_or_piezo.ipynb",
    "gupta_2010": "notebooks/10_placement_criteria.ipynb",
    "rrr_2016": "notebooks/11_are_links_coupled.ipynb",
}


def find_card(name: str) -> PaperCard:
    """The card of a name.

    Raises:
        StudyError: there is none.
    """
    if not name:
        notebooks = "; ".join(f"{paper}: {notebook}" for paper, notebook in NOTEBOOKS.items())
        raise StudyError(f"WHAT: missing; allowed: {', '.join(CARDS)}. Notebooks: {notebooks}")
    if name in NOTEBOOKS:
        raise StudyError(f"WHAT = {name!r}: no card; see {NOTEBOOKS[name]}")
    if name not in CARDS:
        papers = [*CARDS, *NOTEBOOKS]
        begun = next((paper for paper in papers if name and paper.startswith(name.lower())), "")
        raise field_error("WHAT", name, ", ".join(CARDS), hint=begun or nearest(name, papers))
    return CARDS[name]
