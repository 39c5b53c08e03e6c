"""`studies paper`: the paper's cases, its figures' counterparts, a report beside its numbers.

`cases` runs them, `measures` reads the runs, `figures` draws, `report` and `tables` write from
what `context` finds; `run` leads through it.
"""
