"""One controller in several arithmetics and at several sample rates: what each would cost."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from studies.engine.controller import FixedController, check_codable, fixed_controller
from studies.engine.design import Design
from studies.engine.fast_motion import find_motion
from studies.errors import StudyError
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.c_text import Source
from studies.export.compiler import NO_COMPILER, find_compiler
from studies.export.firmware.boards import Board
from studies.export.firmware.build import Built, build, check_tools
from studies.export.firmware.emulator import EmulatedCode, emulated
from studies.export.firmware.project import project_files, write_files
from studies.export.fixed import ALLOWED_ERROR, check_words, dac_step_of
from studies.export.fixed_blocks import design_integers
from studies.export.floating import respond
from studies.export.in_the_loop import LoopRun, law_of, run_in_the_loop
from studies.export.request import check_loop
from studies.export.run import checked_bits, checked_board
from studies.export.say import whole_page
from studies.export.verify import load_code, reference_run
from studies.publish import publish, working_folder
from studies.result import Result, in_folder
from studies.results.document import json_text
from studies.results.labelled import Labelled, derived, labelled, told, unwritten
from studies.show.listing import Rows
from studies.show.report import Report, chapter, machine
from studies.study.margin import margin_text
from studies.study.spec import Study

PAGE, DOCUMENT = "comparison.html", "comparison.json"
#: Sample rates [Hz], and bits of a word in fixed point; 0: single precision.
RATES = (5e3, 10e3, 20e3)
WORDS = (0, 32, 16)
NAME = "flexlink"
#: Gain margin of a controller to recommend, and vibration that counts as alike [1].
SAFE, ALIKE = 2.0, 0.05


class Variant(Labelled):
    """A controller in one arithmetic at one sample rate."""

    sample_rate: float = labelled("Hz", "of the controller")
    word: int = told("bits of a word; 0: single precision")
    fault: str = told("why there is no such controller; empty if there is", default="")
    gain_margin: float = labelled("1", "with its coefficients", default=np.nan)
    residual_rms: float = labelled("m", "of the worst link after the motion", default=np.nan)
    rounding: float = labelled("1", "bound on the error at an actuator, in DAC steps", default=0.0)
    instructions: int | None = told("of the costliest sample; null: not emulated", default=None)
    load: float | None = labelled("1", "share of a sample period, usual clock", default=None)
    flash: int | None = told("code and constants [byte]", default=None)

    @derived("", "in words")
    def arithmetic(self) -> str:
        return f"{self.word}-bit fixed point" if self.word else "single precision"

    @derived("", "whether studies export writes it")
    def is_exportable(self) -> bool:
        return not self.fault and self.word in (0, 32) and self.rounding <= ALLOWED_ERROR


class ComparedVariants(Labelled, Result, command="comparison", version=2):
    """`comparison.json`, written by `studies export --compare`: a controller in several
    arithmetics and at several sample rates.
    """

    study: Study = unwritten()
    motion: str = told("why it is not that of the study; empty if it is")
    board: Board | None = unwritten()
    dac_bits: int = told("resolution of the DAC behind all of them")
    variants: tuple[Variant, ...] = told("arithmetic by arithmetic at each sample rate")
    uncontrolled: float = labelled("m", "residual vibration of the worst link without control")

    @derived("", "of the study")
    def title(self) -> str:
        return self.study.title

    @derived("", "that counted instructions; empty: none")
    def processor(self) -> str:
        return "" if self.board is None else self.board.name

    @property
    def is_good(self) -> bool:
        """Whether any variant has a controller."""
        return not all(x.fault for x in self.variants)


def compare_variants(
    design: Design,
    out: str | Path,
    dac_bits: int | None = None,
    pil: str | None = None,
    console: Console | None = None,
) -> ComparedVariants:
    """Export a controller in every arithmetic at every sample rate, for a table, not for use.

    Args:
        design: whose controller; its sample rate is replaced.
        out: folder for the page and the document.
        dac_bits: resolution of the DAC behind all of them; None: the usual one.
        pil: emulated processor that counts instructions; None: they are not counted.
        console: where messages go; default: standard output.

    Raises:
        StudyError: an argument out of range, no compiler or controller, or a folder that cannot
            be written to.
    """
    console = console or Console(highlight=False, markup=False)
    bits, board = checked_bits(dac_bits), checked_board(pil)
    if board is not None:
        check_tools()
    out, compiler = Path(out), find_compiler()
    if not compiler:
        raise StudyError(f"--compare: {NO_COMPILER}")
    check_codable(design.study)
    fixed_controller(design.study)  # that there is one
    motion = find_motion(design.study)
    if motion.text:
        console.print(motion.text, soft_wrap=True)
    uncontrolled = _uncontrolled(motion.study)
    console.print(f"without control: residual vibration {1e6 * uncontrolled:.3g} µm")
    variants: list[Variant] = []
    for rate in RATES:
        for variant in _at_rate(motion.study, rate, bits, board, compiler):
            console.print(": ".join((f"{rate:g} Hz, {variant.arithmetic}", _verdict(variant))))
            variants.append(variant)
    found = ComparedVariants(
        study=design.study,
        motion=motion.text,
        board=board,
        dac_bits=bits,
        variants=tuple(variants),
        uncontrolled=uncontrolled,
    )
    with publish(out) as staging:
        (staging / PAGE).write_text(whole_page(found.report()), encoding="utf-8")
        (staging / DOCUMENT).write_text(json_text(found), encoding="utf-8")
    return in_folder(found, out, out / PAGE)


def _uncontrolled(study: Study) -> float:
    """Residual vibration where actuators stay at rest [m]."""
    own = fixed_controller(study)
    return _residual(run_in_the_loop(own.structure, own.case, np.zeros_like))


def _at_rate(
    study: Study, rate: float, dac_bits: int, board: Board | None, compiler: list[str]
) -> Iterator[Variant]:
    """The variants of one sample rate."""
    try:
        study = study.change(electronics__sample_rate_hz=rate)
        exported = fixed_controller(study)
        loop = check_loop(exported, exported.channels, "")
        codes = reference_run(exported).codes
    except StudyError as error:
        yield from (Variant(rate, word, fault=str(error)) for word in WORDS)
        return
    at = _At(
        exported=exported,
        codes=codes,
        dac_bits=dac_bits,
        board=board,
        compiler=compiler,
        margin=float(loop.gain_margin),
    )
    for word in WORDS:
        try:
            yield _fixed(at, rate, word) if word else _floating(at, rate)
        except StudyError as error:
            yield Variant(rate, word, fault=str(error))


class _At(NamedTuple):
    """What the variants of one sample rate have in common."""

    exported: FixedController
    codes: np.ndarray  # of the ADC with the JAX controller, (T, 3, K)
    dac_bits: int
    board: Board | None
    compiler: list[str]
    margin: float  # with exact coefficients [1]


def _floating(at: _At, rate: float) -> Variant:
    exported, scale = at.exported, float(at.exported.controller.adc_step)
    source = floating_source(exported, NAME, [])
    step = dac_step_of(exported.controller, at.dac_bits)

    def through_dac(volts: np.ndarray) -> np.ndarray:
        return np.asarray(np.round(volts / step) * step)

    with load_code(exported, source, NAME, at.compiler, np.float32, np.float32) as code:
        law = law_of(code, scale, through_dac)
        run = run_in_the_loop(exported.structure, exported.case, law)
    variant = Variant(rate, 0, gain_margin=at.margin, residual_rms=_residual(run))
    return _with_cost(at, variant, source, at.codes * scale)


def _fixed(at: _At, rate: float, word: int) -> Variant:
    exported = at.exported
    check_words(exported)
    signals = respond(exported.channels, exported.controller, at.codes)
    fixed, near = design_integers(exported, signals, at.dac_bits, word)
    loop = check_loop(exported, near, f", coefficients rounded to {word} bits")
    source, wires = fixed_source(exported, fixed, NAME, [], ""), fixed.wires
    with load_code(exported, source, NAME, at.compiler, np.uint16, np.int32) as code:
        law = law_of(code, to_volts=wires.volts)
        run = run_in_the_loop(exported.structure, exported.case, law)
    variant = Variant(
        rate,
        word,
        gain_margin=float(loop.gain_margin),
        residual_rms=_residual(run),
        rounding=float(fixed.error.inside.max() / wires.dac_step),
    )
    return _with_cost(at, variant, source, at.codes)


def _residual(run: LoopRun) -> float:
    return float(np.max(run.result.metrics.residual_rms))


def _with_cost(at: _At, variant: Variant, source: Source, sensor: np.ndarray) -> Variant:
    """With instructions and flash, if there is a processor."""
    if at.board is None:
        return variant
    with _emulation(source, at.board, bool(variant.word)) as (built, processor):
        processor.respond(sensor)
        most = int(processor.instructions[-1].max())
    load = at.board.load(most, variant.sample_rate, at.board.clock)
    return variant.replace(instructions=most, load=load, flash=built.flash)


@contextmanager
def _emulation(
    source: Source, board: Board, is_fixed: bool
) -> Iterator[tuple[Built, EmulatedCode]]:
    """The code, built for a processor and running on it."""
    with working_folder() as folder:
        write_files(project_files(source, NAME, board, is_fixed), folder)
        built = build(folder, NAME, board, is_fixed)
        with emulated(built.image, board) as processor:
            yield built, processor


def _verdict(x: Variant) -> str:
    """What speaks for or against a variant, in words."""
    if x.fault:
        return f"none: {x.fault}"
    margin = margin_text(x.gain_margin, 3)
    text = f"gain margin {margin}, residual vibration {1e6 * x.residual_rms:.3g} µm"
    if x.rounding > ALLOWED_ERROR:
        return f"{text}, but rounding of up to {x.rounding:.3g} DAC steps"
    return text


def _rows(found: ComparedVariants) -> list[list[str]]:
    """Row of the table of each variant."""
    rows, own = [], found.study.electronics.sample_rate_hz
    for x in found.variants:
        start = [f"{x.sample_rate / 1e3:g}{' (own)' if x.sample_rate == own else ''}", x.arithmetic]
        if x.fault:
            rows.append([*start, *[""] * (3 if found.board is None else 6), f"none: {x.fault}"])
            continue
        figures = [margin_text(x.gain_margin, 3), f"{1e6 * x.residual_rms:.4g}"]
        figures.append(f"{x.rounding:.3g}" if x.word else "no bound")
        if found.board is not None and x.load is not None:
            figures += [str(x.instructions), f"{100 * x.load:.0f} %", str(x.flash)]
        what = "studies export writes it"
        if x.rounding > ALLOWED_ERROR:
            what = f"not written: rounding above {ALLOWED_ERROR:g} DAC steps"
        elif not x.is_exportable:
            what = "not written: words of 16 bits are only compared"
        rows.append([*start, *figures, what])
    return rows


def cheapest(found: ComparedVariants) -> Variant | None:
    """The one that takes least of a processor among those as good as any; None: there is none.

    They are exported, keep a gain margin of `SAFE`, and vibrate no more than the stillest one by
    `ALIKE`. Without a processor the one of the lowest rate, in single precision first.
    """
    safe = [x for x in found.variants if x.is_exportable and x.gain_margin >= SAFE]
    least = min((x.residual_rms for x in safe), default=np.nan)
    able = [x for x in safe if x.residual_rms <= (1 + ALIKE) * least and (x.load or 0.0) < 1]
    return min(able, key=lambda x: (x.load or 0.0, x.sample_rate, x.word), default=None)


def _advice(found: ComparedVariants) -> str:
    """Which variant to take, in words."""
    best = cheapest(found)
    if best is None:
        return f"none keeps a gain margin of {SAFE:g} and fits into its sample period"
    load = "" if best.load is None else f", {100 * best.load:.0f} % of a sample period"
    return (
        f"the cheapest with a gain margin of {SAFE:g} and at most {100 * ALIKE:.0f} % more "
        f"vibration than the stillest is {best.arithmetic} at {best.sample_rate / 1e3:g} kHz{load}"
    )


def say(found: ComparedVariants) -> Report:
    """What a comparison tells."""
    board, heads = found.board, ["sample rate [kHz]", "arithmetic", "gain margin"]
    heads += ["residual rms, worst link [µm]", "rounding, at most [DAC steps]"]
    usable = [x for x in found.variants if x.is_exportable and (x.load is None or x.load < 1)]
    written = f"`studies export` writes {len(usable)} of these {len(found.variants)} controllers"
    cost = """`studies export DESIGN --compare --pil cortex-m4f --out DIR` counts instructions and
    flash, too."""
    if board is not None:
        heads += ["instructions", f"load at {board.clock / 1e6:g} MHz", "flash [byte]"]
        written += f" and they fit into their sample period on a {board.text}"
        cost = f"""Instructions of the costliest sample, not cycles; load: {board.cycles} cycles an
        instruction are assumed; flash: code and constants of controller and shaper."""
    return Report(
        title=f"{found.title or 'untitled study'}: word length and sample rate",
        result=[_advice(found), written],
        question="what does this controller cost in other arithmetics and at other sample rates?",
        next_steps="""set `electronics.sample_rate_hz`, tune at that rate, and export with `--target
        c` or `c-fixed`.""",
        top=[machine(found.study)],
        chapters=[
            chapter(
                "Comparison",
                Rows([*heads, "verdict"], _rows(found)),
                f"""The compiled code in closed loop, not tuned again at each rate, behind a DAC of
                {found.dac_bits} bits in every case. Without control,
                {1e6 * found.uncontrolled:.4g} µm remain.
                {found.motion and f"The study: {found.motion}."}""",
                f"""Rounding: largest error at an actuator that it can add up to, whatever the
                sensors say; {ALLOWED_ERROR} DAC steps are allowed. Single precision has no such
                bound.""",
                cost,
            )
        ],
        files={"Study file": found.study},
    )
