from .certificate import Certificate, certify
from .comparison import Comparison, compare_laws
from .plants import Departure, patch_lengths

__all__ = [
    "Certificate",
    "Comparison",
    "Departure",
    "certify",
    "compare_laws",
    "patch_lengths",
]
