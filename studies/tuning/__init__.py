"""Tuning by gradient: free numbers of a study, moved until an objective is as small as it gets.

`spec` reads the file; `free` puts free numbers into cases; `evaluate` runs designs under all
scenarios and differentiates their objective and limits; `audit` compares those derivatives with
differences.
"""
