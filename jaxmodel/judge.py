"""Stability of sampled loops: gain margin, what breaks beyond it, damping by mode.

A pure function of cases, batched, on any device: frequency responses, elementwise steps over lanes
and small eigenvalue problems. Where it cannot tell, it says so; `studies.engine.margins` then takes
eigenvalues of the whole loop.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.damping import damping_ratios
from jaxmodel.drives import DRIVES
from jaxmodel.gain_margin import fold_frequency, gain_margins
from jaxmodel.laws import LAWS
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.loop_figures import MARGIN_MODES
from jaxmodel.parameters import Array, Num, Shaped
from jaxmodel.prepare import prepare
from jaxmodel.return_difference import (
    AssembledModes,
    LoopResponse,
    assembled_modes,
    controlled_first,
    loop_response,
    loop_strength,
    mode_strength,
)
from jaxmodel.steps import Steps, scan_steps

#: Links with less damping [1] have peaks too sharp for a sweep. So they do where a mode of one link
#: has this many times the damping of another link's: such modes stay with their links, and the
#: sweep, which takes them for modes of the machine, misses the sharp one (from 50 times on).
LEAST_DAMPED, UNEVEN = 5e-4, 20.0


class LoopVerdicts(NamedTuple):
    """Figures of n sampled loops about rest at the first way-point."""

    gain_margin: Num[Array, "n"]  # largest common factor on all gains, all smaller ones stable [1]
    breaking_frequency: Num[Array, "n"]  # of what goes unstable at the margin [Hz], NaN: nothing
    # order of the link mode nearest to it, 0: the platform's; NaN: none
    breaking_mode: Num[Array, "n"]
    # least [1] of the most damped modes of each order, one per controlled link
    least_damping: Num[Array, "n J"]
    is_known: Shaped[Array, "n"]  # 0 where the search cannot tell


def with_margin_modes(
    structure: Structure, case: Case, least: int = MARGIN_MODES
) -> tuple[Structure, Case]:
    """The same loop, or loops, with at least this many plant modes, before any motion."""
    n_modes = max(least, structure.n_modes)
    modes = (case.n_modes + least + abs(case.n_modes - least)) // 2  # the larger one, of any array
    still = np.zeros((*np.shape(case.initial.modal)[:-1], n_modes))
    case = case._replace(n_modes=modes, initial=case.initial._replace(modal=still))
    structure = structure.without_run()._replace(
        n_modes=n_modes,
        has_joint_friction=False,
        feedback="sampled",
        has_position_gain=True,
        drive=_about_rest(structure.drive),
    )
    return structure, case


def _about_rest(drive: str) -> str:
    """The drive whose small motions about rest are the same: PD if it only adds feed-forward."""
    law, plain = DRIVES[drive], DRIVES["pd"]
    return plain.name if law.force is plain.force and not law.is_sampled else drive


def can_judge(structure: Structure) -> bool:
    """Whether loops of a structure are sampled and have a return difference link by link."""
    law, drive = LAWS[structure.law], DRIVES[structure.drive]
    is_by_link = law.channel != "none" and not law.is_switching
    has_plain_drive = not drive.is_sampled and not structure.has_drive_lag
    return structure.feedback == "sampled" and is_by_link and has_plain_drive


@compiled("structure", "steps", "n_active")
def judge(
    structure: Structure, cases: Case, steps: Steps = scan_steps, n_active: int | None = None
) -> LoopVerdicts:
    """Judge sampled loops about rest at the first way-point.

    As a scan it compiles for two minutes and more; `studies.batched` runs it by kernels.

    The gain margin is differentiable: where a crossing lies does not change its value to first
    order, so slopes are taken at the place found.

    Args:
        structure: static choices of the runs, of which `can_judge` holds.
        cases: leaves (n, ...), or one case; give many whole, not by `vmap`.
        steps: runs elementwise steps.
        n_active: links under control at most (static); default: all.

    Returns:
        LoopVerdicts, with NaN where a number of the loop is not finite; of one case without its
        axis n.

    Example:
        >>> judge(*paper_case({"link.modes": 2})).gain_margin  # doctest: +SKIP
        Array(2.098, dtype=float64)
    """
    if np.ndim(cases.seed) == 0:
        many = jax.tree.map(lambda x: jnp.asarray(x)[None], cases)
        alone: LoopVerdicts = jax.tree.map(lambda x: x[0], judge(structure, many, steps, n_active))
        return alone
    structure, cases = with_margin_modes(structure, cases)
    response, modes, strength = jax.vmap(partial(_respond, structure), out_axes=-1)(cases)
    mask = cases.control.link_mask.T
    n_links = jnp.sum(mask > 0, axis=0)
    response = controlled_first(response, mask, n_active or len(mask))
    found = gain_margins(response, modes, strength, steps)
    response, modes = jax.lax.stop_gradient((response, modes))
    ratio = damping_ratios(response, modes, n_links, structure.n_controlled, steps)
    apart = jnp.abs(fold_frequency(modes.omega, np.pi / response.period) - jnp.abs(found.omega))
    order = jnp.take_along_axis(
        jnp.argmax(modes.share, axis=0), jnp.argmin(apart, axis=0)[None], axis=0
    )[0]
    is_lost = jnp.isnan(ratio).any(axis=1) & (n_links > 0) & ~jnp.isnan(found.margin)
    return LoopVerdicts(
        gain_margin=found.margin,
        breaking_frequency=jnp.abs(found.omega) / (2 * np.pi),
        breaking_mode=jnp.where(found.is_static | jnp.isnan(found.omega), jnp.nan, order),
        least_damping=ratio,
        is_known=found.is_known & ~is_lost & ~_is_sharp(structure, cases),
    )


def _respond(
    structure: Structure, case: Case
) -> tuple[LoopResponse, AssembledModes, tuple[Array, Array]]:
    """The loop, its modes and their strength."""
    loop = prepare(structure, case).loop
    response = loop_response(structure, case, loop, case.path.waypoints[0])
    modes = assembled_modes(response)
    return response, modes, (loop_strength(response), mode_strength(response, modes))


def _is_sharp(structure: Structure, cases: Case) -> Array:
    """Whether links have peaks too sharp for the sweep, see `LEAST_DAMPED`, (n,)."""
    damping = cases.machine.damping
    falling = jnp.minimum(damping.exponent, 0.0)
    least = jnp.min(damping.ratio, axis=(1, 2)) * float(structure.n_modes) ** (2 * falling)
    low, high = (damping.ratio.min(axis=1), damping.ratio.max(axis=1))
    return (least < LEAST_DAMPED) | jnp.any(high > UNEVEN * low, axis=1)
