"""What all runs of one machine share: the controller's modes and the ADC step in them."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.prepare import prepare
from studies.engine.programs import kept_jit


class SharedFrame(NamedTuple):
    """What all cases share."""

    modal_omega: np.ndarray  # frequencies of the controller's modes [rad/s], (3, C)
    mode_shape: np.ndarray  # of the controller's modes at the stations [1], (3, S, C)
    adc_step: np.ndarray  # of one ADC step, in the deflection of mode 1 [m], (3,)


@kept_jit(static_argnums=0)
def _prepare_frame(structure: Structure, case: Case) -> SharedFrame:
    loop = prepare(structure, case).loop
    machine, n = case.machine, structure.n_controlled
    shape = build_basis(
        structure.controller_basis, machine.beam, machine.patches, n, station_places(case)
    ).deflection_at
    one_step = loop.controller.adc_step / loop.controller.adc_gain
    largest = jnp.max(jnp.abs(loop.sensor[:, :, 0]), axis=1)
    return SharedFrame(loop.modal_omega, shape, one_step / largest)


def frame_of(structure: Structure, case: Case) -> SharedFrame:
    """Modes of the controller and its ADC step, which all cases of one machine share."""
    return jax.tree.map(np.asarray, _prepare_frame(structure, case))
