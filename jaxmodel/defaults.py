"""The paper's closed-loop run, or one with other numbers: where work without files begins.

Numbers have the names, units and ranges of study files, see `jaxmodel.fields`.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from difflib import get_close_matches
from typing import Any

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.drives import DRIVES
from jaxmodel.fields import fields
from jaxmodel.laws import LAWS
from jaxmodel.lazy import jax, jnp
from jaxmodel.mechanisms.prrr.guides import HOME as HOME
from jaxmodel.numbers import OWN_DRIVES, OWN_LAWS, Numbers, case_of, is_used, structure_of
from jaxmodel.parameters import Array, Machine
from jaxmodel.table import PartError

#: One number for each patch, which follows the placement.
_OF_PATCHES = ("patches.sensor_factor", "patches.actuator_factor")


def paper_case(
    values: Mapping[str, Any] | None = None, n_modes: int = 0, n_controlled: int = 0
) -> tuple[Structure, Case]:
    """The paper's closed-loop run, or one with other numbers; also inside `jit`, `vmap` and `grad`.

    A square of 10 mm in 0.4 s, EI shaper, IMSC of all links by gains that are stable on links with
    patches, twelve bits at 10 kHz.

    Args:
        values: by the names of files, in their units, such as {"control.gain_factor": 0.5,
            "patches.centers": centers, "shaper.kind": "zvd"}. One number stands for all of a list.
            They may be traced, but for choices, switches and `run.duration`.
        n_modes, n_controlled: most modes of a link, and most under control; default: those of
            "link.modes" and "control.modes", which may be traced and fewer.

    Returns:
        (structure, case): what is static, and a pytree.

    Raises:
        ValueError: no such field, or a value of a wrong shape, or out of range.

    Example:
        >>> structure, case = paper_case({"shaper.kind": "zvd", "link.modes": 4})
        >>> structure.n_modes, structure.n_steps
        (4, 8000)
        >>> def gain(factor):
        ...     return paper_case({"control.gain_factor": factor})[1].control.gain_factor
        >>> float(jax.jit(gain)(2.0))
        2.0
    """
    given, numbers = dict(values or {}), dict[str, Any]()
    for name, field in fields().items():
        numbers[name] = _number(name, field, given.get(name))

    def value(name: str) -> Any:
        number = numbers[name]
        if isinstance(number, jax.core.Tracer):
            raise PartError(f"{name}: traced; expected a value that is known before")
        choices = fields()[name].get("choices")
        return choices[int(number)] if choices else number.item()

    def is_needed(name: str) -> bool:
        return isinstance(numbers[name], jax.Array) or is_used(name, numbers[name])

    links = np.shape(numbers["link.length"])
    parts = (OWN_LAWS, LAWS[value("control.law")]), (OWN_DRIVES, DRIVES[value("drive.kind")])
    for place, part in parts:
        for x in part.parameters:
            name = f"{place}.{part.name}.{x.name}"
            own = {"value": [x.default] * links[0], "shape": links, "unit": x.unit}
            own |= {"allowed": f"{x.low:g} to {x.high:g}", "limits": {"ge": x.low, "le": x.high}}
            numbers[name] = _number(name, own, given.get(name))
    for name in given.keys() - numbers.keys():
        _refuse(name, numbers)
    n_patches = np.shape(numbers["patches.centers"])[-1]
    for name in {*_OF_PATCHES} - given.keys():
        numbers[name] = np.ones((*links, n_patches))
    n_controlled = n_controlled or _size(numbers, "control.modes", "n_controlled")
    sizes = {
        "n_modes": n_modes or _size(numbers, "link.modes", "n_modes"),
        "n_controlled": min(n_controlled, n_patches),
        "n_patches": n_patches,
    }
    structure = structure_of(value, sizes, is_needed)
    return structure, case_of(structure, numbers)


def paper_machine() -> Machine:
    """The paper's 3-PRR manipulator, whose links keep their length; one number for equal ones.

    Values not given in the paper (E, density, width, I_p, damping, PZT permittivity and density)
    are the estimates listed in docs/theory.md.

    Example:
        >>> float(paper_machine().beam.length)
        0.2
    """
    machine = paper_case({"link.stretch": False})[1].machine
    equal: Machine = jax.tree.map(lambda x: x if np.ptp(x) else x.flat[0], machine)
    return equal._replace(damping=machine.damping)


def _size(numbers: Numbers, name: str, argument: str) -> int:
    if isinstance(numbers[name], jax.core.Tracer):
        raise PartError(f"{argument}: missing; expected the largest {name}, which is traced")
    return int(np.max(numbers[name]))


def _number(name: str, field: dict[str, Any], value: Any) -> Array:
    """A field's array: a value in the shape that the field has, or the paper's."""
    own = np.array(field["value"], field.get("dtype", float)).reshape(field["shape"])
    if value is None:
        return own
    if "choices" in field:
        if value not in field["choices"]:
            _refuse(value, field["choices"], f"{name} = ")
        return np.array(field["choices"].index(value))
    try:
        is_traced = isinstance(value, jax.Array)
        array = value if is_traced else np.asarray(value, own.dtype)
    except (TypeError, ValueError):
        raise PartError(f"{name} = {value!r}; allowed: {field['allowed']}") from None
    _check_range(name, field, array)
    if field.get("of") == "links" and np.ndim(array) == 1 and own.ndim == 2:  # one a link
        array = array[:, None]
    shape = own.shape
    is_list = "of" in field and np.ndim(array) == own.ndim
    try:
        return array if is_list else (jnp if is_traced else np).broadcast_to(array, shape)
    except ValueError:
        wanted = f"{shape} or a number" if shape else "a number"
        raise PartError(f"{name}: shape {np.shape(value)}; expected {wanted}") from None


def _check_range(name: str, field: dict[str, Any], array: Array) -> None:
    """Refuse numbers out of range; of traced ones nobody knows."""
    if isinstance(array, jax.core.Tracer):
        return
    numbers = np.ravel(np.asarray(array))
    is_fine = np.isfinite(numbers)
    for sign, bound in field.get("limits", {}).items():
        is_fine &= getattr(operator, sign)(numbers, bound)
    if not is_fine.all():
        unit = f" [{field['unit']}]" if field["unit"] else ""
        raise PartError(f"{name} = {numbers[~is_fine][0]:g}; allowed: {field['allowed']}{unit}")


def _refuse(name: Any, allowed: Any, place: str = "") -> None:
    close = get_close_matches(str(name), allowed, 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    listed = f"; allowed: {', '.join(map(str, allowed))}" if len(allowed) < 20 else ""
    raise PartError(f"{place}{name}: no such {'choice' if place else 'field'}{listed}{hint}")
