"""Metrics of a run, accumulated inside the loop so that no trajectory has to be stored.

A `Metric` says what it is, which `Total`s it accumulates sample by sample, and how it computes its
value from them at the end; `METRICS` is the only list of them, and `METRICS.add` adds your own.

Windows: *moving* is from t = 0 to the end of the shaped reference trajectory, *residual* starts
`residual_delay` after it and lasts `residual_length`. Deflections are chord deflections (relative
to the line B-C) at the stations, so they do not depend on the basis. Modal coordinates of the
controller's modes are the output of a noise-free modal filter on the plant's deflection.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

from jaxmodel.control import efficient_modal_control
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.table import PartError, Table, is_real


class Sample(NamedTuple):
    """What the metrics read at one sampling instant."""

    deflection: Num[Array, "links S"]  # chord deflection at the stations [m]
    q: Num[Array, "links R"]  # plant modes [m]
    q_rate: Num[Array, "links R"]  # [m/s]
    modal: Num[Array, "links C"]  # controlled modes as seen by an ideal modal filter [m]
    modal_rate: Num[Array, "links C"]  # [m/s]
    pose_error: Num[Array, "pose"]  # against the shaped reference [m, m, rad]
    voltage: Num[Array, "links K"]  # on the actuators [V]
    is_saturated: Num[Array, ""]  # share of this sample with an actuator at its limit, 0 or 1
    is_clipped: Num[Array, ""]  # 1 where any ADC channel clips
    motor_force: Num[Array, "links"]  # [N]
    is_motor_saturated: Num[Array, ""]  # share of this sample with a motor at its limit, 0 or 1
    axial_force: Num[Array, "links"]  # tension in the links [N]
    stretch_error: Num[Array, "pose"]  # of the platform if links stretched [m, m, rad]
    # of the ceramics' outer faces [1]; None: `patch_strain_peak` is not accumulated
    strain: Num[Array, "links K"] | Num[Array, "links 2*K"]


class Window(NamedTuple):
    """Weights of this instant."""

    time: Num[Array, ""]  # t [s]
    is_moving: Num[Array, ""]  # 0 or 1
    is_residual: Num[Array, ""]  # 0 or 1
    after_command: Num[Array, ""]  # time since the end of the reference, 0 before [s]
    taper: Num[Array, ""]  # Hann window of the spectra [1]


class Fixed(NamedTuple):
    """What the metrics read from the case at every sample."""

    omega: Num[Array, "links R"]  # plant modes [rad/s]
    modal_omega: Num[Array, "links C"]  # controller's modes [rad/s]
    # cos and sin of (frequency x period), F frequencies
    rotation: tuple[Num[Array, "links C F"], Num[Array, "links C F"]]
    band: Num[Array, ""]  # settling band [m]


class Instant(NamedTuple):
    """Everything that a total may read at a sample."""

    sample: Sample
    window: Window
    fixed: Fixed


class Ending(NamedTuple):
    """What the metrics read from the case at the end."""

    period: Num[Array, ""]  # between samples [s]
    modal_omega: Num[Array, "links C"]  # controller's modes [rad/s]


#: Arrays by the name of their `Total`.
Totals = dict[str, Any]


class Total(NamedTuple):
    """A running sum or maximum."""

    name: str
    dims: tuple[str, ...]  # see `Metric`
    update: Callable[[Totals, Instant], Any]  # from all totals so far to this one's next value
    start: Any = 0.0  # value before the first sample; a tuple: an array for each entry


class Metric(NamedTuple):
    """One number, or array of numbers, of a run."""

    name: str
    dims: tuple[str, ...]  # axes: keys of `Sizes.axes`
    unit: str  # SI; of each entry where they differ: "m; m; rad"
    text: str  # what it is
    totals: tuple[Total, ...]  # its inputs; totals of the same name are accumulated once
    finish: Callable[[Totals, Ending], Array]
    is_differentiable: bool = True  # can be an objective; otherwise it only compares designs
    is_single: bool = True  # float32 has it within 1 % (`studies bench --precision float32`)


class Sizes(NamedTuple):
    """Lengths of the axes that differ from run to run."""

    n_stations: int
    n_modes: int
    n_controlled: int
    n_frequencies: int
    n_links: int
    n_pose: int

    @property
    def axes(self) -> dict[str, int]:
        """Length of every axis by name."""
        return {
            "link": self.n_links,
            "pose_axis": self.n_pose,
            "slider_axis": self.n_links,
            "station": self.n_stations,
            "mode": self.n_modes,
            "controlled_mode": self.n_controlled,
            "spectrum_point": self.n_frequencies,
        }


class Metrics(dict[str, Any]):
    """Metrics of a run: arrays by name, also as attributes; None if not accumulated."""

    def __new__(cls, *_: Any) -> Metrics:
        _register_pytree()  # before there is one
        return super().__new__(cls)

    def __getattr__(self, name: str) -> Any:
        if name not in METRICS:
            raise AttributeError(name)
        return self.get(name)

    def tree_flatten(self) -> tuple[tuple[Any, ...], tuple[str, ...]]:
        return tuple(self.values()), tuple(self)

    @classmethod
    def tree_unflatten(cls, names: tuple[str, ...], values: Any) -> Metrics:
        return cls(zip(names, values, strict=True))


@cache
def _register_pytree() -> None:
    jax.tree_util.register_pytree_node_class(Metrics)


def zero_totals(sizes: Sizes, dtype: Any, names: tuple[str, ...] = ()) -> Totals:
    """Totals before the first sample.

    Args:
        sizes: of the axes.
        dtype: of all of them.
        names: metrics to accumulate, () for all.
    """

    def begin(total: Total) -> Any:
        shape = tuple(sizes.axes[name] for name in total.dims)
        return jax.tree.map(lambda start: jnp.full(shape, start, dtype), total.start)

    selected = {*names, *ALWAYS} if names else METRICS
    return {x.name: begin(x) for name in METRICS if name in selected for x in METRICS[name].totals}


def accumulate(totals: Totals, instant: Instant) -> Totals:
    """Add one sample.

    Args:
        totals: so far.
        instant: the instant's signals and weights.
    """
    definitions = {total.name: total for metric in METRICS.values() for total in metric.totals}
    after = {name: definitions[name].update(totals, instant) for name in totals}
    for name, new in after.items():
        if not all(hasattr(x, "dtype") or is_real(x) for x in jax.tree.leaves(new)):
            raise PartError(f"total {name!r}: {new!r} after a sample; expected numbers")
        shapes = [jax.tree.map(jnp.shape, x) for x in (totals[name], new)]
        if shapes[0] != shapes[1]:
            raise PartError(f"total {name!r}: shape {shapes[1]} after a sample, {shapes[0]} before")
    return after


def finish(totals: Totals, ending: Ending) -> Metrics:
    """All metrics that can be computed from the totals of a run."""
    metrics = Metrics(
        (name, metric.finish(totals, ending))
        for name, metric in METRICS.items()
        if all(total.name in totals for total in metric.totals)
    )
    for name, value in metrics.items():
        dims = METRICS[name].dims
        if not is_real(value):
            raise PartError(f"metric {name!r}: finish returns {value!r}; expected real numbers")
        if jnp.ndim(value) != len(dims):
            raise PartError(f"metric {name!r}: {jnp.ndim(value)} axes found; its dims are {dims}")
    return metrics


def check_metric(metric: Metric) -> None:
    """Raise PartError for a metric with unknown axes."""
    axes = Sizes(*(1,) * len(Sizes._fields)).axes
    for dims in (metric.dims, *(total.dims for total in metric.totals)):
        for name in dims:
            if name not in axes:
                raise PartError(
                    f"metric {metric.name!r}: axis {name!r}; allowed: {', '.join(axes)}"
                )


# --- totals ---------------------------------------------------------------------------------------


def _summed(name: str, dims: tuple[str, ...], term: Callable[[Instant], Array | float]) -> Total:
    return Total(name, dims, lambda totals, at: totals[name] + term(at))


def _highest(name: str, dims: tuple[str, ...], value: Callable[[Instant], Array]) -> Total:
    return Total(name, dims, lambda totals, at: jnp.maximum(totals[name], value(at)))


def _last_outside(totals: Totals, at: Instant) -> Array:
    highest = jnp.max(jnp.abs(at.sample.deflection), axis=1)
    return jnp.where(highest > at.fixed.band, at.window.after_command, totals["settled_at"])


def _share_outside(at: Instant) -> Array:
    highest = jnp.max(jnp.abs(at.sample.deflection), axis=1)
    is_after = jnp.where(at.window.after_command > 0, 1.0, 0.0).astype(highest.dtype)
    band = at.fixed.band
    return is_after * highest * highest / (highest * highest + band * band)


def _turned(totals: Totals, at: Instant) -> tuple[Array, Array]:
    cosine, sine = totals["phasor"]
    turn_c, turn_s = at.fixed.rotation
    return cosine * turn_c - sine * turn_s, sine * turn_c + cosine * turn_s


def _transformed(totals: Totals, at: Instant) -> tuple[Array, Array]:
    (cosine, sine), spectrum = totals["phasor"], totals["spectrum"]
    weighted = (at.window.taper * at.sample.modal)[:, :, None]
    return spectrum[0] + weighted * cosine, spectrum[1] + weighted * sine


_STATIONS, _MODES = ("link", "station"), ("link", "mode")
_CONTROLLED = ("link", "controlled_mode")
_LINES = (*_CONTROLLED, "spectrum_point")

_COUNT = _summed("count", (), lambda at: 1)
_MOVING = _summed("moving_count", (), lambda at: at.window.is_moving)
_RESIDUAL = _summed("residual_count", (), lambda at: at.window.is_residual)
_TAPER = _summed("taper_square", (), lambda at: at.window.taper * at.window.taper)
_PHASOR = Total("phasor", _LINES, _turned, (1.0, 0.0))
_SPECTRUM = Total("spectrum", _LINES, _transformed, (0.0, 0.0))


# --- metrics --------------------------------------------------------------------------------------


def _root(x: Array) -> Array:
    # the inner where keeps the gradient finite at zero
    return jnp.where(x > 0, jnp.sqrt(jnp.where(x > 0, x, 1.0)), 0.0)


def _average(totals: Totals, total: Total, count: Total) -> Array:
    return totals[total.name] / jnp.maximum(totals[count.name], 1)


def _rms(
    name: str,
    dims: tuple[str, ...],
    unit: str,
    text: str,
    count: Total,
    square: Callable[[Instant], Array],
    **about: bool,
) -> Metric:
    """Root of the mean over a window."""
    total = _summed(f"{name}_square", dims, square)

    def finished(totals: Totals, _: Ending) -> Array:
        return _root(_average(totals, total, count))

    return Metric(name, dims, unit, text, (count, total), finished, **about)


def _mean(
    name: str,
    dims: tuple[str, ...],
    unit: str,
    text: str,
    count: Total,
    term: Callable[[Instant], Array],
    **about: bool,
) -> Metric:
    total = _summed(f"{name}_sum", dims, term)

    def finished(totals: Totals, _: Ending) -> Array:
        return _average(totals, total, count)

    return Metric(name, dims, unit, text, (count, total), finished, **about)


def _peak(
    name: str,
    dims: tuple[str, ...],
    unit: str,
    text: str,
    value: Callable[[Instant], Array],
    **about: bool,
) -> Metric:
    total = _highest(name, dims, value)
    return Metric(name, dims, unit, text, (total,), lambda totals, _: totals[name], **about)


def _square(x: Array) -> Array:
    return x * x


def _sum_of_squares(voltage: Array) -> Array:
    return jnp.sum(jnp.sum(voltage * voltage, axis=1), axis=0)


def _plant_energy(at: Instant) -> Array:
    omega, q, q_rate = at.fixed.omega, at.sample.q, at.sample.q_rate
    return omega * omega * (q * q) + q_rate * q_rate


def _modal_energy(at: Instant) -> Array:
    modal, rate = at.sample.modal, at.sample.modal_rate
    return (at.fixed.modal_omega * modal) ** 2 + rate * rate


def _density(totals: Totals, ending: Ending) -> Array:
    """2 T |sum w x e^(-j omega t)|^2/sum w^2."""
    power = totals["spectrum"][0] ** 2 + totals["spectrum"][1] ** 2
    taper = totals["taper_square"]
    return 2 * ending.period * power / jnp.where(taper > 0, taper, 1.0)


_MODAL_ENERGY = _summed(
    "modal_energy_sum", _CONTROLLED, lambda at: at.window.is_moving * _modal_energy(at)
)


def _fraction(name: str, what: str) -> Metric:
    """Share of samples with something that a field of them says."""

    def read(at: Instant) -> Array:
        return getattr(at.sample, f"is_{name}")

    text = f"samples with {what}"
    return _mean(f"{name}_fraction", (), "1", text, _COUNT, read, is_differentiable=False)


def _in_window(
    name: str, dims: tuple[str, ...], what: str, read: Callable[[Instant], Array]
) -> list[Metric]:
    """rms and peak of a length in the residual window, or while moving."""
    is_residual = name.startswith("residual")
    count, place = (
        (_RESIDUAL, "in the residual window") if is_residual else (_MOVING, "while moving")
    )

    def weight(at: Instant) -> Array:
        return at.window.is_residual if is_residual else at.window.is_moving

    def square(at: Instant) -> Array:
        return weight(at) * _square(read(at))

    def size(at: Instant) -> Array:
        return weight(at) * jnp.abs(read(at))

    about = {"is_single": not is_residual}
    return [
        _rms(f"{name}_rms", dims, "m", f"rms {what} {place}", count, square, **about),
        _peak(f"{name}_peak", dims, "m", f"peak {what} {place}", size, **about),
    ]


#: All metrics by name, in the order of the files.
METRICS: Table[Metric] = Table(
    "metric",
    [
        *_in_window("residual", _STATIONS, "chord deflection", lambda at: at.sample.deflection),
        *_in_window("structural", _STATIONS, "chord deflection", lambda at: at.sample.deflection),
        *_in_window("residual_modal", _MODES, "of plant modes", lambda at: at.sample.q),
        _in_window("structural_modal", _MODES, "of plant modes", lambda at: at.sample.q)[0],
        Metric(
            "settling_time",
            ("link",),
            "s",
            "from the end of the reference trajectory until all stations stay in the band",
            (Total("settled_at", ("link",), _last_outside),),
            lambda totals, _: totals["settled_at"],
            is_differentiable=False,
            is_single=False,
        ),
        Metric(
            "ringing_time",
            ("link",),
            "s",
            "time outside the band after the reference trajectory, smooth",
            (_summed("ringing", ("link",), _share_outside),),
            lambda totals, ending: totals["ringing"] * ending.period,
            is_single=False,
        ),
        _peak(
            "pose_error_peak",
            ("pose_axis",),
            "m; m; rad",
            "peak error from the shaped reference while moving",
            lambda at: at.window.is_moving * jnp.abs(at.sample.pose_error),
        ),
        _rms(
            "pose_error_rms",
            ("pose_axis",),
            "m; m; rad",
            "rms error in the residual window",
            _RESIDUAL,
            lambda at: at.window.is_residual * _square(at.sample.pose_error),
            is_single=False,
        ),
        _peak(
            "peak_voltage",
            ("link",),
            "V",
            "peak actuator voltage",
            lambda at: jnp.max(jnp.abs(at.sample.voltage), axis=1),
            is_single=False,
        ),
        _fraction("saturated", "an actuator at its limit"),
        _fraction("clipped", "a clipped ADC channel"),
        Metric(
            "control_energy",
            (),
            "V2 s",
            "integral of the summed squared actuator voltages",
            (_summed("voltage_square", (), lambda at: _sum_of_squares(at.sample.voltage)),),
            lambda totals, ending: totals["voltage_square"] * ending.period,
        ),
        _peak(
            "peak_force",
            ("slider_axis",),
            "N",
            "peak motor force",
            lambda at: jnp.abs(at.sample.motor_force),
        ),
        _fraction("motor_saturated", "a motor at its limit"),
        _peak(
            "peak_tension",
            ("link",),
            "N",
            "largest tension in a link",
            lambda at: at.sample.axial_force,
        ),
        _peak(
            "peak_compression",
            ("link",),
            "N",
            "largest compression of a link",
            lambda at: -at.sample.axial_force,
        ),
        _peak(
            "stretch_error_peak",
            ("pose_axis",),
            "m; m; rad",
            "peak pose error that link stretching would add, N L/(E A)",
            lambda at: jnp.abs(at.sample.stretch_error),
        ),
        _peak(
            "patch_strain_peak",
            ("link",),
            "1",
            "largest strain of the ceramics, at the centres of the pairs",
            lambda at: jnp.max(jnp.abs(at.sample.strain), axis=1),
        ),
        _mean(
            "plant_energy",
            _MODES,
            "m2/s2",
            "mean of omega^2 q^2 + q'^2 while moving",
            _MOVING,
            lambda at: at.window.is_moving * _plant_energy(at),
        ),
        Metric(
            "modal_energy",
            _CONTROLLED,
            "m2/s2",
            "the same in the controller's modes",
            (_MOVING, _MODAL_ENERGY),
            lambda totals, _: _average(totals, _MODAL_ENERGY, _MOVING),
        ),
        Metric(
            "spectral_density",
            _LINES,
            "m2/Hz",
            "one-sided power spectral density of the controller's modes, Hann periodogram of the "
            "run",
            (_TAPER, _PHASOR, _SPECTRUM),
            _density,
            is_single=False,
        ),
        Metric(
            "energy_ratio",
            _CONTROLLED,
            "1",
            "EMC ratios (24) from the run's modal energies",
            (_MOVING, _MODAL_ENERGY),
            lambda totals, ending: efficient_modal_control(
                _average(totals, _MODAL_ENERGY, _MOVING), ending.modal_omega
            ),
        ),
    ],
    check_metric,
)

#: Metrics that the status of a run depends on.
ALWAYS = (
    "saturated_fraction",
    "clipped_fraction",
    "motor_saturated_fraction",
    "pose_error_rms",
    "peak_compression",
)
