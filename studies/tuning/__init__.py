"""Tuning by gradient: free numbers of a study, moved until an objective is as small as it gets.

`spec` reads the file; `free` puts free numbers into cases; `evaluate` runs designs under all
scenarios and differentiates their objective and limits; `optimise` moves many starts downhill;
`check` runs the result on fresh scenarios with the real converters; `audit` compares derivatives
with differences; `run` keeps all this in a folder, and `report` tells of it.
"""
