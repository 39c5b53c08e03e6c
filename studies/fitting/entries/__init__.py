"""From an entry of `[[fit.data]]` to a measurement with its data.

`common` reads columns, signals and noise; `linear` makes what is measured on the linear machine,
`motions` what whole motions show.
"""
