"""Export targets: which files a controller becomes, and how they are verified.

A `Target` makes the files of a `Job` and, if requested, compares them with the JAX controller.
`TARGETS` is the only list of them; `TARGETS.add` adds your own.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import NamedTuple

from jaxmodel.table import Table
from studies.engine.blocks import BlockFlow
from studies.engine.channels import ChannelFlow
from studies.engine.controller import FixedController
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.c_text import Source
from studies.export.cost import cost_of
from studies.export.document import document, schema, to_json
from studies.export.fixed import FixedPoint, check_words, design_fixed, rounded
from studies.export.fixed_blocks import FixedBlocks, design_blocks, rounded_blocks
from studies.export.floating import BlockSignals, Signals, respond
from studies.export.job import Job, Made, judged, reference_motion
from studies.export.verify import verify_document, verify_fixed, verify_floating


class Target(NamedTuple):
    """One kind of files."""

    name: str
    text: str  # what they are
    make: Callable[[Job], Made]
    needs_compiler: bool = False  # for verification
    has_dac: bool = False  # accepts the resolution of a DAC


def _as_json(job: Job) -> Made:
    loop = judged(job.found, job.found.channels, "")
    described = document(job.found, job.case_id)
    files = {
        f"{job.name}.json": to_json(described),
        f"{job.name}.schema.json": json.dumps(schema(), indent=1) + "\n",
    }
    if not job.is_verified:
        return Made(files, loop, None)
    return Made(files, loop, verify_document(job.found, reference_motion(job), described))


def _as_floating(job: Job) -> Made:
    loop = judged(job.found, job.found.channels, "")
    source = floating_source(job.found, job.name, job.origin)
    files = _files(source, job.name)
    if not job.is_verified:
        return Made(files, loop, None)
    reference = reference_motion(job)
    verified = verify_floating(job.found, reference, source, job.name, job.compiler)
    return Made(files, loop, verified)


def _as_fixed(job: Job) -> Made:
    found = job.found
    check_words(found)
    judged(found, found.channels, "")
    reference = reference_motion(job)
    seen = respond(found.channels, found.controller, reference.codes)
    fixed, near = _designed(found, seen, job.dac_bits)
    loop = judged(found, near, ", coefficients rounded to 32 bits")
    cost = cost_of(found, fixed)
    job.console.print(cost.text)
    source = fixed_source(found, fixed, job.name, job.origin, cost.text)
    verified = None
    if job.is_verified:
        verified = verify_fixed(found, fixed, reference, source, job.name, job.compiler)
    return Made(
        files=_files(source, job.name), loop=loop, verified=verified, fixed=fixed, cost=cost
    )


def _designed(
    found: FixedController, seen: Signals | BlockSignals, dac_bits: int
) -> tuple[FixedPoint | FixedBlocks, ChannelFlow | BlockFlow]:
    """A controller in fixed point, and what its integers represent."""
    if isinstance(found.channels, BlockFlow):
        assert isinstance(seen, BlockSignals)
        blocks = design_blocks(found, seen, dac_bits)
        return blocks, rounded_blocks(blocks, found.channels)
    assert isinstance(seen, Signals)
    fixed = design_fixed(found, seen, dac_bits)
    return fixed, rounded(fixed, found.channels)


def _files(source: Source, name: str) -> dict[str, str]:
    return {f"{name}.h": source.header, f"{name}.c": source.code}


#: All targets by name.
TARGETS: Table[Target] = Table(
    "target",
    [
        Target("json", "all numbers with units and meanings", _as_json),
        Target("c", "C99 in floating point", _as_floating, needs_compiler=True),
        Target("c-fixed", "C99 in 32-bit fixed point", _as_fixed, True, has_dac=True),
    ],
)
