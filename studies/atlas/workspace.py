"""Natural modes of the machine on a grid of poses: frequencies, shapes, participation, coupling.

The sliders are held by their drive; damping is neglected. Coupling is that of the links' first
modes through platform and sliders: with the pose condensed out of the mass matrix,
M_c = M_qq - M_qX M_XX^-1 M_Xq, it is |M_c,ik|/sqrt(M_c,ii M_c,kk) for links i and k.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import status
from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import close_chain, lift, link_angle, path_status
from jaxmodel.linear import linearise, mass_and_stiffness, resting
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from studies.engine.preflight import check_pose, check_run
from studies.engine.programs import kept_jit
from studies.results.labelled import Labelled, derived, labelled
from studies.study.geometry import machine_geometry
from studies.study.spec import Study

#: Modes per link in these matrices; assembled frequencies converge with the first one.
MAP_MODES = 3
#: Rotations of the platform relative to the path's first pose [rad].
TURNS = (-np.pi / 18, 0.0, np.pi / 18)
#: Points of the map along x and y.
GRID = 61
#: Pairs of links, as in the last axis of `Map.coupling`.
PAIRS = ((0, 1), (0, 2), (1, 2))
#: Poses per call of the compiled program.
_BATCH = 512


class PoseModes(NamedTuple):
    """Natural modes at poses (leading axes), ascending in frequency."""

    frequency: np.ndarray  # [Hz], (..., m)
    shape: np.ndarray  # of (X [m, m, rad], q [m]), largest entry 1, one per column, (..., m, m)
    share: np.ndarray  # strain energy in links 1, 2, 3 and drive, sum 1, (..., m, 4)
    order_share: np.ndarray  # strain energy in the first, second, ... modes of links, (..., m, R)
    coupling: np.ndarray  # of the links' first modes, by PAIRS [1], (..., 3)


_GRID = ("map_phi", "map_y", "map_x")
_OF_LINKS = (*_GRID, "link")
_BENDING = (*_GRID, "bending_mode")


class Map(Labelled):
    """Axes: phi, y, x; NaN where a pose is infeasible, except in `lift`."""

    x: np.ndarray = labelled("m", "platform x", "map_x", file_name="map_x")
    y: np.ndarray = labelled("m", "platform y", "map_y", file_name="map_y")
    phi: np.ndarray = labelled("rad", "platform turn", "map_phi", file_name="map_phi")
    status: np.ndarray = labelled("1", "pose", *_GRID, file_name="map_status", flags=status.REASONS)
    lift: np.ndarray = labelled("1", "sines of the link angles, above 1 out of reach", *_OF_LINKS)
    gamma: np.ndarray = labelled("rad", "link angles", *_OF_LINKS)
    frequency: np.ndarray = labelled(
        "Hz", "of the machine on its drive", *_GRID, "natural_mode", file_name="natural_frequency"
    )
    bending: np.ndarray = labelled(
        "Hz", "the first three bending modes", *_BENDING, file_name="bending_frequency"
    )
    share: np.ndarray = labelled(
        "1", "strain energy in links and drive", *_BENDING, "part", file_name="strain_share"
    )
    coupling: np.ndarray = labelled(
        "1",
        "of the links' first modes, pose condensed out",
        *_GRID,
        "pair",
        file_name="inertial_coupling",
    )

    @derived("1", "two links", "pair")
    def pair(self) -> list[str]:
        return [f"{i + 1}-{k + 1}" for i, k in PAIRS]

    @property
    def margin(self) -> np.ndarray:
        """Distance of the nearest link angle from 0 and 90 deg [rad], (p, n, n)."""
        return np.minimum(self.gamma, np.pi / 2 - self.gamma).min(axis=-1)

    @property
    def squared_margin(self) -> np.ndarray:
        """Square of `margin`, negative out of reach [rad2], (p, n, n).

        Unlike `margin` it crosses the border without a kink, so that contours of it are smooth.
        """
        sine = np.clip(self.lift, -1, 1)
        low = np.arcsin(sine)
        from_square = np.where(self.lift < 1, np.arccos(sine) ** 2, 2 * (1 - self.lift))
        return np.minimum(low * np.abs(low), from_square).min(axis=-1)

    @property
    def spread(self) -> np.ndarray:
        """Width of the first bending triple over its mean [1], (p, n, n)."""
        return np.ptp(self.bending, axis=-1) / self.bending.mean(axis=-1)


def natural_modes_at(study: Study, poses: Any) -> PoseModes:
    """Natural modes at given poses.

    Args:
        study: the machine and its drive.
        poses: (x, y, phi) [m, m, rad], (n, 3).

    Returns:
        PoseModes with leading axis n.

    Raises:
        StudyError: a pose out of reach or singular.
    """
    structure, case = _machine(study)
    poses = np.asarray(poses, float)
    codes = np.asarray(_solve_poses(structure, case, poses)[0])
    for pose, code in zip(poses, codes, strict=True):
        check_pose(study, "pose", tuple(pose.tolist()), int(code))
    return _solve(structure, case, poses)


def map_workspace(study: Study, count: int = GRID, turns: tuple[float, ...] = TURNS) -> Map:
    """Natural modes over everything the platform can reach.

    Args:
        study: the machine and its drive.
        count: points along x and along y.
        turns: of the platform relative to the first pose of the study's path [rad].

    Returns:
        Map.
    """
    structure, case = _machine(study)
    phi = study.motion.waypoints[0][2] + np.array(turns)
    x, y = _extent(structure, case, study, phi, count)
    grid = np.stack(np.meshgrid(phi, y, x, indexing="ij")[::-1], axis=-1)
    poses = grid.reshape(-1, 3)
    codes, gamma, lifts = map(np.asarray, _solve_poses(structure, case, poses))
    good = codes == status.OK
    modes = _solve(structure, case, poses[good])
    chosen = np.sort(np.argsort(-modes.order_share[..., 0], axis=1)[:, :3], axis=1)

    def scatter(values: np.ndarray) -> np.ndarray:
        whole = np.full((len(poses), *values.shape[1:]), np.nan)
        whole[good] = values
        return whole.reshape(*grid.shape[:-1], *values.shape[1:])

    return Map(
        x=x,
        y=y,
        phi=phi,
        status=codes.astype(int).reshape(grid.shape[:-1]),
        lift=lifts.reshape(*grid.shape[:-1], 3),
        gamma=scatter(gamma[good]),
        frequency=scatter(modes.frequency),
        bending=scatter(np.take_along_axis(modes.frequency, chosen, axis=1)),
        share=scatter(np.take_along_axis(modes.share, chosen[..., None], axis=1)),
        coupling=scatter(modes.coupling),
    )


def _machine(study: Study) -> tuple[Structure, Case]:
    """The machine with few modes, without control or shaper."""
    plain = study.change(
        link__modes=min(study.link.modes, MAP_MODES),
        control__feedback="none",
        shaper__kind="none",
        control__ratio_source="given",
    )
    structure, case = check_run(plain)
    return structure._replace(n_steps=1, substeps=1), case


def _extent(
    structure: Structure, case: Case, study: Study, phi: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Grid lines that cover all feasible poses."""
    axis = np.linspace(-0.6, 0.6, 121) * machine_geometry(study)[0].size()
    grid = np.stack(np.meshgrid(phi, axis, axis, indexing="ij")[::-1], axis=-1)
    codes = _solve_poses(structure, case, grid.reshape(-1, 3))[0]
    good = (np.asarray(codes) == status.OK).reshape(grid.shape[:-1]).any(axis=0)
    step = axis[1] - axis[0]
    rows, columns = (axis[np.flatnonzero(good.any(axis=k))] for k in (1, 0))
    return tuple(  # type: ignore[return-value]
        np.linspace(lines[0] - step, lines[-1] + step, count) for lines in (columns, rows)
    )


@kept_jit(static_argnums=0)
def _solve_poses(structure: Structure, case: Case, poses: Array) -> tuple[Array, Array, Array]:
    """Status, link angles [rad] and `lift` of poses, (n,), (n, 3) and (n, 3)."""
    plant = prepare(structure, case).loop.plant

    def one(pose: Array) -> tuple[Array, Array, Array]:
        chain = close_chain(plant, pose, jnp.zeros_like(pose))
        return path_status(plant, pose[None])[0], link_angle(chain), lift(plant, pose)

    return jax.vmap(one)(poses)


@kept_jit(static_argnums=0)
def _matrices(structure: Structure, case: Case, poses: Array) -> tuple[Array, Array, Array]:
    """Mass and stiffness matrices in (X, q), and k_j of the links, (n, m, m) twice, (3, R)."""
    loop = prepare(structure, case).loop

    def one(pose: Array) -> tuple[Array, Array]:
        plant = linearise(structure, loop, pose, resting(structure, case))
        return mass_and_stiffness(loop, pose, plant)

    return *jax.vmap(one)(poses), loop.plant.stiffness


def _solve(structure: Structure, case: Case, poses: np.ndarray) -> PoseModes:
    """Modes at feasible poses, batch by batch in one compiled program."""
    parts = []
    for start in range(0, len(poses), _BATCH):
        batch = poses[start : start + _BATCH]
        filled = np.concatenate([batch, np.repeat(batch[-1:], _BATCH - len(batch), axis=0)])
        mass, stiffness, own = (np.asarray(x) for x in _matrices(structure, case, filled))
        parts.append(_modes(mass[: len(batch)], stiffness[: len(batch)], own))
    return PoseModes(*(np.concatenate(part) for part in zip(*parts, strict=True)))


def _modes(mass: np.ndarray, stiffness: np.ndarray, own: np.ndarray) -> PoseModes:
    """Natural modes of stacked matrices; own: k_j of the links [N/m], (3, R)."""
    inverse = np.linalg.inv(np.linalg.cholesky(mass))
    square, vector = np.linalg.eigh(inverse @ stiffness @ np.swapaxes(inverse, 1, 2))
    shape = np.swapaxes(inverse, 1, 2) @ vector  # x'Mx = 1, so x'Kx = omega^2
    strain = own[..., None] * shape[:, 3:].reshape(-1, *own.shape, shape.shape[-1]) ** 2
    total = np.einsum("nam,nab,nbm->nm", shape, stiffness, shape)
    strain = np.moveaxis(strain / total[:, None, None], -1, 1)  # (n, m, 3, R)
    link = strain.sum(axis=3)
    peak = np.take_along_axis(shape, np.abs(shape).argmax(axis=1)[:, None], axis=1)
    return PoseModes(
        frequency=np.sqrt(np.maximum(square, 0.0)) / (2 * np.pi),
        shape=shape / peak,
        share=np.concatenate([link, 1 - link.sum(axis=2, keepdims=True)], axis=2),
        order_share=strain.sum(axis=2),
        coupling=_coupling(mass, own.shape[1]),
    )


def _coupling(mass: np.ndarray, modes: int) -> np.ndarray:
    rigid, cross, bent = mass[:, :3, :3], mass[:, :3, 3:], mass[:, 3:, 3:]
    left = bent - np.swapaxes(cross, 1, 2) @ np.linalg.solve(rigid, cross)
    first = left[:, ::modes, ::modes]
    size = np.sqrt(np.einsum("nii->ni", first))
    return np.stack([np.abs(first[:, i, k]) / (size[:, i] * size[:, k]) for i, k in PAIRS], axis=1)
