"""Comparison of laws: each as strong as the required margin allows, then on one fast move."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np
from threadpoolctl import threadpool_limits

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, linear_parts
from jaxmodel.laws.srf import SRF
from jaxmodel.simulate import Result, simulate
from studies.engine.controller import FixedController, fixed_controller
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.stability import (
    breaking_motion,
    follow_modes,
    gain_margin,
    modal_damping,
    pole_beyond,
)
from studies.spillover.certificate import STEPS
from studies.spillover.laws import Candidate, all_laws
from studies.spillover.plants import LoopBuilder, PlantVariant, plant_sizes
from studies.study.margin import HIGHEST, LOWEST
from studies.study.spec import Study
from studies.study.window import residual_delay

#: The fast move has the acceleration of a move of this length in this time.
FAST = (0.01, 0.03)  # [m], [s]
#: Length of the residual window [s].
WINDOW = 0.15
#: Number of modes whose damping is reported.
SHOWN = 3
GIVEN, WITHOUT = "baseline", "no control"


class Comparison(NamedTuple):
    """L laws: without control, the design as given, then each law at its own factor."""

    study: Study  # of the runs: the design's first move made fast
    required: float  # margin that sets the factors [1]
    plant: PlantVariant  # whose damping is reported, and whose basis all use
    names: tuple[str, ...]
    factor: np.ndarray  # on the gains of each law, 1: as strong on mode 1 as the design [1], (L,)
    damping_ratio: np.ndarray  # modes 1.., smallest of the links that control it [1], (L, J)
    margin: np.ndarray  # smallest over the plants, 0 if no gains are stable [1], (L,)
    breaking: tuple[str, ...]  # what goes unstable beyond it
    residual_rms: np.ndarray  # worst station of each link [m], (L, 3)
    peak_voltage: np.ndarray  # [V], (L,)
    control_energy: np.ndarray  # integral of summed squared voltages [V2 s], (L,)
    status: np.ndarray  # of the run, code of `jaxmodel.status`, (L,)


def compare_laws(study: Study, margin: float = 2.0, sizes: tuple[int, ...] = ()) -> Comparison:
    """Compare control laws on a study's machine.

    The factor on a law's gains is the largest that keeps the margin on the design's own plants, but
    no larger than needed to damp mode 1 like the given design, or as well as possible. Modified
    IMSC switches, so it is not linear: its loops are judged with each mode alone, which proves
    nothing about switching.

    Args:
        study: the design, with sampled feedback.
        margin: gain margin that the factors must keep [1].
        sizes: plant modes per link; empty: the controlled ones, 8 and 12.

    Raises:
        StudyError: as `certify`, or a design that does not damp mode 1.
    """
    design = fixed_controller(study)
    sizes = plant_sizes(design, sizes)
    plant = PlantVariant(design.study.link.basis, sizes[-1])
    laws = all_laws(design, LoopBuilder(design), plant)
    with threadpool_limits(1, "blas"):
        views = [_LawLoops(design, law, plant, sizes) for law in laws]
        own = next(view for view in views if view.law.law.name == study.control.law)
        target = own.damping(1.0)[0]
        rows = [(WITHOUT, own, 0.0), (GIVEN, own, 1.0)]
        for view in views:
            is_own = view is own and view.limit >= margin
            rows.append(
                (view.law.law.text, view, 1.0 if is_own else view.matched_factor(margin, target))
            )
        zeta = np.array([view.damping(factor) for _, view, factor in rows])
    fast, result = _run(design, [view.law.at(factor) for _, view, factor in rows])
    metrics = result.metrics
    return Comparison(
        study=fast,
        required=margin,
        plant=plant,
        names=tuple(name for name, _, _ in rows),
        factor=np.array([factor for _, _, factor in rows]),
        damping_ratio=zeta,
        margin=np.array([np.nan, *(view.margin(factor) for _, view, factor in rows[1:])]),
        breaking=("", *(view.breaking for _, view, _ in rows[1:])),
        residual_rms=metrics.residual_rms.max(axis=2),
        peak_voltage=metrics.peak_voltage.max(axis=1),
        control_energy=metrics.control_energy,
        status=result.status,
    )


class _LawLoops:
    """A law on the design's own plants."""

    def __init__(
        self, design: FixedController, law: Candidate, plant: PlantVariant, sizes: tuple[int, ...]
    ) -> None:
        self.law, builder = law, LoopBuilder(design)
        self.limit, self.breaking = HIGHEST, ""
        self._n_links = _controlled_links(design)
        parts = linear_parts(law.controller)
        self._parts = [(modes, builder.loop(plant, part)) for modes, part in parts]
        for _, part in parts:
            for n in sorted(sizes, reverse=True):  # usually the lowest limit first
                if self.limit <= LOWEST:
                    return
                loop = builder.loop(plant._replace(n_modes=n), part)
                limit = gain_margin(loop.poles, highest=self.limit)
                if limit < self.limit:
                    self.limit = limit
                    self.breaking = breaking_motion(loop, limit, pole_beyond(loop, limit))

    def margin(self, factor: float) -> float:
        """Smallest margin of all plants with all gains times a factor; 0 if no gains are stable."""
        return float(min(self.limit / factor, HIGHEST)) if factor else HIGHEST * (self.limit > 0)

    def damping(self, factor: float) -> np.ndarray:
        """Smallest damping ratio of the links that control it, modes 1 to `SHOWN`, NaN: none."""
        return self._path(factor * STEPS)[-1]

    def matched_factor(self, margin: float, target: float) -> float:
        """Largest factor with the margin, limited to where mode 1's damping reaches a target.

        Args:
            margin: that the factor must keep [1].
            target: damping ratio of mode 1 [1].
        """
        highest = self.limit / margin
        if highest == 0:
            return 0.0
        factors = highest * STEPS
        first = np.append(self.damping(0.0)[0], self._path(factors)[:, 0])
        factors = np.append(0.0, factors)
        most = int(np.argmax(first))
        if not first[0] < target <= first[most]:
            return float(factors[most])
        k = int(np.flatnonzero(first >= target)[0])
        return float(np.interp(target, first[k - 1 : k + 1], factors[k - 1 : k + 1]))

    def _path(self, factors: np.ndarray) -> np.ndarray:
        """The same as the gains grow through factors, (steps, `SHOWN`)."""
        damping = np.full((len(factors), SHOWN), np.nan)
        for modes, loop in self._parts:
            tracked = follow_modes(loop, factors, loop.poles)
            # a mode's three poles belong to no single link; uncontrolled links keep the weak ones
            zeta = -np.sort(-modal_damping(loop, tracked)[1][:, :SHOWN], axis=2)
            last = self._n_links[None, : zeta.shape[1], None] - 1
            zeta = np.take_along_axis(zeta, last, axis=2)[..., 0]
            damping[:, : zeta.shape[1]][:, modes] = zeta[:, modes]
        return damping


def _controlled_links(design: FixedController) -> np.ndarray:
    """How many links control each of modes 1 to `SHOWN`; if none does, all links with gains."""
    is_on = design.controller.feedback.acting
    if not is_on.size:  # a system from sensors to actuators
        return np.full(SHOWN, sum(design.study.control.links))
    is_on, n_links = is_on[:, :SHOWN], is_on.any(axis=1).sum()
    count = np.pad(is_on.sum(axis=0), (0, SHOWN - is_on.shape[1]))
    return np.where(count > 0, count, n_links)


def _run(design: FixedController, laws: list[Controller]) -> tuple[Study, Result]:
    """The design's first move made fast under each law, and the study of it."""
    study = _fast_move(design.study)
    structure, case = check_run(study)
    # a channel per patch, whatever the law with channels
    structure = structure._replace(
        law=SRF.name, n_frequencies=1, metrics=("residual_rms", "peak_voltage", "control_energy")
    )
    shapes = [jax.tree.map(np.shape, law) for law in laws]
    order, results = [], []
    for k, shape in enumerate(shapes):
        if k in order:
            continue
        alike = [j for j in range(k, len(laws)) if shapes[j] == shape]
        stacked = jax.tree.map(lambda *x: np.stack(x), *(laws[j] for j in alike))
        results.append(jax.tree.map(np.asarray, _simulate(structure, case, stacked)))
        order += alike
    back = np.argsort(order)
    return study, jax.tree.map(lambda *x: np.concatenate(x)[back], *results)


@kept_jit(static_argnums=0)
def _simulate(structure: Structure, case: Case, laws: Controller) -> Result:
    return jax.vmap(lambda law: simulate(structure, case, False, law))(laws)


def _fast_move(study: Study) -> Study:
    """The same with only its first move, at the acceleration of `FAST`, without shaper."""
    points = study.motion.waypoints[:2]
    distance = float(np.hypot(*np.subtract(points[-1], points[0])[:2]))
    time = study.motion.move_time
    time = time if isinstance(time, float) else time[0]
    if distance > 0:
        time = max(FAST[1] * np.sqrt(distance / FAST[0]), 1e-3)
    moving = time if len(points) > 1 else 0.0
    fast = study.change(
        motion__waypoints=points,
        motion__move_time=float(time),
        motion__dwell=0.0,
        shaper__kind="none",
        metrics__residual_length=WINDOW,
    )
    return fast.change(run__duration=moving + residual_delay(fast) + WINDOW + 0.01)
