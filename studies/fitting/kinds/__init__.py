"""Kinds of measurements, a file each: its entry, how that becomes data, and what predicts them.

`contract` says what a kind does, `entry` what all entries have: `modes`, `decay`, `response` and
`spectrum` on the linear machine, `trace` and `settling` on its recorded motion, `figures` on
`runs`. To add one, write such a file and name its entry in `studies.fitting.spec`.
"""
