"""The engine: runs of one study, and of thousands.

In: a `Study`, or a `Table` of cases. Out: metrics and judgements, as arrays or in a folder.

- One study: `runs` checks and runs it, `host_loop` is its linearised loop, `stability`
  judges it, `simplifications` warns of the model's, `modes` are its natural modes,
  `controller` and `channels` its controller as fixed numbers, `frame` and `batches` what a few
  runs share; `design` finds the study in any file or folder.
- Many cases: `plan` groups them by program and cuts them into chunks; `function` is the one way
  to run a block of cases (begin, all steps, conclude) and to differentiate it, `executor` runs
  a chunk's blocks on threads, `batched` hands the function to users. `margins` and `damping`
  judge every loop, by `lanes`. `chunks` runs and judges one chunk.
- Files: `folder` keeps each finished chunk, whatever happens; `columns` defines the contents of
  files, `stored` writes and joins them, `results` reads them. `progress` reports on it,
  and ends it on Ctrl-C.

To add a way of stepping, give it a method of `function.BlockFunction` and a name in `STEPPERS`.
"""
