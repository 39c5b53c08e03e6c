"""The plants that a design is judged on, and the linearised loops with its controller.

The controller's coefficients stay what the design makes them; the plants differ in their number of
modes, their modal basis and the lengths that the patches really have.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller
from jaxmodel.parameters import Array
from jaxmodel.piezo import placement_faults
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import LoopMatrices, closed_loop
from studies.errors import field_error
from studies.export.controller import FixedController
from studies.stability import link_poles

#: Plant modes per link at most.
LARGEST = 10
#: True length of sensors and of actuators over what the controller believes [1].
LENGTHS = (0.8, 1.0, 1.25)


class Plant(NamedTuple):
    """What sets one plant apart."""

    basis: str
    n_modes: int  # per link
    sensor: float  # true sensor length over the one that the controller believes [1]
    actuator: float  # the same for actuators [1]

    @property
    def lengths(self) -> str:
        """In words."""
        return f"sensors x {self.sensor:g}, actuators x {self.actuator:g}"

    def __str__(self) -> str:
        return f"{self.basis}, {self.n_modes} modes a link, {self.lengths}"


class SampledLoop(NamedTuple):
    """A linearised loop on the host, with nothing in it of modes that its plant does not have."""

    open: np.ndarray  # transition over a sample without gains, (n, n)
    feedback: np.ndarray  # what the gains add, (n, n)
    mode_poles: np.ndarray  # of the link modes without control [rad/s], complex, (J, 3)
    omega: np.ndarray  # of the plant's modal coordinates [rad/s], (3, r)
    period: float  # [s]

    @property
    def n_modes(self) -> int:
        """r of each link."""
        return self.omega.shape[1]

    def poles(self, factor: float) -> np.ndarray:
        """Discrete poles with all gains times a factor, (n,)."""
        return np.linalg.eigvals(self.open + factor * self.feedback)


class Leakage(NamedTuple):
    """What passes between channels and plant modes, in the plant basis' own scale."""

    observation: Array  # channel signal per modal coordinate, filter x sensor, (3, C, R)
    actuation: Array  # modal force per channel force, actuator x synthesizer, (3, R, C)


class LoopMaker:
    """Makes loops of one design's machine with any controller; one compilation for each basis."""

    def __init__(self, found: FixedController) -> None:
        """
        Args:
            found: the design with its own controller.
        """
        self._found = found
        self._case = found.case._replace(
            initial=found.case.initial._replace(modal=np.zeros((3, LARGEST)))
        )
        self._pose = np.array(found.study.motion.waypoints[0], float)

    def fault(self, plant: Plant) -> str:
        """Why there is no such plant, "" where there is one."""
        study, patches = self._found.study, self._placed(plant).machine.patches
        is_off, is_overlapping = placement_faults(patches, study.link.length)
        if is_off or is_overlapping:
            what = "patches leave the link" if is_off else "patches overlap"
            return f"{plant.lengths}: {what}"
        if plant.basis == "pinned_free" and study.drive.locked:
            return f"{plant.basis}: its sliders cannot be locked"
        has_inertia = study.link.joint_inertia_b or study.link.joint_inertia_c
        if plant.basis != "loaded" and has_inertia:
            return f"{plant.basis}: it has no rotary inertia at the joints"
        return ""

    def loop(self, plant: Plant, law: Controller) -> SampledLoop:
        """The loop of a plant and a controller with a channel for each patch, see `widened`."""
        matrices, omega, _ = self._look(plant, law)
        kept, of_plant = _kept(matrices, plant.n_modes)
        return SampledLoop(
            matrices.open[np.ix_(kept, kept)],
            matrices.feedback[np.ix_(kept, kept)],
            link_poles(matrices.plant[np.ix_(of_plant, of_plant)], plant.n_modes),
            omega[:, : plant.n_modes],
            float(self._found.case.electronics.period),
        )

    def leakage(self, plant: Plant, law: Controller) -> Leakage:
        """What the channels of a controller as `widened` see of a plant's modes, and do to them."""
        _, _, (observation, actuation) = self._look(plant, law)
        return Leakage(observation[:, :, : plant.n_modes], actuation[:, : plant.n_modes])

    def _look(self, plant: Plant, law: Controller) -> tuple[LoopMatrices, np.ndarray, Leakage]:
        known = self._found.structure
        # nothing that only a controller's own design depends on: one program for all laws
        structure = Structure(
            n_modes=LARGEST, n_controlled=known.n_controlled, n_patches=known.n_patches,
            n_steps=1, n_frequencies=1, basis=plant.basis, has_shortening=known.has_shortening,
            law="srf",
            has_feedforward=known.has_feedforward, has_friction=known.has_friction,
            has_position_gain=False, is_coupled=known.is_coupled, has_wrench=known.has_wrench,
            has_sensor_highpass=known.has_sensor_highpass, has_amplifier=known.has_amplifier,
        )  # fmt: skip
        law = jax.tree.map(jnp.asarray, law)
        return jax.tree.map(np.asarray, _look(structure, self._placed(plant), self._pose, law))

    def _placed(self, plant: Plant) -> Case:
        machine = self._case.machine
        patches = machine.patches._replace(
            sensor_length=plant.sensor * machine.patches.sensor_length,
            actuator_length=plant.actuator * machine.patches.actuator_length,
        )
        return self._case._replace(
            machine=machine._replace(patches=patches), n_modes=jnp.asarray(plant.n_modes)
        )


@partial(jax.jit, static_argnums=0)
def _look(
    structure: Structure, case: Case, pose: Array, law: Controller
) -> tuple[LoopMatrices, Array, Leakage]:
    loop = prepare(structure, case).loop
    observation = jnp.einsum("ick,ikr->icr", law.filter, loop.sensor)
    force = loop.plant.modal_mass[:, None, None] * loop.actuator
    actuation = jnp.einsum("irk,ikc->irc", force, law.synthesizer)
    leakage = Leakage(observation, actuation)
    return closed_loop(structure, case, pose, law), loop.omega, leakage


def _kept(matrices: LoopMatrices, n_modes: int) -> tuple[np.ndarray, np.ndarray]:
    """Entries of the loop's and of the plant's state that a plant with fewer modes has."""

    def entries(size: int) -> np.ndarray:
        is_kept = np.ones(size, bool)
        modes = is_kept[6 : 6 + 6 * LARGEST].reshape(6, LARGEST)
        modes[:, n_modes:] = False
        return np.flatnonzero(is_kept)

    return entries(len(matrices.open)), entries(len(matrices.plant))


def widened(law: Controller, n_channels: int) -> Controller:
    """The same controller with idle channels behind its own, so that all laws have one shape.

    Args:
        law: NumPy arrays.
        n_channels: of each link.
    """
    shape = law.velocity_gain.shape
    more = n_channels - shape[1]

    def padded(x: Any, axis: int = 1) -> np.ndarray:
        return np.pad(x, [(0, more if k == axis else 0) for k in range(x.ndim)])

    def full(x: Any) -> np.ndarray:
        return np.pad(np.broadcast_to(x, shape), ((0, 0), (0, more)), mode="edge")

    none = np.zeros(shape)
    position, rival = law.position_gain, law.rival_omega
    return law._replace(
        filter=padded(law.filter),
        estimator=jax.tree.map(full, law.estimator),
        velocity_gain=padded(law.velocity_gain),
        position_gain=padded(none if position is None else position),
        synthesizer=padded(law.synthesizer, 2),
        rival_omega=None if rival is None else padded(rival),
    )


def plant_sizes(found: FixedController, sizes: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Numbers of plant modes per link, rising; by default from the controlled ones to `LARGEST`.

    Raises:
        StudyError: fewer than are controlled, or more than `LARGEST`.
    """
    smallest = found.structure.n_controlled
    if smallest > LARGEST:
        raise field_error("control.modes", smallest, f"1 to {LARGEST}, the plant modes looked at")
    sizes = tuple(sorted(sizes or range(smallest, LARGEST + 1)))
    if not smallest <= sizes[0] <= sizes[-1] <= LARGEST:
        raise field_error("sizes", sizes, f"{smallest}, as many as are controlled, to {LARGEST}")
    return sizes


def all_plants(
    bases: tuple[str, ...], sizes: tuple[int, ...], lengths: tuple[float, ...]
) -> np.ndarray:
    """Plants of every basis, sensor length, actuator length and size, (B, S, A, N) of `Plant`.

    Args:
        bases: modal bases of the plant.
        sizes: modes per link.
        lengths: true lengths over believed ones, of sensors and of actuators [1].
    """
    plants = np.empty((len(bases), len(lengths), len(lengths), len(sizes)), object)
    for at in np.ndindex(plants.shape):
        b, s, a, n = at
        plants[at] = Plant(bases[b], sizes[n], lengths[s], lengths[a])
    return plants
