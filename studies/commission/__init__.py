"""From measurements to verified firmware, unattended.

In: a file with what was measured, what is wanted and what the controller runs on. Out: a folder
for each stage, as its own command makes it, and one page that says what was found, what was chosen,
how sure that is, and what to measure next if it is not.

- `spec` reads the file; `stages` are fit, tuning, certificate and firmware, each of which adds to
  the `findings`; `machines` judges the chosen controller on every machine that the
  data leave possible.
- `run` goes from one stage to the next, or refuses; `say` presents it, `verb` is
  `studies.commission` and the command.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
