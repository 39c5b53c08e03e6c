"""Sweeps and tunings on the workers of a Dask cluster (extra `cluster`).

`connect` joins a scheduler, or starts workers on this machine, and rejects workers with other
versions; `runner` distributes the chunks of a sweep and collects them, whatever happens to the
workers; `worker` is the code that runs there: pure functions that need no files;
`studies.tuning.workers` does the same for the designs of a tuning. Only the client writes
results.
"""
