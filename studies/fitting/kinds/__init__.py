"""Kinds of measurements: how the model predicts them, with derivatives by the parameters.

`contract` says what a kind does: `modes`, `response` and spectra on the linear machine, `runs` for
signals and figures of whole motions. To add one, write a class with `residual` here, its fields in
`studies.fitting.spec`, and make it in `studies.fitting.entries`.
"""
