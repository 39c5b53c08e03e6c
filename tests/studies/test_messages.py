"""Messages about files, word for word: what a file says, and what is wrong with it.

A message may change for the better: `python -m tests.studies.test_messages` writes them anew.
"""

import json
from pathlib import Path

import pytest

from studies.commission.spec import parse_measured
from studies.config import configure
from studies.errors import StudyError
from studies.fitting.spec import parse_fit
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.study.spec import parse_study
from studies.tuning.spec import parse_tuning

FILE = Path(__file__).with_name("messages.jsonl")
ROWS = [json.loads(line) for line in FILE.read_text(encoding="utf-8").splitlines()]
READERS = {
    "study": parse_study,
    "sweep": parse_sweep,
    "table": lambda data: build_table(parse_sweep(data)),
    "tune": parse_tuning,
    "fit": parse_fit,
    "commission": parse_measured,
}


def said(kind, data):
    with pytest.raises(StudyError) as caught:
        READERS[kind](data)
    return str(caught.value)


@pytest.mark.filterwarnings("ignore")  # of models that do not fit
@pytest.mark.parametrize("kind", READERS)
def test_messages_are_word_for_word_as_they_were(kind):
    rows = [(data, message) for one, data, message in ROWS if one == kind]
    assert len(rows) > 5
    assert [said(kind, data) for data, _ in rows] == [message for _, message in rows]


if __name__ == "__main__":
    configure()
    rows = [[kind, data, said(kind, data)] for kind, data, _ in ROWS]
    FILE.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
