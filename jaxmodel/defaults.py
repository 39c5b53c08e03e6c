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
from jaxmodel.checks import check_shape
from jaxmodel.drives import DRIVES
from jaxmodel.fields import fields
from jaxmodel.laws import LAWS
from jaxmodel.lazy import jax, jnp
from jaxmodel.mechanisms.prrr.guides import HOME as HOME
from jaxmodel.numbers import OWN_DRIVES, OWN_LAWS, Numbers, case_of, is_used, structure_of
from jaxmodel.parameters import Array, Machine
from jaxmodel.table import PartError

#: Its number, or one a link, is that of mode 1; those of other fields are the same for all modes.
OF_MODE_1 = "control.damping"
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
            "patches.centers": centers, "shaper.kind": "zvd"}; docs/reference/fields.md lists them.
            One number stands for all of a list, one list of places or of damping ratios for all
            links. They may be traced, but for choices, switches and `run.duration`; with a traced
            one out of its range, the run's status is not 0 and its metrics are NaN.
        n_modes, n_controlled: most modes of a link, and most under control; default: those of
            "link.modes" and "control.modes", which may be traced and fewer.

    Returns:
        Structure, which is static, and Case, a pytree.

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
    given, forms = dict(values or {}), dict(fields())
    numbers = {name: _number(name, form, given) for name, form in forms.items()}

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
            forms[name], numbers[name] = own, _number(name, own, given)
    for name in given.keys() - numbers.keys():
        _refuse(name, numbers)
    moves = len(numbers["motion.waypoints"]) - 1
    for name in ("motion.move_time", "motion.dwell"):
        if np.shape(numbers[name]) != (1,):
            check_shape(name, numbers[name], (moves,))
    if "machine.joint_angles_deg" in given:
        check_shape("machine.joint_angles_deg", numbers["machine.joint_angles_deg"], links)
    n_patches = np.shape(numbers["patches.centers"])[-1]
    for name in _OF_PATCHES:
        ones = np.ones((*links, n_patches))
        own = forms[name] | {"value": ones, "shape": ones.shape}
        numbers[name] = _number(name, own, given)
        check_shape(name, numbers[name], (*links, n_patches))
    sizes = {
        "n_modes": _size(numbers, "link.modes", "n_modes", n_modes),
        "n_controlled": min(
            _size(numbers, "control.modes", "n_controlled", n_controlled), n_patches
        ),
        "n_patches": n_patches,
    }
    # a case with a traced number that is not allowed has no length, and its status says so
    is_fine = [
        jnp.all(_is_allowed(forms[name], x))
        for name, x in given.items()
        if isinstance(x, jax.core.Tracer)
    ]
    is_fine += [
        numbers[name] <= sizes[size]
        for name, size in (("link.modes", "n_modes"), ("control.modes", "n_controlled"))
        if isinstance(numbers[name], jax.core.Tracer)
    ]
    if is_fine:
        length = numbers["link.length"]
        numbers["link.length"] = jnp.where(jnp.stack(is_fine).all(), length, jnp.nan)
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


def _size(numbers: Numbers, name: str, argument: str, most: int) -> int:
    """The largest of a number of modes: as said, or its value."""
    field, value = fields()[name], numbers[name]
    if most:
        _number(argument, field, {argument: most})
    elif isinstance(value, jax.core.Tracer):
        raise PartError(f"{argument}: missing; expected the largest {name}, which is traced")
    if most and not isinstance(value, jax.core.Tracer) and value > most:
        raise PartError(f"{name} = {value}; allowed: up to {argument} = {most}")
    return int(most or value)


def _number(name: str, field: dict[str, Any], given: Mapping[str, Any]) -> Array:
    """A field's array: a given value in the shape that the field has, or the paper's."""
    own = np.array(field["value"], field.get("dtype", float)).reshape(field["shape"])
    if name not in given:
        return own
    value = given[name]
    if isinstance(value, jax.core.Tracer):
        if "choices" in field:
            raise PartError(f"{name}: traced; expected a value that is known before")
        return _shaped(name, field.get("of"), own.shape, value)
    if "choices" in field:
        if not isinstance(value, str) or value not in field["choices"]:
            _refuse(value, field["choices"], f"{name} = ")
        return np.array(field["choices"].index(value))
    try:
        array = np.asarray(value)
    except ValueError:  # lists of unequal length
        array = np.array(None)
    is_switch = field.get("is_whole", False)
    if array.dtype.kind not in ("biuf" if is_switch else "iuf"):
        raise PartError(f"{name} = {value!r}; allowed: {field['allowed']}")
    if not (is_fine := _is_allowed(field, array)).all():
        unit = f" [{field['unit']}]" if field["unit"] else ""
        raise PartError(f"{name} = {array[~is_fine].flat[0]:g}; allowed: {field['allowed']}{unit}")
    return np.asarray(_shaped(name, field.get("of"), own.shape, array), own.dtype)


def _shaped(name: str, of: str | None, own: tuple[int, ...], value: Any) -> Array:
    """A value in the shape of a field's arrays; `of`: what its lists hold."""
    shape, xp = np.shape(value), jnp if isinstance(value, jax.core.Tracer) else np
    if len(own) > 1 and of != "entries":  # also of lists that the paper's run has not
        own = (*fields()["link.length"]["shape"], *own[1:])
    target = own
    if of and len(shape) == len(own):  # as long as written
        target = (shape[0], *own[1:]) if of == "entries" else (own[0], *shape[1:])
    elif of == "each link":
        most = int(fields()["control.modes"]["limits"]["le"])
        value, target = value[..., None], (own[0], 1 if name == OF_MODE_1 else most)
    elif of == "all links" and shape:
        target = (own[0], *shape)
    is_flat = of in ("entries", "lists") and 0 < len(shape) < len(own)
    try:
        if not is_flat and 0 not in shape and (shape or np.prod(target)):
            return xp.broadcast_to(value, target)
    except ValueError:
        pass
    wanted = {None: own, "entries": ("n", *own[1:])}.get(of, (*own[:1], "n"))
    listed = ", ".join(map(str, wanted)) + "," * (len(wanted) == 1)
    allowed = f"({listed}) or a number" if own else "a number"
    raise PartError(f"{name}: shape {shape}; expected {allowed}")


def _is_allowed(field: dict[str, Any], array: Array) -> Array:
    """Which numbers are finite, within a field's bounds and, if they must be, whole."""
    is_fine = abs(array) < np.inf
    for sign, bound in field.get("limits", {}).items():
        is_fine &= getattr(operator, sign)(array, bound)
    is_whole = field.get("is_whole") or field.get("dtype") == "int"
    return is_fine & (array % 1 == 0) if is_whole else is_fine


def _refuse(name: Any, allowed: Any, place: str = "") -> None:
    close = get_close_matches(str(name), allowed, 1)
    hint = f"; did you mean {close[0]!r}?" if close else ""
    listed = f"; allowed: {', '.join(map(str, allowed))}" if len(allowed) < 20 else ""
    raise PartError(f"{place}{name}: no such {'choice' if place else 'field'}{listed}{hint}")
