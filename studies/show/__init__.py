"""Presentation: figures, pages, formatted numbers.

In: results. Out: Markdown and HTML with figures inside. `templates` fills the `report.md` texts
next to the modules; `pages` turns Markdown into a page; `markdown` writes tables and figures;
`units` writes numbers in readable units; `sketch` draws a machine; `figures` defines the style of
all drawings.
"""
