"""The verb `fit`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.fitting.estimate import Fitted
    from studies.fitting.spec import FitSpec


@verb
def fit(
    what: FitSpec | str | Path,
    out: str | Path | None = None,
    *,
    pdf: bool = False,
    resume: bool = False,
    progress: bool = True,
) -> Fitted:
    """Fit parameters of a study to measurements, and say how well they are known.

    Args:
        what: file of a fit (TOML), the name of a ready-made one, or what `load` made of it.
        out: folder for the results.
        pdf: also write the figures as PDF.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        The parameters, how well they are known, and what to measure next.

    Raises:
        StudyError: data that cannot be used, or no starting point that leads to a fit; the folder
            cannot be written to.

    Example:
        >>> fit("paper_measured").study  # doctest: +SKIP
    """
    from studies.fitting.estimate import fit_phases
    from studies.fitting.run import DECISIVE, fitted_into
    from studies.fitting.spec import FitSpec, load_fit
    from studies.job import CHECKED, make_request, working
    from studies.study.files import as_given

    spec = as_given(what, FitSpec, load_fit)
    request = make_request(spec.data, DECISIVE) | {"files": spec.data_files()}
    checked = CHECKED | {"files": "set of data"}
    with working("fit", out, request, fit_phases(spec), resume, progress, checked) as job:
        return fitted_into(spec, job)
