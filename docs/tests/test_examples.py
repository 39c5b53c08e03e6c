"""Every example of README, documents, notebooks and ready files shows control that works.

All of them run as one table: the example as written, at half its gains, and without control.
"""

import ast
import contextlib
import json
import tomllib
from types import SimpleNamespace

import numpy as np
import pytest

from studies.engine.executor import Executor
from studies.engine.frame import frame_of
from studies.engine.plan import chunk_cases, even_layout, plan_groups
from studies.engine.preflight import check_run
from studies.space.table import CaseTable
from studies.study.files import READY, read_toml
from studies.study.paths import field_value
from studies.study.spec import Study, paper_study, parse_study
from studies.study.window import residual_delay
from tests.documents import NOTEBOOKS, PAGES, blocks, page

#: Sections of a file beside those of its study.
WORK = ("sweep", "tune", "fit")
#: Examples that are about something else.
OTHERS = {
    "models.toml": "compares models, without control",
}
#: Examples whose shaped move leaves less than one step of the converter, with control or without:
#: no controller sees that. README, "A first run", says so of the paper's own move.
UNSEEN = ("paper.toml",)
FACTORS = (1.0, 0.5, 0.0)


def study_of(data):
    return parse_study({name: value for name, value in data.items() if name not in WORK})


def in_toml(text):
    """Studies of a page's files; fragments that are no files of this program are passed over."""
    for block in blocks(text, "toml"):
        data = tomllib.loads(block)
        is_whole = set(data) <= {*Study.model_fields, *WORK}
        if is_whole and "file" not in data.get("state_space", {}):  # whose file is the reader's own
            yield study_of(data)


#: Calls that only make studies; nothing else of an example is evaluated.
MAKERS = (
    "Study",
    "change",
    "load",
)


def in_python(code, names):
    """Studies that code assigns to names; names: those of earlier code, which it adds to."""
    kept = (line for line in code.splitlines() if not line.startswith(("%", "!")))
    for node in ast.parse("\n".join(kept)).body:
        if not isinstance(node, ast.Assign) or not isinstance(node.targets[0], ast.Name):
            continue
        calls = [x.func for x in ast.walk(node.value) if isinstance(x, ast.Call)]
        if not all(getattr(x, "attr", getattr(x, "id", "")) in MAKERS for x in calls):
            continue
        with contextlib.suppress(NameError, AttributeError, TypeError, KeyError):
            made = eval(compile(ast.Expression(node.value), "example", "eval"), names)
            names[node.targets[0].id] = made
            if isinstance(made, Study):
                yield made


def start_names():
    """What makers are called; a sweep or a tuning is its study here, so that nothing starts JAX."""
    makers = SimpleNamespace(
        Study=Study,
        load=lambda what: paper_study() if what == "paper" else study_of(what),
    )
    return {"studies": makers}


def examples():
    """Name and study of every example."""
    found = [(path.name, study_of(read_toml(path))) for path in sorted(READY.glob("*.toml"))]
    found.append(("default", Study()))
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        found += [(path.name, study) for study in in_toml(text)]
        names = start_names()
        for block in blocks(text, "python"):
            found += [(path.name, study) for study in in_python(block, names)]
    for path in NOTEBOOKS:
        names = start_names()
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "code":
                found += [(path.name, study) for study in in_python("".join(cell["source"]), names)]
    chosen, seen = [], []
    for name, study in found:
        is_controlled = study.control.feedback == "sampled" and any(study.control.links)
        is_controlled &= study.control.gain_factor > 0  # otherwise what an example compares with
        what = study.model_dump(exclude={"title"})
        # a warning: a difference as the velocity estimate makes the loop unstable
        is_controlled &= study.electronics.estimator != "difference"
        if name in OTHERS or not is_controlled or what in seen:
            continue
        seen.append(what)
        chosen.append((name, study))
    return chosen


EXAMPLES = examples()


def columns_of(study):
    """Fields in which a study differs from the default one, `run.duration` apart."""
    skipped = {"run.duration"}
    if study.shaper.kind == "none":
        skipped.add("shaper.frequencies_hz")
    fields = {}
    for section, info in list(Study.model_fields.items())[1:]:
        for name in info.annotation.model_fields:
            field = f"{section}.{name}"
            value = field_value(study, field)
            if value != field_value(Study(), field) and field not in skipped:
                fields[field] = value
    return fields | {"metrics.residual_delay": residual_delay(study)}


def column_of(values):
    """As a table keeps them: an array, or an array of tuples of one depth."""
    if any(isinstance(x, tuple) for x in values):
        if any(isinstance(x, tuple) and x and isinstance(x[0], tuple) for x in values):
            values = [x if x and isinstance(x[0], tuple) else (x,) * 3 for x in values]
        column = np.empty(len(values), object)
        column[:] = values
        return column
    return np.array(values)


def table_of(examples):
    """The table of these studies, each at FACTORS times its gains."""
    rows = [
        columns_of(study) | {"control.gain_factor": factor * study.control.gain_factor}
        for study in examples
        for factor in FACTORS
    ]
    longest = max(study.run.duration for study in examples)
    default = Study().change(run__duration=longest, machine__kind=examples[0].machine.kind)
    names = sorted({name for row in rows for name in row})
    columns = {
        name: column_of([row.get(name, field_value(default, name)) for row in rows])
        for name in names
    }
    n = len(rows)
    zero, row = np.zeros(n, int), np.arange(n)
    return CaseTable(default, columns, zero, 0, row, row)


@pytest.fixture(scope="module")
def residual():
    """Residual of every example at FACTORS times its gains, rms [m]: of each, (factors, links)."""
    found = [None] * len(EXAMPLES)
    kinds = [study.machine.kind for _, study in EXAMPLES]
    for kind in dict.fromkeys(kinds):
        own = [k for k, name in enumerate(kinds) if name == kind]
        for k, rms in zip(own, residual_of([EXAMPLES[k][1] for k in own]), strict=True):
            found[k] = rms
    return found


def residual_of(examples):
    """Of examples of one mechanism, (n, factors, links)."""
    table = table_of(examples)
    rms = np.full((len(table), examples[0].n_links), np.nan)
    groups = plan_groups(
        table, np.arange(len(table)), lambda n, _: even_layout(n), ("residual_rms",), False, False
    )
    for group in groups:
        executor = Executor(group.structure, group.layout)
        chunk = chunk_cases(table, group.rows, group.structure, group.layout.size)
        found = executor.start(chunk).wait().metrics.residual_rms
        rms[group.rows] = np.asarray(found)[: len(group.rows)].max(axis=-1)
    return rms.reshape(len(examples), len(FACTORS), -1)


def test_the_first_example_prints_what_the_readme_shows(tmp_path, monkeypatch, capsys):
    text = page("README.md")
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks(text, "python")[0], "README.md", "exec"), {})
    assert capsys.readouterr().out == blocks(text, "text")[0]
    assert (tmp_path / "first_run.png").stat().st_size > 1e4


def test_there_are_examples():
    names = {name for name, _ in EXAMPLES}
    assert {
        "own-machine.md",
        "automation.md",
        "tune.md",
        "default",
        "tune.toml",
        "4_gradient_tuning.ipynb",
    } <= names
    assert {path.name for path in READY.glob("*.toml")} >= OTHERS.keys()


@pytest.mark.parametrize("k", range(len(EXAMPLES)), ids=[name for name, _ in EXAMPLES])
def test_control_beats_no_control(residual, k):
    study = EXAMPLES[k][1]
    # of the controlled links, as `best` ranks
    controlled = residual[k][:, list(study.control.links)]
    assert np.isfinite(residual[k]).all()
    left, half, free = controlled.max(axis=1)
    if EXAMPLES[k][0] in UNSEEN:
        step = frame_of(*check_run(study)).adc_step
        assert max(left, half, free) < np.min(np.asarray(step)[list(study.control.links)])
        return
    assert left < 0.9 * free
    assert half < 0.9 * free
