"""The best of up to a billion designs: the first stage of a sweep that keeps some.

Its designs are made shard by shard (`shards`), each shard is reduced to a tally (`tally`): the best
designs, how the others ended, and how the metric is distributed. Tallies of any shards merge, in
any order, whether shards run here (`local`) or on a cluster (`workers`); `run` drives them. One
file holds the tally so far (`stored`), so that it takes no more memory or disk for more designs,
and goes on after any interruption. `selection` chooses the best that have the margin asked for,
which are then an ordinary sweep.
"""
