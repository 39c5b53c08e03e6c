"""Thousands of cases from one file.

A sweep goes one way: `spec` reads the file; `axes` and `designs` spread its axes into a `table` of
cases; `plan` groups them by program and cuts them into chunks; `executor` compiles a program and
runs its chunks; `folder` keeps each finished chunk, whatever happens, and joins them; `run` drives
all this; `results` reads it again for `show`, `plots` and `sensitivity`.
"""
