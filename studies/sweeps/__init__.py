"""Thousands of cases from one file.

A sweep goes one way: `spec` reads the file; `axes` and `designs` spread its axes into a `table` of
cases; `plan` groups them by program and cuts them into chunks; `program` is what comes before and
after the steps; `executor` runs chunks, by `scan` or by `kernels` (whose `steps` are traced), and
`gradients` differentiates them; `folder` keeps each finished chunk, whatever happens, and joins
them; `run` drives all this; `results` reads it again for `show`, `plots` and `sensitivity`.
"""
