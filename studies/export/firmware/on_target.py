"""The controller on an emulated processor: against the same on this machine, and its cost."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.engine.controller import FixedController
from studies.errors import StudyError
from studies.export.c_text import Source
from studies.export.compiler import Code
from studies.export.firmware.boards import Board
from studies.export.firmware.build import Built, build
from studies.export.firmware.emulator import EmulatedCode, ProgramSizes, emulated
from studies.export.firmware.project import STACK, project_files, write_files
from studies.export.fixed import Wires, rail_samples
from studies.export.in_the_loop import LoopRun, law_of, run_in_the_loop
from studies.export.sequences import episodes
from studies.export.verify import (
    DOUBLE,
    SINGLE,
    Check,
    Exchange,
    Verification,
    check_faults,
    compare_values,
    load_code,
    path_counts,
    reference_path,
)
from studies.publish import working_folder
from studies.study.labels import describe

#: Episodes of random input with faults, each after a reset.
EPISODES = 8


class OnTarget(NamedTuple):
    """A controller on an emulated processor."""

    board: Board
    files: dict[str, str]  # of the project
    checks: list[Check]
    built: Built
    sizes: ProgramSizes | None  # None: the program does not run
    instructions: dict[str, np.ndarray]  # of each sample, by sequence
    depth: int  # of the stack in a sample, measured [bytes]
    run: LoopRun | None  # closed loop with the plant

    @property
    def costliest(self) -> str:
        """The sequence with the sample that takes most instructions."""
        return max(self.instructions, key=lambda name: int(self.instructions[name].max()))


class Comparison(NamedTuple):
    """What is compared, and with what."""

    exported: FixedController
    source: Source
    name: str  # of its functions
    board: Board
    wires: Wires | None  # of code in fixed point
    compiler: list[str]  # of this machine
    verified: Verification  # on this machine

    @property
    def is_fixed(self) -> bool:
        return self.wires is not None

    @property
    def limit(self) -> float:
        """Largest difference of floating point over the largest value [1]."""
        return SINGLE if self.board.real == "float" else DOUBLE

    @property
    def label(self) -> str:
        """The run in the loop on this machine that the target repeats."""
        return "C, fixed point" if self.is_fixed else "JAX"


def verify_on_target(at: Comparison) -> OnTarget:
    """Build the project of a controller, run it on the emulated processor and compare.

    Args:
        at: the controller and what it did on this machine.

    Raises:
        StudyError: Arm's compiler rejects the code.
    """
    with working_folder() as folder:
        files = project_files(at.source, at.name, at.board, at.is_fixed)
        write_files(files, folder)
        built = build(folder, at.name, at.board, at.is_fixed)
        found = OnTarget(
            board=at.board,
            files=files,
            checks=_static_checks(at, built),
            built=built,
            sizes=None,
            instructions={},
            depth=0,
            run=None,
        )
        try:
            with emulated(built.image, at.board) as processor:
                return _compared(at, found, processor)
        except StudyError as error:
            failed = Check(f"{at.board.name}: runs to its end", str(error), "no fault", False)
            return found._replace(checks=[*found.checks, failed])


def _static_checks(at: Comparison, built: Built) -> list[Check]:
    name = at.board.name
    checks = [
        Check(
            f"{name}: stack of a sample, from the compiler",
            f"{built.stack} bytes",
            f"less than the {STACK} reserved",
            built.stack < STACK,
        )
    ]
    if at.is_fixed:
        soft = ", ".join(built.soft_float) or "none"
        what = f"{name}: calls of floating-point routines"
        checks.append(Check(what, soft, "none", not built.soft_float))
    return checks


def _compared(at: Comparison, found: OnTarget, processor: EmulatedCode) -> OnTarget:
    checks, counts = list(found.checks), dict[str, np.ndarray]()
    for label, exchange in at.verified.exchanges.items():
        values, _ = processor.respond(exchange.sensor)
        counts[label] = processor.instructions[-1]
        checks.append(_compare(at, label, values, exchange))
    checks += _compare_here(at, processor, counts)
    reference, note = at.verified.runs["JAX"], f", {at.board.name}"
    checks += check_faults(at.exported, processor, reference, at.wires, note)
    run = _closed_loop(at, processor, counts)
    checks += _loop_checks(at, run)
    return found._replace(
        checks=checks,
        sizes=processor.sizes,
        instructions=counts,
        depth=processor.depth,
        run=run,
    )


def _compare(at: Comparison, label: str, values: np.ndarray, exchange: Exchange) -> Check:
    wanted = exchange.actuator
    what = f"{at.board.name}: {label}"
    if at.is_fixed:
        differing = int(np.sum(values != wanted))
        text = f"{differing} of {values.size} codes differ"
        return Check(what, text, "0", differing == 0)
    limit = max(at.limit, exchange.allowed)
    return compare_values(what, values, wanted, limit, exchange.largest)


def _compare_here(
    at: Comparison, processor: EmulatedCode, counts: dict[str, np.ndarray]
) -> list[Check]:
    """Against the same code on this machine: the shaper; in fixed point also random input."""
    path, _ = reference_path(at.exported)
    real = np.float64 if at.board.real == "double" else np.float32
    wire, word = (np.uint16, np.int32) if at.is_fixed else (real, real)
    what = f"{at.board.name}: shaper, the case's motion"
    with load_code(at.exported, at.source, at.name, at.compiler, wire, word) as code:
        if not at.is_fixed:
            return [compare_values(what, processor.shape(path), code.shape(path), at.limit)]
        rows, _ = path_counts(path)
        differing = int(np.sum(processor.shape(rows) != code.shape(rows)))
        shaper = Check(what, f"{differing} counts differ", "0", differing == 0)
        return [shaper, _compare_episodes(at, code, processor, counts)]


def _compare_episodes(
    at: Comparison, code: Code, processor: EmulatedCode, counts: dict[str, np.ndarray]
) -> Check:
    """Random input with sensor faults, reset in between."""
    exported = at.exported
    rail = rail_samples(exported.study.electronics.sample_rate_hz)
    top, shape = int(exported.controller.adc_top), (exported.n_links, exported.n_patches)
    differing = faulty = total = 0
    each = []
    for codes in episodes(EPISODES, shape, top, rail):
        values, faults = processor.respond(codes)
        each.append(processor.instructions[-1])
        wanted, expected = code.respond(codes)
        differing += int(np.sum(values != wanted) + np.sum(faults != expected))
        faulty += int(faults[-1] > 0)
        total += len(codes)
    label = "random input with faults and resets"
    counts[label] = np.concatenate(each)
    return Check(
        f"{at.board.name}: {label}, {total} samples, {EPISODES} resets, {faulty} faults",
        f"{differing} codes and faults differ",
        "0",
        differing == 0,
    )


def _closed_loop(at: Comparison, processor: EmulatedCode, counts: dict[str, np.ndarray]) -> LoopRun:
    """The case's motion: the plant in JAX, the controller on the target, sample by sample."""
    exported, begin = at.exported, len(processor.instructions)
    if at.wires is None:
        law = law_of(processor, float(exported.controller.adc_step))
    else:
        law = law_of(processor, to_volts=at.wires.volts)
    run = run_in_the_loop(exported.structure, exported.case, law)
    counts["closed loop"] = np.concatenate(processor.instructions[begin:])
    return run


def _loop_checks(at: Comparison, run: LoopRun) -> list[Check]:
    wanted = at.verified.runs[at.label]
    name = f"{at.board.name}: closed loop"
    actual, expected = (describe(int(x.result.status)) for x in (run, wanted))
    checks = [Check(f"{name}, status", actual, expected, actual == expected)]
    if not at.is_fixed:
        return checks
    differing = int(np.sum(run.codes != wanted.codes) + np.sum(run.voltage != wanted.voltage))
    residual = [x.result.metrics.residual_rms for x in (run, wanted)]
    is_same = differing == 0 and bool(np.array_equal(*residual))
    text = f"{differing} ADC codes and commands differ, residual {'equal' if is_same else 'apart'}"
    return [*checks, Check(name, text, "0, equal to the last bit", is_same)]
