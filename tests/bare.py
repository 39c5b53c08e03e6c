"""Studies of bare links that keep their length, as the paper has them.

Most tests were made with them: what they test does not depend on patches, and their numbers come
from closed forms and codes of such links. `tests/jaxmodel/test_stretch.py` has patches as they are.
"""

from jaxmodel.mechanisms import MECHANISMS
from studies.fitting import spec as fitting_spec
from studies.reference.tables import BARE
from studies.space import spec as space_spec
from studies.study import spec
from studies.study.spec import Study
from studies.tuning import spec as tuning_spec


def bare(data):
    """The data of a study, sweep, tuning or fit with defaults of bare links."""
    data = {name: dict(part) if isinstance(part, dict) else part for name, part in data.items()}
    machine = data.get("machine")
    kind = machine.get("kind") if isinstance(machine, dict) else None
    links = MECHANISMS[kind].n_links if isinstance(kind, str) and kind in MECHANISMS else 3
    for name, value in BARE.items():
        section, field = name.split("__")
        part = data.setdefault(section, {})
        if not isinstance(part, dict) or (field == "velocity_gain" and "damping" in part):
            continue
        part.setdefault(field, list(value[:links]) if isinstance(value, tuple) else value)
    return data


def parse_study(data):
    """`studies.study.spec.parse_study` with defaults of bare links."""
    return spec.parse_study(bare(data))


def paper_study() -> Study:
    """`studies.study.spec.paper_study` of bare links."""
    return spec.paper_study().change(**BARE)


def parse_sweep(data):
    """`studies.space.spec.parse_sweep` with defaults of bare links."""
    return space_spec.parse_sweep(bare(data))


def parse_tuning(data):
    """`studies.tuning.spec.parse_tuning` with defaults of bare links."""
    return tuning_spec.parse_tuning(bare(data))


def parse_fit(data, folder="."):
    """`studies.fitting.spec.parse_fit` with defaults of bare links."""
    return fitting_spec.parse_fit(bare(data), folder)
