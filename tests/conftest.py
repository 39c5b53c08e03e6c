"""Float64, one CPU device per core and the compilation cache for every test.

Tests compile much and run little, so the code generators of XLA and of the kernels leave their
optimisations out here: the same programs, compiled in a third of the time.
"""

import os

import jaxlib

from studies.config import configure

FLAGS = "--xla_backend_optimization_level=0"
if jaxlib.__version__.startswith(
    "0.10."
):  # unknown flags stop XLA, so elsewhere compiling is slower
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"
configure()
# tables as wide as they need to be, wherever the tests run
os.environ["COLUMNS"] = "240"
