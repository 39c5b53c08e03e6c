"""`studies simulate`, `replay` and `modes`: one study in full detail.

In: a study, or a case of a sweep. Out: a `Run` with trajectories, its file and its report. `run`
has one call per command, `say` and `modes` are what results tell, `plots` draws, `commands` is the
command line.
"""
