"""From a design to the comparison with its twin, and its folder."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from studies.engine.design import Design, as_design
from studies.engine.progress import Phases
from studies.engine.runs import resolved_study
from studies.publish import REPORT, announce, check_folder, publish
from studies.results.document import json_text
from studies.show.pages import write_report
from studies.study.spec import Study
from studies.twin.compare import BothRuns, TwinBench, causes, check_supported, our_runs, pair
from studies.twin.law import check_compiler
from studies.twin.margin import first_modes, margin_by_growth, ring
from studies.twin.multibody import DEFAULT, Settings, load_exudyn
from studies.twin.result import TwinResult, expected_poles
from studies.twin.say import say, twin_document

DOCUMENT = "twin.json"
PHASES = ("ours", "theirs", "changes", "poles", "draw")


def twin_design(
    design: Design | Study | str | Path,
    out: str | Path | None = None,
    console: Console | None = None,
    settings: Settings = DEFAULT,
    has_changes: bool = True,
) -> TwinResult:
    """Repeat a design's loop with Exudyn and the exported controller, and compare.

    Args:
        design: what to repeat; or its study, or what `load_design` reads.
        out: folder for the report, the figure and the numbers; None: nothing is written.
        console: where messages go; default: standard output.
        settings: resolution of the twin.
        has_changes: also look for what the difference is made of, which takes most of the time.

    Raises:
        StudyError: Exudyn or a C compiler is missing, or a study that the twin cannot repeat.
    """
    design = as_design(design)
    exudyn = load_exudyn()
    check_compiler()
    check_supported(design.study)
    console = console or Console(highlight=False, markup=False)
    if out is not None:
        check_folder(out)
    with Phases(console, PHASES, is_quiet=console.quiet) as phases:
        phases.begin("ours")
        study = resolved_study(design.study)
        bench = TwinBench(study, settings)
        ours = our_runs(study, has_loop=True)
        phases.begin("theirs", f"{bench.plan.n_samples * bench.plan.n_steps} steps, twice")
        free, controlled = (pair(run, bench.run(run is ours[0])) for run in ours[::-1])
        runs = BothRuns(free, controlled)
        found = []
        if has_changes:
            phases.begin("changes", "stretch, mesh, step, modes and rounding, one at a time")
            found = causes(bench, ours, runs)
        phases.begin("poles", "damping by decay, gain margin by growth")
        loop = ours[0].loop
        assert loop is not None
        # implicit steps lower the frequencies of modes near the sample rate, whose aliases then
        # fall elsewhere: loops near their margin need smaller steps than motions
        fine = settings._replace(n_steps=2 * bench.plan.n_steps)
        arguments = study, bench.machine, TwinBench(study, fine).plan
        result = TwinResult(
            study=study,
            plan=bench.plan,
            settings=settings,
            version=f"Exudyn {exudyn.__version__}",
            runs=runs,
            causes=found,
            loop=loop,
            first_modes=first_modes(
                ring(*arguments, 1.0, fine),
                bench.plan.electronics.period,
                expected_poles(loop),
            ),
            growth=margin_by_growth(*arguments, float(loop.gain_margin), fine),
        )
        phases.begin("draw")
        if out is not None:
            _write(Path(out), result)
    if out is not None:
        announce(console, Path(out) / REPORT, ", numbers and figure in the same folder")
    return result


def _write(out: Path, result: TwinResult) -> None:
    with publish(out) as staging:
        (staging / DOCUMENT).write_text(json_text(twin_document(result)), encoding="utf-8")
        write_report(say(result), staging)
