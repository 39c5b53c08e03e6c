"""Residual vibration from the linearised sampled loop: a quick estimate before any run.

The shaped reference moves the linear machine of the first way-point; what is left `residual_delay`
after its end decays freely, and its energy until then comes from a Gramian by doubling (H2 norm
of an initial state). Converters and their limits are ignored.
"""

from __future__ import annotations

from functools import partial

from jaxmodel.case import Case, Structure
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.dynamics import inverse_dynamics
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array
from jaxmodel.sampled_loop import LoopMatrices, summed_squares
from jaxmodel.simulate import begin


def linear_residual(structure: Structure, case: Case, matrices: LoopMatrices) -> Array:
    """H2 norm of the vibration that a move leaves behind; differentiable.

    sqrt(sum over k of y_k^2 T/L) with y the chord deflection from the window's start on, T the
    sample period and L the window's length: the nonlinear run's `residual_rms` where vibration dies
    out within the window.

    Args:
        structure: static choices; `n_steps` samples of the command are considered.
        case: the numbers.
        matrices: from `closed_loop` at the first way-point.

    Returns:
        rms of the chord deflection at the stations over the residual window [m], (3, S).
    """
    start = begin(structure._replace(has_noise=False), case)
    inputs, drive = start.inputs, start.loop.drive
    home = inputs.rho[0, 0]
    if matrices.reference is None:
        gains = drive_gains(DRIVES[structure.drive], drive)
        command = gains.position * (jnp.mean(inputs.rho, axis=1) - home)
        command = command + gains.rate * jnp.mean(inputs.rho_rate, axis=1)
        follow, seen = jnp.zeros((matrices.open.shape[0], 0)), inputs.rho[:, 0, :0]
    else:  # a sampled drive reads its reference at the start of each sample
        command = jnp.zeros_like(inputs.disturbance)
        seen = jnp.concatenate([inputs.rho[:, 0] - home, inputs.rho_rate[:, 0]], axis=1)
        follow = matrices.reference
    force = jnp.zeros_like(command)
    if structure.has_wrench:  # a pulse on the platform acts like drive forces that hold against it
        pulse = inputs.wrench - case.load.wrench
        still = jnp.zeros_like(start.state.plant.pose)
        held = partial(inverse_dynamics, start.loop.plant, start.state.plant.pose, still, still)
        force = force - jax.vmap(held)(pulse)
    if inputs.feedforward is not None:
        rest = inputs.feedforward[0, 0]
        command = command + jnp.mean(inputs.feedforward, axis=1) - rest
    begins = start.outline.command_end + case.windows.residual_delay
    is_before = inputs.window.time < begins - case.electronics.period / 2
    transition = matrices.open + matrices.feedback

    def pushed(command: Array, force: Array, seen: Array) -> Array:
        return matrices.motor @ command + matrices.force @ force + follow @ seen

    def advance(x: Array, at: tuple[Array, ...]) -> tuple[Array, None]:
        *inputs, is_moving = at
        moved = transition @ x + pushed(*inputs)
        return jnp.where(is_moving, moved, x), None

    still = jnp.zeros(transition.shape[0], transition.dtype)
    each = command, force + inputs.disturbance, seen, is_before
    x, _ = jax.lax.scan(advance, still, each)
    # the machine comes to rest where the drive then holds it
    held = pushed(command[-1], force[-1], seen[-1])
    x = x - jnp.linalg.solve(jnp.eye(x.size, dtype=x.dtype) - transition, held)
    size = jnp.sqrt(jnp.sum(x * x))
    size = jnp.where(size > 0, size, 1.0)
    gramian = summed_squares(transition, jnp.outer(x, x) / size**2)
    share = jnp.sum((matrices.deflection @ gramian.share) * matrices.deflection, axis=1)
    samples = case.windows.residual_length / case.electronics.period
    # an unstable loop's sum grows without bound: large, but still a number
    log_square = jnp.minimum(gramian.log_size, 100.0) + jnp.log(
        jnp.maximum(share, 1e-300) / samples
    )
    return jnp.reshape(size * jnp.exp(log_square / 2), (structure.n_links, -1))
