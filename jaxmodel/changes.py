"""The sampled loop of a machine that has changed while its controller has not.

Every physical number that drifts, is built with a tolerance, or is known badly is one entry of a
`MachineChange`; the transition matrix of the loop is a smooth function of all of them, so that its
exact derivative by any of them is at hand (docs/theory.md, "The smallest change that breaks a
design").
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, controller_step, rest_controller
from jaxmodel.lazy import jax, jnp
from jaxmodel.linear import linearise, resting
from jaxmodel.parameters import Array
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import analogue_plant, transition_over

#: Longest extra delay that `changed_loop` covers [samples].
LONGEST_DELAY = 2.0


class MachineChange(NamedTuple):
    """Departure of a machine from its nominal numbers; all zero: none.

    Relative changes are natural logarithms of the factor, so that no factor becomes negative.
    """

    stiffness: Array  # ln of the factor on E I of each link [1], (3,)
    damping: Array  # ln of the factor on the damping ratios of each link [1], (3,)
    payload: Array  # mass added at the platform's reference point [kg], ()
    patch: Array  # how far each pair of patches moves towards joint C [m], (3, K)
    delay: Array  # extra delay of the actuators, 0 to `LONGEST_DELAY` [samples], ()
    actuator: Array  # ln of the factor on each actuator's voltage [1], (3, K)
    sensor: Array  # ln of the factor on each sensor's voltage [1], (3, K)
    joint_inertia: Array  # added at the platform joint of each link [kg m2], (3,)


def changed_case(case: Case, change: MachineChange) -> Case:
    """The case of the changed machine; channel gains and delay are not part of a case.

    Args:
        case: the numbers.
        change: of the machine.
    """
    machine = case.machine
    beam, masses, damping = machine.beam, machine.masses, machine.damping
    return case._replace(
        machine=machine._replace(
            beam=beam._replace(
                stiffness_factor=beam.stiffness_factor * jnp.exp(change.stiffness),
                joint_inertia_c=beam.joint_inertia_c + change.joint_inertia,
            ),
            masses=masses._replace(payload_mass=masses.payload_mass + change.payload),
            patches=machine.patches._replace(center=machine.patches.center + change.patch),
            damping=damping._replace(ratio=damping.ratio * jnp.exp(change.damping)[:, None]),
        )
    )


def changed_loop(
    structure: Structure, case: Case, pose: Array, law: Controller, change: MachineChange
) -> tuple[Array, Array]:
    """One sample of a changed machine under a given controller; differentiable by the change.

    The state is that of `LoopMatrices`, and the commands of the two samples before. A delay of
    m + f samples (m whole, 0 <= f < 1) holds the command of m + 1 samples ago over the first
    share f of the sample and that of m samples ago over the rest, where 0 counts from the sample
    in which a command acts without extra delay:

        x(T) = e^(A T) x + (G(T) - G((1 - f) T)) u_(k-m-1) + G((1 - f) T) u_(k-m),
        G(t) = int_0^t e^(A s) ds B.

    Args:
        structure: static choices with feedback "sampled".
        case: the nominal numbers.
        pose: where to linearise [m, m, rad], (3,).
        law: the controller, designed for the nominal machine.
        change: of the machine.

    Returns:
        transition matrix, (n, n), and omega of the changed links' modes [rad/s], (3, R).
    """
    from jax.flatten_util import ravel_pytree

    case = changed_case(case, change)
    smooth = structure._replace(is_smooth=True, feedback="sampled")
    loop = prepare(smooth, case).loop
    plant = linearise(smooth, loop, pose, resting(structure, case))
    analogue = analogue_plant(smooth, plant, case)
    whole = jnp.where(change.delay < 1.0, 0.0, 1.0)
    fraction = change.delay - whole
    period, n_sensors = case.electronics.period, 3 * structure.n_patches
    exact = transition_over(analogue, period)
    n = len(exact)
    state, enter = exact[:, :n], exact[:, n : n + n_sensors]
    late = transition_over(analogue, (1 - fraction) * period)[:, n : n + n_sensors]
    rest, unpack = ravel_pytree(rest_controller(law))
    gain, seen = (jnp.exp(jnp.ravel(x)) for x in (change.actuator, change.sensor))

    def advance(x: Array) -> Array:
        before = unpack(x[n : -2 * n_sensors])
        held = jnp.ravel(before.voltage)
        last, last_but_one = x[-2 * n_sensors : -n_sensors], x[-n_sensors:]
        old = (1 - whole) * last + whole * last_but_one
        new = (1 - whole) * held + whole * last
        moved = state @ x[:n] + (enter - late) @ (gain * old) + late @ (gain * new)
        filtered = jnp.reshape(seen * x[analogue.filtered], before.voltage.shape)
        after, _ = controller_step(law, before, filtered, None, True)
        return jnp.concatenate([moved, ravel_pytree(after)[0], held, last])

    still = jnp.zeros(n + rest.size + 2 * n_sensors, exact.dtype)
    return jax.jacfwd(advance)(still), loop.omega
