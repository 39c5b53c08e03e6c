"""From a DESIGN to a real-time controller, with proof.

- What there is to export: a fixed controller (`studies.engine.controller`), ordered as code
  wants it (`channels` there); `document` is its JSON file.
- Code: `floating` is the arithmetic in NumPy; `fixed` finds formats, integer coefficients and
  error bounds, `integers` is their arithmetic, `cost` what it takes; `c_floating` and `c_fixed`
  gather what the templates of C99 need, which `c_text` fills.
- Proof: `compiler` makes the code callable, `in_the_loop` runs it with the plant, `sequences`
  are inputs that no plant would make, `verify` compares, `report` tells.
- `targets` is the table of what can be written, each of a `job`; `run` leads from the design to
  the files.
"""
