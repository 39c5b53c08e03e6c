"""The baseline of a sweep without control, in its folder (`baseline.h5`), beside one ADC step."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np

from jaxmodel import status
from studies.engine.columns import axis_variables
from studies.engine.folder import BASELINE
from studies.engine.frame import frame_of
from studies.engine.results import (
    DIGEST,
    baseline_digest,
    baseline_id,
    controlled,
    read_baseline,
)
from studies.engine.run_data import metric_variables, run_attributes
from studies.engine.runs import run_uncontrolled
from studies.engine.stored import kept_metrics
from studies.errors import StudyError
from studies.results.labelled import Variable
from studies.space.spec import SweepSpec
from studies.space.table import CaseTable
from studies.store import axis_sizes, write_store
from studies.study.labels import STATUS_LABEL


def keep_baseline(
    spec: SweepSpec, table: CaseTable, folder: Path, say: Callable[[str], None]
) -> None:
    """Run the baseline of a sweep without control, unless its folder has that run.

    Args:
        spec: the sweep.
        table: its cases; if none is controlled, there is nothing to compare them with.
        folder: of the sweep.
        say: called before the run, and with the reason if there can be none.

    Raises:
        StudyError: the file cannot be written.
    """
    is_sampled = bool((table.values("control.feedback") == "sampled").any())
    if not controlled(table).any() or _is_stored(folder, spec, is_sampled):
        return
    say("running the baseline without control")
    try:
        run = run_uncontrolled(spec.study, is_linear=spec.sweep.fidelity == "linear")
    except StudyError as error:
        say(f"the baseline cannot run without control: {error}")
        return
    variables = {"status": Variable(np.array(run.status), (), *STATUS_LABEL)}
    if is_sampled:
        step = frame_of(run.structure, run.case).adc_step
        text = "one ADC step, in the deflection of mode 1"
        variables["adc_step"] = Variable(step, ("link",), "m", text)
    if run.status in status.FINISHED:
        metrics = metric_variables(run.result)
        variables |= {name: metrics[name] for name in kept_metrics(spec)}
    variables |= axis_variables(run.study, axis_sizes(variables))
    attributes = run_attributes(run.study) | {"case_id": baseline_id(spec)}
    attributes[DIGEST] = baseline_digest(variables)
    write_store(folder / BASELINE, variables, attributes)


def _is_stored(folder: Path, spec: SweepSpec, is_sampled: bool) -> bool:
    try:
        stored = read_baseline(folder, spec)
        return bool(stored) and ("adc_step" in stored) == is_sampled
    except StudyError:  # damaged
        return False
