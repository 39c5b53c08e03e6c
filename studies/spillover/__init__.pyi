from . import plots
from .certificate import Certificate, certify
from .plants import ModelMismatch, patch_lengths

__all__ = [
    "Certificate",
    "ModelMismatch",
    "certify",
    "patch_lengths",
    "plots",
]
