"""Tuning by gradient: minimise an objective over free parameters of a study.

- Problem: `spec` reads the file, `free` puts free parameters into cases, `scenarios` makes the
  machines and moves, `objective` rates a design.
- Descent: `evaluate` runs designs and differentiates them, `linear_fidelity` does the same for
  the linearised loop by `loop_programs`, `descent` steps (L-BFGS, Adam), `optimise` drives all
  starts.
- Results: `check` runs them on fresh machines with the real converters, `loop_figures` judges their
  loops, `audit` compares derivatives with finite differences, `report`, `plots` and `results`
  present them.
- `run` leads from the file to the results, `folder` saves and resumes progress.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
