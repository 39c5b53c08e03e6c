"""Control laws for one machine: coefficients of the same sampled controller, of equal strength.

Each law has the design's patches, modes, electronics and feed-through compensation; factor 1 gives
mode 1 the damping that the design's own gains intend, a law from a file what it gives.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.controller import Controller, with_gains
from jaxmodel.laws import LAWS
from jaxmodel.laws.contract import Law, as_modal
from jaxmodel.laws.imsc import IMSC
from jaxmodel.laws.state_space import STATE_SPACE
from jaxmodel.parameters import Array
from jaxmodel.prepare import design_controller
from studies.engine.controller import FixedController
from studies.engine.programs import kept_jit
from studies.errors import field_error
from studies.spillover.plants import LoopBuilder, PlantVariant, pad_channels
from studies.study.cases import law_parameters

#: Damping of mode 1 below this share of other modes' damping is rounding [1].
ROUNDING = 1e-9


class Candidate(NamedTuple):
    """A control law; one with channels has one for each patch, see `pad_channels`."""

    law: Law
    controller: Controller  # at factor 1

    def at(self, factor: float) -> Controller:
        """All gains times a factor."""
        return with_gains(self.controller, factor)


def all_laws(design: FixedController, builder: LoopBuilder, plant: PlantVariant) -> list[Candidate]:
    """All available laws; the design's own law with the design's own numbers.

    Args:
        design: whose machine the laws control.
        builder: of its loops.
        plant: where strength is compared.

    Raises:
        StudyError: velocity gains that do not damp mode 1, so nothing to compare strength by.
    """
    control = design.study.control
    controller = design.controller

    def strength(law: Controller) -> np.ndarray:
        """Damping constant that a law gives mode 1 of each link [N s/m], (3,)."""
        padded = pad_channels(law, design.n_patches)
        observation, actuation = builder.spillover_gains(plant, padded)
        every = np.einsum("irc,ic,icr->ir", actuation, _channels(padded).velocity_gain, observation)
        return np.where(np.abs(every[:, 0]) > ROUNDING * np.abs(every).max(), every[:, 0], 0.0)

    modal = controller if control.law == IMSC.name else _design_law(design, IMSC)
    # a law without velocity feedback counts as strong as modal control with the same settings
    target = strength(controller if _has_velocity_gain(controller) else modal)
    if not np.any(target > 0) or np.any(target < 0):
        raise field_error(
            "control.velocity_gain",
            control.velocity_gain,
            "with control.ratios and control.mode_mask, gains that damp mode 1, to compare laws of "
            "equal strength",
        )
    if modal is not controller:
        modal_strength = strength(modal)
        if np.any((target > 0) & (modal_strength == 0)):
            raise field_error(
                "control.ratios",
                control.ratios,
                "with control.mode_mask, mode 1 on, to compare with IMSC of equal strength",
            )
        modal = _scale(modal, target, modal_strength)

    def as_strong(law: Law) -> Controller:
        if law.as_strong is not None:
            return _design_law(design, law, modal)
        own = _design_law(design, law)
        return _scale(own, target, strength(own))

    own = {control.law: controller, IMSC.name: modal}
    return [
        Candidate(
            law, _unify_channels(own[name] if name in own else as_strong(law), design.n_patches)
        )
        for name, law in LAWS.items()
        if name in own or law is not STATE_SPACE
    ]


def _has_velocity_gain(law: Controller) -> bool:
    return isinstance(law.feedback, Channels) and bool(np.any(law.feedback.velocity_gain))


def _unify_channels(law: Controller, n_channels: int) -> Controller:
    """With a channel for each patch and rivals, if none: one shape for all laws with channels."""
    if not isinstance(law.feedback, Channels):
        return law
    channels = law.feedback
    if channels.rival_omega is None:
        channels = channels._replace(rival_omega=np.zeros_like(channels.velocity_gain))
    return pad_channels(law._replace(feedback=channels), n_channels)


def _channels(law: Controller) -> Channels:
    assert isinstance(law.feedback, Channels)
    return law.feedback


def _scale(law: Controller, target: np.ndarray, strength: np.ndarray) -> Controller:
    """Velocity gains of each link times target/strength, (3,) each; 0 where there are none."""
    is_there = strength != 0
    factor = np.where(is_there, target / np.where(is_there, strength, 1.0), 0.0)
    channels = _channels(law)
    velocity = factor[:, None] * channels.velocity_gain
    return law._replace(feedback=channels._replace(velocity_gain=velocity))


@kept_jit(static_argnums=0)
def _design(structure: Structure, case: Case, gains: tuple[Array, Array] | None) -> Controller:
    """Design with the structure's law; gains: of the modal control whose strength it must match."""
    bases, law = find_bases(structure, case), LAWS[structure.law]
    if gains is not None:
        assert law.as_strong is not None
        case = case._replace(control=as_modal(case.control, *gains))
        nominal = design_controller(structure, case, bases).nominal
        case = case._replace(control=law.as_strong(case, nominal))
    return design_controller(structure, case, bases).controller


def _design_law(design: FixedController, law: Law, modal: Controller | None = None) -> Controller:
    """The study's controller with another law, NumPy arrays.

    Args:
        design: of the study.
        law: which one.
        modal: modal control whose strength it must match; None: the study's settings.
    """
    structure = design.structure._replace(
        law=law.name,
        n_steps=1,
        has_position_gain=law.has_position or design.structure.has_position_gain,
    )
    control = design.case.control._replace(parameters=law_parameters(design.study, law))
    gains = None
    if modal is not None:
        velocity, position = _channels(modal).velocity_gain, _channels(modal).position_gain
        gains = velocity, np.zeros_like(velocity) if position is None else position
    case = design.case._replace(control=control)
    return jax.tree.map(np.asarray, _design(structure, case, gains))
