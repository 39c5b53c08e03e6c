"""Work on a Dask cluster (extra `cluster`): functions of plain arguments, called on its workers.

`connect` joins a scheduler, or starts workers on this machine, and rejects workers with other
versions; `remote` calls functions there, whatever happens to the workers, which `watch` restarts if
they hang; `runner` does so with the chunks of a sweep. Functions need no files: only the client
writes results.
"""
