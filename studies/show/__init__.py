"""What people see: figures, pages, words for numbers.

In: results. Out: Markdown and HTML with figures inside. `templates` fills the texts that lie beside
the modules as `report.md`; `pages` turns Markdown into a page; `markdown` writes tables and
figures; `units` writes numbers in the scale people use; `sketch` draws a machine; `figures` is the
style of all drawings.
"""
