"""The verb `compare`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from studies.cluster.connect import TIMEOUT, Place
from studies.verbs import verb

if TYPE_CHECKING:
    from studies.laws.findings import LawFindings
    from studies.study.spec import Study


@verb
def compare(
    what: Study | str | Path,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    voltage: float | None = None,
    margin: float = 0.4,
    workers: Place = None,
    worker_timeout: float = TIMEOUT,
    resume: bool = False,
    progress: bool = True,
) -> LawFindings:
    """Compare control laws and drives, each tuned to one budget, on machines they never saw.

    Takes about 20 minutes on two cores.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: folder for the results.
        case: case of a sweep (number or id:...) or family of a tuning.
        voltage: largest actuator voltage [V]; default: what the design needs in its motion.
        margin: least disk margin [1].
        workers: number of processes on this machine, a Dask scheduler's tcp://HOST:PORT, or its
            file; default: this process.
        worker_timeout: restart workers silent for so long [s].
        resume: go on with what is in the folder, if anything.
        progress: show how far it is.

    Returns:
        All controllers, tuned and judged, and their rankings.

    Raises:
        StudyError: a fault of the design, a limit or the folder; no candidate can be tuned.

    Example:
        >>> compare("paper", "laws").report()  # doctest: +SKIP
    """
    from studies.engine.design import as_design
    from studies.job import CHECKED, checked_out, make_request, working
    from studies.laws.run import DECISIVE, PHASES, compared, prepared
    from studies.results.labelled import document

    out = checked_out(out)
    study, budget = prepared(as_design(what, case).study, voltage, margin)
    asked = document(budget)
    request = make_request(study.model_dump(mode="json"), DECISIVE) | asked
    checked = CHECKED | {"spec": "design"} | dict.fromkeys(asked, "budget")
    with working("compare", out, request, PHASES, resume, progress, checked) as job:
        return compared(study, budget, job, workers, worker_timeout)
