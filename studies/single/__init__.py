"""The verbs `simulate`, `modes` and `plant`: one study in full detail.

In: a study, or a case of a sweep. Out: a simulation with trajectories, its file and its report.
`verb` has the verbs, `run` and `plant` do it, `say` and `modes` are what results tell, `plots`
draws.
"""
