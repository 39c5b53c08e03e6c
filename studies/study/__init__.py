"""One study: its file, its fields, its arrays.

In: a TOML file or a dictionary. Out: a checked `Study`, and a `Case` of arrays for `jaxmodel`.

- `spec` is the schema, the only place of defaults; `choices` are fields chosen from tables,
  `consistency` faults of more than one field, `explain` all faults in words, `template` a file with
  every field.
- `paths` is the language of field names, with one getter and one setter; `fields` are columns of
  values for many cases, `cases` makes arrays of them, `entries` names metrics and their entries.
- `labels` and `margin` are what numbers are called; `printed` is what the paper prints.

To add a field: a line in `spec`, and its place in the arrays in `cases`.
"""
