"""Cards of papers: their contract, the list, and what each card finds, on small batches."""

import re

import pytest

from studies.papers.card import FAILS, HOLDS, depends_on, outcome_of
from studies.papers.catalogue import CARDS
from tests.test_cli import refused, run


def test_cards_are_listed(capsys):
    code, out, err = run(capsys, "paper")
    assert (code, err) == (0, "")
    assert [line.partition(":")[0] for line in out.splitlines()] == list(CARDS)


@pytest.mark.parametrize(
    "arguments, message",
    [
        (("zhang_2061", "--out", "OUT"), "NAME = 'zhang_2061'; allowed: .*did you mean 'zhang_201"),
        (("zhang_2016",), "--out: missing"),
        (("--out", "OUT"), "NAME: missing; allowed: zhang_2016"),
    ],
)
def test_incomplete_requests_are_refused(capsys, arguments, message):
    assert re.search(message, refused(capsys, "paper", *arguments))


@pytest.mark.parametrize("card", CARDS.values(), ids=CARDS)
def test_a_card_says_what_it_tests(card):
    assert CARDS[card.name] is card and card.work > 0
    assert card.claims and card.left_open and card.read
    texts = [claim.text for claim in card.claims]
    assert len({*texts}) == len(texts)
    assert all(all(claim) for claim in card.claims)


def test_outcomes():
    assert [outcome_of(x) for x in (True, False)] == [HOLDS, FAILS]
    assert depends_on("the mass", "holds below 1 kg") == "depends on the mass: holds below 1 kg"
