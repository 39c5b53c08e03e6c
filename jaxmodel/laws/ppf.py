"""Positive position feedback (Goh and Caughey 1985; Fanson and Caughey 1990).

A second-order filter per mode feeds back its output positively, f = +g eta with
eta'' + 2 zeta_f omega_f eta' + omega_f^2 eta = omega_f^2 q. Where the filter lags by 90 degrees,
this is a force against q'. In a sampled loop, anti-alias filter, delay and hold lag as well, so the
filter is tuned for all of them together.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Electronics, Structure
from jaxmodel.channels import Channels
from jaxmodel.electronics import measurement_chain
from jaxmodel.estimator import Estimator, second_order
from jaxmodel.laws.contract import Law, NominalModel, modal_feedback, study_gains
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.table import Parameter

#: Highest corner over the assembled frequency, used where the chain itself lags by 90 degrees [1].
HIGHEST_RATIO = 3.0
#: Highest corner over half the sample rate [1].
HIGHEST_SHARE = 0.9


class PositionFilter(NamedTuple):
    """Filters of positive position feedback."""

    estimator: Estimator  # its position is the filter's output
    corner: Num[Array, "links C"]  # omega_f [rad/s]
    # k_d at the assembled frequency per unit of g, delays included [s]
    damping: Num[Array, "links C"]


def design_position_filter(omega: Array, zeta: Array, electronics: Electronics) -> PositionFilter:
    """Filters that lag by 90 degrees at omega together with the measurement chain.

    With x = omega/omega_f and t = tan(90 degrees - lag of the chain), 2 zeta_f x = t (1 - x^2);
    omega_f at most `HIGHEST_RATIO` omega.

    Args:
        omega: assembled frequency of each channel [rad/s], (3, C).
        zeta: zeta_f, damping of the filters [1], ().
        electronics: what lies between command and sample.

    Returns:
        PositionFilter; where `damping` is not positive, the chain lags too much for this law.
    """
    period, share = electronics.period, omega / electronics.antialias
    lag = jnp.arctan2(jnp.sqrt(2.0) * share, 1 - share**2)
    lag = lag + (0.5 + electronics.delay) * omega * period
    lag = lag + jnp.arctan(omega * electronics.amplifier_lag)
    lag = lag - jnp.arctan(electronics.sensor_highpass / omega)
    least = jnp.arctan(2 * zeta * HIGHEST_RATIO / (HIGHEST_RATIO**2 - 1))
    slope = jnp.tan(jnp.maximum(jnp.pi / 2 - lag, least))
    corner = omega * slope / (jnp.sqrt(zeta**2 + slope**2) - zeta)
    corner = jnp.minimum(corner, HIGHEST_SHARE * jnp.pi / period)
    low, a1, a2 = second_order(corner, zeta, period)
    one, zero = jnp.ones_like(corner), jnp.zeros_like(corner)
    estimator = Estimator(
        first=(one, zero, zero),
        denominator=(a1, a2),
        velocity=(zero,) * 3,
        position=(low, 2 * low, low),
        direct=zero,
    )
    z = jnp.exp(-1j * omega * period)  # z^-1 on the unit circle
    response = low * (1 + z) ** 2 / (1 + a1 * z + a2 * z * z)
    whole = measurement_chain(omega, electronics) * response
    return PositionFilter(estimator, corner, -jnp.imag(whole) / omega)


def design(structure: Structure, case: Case, nominal: NominalModel) -> Channels:
    """Damp each assembled mode as much as the study's velocity gains intend: g = k_d/damping.

    Modes at which the measurement chain lags too much get no gain.
    """
    velocity, _ = study_gains(case, nominal)
    zeta = jnp.asarray(case.control.parameters["filter_damping"])[:, None]
    filters = design_position_filter(nominal.omega, zeta, case.electronics)
    is_fit = filters.damping > 0
    gain = jnp.where(is_fit, velocity / jnp.where(is_fit, filters.damping, 1.0), 0.0)
    return modal_feedback(case, nominal, 0 * gain, -gain, filters.estimator)


PPF = Law(
    "ppf",
    "positive position feedback",
    "mode",
    design,
    parameters=(
        Parameter("filter_damping", 0.5, "1", "zeta_f, damping ratio of the filters", 0.01, 2.0),
    ),
)
