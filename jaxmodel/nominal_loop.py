"""Closed loop of the nominal link, on which poles are placed: where do they lie there?

Modes are decoupled (`laws.poles.nominal_modes`), so that the loop of each is a matter of its own; a
law with a model of whole links (`laws.link_model`) closes the loop of that model.
"""

from __future__ import annotations

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.controller import Controller
from jaxmodel.estimator import FilterState, advance_filters, weighted
from jaxmodel.laws.contract import NominalModel
from jaxmodel.laws.link_model import LinkModel, link_model
from jaxmodel.laws.poles import is_placed, nominal_modes, specified_poles
from jaxmodel.lazy import jax, jnp
from jaxmodel.notch import Notch, advance_notch, design_notch
from jaxmodel.parameters import Array
from jaxmodel.prepare import design_controller
from jaxmodel.state_space import StateSpace


def nominal_loop(structure: Structure, case: Case) -> tuple[Array, Array]:
    """Specified poles, and the loop's transition matrices per sample.

    Args:
        structure: static choices, feedback "sampled", a law that places poles.
        case: the numbers.

    Returns:
        specified poles s [1/s], complex, NaN where a mode has none, (3, C); and
        matrices, (3, B, n, n): B = C modes, or 1 for a whole link.
    """
    design = design_controller(structure, case, find_bases(structure, case))
    poles = specified_poles(case, design.nominal)
    s = -poles.decay + 1j * poles.frequency
    controller, nominal = design.controller, design.nominal
    if isinstance(controller.feedback, Channels):
        matrix = _of_modes(structure, case, controller.feedback, nominal)
    else:
        matrix = _of_links(structure, case, controller, controller.feedback, nominal)
    return jnp.where(is_placed(case, design.nominal), s, jnp.nan), matrix


def _of_modes(structure: Structure, case: Case, law: Channels, nominal: NominalModel) -> Array:
    model = nominal_modes(structure, case, nominal)
    position = 0 * law.velocity_gain if law.position_gain is None else law.position_gain
    n = model.state.shape[-1]
    notch = design_notch(case.control, case.electronics.period) if structure.has_notch else None

    def one(
        model: LinkModel, estimator: Array, velocity: Array, position: Array, notch: Notch | None
    ) -> Array:
        def advance(x: Array) -> Array:
            plant, first, second = x[:n], x[n], (x[n + 1], x[n + 2])
            seen, memory = model.sensor[0] @ plant, x[n + 3 :]
            if notch is not None:
                column = Notch(*(x[None] for x in notch))
                memory, seen = advance_notch(column, (memory[:1, None], memory[1:, None]), seen)
                memory, seen = jnp.ravel(jnp.stack(memory)), seen[0, 0]
            after, line = advance_filters(estimator, FilterState(first, second), seen)
            value = weighted(estimator.position, line) + estimator.direct * seen
            force = -velocity * weighted(estimator.velocity, line) - position * value
            moved = model.state @ plant + model.enter[:, 0] * force
            return jnp.concatenate([moved, jnp.stack([after.first, *after.second]), memory])

        size = n + 3 + (0 if notch is None else 2)
        return jax.jacfwd(advance)(jnp.zeros((size,), velocity.dtype))

    by_mode = jax.vmap(one, (0, 0, 0, 0, None))
    return jax.vmap(by_mode)(model, law.estimator, law.velocity_gain, position, notch)


def _of_links(
    structure: Structure, case: Case, law: Controller, system: StateSpace, nominal: NominalModel
) -> Array:
    model = link_model(structure, case, nominal)
    a, b, c, d = system.state[:, 0], system.enter[:, 0], system.leave[:, :, 0], system.direct
    last = jnp.zeros_like(model.sensor).at[:, :, -structure.n_patches :].set(law.feedthrough)
    seen = model.sensor - last
    above = jnp.concatenate([model.state + model.enter @ d @ seen, model.enter @ c], axis=2)
    return jnp.concatenate([above, jnp.concatenate([b @ seen, a], axis=2)], axis=1)[:, None]
