"""Q. Zhang et al. (2016), the paper that this project follows: its sections 4 and 5.

`cases` runs them, `measures` reads the runs, `figures` draws, `report`, `tables` and `store` write
from what `context` finds; `claims` judges and `card` leads through it.
"""
