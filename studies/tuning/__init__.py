"""Tuning by gradient: free numbers of a study, moved until an objective is as small as it gets.

- What is asked: `spec` reads the file, `free` puts free numbers into cases, `scenarios` makes the
  machines and moves, `merit` says what a design is worth.
- The way down: `evaluate` runs designs and differentiates them, `linear_fidelity` does the same
  for the linearised loop, `descent` steps (L-BFGS, Adam), `optimise` leads all starts.
- What came out: `check` runs it on fresh machines with the real converters, `audit` compares
  derivatives with differences, `report`, `plots` and `results` tell.
- `run` leads from the file to the results, `folder` keeps what is done and goes on with it.
"""
