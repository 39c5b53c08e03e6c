"""Export targets: which files a controller becomes, and how they are verified.

A `Target` makes the files of an `Export` and, if requested, compares them with the JAX controller.
`TARGETS` is the only list of them; `TARGETS.add` adds your own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import NamedTuple

from jaxmodel.drives import DRIVES
from jaxmodel.table import Table
from studies.export.c_drive import drive_code
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.c_text import Source
from studies.export.cost import cost_of
from studies.export.document import document, schema, to_json
from studies.export.firmware.on_target import Comparison, verify_on_target
from studies.export.fixed import Wires, check_error, check_words
from studies.export.fixed_blocks import design_integers
from studies.export.floating import respond
from studies.export.request import Export, ExportResult, check_loop, reference_motion
from studies.export.verify import drive_checks, verify_document, verify_fixed, verify_floating


class Target(NamedTuple):
    """One kind of files."""

    name: str
    text: str  # what they are
    make: Callable[[Export], ExportResult]
    needs_compiler: bool = False  # for verification
    has_dac: bool = False  # accepts the resolution of a DAC
    has_pil: bool = False  # runs on the emulated processors


def _export_json(job: Export) -> ExportResult:
    loop = check_loop(job.exported, job.exported.channels, "")
    described = document(job.exported, job.case_id)
    files = {
        f"{job.name}.json": to_json(described),
        f"{job.name}.schema.json": json.dumps(schema(), indent=1) + "\n",
    }
    if not job.is_verified:
        return ExportResult(files, loop, None)
    return ExportResult(
        files, loop, verify_document(job.exported, reference_motion(job), described)
    )


def _export_floating(job: Export) -> ExportResult:
    loop = check_loop(job.exported, job.exported.channels, "")
    source = floating_source(job.exported, job.name, job.origin)
    files = _files(source, job.name)
    drive = drive_code(job.exported, job.name, job.origin)
    if drive is not None:
        files |= _files(drive.source, drive.name)
    if not job.is_verified:
        return ExportResult(files, loop, None)
    reference = reference_motion(job)
    verified = verify_floating(job.exported, reference, source, job.name, job.compiler)
    if drive is not None:
        checks = [*verified.checks, *drive_checks(drive, job.compiler)]
        verified = verified._replace(checks=checks)
    return _on_target(job, ExportResult(files, loop, verified), source, None)


def _export_fixed(job: Export) -> ExportResult:
    exported = job.exported
    check_words(exported)
    if DRIVES[exported.structure.drive].is_sampled:
        job.console.print("the drives is not part of it: --target c writes it, too")
    check_loop(exported, exported.channels, "")
    reference = reference_motion(job)
    signals = respond(exported.channels, exported.controller, reference.codes)
    fixed, near = design_integers(exported, signals, job.dac_bits)
    check_error(exported, fixed.error, fixed.wires.dac_step)
    loop = check_loop(exported, near, ", coefficients rounded to 32 bits")
    cost = cost_of(exported, fixed)
    job.console.print(cost.text)
    source = fixed_source(exported, fixed, job.name, job.origin, cost.text)
    verified = None
    if job.is_verified:
        verified = verify_fixed(exported, fixed, reference, source, job.name, job.compiler)
    result = ExportResult(
        files=_files(source, job.name), loop=loop, verified=verified, fixed=fixed, cost=cost
    )
    return _on_target(job, result, source, fixed.wires)


def _on_target(
    job: Export, result: ExportResult, source: Source, wires: Wires | None
) -> ExportResult:
    """An export with its project, compared on the emulated processor; as it is without one."""
    if job.board is None or result.verified is None:
        return result
    job.console.print(f"on the target: {job.board.text}, emulated")
    found = verify_on_target(
        Comparison(
            exported=job.exported,
            source=source,
            name=job.name,
            board=job.board,
            wires=wires,
            compiler=job.compiler,
            verified=result.verified,
        )
    )
    verified = result.verified
    runs = verified.runs if found.run is None else verified.runs | {job.board.text: found.run}
    return result._replace(
        files=result.files | found.files,
        verified=verified._replace(checks=[*verified.checks, *found.checks], runs=runs),
        on_target=found,
    )


def _files(source: Source, name: str) -> dict[str, str]:
    return {f"{name}.h": source.header, f"{name}.c": source.code}


#: All targets by name.
TARGETS: Table[Target] = Table(
    "target",
    [
        Target("json", "all numbers with units and meanings", _export_json),
        Target("c", "C99 in floating point", _export_floating, True, has_pil=True),
        Target("c-fixed", "C99 in 32-bit fixed point", _export_fixed, True, True, has_pil=True),
    ],
)
