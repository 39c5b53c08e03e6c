"""`studies simulate`, `replay` and `modes`: one study in full detail.

In: a study, or a case of a sweep. Out: a `Run` with trajectories, its file and its report. `run`
has one call per command, `report` and its template write the report, `commands` is the command
line.
"""
