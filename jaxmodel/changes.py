"""The sampled loop of a machine that has changed while its controller has not.

Every physical number that drifts, is built with a tolerance, or is known badly is one entry of a
`MachineChange`; the transition matrix of the loop is a smooth function of all of them, so that its
exact derivative by any of them is at hand (docs/theory.md, "The smallest change that breaks a
design").
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller
from jaxmodel.lazy import jnp
from jaxmodel.linear import resting
from jaxmodel.loop import coordinate_omega
from jaxmodel.parameters import Array, Num
from jaxmodel.prepare import prepare
from jaxmodel.sampled_loop import loop_matrices


class MachineChange(NamedTuple):
    """Departure of a machine from its nominal numbers; all zero: none.

    Relative changes are natural logarithms of the factor, so that no factor becomes negative.
    """

    stiffness: Num[Array, "links"]  # ln of the factor on E I of each link [1]
    damping: Num[Array, "links"]  # ln of the factor on the damping ratios of each link [1]
    payload: Num[Array, ""]  # mass added at the platform's reference point [kg]
    patch: Num[Array, "links K"]  # how far each pair of patches moves towards joint C [m]
    delay: Num[Array, ""]  # extra delay of the actuators, 0 or more [samples]
    actuator: Num[Array, "links K"]  # ln of the factor on each actuator's voltage [1]
    sensor: Num[Array, "links K"]  # ln of the factor on each sensor's voltage [1]
    joint_inertia: Num[Array, "links"]  # added at the platform joint of each link [kg m2]


def changed_case(case: Case, change: MachineChange) -> Case:
    """The case of the changed machine.

    Args:
        case: the numbers.
        change: of the machine.
    """
    machine, electronics = case.machine, case.electronics
    beam, patches, masses, damping = machine.beam, machine.patches, machine.masses, machine.damping
    return case._replace(
        machine=machine._replace(
            beam=beam._replace(
                stiffness_factor=beam.stiffness_factor * jnp.exp(change.stiffness),
                joint_inertia_c=beam.joint_inertia_c + change.joint_inertia,
            ),
            masses=masses._replace(payload_mass=masses.payload_mass + change.payload),
            patches=patches._replace(
                center=patches.center + change.patch,
                sensor_factor=patches.sensor_factor * jnp.exp(change.sensor),
                actuator_factor=patches.actuator_factor * jnp.exp(change.actuator),
            ),
            damping=damping._replace(ratio=damping.ratio * jnp.exp(change.damping)[:, None]),
        ),
        electronics=electronics._replace(
            unmodelled_delay=electronics.unmodelled_delay + change.delay
        ),
    )


def changed_loop(
    structure: Structure, case: Case, pose: Array, law: Controller, change: MachineChange
) -> tuple[Array, Array]:
    """One sample of a changed machine under a given controller; differentiable by the change.

    At whole samples of delay the derivative by it is that of shorter delays.

    Args:
        structure: static choices with feedback "sampled".
        case: the nominal numbers, with a delay that leaves room for more, up to `delay.LONGEST`.
        pose: where to linearise [m, m, rad], (3,).
        law: the controller, designed for the nominal machine.
        change: of the machine.

    Returns:
        transition matrix, (n, n), and omega of the changed links' coordinates [rad/s], (3, R).
    """
    case, late = changed_case(case, change), structure._replace(has_delay=True)
    loop = prepare(late._replace(is_smooth=True, feedback="sampled"), case).loop
    matrices = loop_matrices(late, case, loop, law, pose, resting(late, case))
    return matrices.open + matrices.feedback, coordinate_omega(loop)
