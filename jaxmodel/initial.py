"""State at rest from which a run starts."""

from __future__ import annotations

from jaxmodel import metrics
from jaxmodel.case import Structure
from jaxmodel.controller import rest_controller
from jaxmodel.drive import settled_motors
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import resting_drive
from jaxmodel.lazy import jnp
from jaxmodel.loop import Loop, PlantState, State
from jaxmodel.parameters import Array


def initial_state(
    structure: Structure,
    loop: Loop,
    pose: Array,
    q: Array,
    code: Array,
    highpass: Array,
    force: Array | None,
) -> State:
    """State at rest at a pose with given modal coordinates.

    Args:
        structure: static choices.
        loop: constants, only for sizes.
        pose: (3,).
        q: [m], (3, R); the electronics start settled on it.
        code: status known before the run, as a float, ().
        highpass: corner of the patches into their amplifiers [rad/s], (); 0: not drained.
        force: of the motors at rest [N], (3,); None: none.

    Returns:
        State.
    """
    zero, still = jnp.zeros_like(q), jnp.zeros_like(pose)
    is_sampled = structure.feedback == "sampled"
    is_drained = is_sampled and structure.has_sensor_highpass
    drained = jnp.where(highpass > 0, q, zero)
    controller = rest_controller(loop.controller)
    is_direct = is_sampled and loop.left_out is not None

    def none(count: int) -> Array:
        return jnp.stack([jnp.zeros_like(controller.voltage)] * count)

    n_stations = loop.deflection_at.shape[1]
    sizes = metrics.Sizes(
        n_stations=n_stations,
        n_modes=structure.n_modes,
        n_controlled=structure.n_controlled,
        n_frequencies=structure.n_frequencies,
        n_links=structure.n_links,
        n_pose=structure.n_pose,
    )
    totals = metrics.zero_totals(sizes, q.dtype, structure.metrics)
    return State(
        plant=PlantState(
            pose,
            still,
            q,
            zero,
            z=(q - drained if is_drained else q) if is_sampled else None,
            z_rate=zero if is_sampled else None,
            s=drained if is_drained else None,
            voltage=controller.voltage if is_sampled and structure.has_amplifier else None,
            direct_z=jnp.zeros_like(controller.voltage) if is_direct else None,
            direct_z_rate=jnp.zeros_like(controller.voltage) if is_direct else None,
            direct_s=jnp.zeros_like(controller.voltage) if is_direct and is_drained else None,
            commands=None if loop.delayed is None else none(loop.delayed.before.shape[0] - 2),
            motor=settled_motors(structure, still if force is None else force),
            plays=None if loop.hysteresis is None else none(loop.hysteresis.play.shape[0]),
        ),
        controller=controller,
        totals=totals,
        status=code,
        bad_time=jnp.zeros_like(code),
        drive=resting_drive(DRIVES[structure.drive], still),
    )
