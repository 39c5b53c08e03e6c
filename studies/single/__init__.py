"""`studies simulate`, `replay` and `modes`: one study, with everything there is to see of it.

In: a study, or a case of a sweep. Out: a `Run` with trajectories, its file and its report. `run`
has one call for each command, `report` and its template tell, `commands` is the command line.
"""
