"""`studies paper`: the paper's cases, its figures' counterparts, a report beside its numbers.

`cases` runs them, `measures` reads the runs, `figures` draws, `context`, `report` and `causes`
write; `run` leads through it.
"""
