"""A sweep, and what its folder shows: tables, figures, a report.

`run` runs what is left of the cases of `studies.space`, chunk by chunk, by `studies.engine`.
`show` makes tables, `plots` figures, `sensitivity` finds what matters and what failures depend on,
`screening` how well a screen ranked, `dry_run` what a sweep would take, `say` tells it all;
`commands` is the command line.
"""
