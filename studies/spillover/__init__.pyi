from . import plots
from .certificate import Certificate, certify
from .comparison import Comparison, compare_laws
from .plants import ModelMismatch, patch_lengths

__all__ = [
    "Certificate",
    "Comparison",
    "ModelMismatch",
    "certify",
    "compare_laws",
    "patch_lengths",
    "plots",
]
