"""`studies bench`: speed and memory on this machine.

In: a kind of work. Out: figures by name. `run` is the one call for everything.

- `works`: runs of this program.
- `gradients`: derivatives of such runs.
"""
