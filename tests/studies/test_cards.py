"""Results as notebooks show them, and the progress of long commands there."""

import ast
import io
import json
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace

import IPython.display
import jsonschema
import numpy as np
import pytest
from rich.console import Console

import studies
from studies.cards import teller
from studies.documents import schema
from studies.engine.modes import NamedModes
from studies.engine.runs import run_study
from studies.engine.stability import LoopFigures
from studies.export.comparison import ComparedVariants, Variant
from studies.export.request import Exported, ExportResult
from studies.export.verify import Check, Verification
from studies.phases import Phases
from studies.results.document import json_text
from studies.single.run import Simulation
from tests.canonical import MACHINE, study_of
from tests.studies.show.test_findings import certificate

TITLE = "<script>x</script> & y"


@pytest.fixture(scope="module")
def results():
    """One of each kind, the run a true one."""
    study = study_of(MACHINE, title=TITLE)
    check = Check("voltages", "1e-16 V", "1e-12 V", True)
    loop = LoopFigures(spectral_radius=0.99, gain_margin=3.0)
    made = ExportResult({}, loop, Verification([check], [], {}, {}, {}))
    shares = np.zeros((2, 3, 3))
    shares[1, 0, 0] = 0.9
    return {
        "Simulation": Simulation(run_study(study)),
        "NamedModes": NamedModes(
            frequency=np.array([60.0, 114.0]),
            damping_ratio=np.full(2, 0.01),
            shape=np.zeros((12, 2)),
            link_share=shares,
            drive_share=np.array([1.0, 0.1]),
            turn_share=np.zeros(2),
        ),
        "Certificate": certificate(study=study),
        "Exported": Exported(SimpleNamespace(study=study), "json", (), made, ["", "", ""]),
        "ComparedVariants": ComparedVariants(
            study=study,
            motion="",
            board=None,
            dac_bits=12,
            variants=(Variant(1e4, 0, gain_margin=2.5, residual_rms=1e-7),),
            uncontrolled=1e-5,
        ),
    }


def test_all_that_shows_itself_has_something_to_say():
    sources = Path(studies.__file__).parent.rglob("*.py")
    classes = [
        (path, node)
        for path in sources
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.ClassDef) and "Result" in map(ast.unparse, node.bases)
    ]
    assert len(classes) > 10
    for path, node in classes:
        if "report" not in [getattr(x, "name", "") for x in node.body]:
            place = path.relative_to(Path(studies.__file__).parents[1]).with_suffix("")
            kind = getattr(import_module(".".join(place.parts)), node.name)
            assert callable(teller(kind).say), node.name


@pytest.mark.parametrize(
    "name", ["Simulation", "NamedModes", "Certificate", "Exported", "ComparedVariants"]
)
def test_a_result_shows_itself(results, name):
    result = results[name]
    assert type(result).__name__ == name
    html = result._repr_html_()
    assert "<script" not in html and html.count("data:image/png;base64,") == 1
    assert ("&lt;script&gt;" in html) == (name != "NamedModes")
    assert len(html) < 1e5


@pytest.mark.parametrize("name", ["Simulation", "NamedModes", "Certificate", "ComparedVariants"])
def test_a_result_has_data_a_table_and_a_document(results, name):
    result = results[name]
    assert all(x.attrs["units"] and x.attrs["long_name"] for x in result.data.values())
    assert len(result.table())
    document = result.document()
    jsonschema.validate(json.loads(json_text(document)), schema(document.COMMAND))


def test_a_result_without_a_document_is_told_in_sentences(results):
    told = results["Exported"].document()
    jsonschema.validate(json.loads(json_text(told)), schema("summary"))
    assert told.is_good and told.title and told.result


def test_a_run_without_trajectories_shows_its_numbers(results):
    run = results["Simulation"].run
    run = run._replace(result=run.result._replace(record=None), loop=None)
    html = Simulation(run)._repr_html_()
    assert "residual rms [µm]" in html and "<img" not in html and "peak of the run" not in html


def test_progress_in_a_notebook_is_one_line(monkeypatch):
    shown = []

    class Line:
        def update(self, data, raw):
            shown.append(data["text/plain"])

    monkeypatch.setattr(IPython.display, "display", lambda *_, **__: Line())
    said = io.StringIO()
    console = Console(file=said, force_jupyter=False)
    console.is_jupyter = True
    with Phases(console, ("compile", "run")) as phases:
        phases.begin("run")
        console.is_jupyter = False
        phases.advance(1, 2, "1/2 cases", 3.0)
        phases.say("a sentence")
    assert shown[0].startswith("run (2 of 2)")
    assert shown[1] == "run (2 of 2): 1/2 cases; about 3 s left"
    assert said.getvalue() == "a sentence\n"
