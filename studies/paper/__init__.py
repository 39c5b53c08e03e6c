"""`studies paper`: the paper's cases, counterparts of its figures, a comparing report.

`cases` runs them, `measures` reads the runs, `figures` draws, `report` and `tables` write from
what `context` finds; `run` leads through it.
"""
