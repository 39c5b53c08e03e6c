"""ModelVerification: every assumption of the model checked on the user's machine, in one table.

- `rows` is the table; `links`, `trajectories`, `outside` (published and
  finite-element figures), `machine` (mechanics), `stepping` (time steps, kernels, metrics) and
  `loops` (margins, exported C) fill it, each one way of checking: a function of a study.
- `run` puts them together, `say` presents them; `passport` keeps the outcome for later reports;
  `verb` is `studies.verify` and the command.

docs/theory.md, section 11, gives the reason for each limit.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
