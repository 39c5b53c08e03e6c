from .atlas.run import run_atlas
from .bench.run import run_bench
from .cache import cache_contents
from .commission.run import run_commission
from .commission.spec import load_measured
from .config import configure, info
from .documents import schema
from .engine.batched import batched
from .engine.dataset import load
from .engine.design import load_design
from .engine.modes import machine_modes
from .engine.run_data import chord_deflection
from .engine.runs import Run, run_study
from .errors import StudyError
from .explore import explore_results
from .export.document import import_study
from .export.run import export_design
from .extensions import extend
from .fitting.estimate import fit
from .fitting.run import run_fit
from .fitting.spec import load_fit
from .laws.run import run_laws
from .papers.run import run_paper
from .screen.run import run_screen
from .screen.shards import screen_of
from .single.plant import controller_of, plant_of, write_system
from .single.run import replay, simulate
from .space.spec import load_sweep, parse_sweep
from .spillover.run import spillover_design
from .study.cases import as_arrays, build_case, build_structure
from .study.spec import Study, load_study, paper_study, parse_study
from .study.template import write_study
from .sweeps.plots import plot
from .sweeps.run import make_plan, run_sweep
from .sweeps.say import write_sweep_report
from .sweeps.sensitivity import analyse
from .sweeps.show import best_cases, table
from .tuning.audit import audit
from .tuning.run import run_tuning
from .tuning.spec import load_tuning, parse_tuning
from .twin.run import twin_design
from .verify.run import verify_study

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
    "cache_contents",
    "chord_deflection",
    "configure",
    "controller_of",
    "explore_results",
    "export_design",
    "extend",
    "fit",
    "import_study",
    "info",
    "load",
    "load_design",
    "load_fit",
    "load_measured",
    "load_study",
    "load_sweep",
    "load_tuning",
    "machine_modes",
    "make_plan",
    "paper_study",
    "parse_study",
    "parse_sweep",
    "parse_tuning",
    "plant_of",
    "plot",
    "replay",
    "run_atlas",
    "run_bench",
    "run_commission",
    "run_fit",
    "run_laws",
    "run_paper",
    "run_screen",
    "run_study",
    "run_sweep",
    "run_tuning",
    "schema",
    "screen_of",
    "simulate",
    "spillover_design",
    "table",
    "twin_design",
    "verify_study",
    "write_study",
    "write_sweep_report",
    "write_system",
]

__version__: str
