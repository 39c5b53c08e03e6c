"""How the links of one machine couple, and which links benefit when one is controlled.

`subsets` runs every subset of controlled links and modes through the sweep engine, and
`attribution` turns their residuals into effects, interactions and Shapley shares. `workspace`
computes natural modes on a grid of poses, `platform` splits the platform's error and computes
frequency responses. `claims` checks the paper's statements against these results. `findings`
collects everything; `plots`, `drawing` and `figures` show it, `say` tells it, and `run` writes it;
`verb` is `studies.atlas`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
