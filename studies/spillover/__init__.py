"""Spillover: a controller on plants with modes it does not know.

- `plants` defines the plants and their linearised loops, `certificate` judges them:
  `certify(study)`; `proofs` is about what lies between and beyond them.
- `fast_move` runs the nominal machine with and without the controller.
- `report`, `plots` and `run` write everything into a folder, `verb` is `studies.certify`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
