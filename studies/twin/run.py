"""From a design to the comparison with its twin, and its folder."""

from __future__ import annotations

from studies.engine.runs import resolved_study
from studies.job import Job
from studies.publish import REPORT, publish
from studies.result import in_folder
from studies.results.document import json_text
from studies.show.pages import write_report
from studies.study.spec import Study
from studies.twin.compare import BothRuns, TwinBench, causes, our_runs, pair
from studies.twin.margin import first_modes, margin_by_growth, ring
from studies.twin.multibody import DEFAULT, Settings, load_exudyn
from studies.twin.result import TwinResult, expected_poles
from studies.twin.say import twin_document

DOCUMENT = "twin.json"
#: What is done, with what it takes on two cores [s].
PHASES = {"ours": 15.0, "theirs": 60.0, "changes": 240.0, "poles": 90.0, "draw": 5.0}
#: Modules that determine the numbers, with everything they import.
DECISIVE = ("studies.twin.compare", "studies.twin.margin")


def compared_with_twin(
    study: Study, job: Job, settings: Settings = DEFAULT, has_changes: bool = True
) -> TwinResult:
    """Repeat a design's loop with Exudyn and the exported controller, and compare.

    Args:
        study: what to repeat.
        job: with `PHASES`.
        settings: resolution of the twin.
        has_changes: also look for what the difference is made of, which takes most of the time.

    Raises:
        StudyError: the study cannot run.
    """
    job.begin("ours")
    study = resolved_study(study)
    bench = TwinBench(study, settings)
    ours = our_runs(study, has_loop=True)
    job.begin("theirs", f"{bench.plan.n_samples * bench.plan.n_steps} steps, twice")

    def run_both() -> BothRuns:
        free, controlled = (pair(run, bench.run(run is ours[0])) for run in ours[::-1])
        return BothRuns(free, controlled)

    runs = job.part("both runs", run_both)
    found = []
    if has_changes:
        job.begin("changes", "stretch, mesh, step, modes and rounding, one at a time")
        found = job.part("changes", lambda: causes(bench, ours, runs))
    job.begin("poles", "damping by decay, gain margin by growth")
    loop = ours[0].loop
    assert loop is not None
    # implicit steps lower the frequencies of modes near the sample rate, whose aliases then fall
    # elsewhere: loops near their margin need smaller steps than motions
    fine = settings._replace(n_steps=2 * bench.plan.n_steps)
    arguments = study, bench.machine, TwinBench(study, fine).plan
    period, expected = bench.plan.electronics.period, expected_poles(loop)
    margin = float(loop.gain_margin)
    result = TwinResult(
        study=study,
        plan=bench.plan,
        settings=settings,
        version=f"Exudyn {load_exudyn().__version__}",
        runs=runs,
        causes=found,
        loop=loop,
        first_modes=job.part(
            "poles", lambda: first_modes(ring(*arguments, 1.0, fine), period, expected)
        ),
        growth=job.part("growth", lambda: margin_by_growth(*arguments, margin, fine)),
    )
    if job.folder is None:
        return result
    job.begin("draw")
    with publish(job.folder) as staging:
        (staging / DOCUMENT).write_text(json_text(twin_document(result)), encoding="utf-8")
        write_report(result.report(), staging)
    return in_folder(result, job.folder, job.folder / REPORT)
