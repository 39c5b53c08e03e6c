"""Parameter studies of a flexible 3-PRR manipulator: files, batches, command line."""

from typing import TYPE_CHECKING

from studies.lazy import lazily

__version__ = "0.1.0"

if TYPE_CHECKING:
    from studies.atlas.run import run_atlas
    from studies.bench.run import run_bench
    from studies.config import configure, info
    from studies.engine.batched import batched
    from studies.engine.design import load_design
    from studies.engine.modes import machine_modes
    from studies.engine.results import load
    from studies.engine.run_data import chord_deflection
    from studies.engine.runs import Run, run_study
    from studies.engine.sweep import make_plan, run_sweep
    from studies.errors import StudyError
    from studies.export.document import import_study
    from studies.export.run import export_design
    from studies.extensions import extend
    from studies.fitting.estimate import fit
    from studies.fitting.run import run_fit
    from studies.fitting.spec import load_fit
    from studies.paper.run import run_paper
    from studies.single.run import replay, simulate
    from studies.space.spec import load_sweep, parse_sweep
    from studies.spillover.run import spillover_design
    from studies.study.cases import as_arrays, build_case, build_structure
    from studies.study.spec import Study, load_study, paper_study, parse_study
    from studies.study.template import write_study
    from studies.sweeps.plots import plot
    from studies.sweeps.report import write_sweep_report
    from studies.sweeps.sensitivity import analyse
    from studies.sweeps.show import best_cases, status_rows
    from studies.tuning.audit import audit
    from studies.tuning.run import run_tuning
    from studies.tuning.spec import load_tuning

__all__ = [
    "Run",
    "Study",
    "StudyError",
    "__version__",
    "analyse",
    "as_arrays",
    "audit",
    "batched",
    "best_cases",
    "build_case",
    "build_structure",
    "chord_deflection",
    "configure",
    "export_design",
    "extend",
    "fit",
    "import_study",
    "info",
    "load",
    "load_design",
    "load_fit",
    "load_study",
    "load_sweep",
    "load_tuning",
    "machine_modes",
    "make_plan",
    "paper_study",
    "parse_study",
    "parse_sweep",
    "plot",
    "replay",
    "run_atlas",
    "run_bench",
    "run_fit",
    "run_paper",
    "run_study",
    "run_sweep",
    "run_tuning",
    "simulate",
    "spillover_design",
    "status_rows",
    "write_study",
    "write_sweep_report",
]

__getattr__ = lazily(
    __name__,
    {
        "Run": "studies.engine.runs",
        "Study": "studies.study.spec",
        "StudyError": "studies.errors",
        "analyse": "studies.sweeps.sensitivity",
        "as_arrays": "studies.study.cases",
        "audit": "studies.tuning.audit",
        "batched": "studies.engine.batched",
        "best_cases": "studies.sweeps.show",
        "build_case": "studies.study.cases",
        "build_structure": "studies.study.cases",
        "chord_deflection": "studies.engine.run_data",
        "configure": "studies.config",
        "export_design": "studies.export.run",
        "extend": "studies.extensions",
        "fit": "studies.fitting.estimate",
        "import_study": "studies.export.document",
        "info": "studies.config",
        "load": "studies.engine.results",
        "load_design": "studies.engine.design",
        "load_fit": "studies.fitting.spec",
        "load_study": "studies.study.spec",
        "load_sweep": "studies.space.spec",
        "load_tuning": "studies.tuning.spec",
        "machine_modes": "studies.engine.modes",
        "make_plan": "studies.engine.sweep",
        "paper_study": "studies.study.spec",
        "parse_study": "studies.study.spec",
        "parse_sweep": "studies.space.spec",
        "plot": "studies.sweeps.plots",
        "replay": "studies.single.run",
        "run_atlas": "studies.atlas.run",
        "run_bench": "studies.bench.run",
        "run_fit": "studies.fitting.run",
        "run_paper": "studies.paper.run",
        "run_study": "studies.engine.runs",
        "run_sweep": "studies.engine.sweep",
        "run_tuning": "studies.tuning.run",
        "simulate": "studies.single.run",
        "spillover_design": "studies.spillover.run",
        "status_rows": "studies.sweeps.show",
        "write_study": "studies.study.template",
        "write_sweep_report": "studies.sweeps.report",
    },
)
