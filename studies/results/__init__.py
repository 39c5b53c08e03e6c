"""Labelled results: a field says what it is where it is declared.

`labelled` declares fields; the variables of a file, the JSON document and its schema follow from
them. `schema` reads the declarations.
"""
