"""From a DESIGN to a real-time controller, with proof.

- What there is to export: `controller` takes the fixed numbers out of a study, or says why not;
  `document` is their JSON file; `channels` orders them as code wants them.
- Code: `floating` and `fixed` are the arithmetic of both targets in NumPy, with the formats and
  error bounds of fixed point; `c_code` writes C99 from them into the templates beside it.
- Proof: `compiler` makes the code callable, `in_the_loop` runs it with the plant, `sequences` are
  inputs that no plant would make, `verify` compares, `report` tells.
- `run` leads from the design to the files.
"""
