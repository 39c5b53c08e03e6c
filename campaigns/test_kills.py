"""Kills at random moments: the next call of the command leaves what an uninterrupted one leaves."""

import numpy as np
import pytest

from campaigns.kills import Whole, contents, half_done, run_campaign, same

#: Kills by kind of command in the long campaign.
COUNTS = {
    "sweep": 10,
    "extension": 8,
    "sweep, empty cache": 3,
    "sweep, local workers": 5,
    "sweep that keeps": 14,
    "tune": 8,
    "fit": 5,
    "commission": 20,
    "simulate": 4,
    "plant": 4,
    "export": 6,
    "certify": 4,
    "compare": 2,
    "paper": 2,
    "twin": 2,
    "verify": 2,
    "atlas": 2,
    "plot": 3,
    "explore": 3,
    "client": 6,
    "worker": 8,
    "frozen worker": 3,
    "scheduler": 3,
    "poisoned chunk": 2,
    "two at once": 3,
}


def check(folder, seed, counts):
    """Run the campaign and print its table."""
    tallies = run_campaign(folder, seed, counts)
    for kind, tally in tallies.items():
        print(f"{kind}: {tally.kills} kills, {tally.equal} equal, {tally.leftovers} left over")
    faults = [fault for tally in tallies.values() for fault in tally.faults]
    assert not faults, "\n".join(map(str, faults))
    assert {kind: tally.kills for kind, tally in tallies.items()} == counts
    assert {kind: tally.equal for kind, tally in tallies.items()} == counts


def test_a_killed_command_is_run_again(tmp_path):
    check(tmp_path, 0, {"sweep": 1, "plant": 1})


@pytest.mark.long
@pytest.mark.timeout(5400)
def test_a_hundred_kills(tmp_path):
    assert sum(COUNTS.values()) >= 100
    check(tmp_path, 1, COUNTS)


# --- the campaign sees faults ---------------------------------------------------------------------


def test_numbers_are_compared_to_twelve_digits():
    x = {"a": np.array([1.0, np.nan, np.inf, 0.0]), "git": "one"}
    assert same(x, {"a": x["a"] * (1 + 1e-14), "git": "other"})
    for other in (x["a"] * (1 + 1e-11), x["a"] + 1e-11, np.nan_to_num(x["a"], posinf=np.inf)):
        assert not same(x, {"a": other})
    assert not same(x, {"a": x["a"][:2]}) and not same(x, {})


def test_a_page_without_its_files_is_a_fault(tmp_path):
    for name in ("report.html", "a.txt", "b.txt"):
        (tmp_path / name).write_text(f"new {name}")
    new = contents(tmp_path)
    old = {name: text.replace(b"new", b"old") for name, text in new.items()}
    whole = Whole(new, set(new), old, tmp_path, 1.0, 3)
    assert not half_done(tmp_path, whole)
    (tmp_path / "a.txt").write_text("old a.txt")
    (fault,) = half_done(tmp_path, whole)
    assert fault == "report.html is there, but ['a.txt'] are not of it"
    (tmp_path / "report.html").unlink()
    assert not half_done(tmp_path, whole)
    (tmp_path / "a.txt").write_text("half")
    assert half_done(tmp_path, whole) == ["neither old nor new: a.txt"]
