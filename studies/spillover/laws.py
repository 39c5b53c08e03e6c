"""Control laws for one machine: coefficients of the same sampled controller, equally strong.

Each law has the design's patches, modes, electronics and feed-through compensation; factor 1 is as
much damping of mode 1 as the design's own gains are meant to give.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.control import optimal_gains
from jaxmodel.controller import Controller
from jaxmodel.ppf import design_position_filter
from jaxmodel.prepare import design_controller
from studies.errors import field_error
from studies.export.controller import FixedController
from studies.spillover.plants import LoopMaker, Plant, widened

#: Damping of the filters of positive position feedback [1].
FILTER_ZETA = 0.5
#: Damping of mode 1 below this share of that of other modes is rounding [1].
ROUNDING = 1e-9


class Law(NamedTuple):
    """A control law with a channel for each patch, see `widened`."""

    name: str
    controller: Controller  # at factor 1

    def at(self, factor: float) -> Controller:
        """All gains times a factor."""
        law = self.controller
        assert law.position_gain is not None
        return law._replace(
            velocity_gain=factor * law.velocity_gain, position_gain=factor * law.position_gain
        )

    @property
    def linear_parts(self) -> list[tuple[slice, Controller]]:
        """What a linear analysis can judge: the law, or each rival channel by itself.

        Each with the modes whose damping it tells.
        """
        law = self.controller
        assert law.position_gain is not None and law.rival_omega is not None
        parts = []
        for j in np.flatnonzero(law.rival_omega.any(axis=0)):
            alone = np.arange(law.rival_omega.shape[1]) == j
            part = law._replace(
                velocity_gain=alone * law.velocity_gain, position_gain=alone * law.position_gain,
                rival_omega=np.zeros_like(law.rival_omega),
            )  # fmt: skip
            parts.append((slice(j, j + 1), part))
        return parts or [(slice(None), law)]


def all_laws(found: FixedController, maker: LoopMaker, plant: Plant) -> list[Law]:
    """The laws to compare; the one that the design is of with the design's own numbers.

    Args:
        found: the design.
        maker: of its loops.
        plant: where strength is compared.

    Raises:
        StudyError: velocity gains that do not damp mode 1, so nothing to compare strength by.
    """
    given, has_modes = found.controller, found.is_modal
    imsc = given if has_modes else _designed(found, "imsc")
    srf = _designed(found, "srf") if has_modes else given

    def strength(law: Controller) -> np.ndarray:
        """Damping constant that a law gives mode 1 of each link [N s/m], (3,)."""
        seen, driven = maker.leakage(plant, widened(law, found.n_patches))
        gain = widened(law, found.n_patches).velocity_gain
        every = np.einsum("irc,ic,icr->ir", driven, gain, seen)
        return np.where(np.abs(every[:, 0]) > ROUNDING * np.abs(every).max(), every[:, 0], 0.0)

    control, wanted = found.study.control, strength(given)
    if not np.any(wanted > 0) or np.any(wanted < 0):
        raise field_error(
            "control.velocity_gain", control.velocity_gain,
            "with control.ratios and control.mode_mask, gains that damp mode 1, to compare laws of "
            "equal strength",
        )  # fmt: skip
    if has_modes:
        srf = _scaled(srf, wanted, strength(srf))
    else:
        has = strength(imsc)
        if np.any((wanted > 0) & (has == 0)):
            raise field_error(
                "control.ratios", control.ratios,
                "with control.mode_mask, mode 1 on, to compare with IMSC of equal strength",
            )  # fmt: skip
        imsc = _scaled(imsc, wanted, has)
    omega, is_on = _assembled_omega(found), imsc.velocity_gain != 0
    if imsc.position_gain is not None:
        is_on = is_on | (imsc.position_gain != 0)
    laws = {
        "IMSC": imsc,
        "strain rate feedback": srf,
        "IMSC-LQR": _optimal(imsc, _modal_mass(found), omega),
        "modified IMSC": imsc._replace(rival_omega=np.where(is_on, omega, 0.0)),
        "positive position feedback": _position_feedback(found, imsc, omega),
    }
    return [Law(name, _even(law, found.n_patches)) for name, law in laws.items()]


def _assembled_omega(found: FixedController) -> np.ndarray:
    """Frequencies of the controlled modes as the controller believes [rad/s], (3, C)."""
    return np.asarray(find_bases(found.structure, found.case).believed_omega)


def _even(law: Controller, n_channels: int) -> Controller:
    """With a channel for each patch and rivals, if none: one shape for all laws."""
    if law.rival_omega is None:
        law = law._replace(rival_omega=np.zeros_like(law.velocity_gain))
    return widened(law, n_channels)


def _scaled(law: Controller, wanted: np.ndarray, has: np.ndarray) -> Controller:
    """Velocity gains of each link times wanted/has, (3,) each; 0 where there are none."""
    is_there = has != 0
    factor = np.where(is_there, wanted / np.where(is_there, has, 1.0), 0.0)
    return law._replace(velocity_gain=factor[:, None] * law.velocity_gain)


@partial(jax.jit, static_argnums=0)
def _design(structure: Structure, case: Case) -> Controller:
    return design_controller(structure, case, find_bases(structure, case)).controller


_filters = jax.jit(design_position_filter)


def _designed(found: FixedController, law: str) -> Controller:
    """The study's controller by another law, NumPy arrays."""
    structure = found.structure._replace(law=law, n_steps=1)
    return jax.tree.map(np.asarray, _design(structure, found.case))


def _modal_mass(found: FixedController) -> np.ndarray:
    """Modal masses of the controller's basis [kg], (3, C)."""
    control = found.case.control
    ones = np.ones_like(control.ratio)
    unit = control._replace(
        velocity_gain=ones[:, 0], ratio=ones, mode_mask=ones, link_mask=ones[:, 0],
        gain_factor=np.ones(()), is_per_mass=np.ones(()),
    )  # fmt: skip
    # a gain of 1 per modal mass
    return _designed(found._replace(case=found.case._replace(control=unit)), "imsc").velocity_gain


def _optimal(imsc: Controller, mass: np.ndarray, omega: np.ndarray) -> Controller:
    """Optimal gains of every mode with one weight, which gives the first mode its own k_d.

    From k_d^2 = 2 k_p + 1/R: 1/R = h (h - 2 omega) with h^2 = k_d^2 + 4 omega^2.
    """
    is_on = imsc.velocity_gain != 0
    first = int(np.flatnonzero(is_on.any(axis=0))[0])
    gain = (imsc.velocity_gain / mass)[is_on[:, first], first].mean()
    at = omega[is_on[:, first], first].mean()
    size = np.hypot(gain, 2 * at)
    weight = (1 + 2 * at / size) / gain**2
    gains = jax.tree.map(np.asarray, optimal_gains(omega, weight))
    return imsc._replace(
        velocity_gain=is_on * mass * gains.velocity, position_gain=is_on * mass * gains.position
    )


def _position_feedback(found: FixedController, imsc: Controller, omega: np.ndarray) -> Controller:
    """Positive position feedback that damps each assembled mode as much as IMSC."""
    filters = jax.tree.map(np.asarray, _filters(omega, FILTER_ZETA, found.case.electronics))
    is_fit = filters.damping > 0
    gain = np.where(is_fit, imsc.velocity_gain / np.where(is_fit, filters.damping, 1.0), 0.0)
    return imsc._replace(estimator=filters.estimator, velocity_gain=0 * gain, position_gain=-gain)
