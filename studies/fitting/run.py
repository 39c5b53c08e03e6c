"""From the file of a fit to the folder with its answer."""

from __future__ import annotations

import json

from studies.engine.folder import FIT
from studies.engine.run_data import run_attributes
from studies.fitting import plots
from studies.fitting.document import fit_document, fit_variables
from studies.fitting.estimate import Fitted, estimate, suggest
from studies.fitting.spec import FitSpec
from studies.fitting.statistics import REGION
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import page, write_report
from studies.store import write_store
from studies.study.template import study_template
from studies.threads import serial_blas

#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.fitting.estimate",)
#: Least gain margin of that tuning [1].
MARGIN = 2.0
#: Comment in that file.
UNEXPLAINED = (
    "# THE MODEL DOES NOT EXPLAIN THE DATA: these machines are too much alike (see report).\n"
)
#: Files of the folder.
STUDY, TUNE, DATA, DOCUMENT = "fitted.toml", "fitted_tune.toml", FIT, "fit.json"


def fitted_into(spec: FitSpec, job: Job, has_pdf: bool = False) -> Fitted:
    """Fit, and write the answer if the job has a folder.

    Args:
        spec: from `load_fit`.
        job: with `fit_phases`.
        has_pdf: also write the figures as PDF.

    Raises:
        StudyError: as `studies.fit`.
    """
    # many small matrices: two threads of BLAS take 1.6 times as long
    with serial_blas():
        fitted = estimate(spec, job)
        if job.folder is None:
            return suggest(fitted, job)
        out = job.folder
        job.begin("draw")
        images = [f"{x}.{kind}" for x in plots.NAMES for kind in ("png", "pdf")]
        with publish(out, [DOCUMENT, *images]) as staging:
            (staging / STUDY).write_text(study_template(fitted.study), encoding="utf-8")
            (staging / TUNE).write_text(_tuning(fitted), encoding="utf-8")
            write_store(staging / DATA, fit_variables(fitted), run_attributes(fitted.study))
            write_report(fitted.report(), staging, has_pdf)
        fitted = suggest(fitted, job)
        with publish(out) as staging:  # only now is there a document: the answer is complete
            (staging / REPORT).write_text(page(fitted.report(), out), encoding="utf-8")
            (staging / DOCUMENT).write_text(json_text(fit_document(fitted)), encoding="utf-8")
    return in_folder(fitted, out, out / REPORT)


def machines(fitted: Fitted) -> dict[str, list[float]]:
    """Machines as the data leave them possible: by parameter, its value on each of them."""
    return {
        name: [float(f"{x:.9g}") for x in column]
        for name, column in zip(fitted.names, fitted.machines.T, strict=True)
        if not name.startswith("control.")  # which is free below
    }


def _tuning(fitted: Fitted) -> str:
    """The fitted study with machines like it, ready for `studies tune`."""
    gain = fitted.study.control.gain_factor or 1.0
    rows = "\n".join(f"{json.dumps(k)} = {v}" for k, v in machines(fitted).items())
    is_sampled = fitted.study.control.feedback == "sampled"
    limits = f"[tune.limits]\ngain_margin = {MARGIN}\n" if is_sampled else ""
    return (
        f"{study_template(fitted.study)}\n"
        "# What moves, and how far: change it to what you can decide.\n"
        "[tune]\n"
        "# objective = { residual_rms = 1.0 }   # metric = weight, relative to this study's\n"
        "# starts = 8                           # starting points\n"
        "# iterations = 60                      # evaluations from each\n"
        "[tune.free]\n"
        f'"control.gain_factor" = {{ from = {0.2 * gain:g}, to = {2 * gain:g} }}\n'
        f"{limits}\n"
        "# Machines that the data leave possible: chi square of each is within their region of\n"
        f"# {100 * REGION:g} %, about all equally good optima. The controller\n"
        "# knows link.youngs_modulus of each machine; fit link.stiffness_factor for what it does\n"
        "# not know.\n"
        f"{'' if fitted.answer.is_explained else UNEXPLAINED}"
        "[tune.scenarios]\ncount = 4   # of them to tune on, with the nominal one\n"
        "check = 16  # others to judge the result\n"
        f"[tune.scenarios.machines]\n{rows}\n"
    )
