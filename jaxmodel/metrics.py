"""Numbers that judge a run, accumulated inside the loop so that no trajectory has to be kept.

Windows: *moving* is from t = 0 to the end of the shaped command, *residual* starts
`residual_delay` after it and lasts `residual_length`. Deflections are chord deflections (relative
to the line B-C) at the stations, so they do not depend on the basis. Modal coordinates of the
controller's modes are what a noise-free modal filter makes of the plant's deflection.
"""

from __future__ import annotations

from typing import NamedTuple

import jax.numpy as jnp

from jaxmodel.parameters import Array


class Sample(NamedTuple):
    """What the metrics read at one sampling instant."""

    deflection: Array  # chord deflection at the stations [m], (3, S)
    q: Array  # plant modes [m], (3, R)
    q_rate: Array  # [m/s], (3, R)
    modal: Array  # controlled modes as seen by an ideal modal filter [m], (3, C)
    modal_rate: Array  # [m/s], (3, C)
    pose_error: Array  # against the shaped command [m, m, rad], (3,)
    voltage: Array  # on the actuators [V], (3, K)
    is_saturated: Array  # share of this sample with an actuator at its limit, 0 or 1, ()
    is_clipped: Array  # 1 where any ADC channel clips, ()
    motor_force: Array  # [N], (3,)
    is_motor_saturated: Array  # share of this sample with a motor at its limit, 0 or 1, ()
    axial_force: Array  # tension in the links [N], (3,)
    stretch_error: Array  # of the platform if links stretched [m, m, rad], (3,)


class Window(NamedTuple):
    """Weights of this instant, () each."""

    time: Array  # t [s]
    is_moving: Array  # 0 or 1
    is_residual: Array  # 0 or 1
    after_command: Array  # time since the end of the command, 0 before [s]
    taper: Array  # Hann window of the spectra [1]


class Totals(NamedTuple):
    """Running sums and maxima."""

    count: Array  # samples so far, ()
    moving_count: Array
    residual_count: Array
    moving_square: Array  # deflection, (3, S)
    moving_peak: Array
    residual_square: Array
    residual_peak: Array
    moving_modal_square: Array  # plant modes, (3, R)
    residual_modal_square: Array
    residual_modal_peak: Array
    settled_at: Array  # last time outside the band after the command [s], (3,)
    ringing: Array  # sum of share outside the band after the command, (3,)
    moving_error_peak: Array  # pose, (3,)
    residual_error_square: Array
    peak_voltage: Array  # (3,)
    voltage_square: Array  # ()
    saturated: Array  # ()
    clipped: Array  # ()
    peak_force: Array  # (3,)
    motor_saturated: Array  # ()
    peak_tension: Array  # (3,)
    peak_compression: Array  # (3,)
    stretch_peak: Array  # (3,)
    plant_energy: Array  # sum while moving, (3, R)
    modal_energy: Array  # the same in the controller's modes, (3, C)
    taper_square: Array  # ()
    phasor: tuple[Array, Array]  # cos and sin of omega t, (3, C, n_frequencies)
    spectrum: tuple[Array, Array]  # sum of taper q cos, q sin, (3, C, n_frequencies)


class Metrics(NamedTuple):
    """Judgement of a run."""

    residual_rms: Array  # chord deflection in the residual window [m], (3, S)
    residual_peak: Array  # [m], (3, S)
    structural_rms: Array  # while moving [m], (3, S)
    structural_peak: Array  # [m], (3, S)
    residual_modal_rms: Array  # plant modes in the residual window [m], (3, R)
    residual_modal_peak: Array  # [m], (3, R)
    structural_modal_rms: Array  # plant modes while moving [m], (3, R)
    settling_time: Array  # from the command's end until it stays in the band [s], (3,)
    ringing_time: Array  # smooth: integral of d^2/(d^2 + band^2) after the command [s], (3,)
    pose_error_peak: Array  # while moving [m, m, rad], (3,)
    pose_error_rms: Array  # in the residual window [m, m, rad], (3,)
    peak_voltage: Array  # [V], (3,)
    saturated_fraction: Array  # samples with any actuator at its limit [1], ()
    clipped_fraction: Array  # samples with any ADC channel at its end [1], ()
    control_energy: Array  # integral of sum V_a^2 over the run [V2 s], ()
    peak_force: Array  # of the motors [N], (3,)
    motor_saturated_fraction: Array  # samples with any motor at its limit [1], ()
    peak_tension: Array  # in the links [N], (3,)
    peak_compression: Array  # [N], (3,)
    stretch_error_peak: Array  # of the platform if links stretched [m, m, rad], (3,)
    plant_energy: Array  # mean of omega^2 q^2 + q'^2 while moving, plant modes [m2/s2], (3, R)
    modal_energy: Array  # the same, controller's modes, for EMC (24) [m2/s2], (3, C)
    spectral_density: Array  # one-sided PSD of the controller's modes [m2/Hz], (3, C, n)


#: Totals that each metric needs.
NEEDS = {
    "residual_rms": ("residual_count", "residual_square"),
    "residual_peak": ("residual_peak",),
    "structural_rms": ("moving_count", "moving_square"),
    "structural_peak": ("moving_peak",),
    "residual_modal_rms": ("residual_count", "residual_modal_square"),
    "residual_modal_peak": ("residual_modal_peak",),
    "structural_modal_rms": ("moving_count", "moving_modal_square"),
    "settling_time": ("settled_at",),
    "ringing_time": ("ringing",),
    "pose_error_peak": ("moving_error_peak",),
    "pose_error_rms": ("residual_count", "residual_error_square"),
    "peak_voltage": ("peak_voltage",),
    "saturated_fraction": ("count", "saturated"),
    "clipped_fraction": ("count", "clipped"),
    "control_energy": ("voltage_square",),
    "peak_force": ("peak_force",),
    "motor_saturated_fraction": ("count", "motor_saturated"),
    "peak_tension": ("peak_tension",),
    "peak_compression": ("peak_compression",),
    "stretch_error_peak": ("stretch_peak",),
    "plant_energy": ("moving_count", "plant_energy"),
    "modal_energy": ("moving_count", "modal_energy"),
    "spectral_density": ("taper_square", "phasor", "spectrum"),
}
#: Metrics that the status of a run depends on.
ALWAYS = (
    "saturated_fraction", "clipped_fraction", "motor_saturated_fraction", "pose_error_rms",
    "peak_compression",
)  # fmt: skip


def zero_totals(
    n_stations: int, n_modes: int, n_controlled: int, n_frequencies: int, dtype,
    wanted: tuple[str, ...] = (),
) -> Totals:  # fmt: skip
    """Totals before the first sample.

    Args:
        n_stations, n_modes, n_controlled, n_frequencies: sizes.
        dtype: of all of them.
        wanted: metrics to accumulate, () for all; what only others need is None.
    """
    zero, link = jnp.zeros((), dtype), jnp.zeros((3,), dtype)
    stations, modes = jnp.zeros((3, n_stations), dtype), jnp.zeros((3, n_modes), dtype)
    controlled = jnp.zeros((3, n_controlled), dtype)
    lines = jnp.zeros((3, n_controlled, n_frequencies), dtype)
    whole = Totals(
        zero, zero, zero, stations, stations, stations, stations, modes, modes, modes, link, link,
        link, link, link, zero, zero, zero, link, zero, link, link, link, modes, controlled, zero,
        (1 + lines, lines), (lines, lines),
    )  # fmt: skip
    names = {*wanted, *ALWAYS} if wanted else NEEDS
    needed = {total for name in names for total in NEEDS[name]}
    kept = (x if f in needed else None for f, x in zip(Totals._fields, whole, strict=True))
    return Totals._make(kept)


def _filled(totals: Totals) -> Totals:
    """Zeros for what is not accumulated, so that one arithmetic serves all choices."""
    pairs = ("phasor", "spectrum")
    return Totals._make(
        x if x is not None else (0.0, 0.0) if f in pairs else 0.0
        for f, x in zip(Totals._fields, totals, strict=True)
    )


def accumulate(
    totals: Totals,
    sample: Sample,
    window: Window,
    omega: Array,
    modal_omega: Array,
    rotation: tuple[Array, Array],
    band: Array,
) -> Totals:
    """Add one sample.

    Args:
        totals: so far.
        sample: the instant's signals.
        window: the instant's weights.
        omega: plant modes [rad/s], (3, R).
        modal_omega: controller's modes [rad/s], (3, C).
        rotation: cos and sin of (frequency x period), (3, C, n_frequencies).
        band: settling band [m], ().

    Returns:
        Totals.
    """
    given, totals = totals, _filled(totals)
    moving, residual = window.is_moving, window.is_residual
    size = jnp.abs(sample.deflection)
    square = sample.deflection * sample.deflection
    modal_square = sample.q * sample.q
    highest = jnp.max(size, axis=1)
    is_outside = highest > band
    is_after = jnp.where(window.after_command > 0, 1.0, 0.0).astype(highest.dtype)
    cosine, sine = (jnp.asarray(x) for x in totals.phasor)
    turn_c, turn_s = rotation
    weighted = (window.taper * sample.modal)[:, :, None]
    plant_energy = omega * omega * modal_square + sample.q_rate * sample.q_rate
    modal_energy = (modal_omega * sample.modal) ** 2 + sample.modal_rate * sample.modal_rate
    new = Totals(
        count=totals.count + 1,
        moving_count=totals.moving_count + moving,
        residual_count=totals.residual_count + residual,
        moving_square=totals.moving_square + moving * square,
        moving_peak=jnp.maximum(totals.moving_peak, moving * size),
        residual_square=totals.residual_square + residual * square,
        residual_peak=jnp.maximum(totals.residual_peak, residual * size),
        moving_modal_square=totals.moving_modal_square + moving * modal_square,
        residual_modal_square=totals.residual_modal_square + residual * modal_square,
        residual_modal_peak=jnp.maximum(totals.residual_modal_peak, residual * jnp.abs(sample.q)),
        settled_at=jnp.where(is_outside, window.after_command, totals.settled_at),
        ringing=totals.ringing + is_after * highest * highest / (highest * highest + band * band),
        moving_error_peak=jnp.maximum(
            totals.moving_error_peak, moving * jnp.abs(sample.pose_error)
        ),
        residual_error_square=totals.residual_error_square
        + residual * sample.pose_error * sample.pose_error,
        peak_voltage=jnp.maximum(totals.peak_voltage, jnp.max(jnp.abs(sample.voltage), axis=1)),
        voltage_square=totals.voltage_square
        + jnp.sum(jnp.sum(sample.voltage * sample.voltage, axis=1), axis=0),
        saturated=totals.saturated + sample.is_saturated,
        clipped=totals.clipped + sample.is_clipped,
        peak_force=jnp.maximum(totals.peak_force, jnp.abs(sample.motor_force)),
        motor_saturated=totals.motor_saturated + sample.is_motor_saturated,
        peak_tension=jnp.maximum(totals.peak_tension, sample.axial_force),
        peak_compression=jnp.maximum(totals.peak_compression, -sample.axial_force),
        stretch_peak=jnp.maximum(totals.stretch_peak, jnp.abs(sample.stretch_error)),
        plant_energy=totals.plant_energy + moving * plant_energy,
        modal_energy=totals.modal_energy + moving * modal_energy,
        taper_square=totals.taper_square + window.taper * window.taper,
        phasor=(cosine * turn_c - sine * turn_s, sine * turn_c + cosine * turn_s),
        spectrum=(
            totals.spectrum[0] + weighted * cosine,
            totals.spectrum[1] + weighted * sine,
        ),
    )
    return Totals._make(None if a is None else b for a, b in zip(given, new, strict=True))


def _root(x: Array) -> Array:
    # the inner where keeps the gradient finite at zero
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


def finish(totals: Totals, period: Array) -> Metrics:
    """Metrics from the totals of a run sampled every `period` [s].

    The spectral density is the Hann-windowed periodogram 2 T |sum w x e^(-j omega t)|^2/sum w^2 at
    given frequencies, one-sided. Metrics that have not been accumulated are None.
    """
    is_there = {f: x is not None for f, x in zip(Totals._fields, totals, strict=True)}
    totals = _filled(totals)
    moving = jnp.maximum(totals.moving_count, 1)
    residual = jnp.maximum(totals.residual_count, 1)
    count = jnp.maximum(totals.count, 1)
    power = totals.spectrum[0] ** 2 + totals.spectrum[1] ** 2
    taper = jnp.where(totals.taper_square > 0, totals.taper_square, 1.0)
    whole = Metrics(
        residual_rms=_root(totals.residual_square / residual),
        residual_peak=totals.residual_peak,
        structural_rms=_root(totals.moving_square / moving),
        structural_peak=totals.moving_peak,
        residual_modal_rms=_root(totals.residual_modal_square / residual),
        residual_modal_peak=totals.residual_modal_peak,
        structural_modal_rms=_root(totals.moving_modal_square / moving),
        settling_time=totals.settled_at,
        ringing_time=totals.ringing * period,
        pose_error_peak=totals.moving_error_peak,
        pose_error_rms=_root(totals.residual_error_square / residual),
        peak_voltage=totals.peak_voltage,
        saturated_fraction=totals.saturated / count,
        clipped_fraction=totals.clipped / count,
        control_energy=totals.voltage_square * period,
        peak_force=totals.peak_force,
        motor_saturated_fraction=totals.motor_saturated / count,
        peak_tension=totals.peak_tension,
        peak_compression=totals.peak_compression,
        stretch_error_peak=totals.stretch_peak,
        plant_energy=totals.plant_energy / moving,
        modal_energy=totals.modal_energy / moving,
        spectral_density=2 * period * power / taper,
    )
    return Metrics(
        *(
            x if all(is_there[total] for total in NEEDS[name]) else None
            for name, x in zip(Metrics._fields, whole, strict=True)
        )
    )
