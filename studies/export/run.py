"""From a design to the files of a controller."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from studies import config
from studies.engine.controller import FixedController, check_codable, fixed_controller
from studies.engine.design import Design, as_design
from studies.engine.preflight import check_run
from studies.errors import StudyError, field_error, nearest
from studies.export.compiler import NO_COMPILER, find_compiler
from studies.export.document import study_hash
from studies.export.firmware.boards import BOARDS, Board
from studies.export.firmware.build import check_tools
from studies.export.request import Export, Exported, ExportResult
from studies.export.say import whole_page
from studies.export.targets import TARGETS
from studies.publish import publish
from studies.result import in_folder
from studies.study.spec import Study

REPORT, FAILED = "verification.html", "verification-failed.html"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,30}")
_DAC_BITS = (4, 16)
DAC_BITS = 12


def export_design(
    design: Design | Study | str | Path,
    target: str,
    out: str | Path,
    is_verified: bool | None = None,
    name: str = "flexlink",
    dac_bits: int | None = None,
    console: Console | None = None,
    pil: str | None = None,
) -> Exported:
    """Write a controller, verified if requested.

    Args:
        design: what to export; or its study, or what `load_design` reads.
        target: one of `TARGETS`.
        out: folder for the files, created if missing.
        is_verified: whether to compare with the JAX controller; None: if there is a compiler.
        name: of the files, prefix of C functions.
        dac_bits: resolution of the DAC, for targets that have one; None: `DAC_BITS`.
        console: where messages go; default: standard output.
        pil: processor on which the code is emulated and for which a project is written, one of
            `studies.export.firmware.boards.BOARDS`; None: neither.

    Returns:
        what was written and compared; `is_good`: whether something was, and everything agreed.

    Raises:
        StudyError: an argument out of range, or a controller that cannot be exported.
    """
    design = as_design(design)
    _check_arguments(target, name, dac_bits)
    bits = checked_bits(dac_bits)
    board = checked_board(pil)
    if board is not None:
        _check_processor(board.name, target, is_verified)
    out = Path(out)
    console = console or Console(highlight=False, markup=False)
    needs_compiler = TARGETS[target].needs_compiler
    compiler = find_compiler() if needs_compiler else []
    if needs_compiler and not compiler:
        if is_verified:
            raise StudyError(f"--verify: {NO_COMPILER}")
        if pil is not None:
            raise StudyError(f"--pil {pil}: {NO_COMPILER}")
        if is_verified is None:
            console.print(f"not verified: {NO_COMPILER}")
        is_verified = False
    is_verified = True if is_verified is None else is_verified

    check_codable(design.study)
    exported = fixed_controller(design.study)
    if is_verified:  # by the study's own motion
        check_run(exported.study)
    job = Export(
        exported=exported,
        name=name,
        origin=_origin(exported, design.case_id),
        case_id=design.case_id,
        compiler=compiler,
        is_verified=is_verified,
        dac_bits=bits,
        console=console,
        board=board,
    )
    result = TARGETS[target].make(job)
    if not _is_result(result):
        wanted = "an ExportResult with the text of each file"
        raise StudyError(
            f"--target {target}: it returns {type(result).__name__}; expected {wanted}"
        )
    for file in result.files:
        if Path(file).name != file or file.startswith("."):
            raise StudyError(f"--target {target}: it makes {file!r}; expected a plain file name")
    made = Exported(exported, target, (), result, origin=job.origin)
    # files of an earlier export stay unchanged
    texts = {} if made.has_failed else result.files
    if made.verified is not None:
        texts |= {FAILED if made.has_failed else REPORT: whole_page(made.report())}
    with publish(out, stale=() if made.has_failed else (REPORT, FAILED)) as staging:
        for file, text in texts.items():
            (staging / file).write_text(text, encoding="utf-8")
    return in_folder(replace(made, files=tuple(out / file for file in texts)), out)


def _is_result(found: object) -> bool:
    """Whether a target, which may be a user's, has made texts of files."""
    return (
        isinstance(found, ExportResult)
        and isinstance(found.files, dict)
        and all(isinstance(text, str) for pair in found.files.items() for text in pair)
    )


def _check_arguments(target: str, name: str, dac_bits: int | None) -> None:
    if target not in TARGETS:
        raise field_error("--target", target, ", ".join(TARGETS), hint=nearest(target, TARGETS))
    if not _NAME.fullmatch(name) or name == "stdint":  # a header that the code includes
        raise field_error("--name", name, "letters, digits and _, 31 at most, a letter first")
    if dac_bits is not None and not TARGETS[target].has_dac:
        raise StudyError(f"--dac-bits {dac_bits}: not allowed with --target {target}; leave it out")


def checked_bits(dac_bits: int | None) -> int:
    """Resolution of a DAC; None: the usual one.

    Raises:
        StudyError: out of range.
    """
    low, high = _DAC_BITS
    if dac_bits is not None and not low <= dac_bits <= high:
        raise field_error("--dac-bits", dac_bits, f"{low} to {high}", "1")
    return dac_bits or DAC_BITS


def checked_board(pil: str | None) -> Board | None:
    """The emulated processor of that name; None: none is wanted.

    Raises:
        StudyError: another name.
    """
    if pil is None:
        return None
    if pil not in BOARDS:
        raise field_error("--pil", pil, ", ".join(BOARDS), hint=nearest(pil, BOARDS))
    return BOARDS[pil]


def _check_processor(pil: str, target: str, is_verified: bool | None) -> None:
    if not TARGETS[target].has_pil:
        allowed = ", ".join(name for name, x in TARGETS.items() if x.has_pil)
        raise StudyError(f"--pil {pil}: not allowed with --target {target}; allowed: {allowed}")
    if is_verified is False:
        raise StudyError(f"--pil {pil}: not allowed with --no-verify; leave one of them out")
    check_tools()


def _origin(exported: FixedController, case_id: str) -> list[str]:
    """Where a controller comes from, for file headers."""
    study = exported.study
    links = "+".join(str(i + 1) for i, is_on in enumerate(study.control.links) if is_on)
    package = f"{config.PACKAGE} {config.info()[config.PACKAGE]}"
    wiring = []
    if study.patches.actuators == "both faces":
        wiring = [
            "Each actuator is a pair, one patch on each face, wired with opposite polarity to",
            "one amplifier, which has twice the capacitance to drive",
        ]
    return [
        f"{study.title}",
        f"Exported by {package}; study SHA-256 {study_hash(study)}"
        + (f"; case {case_id} of a sweep" if case_id else ""),
        f"Law {study.control.law}, basis {study.control.basis}, controlled links {links}, "
        f"velocity estimate {study.electronics.estimator}, shaper {study.shaper.kind}",
        *wiring,
    ]
