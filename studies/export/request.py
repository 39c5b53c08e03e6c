"""One export: the request, the checks common to all targets, and the result."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console

from jaxmodel import status
from studies.engine.blocks import ModalBlocks, unfold_blocks
from studies.engine.channels import ActiveChannels, unfold
from studies.engine.controller import FixedController
from studies.engine.stability import LoopFigures, loop_report
from studies.errors import StudyError, field_error
from studies.export.cost import Cost
from studies.export.firmware.boards import Board
from studies.export.firmware.on_target import OnTarget
from studies.export.fixed import FixedPoint, rail_samples
from studies.export.fixed_blocks import FixedBlocks
from studies.export.in_the_loop import LoopRun
from studies.export.verify import Verification, reference_run
from studies.result import Result
from studies.study.labels import describe


class Export(NamedTuple):
    """What to export, and how."""

    exported: FixedController
    name: str
    origin: list[str]
    case_id: str
    compiler: list[str]
    is_verified: bool
    dac_bits: int
    console: Console
    board: Board | None  # processor on which the code is to be emulated


class ExportResult(NamedTuple):
    """The result of an export."""

    files: dict[str, str]
    loop: LoopFigures  # with the exported coefficients
    verified: Verification | None
    fixed: FixedPoint | FixedBlocks | None = None
    cost: Cost | None = None
    on_target: OnTarget | None = None


@dataclass(frozen=True, eq=False)
class Exported(Result):
    """An export."""

    controller: FixedController
    target: str
    files: tuple[Path, ...]  # those written: without the controller if a comparison failed
    result: ExportResult
    origin: list[str]  # where it comes from, in lines

    @property
    def verified(self) -> Verification | None:
        """What was compared; None: nothing was."""
        return self.result.verified

    @property
    def is_good(self) -> bool:
        """Whether everything agreed; not so where nothing was compared."""
        return self.verified is not None and self.verified.is_passed

    @property
    def has_failed(self) -> bool:
        """Whether a comparison failed: then the controller is not written."""
        return self.verified is not None and self.verified.has_failed

    def told(self) -> list[str]:
        return [f"written: {file}" for file in self.files]


def check_loop(
    exported: FixedController, channels: ActiveChannels | ModalBlocks, note: str
) -> LoopFigures:
    """Linearised sampled loop with given coefficients; rejected if unstable."""
    home = np.array(exported.study.motion.waypoints[0], float)
    restore = unfold_blocks if isinstance(channels, ModalBlocks) else unfold
    law = restore(channels, exported.controller)  # type: ignore[arg-type]
    law = jax.tree.map(jnp.asarray, law)
    try:
        # not the case's own controller, so its kind must not cost another compilation
        structure = exported.structure._replace(has_position_gain=False)
        loop = loop_report(structure, exported.case, home, 1, law=law)
    except np.linalg.LinAlgError:
        raise StudyError("the linearised loop is not finite: no controller to export") from None
    if not loop.is_stable:
        factor = exported.study.control.gain_factor
        way = f"at most {0.5 * factor * loop.gain_margin:.3g}, half of what is stable"
        if loop.gain_margin == 0:
            way = "smaller ones do not help either: see studies simulate and docs/theory.md"
        raise field_error(
            "control.gain_factor",
            factor,
            f"gains whose sampled loop is stable{note}: its spectral radius is "
            f"{loop.spectral_radius:.6f}, its gain margin {loop.gain_margin:.3g} ({way})",
            "1",
        )
    return loop


def reference_motion(job: Export) -> LoopRun:
    """The case's motion with the JAX controller; it must finish."""
    exported = job.exported
    job.console.print(f"in the loop: {exported.structure.n_steps} samples for each controller")
    run = reference_run(exported)
    code = int(run.result.status)
    if code not in status.FINISHED:
        raise StudyError(
            f"{exported.study.title}: {describe(code)} at {run.result.bad_time:.4g} s; allowed: a "
            "study that runs to its end (see studies simulate)"
        )
    _check_clipping(exported, run)
    return run


def _check_clipping(exported: FixedController, run: LoopRun) -> None:
    """Reject a motion that the exported code would take for a broken sensor."""
    electronics = exported.study.electronics
    rail = rail_samples(electronics.sample_rate_hz)
    used = np.isin(np.arange(exported.n_links), exported.channels.link)[:, None]
    for end in (0.0, float(exported.controller.adc_top)):
        count = np.cumsum((run.codes == end) & used, axis=0)
        within = count[rail - 1 :].copy()  # of the last `rail` samples
        within[1:] -= count[:-rail]
        held = np.argwhere(within == rail)
        if len(held):
            k, link, patch = held[0] + (rail - 1, 0, 0)
            raise field_error(
                "electronics.conditioner_gain",
                electronics.conditioner_gain,
                f"so small that the motion does not hold sensor {patch + 1} of link {link + 1} "
                f"at an end of the ADC's range for {1e3 * rail / electronics.sample_rate_hz:g} "
                f"ms, as until t = {k / electronics.sample_rate_hz:.4g} s: that is taken for a "
                "broken sensor (see electronics.conditioner_bias, too)",
                "1",
            )
