"""The engine: runs of one study, and of thousands.

In: a `Study`, or a `Table` of cases. Out: metrics and judgements, as arrays or in a folder.

- One study: `runs` checks and runs it, `stability` judges its loop, `modes` are its natural
  modes, `controller` and `channels` its controller as fixed numbers, `frame` and `batches` what
  a few runs share; `design` finds the study in any file or folder.
- Many cases: `plan` groups them by program and cuts them into chunks, `program` is what comes
  before and after the steps, `executor` selects what runs them: `scan` (XLA), or
  `kernel_executor`, whose `steps` are traced; `gradients` differentiates. `margins` and
  `damping` judge every loop, by `lanes`. `chunks` runs and judges one chunk.
- Files: `folder` keeps each finished chunk, whatever happens; `columns` defines the contents of
  files, `stored` writes and joins them, `results` reads them. `sweep` drives all this, `progress`
  reports on it.

To add an executor, give it `start(cases)` as in `program.Executor` and name it in `executor`.
"""
