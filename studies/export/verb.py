"""The verb `export`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.engine.design import Design
    from studies.export.comparison import ComparedVariants
    from studies.export.request import Exported
    from studies.study.spec import Study


@verb
def export(
    what: Design | Study | str | Path,
    out: str | Path | None = None,
    *,
    target: str = "",
    case: int | str | None = None,
    verify: bool | None = None,
    name: str = "flexlink",
    dac_bits: int | None = None,
    pil: str = "",
    compare: bool = False,
    progress: bool = True,
) -> Exported | ComparedVariants:
    """Export the controller of a design to a real-time target, and verify it.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: folder for the results.
        target: json, c, or c-fixed (32-bit fixed point).
        case: case of a sweep (number or id:...) or family of a tuning.
        verify: compare with the JAX controller; default: if a C compiler is found.
        name: name of the files and C functions.
        dac_bits: DAC resolution [bit], for c-fixed; default: 12.
        pil: emulated processor that runs the code, too: cortex-m3, cortex-m4, cortex-m4f or
            cortex-m7; with a project to build for it.
        compare: no code, but a table: single precision, 32 and 16 bits at 5, 10 and 20 kHz.
        progress: show how far it is.

    Returns:
        What was written and compared; `is_good`: whether something was, and everything agreed.

    Raises:
        StudyError: an argument out of range, or a controller that cannot be exported.

    Example:
        >>> export("paper", "dsp", target="c").files  # doctest: +SKIP
    """
    from studies.config import require_configured
    from studies.console import make_console
    from studies.errors import StudyError
    from studies.job import checked_out
    from studies.publish import check_folder

    if compare and (target or verify is not None):
        other = "--target" if target else "--verify"
        raise StudyError(f"--compare: not allowed with {other}; leave one of them out")
    if not compare and not target:
        raise StudyError("--target: missing; allowed: json, c, c-fixed (or --compare)")
    check_folder(out := checked_out(out))
    require_configured()
    from studies.engine.design import as_design
    from studies.export.comparison import compare_variants
    from studies.export.run import export_design

    console = make_console()
    console.quiet = not progress
    design = as_design(what, case)
    if compare:
        return compare_variants(design, out, dac_bits, pil or None, console)
    return export_design(design, target, out, verify, name, dac_bits, console, pil or None)
