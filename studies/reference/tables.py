"""The paper's machine in an independent finite-element multibody code: its tables.

Cable elements (absolute nodal coordinates), 40 to 48 a link, axially stiff, no patches and no joint
inertia. The code shares nothing with this package.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

#: Bare links of given length under half the paper's gains, as the tables and workloads have them.
BARE: dict[str, Any] = {
    "link__basis": "pinned_pinned",
    "link__stretch": False,
    "control__basis": "pinned_pinned",
    "control__velocity_gain": (1.55, 1.75, 1.7),
}

_FOLDER = Path(__file__).parent / "data"

#: What holds the sliders in the table of frequencies, as changes to a study.
HELD: dict[str, dict[str, Any]] = {
    "sliders_locked": {"drive__locked": True},
    "sliders_free": {"drive__kp": 0.0},
    "sliders_on_springs_2e4_N_per_m": {},
}

#: The paper's design with half of its gains (the default study): gain margin [1], the frequency at
#: which the loop breaks there [Hz], and the damping ratios of the three assembled modes 1 [1].
#: Controller: exported C; the same with 40, 80 and 120 elements a link to 1e-4.
LOOP = 3.699, 1199.0, (0.2265, 0.2256, 0.2244)


class FastMove(NamedTuple):
    """A square of 10 mm in 0.05 s a move: no shaper, no damping, drive of 2e4 N/m and 60 N s/m."""

    time: np.ndarray  # [s], (T,)
    deflection: np.ndarray  # of the links' mid-spans from their chords [m], (T, 3)
    pose: np.ndarray  # of the platform [m, m, rad], (T, 3)


def frequencies(name: str) -> np.ndarray:
    """Natural frequencies of the undamped machine at home but for rigid motion [Hz].

    Args:
        name: what holds the sliders, a key of `HELD`.

    Example:
        >>> frequencies("sliders_free")[:3].round(2).tolist()
        [114.65, 115.04, 115.04]
    """
    given = np.array(json.loads((_FOLDER / "frequencies.json").read_text())["cases"][name])
    return given[given > 1]  # free rigid motions sit between 0 and 0.05 Hz there


def free_response() -> tuple[np.ndarray, np.ndarray]:
    """Link 1 bent by 0.05 mm at mid-span and released, sliders locked: time [s], deflection [m]."""
    time, deflection = np.loadtxt(_FOLDER / "free_response.csv", delimiter=",").T
    return time, deflection


def fast_move() -> FastMove:
    """`FastMove`."""
    given = np.genfromtxt(_FOLDER / "fast_50ms.csv", delimiter=",", skip_header=3)
    return FastMove(given[:, 0], given[:, 1:4], given[:, 4:7])
