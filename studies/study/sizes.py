"""How long a study's lists are: one entry a link, or one a coordinate of the platform's pose.

The schema marks them; their lengths are those of the study's mechanism, for which a list that is
not given has a default of its own.
"""

from __future__ import annotations

from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin

from pydantic import BaseModel, GetCoreSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, core_schema

from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.prrr import PRRR

PATH = ("motion", "waypoints")
#: Side of the square along which a platform moves by default [m].
SIDE = 0.01


class OneEach(NamedTuple):
    """Marks a list with one entry for each of a mechanism's links or coordinates."""

    of: Literal["link", "coordinate"]

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        return core_schema.with_info_after_validator_function(self._checked, handler(source))

    def _checked(self, value: tuple[Any, ...], info: ValidationInfo) -> tuple[Any, ...]:
        wanted = info.context[self.of] if info.context else len(value)
        if len(value) != wanted:
            raise ValueError(f"{len(value)} entries; expected {wanted}")
        return value


LINK, COORDINATE = OneEach("link"), OneEach("coordinate")


def alternatives(annotation: Any) -> tuple[Any, ...]:
    """Types that a field can have, without the empty list."""
    every = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    return tuple(x for x in every if x != tuple[()])


def depth(annotation: Any) -> int:
    """Levels of lists."""
    if get_origin(annotation) is Annotated:
        return depth(get_args(annotation)[0])
    return 1 + depth(get_args(annotation)[0]) if _is_list(annotation) else 0


def _is_list(annotation: Any) -> bool:
    return get_origin(annotation) is tuple and bool(get_args(annotation))


def has_one_a_link(annotation: Any) -> bool:
    """Whether one number, or one for each link, is an alternative."""
    return any(
        LINK in getattr(x, "__metadata__", ()) and depth(x) == 1 for x in alternatives(annotation)
    )


def mechanism_of(machine: Any) -> Mechanism | None:
    """The mechanism of a section that is not validated yet; None if it has none."""
    kind = machine.get("kind", PRRR.name) if isinstance(machine, dict) else None
    return MECHANISMS[kind] if isinstance(kind, str) and kind in MECHANISMS else None


def lengths(mechanism: Mechanism) -> dict[str, int]:
    """Lengths of the marked lists."""
    return {LINK.of: mechanism.n_links, COORDINATE.of: mechanism.n_pose}


def default_path(mechanism: Mechanism) -> tuple[tuple[float, ...], ...]:
    """A square from the mechanism's home and back."""
    x, y, *turn = mechanism.home
    corners = ((0.0, 0.0), (0.0, SIDE), (SIDE, SIDE), (SIDE, 0.0), (0.0, 0.0))
    return tuple((round(x + dx, 12), round(y + dy, 12), *turn) for dx, dy in corners)


def own_defaults(model: type[BaseModel], mechanism: Mechanism) -> dict[tuple[str, str], Any]:
    """Defaults of a mechanism that are not those of the schema, by section and leaf."""
    path = default_path(mechanism)
    found: dict[tuple[str, str], Any] = {}
    for at, default, axis in _marked(model):
        own = path if at == PATH else default[: lengths(mechanism)[axis]]
        if own != default:
            found[at] = own
    return found


def defaults_of(model: type[BaseModel], mechanism: Mechanism, section: str) -> dict[str, Any]:
    """What the fields of a section have if nothing is written."""
    own, annotation = own_defaults(model, mechanism), model.model_fields[section].annotation
    fields = getattr(annotation, "model_fields", {})
    return {leaf: own.get((section, leaf), info.default) for leaf, info in fields.items()}


def for_mechanism(data: dict[str, Any], model: type[BaseModel], old: Mechanism) -> dict[str, Any]:
    """A whole study's dictionary for another mechanism, without the defaults of the old one."""
    before = own_defaults(model, old)
    data = {name: dict(x) if isinstance(x, dict) else x for name, x in data.items()}
    for (section, leaf), default, _ in _marked(model):
        if data[section].get(leaf) == before.get((section, leaf), default):
            del data[section][leaf]
    return data


@cache
def _marked(model: type[BaseModel]) -> tuple[tuple[tuple[str, str], tuple[Any, ...], str], ...]:
    """Fields whose default is a marked list: (section, leaf), default, what it counts."""
    found: list[tuple[tuple[str, str], tuple[Any, ...], str]] = []
    for section, outer in model.model_fields.items():
        for leaf, info in getattr(outer.annotation, "model_fields", {}).items():
            if (section, leaf) == PATH:
                found.append((PATH, info.default, COORDINATE.of))
            elif isinstance(info.default, tuple):
                marks = [x for x in info.metadata if isinstance(x, OneEach)]
                for one in alternatives(info.annotation):
                    if depth(one) == _levels(info.default):
                        marks += [
                            x for x in getattr(one, "__metadata__", ()) if isinstance(x, OneEach)
                        ]
                if marks:
                    found.append(((section, leaf), info.default, marks[0].of))
    return tuple(found)


def _levels(value: Any) -> int:
    """Levels of lists in a value."""
    return 1 + max(map(_levels, value), default=0) if isinstance(value, tuple) else 0
