"""`studies compare`: which controller? Every law and every drive, tuned to one budget and compared.

`candidates` says what is compared, `tuning` tunes each on the design's own machine, `judging` runs
all on machines and moves that none was tuned on, `ranking` says which differ, `report` tells it.
"""
