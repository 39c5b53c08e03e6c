"""Pages to look at many cases in a browser: brushed plots, a table, and the machine in motion.

`table` holds what a page shows, `replays` reruns a few cases for it, `page` writes it. The commands
that have cases fill in the table: sweeps, tunings, fits, the atlas.
"""
