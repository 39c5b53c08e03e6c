"""What `studies sweep` shows of a sweep's folder: tables, figures, a report.

`show` makes tables, `plots` figures, `sensitivity` says what matters and what failures depend
on, `dry_run` what a sweep would take, `report` puts it together; `commands` is the command
line. The sweep itself is run by `studies.engine`, from the cases of `studies.space`.
"""
