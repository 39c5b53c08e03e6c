"""From a `Case` to what the loop reads: matrices and coefficients, computed once per case."""

from __future__ import annotations

from functools import reduce
from typing import NamedTuple

from jaxmodel import shaper, status
from jaxmodel.axial import axial_compliance, axial_force, held_coordinates
from jaxmodel.bases import Bases, find_bases
from jaxmodel.beam import BASES, ModalBasis, pinned_free_roots
from jaxmodel.case import Case, Drive, Structure
from jaxmodel.channels import Channels
from jaxmodel.control import active_modes, condition_number, left_inverse
from jaxmodel.controller import Controller, Feedback, with_gains
from jaxmodel.delay import LONGEST, command_change, true_delay
from jaxmodel.drive import LAG_POLE, Reference
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import drive_gains
from jaxmodel.dynamics import inverse_dynamics
from jaxmodel.electronics import Amplifier, design_amplifier, voltage_passage
from jaxmodel.estimator import KINDS
from jaxmodel.hysteresis import Hysteresis, design_hysteresis
from jaxmodel.integrator import Exponential, exponential_step
from jaxmodel.joints import joint_decay
from jaxmodel.kinematics import chain_status, close_chain
from jaxmodel.laws import LAWS, is_modal, n_channels
from jaxmodel.laws.contract import NominalModel, check_feedback
from jaxmodel.laws.poles import is_unplaceable
from jaxmodel.lazy import compiled, jax, jnp
from jaxmodel.loop import Delayed, LeftOut, Loop, Rest
from jaxmodel.metrics import METRICS
from jaxmodel.notch import design_notch
from jaxmodel.parameters import Array, Num
from jaxmodel.piezo import bare_stiffness, outer_faces, patch_constants, placement_faults
from jaxmodel.plant import Plant, build_plant, damping_ratio
from jaxmodel.static import static_remainder
from jaxmodel.stretch import Stretch, find_stretch, held_strain, held_voltage

#: Frequencies of the spectra lie within this fraction of the modal frequency [1].
SPECTRUM_SPAN = 0.1
#: omega h of the highest plant mode beyond which the coefficients of ETDRK4 lose digits [1].
MODE_STEP_LIMIT = 100
#: |Re lambda| h that one plant step may have outside the links; ETDRK4 is unstable from about 2.8.
STIFFNESS_LIMIT = 2.5
#: omega h of the highest mode of links whose ends are not on their chords: such modes are strongly
#: coupled, which ETDRK4 integrates explicitly; 2e-4 of the bending at this limit [1].
COUPLED_STEP_LIMIT = 1.5


#: Fastest longitudinal mode of the machine over that of one link between slider and platform [1].
STRETCHING = 1.5


class Prepared(NamedTuple):
    """A case ready to run."""

    loop: Loop
    bases: Bases  # the modal bases it is built from
    taps: shaper.Taps  # shaper on the sample grid
    initial_q: Num[Array, "links Q"]  # [m]
    sensor_condition: Num[Array, "links"]  # condition number of the modal filter per link [1]
    actuator_condition: Num[Array, "links"]  # of the synthesizer [1]
    status: Num[Array, ""]  # fault found before the run, as a float


class ControllerDesign(NamedTuple):
    """Controller and the by-products of its design."""

    controller: Controller
    nominal: NominalModel
    modal_omega: Num[Array, "links C"]  # frequencies of the controller's own modes [rad/s]
    sensor_condition: Num[Array, "links"]
    actuator_condition: Num[Array, "links"]


@compiled("structure")
def prepare(structure: Structure, case: Case) -> Prepared:
    """Compute everything the loop needs.

    Args:
        structure: static choices.
        case: the numbers.

    Returns:
        Prepared; `status` says what makes the case invalid; the numbers stay finite even then.

    Example:
        >>> prepared = prepare(*paper_case({"link.modes": 2}))
        >>> float(prepared.status)
        0.0
    """
    machine, electronics = case.machine, case.electronics
    bases = find_bases(structure, case)
    basis = bases.plant
    stretch = stretch_of(structure, case)
    plant = _plant(structure, case, basis, stretch)
    design = design_controller(structure, case, bases)
    omega = jnp.sqrt(basis.stiffness / basis.mass)
    split = oscillators(structure, case, plant, omega)
    step = electronics.period / structure.substeps
    change = command_change(true_delay(electronics)) if structure.is_delayed else None
    after = step if change is None else (1 - change.share) * step
    lambda_s, lambda_a = patch_constants(machine)
    sensor = lambda_s[:, :, None] * jnp.swapaxes(basis.sensor_slope, 1, 2)
    observer = jnp.einsum("ick,ikr->icr", design.nominal.observer, sensor)
    actuator = lambda_a[:, None] * basis.actuator_slope / basis.mass[:, :, None]
    deflection_at = basis.deflection_at
    if stretch is not None:
        scale = plant.stretch * stretch.stiffness
        sensor = _beside(sensor, stretch.volts * stretch.strain * scale[:, None], 2)
        actuator = _beside(actuator, stretch.free * (scale / plant.modal_mass)[:, None], 1)
        observer, deflection_at = (_beside(x, 0.0, 2) for x in (observer, deflection_at))
    angle = 2 * jnp.pi * electronics.period * spectrum_frequencies(structure, bases)
    loop = Loop(
        plant=plant,
        omega=omega,
        exponential=_exponential(structure, case, split, after),
        plant_step=after,
        amplifier=_amplifier(structure, case, after),
        sensor=sensor,
        actuator=actuator,
        deflection_at=deflection_at,
        controller=design.controller,
        ideal=_ideal(design.controller.feedback, sensor) if structure.feedback == "ideal" else None,
        observer=observer,
        modal_omega=design.modal_omega,
        rotation=(jnp.cos(angle), jnp.sin(angle)),
        drive=_each_slider(case.drive),
        axial_compliance=axial_compliance(machine) if stretch is None else 1 / stretch.stiffness,
        settling_band=jnp.asarray(case.windows.settling_band),
        left_out=_left_out(structure, case, basis, stretch, after),
        hysteresis=_hysteresis(structure, case),
        rest=_rest(structure, case, plant) if structure.is_linear else None,
        split=split[2],
        strain=_strain(structure, case, basis, stretch, plant),
    )
    if change is not None:
        until = change.share * step
        delayed = Delayed(
            before=change.before,
            after=change.after,
            exponential=_exponential(structure, case, split, until),
            plant_step=until,
            amplifier=_amplifier(structure, case, until),
            passage=None if loop.left_out is None else _passage(structure, case, until),
        )
        loop = loop._replace(delayed=delayed)
    return Prepared(
        loop=loop,
        bases=bases,
        taps=design_taps(case, bases),
        initial_q=_initial_coordinates(structure, case, bases, plant),
        sensor_condition=design.sensor_condition,
        actuator_condition=design.actuator_condition,
        status=_static_status(structure, case, bases, plant, design, split, step),
    )


def _beside(x: Array, value: Array, axis: int) -> Array:
    """One more coordinate at the end of an axis, (3, ., .)."""
    shape = (*x.shape[:axis], 1, *x.shape[axis + 1 :])
    last = jnp.expand_dims(value, axis) if jnp.ndim(value) else jnp.full(shape, value)
    return jnp.concatenate([x, last], axis=axis)


def _plant(structure: Structure, case: Case, basis: ModalBasis, stretch: Stretch | None) -> Plant:
    return build_plant(
        case.machine,
        basis,
        case.drive.is_locked,
        structure.has_shortening,
        structure.is_distributed,
        stretch,
        # linear models leave it out: it damps small motion most, so they are on the safe side
        structure.has_joint_friction and not structure.is_linear,
    )


def stretch_of(structure: Structure, case: Case) -> Stretch | None:
    """Stretch of the links; None: they keep their length."""
    if not structure.has_stretch:
        return None
    machine, basis = case.machine, BASES[structure.basis]
    return find_stretch(machine.beam, machine.patches, machine.damping, basis.has_patches)


def oscillators(structure: Structure, case: Case, plant: Plant, omega: Array) -> tuple[Array, ...]:
    """Oscillators that plant steps solve exactly: modes as they are, elongations as assembled.

    Between slider and platform an elongation vibrates at a fraction of the frequency of the link
    alone, which has the smallest mass.

    Returns:
        omega [rad/s], zeta [1], (3, coordinates) each, and `Loop.split`.
    """
    mass = plant.modal_mass[:, None]
    decay = plant.damping / mass
    if plant.stretch is None:
        return omega, decay / (2 * omega), None
    pose = jnp.asarray(case.path.waypoints[-1])
    chain = close_chain(plant, pose, jnp.zeros_like(pose))
    far = plant.platform_mass + jnp.sum(plant.tip_mass)
    lightness = chain.frame.rho_f**2 / plant.slider_link_mass + 1 / far
    # modal mass over the mass that an elongation moves
    share = plant.modal_mass / plant.stretch**2 * lightness
    square = plant.stiffness[:, -1] / plant.modal_mass
    own = jnp.sqrt(square * share)
    omega = jnp.concatenate([omega, own[:, None]], axis=1)
    held = decay[:, -1] * share
    zeta = jnp.concatenate([decay[:, :-1], held[:, None]], axis=1) / (2 * omega)
    return omega, zeta, (own**2 - square, held - decay[:, -1])


def _explicit_rate(structure: Structure, case: Case, plant: Plant, omega: Array) -> Array:
    """Fastest motion of the links that plant steps do not solve exactly [1/s], ().

    The fastest longitudinal mode, 0 of a path that ends out of reach, and friction in the joints.

    Args:
        omega: of `oscillators`.
    """
    friction = joint_decay(plant)
    if not structure.has_stretch:
        return friction
    pose = jnp.asarray(case.path.waypoints[-1])
    is_ok = chain_status(plant, close_chain(plant, pose, jnp.zeros_like(pose))) == status.OK
    return jnp.maximum(friction, jnp.where(is_ok, STRETCHING * jnp.max(omega[:, -1]), 0.0))


def _exponential(
    structure: Structure, case: Case, split: tuple[Array, ...], step: Array
) -> Exponential:
    electronics = case.electronics
    return exponential_step(
        split[0],
        split[1],
        step,
        electronics.antialias,
        electronics.sensor_highpass if structure.has_sensor_highpass else None,
    )


def _amplifier(structure: Structure, case: Case, step: Array) -> Amplifier | None:
    if not structure.has_amplifier:
        return None
    return design_amplifier(step, case.electronics.amplifier_lag)


def _hysteresis(structure: Structure, case: Case) -> Hysteresis | None:
    if not structure.has_hysteresis or structure.feedback != "sampled":
        return None
    return design_hysteresis(case.machine.patches.hysteresis, case.electronics.voltage_limit)


def _passage(structure: Structure, case: Case, step: Array) -> Array | None:
    """See `LeftOut`."""
    if structure.feedback != "sampled":
        return None
    electronics = case.electronics
    return voltage_passage(
        step,
        electronics.antialias,
        electronics.sensor_highpass if structure.has_sensor_highpass else None,
        electronics.amplifier_lag if structure.has_amplifier else None,
    )


def _left_out(
    structure: Structure, case: Case, basis: ModalBasis, stretch: Stretch | None, step: Array
) -> LeftOut | None:
    """Static response of the modes that the plant leaves out, and of links of given length."""
    if not structure.has_static_correction and stretch is None:
        return None
    share = float(structure.has_static_correction)
    sensor = share * _left_out_voltage(case, basis)
    return LeftOut(
        sensor=sensor if stretch is None else sensor + held_voltage(stretch),
        deflection=share * left_out_deflection(case, basis),
        passage=_passage(structure, case, step),
    )


def _left_out_voltage(case: Case, basis: ModalBasis, mode_mask: Array = 1.0) -> Array:
    """Sensor volts per actuator volt by all but some modes of a basis [V/V], (3, K, K)."""
    lambda_s, lambda_a = patch_constants(case.machine)
    return lambda_s[:, :, None] * lambda_a[:, None] * static_remainder(basis, mode_mask)[0]


def _strain(
    structure: Structure, case: Case, basis: ModalBasis, stretch: Stretch | None, plant: Plant
) -> tuple[Array, Array] | None:
    """See `Loop.strain`; None: not wanted.

    Of the actuators' faces, and of the sensors', which bending draws the other way; of links of
    given length the first are enough, and beside a strain gauge there is no other.
    """
    if "patch_strain_peak" not in (structure.metrics or METRICS):
        return None
    beam, patches = case.machine.beam, case.machine.patches
    near, far = (
        jnp.broadcast_to(height / patches.sensor_length, (structure.n_links,))[:, None, None]
        for height in outer_faces(beam, patches)
    )
    share = float(structure.has_static_correction)
    by_q = jnp.swapaxes(basis.sensor_slope, 1, 2)
    by_voltage = share * patch_constants(case.machine)[1][:, None] * static_remainder(basis)[0]
    if stretch is None:
        return near * by_q, near * by_voltage

    def faces(turned: Array, drawn: Array) -> Array:
        return jnp.concatenate([drawn + near * turned, drawn + far * turned], axis=1)

    tension = (plant.stretch * stretch.stiffness)[:, None]
    by_elongation = jnp.tile(stretch.strain * tension, (1, 2))
    return _beside(faces(by_q, 0.0), by_elongation, 2), faces(by_voltage, held_strain(stretch))


def left_out_deflection(case: Case, basis: ModalBasis) -> Array:
    """Deflection at the stations that the actuators give modes beyond `basis` [m/V], (3, S, K)."""
    return patch_constants(case.machine)[1][:, None] * static_remainder(basis)[1]


def _rest(structure: Structure, case: Case, plant: Plant) -> Rest:
    """The machine at the last way-point, where it rings, held against the steady load."""
    pose = jnp.asarray(case.path.waypoints[-1])
    still = jnp.zeros_like(pose)
    wrench = jnp.asarray(case.load.wrench) if structure.has_wrench else None
    force = None
    law = DRIVES[structure.drive]
    if law.has_feedforward or structure.has_wrench:
        force = inverse_dynamics(plant, pose, still, still, wrench)
    held = Reference(
        rho=close_chain(plant, pose, still).rho,
        rho_rate=still,
        feedforward=force,
        disturbance=still,
        wrench=wrench,
        held=still if law.is_sampled else None,
    )
    return Rest(pose, held)


def _ideal(feedback: Feedback, sensor: Array) -> tuple[Array, Array | None]:
    """Voltages of continuous feedback per modal velocity and position, (3, K, R) each."""
    assert isinstance(feedback, Channels)
    channel = jnp.einsum("ick,ikr->icr", feedback.filter, sensor)

    def matrix(gain: Array | None) -> Array | None:
        if gain is None:
            return None
        return -jnp.einsum("ikc,icr->ikr", feedback.synthesizer, gain[:, :, None] * channel)

    return matrix(feedback.velocity_gain), matrix(feedback.position_gain)


def _each_slider(drive: Drive) -> Drive:
    """The drive with its numbers for each slider, (3,)."""

    def each(x: Array) -> Array:
        return jnp.broadcast_to(jnp.asarray(x), jnp.shape(drive.pulse_force))

    parameters = {name: each(x) for name, x in drive.parameters.items()}
    numbers = {name: each(getattr(drive, name)) for name in _PER_LINK_DRIVE}
    return drive._replace(parameters=parameters, **numbers)


_PER_LINK_DRIVE = (
    "kp",
    "kd",
    "force_limit",
    "coulomb_friction",
    "friction_speed",
    "viscous_friction",
    "ripple",
)


def spectrum_frequencies(structure: Structure, bases: Bases) -> Array:
    """Where spectra are taken, around the plant's frequencies [Hz], (3, C, n_frequencies)."""
    span = jnp.linspace(1 - SPECTRUM_SPAN, 1 + SPECTRUM_SPAN, structure.n_frequencies)
    return bases.plant_omega[:, :, None] * span / (2 * jnp.pi)


def _believed(case: Case) -> Case:
    """The case whose patches are all as the controller believes them to be."""
    patches = case.machine.patches._replace(sensor_factor=1.0, actuator_factor=1.0)
    return case._replace(machine=case.machine._replace(patches=patches))


def design_controller(structure: Structure, case: Case, bases: Bases) -> ControllerDesign:
    """Controller of a case from its nominal model, `Bases.model`.

    Modal filter pinv(lambda_s Phi_s^t) and synthesizer pinv(lambda_a Phi_a), from which the law
    designs the feedback (`jaxmodel.laws`).

    Args:
        structure: static choices; `law` and sizes are read.
        case: the numbers.
        bases: of plant and belief.

    Returns:
        ControllerDesign.
    """
    case = _believed(case)
    control, electronics = case.control, case.electronics
    model, assembled, n = bases.model, bases.believed_omega, structure.n_controlled
    lambda_s, lambda_a = patch_constants(case.machine)
    sensor = lambda_s[:, :, None] * jnp.swapaxes(model.sensor_slope, 1, 2)  # (3, K, modes)
    actuator = lambda_a[:, None] * model.actuator_slope  # (3, modes, K)
    mask = active_modes(control.n_active, n, structure.n_patches)
    seen, driven = sensor[:, :, :n], jnp.swapaxes(actuator[:, :n], 1, 2)
    # in one call: XLA's CPU compiler aborts on two side by side if C = 1 (jax 0.10)
    inverse = jax.vmap(left_inverse, (0, None))(jnp.concatenate([seen, driven]), mask)
    links = structure.n_links
    observer, synthesizer = inverse[:links], jnp.swapaxes(inverse[links:], 1, 2)

    nominal = NominalModel(
        observer=observer,
        synthesizer=synthesizer,
        sensor=seen,
        actuator=actuator[:, :n],
        omega=assembled,
        damping_ratio=_believed_damping(case, assembled),
        modal_mass=model.mass[:, :n],
        mask=mask,
        feedthrough=_left_out_voltage(case, model, jnp.pad(mask, (0, model.mass.shape[1] - n))),
    )
    stretch = stretch_of(structure._replace(basis=structure.controller_basis), case)
    if stretch is not None:  # below longitudinal modes links lengthen freely
        local = stretch.volts[:, :, None] * stretch.local
        nominal = nominal._replace(feedthrough=nominal.feedthrough + local)
    law = LAWS[structure.law]
    feedback = law.design(structure, case, nominal)
    sizes = structure.n_links, n_channels(structure), structure.n_patches
    check_feedback(law, feedback, *sizes)
    if isinstance(feedback, Channels) and not structure.has_position_gain:
        feedback = feedback._replace(position_gain=None)
    controller = Controller(
        feedback=feedback,
        feedthrough=control.feedthrough_factor * nominal.feedthrough,
        voltage_limit=jnp.asarray(electronics.voltage_limit),
        adc_gain=jnp.asarray(electronics.conditioner_gain),
        adc_bias=jnp.asarray(electronics.conditioner_bias),
        adc_step=jnp.asarray(electronics.adc_range / electronics.adc_levels),
        adc_top=jnp.asarray(electronics.adc_levels - 1.0),
        adc_noise=_converter_noise(case),
        notch=design_notch(control, electronics.period) if structure.has_notch else None,
    )
    return ControllerDesign(
        controller=with_gains(controller, control.gain_factor),
        nominal=nominal,
        modal_omega=jnp.sqrt(model.stiffness / model.mass)[:, :n],
        sensor_condition=condition_number(seen, mask),
        actuator_condition=condition_number(driven, mask),
    )


def _converter_noise(case: Case) -> Array:
    """Noise at the ADC's input, of strain gauges with that of their amplifiers [V], ()."""
    electronics, patches = case.electronics, case.machine.patches
    own = electronics.conditioner_gain * patches.gauge_noise
    is_more = (patches.is_gauge > 0) & (own > 0)
    both = jnp.sqrt(jnp.where(is_more, electronics.adc_noise**2 + own**2, 1.0))
    return jnp.where(is_more, both, electronics.adc_noise)


def _believed_damping(case: Case, omega: Array) -> Array:
    """Damping ratios of the controller's modes: of its law's model, if it has one, (3, C)."""
    specified = case.control.parameters.get("model_damping")
    if specified is not None:
        return jnp.broadcast_to(jnp.asarray(specified)[:, None], omega.shape)
    return damping_ratio(case.machine.damping, omega)


def design_taps(case: Case, bases: Bases) -> shaper.Taps:
    """Shaper of the case on its sample grid; each frequency split for its own mode, in series.

    A frequency of zero stands for mode 1 of the controller's model, averaged over the links.
    """
    shaping, period = case.shaping, case.electronics.period
    mean_omega = jnp.mean(bases.believed_omega[:, 0])

    def one(omega: Array, zeta: Array) -> shaper.Taps:
        omega = jnp.where(omega > 0, omega, mean_omega)
        impulses = shaper.design_shaper(shaping.kind, omega, zeta, shaping.tolerance)
        linear = shaper.split_linear(impulses, period)
        exact = shaper.split_exact(impulses, period, omega, zeta)
        return linear._replace(weight=jnp.where(shaping.is_exact > 0, exact.weight, linear.weight))

    return reduce(shaper.in_series, map(one, jnp.asarray(shaping.omega), jnp.asarray(shaping.zeta)))


def _initial_coordinates(structure: Structure, case: Case, bases: Bases, plant: Plant) -> Array:
    """Modal coordinates at t = 0: given ones plus a static load F at x, q_j = Y_j(x) F/k_j.

    Elongations are those of the steady load.
    """
    initial, at, stiffness = case.initial, bases.at_load, bases.plant.stiffness
    compliance = jnp.sum(at * at / stiffness, axis=1)
    load = jnp.asarray(initial.load_deflection) / jnp.where(compliance > 0, compliance, 1.0)
    modal = jnp.where(jnp.arange(structure.n_modes) < case.n_modes, initial.modal, 0.0)
    modal = modal + at / stiffness * load[:, None]
    if plant.stretch is None:
        return modal
    still, pose = jnp.zeros_like(plant.stiffness), jnp.asarray(case.path.waypoints[0])
    if structure.has_wrench:
        at_rest = 0 * pose
        force = axial_force(plant, pose, at_rest, at_rest, case.load.wrench)
        still = held_coordinates(plant, force)
    return still.at[:, :-1].add(modal)


def lowpass_corner(structure: Structure, case: Case, bases: Bases) -> Array:
    """Highest low-pass corner of the velocity estimate among the controlled modes [rad/s], ()."""
    is_used = jnp.arange(structure.n_controlled) < case.control.n_active
    corner = case.electronics.lowpass_ratio * bases.believed_omega
    return jnp.max(jnp.where(is_used, corner, 0))


def _static_status(
    structure: Structure,
    case: Case,
    bases: Bases,
    plant: Plant,
    design: ControllerDesign,
    split: tuple[Array, ...],
    step: Array,
) -> Array:
    """Status before the run; `step` of the plant [s]."""
    is_used = jnp.arange(structure.n_modes) < case.n_modes
    mode_step, zeta = (
        jnp.where(is_used, x[:, : structure.n_modes], 0.0) for x in (split[0] * step, split[1])
    )
    stiff = drive_rate(structure.drive, case) * step
    stiff = jnp.maximum(stiff, _explicit_rate(structure, case, plant, split[0]) * step)
    patches, windows, control = case.machine.patches, case.windows, case.control
    length = jnp.broadcast_to(case.machine.beam.length, (structure.n_links,))
    is_off, is_overlapping = placement_faults(patches, length)
    checks = (
        (_is_ill_conditioned(structure, case, design), status.ILL_CONDITIONED),
        ((control.n_active > structure.n_patches) & is_modal(structure), status.TOO_MANY_MODES),
        (is_overlapping, status.PATCHES_OVERLAP),
        (is_off, status.PATCH_OFF_LINK),
        (
            _is_too_fast(structure, case, bases) | jnp.any(mode_step > MODE_STEP_LIMIT),
            status.TOO_FAST,
        ),
        (stiff > STIFFNESS_LIMIT, status.TOO_STIFF),
        (jnp.any(zeta >= 1), status.OVERDAMPED),
        (_has_unplaceable_poles(structure, case, design), status.UNPLACEABLE),
        (_is_delay_off(structure, case), status.DELAY_OFF),
        (
            ~jnp.all((windows.stations > 0) & (windows.stations < 1)),
            status.STATION_OFF_LINK,
        ),
        (~_is_finite(case), status.NON_FINITE),
    )
    code = jnp.zeros(())
    for is_wrong, value in checks:
        code = jnp.where(is_wrong, float(value), code)
    return code


def _is_finite(case: Case) -> Array:
    """Whether no number of the case is NaN or infinite."""
    numbers = (jnp.asarray(leaf) for leaf in jax.tree.leaves(case))
    return reduce(jnp.logical_and, (jnp.all(jnp.isfinite(leaf)) for leaf in numbers))


def drive_rate(kind: str, case: Case) -> Array:
    """Bound on the rate of the drives, d/m_s + sqrt(Kp/m_s) [1/s], ().

    d adds Kd, viscous friction and the steepest slope of the friction law; the mass that a joint
    feels is at least its own. Locked drives have none; of a sampled drive, whose force is held,
    only friction remains. `kind` is a name in `DRIVES`.
    """
    drive, mass = case.drive, case.machine.masses.slider_mass
    damping = drive.viscous_friction + drive.coulomb_friction / drive.friction_speed
    law = DRIVES[kind]
    if law.is_sampled:
        rate = jnp.max(damping / mass)
    else:
        gains = drive_gains(law, drive)
        rate = jnp.max(
            (gains.rate + damping) / mass + jnp.sqrt(jnp.maximum(gains.position, 0.0) / mass)
        )
    late = drive.lag > 0
    rate = jnp.maximum(rate, jnp.where(late, LAG_POLE / jnp.where(late, drive.lag, 1.0), 0.0))
    return jnp.where(case.drive.is_locked > 0, 0.0, rate)


def coupled_rate(structure: Structure, case: Case) -> Array:
    """omega of the fastest motion that `COUPLED_STEP_LIMIT` bounds [rad/s], 0: there is none.

    The highest mode of links whose ends are not on their chords, of pinned-free links
    sqrt(E I/(rhoA L^4)) (kL)^2; or a share of `_explicit_rate`, whose limit is `STIFFNESS_LIMIT`.
    """
    rate = jnp.zeros(())
    if structure.has_stretch or structure.has_joint_friction:
        basis = find_bases(structure, case).plant
        plant = _plant(structure, case, basis, stretch_of(structure, case))
        omega = jnp.sqrt(basis.stiffness / basis.mass)
        rate = _explicit_rate(
            structure, case, plant, oscillators(structure, case, plant, omega)[0]
        ) * (COUPLED_STEP_LIMIT / STIFFNESS_LIMIT)
    if BASES[structure.basis].is_on_chord:
        return rate
    beam = case.machine.beam
    line_mass = beam.density * beam.width * beam.thickness
    root = jnp.sqrt(bare_stiffness(beam) * beam.stiffness_factor / line_mass) / beam.length**2
    return jnp.maximum(rate, jnp.max(root) * pinned_free_roots(structure.n_modes)[-1] ** 2)


def _is_ill_conditioned(structure: Structure, case: Case, design: ControllerDesign) -> Array:
    uses_filter = is_modal(structure) and structure.feedback != "none"
    worst = jnp.maximum(jnp.max(design.sensor_condition), jnp.max(design.actuator_condition))
    return (worst > case.windows.condition_limit) & uses_filter


def _has_unplaceable_poles(structure: Structure, case: Case, design: ControllerDesign) -> Array:
    if not structure.has_poles or structure.feedback == "none":
        return jnp.zeros((), bool)
    return is_unplaceable(structure, case, design.nominal)


def _is_delay_off(structure: Structure, case: Case) -> Array:
    delay = true_delay(case.electronics)
    return ((delay < 0) | (delay > LONGEST)) & structure.is_delayed


def _is_too_fast(structure: Structure, case: Case, bases: Bases) -> Array:
    """Whether a filter or the shaper is beyond half the sample rate."""
    half = jnp.pi / case.electronics.period
    is_shaped = case.shaping.kind != shaper.SHAPERS.position("none")
    is_fast = jnp.any(case.shaping.omega >= half) & is_shaped
    if structure.feedback != "sampled":
        return is_fast
    has_lowpass = case.electronics.estimator == KINDS.index("modal_phase")
    is_fast |= (lowpass_corner(structure, case, bases) >= half) & has_lowpass
    is_fast |= case.electronics.sensor_highpass >= half
    is_fast |= jnp.any(case.control.notch >= half)
    return is_fast | (case.electronics.antialias >= half)
