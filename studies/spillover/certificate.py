"""Spillover certificate: one design's controller judged on many plants it does not know."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.controller import channel_parts, linear_parts
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.engine.breaking import BreakingChange
from studies.engine.controller import FixedController, fixed_controller
from studies.engine.host_loop import SampledLoop, name_motion
from studies.engine.stability import LoopFigures, judge_loop, worst_figures
from studies.errors import StudyError, field_error
from studies.publish import shown
from studies.spillover.fast_move import ControlEffect
from studies.spillover.plants import (
    MISMATCHES,
    LoopBuilder,
    ModelMismatch,
    PlantVariant,
    all_plants,
    pad_channels,
    plant_sizes,
)
from studies.spillover.proofs import Proofs
from studies.study.margin import hysteresis_text
from studies.study.spec import Study
from studies.threads import serial_blas

#: Gain factors at which modes are traced from no control to the design's gains.
STEPS = np.linspace(0, 1, 17)[1:]
#: Share of its damping that an uncontrolled mode may lose before it is named [1].
SPILLOVER = 0.1


class Spillover(NamedTuple):
    """An uncontrolled mode that control makes worse."""

    mode: int  # from 1
    damping_ratio: float  # [1]
    free_damping: float  # without control [1]
    plant: PlantVariant


class Certificate(NamedTuple):
    """The findings. Axes: B bases, D mismatches, N numbers of modes.

    Numbers of plants that do not exist (patches overlap, ...) are NaN, their texts "".
    """

    study: Study
    required: float  # margin required on every plant [1]
    n_controlled: int  # r_c, controlled modes per link
    plants: np.ndarray  # `Plant`, (B, D, N)
    exists: np.ndarray  # (B, D, N)
    radius: np.ndarray  # spectral radius at the design's gains [1], (B, D, N)
    margin: np.ndarray  # largest common gain factor, all smaller ones stable [1], (B, D, N)
    frequency_hz: np.ndarray  # of each link mode, three of each order, (B, D, N, R, 3)
    damping_ratio: np.ndarray  # [1], (B, D, N, R, 3)
    free_damping: np.ndarray  # without control [1], (B, D, N, R, 3)
    weakest: np.ndarray  # the mode of least damping, in words, (B, D, N)
    breaking: np.ndarray  # what goes unstable beyond the margin, in words, (B, D, N)
    observation: np.ndarray  # channel signal per plant mode, (B, D, 3, C, R), see `SpilloverGains`
    actuation: np.ndarray  # modal force per channel force, (B, D, 3, R, C)
    notes: tuple[str, ...]  # what was left out, and why
    proofs: Proofs | None = None  # beyond these plants, if they were asked for
    smallest_change: BreakingChange | None = None  # that breaks the design; None: not looked for
    fast_move: ControlEffect | None = None  # of the nominal machine; None: not run

    def _repr_html_(self) -> str:
        return shown(self)

    @property
    def least_damping(self) -> np.ndarray:
        """Smallest damping ratio of all link modes [1], (B, D, N)."""
        finite = np.where(np.isnan(self.damping_ratio), np.inf, self.damping_ratio)
        least = finite.min(axis=(3, 4))
        return np.where(np.isfinite(least), least, np.nan)

    @property
    def passes(self) -> np.ndarray:
        """Which plants are stable with the required margin, (B, D, N)."""
        return (self.radius <= 1 + RADIUS_TOLERANCE) & (self.margin >= self.required)

    @property
    def is_passed(self) -> bool:
        """Whether all of them do, and proofs found no unstable machine.

        What proofs leave undecided does not fail a design.
        """
        return bool(self.passes[self.exists].all()) and self.unstable_machine is None

    @property
    def unstable_machine(self) -> tuple[float, float, float] | None:
        """The one that proofs found: factor on stiffness [1], delay [samples], payload [kg]."""
        return None if self.proofs is None else self.proofs.box.unstable

    @property
    def spillover(self) -> Spillover | None:
        """The uncontrolled mode of any plant that loses most damping, if more than a tenth."""
        kept = np.where(
            self.exists[..., None, None], self.damping_ratio / self.free_damping, np.nan
        )
        kept = kept[:, :, :, self.n_controlled :]
        if np.isnan(kept).all() or np.nanmin(kept) > 1 - SPILLOVER:
            return None
        *plant, mode, _ = at = np.unravel_index(np.nanargmin(kept), kept.shape)
        whole = (*plant, mode + self.n_controlled, at[-1])
        return Spillover(
            mode=int(mode) + self.n_controlled + 1,
            damping_ratio=float(self.damping_ratio[whole]),
            free_damping=float(self.free_damping[whole]),
            plant=self.plants[tuple(plant)],
        )

    @property
    def worst(self) -> tuple[int, ...]:
        """Where the margin is smallest; if nearly equal, the plant with the fewest modes."""
        near = np.argwhere(self.margin <= np.nanmin(self.margin) * (1 + 1e-3))
        return tuple(int(k) for k in min(near.tolist(), key=lambda at: at[2]))

    @property
    def truncation(self) -> float:
        """Largest change of a margin by the last plant modes added, as a share of it [1]."""
        last, before = self.margin[:, :, -1], self.margin[:, :, -2:][:, :, 0]
        is_there = self.exists[:, :, -2:].all(axis=2) & (last > 0)
        return float(np.max(np.abs(before / last - 1)[is_there], initial=0.0))

    @property
    def fails_from(self) -> int:
        """Fewest plant modes per link with which a plant fails, 0 if none does."""
        failing = self.plants[self.exists & ~self.passes]
        return min((plant.n_modes for plant in failing), default=0)


def certify(
    study: Study,
    margin: float = 2.0,
    bases: tuple[str, ...] = tuple(BASES),
    sizes: tuple[int, ...] = (),
    mismatches: tuple[ModelMismatch, ...] = MISMATCHES,
) -> Certificate:
    """Judge a study's controller on plants that differ from its model.

    Its coefficients are those of the study. Each plant is linearised at the first way-point, with
    delay, hold and anti-alias filter.

    Args:
        study: with sampled feedback.
        margin: gain margin required on every plant [1], above 1.
        bases: modal bases of the plant.
        sizes: plant modes per link; empty: the controlled ones, 8 and 12.
        mismatches: from the controller's model; joints only in a basis that has them.

    Raises:
        StudyError: no controller to judge (ideal feedback, no link controlled, gains of zero), a
            study that cannot run, or an argument out of range.
    """
    if not 1 < margin <= 32:
        raise field_error("--margin", margin, "more than 1, up to 32", "1")
    design = fixed_controller(study)
    nominal = design.study.each_link(design.study.link.joint_inertia_c)
    mismatches = tuple(
        d for d in mismatches if d.joint_inertia is None or np.any(d.joint_inertia != nominal)
    )
    plants = all_plants(bases, mismatches, plant_sizes(design, sizes))
    builder = LoopBuilder(design)
    faults = np.vectorize(builder.fault, otypes=[object])(plants)
    try:
        with serial_blas():
            judgements = _judge_plants(design, builder, plants, faults)
    except np.linalg.LinAlgError:
        raise StudyError("a linearised loop is not finite: nothing to judge") from None
    if not judgements:
        raise StudyError(f"no plant to judge on: {'; '.join(dict.fromkeys(faults.ravel()))}")
    return _certificate(design, margin, builder, plants, faults, judgements)


class _Judgement(NamedTuple):
    """A plant's loop; texts as in `Certificate`."""

    figures: LoopFigures
    free_damping: np.ndarray  # of the link modes without control [1], (R, 3)
    weakest: str
    breaking: str


def _judge_plants(
    design: FixedController, builder: LoopBuilder, plants: np.ndarray, faults: np.ndarray
) -> dict[tuple[int, ...], _Judgement]:
    """Judgement of every plant that exists, by its place; writes which ones buckle into `faults`.

    Args:
        design: whose controller is judged.
        builder: of its loops.
        plants: (B, D, N).
        faults: why they do not exist, (B, D, N).
    """
    parts = [
        (modes, pad_channels(part, design.n_patches))
        for modes, part in linear_parts(design.controller)
    ]
    judgements = {}
    for at in map(tuple, np.argwhere(faults == "")):
        loops = [builder.loop(plants[at], part) for _, part in parts]
        if not loops[0].is_open_loop_stable:
            faults[at] = f"{plants[at].basis}, {plants[at].mismatch}: it buckles without control"
            continue
        each = [judge_loop(loop, STEPS) for loop in loops]
        least = int(np.argmin([figures.gain_margin for figures in each]))
        loop, poles = loops[least], loops[least].mode_poles
        judgements[at] = _Judgement(
            figures=worst_figures(
                [(modes, figures) for (modes, _), figures in zip(parts, each, strict=True)]
            ),
            free_damping=-poles.real / np.abs(poles),
            weakest=_weakest_mode(loop, each[least]),
            breaking=each[least].breaking or "",
        )
    return judgements


def _weakest_mode(loop: SampledLoop, figures: LoopFigures) -> str:
    """The mode of least damping, "" if all are overdamped."""
    ratio = figures.damping_ratio
    if np.all(np.isnan(ratio)):
        return ""
    at = np.unravel_index(np.nanargmin(ratio), ratio.shape)
    zeta, omega = ratio[at], 2 * np.pi * figures.frequency_hz[at]
    decay = omega * (-zeta + 1j * np.sqrt(max(1 - zeta**2, 0.0)))
    return name_motion(loop, 1.0, np.exp(decay * loop.period))


def _certificate(
    design: FixedController,
    margin: float,
    builder: LoopBuilder,
    plants: np.ndarray,
    faults: np.ndarray,
    judgements: dict[tuple[int, ...], _Judgement],
) -> Certificate:
    shape, largest = plants.shape, max(plant.n_modes for plant in plants.ravel())
    exists = faults == ""
    law = pad_channels(design.controller, design.n_patches)
    links, channels, _ = channel_parts(design.controller).filter.shape

    radius, limit = np.full((2, *shape), np.nan)
    frequency, zeta, free = np.full((3, *shape, largest, links), np.nan)
    weakest, breaking = np.full((2, *shape), "", object)
    observation = np.full((*shape[:2], links, channels, largest), np.nan)
    actuation = np.full((*shape[:2], links, largest, channels), np.nan)
    for at, (figures, free_damping, *texts) in judgements.items():
        n = plants[at].n_modes
        radius[at], limit[at] = figures.spectral_radius, figures.gain_margin
        frequency[at][:n], zeta[at][:n] = figures.frequency_hz, figures.damping_ratio
        free[at][:n] = free_damping
        weakest[at], breaking[at] = texts
    for at in map(tuple, np.argwhere(exists.any(axis=2))):
        plant = plants[at][0]._replace(n_modes=largest)
        gains = builder.spillover_gains(plant, law)
        observation[at] = gains.observation[:, :channels]
        actuation[at] = gains.actuation[:, :, :channels]
    width = design.study.patches.hysteresis
    left_out = [f"left out: {fault}" for fault in faults.ravel() if fault]
    return Certificate(
        study=design.study,
        required=margin,
        n_controlled=design.structure.n_controlled,
        plants=plants,
        exists=exists,
        radius=radius,
        margin=limit,
        frequency_hz=frequency,
        damping_ratio=zeta,
        free_damping=free,
        weakest=weakest.astype(str),
        breaking=breaking.astype(str),
        observation=observation,
        actuation=actuation,
        notes=tuple(filter(None, dict.fromkeys([hysteresis_text(width), *left_out]))),
    )
