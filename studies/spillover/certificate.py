"""Spillover certificate: one design's controller judged on many plants it does not know."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.controller import channel_parts, linear_parts
from jaxmodel.sampled_loop import RADIUS_TOLERANCE
from studies.engine.controller import FixedController, fixed_controller
from studies.engine.host_loop import SampledLoop, name_motion
from studies.engine.stability import LoopFigures, judge_loop, worst_figures
from studies.errors import StudyError, field_error
from studies.result import Result
from studies.results.breaking import BreakingChange
from studies.results.labelled import Labelled, Records, derived, labelled, told, unwritten
from studies.space.machines import MISMATCHES, ModelMismatch
from studies.spillover.fast_move import ControlEffect
from studies.spillover.plants import LoopBuilder, all_plants, pad_channels, plant_sizes
from studies.spillover.proofs import Proofs, machine_text
from studies.study.margin import hysteresis_text, margin_text
from studies.study.spec import Study
from studies.threads import serial_blas

#: An array of texts.
Texts: TypeAlias = np.ndarray[tuple[int, ...], np.dtype[np.str_]]
#: Gain factors at which modes are traced from no control to the design's gains.
STEPS = np.linspace(0, 1, 17)[1:]
#: Share of its damping that an uncontrolled mode may lose before it is named [1].
SPILLOVER = 0.1


class Spillover(Labelled):
    """An uncontrolled mode that control makes worse."""

    mode: int = told("from 1")
    damping_ratio: float = told("under control [1]")
    free_damping: float = told("without control [1]")
    basis: str = told("of the plant")
    n_modes: int = told("of the plant, per link")
    mismatch: str = told("from the nominal model")


#: Axes of what each plant has, and of what each of its modes has.
_PLANTS = ("basis", "mismatch", "plant_modes")
_MODES = (*_PLANTS, "link_mode", "pole")


class Certificate(Labelled, Result, command="certify", version=4):
    """`certificate.json`, written by `studies certify`: the verdict on a controller, and every
    plant that it was judged on.

    Axes: B bases, D mismatches, N numbers of modes. Numbers of plants that do not exist (patches
    overlap, ...) and of modes beyond a plant's own are NaN, null in JSON; their texts "".
    """

    FILES = ", data and figures in the same folder"
    ROWS = Records("plants", _PLANTS, "every plant that it was judged on", "exists")

    study: Study = told("complete, as a study file holds it")
    required_margin: float = labelled("1", "gain margin required")
    n_controlled: int = unwritten()  # r_c, controlled modes per link
    variants: np.ndarray = unwritten()  # `PlantVariant`, (B, D, N)
    exists: np.ndarray = unwritten()  # (B, D, N)
    spectral_radius: np.ndarray = labelled("1", "of the loop at its own gains", *_PLANTS)
    gain_margin: np.ndarray = labelled("1", "common gain factor before instability", *_PLANTS)
    frequency: np.ndarray = labelled("Hz", "of modes under control, by order and link", *_MODES)
    damping_ratio: np.ndarray = labelled("1", "their damping ratios", *_MODES)
    free_damping_ratio: np.ndarray = labelled("1", "without control", *_MODES)
    least_damped: Texts = labelled("1", "mode of least damping", *_PLANTS)
    broken_by: Texts = labelled("1", "what goes unstable beyond the margin", *_PLANTS)
    observation: np.ndarray = labelled(
        "1",
        "channel signal per modal coordinate of the plant (SRF: V/m)",
        *(*_PLANTS[:2], "link", "channel", "link_mode"),
        is_in_document=False,
    )
    actuation: np.ndarray = labelled(
        "1",
        "modal force on the plant per force of a channel (SRF: N/V)",
        *(*_PLANTS[:2], "link", "link_mode", "channel"),
        is_in_document=False,
    )
    notes: tuple[str, ...] = told("what was left out, and why")
    proofs: Proofs | None = told("what was proven with --prove, null without", default=None)
    smallest_change: BreakingChange | None = told(
        "that breaks it; null: not looked for", default=None
    )
    fast_move: ControlEffect | None = told("of the nominal machine; null: none", default=None)

    @property
    def is_good(self) -> bool:
        return self.is_passed

    @property
    def least_damping(self) -> np.ndarray:
        """Smallest damping ratio of all link modes [1], (B, D, N)."""
        finite = np.where(np.isnan(self.damping_ratio), np.inf, self.damping_ratio)
        least = finite.min(axis=(3, 4))
        return np.where(np.isfinite(least), least, np.nan)

    @derived("", "of the study")
    def title(self) -> str:
        return self.study.title

    @derived("1", "modal basis of the plant", "basis")
    def basis(self) -> Texts:
        return np.array([plant.basis for plant in self.variants[:, 0, 0]])

    @derived("1", "mismatch from the nominal model", "mismatch")
    def mismatch(self) -> Texts:
        return np.array([str(one) for one in self._mismatches])

    @derived("1", "true over nominal length of sensors", "mismatch")
    def sensor_factor(self) -> np.ndarray:
        return np.array([one.sensor for one in self._mismatches])

    @derived("1", "true over nominal length of actuators", "mismatch")
    def actuator_factor(self) -> np.ndarray:
        return np.array([one.actuator for one in self._mismatches])

    @derived("1", "true over nominal frequencies of the links", "mismatch")
    def frequency_factor(self) -> np.ndarray:
        return np.array([one.frequency for one in self._mismatches])

    @derived("kg m2", "true J_C of each link", "mismatch", "link")
    def joint_inertia_c(self) -> np.ndarray:
        own, study = self.study.link.joint_inertia_c, self.study
        inertia = [own if d.joint_inertia is None else d.joint_inertia for d in self._mismatches]
        return np.array([study.each_link(x) for x in inertia])

    @property
    def _mismatches(self) -> list[ModelMismatch]:
        return [plant.mismatch for plant in self.variants[0, :, 0]]

    @derived("1", "per link", "plant_modes")
    def plant_modes(self) -> np.ndarray[tuple[int], np.dtype[np.int_]]:
        return np.array([plant.n_modes for plant in self.variants[0, 0]])

    @derived("1", "stable with the margin required", *_PLANTS)
    def passes(self) -> np.ndarray[tuple[int, int, int], np.dtype[np.bool_]]:
        is_stable = self.spectral_radius <= 1 + RADIUS_TOLERANCE
        return np.asarray(is_stable & (self.gain_margin >= self.required_margin))

    @derived(
        "",
        "whether all plants pass, and proofs found no unstable machine; what they leave "
        "undecided does not fail a design",
    )
    def is_passed(self) -> bool:
        return bool(self.passes[self.exists].all()) and self.unstable_machine is None

    @derived("", "passed or failed, and the deciding plant or machine")
    def verdict(self) -> str:
        at, machine = self.worst, self.unstable_machine
        breaking = self.broken_by[at]
        margin = (
            f"gain margin {margin_text(self.gain_margin[at], 3)}, {self.required_margin:g} required"
        )
        if self.is_passed:
            first = f"; first to go unstable beyond it: {breaking}" if breaking else ""
            return f"passed: {margin}{first}"
        unstable = (
            "" if machine is None else f"unstable machine in the box: {machine_text(machine)}"
        )
        if self.fails_from == 0:
            return f"failed by an {unstable}; on the plants: {margin}"
        state = "" if self.spectral_radius[at] <= 1 + RADIUS_TOLERANCE else "unstable, "
        return f"failed by {breaking}: {state}{margin}{unstable and f'; {unstable}'}"

    @derived("", "least gain margin of all plants [1]")
    def smallest_margin(self) -> float:
        return float(np.nanmin(self.gain_margin))

    @property
    def unstable_machine(self) -> tuple[float, float, float] | None:
        """The one that proofs found: factor on stiffness [1], delay [samples], payload [kg]."""
        return None if self.proofs is None else self.proofs.box.unstable

    @derived("", "the uncontrolled mode of any plant that loses most damping, if more than a tenth")
    def spillover(self) -> Spillover | None:
        kept = np.where(
            self.exists[..., None, None], self.damping_ratio / self.free_damping_ratio, np.nan
        )
        kept = kept[:, :, :, self.n_controlled :]
        if np.isnan(kept).all() or np.nanmin(kept) > 1 - SPILLOVER:
            return None
        *plant, mode, _ = at = np.unravel_index(np.nanargmin(kept), kept.shape)
        whole = (*plant, mode + self.n_controlled, at[-1])
        worst = self.variants[tuple(plant)]
        return Spillover(
            mode=int(mode) + self.n_controlled + 1,
            damping_ratio=float(self.damping_ratio[whole]),
            free_damping=float(self.free_damping_ratio[whole]),
            basis=worst.basis,
            n_modes=worst.n_modes,
            mismatch=str(worst.mismatch),
        )

    @property
    def worst(self) -> tuple[int, ...]:
        """Where the margin is smallest; if nearly equal, the plant with the fewest modes."""
        near = np.argwhere(self.gain_margin <= np.nanmin(self.gain_margin) * (1 + 1e-3))
        return tuple(int(k) for k in min(near.tolist(), key=lambda at: at[2]))

    @property
    def truncation(self) -> float:
        """Largest change of a margin by the last plant modes added, as a share of it [1]."""
        last, before = self.gain_margin[:, :, -1], self.gain_margin[:, :, -2:][:, :, 0]
        is_there = self.exists[:, :, -2:].all(axis=2) & (last > 0)
        return float(np.max(np.abs(before / last - 1)[is_there], initial=0.0))

    @derived("", "fewest plant modes per link with which a plant fails, 0 if none does")
    def fails_from(self) -> int:
        failing = self.variants[self.exists & ~self.passes]
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
        required_margin=margin,
        n_controlled=design.structure.n_controlled,
        variants=plants,
        exists=exists,
        spectral_radius=radius,
        gain_margin=limit,
        frequency=frequency,
        damping_ratio=zeta,
        free_damping_ratio=free,
        least_damped=weakest.astype(str),
        broken_by=breaking.astype(str),
        observation=observation,
        actuation=actuation,
        notes=tuple(filter(None, dict.fromkeys([hysteresis_text(width), *left_out]))),
    )
