"""IMSC with Luenberger observers instead of modal filters (the paper's refs [23]-[25]).

Every controlled mode has its own observer on the sampled, delayed plant (`link_model`): it predicts
mode, filters and what the commands do to them, and is corrected by the modal filter's residual. The
poles of its mode are placed: same frequency, more damping. Those of its filters stay. Feedback is
modal control, (20)-(24), of the state that the command will meet: commands on their way, hold and
amplifiers are predicted, so that the poles are those of continuous feedback.
"""

from __future__ import annotations

from functools import reduce

from jaxmodel.case import Case, Structure
from jaxmodel.laws.bending import BENDING, bent, force_decay
from jaxmodel.laws.contract import Law, NominalModel, acting_channels
from jaxmodel.laws.link_model import (
    DAMPING,
    LinkModel,
    compensated,
    layout,
    link_model,
    mode_models,
)
from jaxmodel.laws.poles import closed_modes
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array
from jaxmodel.state_space import StateSpace
from jaxmodel.table import Parameter


def corrections(structure: Structure, case: Case, nominal: NominalModel) -> Array:
    """Corrections of each mode's own states by its residual in z, (3, C, s), s = 5 or 6.

    Mode, filters and, last, the slow force that bends it (`laws.bending`). Ackermann's formula for
    the predictor, L = phi(F) O^-1 e_s, and M = F^-1 L for the corrector.

    Args:
        structure, case, nominal: of the law.
    """
    electronics, period = case.electronics, case.electronics.period
    filters = [electronics.antialias * jnp.sqrt(0.5) * (-1 + 1j)]
    parameters = case.control.parameters
    zeta = jnp.asarray(parameters["observer_damping"])[:, None]
    modes = nominal.omega * (-zeta + 1j * jnp.sqrt(1 - zeta**2))
    drained = jnp.exp(-electronics.sensor_highpass * period)
    slow = jnp.exp(-2 * jnp.pi * jnp.asarray(parameters["bending_hz"]) * period)
    blocks = _own_blocks(structure, case, nominal)
    size = blocks.shape[-1]

    def one(f: Array, mode: Array, slow: Array) -> Array:
        eye = jnp.eye(size)

        def pair(x: Array, pole: Array) -> Array:
            z = jnp.exp(pole * period)
            return x @ (f @ f - 2 * jnp.real(z) * f + jnp.real(z * jnp.conj(z)) * eye)

        phi = f - slow * eye
        if structure.has_sensor_highpass:
            phi = phi @ (f - drained * eye)
        phi = reduce(pair, [mode, *filters], phi)
        return jnp.linalg.solve(f, _ackermann(f.T, eye[2], phi.T))

    return jax.vmap(jax.vmap(one, (0, 0, None)))(blocks, modes, slow)


def _own_blocks(structure: Structure, case: Case, nominal: NominalModel) -> Array:
    """F of each mode, its filters and its slow force alone, (3, C, s, s)."""
    single = mode_models(structure, case, nominal, nominal.damping_ratio)
    at = layout(structure, 1, 1)
    own = jnp.array([at[x].start for x in ("q", "rate", "z", "z_rate", "s") if x in at])
    above = jnp.concatenate(
        [single.state[:, :, own[:, None], own], single.drive[:, :, own]], axis=3
    )
    kept = jnp.broadcast_to(force_decay(case)[:, None, None, None], (*above.shape[:2], 1, 1))
    below = jnp.pad(kept, ((0, 0), (0, 0), (0, 0), (own.size, 0)))
    return jnp.concatenate([above, below], axis=2)


def regulator(structure: Structure, case: Case, nominal: NominalModel, model: LinkModel) -> Array:
    """K of u_k = -K x_k that places the poles of every mode, (3, K, n).

    u_k acts from its arrival on, when x is known: it depends on the commands on their way alone.
    Of each mode, x gives xi = (q, q') and, behind amplifiers, the modal force that still
    rises. With f = -k xi held over a sample, Ackermann's formula k = e^t (gamma, Phi gamma, ..)^-1
    p(Phi) puts the poles at exp(s T), where s are those of continuous feedback, (20)-(23);
    amplifiers keep theirs.

    Args:
        structure, case, nominal: of the law.
        model: of each link, leading axis `links`.
    """
    period = case.electronics.period
    damping, square = closed_modes(structure, case, nominal)
    # exp(s T) of both poles: their sum and product
    total = 2 * jnp.exp(-damping * period) * _cosine((square - damping**2) * period**2)
    product = jnp.exp(-2 * damping * period)
    at = layout(structure, structure.n_controlled, structure.n_patches)
    each = layout(structure, 1, 1)
    own = [each[name].start for name in ("q", "rate", "volts") if name in each]
    single = mode_models(structure, case, nominal, nominal.damping_ratio)
    phi = single.state[:, :, jnp.array(own)[:, None], jnp.array(own)]
    gamma = single.held[:, :, jnp.array(own), 0]

    def one(phi: Array, gamma: Array, total: Array, product: Array) -> Array:
        polynomial = phi @ phi - total * phi + product * jnp.eye(len(own))
        if len(own) > 2:  # the amplifier's pole stays
            polynomial = polynomial @ (phi - phi[2, 2] * jnp.eye(len(own)))
        return _ackermann(phi, gamma, polynomial)

    gain = jax.vmap(jax.vmap(one))(phi, gamma, total, product)  # (3, C, 2 or 3)
    gain = gain * acting_channels(case, nominal)[..., None]
    rows = [model.met[:, at["q"]], model.met[:, at["rate"]]]
    if "volts" in at:
        rows.append(nominal.actuator @ model.met[:, at["volts"]])
    force = jnp.einsum("icr,ricn->icn", gain, jnp.stack(rows))
    return nominal.synthesizer @ force


def _ackermann(phi: Array, gamma: Array, polynomial: Array) -> Array:
    """k of u = -k x that gives x_(k+1) = phi x_k + gamma u_k the polynomial p; wanted = p(phi).

    Of the transposed system, the correction of an observer.
    """
    n = gamma.size
    reach = [gamma]
    for _ in range(n - 1):
        reach.append(phi @ reach[-1])
    return jnp.linalg.solve(jnp.stack(reach), jnp.eye(n)[-1]) @ polynomial


def _cosine(square: Array) -> Array:
    """cos(sqrt(x)), and cosh(sqrt(-x)) where x is negative."""
    is_ringing = square > 0
    turned = jnp.cos(jnp.sqrt(jnp.where(is_ringing, square, 1.0)))
    return jnp.where(is_ringing, turned, jnp.cosh(jnp.sqrt(jnp.where(is_ringing, 1.0, -square))))


def design(structure: Structure, case: Case, nominal: NominalModel) -> StateSpace:
    """Observers of all modes, and a regulator of what they predict."""
    model = link_model(structure, case, nominal)
    wide = bent(case, model)
    n = model.state.shape[1]
    residual = (nominal.omega * jnp.sqrt(nominal.modal_mass))[..., None] * nominal.observer
    own = corrections(structure, case, nominal)  # (3, C, s)
    # residual in z~ per volt, (3, C, K)
    parts = [own[:, :, k, None] * residual for k in range(own.shape[2])]
    correct = jnp.concatenate(parts[:-1], axis=1)  # (3, (s - 1) C, K)
    correct = jnp.pad(correct, ((0, 0), (0, n - correct.shape[1]), (0, 0)))
    correct = jnp.concatenate([correct, parts[-1]], axis=1)
    gain = wide.relative(regulator(structure, case, nominal, model))
    return compensated(structure, case, wide.model, gain, correct)


OBSERVER = Law(
    "observer",
    "IMSC with observers",
    "none",
    design,
    places_poles=True,
    parameters=(
        Parameter(
            "observer_damping", 0.3, "1", "damping ratio of the observer's modes", 0.01, 0.99
        ),
        BENDING,
        DAMPING,
    ),
)
