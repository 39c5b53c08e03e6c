"""Cards of papers: their contract and the list."""

import re

import pytest

from studies.papers.card import FAILS, HOLDS, outcome_of
from studies.papers.catalogue import CARDS, NOTEBOOKS
from tests import TOP
from tests.studies.test_cli import refused


def test_cards_are_listed(capsys):
    said = refused(capsys, "paper")
    assert all(name in said for name in (*CARDS, *NOTEBOOKS))
    for path in NOTEBOOKS.values():
        assert path in said and (TOP / path).exists()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("zhang_2061", "--out", "OUT"), "WHAT = 'zhang_2061'; allowed: .*did you mean 'zhang_201"),
        (("rrr",), "WHAT = 'rrr'; allowed: .*did you mean 'rrr_2016'?"),
        (("zhang_2016",), "--out: name a folder"),
        (("geronel_2025", "--out", "OUT"), "no card; see notebooks/9_gauges"),
        (("gupta_2010",), "no card; see notebooks/10_placement"),
        (("rrr_2016",), "no card; see notebooks/11_are_links"),
        (("--out", "OUT"), "WHAT: missing; allowed: zhang_2016"),
    ],
)
def test_incomplete_requests_are_refused(capsys, arguments, message):
    assert re.search(message, refused(capsys, "paper", *arguments))


@pytest.mark.parametrize("card", CARDS.values(), ids=CARDS)
def test_a_card_says_what_it_tests(card):
    assert CARDS[card.name] is card
    assert card.claims and card.left_open and card.read
    texts = [claim.text for claim in card.claims]
    assert len({*texts}) == len(texts)
    assert all(x.text and x.quantity and x.condition for x in card.claims)


def test_outcomes():
    assert [outcome_of(x) for x in (True, False)] == [HOLDS, FAILS]
