"""The exported controller on a processor: a project to build, and that processor emulated.

- `boards` is the table of processors.
- `project` makes the files of a project from templates: start-up, linker script, main program.
- `build` compiles it with Arm's compiler and reads sizes and stack from what that leaves behind.
- `emulator` runs the program in QEMU, which answers sample by sample like any other code.
- `on_target` compares it with the code on this machine and counts its instructions.
"""
