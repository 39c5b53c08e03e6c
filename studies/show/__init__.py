"""What people see: figures, pages, words for numbers.

In: results. Out: Markdown and HTML with figures inside. `figures` is the style of all drawings,
`pages` turns Markdown into a page, `units` writes numbers in the scale people use, `sketch` draws a
machine; `run_report` is the report of one run.
"""
