"""The notebooks run from top to bottom and are kept without outputs."""

from pathlib import Path

import nbformat
import pytest
from nbclient import NotebookClient

NOTEBOOKS = sorted((Path(__file__).parent.parent / "notebooks").glob("*.ipynb"))


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= {
        "1_first_run", "3_placement_sweep", "4_gradient_tuning", "6_from_design_to_c",
    }  # fmt: skip


#: Minutes of compiling; in short: the same functions in test_tuning and test_tuning_folder.
LONG = "4_gradient_tuning"


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.long] if path.stem == LONG else [], id=path.stem)
        for path in NOTEBOOKS
    ],
)
def test_notebook_is_stripped_and_runs(path):
    notebook = nbformat.read(path, as_version=4)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert all(cell.execution_count is None and not cell.outputs for cell in code)
    assert "configure()" in code[0].source

    NotebookClient(notebook, timeout=300, kernel_name="python3").execute()

    outputs = [output for cell in code for output in cell.outputs]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert not [output for output in outputs if output.get("name") == "stderr"]
