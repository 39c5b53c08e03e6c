"""One closed-loop run: reference, scan over samples, metrics, status. Batch it with `vmap`."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial, reduce
from typing import Any, NamedTuple

import numpy as np

from jaxmodel import metrics, status
from jaxmodel.axial import axial_force, critical_force, euler_force
from jaxmodel.case import Case, Load, Structure
from jaxmodel.delay import command_change, true_delay
from jaxmodel.drives import DRIVES
from jaxmodel.dynamics import inverse_dynamics, with_platform
from jaxmodel.initial import initial_state
from jaxmodel.kinematics import inverse_kinematics, path_status, singularity_distance
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.loop import Inputs, Loop, Record, State, step
from jaxmodel.motion import end_of_path, shape_path
from jaxmodel.parameters import Array, Int, Num
from jaxmodel.plant import Plant
from jaxmodel.prepare import Prepared, prepare
from jaxmodel.shaper import last_sample


class RunResult(NamedTuple):
    """Outcome of a run."""

    # NaN if the run did not finish; derivatives are 0 then, so that a sum over the cases of a batch
    # that masks those by `status` has the right derivative
    metrics: metrics.Metrics
    status: Int[Array, ""]  # 0: ok; others: see `REASONS` and `FINISHED` of `jaxmodel.status`
    bad_time: Num[Array, ""]  # when it appeared [s], 0 if OK or wrong from the start
    command_end: Num[Array, ""]  # end of the shaped reference [s]
    sensor_condition: Num[Array, "links"]  # condition number of the modal filter per link [1]
    actuator_condition: Num[Array, "links"]  # of the synthesizer [1]
    singularity_distance: Num[Array, ""]  # of the path from poses no drive reaches or holds [rad]
    record: Record | None  # trajectories, leading axis (n_steps,), if asked for


class Command(NamedTuple):
    """Everything that enters the loop from outside, for all samples."""

    inputs: Inputs  # leading axis (n_steps,)
    start_pose: Num[Array, "pose"]
    end: Num[Array, ""]  # end of the shaped reference [s]
    status: Num[Array, ""]  # reach, singularity or length fault of the command, as a float
    bad_time: Num[Array, ""]  # when it appears [s]
    singularity_distance: Num[Array, ""]  # of the path from poses no drive reaches or holds [rad]


@compiled("structure")
def command(structure: Structure, case: Case, prepared: Prepared) -> Command:
    """Shaped reference, disturbances, noise and metric windows of a case.

    Args:
        structure: static choices.
        case: the numbers.
        prepared: from `prepare`.

    Returns:
        Command.

    Example:
        >>> structure, case = paper_case({"link.modes": 2, "shaper.kind": "none"})
        >>> f"{command(structure, case, prepare(structure, case)).end:.1f} s"
        '0.4 s'
    """
    n, per_sample = structure.n_steps, 2 * structure.plant_steps
    period, plant = case.electronics.period, prepared.loop.plant
    grid = n * per_sample + 1
    within = _points_in_a_sample(structure, case) if structure.is_delayed else None
    reference = shape_path(case.path, prepared.taps, grid, per_sample, period / per_sample, within)
    rest = prepared.loop.rest
    wrench = case.load.wrench if structure.has_wrench else None
    sliders: Callable[..., Any] = partial(inverse_kinematics, plant)
    known = with_platform(plant, case.drive.model_mass)
    torque: Callable[..., Any] = partial(inverse_dynamics, known, wrench=wrench)
    if rest is not None:
        sliders, torque = _about(sliders, rest.pose), _about(torque, rest.pose)
    rho, rho_rate = sliders(reference.position, reference.velocity)
    forward = None
    if DRIVES[structure.drive].has_feedforward:
        forward = _points(jax.vmap(torque)(*reference), n)
    elif structure.has_wrench:  # the settled output of the drive's integrators
        still = jnp.zeros_like(reference.position[0])
        held = torque(reference.position[0], still, still)
        forward = jnp.broadcast_to(held, (n, per_sample + 1, structure.n_links))

    is_buckled = jnp.any(steady_load(structure, case, plant) >= 1)
    time = period * jnp.arange(n)
    end = end_of_path(case.path) + last_sample(prepared.taps) * period
    code, index = path_status(plant, reference.position)
    bad_time = index * period / per_sample
    code = jnp.where(is_buckled, float(status.BUCKLED), code)
    bad_time = jnp.where(is_buckled, 0.0, bad_time)
    distance = singularity_distance(plant, reference.position)
    is_long = end > n * period
    code = jnp.where((code == status.OK) & is_long, float(status.SHAPER_TOO_LONG), code)
    left = n * period - end - case.windows.residual_delay
    # free vibration of a platform at rest: the window can end with the run
    is_moving = jnp.any(jnp.diff(case.path.waypoints, axis=0) != 0)
    is_cut = is_moving & (case.windows.residual_length > left + period / 2)
    is_cut |= (case.windows.residual_length < period) | (left < period / 2)
    code = jnp.where((code == status.OK) & is_cut, float(status.WINDOW_TOO_LONG), code)
    adc_noise, disturbance = _disturbance(structure, case, prepared, time)
    inputs = Inputs(
        rho=_points(rho, n),
        rho_rate=_points(rho_rate, n),
        feedforward=forward,
        pose=reference.position[:-1:per_sample],
        disturbance=disturbance,
        wrench=_wrench(case.load, time) if structure.has_wrench else None,
        adc_noise=adc_noise,
        window=_windows(structure, case, time, end),
    )
    return Command(
        inputs=inputs,
        start_pose=reference.position[0],
        end=end,
        status=code,
        bad_time=bad_time,
        singularity_distance=distance,
    )


def _points_in_a_sample(structure: Structure, case: Case) -> Array:
    """When the drive reads its reference, before and after a command changes [s], (P - 1,)."""
    share = command_change(true_delay(case.electronics)).share
    grid = np.arange(structure.plant_steps) / structure.plant_steps
    return case.electronics.period * jnp.concatenate([share * grid, share + (1 - share) * grid])


def _about(function: Callable[..., Any], pose: Array) -> Callable[..., Any]:
    """A function of pose and rates to first order about rest at a pose."""

    def linear(*arguments: Array) -> Any:
        rest = [jnp.zeros_like(x) for x in arguments]
        rest[0] = jnp.broadcast_to(pose, arguments[0].shape)
        value, change = jax.jvp(
            function, rest, [x - at for x, at in zip(arguments, rest, strict=True)]
        )
        return jax.tree.map(jnp.add, value, change)

    return linear


def steady_load(structure: Structure, case: Case, plant: Plant) -> Array:
    """Compression of the links by the steady load at the way-points, over N_cr [1], (n, 3)."""
    poses = jnp.asarray(case.path.waypoints)
    if not structure.has_wrench:
        return jnp.zeros(poses.shape)
    still = jnp.zeros_like(poses[0])
    forces = jax.vmap(axial_force, (None, 0, None, None, None))(
        plant, poses, still, still, case.load.wrench
    )
    return -forces / critical_force(plant)


def _wrench(load: Load, time: Array) -> Array:
    """Force and moment on the platform [N, N, N m], (n_steps, 3)."""
    share = _share_on(time, load.pulse_start, load.pulse_length)
    return load.wrench + share[:, None] * load.pulse


def _share_on(time: Array, start: Array, length: Array) -> Array:
    """Share of each sample in which a pulse acts, so that none of its impulse is lost, (n,)."""
    period = time[1] - time[0] if time.size > 1 else jnp.maximum(length, 1.0)
    since = jnp.clip(time + period - start, 0.0, length) - jnp.clip(time - start, 0.0, length)
    return since / period


def _points(x: Array, n: int) -> Array:
    """Group a fine grid (n p + 1, ...) into the p + 1 points of each sample, (n, p + 1, ...)."""
    p = (x.shape[0] - 1) // n
    body = jnp.reshape(x[:-1], (n, p, *x.shape[1:]))
    return jnp.concatenate([body, x[p::p][:, None]], axis=1)


def _windows(structure: Structure, case: Case, time: Array, end: Array) -> metrics.Window:
    windows, tick = case.windows, case.electronics.period / 2  # half a sample against rounding
    after = time - end
    begin = end + windows.residual_delay
    is_residual = (time > begin - tick) & (time < begin + windows.residual_length - tick)
    taper = np.sin(np.pi * np.arange(structure.n_steps) / structure.n_steps) ** 2
    return metrics.Window(
        time=time,
        is_moving=(time < end - tick).astype(time.dtype),
        is_residual=is_residual.astype(time.dtype),
        after_command=jnp.where(after > 1e-6 * tick, after, 0.0),
        taper=jnp.asarray(taper, time.dtype),
    )


def _disturbance(
    structure: Structure, case: Case, prepared: Prepared, time: Array
) -> tuple[Array | None, Array]:
    """(standard normal ADC noise or None, slider disturbance [N])."""
    drive, n = prepared.loop.drive, structure.n_steps
    share = _share_on(time, drive.pulse_start, drive.pulse_length)
    force = share[:, None] * jnp.broadcast_to(drive.pulse_force, (n, structure.n_links))
    if not structure.has_noise:
        return None, force
    adc_key, ripple_key = jax.random.split(jax.random.key(case.seed))
    noise = jax.random.normal(adc_key, (n, structure.n_links, structure.n_patches), time.dtype)
    ripple = jax.random.normal(ripple_key, (n, structure.n_links), time.dtype)
    return noise, force + drive.ripple * ripple


def _scan_in_blocks(body: Any, start: Any, inputs: Inputs, is_checkpointed: bool) -> Any:
    """`lax.scan` in about sqrt(n) blocks, for runs that keep something of every step.

    XLA copies a scan's storage at each step; with blocks it copies only a block's, not the run's.
    With checkpoints, reverse mode keeps the state of every block and recomputes the rest.
    """
    n = inputs.rho.shape[0]
    root = int(np.sqrt(n))
    divisor = max(k for k in range(1, root + 1) if n % k == 0)
    # a remainder compiles the step a second time, so prefer an even division
    size = divisor if divisor > root // 4 else root
    count = n // size

    def block(state: Any, part: Any) -> Any:
        return jax.lax.scan(body, state, part)

    block = jax.checkpoint(block) if is_checkpointed else block
    main = jax.tree.map(lambda x: x[: count * size].reshape((count, size, *x.shape[1:])), inputs)
    state, kept = jax.lax.scan(block, start, main)
    kept = jax.tree.map(lambda x: x.reshape((count * size, *x.shape[2:])), kept)
    if count * size < n:
        state, rest = block(state, jax.tree.map(lambda x: x[count * size :], inputs))
        kept = jax.tree.map(lambda x, y: jnp.concatenate([x, y]), kept, rest)
    return state, kept


class Outline(NamedTuple):
    """What is known about a case before its first step."""

    early_time: Num[Array, ""]  # when a fault of the command appears [s]
    command_end: Num[Array, ""]  # [s]
    sensor_condition: Num[Array, "links"]
    actuator_condition: Num[Array, "links"]
    ending: metrics.Ending
    saturation_limit: Num[Array, ""]  # [1]
    arrival_tolerance: Num[Array, ""]  # [m]
    critical_force: Num[Array, "links"]  # N_cr of the links [N]
    # largest distance of a joint from the platform's reference point [m]; None: it is a point
    joint_radius: Num[Array, ""] | None
    singularity_distance: Num[Array, ""]  # [rad]
    singularity_margin: Num[Array, ""]  # [rad]
    strain_limit: Num[Array, ""]  # [1]


class Start(NamedTuple):
    """A case ready to run: what an executor reads, and what the end of the run needs."""

    loop: Loop
    inputs: Inputs  # leading axis (n_steps,)
    state: State
    outline: Outline


def begin(structure: Structure, case: Case) -> Start:
    """Do everything that precedes the first step.

    Args:
        structure: static choices.
        case: the numbers.

    Returns:
        Start.
    """
    prepared = prepare(structure, case)
    outside = command(structure, case, prepared)
    code = jnp.where(prepared.status == status.OK, outside.status, prepared.status)
    loop = prepared.loop
    return Start(
        loop,
        outside.inputs,
        initial_state(
            structure,
            loop,
            outside.start_pose,
            prepared.initial_q,
            code,
            case.electronics.sensor_highpass,
            None if outside.inputs.feedforward is None else outside.inputs.feedforward[0, 0],
        ),
        Outline(
            early_time=jnp.where(prepared.status == status.OK, outside.bad_time, 0.0),
            command_end=outside.end,
            sensor_condition=prepared.sensor_condition,
            actuator_condition=prepared.actuator_condition,
            ending=metrics.Ending(jnp.asarray(case.electronics.period), loop.modal_omega),
            saturation_limit=jnp.asarray(case.windows.saturation_limit),
            arrival_tolerance=jnp.asarray(case.windows.arrival_tolerance),
            critical_force=_allowed_compression(case, loop.plant),
            joint_radius=_joint_radius(loop.plant),
            singularity_distance=outside.singularity_distance,
            singularity_margin=jnp.asarray(case.windows.singularity_margin),
            strain_limit=jnp.asarray(case.machine.patches.strain_limit),
        ),
    )


def _joint_radius(plant: Plant) -> Array | None:
    if plant.joint_cos is None or plant.joint_sin is None:
        return None
    return jnp.sqrt(jnp.max(plant.joint_cos**2 + plant.joint_sin**2))


def _allowed_compression(case: Case, plant: Plant) -> Array:
    """Critical force of the links, even if the model ignores buckling [N], (3,)."""
    if plant.shortening is None:
        return euler_force(case.machine)
    return critical_force(plant)


def conclude(outline: Outline, code: Array, last: State, record: Record | None = None) -> RunResult:
    """Judge a run.

    Args:
        outline: of the case.
        code: status at the start, as a float, ().
        last: state after the last step.
        record: trajectories to pass on.

    Returns:
        RunResult.
    """
    result = metrics.finish(last.totals, outline.ending)
    final = last.status
    limit, error = outline.saturation_limit, result.pose_error_rms
    miss = jnp.sqrt(error[0] ** 2 + error[1] ** 2)
    if outline.joint_radius is not None:
        miss = miss + outline.joint_radius * error[2]
    strain = result.patch_strain_peak  # None: nobody asked
    is_strained = False if strain is None else jnp.any(strain > outline.strain_limit)
    is_overloaded = jnp.any(result.peak_compression > outline.critical_force)
    for is_wrong, bad in (
        (is_overloaded, status.OVERLOADED),
        (miss > outline.arrival_tolerance, status.NOT_ARRIVED),
        (result.motor_saturated_fraction > limit, status.MOTORS_SATURATED),
        (result.saturated_fraction > limit, status.SATURATED),
        (result.clipped_fraction > limit, status.CLIPPED),
        (outline.singularity_distance < outline.singularity_margin, status.NEAR_SINGULAR),
        (is_strained, status.STRAINED),
    ):
        final = jnp.where((final == status.OK) & is_wrong, float(bad), final)
    # zeros from a stopped run would look like perfect results
    is_finished = reduce(jnp.logical_or, (final == code for code in status.FINISHED))
    result = jax.tree.map(lambda x: jnp.where(is_finished, x, jnp.nan), result)
    return RunResult(
        metrics=result,
        status=final.astype(jnp.int32),
        bad_time=jnp.where(code == status.OK, last.bad_time, outline.early_time),
        command_end=outline.command_end,
        sensor_condition=outline.sensor_condition,
        actuator_condition=outline.actuator_condition,
        singularity_distance=outline.singularity_distance,
        record=record,
    )


@compiled("structure", "has_record")
def simulate(structure: Structure, case: Case, has_record: bool = False) -> RunResult:
    """Run one case with the reference executor, a scan; other executors replace only the scan.

    Args:
        structure: static choices.
        case: the numbers; `jax.vmap` over any of them.
        has_record: return trajectories too (static).

    Returns:
        RunResult, whose `status` says what went wrong; nothing is raised inside. Its derivatives
        are those of the smooth loop: converters without rounding, limits with round corners.

    Example:
        >>> run = simulate(*paper_case({"link.modes": 2}))
        >>> run.metrics.residual_rms.shape  # of each link at three stations
        (3, 3)
    """
    has_converters = structure.feedback == "sampled" and not structure.is_smooth
    run = _rounded() if has_converters else _run
    return run(structure, has_record, case)


@cache
def _rounded() -> Callable[..., RunResult]:
    """`_run` with the derivatives of the smooth loop."""
    run = jax.custom_jvp(_run, nondiff_argnums=(0, 1))
    run.defjvp(_smooth_tangent)
    return run


def _smooth_tangent(
    structure: Structure, has_record: bool, primals: tuple[Any, ...], tangents: tuple[Any, ...]
) -> tuple[RunResult, RunResult]:
    """Rounding has derivative 0, and a loop closed through it a meaningless one."""
    smooth = partial(_run, structure._replace(is_smooth=True), has_record)
    return _run(structure, has_record, *primals), jax.jvp(smooth, primals, tangents)[1]


def _run(structure: Structure, has_record: bool, case: Case) -> RunResult:
    start = begin(structure, case)

    def body(state: Any, inputs: Any) -> Any:
        after, record = step(structure, start.loop, state, inputs)
        return after, record if has_record else None

    if structure.is_smooth or has_record:
        last, record = _scan_in_blocks(body, start.state, start.inputs, structure.is_smooth)
    else:
        last, record = jax.lax.scan(body, start.state, start.inputs)
    return conclude(start.outline, start.state.status, last, record)
