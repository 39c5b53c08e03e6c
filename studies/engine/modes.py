"""`studies modes`: natural modes of the assembled machine at a pose."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.kinematics import path_status
from jaxmodel.linear import linearise, mass_and_stiffness, natural_modes, resting
from jaxmodel.prepare import prepare
from studies.engine.preflight import check_pose
from studies.engine.programs import kept_jit
from studies.engine.simplifications import warn_of_patches, warn_of_sizes
from studies.result import Result
from studies.results.labelled import Labelled, derived, labelled, told, unwritten
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study, parse_study

#: Relative difference of equal frequencies.
EQUAL = 1e-6
#: Frequency, over the highest one, up to which a motion counts as rigid: nothing holds it.
RIGID = 1e-6


class NaturalMode(Labelled):
    """A natural mode, and what holds most of its energy."""

    mode: int = told("from 1")
    frequency: float = labelled("Hz", "|lambda| / (2 pi)")
    damping_ratio: float = labelled("1", "of the mode")
    kind: str = told("what holds most of its energy: link, stretch (of links), drive, or rigid")
    share: float = labelled("1", "of the potential energy, in that", default=np.nan)
    links: tuple[int, ...] = told("which take part, from 1; none for other kinds", default=())
    order: int | None = told("of the links' mode, from 1; null for other kinds", default=None)
    platform: str | None = told("on its drive: translates or turns; null for others", default=None)

    @derived("", "the same in words, such as: link 2, mode 1, 96 %")
    def description(self) -> str:
        if self.kind == "rigid":
            return "rigid motion"
        percent = f"{100 * self.share:.0f} %"
        if self.kind == "drive":
            return f"drive, platform {self.platform}, {percent}"
        is_one = len(self.links) == 1
        links = f"link{'' if is_one else 's'} {' '.join(map(str, self.links))}"
        if self.kind == "stretch":
            return f"{links} lengthen{'s' if is_one else ''}, {percent}"
        return f"{links}, mode {self.order}, {percent}"


class NamedModes(Labelled, Result, command="modes", version=2):
    """What `studies modes --json` prints: natural modes of the machine at a pose.

    `link_share` is the strain energy k_ij |q_ij|^2 in modal coordinate j of link i over the mode's
    potential energy x* K x, which in the mean over a period equals its kinetic energy;
    `drive_share` is the rest, in the sliders' springs and in a steady load. Any mixture of modes of
    equal frequency, as symmetric machines have them, is a mode: such modes have their mean shares,
    those of K-orthogonal ones. NaN for rigid motion, which nothing holds.
    """

    frequency: np.ndarray = unwritten()  # |lambda|/2 pi, ascending [Hz], (m,)
    damping_ratio: np.ndarray = unwritten()  # [1], (m,)
    # (X, q) part of the eigenvectors, largest entry 1, one per column, (n, m)
    shape: np.ndarray = unwritten()
    link_share: np.ndarray = unwritten()  # [1], (m, links, R), elongations last if any
    drive_share: np.ndarray = unwritten()  # [1], (m,)
    turn_share: np.ndarray = unwritten()  # of rotation in the platform's kinetic energy [1], (m,)
    has_stretch: bool = unwritten(default=False)  # links lengthen

    @derived("", "ascending in frequency")
    def modes(self) -> list[NaturalMode]:
        shares = self.link_share, self.drive_share, self.turn_share
        rows = zip(self.frequency, self.damping_ratio, *shares, strict=True)
        return [
            NaturalMode(k, float(f), float(ratio), *_kind(link, drive, turn, self.has_stretch))
            for k, (f, ratio, link, drive, turn) in enumerate(rows, 1)
        ]

    @property
    def names(self) -> list[str]:
        """Each in words, such as "link 2, mode 1, 96 %"."""
        return [mode.description for mode in self.modes]


def _kind(
    link_share: np.ndarray, drive_share: float, turn_share: float, has_stretch: bool
) -> tuple[Any, ...]:
    """Kind, share, links, order and platform of `NaturalMode`."""
    if np.isnan(drive_share):
        return ("rigid",)
    if drive_share > 0.5:
        return "drive", float(drive_share), (), None, "turns" if turn_share > 0.5 else "translates"
    order = int(link_share.sum(axis=0).argmax())
    share = link_share[:, order]
    links = np.flatnonzero(share >= share.max() / 3)  # the others hardly take part
    taking_part = float(share[links].sum()), tuple((links + 1).tolist())
    if has_stretch and order == len(link_share[0]) - 1:
        return "stretch", *taking_part
    return "link", *taking_part, order + 1


def modes_study(
    study: Study | None = None,
    pose: tuple[float, ...] | None = None,
    kp: float | None = None,
    kd: float | None = None,
    damping: float | None = None,
    locked: bool | None = None,
    basis: str | None = None,
    n_modes: int | None = None,
) -> Study:
    """The study to linearise; bad values are rejected as in a study file."""
    links = {"modes": 3, "damping_ratio": 0.0, "stretch_damping": 0.0}
    undamped = {"link": links, "drive": {"kd": 0.0}}
    data: dict[str, Any] = (
        undamped if study is None else study.model_dump(mode="json", exclude_unset=True)
    )
    if pose is not None:
        data["motion"] = {"waypoints": [list(pose)]}
    changes = (
        ("link", "basis", basis),
        ("link", "modes", n_modes),
        ("link", "damping_ratio", damping),
        ("drive", "kp", kp),
        ("drive", "kd", kd),
        ("drive", "locked", locked),
        ("control", "feedback", "none"),
        ("shaper", "kind", "none"),
    )
    for section, name, value in changes:
        if value is not None:
            data[section] = data.get(section, {}) | {name: value}
    return parse_study(data)


def machine_modes(study: Study | None = None, **changes: Any) -> NamedModes:
    """Natural modes of the machine held by its drive at a pose, under the study's steady load.

    Args:
        study: supplies machine and damping, at its first way-point; None: the paper's machine at
            home with three modes per link, undamped.
        changes: overrides, by the names of `modes_study`.

    Raises:
        StudyError: value out of range, pose out of reach or singular.
    """
    study = modes_study(study, **changes)
    warn_of_sizes(study)
    warn_of_patches(study)
    structure, case = build_structure(study), as_arrays(build_case(study))
    where = study.motion.waypoints[0]
    code, plant, mass, stiffness, modal_stiffness = jax.tree.map(
        np.asarray, _at_pose(structure, case, np.array(where))
    )
    check_pose(study, "pose", where, int(code))
    modes = natural_modes(plant)
    # the coordinates that the drives hold are not modes
    first = structure.n_pose if study.drive.locked else 0
    frequency, shape = modes.frequency[first:], modes.shape[:, first:]
    link_share = _link_shares(frequency, shape, stiffness, modal_stiffness)
    return NamedModes(
        frequency=frequency,
        damping_ratio=modes.damping_ratio[first:],
        shape=shape,
        link_share=link_share,
        drive_share=1 - link_share.sum(axis=(1, 2)),
        turn_share=_turn_shares(shape, mass, structure.n_pose),
        has_stretch=structure.has_stretch,
    )


def _link_shares(
    frequency: np.ndarray, shape: np.ndarray, stiffness: np.ndarray, modal_stiffness: np.ndarray
) -> np.ndarray:
    """`link_share` of `NamedModes`; stiffness in (X, q), k_ij of the links (n, R)."""
    share = np.full((len(frequency), *modal_stiffness.shape), np.nan)
    group = np.cumsum(np.diff(frequency, prepend=frequency[0]) > EQUAL * frequency)
    for members in (group == k for k in np.unique(group)):
        if frequency[members].max() <= RIGID * frequency.max():
            continue
        mode = shape[:, members]
        energy = mode.conj().T @ stiffness @ mode
        square = np.diag(mode @ np.linalg.solve(energy, mode.conj().T)).real / members.sum()
        square = square[-modal_stiffness.size :]
        share[members] = modal_stiffness * square.reshape(modal_stiffness.shape)
    return share


def _turn_shares(shape: np.ndarray, mass: np.ndarray, n_pose: int) -> np.ndarray:
    """`turn_share` of `NamedModes`; mass in (X, q)."""
    pose = shape[:n_pose]
    part = np.einsum("am,ab,bm->abm", pose.conj(), mass[:n_pose, :n_pose], pose).real
    turning, translating = part[2:, 2:].sum(axis=(0, 1)), part[:2, :2].sum(axis=(0, 1))
    return turning / np.maximum(turning + translating, np.finfo(float).tiny)


@kept_jit(static_argnums=0)
def _at_pose(structure: Structure, case: Case, pose: np.ndarray) -> Any:
    """Status, linear plant, its mass and stiffness matrices, and k_ij of the links."""
    loop = prepare(structure, case).loop
    code, _ = path_status(loop.plant, pose[None])
    plant = linearise(structure, loop, pose, resting(structure, case))
    matrices = mass_and_stiffness(loop, pose, plant)
    return code, plant, *matrices, loop.plant.stiffness
