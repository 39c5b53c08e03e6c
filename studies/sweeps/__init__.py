"""Presentation of a sweep's folder: tables, figures, a report.

`show` makes tables, `plots` figures, `sensitivity` finds what matters and what failures depend on,
`screening` how well a screen ranked, `dry_run` what a sweep would take, `report` combines them;
`commands` is the command line. The sweep itself is run by `studies.engine`, from the cases of
`studies.space`.
"""
