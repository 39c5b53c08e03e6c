"""Sweeps and tunings on the workers of a Dask cluster (extra `cluster`).

`connect` joins a scheduler, or starts workers on this machine, and refuses workers with other
versions; `runner` hands out the chunks of a sweep and sees them home, whatever happens to the
workers; `worker` is what runs there: functions of what they are given, that need no files;
`studies.tuning.workers` does the same for the designs of a tuning. Only the client writes
results.
"""
