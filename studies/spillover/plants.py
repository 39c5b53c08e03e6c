"""The plants on which a design is judged, and the linearised loops with its controller.

The controller's coefficients stay those of the design; the plants differ in their number of modes,
their modal basis and one mismatch each from the controller's model.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, channel_parts
from jaxmodel.laws.srf import SRF
from jaxmodel.linear import resting
from jaxmodel.loop import coordinate_omega
from jaxmodel.loop_figures import MARGIN_MODES
from jaxmodel.parameters import Array
from jaxmodel.piezo import placement_faults
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import LoopMatrices, loop_matrices
from studies.engine.controller import FixedController
from studies.engine.host_loop import SampledLoop, sampled_loop
from studies.engine.programs import kept_jit
from studies.errors import field_error
from studies.space.machines import ModelMismatch as ModelMismatch
from studies.space.machines import patch_lengths as patch_lengths

#: Plant modes per link at most.
LARGEST = MARGIN_MODES
#: Beyond the controlled modes: margins have converged, and what remains of that is seen.
SIZES = (8, LARGEST)


class PlantVariant(NamedTuple):
    """What distinguishes one plant."""

    basis: str
    n_modes: int  # per link
    mismatch: ModelMismatch = ModelMismatch()


class SpilloverGains(NamedTuple):
    """Coupling between channels and plant modes, in the scale of the plant's basis."""

    observation: Array  # channel signal per modal coordinate, filter x sensor, (n, C, R)
    actuation: Array  # modal force per channel force, actuator x synthesizer, (n, R, C)


_placement_faults = jax.jit(placement_faults)


class LoopBuilder:
    """Builds loops of one design's machine with any controller; one compilation per basis."""

    def __init__(self, design: FixedController) -> None:
        """
        Args:
            design: with its own controller.
        """
        self._design = design
        self._case = design.case._replace(
            initial=design.case.initial._replace(
                modal=np.zeros((design.structure.n_links, LARGEST))
            )
        )
        self._pose = np.array(design.study.motion.waypoints[0], float)

    def fault(self, plant: PlantVariant) -> str:
        """Why there is no such plant, "" if there is one."""
        study, machine = self._design.study, self._mismatched_case(plant).machine
        is_off, is_overlapping = _placement_faults(machine.patches, machine.beam.length)
        if is_off or is_overlapping:
            fault = "patches leave the link" if is_off else "patches overlap"
            return f"{plant.mismatch}: {fault}"
        if not BASES[plant.basis].is_on_chord and study.drive.locked:
            return f"{plant.basis}: its drives cannot be locked"
        link, joint = study.link, plant.mismatch.joint_inertia
        inertia = (link.joint_inertia_b, link.joint_inertia_c, joint or 0.0)
        if not BASES[plant.basis].has_joints and any(np.any(part) for part in inertia):
            size = f" of {joint:g} kg m2" if joint else ""
            return f"{plant.basis}: it has no rotary inertia{size} at the joints"
        return ""

    def loop(self, plant: PlantVariant, law: Controller) -> SampledLoop:
        """The loop of a plant and a controller with a channel for each patch (`pad_channels`)."""
        matrices, omega, _ = self._evaluate(plant, law)
        structure = plant_structure(self._design, plant.basis, LARGEST)
        kept, of_plant = _kept_states(matrices, structure, plant.n_modes)
        matrices = matrices._replace(
            open=matrices.open[np.ix_(kept, kept)],
            feedback=matrices.feedback[np.ix_(kept, kept)],
            plant=matrices.plant[np.ix_(of_plant, of_plant)],
            reference=None if matrices.reference is None else matrices.reference[kept],
        )
        period = float(self._design.case.electronics.period)
        omega = omega[:, _is_kept(structure, plant.n_modes)]
        return sampled_loop(matrices, omega, period, plant.n_modes, structure.has_stretch)

    def spillover_gains(self, plant: PlantVariant, law: Controller) -> SpilloverGains:
        """Coupling of the channels of a padded controller with a plant's modes, both ways."""
        _, _, (observation, actuation) = self._evaluate(plant, law)
        return SpilloverGains(observation[:, :, : plant.n_modes], actuation[:, : plant.n_modes])

    def _evaluate(
        self, plant: PlantVariant, law: Controller
    ) -> tuple[LoopMatrices, np.ndarray, SpilloverGains]:
        structure = plant_structure(self._design, plant.basis, LARGEST)
        law = law._replace(feedback=law.feedback.without_rivals())  # linear: nothing switches
        law = jax.tree.map(jnp.asarray, law)
        return jax.tree.map(
            np.asarray, _evaluate_loop(structure, self._mismatched_case(plant), self._pose, law)
        )

    def _mismatched_case(self, plant: PlantVariant) -> Case:
        machine, true = self._case.machine, plant.mismatch
        patches, beam = machine.patches, machine.beam
        patches = patches._replace(
            sensor_length=true.sensor * patches.sensor_length,
            actuator_length=true.actuator * patches.actuator_length,
        )
        beam = beam._replace(stiffness_factor=true.frequency**2 * beam.stiffness_factor)
        if true.joint_inertia is not None:
            joint = np.full_like(beam.joint_inertia_c, true.joint_inertia)
            beam = beam._replace(joint_inertia_c=joint)
        return self._case._replace(
            machine=machine._replace(patches=patches, beam=beam),
            n_modes=jnp.asarray(plant.n_modes),
        )


def plant_structure(design: FixedController, basis: str, n_modes: int) -> Structure:
    """Static choices of a plant under a design's controller.

    They leave out everything that only a controller's own design depends on: one program for all
    laws, which have a channel for each patch (`pad_channels`).

    Args:
        design: with its controller.
        basis: of the plant.
        n_modes: per link.
    """
    nominal = design.structure.without_run()
    return nominal._replace(
        n_modes=n_modes,
        basis=basis,
        controller_basis=Structure().controller_basis,
        has_stretch=nominal.has_stretch and BASES[basis].is_on_chord,
        feedback="sampled",
        law=SRF.name,
        has_notch=False,
        has_joint_friction=False,
        has_poles=False,
        has_position_gain=False,
    )


@kept_jit(static_argnums=0)
def _evaluate_loop(
    structure: Structure, case: Case, pose: Array, law: Controller
) -> tuple[LoopMatrices, Array, SpilloverGains]:
    loop = prepare(structure, case).loop
    channels = channel_parts(law)
    force = loop.plant.modal_mass[:, None, None] * loop.actuator
    gains = SpilloverGains(
        jnp.einsum("ick,ikr->icr", channels.filter, loop.sensor),
        jnp.einsum("irk,ikc->irc", force, channels.synthesizer),
    )
    at_rest = resting(structure, case)
    matrices = loop_matrices(structure, case, loop, law, pose, at_rest)
    return matrices, coordinate_omega(loop), gains


def _is_kept(structure: Structure, n_modes: int) -> np.ndarray:
    """Which of a link's coordinates exist with fewer modes."""
    order = np.arange(structure.n_coordinates)
    return (order < n_modes) | (order >= structure.n_modes)


def _kept_states(
    matrices: LoopMatrices, structure: Structure, n_modes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Entries of the loop's and the plant's state that exist with fewer modes."""
    first, rows = 2 * structure.n_pose, 2 * structure.n_links  # of the modes: values and rates

    def entries(size: int) -> np.ndarray:
        is_kept = np.ones(size, bool)
        of_link = _is_kept(structure, n_modes)
        is_kept[first : first + rows * len(of_link)] = np.tile(of_link, rows)
        return np.flatnonzero(is_kept)

    return entries(len(matrices.open)), entries(len(matrices.plant))


def pad_channels(law: Controller, n_channels: int) -> Controller:
    """The same controller padded with idle channels, so that all laws have one shape.

    Args:
        law: NumPy arrays.
        n_channels: of each link; a controller without any stays as it is.
    """
    return law._replace(feedback=law.feedback.padded(n_channels))


def plant_sizes(design: FixedController, sizes: tuple[int, ...] = ()) -> tuple[int, ...]:
    """Numbers of plant modes per link, rising; default: the controlled ones, and `SIZES`.

    Raises:
        StudyError: fewer than are controlled, or more than `LARGEST`.
    """
    smallest = design.structure.n_controlled
    if smallest > LARGEST:
        raise field_error("control.modes", smallest, f"1 to {LARGEST}, the most plant modes")
    sizes = tuple(sorted(sizes or {smallest, *(n for n in SIZES if n > smallest)}))
    if not smallest <= sizes[0] <= sizes[-1] <= LARGEST:
        raise field_error("sizes", sizes, f"{smallest}, as many as are controlled, to {LARGEST}")
    return sizes


def all_plants(
    bases: tuple[str, ...], mismatches: tuple[ModelMismatch, ...], sizes: tuple[int, ...]
) -> np.ndarray:
    """Plants of every basis, mismatch and size, (B, D, N) of `Plant`.

    Args:
        bases: modal bases of the plant.
        mismatches: from the controller's model.
        sizes: modes per link.
    """
    plants = np.empty((len(bases), len(mismatches), len(sizes)), object)
    for b, d, n in np.ndindex(plants.shape):
        plants[b, d, n] = PlantVariant(bases[b], sizes[n], mismatches[d])
    return plants
