"""Studies of bare links that keep their length, as the paper has them.

Most tests were made with them: what they test does not depend on patches, and their numbers come
from closed forms and codes of such links. `tests/jaxmodel/test_stretch.py` has patches as they are.
"""

from studies.bench.works import BARE
from studies.study import spec
from studies.study.spec import Study


def parse_study(data):
    """`studies.study.spec.parse_study` with defaults of bare links."""
    data = {name: dict(part) if isinstance(part, dict) else part for name, part in data.items()}
    kinds = {"five_bar": 2}
    links = kinds.get(data.get("machine", {}).get("kind", "prrr"), 3)
    for name, value in BARE.items():
        section, field = name.split("__")
        part = data.setdefault(section, {})
        if isinstance(part, dict):
            part.setdefault(field, value[:links] if isinstance(value, tuple) else value)
    return spec.parse_study(data)


def paper_study() -> Study:
    """`studies.study.spec.paper_study` of bare links."""
    return spec.paper_study().change(**BARE)
