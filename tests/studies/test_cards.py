"""Results as notebooks show them, and the progress of long commands there."""

import io

import IPython.display
import pytest
from rich.console import Console

import studies
from studies.cards import CARDS
from studies.engine.progress import Phases
from studies.engine.runs import run_study
from studies.spillover import ModelMismatch, certify

HOME = (0.0, 0.0, 0.5236)


def small_study(**fields):
    return studies.Study(
        title="<script>x</script> & y",
        run={"duration": 0.1},
        link={"modes": 3},
        motion={"waypoints": (HOME, (0.0, 0.01, 0.5236)), "move_time": 0.03},
        metrics={"residual_length": 0.03},
        **fields,
    )


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """One of each kind that is quick to make."""
    folder, quiet = tmp_path_factory.mktemp("cards"), Console(file=io.StringIO())
    study = small_study()
    studies.write_study(folder / "study.toml", study)
    design = studies.load_design(folder / "study.toml")
    few = {"bases": ("pinned_pinned",), "sizes": (3, 4), "mismatches": (ModelMismatch(),)}
    return {
        "Run": run_study(study),
        "NamedModes": studies.machine_modes(study),
        "Certificate": certify(study, **few),
        "Exported": studies.export_design(design, "json", folder / "out", console=quiet),
    }


@pytest.mark.parametrize("name", ["Run", "NamedModes", "Certificate", "Exported"])
def test_a_result_shows_itself(results, name):
    result = results[name]
    assert type(result).__name__ == name and name in CARDS
    html = result._repr_html_()
    assert "<script" not in html and html.count("data:image/png;base64,") == 1
    assert ("&lt;script&gt;" in html) == (name != "NamedModes")
    assert len(html) < 1e5


def test_a_run_without_trajectories_shows_its_numbers():
    html = run_study(small_study(), has_record=False, has_loop=False)._repr_html_()
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
        phases.advance(1, 2, "1/2 cases", "about 3 s")
        phases.say("a sentence")
    assert shown[0].startswith("run (2 of 2)")
    assert shown[1] == "run (2 of 2): 1/2 cases; about 3 s left"
    assert said.getvalue() == "a sentence\n"
