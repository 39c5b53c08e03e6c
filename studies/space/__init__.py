"""Design spaces: from `[sweep]` in a file to a table of cases.

In: a study with `[sweep]`. Out: a `Table` with one row a case, its id and its seed.

`spec` reads the file, `axes` parses one axis, `methods` defines how axes become points and what can
be analysed afterwards (`indices` computes it), `designs` expands blocks of axes, `condition` reads
expressions on fields and metrics, `table` puts everything together. To add a method, add a `Method`
to the list in `methods`.
"""
