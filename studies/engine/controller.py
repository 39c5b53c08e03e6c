"""What a real-time controller needs from a study: fixed numbers, or why there are none."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller
from jaxmodel.laws import LAWS, is_modal, n_channels
from jaxmodel.shaper import Taps
from jaxmodel.state_space import StateSpace
from studies.engine.blocks import ModalBlocks, modal_blocks
from studies.engine.channels import ActiveChannels, fold
from studies.engine.preflight import check_machine, preflight
from studies.engine.runs import resolved_study
from studies.errors import StudyError, field_error
from studies.study.cases import as_numpy
from studies.study.spec import Study


class FixedController(NamedTuple):
    """A study and the numbers of its controller, as NumPy arrays in SI units."""

    study: Study  # complete: its ratios are given
    structure: Structure
    case: Case
    controller: Controller
    channels: ActiveChannels | ModalBlocks  # the same as code needs it
    taps: Taps  # shaper on the sample grid, one tap per delay, delays rising
    frequency: np.ndarray  # each channel's velocity estimate is exact there [Hz], (n, C)

    @property
    def n_links(self) -> int:
        return len(self.controller.feedthrough)

    @property
    def n_patches(self) -> int:
        return int(self.controller.feedthrough.shape[1])

    @property
    def is_modal(self) -> bool:
        """Whether channels are modes, in metres and newtons; volts otherwise."""
        return is_modal(self.structure)


def fixed_controller(study: Study) -> FixedController:
    """Numbers of a study's controller.

    Args:
        study: with sampled feedback; ratios from its own run are computed here.

    Raises:
        StudyError: nothing to export, or the study cannot run.
    """
    _check_exportable(study)
    study = resolved_study(study)
    structure, case = check_machine(study)
    prepared = preflight(structure, case)
    controller, taps = prepared.controller, prepared.taps
    if not controller.feedback.has_output:
        raise field_error(
            "control.gain_factor",
            study.control.gain_factor,
            "gains of which at least one is not zero (control.links, control.mode_mask, "
            "control.velocity_gain, control.ratios, control.damping, control.pole_decay)",
            "1",
        )
    _check_finite(controller, taps)
    return FixedController(
        study=study,
        structure=structure,
        case=as_numpy(case),
        controller=controller,
        channels=arrange(controller, study.control.law),
        taps=_merge_taps(taps),
        frequency=_frequencies(structure, prepared.believed_omega),
    )


def check_codable(study: Study) -> None:
    """Raise StudyError for a controller that `studies export` has no code for."""
    hertz = study.control.notch_hz
    if any(hertz):
        raise field_error("control.notch_hz", hertz, "0, since exports have no notch filters", "Hz")


def _check_exportable(study: Study) -> None:
    control, electronics = study.control, study.electronics
    step = electronics.adc_step
    if not step < electronics.conditioner_bias < electronics.adc_range - 2 * step:
        raise field_error(
            "electronics.conditioner_bias",
            electronics.conditioner_bias,
            f"inside the ADC's range, {step:.4g} to {electronics.adc_range - 2 * step:.4g}: a "
            "sensor at rest at an end of it is taken for a broken one",
            "V",
        )
    if control.feedback != "sampled":
        raise field_error(
            "control.feedback", control.feedback, "'sampled', a controller that samples"
        )
    if not any(control.links):
        raise field_error("control.links", control.links, "at least one link that is controlled")


def arrange(controller: Controller, law: str) -> ActiveChannels | ModalBlocks:
    """A controller as code needs it."""
    if isinstance(controller.feedback, StateSpace):
        return modal_blocks(controller.feedback, len(controller.feedthrough))
    return fold(controller.feedback, LAWS[law].channel)


def _frequencies(structure: Structure, believed_omega: np.ndarray) -> np.ndarray:
    """Where the velocity estimate of each channel is exact [Hz], (n, C)."""
    hertz = believed_omega / (2 * np.pi)
    return hertz if is_modal(structure) else np.repeat(hertz[:, :1], n_channels(structure), axis=1)


def _merge_taps(taps: Taps) -> Taps:
    """One tap per delay, none without weight."""
    weight, sample = (np.asarray(x) for x in taps)
    delays = np.unique(sample[weight != 0])
    return Taps(np.array([weight[sample == delay].sum() for delay in delays]), delays.astype(int))


def _check_finite(controller: Controller, taps: Taps) -> None:
    for name, value in {**controller._asdict(), **taps._asdict()}.items():
        for leaf in jax.tree.leaves(value):
            if not np.all(np.isfinite(leaf)):
                raise StudyError(
                    f"{name} of the controller is not finite; allowed: gains, filters and a shaper "
                    "whose numbers are (see `studies simulate`)"
                )
