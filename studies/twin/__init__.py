"""The whole loop by somebody else's code: the machine in Exudyn, the exported controller in C.

- In: a design. Out: `TwinResult` (`result`) and its folder; `run` leads from one to the other.
- The machine: `machine` is it as plain numbers, `mesh` its links cut into elements with their
  damping, `chain` its joints at a pose, `multibody` builds it in Exudyn, which only this module
  imports.
- The loop: `plan` is what acts from outside, `electronics` the analogue chain, `law` the compiled
  controller, `reading` the signals, `loop` steps all of it.
- The comparison: `compare` runs both models, `ringing` finds poles in signals, `margin` damping
  and gain margin; `report` and `plots` present them, `verb` is `studies.twin` and the command.

To compare another quantity, add it to `compared` in `report`; another change, to `causes` in
`compare`.
"""
