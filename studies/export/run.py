"""From a design to the files of a controller."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxmodel import status
from studies import config
from studies.design import Design
from studies.errors import StudyError, field_error
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.c_text import Source
from studies.export.channels import Channels, unfold
from studies.export.compiler import NO_COMPILER, find_compiler
from studies.export.controller import FixedController, fixed_controller
from studies.export.cost import Cost, cost_of
from studies.export.document import document, schema, study_hash, to_json
from studies.export.fixed import FixedPoint, check_words, design_fixed, rail_samples, rounded
from studies.export.floating import respond
from studies.export.in_the_loop import LoopRun
from studies.export.report import report
from studies.export.verify import (
    Verification,
    reference_run,
    verify_document,
    verify_fixed,
    verify_floating,
)
from studies.pages import report_files
from studies.runs import describe
from studies.stability import LoopReport, loop_report
from studies.store import check_folder, replacing

TARGETS = ("json", "c", "c-fixed")
REPORT, FAILED = "verification", "verification-failed"
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,30}")
_DAC_BITS = (4, 16)
DAC_BITS = 12


def export_design(
    design: Design, target: str, out: Path, is_verified: bool | None = None,
    name: str = "flexlink", dac_bits: int | None = None, console: Console | None = None,
) -> bool:  # fmt: skip
    """Write a controller, verified where asked for.

    Args:
        design: what to export.
        target: one of `TARGETS`.
        out: folder for the files, made where it is missing.
        is_verified: whether to compare with the JAX controller; None: where there is a compiler.
        name: of the files, prefix of C functions.
        dac_bits: resolution of the DAC, for "c-fixed" alone; None: `DAC_BITS`.
        console: to tell what happens; default: standard output.

    Returns:
        whether everything agreed; the files are written only then.

    Raises:
        StudyError: an argument out of range, or a controller that cannot be exported.
    """
    _check_arguments(target, name, dac_bits)
    check_folder(out)
    console = console or Console(highlight=False, markup=False)
    compiler = [] if target == "json" else find_compiler()
    if target != "json" and not compiler:
        if is_verified:
            raise StudyError(f"--verify: {NO_COMPILER}")
        if is_verified is None:
            console.print(f"not verified: {NO_COMPILER}")
        is_verified = False
    is_verified = True if is_verified is None else is_verified

    found = fixed_controller(design.study)
    job = _Job(
        found, name, _origin(found, design.case_id), design.case_id, compiler, is_verified,
        dac_bits or DAC_BITS, console,
    )  # fmt: skip
    made = {"json": _as_json, "c": _as_floating, "c-fixed": _as_fixed}[target](job)
    verified = made.verified
    is_good = verified is None or verified.is_passed
    texts = made.files if is_good else {}  # what an earlier export has left stays as it is
    if verified is not None:
        text = report(found, job.origin, made.loop, verified, made.fixed, made.cost)
        texts |= report_files(out, text, found.study, REPORT if is_good else FAILED)
        _tell(verified, console)
    reports = [f"{name}.{kind}" for name in (REPORT, FAILED) for kind in ("md", "html")]
    stale = [file for file in reports if file not in texts] if is_good else []
    _write(out, texts, stale, console)
    return is_good


class _Job(NamedTuple):
    """What is to be exported, and how."""

    found: FixedController
    name: str
    origin: list[str]
    case_id: str
    compiler: list[str]
    is_verified: bool
    dac_bits: int
    console: Console


class _Made(NamedTuple):
    """What came out."""

    files: dict[str, str]
    loop: LoopReport  # with the exported coefficients
    verified: Verification | None
    fixed: FixedPoint | None = None
    cost: Cost | None = None


def _as_json(job: _Job) -> _Made:
    loop = _judged(job.found, job.found.channels, "")
    described = document(job.found, job.case_id)
    files = {
        f"{job.name}.json": to_json(described),
        f"{job.name}.schema.json": json.dumps(schema(), indent=1) + "\n",
    }
    if not job.is_verified:
        return _Made(files, loop, None)
    return _Made(files, loop, verify_document(job.found, _reference(job), described))


def _as_floating(job: _Job) -> _Made:
    loop = _judged(job.found, job.found.channels, "")
    source = floating_source(job.found, job.name, job.origin)
    files = _files(source, job.name)
    if not job.is_verified:
        return _Made(files, loop, None)
    reference = _reference(job)
    verified = verify_floating(job.found, reference, source, job.name, job.compiler)
    return _Made(files, loop, verified)


def _as_fixed(job: _Job) -> _Made:
    found = job.found
    check_words(found)
    _judged(found, found.channels, "")
    reference = _reference(job)
    seen = respond(found.channels, found.controller, reference.codes)
    fixed = design_fixed(found, seen, job.dac_bits)
    loop = _judged(found, rounded(fixed, found.channels), ", coefficients rounded to 32 bits")
    cost = cost_of(found, fixed)
    job.console.print(cost.text)
    source = fixed_source(found, fixed, job.name, job.origin, cost.text)
    verified = None
    if job.is_verified:
        verified = verify_fixed(found, fixed, reference, source, job.name, job.compiler)
    return _Made(_files(source, job.name), loop, verified, fixed, cost)


def _check_arguments(target: str, name: str, dac_bits: int | None) -> None:
    if target not in TARGETS:
        raise field_error("--target", target, ", ".join(TARGETS))
    if not _NAME.fullmatch(name) or name == "stdint":  # the header that the code includes
        raise field_error("--name", name, "letters, digits and _, 31 at most, a letter first")
    if dac_bits is None:
        return
    if target != "c-fixed":
        raise StudyError(f"--dac-bits {dac_bits}: not allowed with --target {target}; leave it out")
    low, high = _DAC_BITS
    if not low <= dac_bits <= high:
        raise field_error("--dac-bits", dac_bits, f"{low} to {high}", "1")


def _origin(found: FixedController, case_id: str) -> list[str]:
    """Where a controller comes from, for heads of files."""
    study = found.study
    links = "+".join(str(i + 1) for i in range(3) if study.control.links[i])
    package = f"{config.PACKAGE} {config.info()[config.PACKAGE]}"
    return [
        f"{study.title}",
        f"Exported by {package}; study SHA-256 {study_hash(study)}"
        + (f"; case {case_id} of a sweep" if case_id else ""),
        f"Law {study.control.law}, basis {study.control.basis}, controlled links {links}, "
        f"velocity estimate {study.electronics.estimator}, shaper {study.shaper.kind}",
    ]


def _judged(found: FixedController, channels: Channels, note: str) -> LoopReport:
    """Linearised sampled loop with given coefficients; refused where it is unstable."""
    home = np.array(found.study.motion.waypoints[0], float)
    law = unfold(channels, found.controller)
    law = jax.tree.map(jnp.asarray, law)
    try:
        # not the case's own controller: its kind must not cost another compilation
        structure = found.structure._replace(has_position_gain=False)
        loop = loop_report(structure, found.case, home, 1, law=law)
    except np.linalg.LinAlgError:
        raise StudyError("the linearised loop is not finite: no controller to export") from None
    if not loop.is_stable:
        factor = found.study.control.gain_factor
        way = f"at most {0.5 * factor * loop.gain_margin:.3g}, half of what is stable"
        if loop.gain_margin == 0:
            way = "smaller ones do not help either: see studies simulate and docs/theory.md"
        raise field_error(
            "control.gain_factor", factor,
            f"gains whose sampled loop is stable{note}: its spectral radius is "
            f"{loop.spectral_radius:.6f}, its gain margin {loop.gain_margin:.3g} ({way})", "1",
        )  # fmt: skip
    return loop


def _reference(job: _Job) -> LoopRun:
    """The case's motion with the JAX controller, which must run to its end."""
    found = job.found
    job.console.print(f"in the loop: {found.structure.n_steps} samples for each controller")
    run = reference_run(found)
    code = int(run.result.status)
    if code not in status.FINISHED:
        raise StudyError(
            f"{found.study.title}: {describe(code)} at {run.result.bad_time:.4g} s; allowed: a "
            "study that runs to its end (see studies simulate)"
        )
    _check_clipping(found, run)
    return run


def _check_clipping(found: FixedController, run: LoopRun) -> None:
    """Refuse a motion that the exported code would take for a broken sensor."""
    electronics = found.study.electronics
    rail = rail_samples(electronics.sample_rate_hz)
    used = np.isin(np.arange(3), found.channels.link)[:, None]
    for end in (0.0, float(found.controller.adc_top)):
        length = np.zeros(run.codes.shape[1:])
        for k, code in enumerate(run.codes):
            length = np.where((code == end) & used, length + 1, 0)
            if length.max() >= rail:
                link, patch = np.unravel_index(np.argmax(length), length.shape)
                raise field_error(
                    "electronics.conditioner_gain", electronics.conditioner_gain,
                    f"so small that the motion does not hold sensor {patch + 1} of link {link + 1} "
                    f"at an end of the ADC's range for {1e3 * rail / electronics.sample_rate_hz:g} "
                    f"ms, as until t = {k / electronics.sample_rate_hz:.4g} s: that is taken for a "
                    "broken sensor (see electronics.conditioner_bias, too)", "1",
                )  # fmt: skip


def _files(source: Source, name: str) -> dict[str, str]:
    return {f"{name}.h": source.header, f"{name}.c": source.code}


def _tell(verified: Verification, console: Console) -> None:
    failed = [check for check in verified.checks if not check.is_met]
    for check in failed:
        console.print(f"FAILED: {check.what}: {check.found}, allowed {check.allowed}")
    if not failed:
        console.print(f"verified: {len(verified.checks)} comparisons agree")
    for note in verified.notes:
        console.print(note, soft_wrap=True)
    for name in verified.runs:
        if name != "JAX":
            at = verified.beside(name)
            console.print(
                f"in the loop, {name}: voltage differs by {at.voltage:.2g} V, platform by "
                f"{1e9 * at.pose[:2].max():.2g} nm, residual vibration by {100 * at.loss:+.2g} %"
            )


def _write(out: Path, texts: dict[str, str], stale: list[str], console: Console) -> None:
    """Write all files or none; `stale` are reports that would speak of other code."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyError(f"--out {out}: cannot write there ({error.strerror})") from None
    with ExitStack() as stack:
        for name, text in texts.items():
            temporary = stack.enter_context(replacing(out / name))
            temporary.write_text(text, encoding="utf-8")
    for name in stale:
        (out / name).unlink(missing_ok=True)
    for name in texts:
        console.print(f"written: {out / name}", soft_wrap=True)
