"""`studies bench`: how fast and how large, on this machine.

In: a kind of work. Out: figures by name. `run` is the one call for all of it.

- `works`: runs and sweeps of this program.
- `gradients`: derivatives of such runs.
- `peers`: one of the runs by other means, with `reference.py` (plain equations) and `w0.c`.
"""
