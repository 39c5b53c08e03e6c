"""Fits: parameters of a study from measurements, with their uncertainty.

In: a study with `[fit]`. Out: values with intervals, what is not identifiable, machines that the
data leave possible, and the next experiment.

- Problem: `spec` reads the file, `tables` the files of its data; `records` and `decays` make
  responses and modes of raw records; `entries` makes measurements, `measurements` all of a file;
  `kinds` are the kinds of measurements, `bench` is the linear machine they are predicted with.
- Answer: `problem` stacks the residuals, `solve` finds the least by multi-start, `statistics`,
  `profiles` and `posterior` say what is known, `draw` draws machines, `experiment` says what to
  measure next.
- `estimate` leads through all of these, `run` writes the folder, `report` and `plots` present it,
  `verb` is `studies.fit`.

To add a kind of measurement, see `kinds`.
"""
