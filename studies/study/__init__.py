"""One study: its file, its fields, its arrays.

In: a TOML file or a dictionary. Out: a checked `Study`, and a `Case` of arrays for `jaxmodel`.

- `spec` is the schema, the only place for defaults, `section` what its sections are; `choices` are
  fields chosen from tables, `consistency` faults of more than one field, `explain` all faults in
  words, `template` a file with every field.
- `paths` is the language of field names, with one getter and one setter; `fields` are columns of
  values for many cases, `cases` turns them into arrays, `entries` names metrics and their entries.
- `labels` and `margin` put numbers into words; `printed` holds the paper's printed numbers.

To add a field, add a line in `spec`, and its array in `cases`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
