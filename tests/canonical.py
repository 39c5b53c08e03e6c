"""Three studies that tests of flows, files, reports and messages share, so that their programs are
compiled once: `TINY`, `MACHINE` and the default, `studies.paper_study()`.

Programs depend on a study's sizes (modes, samples, stations) and on which parts it has. A test that
needs another gain, payload or title changes these and keeps the sizes; other durations are those of
`SAMPLES`. Tests of physics keep what they need.
"""

from __future__ import annotations

import copy
from typing import Any

from studies.study.spec import Study
from studies.study.template import toml_text
from tests.bare import parse_study

HOME = [0.0, 0.0, 0.5235987755982988]
#: Samples of runs in tests, at 10 kHz; the default study has 8,000.
SAMPLES = (200, 500, 2000)


def _move(length: float, time: float) -> dict[str, Any]:
    """Along y from home [m], in so long [s]."""
    return {"waypoints": [HOME, [0.0, length, HOME[2]]], "move_time": time}


#: Two modes, 200 samples: 0.5 mm in 10 ms.
TINY: dict[str, Any] = {
    "run": {"duration": 0.02},
    "link": {"modes": 2},
    "control": {"modes": 2, "ratios": [[1.0, 0.3]] * 3},
    "motion": _move(0.0005, 0.01),
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.008},
}
#: Three modes, 500 samples: 10 mm in 30 ms.
MACHINE: dict[str, Any] = {
    "run": {"duration": 0.05},
    "link": {"modes": 3},
    "motion": _move(0.01, 0.03),
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.015},
}


def with_sections(base: dict[str, Any], **sections: Any) -> dict[str, Any]:
    """A study's data with other fields, section by section."""
    data = copy.deepcopy(base)
    for name, fields in sections.items():
        data[name] = {**data.get(name, {}), **copy.deepcopy(fields)}
    return data


def study_of(base: dict[str, Any], **fields: Any) -> Study:
    """The study, with fields changed as by `Study.change`."""
    study: Study = parse_study(copy.deepcopy(base))
    return study.change(**fields) if fields else study


def text_of(base: dict[str, Any], **sections: Any) -> str:
    """The study as a file."""
    return toml_text(with_sections(base, **sections))
