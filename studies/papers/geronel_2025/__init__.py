"""R. S. Geronel et al. (2025): strain gauges in place of piezo sensors on a 3-RRR.

`comparison` runs both sensors over noise and link frequency; `card` leads through it.
"""
