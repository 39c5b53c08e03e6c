"""A mechanism of a user's, checked and tried once before it is taken in.

It is built from its own defaults and the paper's machine, and placed at home: what is wrong with it
is said when its file is loaded, in its own terms, not by whatever uses it first.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable
from typing import Any, NoReturn

import numpy as np

from jaxmodel.fields import fields
from jaxmodel.mechanisms.carriers import Crank, Rail
from jaxmodel.mechanisms.contract import Mechanism, Near
from jaxmodel.mechanisms.prrr.guides import ASSEMBLIES
from jaxmodel.table import PartError, check_parameters

#: Relative error of the links' lengths.
TOLERANCE = 1e-9


def check_mechanism(mechanism: Mechanism) -> None:
    """Raise PartError if a mechanism, or what it builds, violates its contract."""
    place = f"mechanism {mechanism.name!r}"
    _check_description(place, mechanism)
    n, own_link = mechanism.n_links, _number("link.length")[0]
    geometry, mass = _built(place, mechanism)
    x, y = _far_joints(place, mechanism, geometry)
    legs = _call(place, "legs", geometry.legs, np)
    _check_methods(f"{place}: legs", legs, ("near", "side", "misplaced"))
    near = _call(place, "near", legs.near, x, y, np.full(n, own_link**2), 1e-12, np)
    _check_near(f"{place}: near at home", near, own_link, n)
    size = _call(place, "size", geometry.size)
    if not _is_finite(size, ()) or size <= 0:
        _refuse(f"{place}: size", size, "a finite number > 0 [m]")
    carriers = _call(place, "carriers", geometry.carriers, mass, np)
    if not _is_list(carriers, (Rail, Crank)) or len(carriers) != n:
        _refuse(f"{place}: carriers", carriers, f"{n} of Rail and Crank")


def _refuse(what: str, found: object, expected: str) -> NoReturn:
    raise PartError(f"{what} = {found!r}; expected {expected}")


def _check_description(place: str, mechanism: Mechanism) -> None:
    for name in ("text", "allowed"):
        text = getattr(mechanism, name)
        if not isinstance(text, str) or not text.strip():
            _refuse(f"{place}: {name}", text, "a text")
    if not callable(mechanism.build):
        _refuse(f"{place}: build", mechanism.build, "a function")
    if mechanism.n_pose not in (2, 3) or mechanism.n_links != mechanism.n_pose:
        raise PartError(
            f"{place}: n_links = {mechanism.n_links}, n_pose = {mechanism.n_pose}; allowed: 3 and "
            "3, or 2 and 2"
        )
    if not _is_list(mechanism.home, (int, float)) or not _is_finite(
        mechanism.home, (mechanism.n_pose,)
    ):
        numbers = f"{mechanism.n_pose} finite numbers [m, m, rad]"
        _refuse(f"{place}: home", mechanism.home, numbers)
    if not _is_list(mechanism.reads, str):
        _refuse(f"{place}: reads", mechanism.reads, "a tuple of names")
    check_parameters(place, mechanism.parameters)


def _number(name: str) -> np.ndarray:
    """The paper's value of a field."""
    return np.array(fields()[name]["value"])


def _built(place: str, mechanism: Mechanism) -> tuple[Any, Any]:
    """Geometry, and mass with each near joint, from default numbers."""
    n = mechanism.n_links
    machine = {
        "guide_angle": np.resize(np.radians(_number("machine.guide_angles_deg")), n),
        "guide_offset": np.resize(_number("machine.guide_offsets"), n),
        "joint_radius": np.resize(_number("machine.joint_radius"), n),
        "joint_angle": np.resize(ASSEMBLIES["inward"], n),
        "guide_side": _number("machine.guide_side"),
        "slider_mass": np.resize(_number("machine.slider_mass"), n),
    }
    own = {x.name: np.full(n, float(x.default)) for x in mechanism.parameters}
    found = _call(place, "build", mechanism.build, own, machine, np)
    if not isinstance(found, tuple) or len(found) != 2:
        _refuse(f"{place}: build returns", found, "a geometry and a mass")
    geometry, mass = found
    _check_methods(f"{place}: geometry", geometry, ("legs", "arms", "size", "carriers"))
    for name, value in zip(geometry._fields, geometry, strict=True):
        if not _is_finite(value, np.shape(value)):
            _refuse(f"{place}: {name} of its geometry", value, "finite numbers")
    if not any(_is_finite(mass, shape) for shape in ((), (n,))) or np.any(np.asarray(mass) < 0):
        _refuse(f"{place}: mass with the near joints", mass, f"1 or {n} finite numbers >= 0 [kg]")
    return geometry, mass


def _far_joints(place: str, mechanism: Mechanism, geometry: Any) -> tuple[np.ndarray, np.ndarray]:
    """Far joints at home [m], (n,) each."""
    n, (x, y, *turn) = mechanism.n_links, mechanism.home
    arms = _call(place, "arms", geometry.arms, np)
    if (arms is None) != (not turn):
        _refuse(f"{place}: arms", arms, "None for a point, x and y of the joints for a body")
    if arms is None:
        return np.full(n, x), np.full(n, y)
    if not isinstance(arms, tuple) or len(arms) != 2 or not all(_is_finite(a, (n,)) for a in arms):
        _refuse(f"{place}: arms", arms, f"two arrays of {n} finite numbers [m]")
    sine, cosine = np.sin(turn[0]), np.cos(turn[0])
    return x + arms[0] * cosine - arms[1] * sine, y + arms[1] * cosine + arms[0] * sine


def _check_near(place: str, near: Any, link: float, n: int) -> None:
    if not isinstance(near, Near):
        _refuse(place, near, "a Near")
    for name, value in zip(near._fields, near, strict=True):
        if value is not None and not any(_is_finite(value, shape) for shape in ((), (n,))):
            _refuse(f"{place}: {name}", value, f"{n} finite numbers")
    if not np.allclose(np.hypot(near.x, near.y), 1.0, rtol=TOLERANCE):
        _refuse(f"{place}: (x, y)", (near.x, near.y), "directions of length 1")
    found = np.sqrt(np.maximum(near.root_squared + near.across**2, 0.0))
    if not np.allclose(found, link, rtol=TOLERANCE):
        _refuse(f"{place}: root and across make links of", found, f"{link:g} [m], as given")


def _check_methods(what: str, found: Any, names: tuple[str, ...]) -> None:
    """Check that something is a NamedTuple with methods of these names."""
    if not isinstance(found, tuple) or not hasattr(found, "_fields"):
        _refuse(what, found, "a NamedTuple")
    if missing := [name for name in names if not callable(getattr(found, name, None))]:
        raise PartError(f"{what}: {type(found).__name__} has no method {', '.join(missing)}")


def _call(place: str, name: str, function: Callable[..., Any], *arguments: Any) -> Any:
    """What a function of a user's returns."""
    try:
        with np.errstate(all="ignore"):
            return function(*arguments)
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[1:2]  # the function's own
        line = "".join(f", line {x.lineno}" for x in frame)
        raise PartError(f"{place}: {name}{line}: {type(error).__name__}: {error}") from None


def _is_list(found: object, kinds: type | tuple[type, ...]) -> bool:
    return isinstance(found, (tuple, list)) and all(isinstance(x, kinds) for x in found)


def _is_finite(value: object, shape: tuple[int, ...]) -> bool:
    """Whether it is an array of finite real numbers of a shape."""
    try:
        array = np.asarray(value)
    except ValueError:  # rows of different length
        return False
    return array.dtype.kind in "iuf" and array.shape == shape and bool(np.isfinite(array).all())
