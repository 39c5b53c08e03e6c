"""The step as our own compiled loop, where XLA's would be slow (docs/performance.md).

- `traced`: one sample of the step, as operations on scalars and the arrays they come from; it
  builds on `graph` (from JAX's equations), `fusion` (fewer, better ordered) and `tangents`;
  `routines` keeps functions that are called more than once.
- `cpu`: that loop for this processor, written by `llvm` and `vectors`; needs llvmlite.
- `gpu`: the same loop for GPUs, as PTX.
- `differentiable`: either of them as a JAX function with derivatives, by `adjoint` for the reverse;
  `bridge` makes XLA call this processor's.
"""
