"""V. Gupta, M. Sharma and N. Thakur (2010): six criteria for the places of piezo patches.

`criteria` evaluates them on a link, `closed_loop` what a controller makes of each place; `findings`
compares both and `card` leads through it.
"""
