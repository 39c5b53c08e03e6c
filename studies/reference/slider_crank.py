"""The public slider crank with a flexible rod: one leg of the machine, driven by its platform.

IVPTestset, "slider crank" (Simeon 1996): a rod of 0.3 m between a crank of 0.15 m at 150 rad/s and
a slider, two sine modes, undamped. Leg 1 is the rod; the platform, too heavy to notice it, goes
round the crank's circle under its own centripetal force.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel import dynamics
from jaxmodel.beam import build_basis
from jaxmodel.defaults import paper_machine
from jaxmodel.mechanisms.prrr.guides import GuideGeometry
from jaxmodel.parameters import Damping, Masses
from jaxmodel.plant import build_plant
from studies.engine.programs import kept_jit
from studies.reference.lagrangian import rk4_step

#: Radius [m] and speed [rad/s] of the crank; mass and inertia of the platform [kg, kg m2].
CRANK, SPEED, HEAVY = 0.15, 150.0, 1e9
N_STEPS = 8000
STEP = 0.1 / N_STEPS
RATES = np.array([-0.444896105, 4.63434311e-3])  # of the rod's modes at the start [m/s]

#: A guide through the origin, whatever the side of the triangle [m].
SIDE = 1.0
THROUGH_ORIGIN = -SIDE / np.sqrt(12.0)
MACHINE = paper_machine()._replace(
    geometry=GuideGeometry(
        guide_side=SIDE,
        guide_angle=np.pi + np.array([0, 2 * np.pi / 3, 4 * np.pi / 3]),
        joint_radius=0.0,
        joint_angle=np.zeros(3),
        guide_offset=THROUGH_ORIGIN,
    ),
    masses=Masses(platform_mass=HEAVY, platform_inertia=HEAVY, slider_mass=0.075552),
    beam=paper_machine().beam._replace(
        length=0.30, thickness=8e-3, width=8e-3, density=7870.0, youngs_modulus=2e11
    ),
    damping=Damping(ratio=np.zeros((3, 1)), count=np.ones(3, int), exponent=0.0),
)


#: How the rod's mass moves inwards: q1 and q2 at 0.1 s and the peak of q1 [m]. "none": it does not,
#: by an independent code without stretch (published, with stretch: 1.8931929e-4, 2.375751e-5,
#: 1.65124e-3). "distributed": an exactly inextensible rod (elastica kinematics). Published rods
#: start at the crank, ours at the slider: q1 has the other sign. Their peak is that of their
#: output's instants.
ROWS = {
    "none": (-1.8943713e-4, 2.375298e-5, 1.65124e-3),
    "distributed": (-2.32728e-4, 2.46140e-5, 1.56689e-3),
}


@kept_jit(static_argnums=(0, 1))
def coordinates(shortening: str, n_modes: int) -> Any:
    """Modal coordinates of the rod after every step [m], (N_STEPS, n_modes).

    Args:
        shortening: how its mass moves inwards, "none", "lumped" or "distributed".
        n_modes: sine modes of the rod, 2 or more.
    """
    basis = build_basis("pinned_pinned", MACHINE.beam, MACHINE.patches, n_modes, jnp.array([0.15]))
    plant = build_plant(
        MACHINE, basis, has_shortening=shortening != "none", is_distributed=shortening != "lumped"
    )

    def derivative(state: Any, _: Any) -> Any:
        pose, pose_rate, q, q_rate = state
        chain = dynamics.modal_chain(plant, pose, pose_rate, q, q_rate)
        centripetal = -HEAVY * SPEED**2 * pose * jnp.array([1.0, 1.0, 0.0])
        found = dynamics.accelerations(
            plant, chain, pose_rate, q, q_rate, jnp.zeros(3), jnp.zeros(q.shape), centripetal
        )
        return pose_rate, found.pose, q_rate, found.modal

    def one_step(state: Any, _: Any) -> Any:
        state = rk4_step(derivative, state, STEP, (None, None, None))
        return state, state[2][0]

    start = jnp.array([CRANK, 0, 0]), jnp.array([0, CRANK * SPEED, 0])
    q_rate = jnp.zeros((3, n_modes)).at[0, :2].set(RATES)
    return jax.lax.scan(one_step, (*start, 0 * q_rate, q_rate), length=N_STEPS)[1]


def figures(shortening: str) -> np.ndarray:
    """q1 and q2 at 0.1 s, and the peak of q1 [m], to stand beside `ROWS`; with two modes.

    Example:
        >>> bool(np.allclose(figures("distributed"), ROWS["distributed"], rtol=1e-3))
        True
    """
    q = np.asarray(coordinates(shortening, 2))
    return np.array([*q[-1], np.abs(q[:, 0]).max()])
