"""Subsets of controlled links, and of controlled modes, as the cases of a sweep, and their results.

A subset of n players has the number whose bit p says whether player p is controlled. The players
are the 3 links or, for subsets of modes, p = i C + j for mode j of link i, C the number of
controlled modes.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from jaxmodel.laws import LAWS
from jaxmodel.mechanisms import MECHANISMS
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
#: Modes 2 and up matter from this change on, as a share of a mean square without control [1].
MATTERS = 0.01
_KEPT = (
    "residual_rms",
    "pose_error_rms",
    "spectral_density",
    "settling_time",
    "peak_voltage",
)


def in_order(players: int) -> list[int]:
    """Numbers of all subsets as people list them: none, 1, 2, 3, 1+2, 1+3, 2+3, all."""
    return [
        sum(1 << player for player in chosen)
        for size in range(players + 1)
        for chosen in combinations(range(players), size)
    ]


#: Links of the machines that have an atlas.
LINKS = 3
#: The 8 choices of links, in that order.
CHOICES = in_order(LINKS)


class Subsets(NamedTuple):
    """Residuals of subsets: axes setting, subset; first, of choices of links, also modes.

    Of choices of links, `read_subsets` has (settings, C, 8): with the first 1, 2, ... C modes of
    each link controlled.
    """

    setting: tuple[tuple[float, str], ...]  # move time [s], shaper
    status: np.ndarray  # codes of `jaxmodel.status`, (s, ..., n)
    station: np.ndarray  # residual chord deflection, rms [m], (..., 3, S)
    pose: np.ndarray  # residual pose error, rms [m, m, rad], (..., 3)
    peak: np.ndarray  # largest spectral density near each mode [m2/Hz], (..., 3, C)
    settling: np.ndarray  # [s], (..., 3)
    voltage: np.ndarray  # peak [V], (..., 3)

    @property
    def modes(self) -> int:
        """C, controlled modes per link of the design."""
        return self.peak.shape[-1]

    @property
    def link(self) -> np.ndarray:
        """Residual chord deflection, rms over window and stations [m], (..., 3)."""
        return np.sqrt(np.mean(self.station**2, axis=-1))

    @property
    def platform(self) -> np.ndarray:
        """Residual error of the platform's centre, rms [m], (...)."""
        return np.hypot(self.pose[..., 0], self.pose[..., 1])

    def removed(self) -> np.ndarray:
        """Mean square that each subset removes, by TARGETS.

        Returns:
            Share of the value without control [1], (..., 5, n): a game of `attribution`.
        """
        link = np.moveaxis(self.link, -1, -2) ** 2
        total = link.sum(axis=-2, keepdims=True)
        square = np.concatenate([link, total, self.platform[..., None, :] ** 2], axis=-2)
        first = square[..., :1]
        return 1 - square / np.where(first > 0, first, np.nan)

    def each(self, pick: Callable[[np.ndarray], np.ndarray]) -> Subsets:
        """The same with another part of every array."""
        return Subsets(self.setting, *map(pick, self[1:]))

    def whole_links(self) -> Subsets:
        """Of choices of links, those with all modes of a link controlled, (settings, 8)."""
        return self.each(lambda values: values[:, -1])


def beyond_first(choices: Subsets, adc_step: np.ndarray) -> np.ndarray:
    """Largest change that control of modes 2 and up makes, beside that of mode 1, by setting.

    A link that stays below one ADC step without control does not count: its controller hardly
    sees it.

    Args:
        choices: of links, (settings, C, 8).
        adc_step: deflection of one ADC step [m], (3,).

    Returns:
        Share of the mean square without control of a link, all links or the platform [1],
        (settings,).
    """
    removed = choices.removed()
    is_seen = choices.link[:, 0, 0] >= adc_step  # (settings, 3)
    any_seen = is_seen.any(axis=1, keepdims=True)
    counts = np.concatenate([is_seen, any_seen, any_seen], axis=1)
    change = np.abs(removed - removed[:, :1]).max(axis=(1, 3))
    return np.where(counts, change, 0.0).max(axis=1)


#: Targets of `Subsets.removed`, in order.
TARGETS = ("link 1", "link 2", "link 3", "all links", "platform")


def link_label(subset: int) -> str:
    """Links of one of the 8 choices in words: "none", "1", "1+3"."""
    return "+".join(str(i + 1) for i in range(3) if subset >> i & 1) or "none"


def subset_label(subset: int, modes: int) -> str:
    """Modes of a subset in words: "none", "1.1+2.1"."""
    names = player_labels(modes)
    return "+".join(name for p, name in enumerate(names) if subset >> p & 1) or "none"


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
    has_every_mode: bool = False,
) -> SweepSpec:
    """The sweep of the choices of links of a design, or of all its subsets of modes.

    Args:
        study: the design; its links, masks, move time and shaper are replaced. Where its ratios
            come from its own uncontrolled run, each setting's uncontrolled run is done here.
        settings: time of every move of its path [s], and shaper.
        has_every_mode: all 2^(3C) subsets of links and modes; otherwise the 8 choices of links,
            each with the first 1, 2, ... C modes of its links.

    Raises:
        StudyError: too many controlled modes, no motion, no sampled modal controller.
    """
    _check(study)
    study = long_enough(study, settings).change(
        title=f"{study.title[:150]}: controlled {'modes' if has_every_mode else 'links'}",
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
                "metrics.residual_delay": residual_delay(moved),  # a pulse is not moved
            }
        )
    data = study.model_dump(mode="json")
    data["control"] |= {"ratio_source": "given", "ratio_exponent": 1.0}
    data["metrics"]["residual_delay"] = residual_delay(study)  # each case has its own
    data["sweep"] = {
        "axes": {"control.mode_mask": _mask_axis(study.control.modes, has_every_mode)},
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
        ends.append(float(timing.motion_end + timing.shaper_length) + residual_delay(moved))
    needed = max(ends) + study.metrics.residual_length
    return study.change(run__duration=max(study.run.duration, float(np.ceil(100 * needed) / 100)))


def _check(study: Study) -> None:
    control, motion = study.control, study.motion
    if study.n_links != LINKS:
        able = ", ".join(x.name for x in MECHANISMS.values() if x.n_links == LINKS)
        raise field_error("machine.kind", study.machine.kind, f"{able}: machines of {LINKS} links")
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


def _masks(modes: int, has_every_mode: bool) -> np.ndarray:
    """mode_mask by subset: of modes, (2^(3C), 3, C), or of links by modes each, (C, 8, 3, C)."""
    players = np.arange(3 * modes if has_every_mode else 3)
    on = (np.arange(2 ** len(players))[:, None] >> players) & 1
    if has_every_mode:
        return on.astype(bool).reshape(-1, 3, modes)
    return on.astype(bool)[:, :, None] & np.tri(modes, dtype=bool)[:, None, None]


def _mask_axis(modes: int, has_every_mode: bool) -> list[list[list[bool]]]:
    """These masks one after another, in the order of `in_order`, no link only once."""
    masks = _masks(modes, has_every_mode)
    order = in_order(3 * modes if has_every_mode else 3)
    each = np.moveaxis(masks[..., order, :, :], -3, 0).reshape(-1, 3, modes)
    return [mask.tolist() for mask in {mask.tobytes(): mask for mask in each}.values()]


def read_subsets(path: str | Path, has_every_mode: bool = False) -> Subsets:
    """Residuals of a finished `atlas_sweep`.

    Args:
        path: its folder.
        has_every_mode: as given to `atlas_sweep`.

    Returns:
        Subsets, of choices of links (settings, C, 8), of modes (settings, 2^(3C)); NaN where a
        case did not finish.
    """
    data = read_sweep(path)
    case = list(zip(data["motion.move_time"].tolist(), data["shaper.kind"].tolist(), strict=True))
    mask = data["control.mode_mask"].astype(bool)
    row = {(*x, m.tobytes()): k for k, (x, m) in enumerate(zip(case, mask, strict=True))}
    settings = tuple(dict.fromkeys(case))
    masks = _masks(mask.shape[-1], has_every_mode)
    flat = masks.reshape(-1, *mask.shape[1:])
    rows = np.array([[row[(*x, m.tobytes())] for m in flat] for x in settings])
    rows = rows.reshape(len(settings), *masks.shape[:-2])
    return Subsets(
        setting=settings,
        status=data["status"][rows],
        station=data["residual_rms"][rows],
        pose=data["pose_error_rms"][rows],
        peak=data["spectral_density"].max(axis=-1)[rows],
        settling=data["settling_time"][rows],
        voltage=data["peak_voltage"][rows],
    )
