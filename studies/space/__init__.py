"""Design spaces: from `[sweep]` in a file to a table of cases.

In: a study with `[sweep]`. Out: a `Table` with one row a case, its id and its seed.

`spec` reads the file, `axes` knows how one axis is written, `methods` how axes become points
and what may be analysed afterwards (`indices` are the sums behind it), `designs` spreads blocks
of axes, `condition` reads expressions on fields and metrics, `table` puts it together. To add a
method, put a `Method` into the list in `methods`.
"""
