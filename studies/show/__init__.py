"""Presentation: figures, pages, formatted numbers.

In: results. Out: HTML with figures inside. `pages` fills the `report.html` templates next to the
modules; `units` writes numbers in readable units; `sketch` draws a machine; `figures` defines the
style of all drawings.
"""
