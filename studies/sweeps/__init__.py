"""A sweep, and what its folder shows: tables, figures, a report.

`run` runs what is left of the cases of `studies.space`, chunk by chunk, by `studies.engine`; with
`keep`, those that `studies.screen` finds. `show` makes tables, `plots` figures, `sensitivity` finds
what matters and what failures depend on, `dry_run` what a sweep would take, `say` tells it all, and
`screened` what was found among all designs; `verb` is `studies.sweep`,
`commands` reads sweeps: `studies show`, `best`, `plot`, `sensitivity`.
"""
