"""Spillover: a controller on plants with modes it does not know, and a comparison of laws.

- `plants` defines the plants and their linearised loops, `certificate` judges them:
  `certify(study)`.
- `laws` are control laws of equal strength, `comparison` judges and runs them:
  `compare_laws(study)`.
- `report`, `plots` and `run` write everything into a folder, `commands` is `studies spillover`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
