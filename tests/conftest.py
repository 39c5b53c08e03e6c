"""Float64, one CPU device per core and the compilation cache for every test.

Tests compile much and run little, so the code generators of XLA and of the kernels leave their
optimisations out here: the same programs, compiled in a third of the time.
"""

import os
from pathlib import Path

import jaxlib
import pytest

from studies import config
from studies.engine.programs import drop_programs

FLAGS = "--xla_backend_optimization_level=0"
# without the threshold for small loops, which takes a sixth of the time to compile
FLAGS += " --xla_backend_extra_options=xla_cpu_use_multi_output_fusion"
# nor passes over loops, nor modules split for threads that have no processor: another sixth
FLAGS += " --xla_cpu_parallel_codegen_split_count=1 --xla_disable_hlo_passes="
FLAGS += "simplify-while-loops,while-loop-invariant-code-motion,while-loop-constant-sinking"
if jaxlib.__version__.startswith("0.10."):  # unknown flags stop XLA
    FLAGS += " --xla_cpu_use_fusion_emitters=false"
os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"
config.configure()
# tests patch modules, which kept programs would not notice
config.keep_programs = lambda: None
# tables as wide as they need to be, wherever the tests run
os.environ["COLUMNS"] = "240"

#: Files that take longest, begun first so that the workers end together: the longest of all first.
HEAVY = (
    "fit",
    "poles",
    "contracts",
    "margins",
    "cluster",
    "state_space",
    "sweeps",
    "equations",
    "static",
    "axial",
    "screen",
    "sampled_loop",
    "batched",
    "tuning",
    "spillover",
    "export",
    "atlas",
    "sweep_commands",
    "examples",
    "machines",
    "observers",
    "onset",
    "kernel",
    "cli",
    "automation",
    "documents",
    "paper",
    "docs",
    "dynamics",
    "notebooks",
    "fit_verdicts",
    "tuning_references",
    "integrator",
    "tuning_spec",
    "electronics",
    "gradients",
    "batch",
    "way_of_a_gain",
    "exit_codes",
    "metrics",
)


#: Limit of a long campaign [s]; that of every other test stands in pyproject.toml.
LONG = 600


def pytest_collection_modifyitems(items):
    """Heavy files first, otherwise as collected; more time for long campaigns."""
    for item in items:
        if item.get_closest_marker("long") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(LONG))
    place = {f"test_{name}.py": k for k, name in enumerate(HEAVY)}
    items.sort(key=lambda item: place.get(Path(item.fspath).name, len(HEAVY)))


def pytest_runtest_teardown(item, nextitem):
    """Drop compiled programs between files before they become too many."""
    if nextitem is not None and nextitem.fspath != item.fspath:
        drop_programs()


@pytest.fixture(scope="session", autouse=True)
def readable_figures():
    """Asserts that the text of every figure that any test writes can be read on its page."""
    from matplotlib.figure import Figure

    from tests.pages import READABLE, smallest_text

    plain = Figure.savefig

    def checked(figure, *args, **options):
        plain(figure, *args, **options)
        size, text = smallest_text(figure)
        assert options.get("format") != "png" or size >= READABLE, f"{text!r}: {size:.1f} px"

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", checked)
        yield
