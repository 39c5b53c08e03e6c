"""Shock and Vibration 2016, article 4780181, against the paper of `zhang_2016`: are links coupled?

`machines` draws machines of both kinds, `energies` follows free vibrations of their linear plants
in one batch, `coupling` says how far a controlled link calms the others, `thresholds` and `maps`
where that begins, `confirmation` repeats some machines as whole simulations; `findings` collects
all of it and `card` leads through it.
"""
