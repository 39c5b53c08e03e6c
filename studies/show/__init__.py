"""Presentation: figures, pages, formatted numbers.

In: what a feature's `say` makes of a result (`report`). Out: a page with figures inside, a card for
a notebook (`pages`), text on a console. `units` writes numbers in readable units; `sketch` draws a
machine; `figures` defines the style of all drawings.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
