from .atlas.verb import atlas
from .commission.verb import commission
from .config import configure, info
from .engine.batched import batched
from .errors import StudyError
from .explore import explore
from .export.verb import export
from .extensions import extend
from .fitting.verb import fit
from .laws.verb import compare
from .loading import load
from .papers.verb import paper
from .single.verb import modes, plant, simulate
from .spillover.verb import certify
from .study.spec import Study
from .study.template import write_study
from .sweeps.verb import sweep
from .tuning.verb import tune
from .twin.verb import twin
from .verify.verb import verify

__all__ = [
    "Study",
    "StudyError",
    "__version__",
    "atlas",
    "batched",
    "certify",
    "commission",
    "compare",
    "configure",
    "explore",
    "export",
    "extend",
    "fit",
    "info",
    "load",
    "modes",
    "paper",
    "plant",
    "simulate",
    "sweep",
    "tune",
    "twin",
    "verify",
    "write_study",
]

__version__: str
