"""The notebooks run from top to bottom and are kept without outputs."""

import ast
import os
from importlib import import_module

import nbformat
import pytest
from nbclient import NotebookClient
from nbformat.v4 import new_code_cell, new_notebook

import studies
from tests import TOP

#: Packages of the project, and how modules in them begin.
OURS, DEEPER = ("jaxmodel", "studies"), ("jaxmodel.", "studies.")

NOTEBOOKS = {path.stem: path for path in sorted((TOP / "notebooks").glob("*.ipynb"))}
#: Much to compile; in short: the same functions in test_sweeps, test_tuning, test_atlas,
#: test_spillover, test_export, test_robust and test_sampled_loop.
LONG = (
    "2_coupling",
    "3_placement_sweep",
    "4_gradient_tuning",
    "5_spillover",
    "6_from_design_to_c",
    "7_python_control",
    "9_gauges_or_piezo",
    "10_placement_criteria",
    "11_are_links_coupled",
    "12_physics_as_a_library",
)
#: Packages of an extra that a notebook needs.
NEEDS = {"7_python_control": ("control", "ctrlsys")}
QUICK = [name for name in NOTEBOOKS if name not in LONG]


def test_there_are_notebooks():
    assert sorted(NOTEBOOKS) == [
        "10_placement_criteria",
        "11_are_links_coupled",
        "12_physics_as_a_library",
        "1_first_run",
        "2_coupling",
        "3_placement_sweep",
        "4_gradient_tuning",
        "5_spillover",
        "6_from_design_to_c",
        "7_python_control",
        "8_other_machines",
        "9_gauges_or_piezo",
    ]


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_is_stripped(name):
    code = code_cells(read(name))
    assert all(cell.execution_count is None and not cell.outputs for cell in code)
    assert "configure()" in code[0].source or "jax_enable_x64" in code[0].source


@pytest.mark.parametrize("name", NOTEBOOKS)
def test_notebook_uses_public_names(name):
    """Of the project, only what a package lists in its `__all__`."""
    private = []
    for cell in code_cells(read(name)):
        lines = (x for x in cell.source.splitlines() if not x.startswith("%"))
        for node in ast.walk(ast.parse("\n".join(lines))):
            if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] in OURS:
                public = getattr(import_module(node.module), "__all__", ())
                private += [f"{node.module}.{x.name}" for x in node.names if x.name not in public]
            elif isinstance(node, ast.Import):
                private += [x.name for x in node.names if x.name.startswith(DEEPER)]
            elif isinstance(node, ast.Attribute) and ast.unparse(node.value) == "studies":
                private += [node.attr] * (node.attr not in studies.__all__)
    assert private == []


@pytest.fixture(scope="module")
def executed():
    """All but the long ones, in one process that forgets its names in between."""
    books = {name: read(name) for name in QUICK}
    cells = []
    for name, book in books.items():
        for k, cell in enumerate(book.cells):
            cell.id = f"{name}-{k}"  # each notebook counts its own
        cells += [new_code_cell("%reset -f"), *book.cells]
    execute(new_notebook(cells=cells))
    return books


@pytest.mark.parametrize("name", QUICK)
def test_notebook_runs(executed, name):
    check_outputs(executed[name])


@pytest.mark.long
@pytest.mark.parametrize("name", LONG)
def test_long_notebook_runs(name):
    for package in NEEDS.get(name, ()):
        pytest.importorskip(package, reason="extra robust: pip install '.[robust]'")
    book = read(name)
    execute(book)
    check_outputs(book)


def read(name):
    return nbformat.read(NOTEBOOKS[name], as_version=4)


def code_cells(book):
    return [cell for cell in book.cells if cell.cell_type == "code"]


def execute(book):
    # on a busy machine, output may come more than the 4 s of the default after the reply
    client = NotebookClient(
        book, timeout=300, iopub_timeout=120, kernel_name="python3", allow_errors=True
    )
    # a command, run by a test in this process, draws into files only, and says so to its children
    client.execute(env={k: x for k, x in os.environ.items() if k != "MPLBACKEND"})


def check_outputs(book):
    """No cell failed or wrote warnings, every one was run, and there is something to see."""
    code = code_cells(book)
    outputs = [output for cell in code for output in cell.outputs]
    failed = [output for output in outputs if output.output_type == "error"]
    assert not failed, "\n".join(failed[0].traceback)
    assert all(cell.execution_count for cell in code)
    shown = [output.get("data", {}) for output in outputs]
    assert any("image/png" in x or "data:image/png" in x.get("text/html", "") for x in shown)
    assert not [output for output in outputs if output.get("name") == "stderr"]
