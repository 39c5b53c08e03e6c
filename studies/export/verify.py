"""Compare exported code with the JAX controller: open loop, in the loop, under faults."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.motion import sample_path, shape_path
from jaxmodel.shaper import Taps
from studies.engine.blocks import ModalBlocks
from studies.engine.controller import FixedController, arrange
from studies.engine.programs import kept_jit
from studies.export.c_drive import DriveCode, compare_drive
from studies.export.c_text import Source
from studies.export.compiler import Code, Responding, compiled
from studies.export.document import Document, controller_of
from studies.export.fixed import FixedPoint, Wires, rail_samples, shaper_row
from studies.export.fixed_blocks import FixedBlocks
from studies.export.floating import BlockSignals
from studies.export.floating import respond as respond_floating
from studies.export.in_the_loop import LoopRun, law_of, replay, run_controller, run_in_the_loop
from studies.export.integers import Response, shifted
from studies.export.integers import respond as respond_fixed
from studies.export.sequences import hard_sequences, stuck_at_end
from studies.study.labels import describe

#: Limit for double precision against JAX, largest difference over largest value [1]; where the same
#: arithmetic rounds more, that so many times, up to the last one.
DOUBLE, ROUNDINGS, WORST = 1e-12, 10.0, 1e-9
#: Limit for single precision, beyond which it is useless.
SINGLE = 1e-3
#: Allowed share of samples in which rounding decides which of two rivals acts [1].
OTHER_MODE = 0.01
#: Allowed excess of residual vibration in fixed point over that in floating point [1].
AIM = 0.01
#: Counts per metre and radian of the shaper's reference in fixed point.
REFERENCE_COUNTS = 1e9


class Check(NamedTuple):
    """One comparison."""

    what: str
    found: str
    allowed: str
    is_met: bool


class LoopDeviation(NamedTuple):
    """A run in the loop compared with that of the JAX controller."""

    voltage: float  # largest difference of an actuator [V]
    pose: np.ndarray  # of the platform [m, m, rad], (3,)
    first_code: int  # sample at which an ADC code first differs; -1: never
    loss: float  # residual vibration, rms over links, over that with JAX, minus 1 [1]


class Exchange(NamedTuple):
    """A sequence that a controller was given, and what it must answer, both in its own units."""

    sensor: np.ndarray  # (T, 3, K)
    actuator: np.ndarray  # (T, 3, K)
    largest: float = 0.0  # voltage that the arithmetic rounds, where it exceeds them [V]
    allowed: float = 0.0  # difference in double precision, over the largest voltage [1]


class Verification(NamedTuple):
    """All comparisons."""

    checks: list[Check]
    notes: list[str]  # remarks that do not fail the verification
    runs: dict[str, LoopRun]  # by controller, JAX first
    exchanges: dict[str, Exchange]  # by sequence
    counts: dict[str, Response]  # fixed point: by sequence

    def deviation(self, name: str) -> LoopDeviation:
        """One of the runs against that of the JAX controller."""
        reference, run = self.runs["JAX"], self.runs[name]
        differing = np.flatnonzero(np.any(run.codes != reference.codes, axis=(1, 2)))
        size = vibration(reference)
        return LoopDeviation(
            float(np.abs(run.voltage - reference.voltage).max()),
            np.abs(run.pose - reference.pose).max(axis=0),
            int(differing[0]) if len(differing) else -1,
            vibration(run) / size - 1 if size > 0 else 0.0,
        )

    @property
    def is_passed(self) -> bool:
        """Whether something was compared and everything agreed."""
        return bool(self.checks) and not self.has_failed

    @property
    def has_failed(self) -> bool:
        """Whether any comparison failed: then no controller is written."""
        return not all(check.is_met for check in self.checks)


def vibration(run: LoopRun) -> float:
    """Residual deflection of the machine: rms over links, worst stations [m]."""
    worst = np.max(run.result.metrics.residual_rms, axis=1)
    return float(np.sqrt(np.mean(worst**2)))


def reference_run(exported: FixedController) -> LoopRun:
    """The case's motion with the JAX controller."""
    return run_controller(exported.structure, exported.case, exported.controller)


def verify_document(
    exported: FixedController, reference: LoopRun, document: Document
) -> Verification:
    """A controller built only from its document, against the JAX controller."""
    controller, taps = controller_of(document)
    channels = arrange(controller, document.law)
    checks = []
    for name, codes in _sequences(exported, reference).items():
        values = respond_floating(channels, controller, codes).command
        largest, allowed = _limits(exported, codes)
        what, expected = f"open loop, {name}", _replay(exported, codes)
        checks.append(compare_values(what, values, expected, allowed, largest))
    path, shaped = reference_path(exported)
    checks.append(
        compare_values("shaper, the case's motion", _shape_reference(taps, path), shaped, DOUBLE)
    )
    return Verification(checks=checks, notes=[], runs={"JAX": reference}, exchanges={}, counts={})


def verify_floating(
    exported: FixedController,
    reference: LoopRun,
    source: Source,
    name: str,
    compiler: list[str],
) -> Verification:
    """C in double and single precision against the JAX controller."""
    checks, runs, exchanges = [], {"JAX": reference}, dict[str, Exchange]()
    with load_code(exported, source, name, compiler, np.float64, np.float64) as code:
        for label, codes in _sequences(exported, reference).items():
            sensor, expected = codes * float(exported.controller.adc_step), _replay(exported, codes)
            largest, allowed = _limits(exported, codes)
            exchanges[label] = Exchange(sensor, expected, largest, allowed)
            volts, faults = code.respond(sensor)
            check = compare_values(f"open loop, {label}", volts, expected, allowed, largest)
            checks.append(check._replace(is_met=check.is_met and not faults.any()))
        step = float(exported.controller.adc_step)
        checks += check_faults(exported, code, reference, None)
        path, shaped = reference_path(exported)
        checks.append(compare_values("shaper, the case's motion", code.shape(path), shaped, DOUBLE))
        law = law_of(code, step)
        runs["C, double"] = run_in_the_loop(exported.structure, exported.case, law)
    with load_code(exported, source, name, compiler, np.float32, np.float32) as code:
        volts, _ = code.respond(reference.codes * step)
        checks += check_faults(exported, code, reference, None, ", float")
        single = compare_values("", volts, reference.voltage, SINGLE)
        advice = "precise enough" if single.is_met else "NOT precise enough, keep to double"
        note = f"With float, recorded codes in open loop differ by {single.found}: {advice}."
    return Verification(
        checks=[*checks, *_check_status(runs)],
        notes=[note],
        runs=runs,
        exchanges=exchanges,
        counts={},
    )


def verify_fixed(
    exported: FixedController,
    fixed: FixedPoint | FixedBlocks,
    reference: LoopRun,
    source: Source,
    name: str,
    compiler: list[str],
) -> Verification:
    """C in fixed point against its integer model, bit by bit, and against the JAX controller."""
    rail = rail_samples(exported.study.electronics.sample_rate_hz)
    checks, runs = [], {"JAX": reference}
    runs["JAX behind the DAC"] = run_controller(
        exported.structure, exported.case, exported.controller, float(fixed.wires.dac_step)
    )
    shape = reference.codes.shape[1:]
    with load_code(exported, source, name, compiler, np.uint16, np.int32) as code:
        law = law_of(code, to_volts=fixed.wires.volts)
        runs["C, fixed point"] = own = run_in_the_loop(exported.structure, exported.case, law)
        sequences = {
            "recorded codes": reference.codes,
            "own run in the loop": own.codes,
            **_hard_codes(exported, reference),
            "stuck at the end of the range": _stuck_codes(exported, reference),
            "words beyond the ADC's codes": np.random.default_rng(1).integers(
                0, 2**16, (50, *shape)
            ),
        }
        counts = _model_responses(fixed, sequences, rail)
        for label, codes in sequences.items():
            codes_out, _ = code.respond(codes)
            differing = int(np.sum(codes_out != counts[label].codes))
            checks.append(
                Check(
                    f"bit by bit, {label}",
                    f"{differing} of {codes_out.size} codes differ",
                    "0",
                    differing == 0,
                )
            )
        checks += check_faults(exported, code, reference, fixed.wires)
        checks.append(_check_shaper(exported, code))
    checks.append(_check_error(exported, fixed, reference, counts["recorded codes"]))
    for label in ("recorded codes", "own run in the loop"):
        at_rest = int(counts[label].is_faulty.sum())
        checks.append(
            Check(f"samples at rest by a sensor fault, {label}", str(at_rest), "0", at_rest == 0)
        )
    limited = sum(int(response.limited.sum()) for response in counts.values())
    checks.append(Check("internal overflow, all sequences", f"{limited} times", "0", limited == 0))
    exchanges = {label: Exchange(codes, counts[label].codes) for label, codes in sequences.items()}
    return Verification(
        checks=[*checks, *_check_status(runs)],
        notes=[],
        runs=runs,
        exchanges=exchanges,
        counts=counts,
    )


def _model_responses(
    fixed: FixedPoint | FixedBlocks, sequences: dict[str, np.ndarray], rail: int
) -> dict[str, Response]:
    """Response of the integer model to each sequence, all side by side."""
    longest = max(map(len, sequences.values()))
    rows = [np.pad(x, ((0, longest - len(x)), (0, 0), (0, 0)), "edge") for x in sequences.values()]
    response = respond_fixed(fixed, np.stack(rows, axis=1), rail)
    return {
        name: Response(*(part[: len(codes), k] for part in response))
        for k, (name, codes) in enumerate(sequences.items())
    }


def load_code(
    exported: FixedController,
    source: Source,
    name: str,
    compiler: list[str],
    real: type,
    reference: type,
) -> AbstractContextManager[Code]:
    """A controller's C code, compiled and loaded.

    Args:
        exported: the controller.
        source: the same in C.
        name: prefix of its functions.
        compiler: command, from `find_compiler`.
        real: NumPy's type of sensors and actuators.
        reference: of the shaper.
    """
    sizes = (
        exported.n_links * exported.n_patches,
        len(exported.channels.names),
        int(exported.taps.sample.max()) + 1,
    )
    return compiled(source, name, compiler, real, reference, sizes)


def _hard_codes(exported: FixedController, reference: LoopRun) -> dict[str, np.ndarray]:
    top = int(exported.controller.adc_top)
    rail = rail_samples(exported.study.electronics.sample_rate_hz)
    return hard_sequences(reference.codes, top, rail)


def _sequences(exported: FixedController, reference: LoopRun) -> dict[str, np.ndarray]:
    """Codes for the open loop, by name."""
    return {"recorded codes": reference.codes, **_hard_codes(exported, reference)}


def _replay(exported: FixedController, codes: np.ndarray) -> np.ndarray:
    return np.asarray(replay(exported.controller, codes))


def _limits(exported: FixedController, codes: np.ndarray) -> tuple[float, float]:
    """Largest voltage that the arithmetic rounds [V], 0 if it is that of the actuators; and the
    difference that double precision is allowed, over the largest voltage [1].

    Demands can be a thousand times the limit, and what limits take away from them enters the state
    of a system that is told of it. Slow poles, or states of unlike size, add up what is rounded:
    how much, the same arithmetic says in extended precision.
    """
    blocks, controller = exported.channels, exported.controller
    rounded = respond_floating(blocks, controller, codes)
    blocks, controller = jax.tree.map(_extended, (blocks, controller))
    exact = respond_floating(blocks, controller, codes)
    largest = 0.0
    if isinstance(blocks, ModalBlocks) and blocks.system.anti_windup is not None:
        assert isinstance(rounded, BlockSignals)
        largest = float(np.abs(rounded.demand).max())
    size = max(float(np.abs(exact.command).max()), largest)
    away = float(np.abs(rounded.command - exact.command).max()) / (size if size > 0 else 1.0)
    return largest, min(max(DOUBLE, ROUNDINGS * away), WORST)


def _extended(x: Any) -> Any:
    is_real = isinstance(x, np.ndarray | np.generic) and x.dtype == np.float64
    return np.asarray(x, np.longdouble) if is_real else x


def compare_values(
    what: str, values: np.ndarray, expected: np.ndarray, allowed: float, rounded: float = 0.0
) -> Check:
    """Largest difference over the largest value, or over a larger one that was rounded."""
    size = max(np.abs(expected).max(), rounded)
    difference = float(np.abs(values - expected).max() / (size if size > 0 else 1.0))
    return Check(what, f"{difference:.1e}", f"{allowed:.0e}", difference <= allowed)


def drive_checks(code: DriveCode, compiler: list[str]) -> list[Check]:
    """The C code of a sampled drive against the drive in JAX, in both precisions."""
    found = compare_drive(code, compiler)
    return [
        Check(f"drive, random motion, {text}", f"{x:.1e}", f"{limit:.0e}", x <= limit)
        for text, x, limit in zip(("double", "float"), found, (DOUBLE, SINGLE), strict=True)
    ]


def _stuck_codes(exported: FixedController, reference: LoopRun) -> np.ndarray:
    return stuck_at_end(
        reference.codes, int(exported.controller.adc_top), (exported.channels.link[-1], 0)
    )


def check_faults(
    exported: FixedController,
    code: Responding,
    reference: LoopRun,
    wires: Wires | None,
    note: str = "",
) -> list[Check]:
    """Check that a faulty sensor is reported and all actuators rest from then on.

    Args:
        exported: the controller.
        code: the same in C.
        reference: its run.
        wires: of code in fixed point; None: it is in floating point.
        note: for the names of the checks.
    """
    link, top = int(exported.channels.link[-1]), float(exported.controller.adc_top)
    rail = rail_samples(exported.study.electronics.sample_rate_hz)
    number, begin = link * exported.n_patches + 1, len(reference.codes) // 3
    faults = {"stuck at the end of the range": (top, rail)}
    if wires is None:
        scale, rest = float(exported.controller.adc_step), 0.0
        faults |= {"beyond the range": (top + 3, 1), "NaN": (np.nan, 1), "infinite": (np.inf, 1)}
    else:
        scale, rest = 1.0, float(wires.dac_rest)
        if top < 2**16 - 1:  # a 16-bit word can exceed it
            faults["beyond the range"] = (top + 1, 1)
    checks = []
    for name, (value, needed) in faults.items():
        codes = np.clip(reference.codes[: begin + rail + 50], 1, top - 1)
        codes = np.pad(codes, ((0, rail + 50), (0, 0), (0, 0)), "edge")
        codes[begin : begin + rail + 5, link, 0] = value
        out, numbers = code.respond(codes * scale)
        first = begin + needed - 1
        is_met = not numbers[:first].any() and np.all(numbers[first:] == number)
        is_met &= np.all(out[first:] == rest) and np.all(np.isfinite(out))
        at = np.flatnonzero(numbers)
        text = f"sensor {numbers[at[0]]}, sample {at[0] - begin + 1}" if len(at) else "nothing"
        expected = f"sensor {number}, sample {needed}; at rest from then on"
        checks.append(Check(f"faulty sensor: {name}{note}", text, expected, bool(is_met)))
    return checks


def reference_path(exported: FixedController) -> tuple[np.ndarray, np.ndarray]:
    """Planned poses and JAX's shaped ones at the samples, (T, 3)."""
    n, period = exported.structure.n_steps, float(exported.case.electronics.period)
    taps = Taps(jnp.asarray(exported.taps.weight), jnp.asarray(exported.taps.sample))
    time = period * np.arange(n)
    planned = np.asarray(_plan(exported.case.path, time))
    shaped = np.asarray(_shape(exported.case.path, taps, n, period))
    return planned, shaped


@kept_jit()
def _plan(path: Any, time: Any) -> Any:
    return sample_path(path, time).position


def _shape_path(path: Any, taps: Any, n: int, period: Any) -> Any:
    return shape_path(path, taps, n, 1, period).position


_shape = kept_jit(static_argnums=2)(_shape_path)


def _shape_reference(taps: Taps, path: np.ndarray) -> np.ndarray:
    """Sum of the path's past."""
    longest = int(taps.sample.max())
    padded = np.concatenate([np.repeat(path[:1], longest, axis=0), path])
    parts = (
        weight * padded[longest - delay : longest - delay + len(path)]
        for weight, delay in zip(taps.weight, taps.sample, strict=True)
    )
    return sum(parts)


def path_counts(path: np.ndarray) -> tuple[np.ndarray, float]:
    """A path in whole counts, and how many of them make a metre or radian."""
    scale = min(REFERENCE_COUNTS, 2.0**30 / np.abs(path).max())
    return np.round(path * scale).astype(np.int64), float(scale)


def _check_shaper(exported: FixedController, code: Code) -> Check:
    """The shaper in fixed point: bit by bit like its integer model, within a count of JAX's."""
    path, shaped = reference_path(exported)
    counts, scale = path_counts(path)
    counts_out = code.shape(counts)
    row = shaper_row(exported.taps)
    total = _shape_reference(exported.taps._replace(weight=row.integers[0]), counts)
    differing = int(np.sum(counts_out != shifted(total, row.shift[0])))
    off = np.abs(counts_out / scale - shaped).max() * scale
    # half a count of the reference, half of the result, and what JAX's path differs by
    return Check(
        "shaper, the case's motion",
        f"{differing} counts differ, {off:.2f} counts from JAX's",
        "0, 1.1",
        bool(differing == 0 and off <= 1.1),
    )


def _check_error(
    exported: FixedController,
    fixed: FixedPoint | FixedBlocks,
    reference: LoopRun,
    response: Response,
) -> Check:
    """Fixed point against the JAX controller on the same codes, with the allowed difference.

    Where rivals are so close that rounding decides which of them acts, no bound holds; such samples
    are left out and must be few.
    """
    volts = fixed.wires.volts(response.codes)
    each = np.abs(volts - reference.voltage)
    if fixed.energy is not None:
        is_other = np.any(each > fixed.error.total * (1 + 1e-9), axis=(1, 2))
        share = float(np.mean(is_other))
        return Check(
            "open loop against JAX, recorded codes: samples in which another mode is served",
            f"{100 * share:.2g} %",
            f"{100 * OTHER_MODE:g} %, equal energies",
            share <= OTHER_MODE,
        )
    difference = each.max(axis=0)
    bound, reason = fixed.error.total, "rounding of the DAC, and inside"
    peak = np.abs(reference.voltage).max()
    limit = fixed.wires.dac_step * (fixed.wires.dac_rest - 1)
    is_told = isinstance(fixed, FixedBlocks) and fixed.anti_windup is not None
    is_bounded = peak < limit * (1 - 1e-9) or not (is_told or fixed.wires.feedthrough is not None)
    if not is_bounded or not np.all(np.isfinite(bound)):
        bound = np.full_like(bound, 0.01 * peak + 2 * fixed.wires.dac_step)
        reason = "1 % and two steps of the DAC: what is rounded at a limit comes back"
    worst = np.unravel_index(np.argmax(difference / bound), bound.shape)
    return Check(
        "open loop against JAX, recorded codes",
        f"{difference[worst]:.4g} V",
        f"{bound[worst]:.4g} V: {reason}",
        bool(np.all(difference <= bound * (1 + 1e-9))),
    )


def _check_status(runs: dict[str, LoopRun]) -> list[Check]:
    """Check that every run ends like that of the JAX controller."""
    expected, *others = (describe(int(run.result.status)) for run in runs.values())
    names = list(runs)[1:]
    return [
        Check(f"status in the loop, {name}", actual, expected, actual == expected)
        for name, actual in zip(names, others, strict=True)
    ]
