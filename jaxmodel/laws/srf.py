"""Strain rate feedback (16)-(18): every patch pair feeds back the rate of its own voltage."""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.estimator import design_estimator
from jaxmodel.laws.contract import Law, NominalModel
from jaxmodel.lazy import jnp


def design(structure: Structure, case: Case, nominal: NominalModel) -> Channels:
    """Gains of the link [s] and [1]; the estimator is exact at mode 1."""
    control, electronics, n = case.control, case.electronics, structure.n_patches
    on, links = jnp.asarray(control.link_mask)[:, None], structure.n_links
    eye = jnp.broadcast_to(jnp.eye(n), (links, n, n))
    return Channels(
        filter=eye,
        synthesizer=eye,
        estimator=design_estimator(
            jnp.broadcast_to(nominal.omega[:, :1], (links, n)),
            electronics,
            electronics.lowpass_ratio[0],
            electronics.lowpass_zeta[0],
        ),
        velocity_gain=on * jnp.broadcast_to(control.velocity_gain[:, None], (links, n)),
        position_gain=on * jnp.broadcast_to(control.position_gain[:, None], (links, n)),
    )


SRF = Law("srf", "strain rate feedback", "patch", design, has_position=False)
