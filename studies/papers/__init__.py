"""`studies paper`: papers as cards, each a study that tests what its paper claims.

`card` is what a card is, `catalogue` lists them, `run` carries one out; every card is a package.
"""
