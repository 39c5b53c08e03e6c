"""Float64, one CPU device per core and the compilation cache for every test.

Tests compile much and run little, so XLA's code generator leaves its optimisations out here: the
same programs, compiled in a third of the time.
"""

import os

from studies.config import configure

os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --xla_backend_optimization_level=0"
configure()
# tables as wide as they need to be, wherever the tests run
os.environ["COLUMNS"] = "240"
