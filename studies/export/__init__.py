"""From a DESIGN to a verified real-time controller.

- What is exported: a fixed controller (`studies.engine.controller`), arranged as code needs it
  (`channels` there); `document` is its JSON file.
- Code: `floating` is the arithmetic in NumPy; `fixed` finds formats, integer coefficients and
  error bounds, `integers` is their arithmetic, `cost` its cost; `c_floating` and `c_fixed` gather
  the values of the C99 templates, which `c_text` fills.
- Verification: `compiler` makes the code callable, `in_the_loop` runs it with the plant,
  `sequences` are inputs that no plant would produce, `verify` compares, `say` tells.
- Processor: `firmware` makes a project of the code, builds it and runs it on an emulated one.
- `targets` is the table of output formats, each made from a `request`; `run` leads from the design
  to the files.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
