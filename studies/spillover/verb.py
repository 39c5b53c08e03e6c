"""The verb `certify`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from studies.verbs import verb

if TYPE_CHECKING:
    from studies.spillover.certificate import Certificate
    from studies.study.spec import Study


@verb
def certify(
    what: Study | str | Path,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    margin: float = 2.0,
    prove: bool = False,
    tolerance: Mapping[str, float] | None = None,
    pdf: bool = False,
    resume: bool = False,
    progress: bool = True,
) -> Certificate:
    """Certify a controller on plants that differ from its model.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: folder for the results.
        case: case of a sweep (number or id:...) or family of a tuning.
        margin: gain margin required on every plant [1]; 2 is 6 dB.
        prove: also prove stability for every number of modes and a box of machines; an unstable
            machine of the box fails the design.
        tolerance: NAME=VALUE, one unit of a kind of change that may break a design: stiffness,
            damping, payload, patch, delay, actuator, sensor, joint_inertia; 0: it does not change.
        pdf: also write the figures as PDF.
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        The certificate; `is_good`: whether the design passes on every plant, and proofs found no
        unstable machine.

    Raises:
        StudyError: no sampled controller, an argument out of range, or a folder that cannot be
            written to.

    Example:
        >>> certify("spillover").verdict  # doctest: +SKIP
    """
    from studies.engine.design import as_design
    from studies.engine.runs import resolved_study
    from studies.job import make_request, working
    from studies.space.machines import parse_tolerances
    from studies.spillover.run import DECISIVE, certified, phases

    study = resolved_study(as_design(what, case).study)
    units = parse_tolerances(tolerance)
    asked = {"study": study.model_dump(mode="json"), "margin": margin, "prove": prove}
    request = make_request(asked | {"tolerance": list(units)}, DECISIVE)
    with working("certify", out, request, phases(prove), resume, progress) as job:
        return certified(study, job, margin, pdf, prove, units)
