"""The documents: references that are whole, links that lead somewhere, code that runs."""

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from importlib import import_module

import numpy as np
import pytest
import typer

import studies
from jaxmodel.drives import DRIVES
from jaxmodel.laws import LAWS
from jaxmodel.metrics import METRICS
from studies.cli import app
from studies.study.explain import written_fields
from studies.study.spec import Section, Study
from studies.tuning.spec import load_tuning
from tests.documents import NOTEBOOKS, PAGES, TOP, blocks, page

SITE = TOP / "docs"
spec = importlib.util.spec_from_file_location("reference", SITE / "_ext" / "reference.py")
reference = importlib.util.module_from_spec(spec)
spec.loader.exec_module(reference)

#: Where the Python blocks of a page run, one after the other, or why they cannot.
HERE, LONG = "here", "here, in a long test"
PYTHON = {
    "README.md": ["test_examples"],
    "docs/index.md": [HERE],
    "docs/how-to/automation.md": ["test_automation"],
    "docs/how-to/cluster.md": ["needs a cluster; test_cluster", "needs Slurm"],
    "docs/how-to/own-controller.md": ["needs python-control"],
    "docs/how-to/own-parts.md": ["test_contracts"] * 5,
    "docs/reference/exploring.md": [LONG],
    "docs/reference/python.md": [HERE, "test_gradients"],
}
COMMAND = typer.main.get_command(app)


def sections(model):
    """Models of sections below this one."""
    return [x for below in model.__subclasses__() for x in (below, *sections(below))]


# references


def test_the_field_reference_has_every_field():
    text = reference.fields_text()
    models = [Study, *sections(Section)]
    assert len(models) > 25
    for model in models:
        for name, info in written_fields(model).items():
            if info.description is None:  # a section in a section
                assert re.search(rf"^### `\[(\w+\.)?{name}\]`$", text, re.MULTILINE), name
            else:
                row = reference.table((), [(f"`{name}`", info.description)])
                assert row.splitlines()[-1].removesuffix(" |") in text, f"{model.__name__}.{name}"
    assert [
        x
        for one in (*LAWS.values(), *DRIVES.values())
        for x in one.parameters
        if f"{one.name}.{x.name}" not in text
    ] == []


def test_the_command_reference_has_every_command():
    text = reference.commands_text()
    assert len(COMMAND.commands) > 15
    for name, command in COMMAND.commands.items():
        (part,) = re.findall(rf"^## studies {name}\n(.*?)(?=^## )", text, re.DOTALL | re.MULTILINE)
        given = [x for x in command.params if x.param_type_name == "option"]
        words = [" / ".join((*x.opts, *x.secondary_opts)) for x in given]
        assert command.help in part and [x for x in words if f"`{x}`" not in part] == []


def test_every_metric_is_listed():
    assert [name for name in METRICS if f"| `{name}` |" not in reference.metrics_text()] == []


def test_every_reference_has_its_place():
    marks = [
        x for path in PAGES for x in re.findall("<!-- generated: (\\w+) -->", path.read_text())
    ]
    assert sorted(marks) == sorted(reference.TEXTS)


@pytest.mark.parametrize("name", ["commands", "fields", "python", "results"])
def test_the_reference_is_current(name):
    text = page(f"docs/reference/{name}.md")
    assert text == reference.filled(text), "run: make reference"


def test_members_are_read_from_their_comments_and_annotations():
    source = (
        'class A(NamedTuple):\n    mass: Num[Array, "n C"] | None  # [kg]\n    other: int\n'
        '    # l [m]\n    length: Num[Array, ""] = 0.0\n    k: int = 1  # x\n'
    )
    found = reference.members_text(source)
    assert found == {"mass": "[kg], (n, C)", "length": "l [m], ()", "k": "x"}


# links

DOCUMENTS = [*PAGES, TOP / "CHANGELOG.md", TOP / "CONTRIBUTING.md", *NOTEBOOKS]


def prose(path):
    """A document without its code."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".ipynb":
        cells = json.loads(text)["cells"]
        text = "\n".join("".join(x["source"]) for x in cells if x["cell_type"] == "markdown")
    return re.sub(r"^ *```.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(path):
    """Anchors of a document's headings, as GitHub and the site name them."""
    heads = re.findall(r"^#+ (.*)$", prose(path), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


def broken(path, text):
    """Relative links of a document that lead nowhere."""
    found = []
    for link in re.findall(r"(?<!`)\]\(([^)\s]+)\)", text):
        target, _, anchor = link.partition("#")
        goal = path.parent / target if target else path
        if "://" in link:
            continue
        if not goal.exists() or (anchor and anchor not in anchors(goal)):
            found.append(link)
    return found


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(TOP)))
def test_links_lead_somewhere(path):
    assert broken(path, prose(path)) == []


def test_broken_links_are_found():
    text = "[a](docs/none.md) [b](docs/theory.md#none) [c](#none) [d](docs/theory.md) [e](#start)"
    found = broken(TOP / "README.md", text)
    assert found == ["docs/none.md", "docs/theory.md#none", "#none"]


def test_documents_that_code_names_exist():
    folders = ("jaxmodel", "studies", "tests", "campaigns", ".ci")
    files = [*DOCUMENTS, *(x for folder in folders for x in (TOP / folder).rglob("*"))]
    texts = {
        x: x.read_text()
        for x in files
        if x.suffix in (".py", ".html", ".toml", ".c", ".h", ".md", ".ipynb")
    }
    named = {
        (x, name) for x, text in texts.items() for name in re.findall(r"docs/[\w/-]+\.md", text)
    }
    assert len(named) > 10
    assert [x for x in named if not (TOP / x[1]).exists()] == []


def found_by(name):
    """What a dotted name stands for, as a session finds it that has imported its package."""
    module, *parts = name.split(".")
    found = importlib.import_module(module)
    for part in parts:
        module += f".{part}"
        found = getattr(found, part) if hasattr(found, part) else importlib.import_module(module)
    return found


@pytest.mark.parametrize("path", PAGES, ids=lambda path: str(path.relative_to(TOP)))
def test_names_in_prose_are_found(path):
    for name in re.findall(r"`((?:jaxmodel|studies)(?:\.[A-Za-z_]\w*)+)", prose(path)):
        assert found_by(name) is not None, name


def test_a_name_that_fails_as_printed_is_not_found():
    with pytest.raises(ImportError):
        found_by("jaxmodel.simulate.simulate")  # jaxmodel.simulate is the function


def test_every_page_is_in_the_contents():
    trees = blocks(page("docs/index.md"), r"\{toctree\}")
    names = [x for tree in trees for x in tree.splitlines() if x and not x.startswith(":")]
    found = {(SITE / f"{name}{end}").resolve() for name in names for end in (".md", ".ipynb")}
    pages = {*DOCUMENTS} - {TOP / "README.md", SITE / "index.md"}
    assert {x for x in found if x.exists()} == pages


# examples


def python_blocks():
    found = {str(x.relative_to(TOP)): blocks(x.read_text(), "python") for x in PAGES}
    return {name: codes for name, codes in found.items() if codes}


def test_it_is_known_of_every_python_block_where_it_runs():
    assert {name: len(codes) for name, codes in python_blocks().items()} == {
        name: len(where) for name, where in PYTHON.items()
    }
    for name, codes in python_blocks().items():
        for code in codes:
            compile(code, name, "exec")


#: One short move, seen for a short time.
SHORT = {
    "run": {"duration": 0.1},
    "link": {"modes": 3},
    "motion": {"waypoints": ((0.0, 0.0, 0.5236), (0.0, 0.01, 0.5236)), "move_time": 0.03},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.03},
}


def swept(axes, folder):
    """Run a sweep of the short move into a folder."""
    studies.sweep(studies.load({**SHORT, "sweep": {"axes": axes}}), folder, progress=False)


def run_block(name, where):
    """Run the blocks of a page for which PYTHON says so."""
    for code, place in zip(python_blocks()[name], PYTHON[name], strict=True):
        if place == where:
            exec(compile(code, name, "exec"), {"studies": studies})


def test_the_code_of_the_start_page_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    studies.simulate(studies.load(SHORT), tmp_path / "run.h5")
    run_block("docs/index.md", HERE)


def test_the_code_about_results_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    swept({"gain": [0.5, 1.0], "drive.kp": [1e4, 2e4]}, "gains")
    run_block("docs/reference/python.md", HERE)


@pytest.mark.long  # compiles two models; in short: the same calls in test_dataset
def test_the_code_about_models_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    axes = {
        "run.model": "all",
        "move_time": [0.03, 0.05],
        "load.mass": [0.0, 0.5],
        "drive.kp": [2e4, 1e5],
    }
    swept(axes, "models")
    run_block("docs/reference/exploring.md", LONG)
    assert capsys.readouterr().out.count("\n") >= 3


def shell_lines():
    """Calls of `studies` in the shell blocks of all documents, with their document."""
    for path in [*PAGES, TOP / "CONTRIBUTING.md"]:
        for block in blocks(path.read_text(encoding="utf-8"), "sh"):
            for line in block.splitlines():
                words = shlex.split(line, comments=True)
                if "studies" in words:
                    yield path, words[words.index("studies") + 1 :]


def test_commands_of_the_documents_exist_with_their_options():
    lines = list(shell_lines())
    assert len(lines) > 25
    for path, words in lines:
        words = words[2:] if words[0] == "--with" else words
        params = COMMAND.commands[words[0]].params
        options = {x for one in params for x in (*one.opts, *one.secondary_opts)}
        used = {x.partition("=")[0] for x in words if x.startswith("--")}
        assert used <= options, (path, words)


def test_ready_made_files_that_documents_name_exist():
    listed = re.findall(r"init \S+ --from (\w+)", "\n".join(map(prose, PAGES)))
    assert {f"{x}.toml" for x in listed} <= {x.name for x in (TOP / "studies/specs").iterdir()}


def test_ready_tunings_are_valid():
    paths = sorted((TOP / "studies/specs").glob("*tune*.toml"))
    assert len(paths) >= 6
    for path in paths:
        assert len(load_tuning(path).free.names) > 1


# the site


@pytest.mark.long
def test_the_site_is_built_without_warnings(tmp_path):
    """Without running the notebooks, which test_notebooks does."""
    pytest.importorskip("myst_nb", reason="needs the extra 'docs'")
    options = ("-q", "-W", "--keep-going", "-n", "-D", "nb_execution_mode=off", "-c", "docs")
    command = [sys.executable, "-m", "sphinx", *options, ".", tmp_path]
    done = subprocess.run(command, cwd=TOP, capture_output=True, text=True, timeout=500)
    assert (done.returncode, done.stderr) == (0, "")
    listed = re.findall(r"\]\((\S+\.html)\)", (tmp_path / "llms.txt").read_text())
    assert len(listed) == len(DOCUMENTS) - 1  # the README is part of the start page
    assert [x for x in listed if not (tmp_path / x).exists()] == []
    assert "docs/index.html" in (tmp_path / "index.html").read_text()
    api = (tmp_path / "docs/reference/api.html").read_text()
    names = [f"studies.{x}" for x in studies.__all__ if x != "__version__"]
    assert [x for x in names if f'id="{x}"' not in api] == []


@pytest.mark.parametrize("name", [name for name in PAGES if "$$" in page(name)])
def test_displayed_formulas_are_paragraphs(name):
    """Inside one, their dollars end as text, and what follows as a formula."""
    parts = re.split(r"\n\s*\n", page(name))
    shown = [part.strip() for part in parts if "$$" in part]
    assert all(part.count("$$") == 2 and part[:2] == part[-2:] == "$$" for part in shown), shown


def test_the_table_of_what_is_left_out_is_what_its_script_prints():
    script = importlib.util.spec_from_file_location("left_out", SITE / "left_out.py")
    left_out = importlib.util.module_from_spec(script)
    script.loader.exec_module(left_out)
    default, stubby = (
        left_out.rows(study).values() for study in (Study(), Study().change(**left_out.STUBBY))
    )
    section = (SITE / "validity.md").read_text().split("## What the equations leave out")[1]
    table = [row.split("|")[2:4] for row in section.split("\n\n")[2].splitlines()[2:]]
    written = [[float(cell.split()[0]) for cell in row] for row in table]
    np.testing.assert_allclose(written, list(zip(default, stubby, strict=True)), rtol=0.03)


def test_every_type_of_the_reference_is_there():
    text = (SITE / "reference" / "api.md").read_text(encoding="utf-8")
    names = re.findall(r"autoclass:: (\S+)\.(\w+)", text)
    assert len(names) > 30
    missing = [name for module, name in names if not hasattr(import_module(module), name)]
    assert not missing
