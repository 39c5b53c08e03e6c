"""Presentation: figures, pages, formatted numbers.

In: results. Out: HTML with figures inside. `pages` fills the `report.html` templates next to the
modules; `units` writes numbers in readable units; `sketch` draws a machine; `figures` defines the
style of all drawings.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
