"""What the sampled loop of the machine makes of each place of the pairs.

Mode 1 of each link is controlled through one pair, by positive position feedback: with a single
pair, the velocity estimates of independent modal space control are unstable at nearly every place.
Of all gains within the margin the best one counts.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, loop_matrices
from studies.engine.programs import kept_jit
from studies.papers.gupta_2010.criteria import LinkPlaces
from studies.study.cases import build_cases, build_structure
from studies.study.spec import Study
from studies.threads import serial_blas

#: Modes per link; the static response of the others is exact.
MODES = 6
#: Factor by which gains may grow, every smaller one stable [1].
MARGIN = 2.0
#: Law of the loops.
LAW = "ppf"


class ClosedLoops(NamedTuple):
    """Leading axis: places of the pairs. Energies are those after a pluck of every first mode."""

    place: np.ndarray  # centre along the links [m], (n,)
    factor: np.ndarray  # of the gains [1], (g,)
    energy: np.ndarray  # left by control, over that without; NaN: unstable [1], (n, g)
    link: LinkPlaces  # link 1, for the criteria

    @property
    def residual(self) -> np.ndarray:
        """Least rms vibration within the margin over that without control [1], (n,)."""
        is_stable = np.logical_and.accumulate(np.isfinite(self.energy), axis=1)
        largest = np.max(np.where(is_stable, self.factor, 0.0), axis=1, keepdims=True)
        is_allowed = self.factor * MARGIN <= largest
        least = np.min(np.where(is_allowed, self.energy, 1.0), axis=1)
        return np.sqrt(np.minimum(least, 1.0))


def close_loops(study: Study, place: np.ndarray, factor: np.ndarray) -> ClosedLoops:
    """Loops with a pair of each link at given places, at home.

    Args:
        study: the machine and its gains.
        place: centre along every link [m], (n,).
        factor: of the gains [1], ascending, (g,).
    """
    study = study.change(
        link__modes=MODES,
        control__law=LAW,
        control__modes=1,
        patches__centers=(float(place[0]),),
        metrics__stations=(0.25, 0.5, 0.75),
    )
    columns = {"patches.centers": np.repeat(place[:, None, None], 3, axis=1)}
    structure = build_structure(study, columns)._replace(n_steps=1, n_frequencies=1)
    cases = build_cases(study, columns, structure)
    cases = jax.tree.map(lambda x: np.broadcast_to(x, (len(place), *np.shape(x)[1:])), cases)
    found = _loops(structure, cases, jnp.asarray(study.motion.waypoints[0]))
    without, feedback, output, *link = map(np.asarray, found)
    start = np.zeros(without.shape[-1])
    start[2 * structure.n_pose : 2 * structure.n_pose + 3 * MODES : MODES] = 1.0
    with serial_blas():
        free = np.array([_energy(m, c, start) for m, c in zip(without, output, strict=True)])
        energy = np.array(
            [
                [_energy(m + g * f, c, start) for g in factor]
                for m, f, c in zip(without, feedback, output, strict=True)
            ]
        )
    return ClosedLoops(
        place=place,
        factor=factor,
        energy=energy / free[:, None],
        link=LinkPlaces(*link),
    )


@kept_jit(static_argnums=0)
def _loops(structure: Structure, cases: Case, pose: Array) -> tuple[Array, ...]:
    def one(case: Case) -> tuple[Array, ...]:
        loop = prepare(structure, case).loop
        matrices = loop_matrices(structure, case, loop, loop.controller, pose, None)
        plant = loop.plant
        zeta = plant.damping[0] / (2 * plant.modal_mass[0] * loop.omega[0])
        middle = loop.deflection_at.shape[1] // 2
        modal = loop.deflection_at[0, middle] * loop.actuator[0, :, 0] / loop.omega[0] ** 2
        assert loop.left_out is not None
        return (
            matrices.open,
            matrices.feedback,
            matrices.deflection,
            loop.omega[0],
            zeta,
            loop.actuator[0, :, 0],
            loop.sensor[0, 0],
            jnp.sum(modal) + loop.left_out.deflection[0, middle, 0],
        )

    return jax.vmap(one)(cases)


def _energy(matrix: np.ndarray, output: np.ndarray, start: np.ndarray) -> float:
    """sum over samples of |C M^k b|^2 by eigenvectors; NaN if unstable."""
    value, vector = np.linalg.eig(matrix)
    if np.abs(value).max() > 1 + RADIUS_TOLERANCE:
        return np.nan
    part = output @ (vector * np.linalg.solve(vector, start.astype(complex)))
    return float(np.sum((part.T @ part.conj()) / (1 - np.outer(value, value.conj()))).real)
