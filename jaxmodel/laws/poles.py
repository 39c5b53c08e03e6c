"""Pole placement (20)-(23): gains of modal control that give each mode its specified poles.

Poles are -alpha +- j beta. With continuous feedback k_d = 2 (alpha - zeta omega) m and
k_p = (alpha^2 + beta^2 - omega^2) m; (22) is this without structural damping. A sampled loop with
delay and filters gets other poles from these gains (half of the damping at 10 kHz), so its gains
are those of the loop that runs: with z = exp(s T), G(z) the pulse transfer of the nominal link from
modal force to modal coordinate, one sample of delay included, and H_v(z), H_p(z) the estimates of
rate and value,

    1 + (k_d H_v(z) + k_p H_p(z)) G(z) = 0,

one complex equation for two real gains. Nominal link: each mode by itself at its assembled
frequency, with its structural damping, and all other modes' static response to its modal force.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Structure
from jaxmodel.control import pole_placement
from jaxmodel.estimator import Estimator, responses
from jaxmodel.laws.contract import NominalModel, acting_channels, study_estimator, study_gains
from jaxmodel.laws.link_model import LinkModel, mode_models
from jaxmodel.lazy import jnp
from jaxmodel.notch import Notch, design_notch, notch_response
from jaxmodel.parameters import Array, Num

#: Added decay over omega below which a mode is left alone [1].
LEAST_SHIFT = 1e-9
#: Sine of the angle between k_d H_v and k_p H_p below which they are taken as parallel [1].
LEAST_ANGLE = 1e-4


class Poles(NamedTuple):
    """Poles -decay +- j frequency of the controlled modes."""

    decay: Num[Array, "links C"]  # alpha [1/s]
    frequency: Num[Array, "links C"]  # beta [rad/s]


def specified_poles(case: Case, nominal: NominalModel) -> Poles:
    """Poles that the study specifies, by their decays or by added damping ratios.

    An added damping ratio is a decay alpha_j = (zeta_j + damping_j) omega_j. A mode without either
    gets more than its structural decay by the EMC ratios, alpha_j = zeta_j omega_j +
    r_j (alpha_1 - zeta_1 omega_1), as (24) shares out k_d. A mode without a frequency keeps its
    own, alpha^2 + beta^2 = omega^2, so that k_p = 0 in (23).

    Args:
        case: the numbers.
        nominal: the model the controller is designed for.
    """
    control, own = case.control, nominal.damping_ratio * nominal.omega
    is_damped = control.damping >= 0
    decay = jnp.where(is_damped, own + control.damping * nominal.omega, control.pole_decay)
    shared = own + control.ratio * (decay[:, :1] - own[:, :1])
    decay = jnp.where(is_damped | (decay > 0), decay, shared)
    kept = jnp.sqrt(jnp.maximum(nominal.omega**2 - decay**2, (1e-3 * nominal.omega) ** 2))
    is_given = control.pole_frequency > 0
    return Poles(decay, jnp.where(is_given, control.pole_frequency, kept))


def is_placed(case: Case, nominal: NominalModel) -> Array:
    """Whether a mode acts and its poles are specified, (3, C)."""
    control = case.control
    is_specified = (control.damping[:, :1] >= 0) | (control.pole_decay[:, :1] > 0)
    return is_specified & (acting_channels(case, nominal) > 0)


def continuous_gains(poles: Poles, nominal: NominalModel) -> tuple[Array, Array]:
    """Velocity [N s/m] and position gains [N/m] of continuous feedback, (22)-(23), (3, C) each."""
    gains = pole_placement(poles.decay, poles.frequency, nominal.omega)
    structural = 2 * nominal.damping_ratio * nominal.omega
    return nominal.modal_mass * (gains.velocity - structural), nominal.modal_mass * gains.position


def sampled_gains(
    structure: Structure, case: Case, nominal: NominalModel, estimator: Estimator
) -> tuple[Array, Array]:
    """Velocity [N s/m] and position gains [N/m] of the loop that runs, (3, C) each."""
    poles = specified_poles(case, nominal)
    is_moved = _is_moved(poles, nominal)
    # own poles are poles of G: any others keep the unused alternative finite
    decay = jnp.where(is_moved, poles.decay, poles.decay + 0.1 * nominal.omega)
    z = jnp.exp((-decay + 1j * poles.frequency) * case.electronics.period)
    rate, value = responses(estimator, z)
    if structure.has_notch:
        notch = design_notch(case.control, case.electronics.period)
        passed = notch_response(Notch(*(x[:, None] for x in notch)), z)
        rate, value = rate * passed, value * passed
    gain = -1 / pulse_transfer(structure, case, nominal, z)
    area = jnp.imag(jnp.conj(rate) * value)
    is_solved = is_moved & ~_is_flat(rate, value)
    area = jnp.where(is_solved, area, 1.0)
    velocity = jnp.imag(jnp.conj(gain) * value) / area
    position = jnp.imag(jnp.conj(rate) * gain) / area
    return jnp.where(is_solved, velocity, 0.0), jnp.where(is_solved, position, 0.0)


def pulse_transfer(structure: Structure, case: Case, nominal: NominalModel, z: Array) -> Array:
    """G(z) of the nominal link [m/N], complex, (3, C).

    Args:
        structure, case, nominal: of the law.
        z: complex, (3, C).
    """
    model = nominal_modes(structure, case, nominal)
    shifted = z[..., None, None] * jnp.eye(model.state.shape[-1]) - model.state
    answer = jnp.linalg.solve(shifted, model.enter.astype(shifted.dtype))
    return (model.sensor.astype(shifted.dtype) @ answer)[..., 0, 0]


def nominal_modes(structure: Structure, case: Case, nominal: NominalModel) -> LinkModel:
    """The nominal link, mode by mode, as the controller sees it.

    Of the other modes' static response it subtracts a share, that of its last command.

    Args:
        structure, case, nominal: of the law.

    Returns:
        LinkModel with leading axes (3, C), one input [N] and one output [m].
    """
    direct = nominal.observer @ nominal.feedthrough @ nominal.synthesizer
    direct = jnp.diagonal(direct, axis1=1, axis2=2)
    model = mode_models(structure, case, nominal, nominal.damping_ratio, direct)
    subtracted = case.control.feedthrough_factor * direct
    return model._replace(sensor=model.sensor.at[..., 0, -1].add(-subtracted))


def _is_moved(poles: Poles, nominal: NominalModel) -> Array:
    """Whether a mode's specified poles are not those it has without control."""
    omega = nominal.omega
    own = nominal.damping_ratio * omega
    ringing = jnp.sqrt(jnp.maximum(omega**2 - own**2, 0.0))
    shift = jnp.abs(poles.decay - own) + jnp.abs(poles.frequency - ringing)
    return shift > LEAST_SHIFT * omega


def _is_flat(rate: Array, value: Array) -> Array:
    """Whether the two estimates are (nearly) in phase, so that they cannot place two poles."""
    size = jnp.abs(rate) * jnp.abs(value)
    return jnp.abs(jnp.imag(jnp.conj(rate) * value)) <= LEAST_ANGLE * size


def modal_gains(structure: Structure, case: Case, nominal: NominalModel) -> tuple[Array, Array]:
    """Velocity [N s/m] and position gains [N/m] by mode, (3, C) each.

    From the poles that the study specifies; of links without, its gains and ratios (24).

    Args:
        structure, case, nominal: of the law.
    """
    written = study_gains(case, nominal)
    if not structure.has_poles:
        return written
    if structure.feedback == "ideal":
        placed = continuous_gains(specified_poles(case, nominal), nominal)
    else:
        placed = sampled_gains(structure, case, nominal, study_estimator(case, nominal))
    chosen = is_placed(case, nominal)
    velocity, position = (jnp.where(chosen, x, y) for x, y in zip(placed, written, strict=True))
    return velocity, position


def closed_modes(structure: Structure, case: Case, nominal: NominalModel) -> tuple[Array, Array]:
    """a [1/s] and b [1/s2] of each mode under continuous feedback, s^2 + 2 a s + b = 0, (3, C).

    Args:
        structure, case, nominal: of the law.
    """
    velocity, position = study_gains(case, nominal)
    damping = nominal.damping_ratio * nominal.omega + velocity / (2 * nominal.modal_mass)
    square = nominal.omega**2 + position / nominal.modal_mass
    if not structure.has_poles:
        return damping, square
    poles, chosen = specified_poles(case, nominal), is_placed(case, nominal)
    size = poles.decay**2 + poles.frequency**2
    return jnp.where(chosen, poles.decay, damping), jnp.where(chosen, size, square)


def is_unplaceable(structure: Structure, case: Case, nominal: NominalModel) -> Array:
    """Whether specified poles of an acting mode cannot be placed, ().

    No positive decay, a decay beyond the mode's frequency without a frequency of its own, a
    frequency beyond half the sample rate, or estimates that are in phase at the pole.
    """
    poles, period = specified_poles(case, nominal), case.electronics.period
    is_fault = (poles.decay <= 0) | (poles.frequency * period >= jnp.pi)
    is_fault |= (poles.decay >= nominal.omega) & (case.control.pole_frequency <= 0)
    if structure.feedback == "sampled":
        z = jnp.exp((-poles.decay + 1j * poles.frequency) * period)
        is_fault |= _is_flat(*responses(study_estimator(case, nominal), z))
    return jnp.any(is_fault & _is_moved(poles, nominal) & is_placed(case, nominal))
