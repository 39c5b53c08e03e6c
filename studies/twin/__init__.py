"""The whole loop by somebody else's code: the machine in Exudyn, the exported controller in C.

- `machine` is the study's machine as plain numbers, `mesh` its links cut into elements with their
  damping, `multibody` the machine in Exudyn, the only module that needs it.
"""
