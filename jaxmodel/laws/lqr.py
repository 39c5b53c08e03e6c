"""IMSC with optimal gains (IMSC-LQR; Meirovitch 1990, Dynamics and Control of Structures)."""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.control import PoleGains
from jaxmodel.laws.contract import Law, NominalModel, acting_channels, modal_feedback
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array
from jaxmodel.table import Parameter


def optimal_gains(omega: Array, control_weight: Array) -> PoleGains:
    """Gains that minimise int omega^2 q^2 + q'^2 + R u^2 dt of q'' + omega^2 q = u.

    k_p = omega sqrt(omega^2 + 1/R) - omega^2 and k_d = sqrt(2 k_p + 1/R): the closed-form solution
    of the mode's Riccati equation.

    Args:
        omega: natural frequency of the mode [rad/s].
        control_weight: R, weight of the squared control per unit modal mass [s2].

    Returns:
        PoleGains per unit modal mass.
    """
    share = 1 / control_weight
    # avoids the difference of two large numbers where control is expensive
    position = omega * share / (jnp.sqrt(omega**2 + share) + omega)
    return PoleGains(position, jnp.sqrt(2 * position + share))


def design(structure: Structure, case: Case, nominal: NominalModel) -> Channels:
    """Optimal gains of every controlled mode, one weight for each link."""
    weight = jnp.asarray(case.control.parameters["control_weight"])[:, None]
    gains = optimal_gains(nominal.omega, weight)
    scale = acting_channels(case, nominal) * nominal.modal_mass
    return modal_feedback(case, nominal, scale * gains.velocity, scale * gains.position)


LQR = Law(
    "lqr",
    "IMSC-LQR",
    "mode",
    design,
    parameters=(
        Parameter(
            "control_weight",
            2e-5,
            "s2",
            "R of the optimal gains, weight of the squared control per modal mass",
            1e-9,
            1e3,
        ),
    ),
)
