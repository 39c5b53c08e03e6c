"""Fixed point: formats, integer coefficients, and bounds on rounding errors.

Words have 32 or 16 bits, sums of products twice as many. A signal is `base * integer / 2^bits`, per
unit of its own base, the range seen in the simulation; it has as many bits as leave room for the
largest value that any sequence of ADC codes can produce. A coefficient is `integer / 2^shift`
between the integers of two signals, so that gains of 570 V/N and filters of 1e-6 m/V become numbers
of similar size.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from jaxmodel.controller import Controller
from jaxmodel.shaper import Taps
from studies.engine.blocks import ModalBlocks
from studies.engine.channels import ActiveChannels
from studies.engine.controller import FixedController
from studies.errors import StudyError, field_error
from studies.export.floating import Signals, respond_from

#: Bits of a word, sign included: what is usual; the shaper has no others.
WORD = 32
#: A format has room for at least this many times the largest simulated value [1].
MARGIN = 2
#: ADC codes travel in 16 bits.
ADC_BITS = 16
#: Allowed total error, as a share of a DAC step.
ALLOWED_ERROR = 0.5
#: Samples after which a filter must have forgotten (to 1e-16).
LONGEST_MEMORY = 2**20
FORGOTTEN = 1e-16
#: Samples within which feed-through must die out.
ECHO = 4000
#: Time at the end of its range after which a sensor counts as faulty [s].
RAIL_TIME = 0.01


class Format(NamedTuple):
    """Meaning of a signal's integers, one entry per channel: base * integer / 2^bits."""

    base: np.ndarray  # one per unit, in the signal's SI unit, (M,)
    bits: np.ndarray  # fraction bits, (M,)
    seen: np.ndarray  # largest value in the simulation, (M,)
    bound: np.ndarray  # largest value that ADC codes can produce, (M,)
    largest: np.ndarray  # that a word has room for, (M,)

    @property
    def step(self) -> np.ndarray:
        """Value of one count, (M,)."""
        return self.base / 2.0**self.bits

    @property
    def margin(self) -> np.ndarray:
        """Largest representable value over the largest one seen; inf if none was seen, (M,)."""
        seen = np.where(self.seen > 0, self.seen, 1.0)
        return np.where(self.seen > 0, self.largest / seen, np.inf)


class IntegerRow(NamedTuple):
    """Coefficients of sums of products: integers / 2^shift."""

    integers: np.ndarray  # (..., n)
    shift: np.ndarray  # (...,)

    @property
    def values(self) -> np.ndarray:
        return self.integers / 2.0 ** self.shift[..., None]


class Wires(NamedTuple):
    """Sensors and actuators in fixed point. Integers unless said otherwise."""

    word: int  # bits of a signal
    adc_bits: int  # fraction bits of a sensor signal, whose base is one ADC code
    adc_top: int
    bias: int  # of the conditioner, as a sensor signal
    dac_rest: int  # code of 0 V
    sensor_step: float  # one count of a sensor signal [V]
    dac_step: float  # one code [V]
    feedthrough: IntegerRow | None  # sensor counts per DAC code, (3, K, K)

    def volts(self, codes: np.ndarray) -> np.ndarray:
        """Voltages of codes of the DAC [V]."""
        return (codes - self.dac_rest) * self.dac_step


class FixedPoint(NamedTuple):
    """A controller with channels in fixed point. Integers unless said otherwise."""

    wires: Wires
    link: np.ndarray  # of each channel, from 0, (M,)
    signal: Format  # m or V
    high: Format
    inner: Format
    force: Format  # N or V
    filter: IntegerRow  # (M, K)
    high_pass: IntegerRow  # b0, (M, 1)
    memory: IntegerRow  # b1, -a1, (M, 2)
    low_pass: IntegerRow  # scale, -a1, -a2, (M, 3)
    numerator: IntegerRow  # three taps and the direct share, (M, 4)
    synthesizer: IntegerRow  # 0 for channels of other links, (3, K, M)
    is_rival: np.ndarray  # channels that act one at a time, (M,)
    energy: IntegerRow | None  # roots of the modal energies of rivals, in one unit, (M, 2, 4)
    error: ErrorBound

    @property
    def formats(self) -> list[tuple[str, Format, str]]:
        """Signals, their formats and units; of patches all are in volts."""
        parts = self.signal, self.high, self.inner, self.force
        names = "signal", "high-passed", "delay line", "force"
        return list(zip(names, parts, ("m", "m", "m", "N"), strict=True))


class ErrorBound(NamedTuple):
    """Largest differences from exact arithmetic at the actuators, open loop [V], (3, K)."""

    rounding: np.ndarray  # of all signals, each rounded in the worst direction in every sample
    coefficients: np.ndarray  # of rounded coefficients, at full-scale input
    total: np.ndarray  # both with the DAC's rounding, and returned by the feed-through

    @property
    def inside(self) -> np.ndarray:
        """Of the arithmetic alone, (3, K)."""
        return self.rounding + self.coefficients


class Gains(NamedTuple):
    """Peak gains of a channel: largest output for inputs within +-1, by impulse responses, (M,)."""

    high: np.ndarray  # from the channel's signal
    inner: np.ndarray
    force: np.ndarray
    force_of_high: np.ndarray  # from what is added to `high`, to the force
    force_of_inner: np.ndarray  # from what is added to the delay line


def rail_samples(rate: float) -> int:
    """`RAIL_TIME` in samples at a sample rate [Hz]; they are counted in 16 bits."""
    return min(max(round(RAIL_TIME * rate), 2), 2**15 - 1)


def design_fixed(
    exported: FixedController, signals: Signals, dac_bits: int, word: int = WORD
) -> FixedPoint:
    """Formats and coefficients for a controller; see `check_error` for what rounding does.

    Args:
        exported: the controller.
        signals: signals of the simulated motion, (T, ...).
        dac_bits: resolution of the DAC, whose codes 1 to 2^bits - 1 span +-voltage_limit.
        word: bits of a signal, 16 or 32.

    Raises:
        StudyError: what cannot be represented, with the number and a remedy.
    """
    controller, channels = exported.controller, exported.channels
    assert isinstance(channels, ActiveChannels)
    check_words(exported)
    if channels.energy is not None and np.any(controller.feedthrough):
        raise field_error(
            "control.feedthrough_factor",
            exported.study.control.feedthrough_factor,
            "0 for fixed point with a law whose channels act one at a time (or --target c): "
            "what a switch brings back by feed-through has no bound",
            "1",
        )
    wires = design_wires(exported, dac_bits, word)
    step, dac_step = wires.sensor_step, wires.dac_step
    memory = channels.memory(FORGOTTEN)
    gains = peak_gains(channels, memory)
    sensor = sensor_bound(controller)  # (3, K)
    bound = np.sum(np.abs(channels.filter) * sensor[channels.link], axis=1)
    signal = find_format(signals.signal, bound, word)
    high = find_format(signals.high, bound * gains.high, word)
    inner = find_format(signals.inner, bound * gains.inner, word)
    force = find_format(signals.force, bound * gains.force, word)
    b0, b1, a1 = channels.first.T
    one = np.ones_like(b0)
    tap = channels.force * (inner.step / force.step)[:, None]
    back = np.zeros((exported.n_links, exported.n_patches, len(channels.link)))
    back[channels.link, :, np.arange(len(channels.link))] = channels.synthesizer
    fixed = FixedPoint(
        wires=wires,
        link=channels.link,
        signal=signal,
        high=high,
        inner=inner,
        force=force,
        filter=find_row(channels.filter * step / signal.step[:, None], "modal filter", word),
        high_pass=find_row((b0 * signal.step / high.step)[:, None], "high-pass", word),
        memory=find_row(np.stack([b1 * signal.step / high.step, -a1], 1), "high-pass", word),
        low_pass=find_row(
            np.stack([one * high.step / inner.step, *-channels.denominator.T], 1),
            "low-pass",
            word,
        ),
        numerator=find_row(
            np.column_stack([tap, channels.direct * signal.step / force.step]),
            "gains",
            word,
        ),
        synthesizer=find_row(back * force.step / dac_step, "synthesizer", word),
        is_rival=channels.is_rival,
        energy=_energy(channels, bound, inner, signal, memory, word),
        error=ErrorBound(*np.zeros((3, exported.n_links, exported.n_patches))),
    )
    return fixed._replace(error=_error_bound(exported, fixed, gains, memory))


def design_wires(exported: FixedController, dac_bits: int, word: int) -> Wires:
    """Formats of sensors and actuators.

    Raises:
        StudyError: sensor signals too large for a word.
    """
    controller = exported.controller
    rest = 2 ** (dac_bits - 1)
    dac_step = dac_step_of(controller, dac_bits)
    code = float(controller.adc_step / controller.adc_gain)  # one ADC code at the sensor [V]
    largest = sensor_bound(controller).max() / code
    adc_bits = int(_bits(largest, word))
    if adc_bits < 0:
        raise StudyError(
            f"fixed point: sensor signals can be {largest:.3g} ADC codes; allowed: "
            f"{2.0 ** (word - 1):.3g}; lower control.feedthrough_factor or "
            "electronics.voltage_limit, or take --target c"
        )
    step = code / 2.0**adc_bits
    through = None
    if np.any(controller.feedthrough):
        through = find_row(controller.feedthrough * dac_step / step, "feed-through", word)
    return Wires(
        word=word,
        adc_bits=adc_bits,
        adc_top=int(controller.adc_top),
        bias=round(float(controller.adc_bias) / float(controller.adc_step) * 2**adc_bits),
        dac_rest=rest,
        sensor_step=step,
        dac_step=dac_step,
        feedthrough=through,
    )


def dac_step_of(controller: Controller, dac_bits: int) -> float:
    """One step of a DAC whose codes span the voltage limit [V]."""
    return float(controller.voltage_limit) / (2 ** (dac_bits - 1) - 1)


def check_words(exported: FixedController) -> None:
    """Reject converters and filters that do not fit into words, before anything runs.

    Raises:
        StudyError: codes too long, or a filter that retains rounding errors for too long.
    """
    electronics = exported.study.electronics
    if electronics.adc_bits > ADC_BITS:
        raise field_error(
            "electronics.adc_bits",
            electronics.adc_bits,
            f"up to {ADC_BITS} for fixed point: codes are 16-bit words (or --target c)",
            "1",
        )
    slowest = 1 + np.log(FORGOTTEN) / LONGEST_MEMORY  # slowest pole that forgets in time
    pole = exported.channels.slowest_pole
    if pole > slowest and isinstance(exported.channels, ModalBlocks):
        raise StudyError(
            f"fixed point: the controller has a pole of modulus {pole:.12g}; allowed: up to "
            f"{slowest:.12g}, or it keeps rounding errors for too long (or --target c)"
        )
    if pole > slowest:
        rate = electronics.sample_rate_hz
        lowest = -np.log(slowest) * rate / (2 * np.pi)
        raise field_error(
            "electronics.highpass_hz",
            electronics.highpass_hz,
            f"from {lowest:.3g} for fixed point at electronics.sample_rate_hz = {rate:g}: a filter "
            f"with its pole at {pole:.12g} keeps rounding errors for too "
            "long (or --target c)",
            "Hz",
        )


def _energy(
    channels: ActiveChannels,
    bound: np.ndarray,
    inner: Format,
    signal: Format,
    memory: int,
    word: int,
) -> IntegerRow | None:
    """Roots of the energies of rivals: the squares of two of them sum within two words.

    Args:
        channels: folded controller.
        bound: largest signals, (M,).
        inner, signal: formats of the terms of the roots.
        memory: samples of the impulse responses.
        word: bits of a signal.
    """
    if channels.energy is None:
        return None
    impulse = np.zeros(memory)
    impulse[0] = 1.0
    largest = np.zeros((len(bound), 2))
    for m, (rows, first, below) in enumerate(
        zip(channels.energy, channels.first, channels.denominator, strict=True)
    ):
        high = scipy.signal.lfilter(first[:2], [1.0, first[2]], impulse)
        line = scipy.signal.lfilter([1.0], [1.0, *below], high)
        for part, row in enumerate(rows):
            root = scipy.signal.lfilter(row[:3], [1.0], line)
            root[0] += row[3]
            largest[m, part] = bound[m] * np.abs(root).sum()
    step = largest.max() / 2.0 ** (word - 3)
    factors = channels.energy * inner.step[:, None, None] / step
    factors[..., 3] = channels.energy[..., 3] * signal.step[:, None] / step
    return find_row(factors, "modal energies", word)


def _responses(channels: ActiveChannels, m: int, n: int) -> tuple[np.ndarray, ...]:
    """Impulse responses of channel m: to high, inner, force; from high and inner to force."""
    impulse = np.zeros(n)
    impulse[0] = 1.0
    b0, b1, a1 = channels.first[m]
    below, numerator = [1.0, *channels.denominator[m]], channels.force[m]
    high = scipy.signal.lfilter([b0, b1], [1.0, a1], impulse)
    inner = scipy.signal.lfilter([1.0], below, high)
    force = scipy.signal.lfilter(numerator, [1.0], inner)
    force[0] += channels.direct[m]
    of_inner = scipy.signal.lfilter(numerator, below, impulse)
    of_high = scipy.signal.lfilter([1.0], [1.0, a1], of_inner)
    return high, inner, force, of_high, of_inner


def peak_gains(channels: ActiveChannels, n: int) -> Gains:
    """Peak gains of all channels by impulse responses of n samples."""
    rows = [
        [np.abs(response).sum() for response in _responses(channels, m, n)]
        for m in range(len(channels.link))
    ]
    return Gains(*np.array(rows).T)


def sensor_bound(controller: Controller) -> np.ndarray:
    """Largest sensor signals that codes and their own feed-through can produce [V], (3, K)."""
    ends = np.array([0.0, float(controller.adc_top)]) * controller.adc_step - controller.adc_bias
    own = np.abs(controller.feedthrough).sum(axis=2) * controller.voltage_limit
    return np.abs(ends / controller.adc_gain).max() + own


def _bits(largest: np.ndarray, word: int) -> np.ndarray:
    """Fraction bits with room for values up to `largest`, with some margin for rounding."""
    return np.floor(word - 1 - np.log2(largest * (1 + 1e-4))).astype(int)


def find_format(seen: np.ndarray, bound: np.ndarray, word: int) -> Format:
    """Format of a signal, (M,), from its values over time and its bound."""
    peak = np.abs(seen).max(axis=0)
    # a channel at rest in the simulation has no range
    base = np.where(peak > bound * 2.0**-20, peak, bound)
    bits = _bits(np.maximum(bound, MARGIN * peak) / base, word)
    return Format(base, bits, peak, bound, largest=base * 2.0 ** (word - 1 - bits))


def find_row(factors: np.ndarray, name: str, word: int) -> IntegerRow:
    """Integers and shifts of rows of factors, (..., n), for words of so many bits."""
    total = np.abs(factors).sum(axis=-1)
    safe = np.where(total > 0, total, 1.0)
    shift = np.floor(word - 1 - np.log2(safe * (1 + 1e-6)))
    if not np.all(np.isfinite(total)) or shift.min() < 1:
        raise StudyError(
            f"{name}: factors add up to {total.max():.3g} between words of {word} bits; allowed: "
            f"below {2.0 ** (word - 2):.3g}; lower control.gain_factor, or take --target c"
        )
    shift = np.minimum(shift, 2 * word - 2).astype(int)
    return IntegerRow(np.round(factors * 2.0 ** shift[..., None]).astype(np.int64), shift)


def rounded(fixed: FixedPoint, like: ActiveChannels) -> ActiveChannels:
    """The channels that the integers represent, in SI units."""
    f = fixed
    scale = f.low_pass.values[:, 0] * f.inner.step / f.high.step  # 1, rounded
    numerator = f.numerator.values * f.force.step[:, None]
    own = np.arange(len(f.link))
    return like._replace(
        filter=f.filter.values * f.signal.step[:, None] / f.wires.sensor_step,
        first=np.stack(
            [
                f.high_pass.values[:, 0] * f.high.step / f.signal.step,
                f.memory.values[:, 0] * f.high.step / f.signal.step,
                -f.memory.values[:, 1],
            ],
            axis=1,
        ),
        denominator=-f.low_pass.values[:, 1:],
        force=numerator[:, :3] * (scale / f.inner.step)[:, None],
        direct=numerator[:, 3] / f.signal.step,
        synthesizer=f.synthesizer.values[f.link, :, own] * f.wires.dac_step / f.force.step[:, None],
    )


def _error_bound(exported: FixedController, fixed: FixedPoint, gains: Gains, n: int) -> ErrorBound:
    """Peak errors at the actuators: the sum of every rounding through its peak gain."""
    exact = exported.channels
    assert isinstance(exact, ActiveChannels)
    near = rounded(fixed, exact)
    half = 0.5
    # bias and feed-through are rounded once each
    entering = fixed.wires.sensor_step * np.abs(exact.filter).sum(axis=1) + half * fixed.signal.step
    force = entering * gains.force + half * fixed.force.step
    force = force + 2 * half * fixed.high.step * gains.force_of_high
    force = force + half * fixed.inner.step * gains.force_of_inner
    size, volts = np.abs(exact.synthesizer), sensor_bound(exported.controller)[exact.link]
    change = np.array(
        [
            np.abs(_responses(near, m, n)[2] - _responses(exact, m, n)[2]).sum()
            for m in range(len(exact.link))
        ]
    )
    signal = np.sum(np.abs(exact.filter) * volts, axis=1)
    moved = np.sum(np.abs(near.filter - exact.filter) * volts, axis=1)
    wrong = signal * change + moved * gains.force
    wrong = wrong[:, None] * size + (signal * gains.force)[:, None] * np.abs(
        near.synthesizer - exact.synthesizer
    )
    rounding, coefficients = np.zeros((2, exported.n_links, exported.n_patches))
    np.add.at(rounding, exact.link, force[:, None] * size)
    np.add.at(coefficients, exact.link, wrong)
    inside = rounding + coefficients + half * fixed.wires.dac_step
    return ErrorBound(rounding, coefficients, output_error_bound(exported, inside))


def output_error_bound(exported: FixedController, error: np.ndarray) -> np.ndarray:
    """Errors of commands including their feed-through, (3, K).

    An error of a command enters the sensors in the next sample, and so the next command. Uses peak
    gains of this recursion from its impulse response, valid while no actuator is at its limit.
    Infinite if it does not die out.
    """
    controller = exported.controller
    if not np.any(controller.feedthrough):
        return error
    links, n = exported.n_links, exported.n_patches
    kick = np.broadcast_to(np.eye(n)[:, None], (n, links, n))  # one actuator of each link at a time
    linear = controller._replace(
        voltage_limit=np.inf, adc_bias=np.zeros(()), adc_step=np.ones(()), adc_gain=np.ones(())
    )
    silent = np.zeros((ECHO, n, links, n))
    with np.errstate(over="ignore", invalid="ignore"):
        echo = respond_from(exported.channels, linear, silent, kick).command
    peak = np.abs(echo)
    if not np.all(np.isfinite(peak)) or peak[-ECHO // 10 :].max() > 1e-6 * peak.max():
        return np.full_like(error, np.inf)
    gain = peak.sum(axis=0)  # (kicked actuator, link, actuator)
    return error + np.einsum("lik,il->ik", gain, error)


def check_error(exported: FixedController, error: ErrorBound, dac_step: float) -> None:
    """Reject a controller whose rounding can be seen at the actuators.

    Raises:
        StudyError: it can be, with how much and a remedy.
    """
    worst = error.inside
    if worst.max() <= ALLOWED_ERROR * dac_step:
        return
    link, patch = np.unravel_index(np.argmax(worst), worst.shape)
    raise StudyError(
        f"fixed point: rounding can add up to {worst.max():.3g} V at actuator {patch + 1} of link "
        f"{link + 1}; allowed: {ALLOWED_ERROR * dac_step:.3g} [V], half a step of the DAC; lower "
        f"electronics.sample_rate_hz = {exported.study.electronics.sample_rate_hz:g} or the gains, "
        f"raise electronics.highpass_hz = {exported.study.electronics.highpass_hz:g}, choose "
        "patches.centers whose modal filter is better conditioned, or take --target c"
    )


def shaper_row(taps: Taps) -> IntegerRow:
    """Weights of the shaper in fixed point; they add up to exactly 1 (or to what they add up to).

    Raises:
        StudyError: weights too large for a word.
    """
    row = find_row(np.asarray(taps.weight)[None], "input shaper", WORD)
    integers, shift = row.integers[0], int(row.shift[0])
    left = round(float(np.sum(taps.weight)) * 2**shift) - int(integers.sum())
    largest = np.argmax(np.abs(integers))
    integers[largest] += left  # a pose at rest stays unchanged
    return IntegerRow(integers[None], row.shift)
