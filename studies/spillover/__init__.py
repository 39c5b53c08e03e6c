"""Spillover: a controller on plants with modes it does not know, and a comparison of laws.

- `plants` defines the plants and their linearised loops, `judgement` evaluates their poles,
  `certificate` puts them together: `certify(study)`.
- `laws` are control laws of equal strength, `comparison` judges and runs them:
  `compare_laws(study)`.
- `report`, `plots` and `run` write everything into a folder, `commands` is `studies spillover`.
"""

from typing import TYPE_CHECKING

from studies.lazy import lazily

if TYPE_CHECKING:
    from studies.spillover.certificate import Certificate, certify
    from studies.spillover.comparison import Comparison, compare_laws
    from studies.spillover.plants import Departure, patch_lengths

__all__ = [
    "Certificate",
    "Comparison",
    "Departure",
    "certify",
    "compare_laws",
    "patch_lengths",
]

__getattr__ = lazily(
    __name__,
    {
        "Certificate": "studies.spillover.certificate",
        "Comparison": "studies.spillover.comparison",
        "Departure": "studies.spillover.plants",
        "certify": "studies.spillover.certificate",
        "compare_laws": "studies.spillover.comparison",
        "patch_lengths": "studies.spillover.plants",
    },
)
