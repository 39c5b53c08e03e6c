"""Every subset of controlled links and modes, as the cases of one sweep, and its results.

Player p = i C + j stands for mode j of link i, C the number of controlled modes; bit p of a
subset's number says whether it is controlled.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.laws import LAWS
from studies.engine.columns import NOT_RUN
from studies.engine.preflight import preflight
from studies.engine.results import read_sweep
from studies.engine.runs import resolved_study
from studies.errors import field_error
from studies.space.spec import SweepSpec, parse_sweep
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study
from studies.study.window import residual_delay

#: Time of a move [s] and input shaper: the paper's move, and faster ones that leave more vibration.
SETTINGS = tuple((time, shaper) for time in (0.1, 0.05, 0.03) for shaper in ("ei", "none"))
#: More controlled modes than this have too many subsets.
MODE_LIMIT = 3
_KEPT = (
    "residual_rms",
    "pose_error_rms",
    "spectral_density",
    "settling_time",
    "peak_voltage",
)


class Subsets(NamedTuple):
    """Residuals of all subsets; leading axes: setting, subset."""

    setting: tuple[tuple[float, str], ...]  # move time [s], shaper
    modes: int  # C, controlled modes per link
    status: np.ndarray  # codes of `jaxmodel.status`, (n, 2^(3C))
    station: np.ndarray  # residual chord deflection, rms [m], (..., 3, S)
    pose: np.ndarray  # residual pose error, rms [m, m, rad], (..., 3)
    peak: np.ndarray  # largest spectral density near each mode [m2/Hz], (..., 3, C)
    settling: np.ndarray  # [s], (..., 3)
    voltage: np.ndarray  # peak [V], (..., 3)

    @property
    def link(self) -> np.ndarray:
        """Residual chord deflection, rms over window and stations [m], (..., 3)."""
        return np.sqrt(np.mean(self.station**2, axis=-1))

    @property
    def platform(self) -> np.ndarray:
        """Residual error of the platform's centre, rms [m], (...)."""
        return np.hypot(self.pose[..., 0], self.pose[..., 1])

    @property
    def link_subsets(self) -> np.ndarray:
        """Subset numbers of the 8 choices of whole links; bit i of the position is link i, (8,)."""
        whole = 2**self.modes - 1
        shifts = whole << (self.modes * np.arange(3))
        return ((np.arange(8)[:, None] >> np.arange(3)) & 1) @ shifts

    def removed(self) -> np.ndarray:
        """Mean square that each subset removes, by TARGETS.

        Returns:
            Share of the value without control [1], (..., 5, 2^(3C)): a game of `attribution`.
        """
        link = np.moveaxis(self.link, -1, -2) ** 2
        total = link.sum(axis=-2, keepdims=True)
        square = np.concatenate([link, total, self.platform[..., None, :] ** 2], axis=-2)
        first = square[..., :1]
        return 1 - square / np.where(first > 0, first, np.nan)


#: Targets of `Subsets.removed`, in order.
TARGETS = ("link 1", "link 2", "link 3", "all links", "platform")


def link_label(subset: int) -> str:
    """Links of one of the 8 choices in words: "none", "1", "1+3"."""
    return "+".join(str(i + 1) for i in range(3) if subset >> i & 1) or "none"


def player_labels(modes: int) -> list[str]:
    """Short names of the players, "2.1" for mode 1 of link 2."""
    return [f"{i + 1}.{j + 1}" for i in range(3) for j in range(modes)]


def setting_label(setting: tuple[float, str]) -> str:
    """Move time and shaper in words."""
    time, shaper = setting
    return f"{time:g} s, " + {"none": "no shaper"}.get(shaper, f"{shaper.upper()} shaper")


def atlas_sweep(
    study: Study,
    settings: tuple[tuple[float, str], ...] = SETTINGS,
    has_modes: bool = True,
) -> SweepSpec:
    """The sweep of all subsets of a design.

    Args:
        study: the design; its links, masks, move time and shaper are replaced. Where its ratios
            come from its own uncontrolled run, each setting's uncontrolled run is done here.
        settings: time of every move of its path [s], and shaper.
        has_modes: all subsets of links and modes; otherwise the 8 of links.

    Raises:
        StudyError: too many controlled modes, no motion, no sampled modal controller.
    """
    _check(study)
    modes = study.control.modes
    masks = _masks(modes) if has_modes else _masks(modes)[_whole_links(modes)]
    study = long_enough(study, settings).change(
        title=f"{study.title[:150]}: subsets of controlled links and modes",
        control__links=(True,) * 3,
        control__mode_mask=(),
    )
    cases = []
    for time, shaper in settings:
        moved = study.change(motion__move_time=time, shaper__kind=shaper)
        # the same on every machine, so that a sweep can be resumed
        ratios = np.vectorize(_round)(resolved_study(moved).control.ratios)
        cases.append(
            {
                "motion.move_time": time,
                "shaper.kind": shaper,
                "control.ratios": ratios.tolist(),
            }
        )
    data = study.model_dump(mode="json")
    data["control"] |= {"ratio_source": "given", "ratio_exponent": 1.0}
    data["sweep"] = {
        "axes": {"control.mode_mask": masks.tolist()},
        "blocks": [{"method": "list", "cases": cases}],
        "metrics": list(_KEPT),
    }
    return parse_sweep(data)


def _round(x: float) -> float:
    return float(f"{x:.10g}")


def long_enough(study: Study, settings: tuple[tuple[float, str], ...]) -> Study:
    """The study with a run long enough for the slowest setting and its window."""
    ends = []
    for time, shaper in settings:
        moved = study.change(motion__move_time=time, shaper__kind=shaper)
        timing = preflight(build_structure(moved), as_arrays(build_case(moved)))
        ends.append(float(timing.motion_end + timing.shaper_length))
    needed = max(ends) + residual_delay(study) + study.metrics.residual_length
    return study.change(run__duration=max(study.run.duration, float(np.ceil(100 * needed) / 100)))


def _check(study: Study) -> None:
    control, motion = study.control, study.motion
    if control.modes > MODE_LIMIT:
        raise field_error(
            "control.modes",
            control.modes,
            f"1 to {MODE_LIMIT}, whose {2 ** (3 * MODE_LIMIT)} subsets can all be run",
            "1",
        )
    if len(set(motion.waypoints)) < 2:
        allowed = "a path of two different poses or more"
        raise field_error("motion.waypoints", motion.waypoints, allowed, "m, m, rad")
    gains = (*control.velocity_gain, *control.position_gain, control.has_poles)
    if control.gain_factor == 0 or not any(gains):
        name = "control.gain_factor" if control.gain_factor == 0 else "control.velocity_gain"
        raise field_error(name, 0.0, "gains that do something, whose effect can be shared out")
    modal = [name for name, law in LAWS.items() if law.channel == "mode"]
    for name, value, choices in (
        ("control.feedback", control.feedback, ["sampled"]),
        ("control.law", control.law, modal),
    ):
        if value not in choices:
            names = " or ".join(map(repr, choices))
            raise field_error(name, value, f"{names}, whose links and modes can be chosen")


def _masks(modes: int) -> np.ndarray:
    """mode_mask of every subset, (2^(3C), 3, C)."""
    players = np.arange(3 * modes)
    on = (np.arange(2 ** (3 * modes))[:, None] >> players) & 1
    return on.astype(bool).reshape(-1, 3, modes)


def _whole_links(modes: int) -> np.ndarray:
    """Which subsets consist of whole links."""
    masks = _masks(modes)
    return np.flatnonzero((masks == masks[..., :1]).all(axis=(1, 2)))


def read_subsets(path: str | Path) -> Subsets:
    """Residuals of a finished `atlas_sweep`.

    Args:
        path: its folder.

    Returns:
        Subsets; NaN where a case did not finish, or where only whole links were run.
    """
    data = read_sweep(path)
    mask = data["control.mode_mask"].astype(bool)
    modes = mask.shape[2]
    setting = list(
        zip(data["motion.move_time"].tolist(), data["shaper.kind"].tolist(), strict=True)
    )
    settings = list(dict.fromkeys(setting))
    subset = mask.reshape(len(mask), -1) @ 2 ** np.arange(3 * modes)
    index = (np.array([settings.index(x) for x in setting]), subset)
    shape = (len(settings), 2 ** (3 * modes))

    def scatter(values: np.ndarray, fill: Any = np.nan) -> np.ndarray:
        whole = np.full(shape + values.shape[1:], fill, values.dtype)
        whole[index] = values
        return whole

    return Subsets(
        setting=tuple(settings),
        modes=modes,
        status=scatter(data["status"], NOT_RUN),
        station=scatter(data["residual_rms"]),
        pose=scatter(data["pose_error_rms"]),
        peak=scatter(data["spectral_density"].max(axis=-1)),
        settling=scatter(data["settling_time"]),
        voltage=scatter(data["peak_voltage"]),
    )
