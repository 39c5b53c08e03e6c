"""`studies bench`: how fast and how large, on this machine.

- `works`: runs and sweeps of this program.
- `gradients`: derivatives of such runs.
- `peers`: one of the runs by other means, with `reference.py` (plain equations) and `w0.c`.
"""
