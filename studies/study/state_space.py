"""A controller of one's own: read from a file, checked, and brought to real modal form."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxmodel.laws.state_space import STATE_SPACE
from jaxmodel.state_space import IllConditionedError, StateSpace, modal_form
from studies.errors import StudyError, field_error, shown
from studies.reading import read_json, read_npz
from studies.study.matlab import read_mat
from studies.study.signals import INPUTS, OUTPUTS, parse_signal

if TYPE_CHECKING:
    from studies.study.spec import StateSpaceSection, Study

#: Endings of the formats.
FORMATS = (".json", ".npz", ".mat")
#: Matrices, and what a file may call the sample time.
MATRICES, TIMES = ("a", "b", "c", "d"), ("sample_time", "dt", "ts")
#: What a limit of the commands adds to the state; optional.
ANTI_WINDUP = "anti_windup"
#: A sample time that differs by more than this share is another one [1].
SAME_TIME = 1e-6
#: Largest entry of a matrix [1], so that no product of a few overflows, and number of states.
LARGEST, LARGEST_ORDER = 1e30, 500
#: Spectral radius from which a controller is unstable [1].
UNSTABLE = 1 + 1e-9


def with_matrices(data: dict[str, Any], folder: Path) -> dict[str, Any]:
    """A study as read, with the matrices of the file that it names.

    Args:
        data: sections.
        folder: where the file of the study is.

    Raises:
        StudyError: the file cannot be read.
    """
    section = data.get("state_space")
    if not isinstance(section, dict) or any(name in section for name in MATRICES):
        return data
    file = section.get("file", "")
    if not isinstance(file, str) or not file:
        return data
    return {**data, "state_space": {**read_system(folder / file), **section}}


def read_system(path: Path) -> dict[str, Any]:
    """Fields of the section from a file, JSON, NPZ or MAT.

    Raises:
        StudyError: unreadable, or without A, B or C.
    """
    name = "state_space.file"
    if path.suffix.lower() not in FORMATS:
        raise field_error(name, str(path), f"a file {', '.join(FORMATS)}")
    try:
        entries = {key.lower(): value for key, value in _entries(path).items()}
    except OSError as error:
        reason = error.strerror or str(error)
        raise StudyError(f"{name}: {path} cannot be read ({reason})") from None
    except Exception as error:  # of any kind, for a damaged file
        raise StudyError(f"{name}: {path} cannot be read ({error})") from None
    section: dict[str, Any] = {
        key: _matrix(entries[key], f"{name}: {path}: {key.upper()}")
        for key in (*MATRICES, ANTI_WINDUP)
        if key in entries
    }
    if section.get("d") and not any(any(section.get(key, ())) for key in MATRICES[:3]):
        section |= {"a": (), "b": (), "c": ((),) * len(section["d"])}  # a static gain
    missing = [key.upper() for key in MATRICES[:3] if key not in section]
    if missing:
        raise StudyError(f"{name}: {path} has no {', '.join(missing)}; expected A, B, C, D and dt")
    for key in TIMES:
        if key in entries:
            time = _number(entries[key], f"{name}: {path}: {key}")
            if time.size != 1:
                raise StudyError(f"{name}: {path}: {key} has {time.size} entries; expected 1 [s]")
            section["sample_time"] = float(time.item())
    for key in ("inputs", "outputs"):
        if key in entries:
            section[key] = tuple(str(x).strip() for x in np.ravel(np.array(entries[key], object)))
    return section


def _entries(path: Path) -> dict[str, Any]:
    kind = path.suffix.lower()
    if kind == ".json":
        entries = read_json(path)
        if not isinstance(entries, dict):
            raise ValueError("expected an object with A, B, C, D and dt")
        return entries
    if kind == ".npz":
        return dict(read_npz(path))
    return dict(read_mat(path))


def _number(value: Any, what: str) -> np.ndarray:
    try:
        array = np.array(value)
    except ValueError:  # lists of unequal length
        array = np.array(None)
    is_real = array.dtype.kind in "biuf" or (array.dtype.kind == "c" and not array.imag.any())
    if not is_real:
        raise StudyError(f"{what} = {shown(str(value))}: expected real numbers")
    return array.real.astype(float)


def _matrix(value: Any, what: str) -> tuple[tuple[float, ...], ...]:
    matrix = _number(value, what)
    if matrix.ndim != 2 and matrix.size:
        raise StudyError(f"{what} has {matrix.ndim} dimensions; expected 2, rows and columns")
    return tuple(tuple(map(float, row)) for row in matrix) if matrix.ndim == 2 else ()


def check_system(study: Study, n_patches: int) -> None:
    """Check the section if the study's law needs it.

    Raises:
        StudyError: missing, wrong sizes or sample time, unstable, no modal form.
    """
    if study.control.law != STATE_SPACE.name:
        return
    section, period = study.state_space, 1 / study.electronics.sample_rate_hz
    if not section.c:
        raise StudyError(
            "state_space.file: missing; control.law = 'state_space' needs a file with A, B, C, D "
            "and sample time, or these as fields"
        )
    if not section.sample_time:
        raise StudyError(
            f"state_space.sample_time: missing (in a file: dt, Ts or sample_time); expected "
            f"{period:.9g} [s], that of electronics.sample_rate_hz"
        )
    if abs(section.sample_time / period - 1) > SAME_TIME:
        raise field_error(
            "state_space.sample_time",
            section.sample_time,
            f"{period:.9g}, that of electronics.sample_rate_hz = "
            f"{study.electronics.sample_rate_hz:g} Hz; convert the controller",
            "s",
        )
    system_of(section, study.n_links, n_patches)


@lru_cache(maxsize=8)
def system_of(section: StateSpaceSection, n_links: int, n_patches: int) -> StateSpace:
    """The section's controller in real modal form, NumPy arrays.

    Raises:
        StudyError: wrong sizes or names, unstable, no well-conditioned modal form.
    """
    c = _sized(section.c, "c", (len(section.c), None))
    order = c.shape[1]
    if order > LARGEST_ORDER:
        raise StudyError(f"state_space.c: {order} states; allowed: up to {LARGEST_ORDER}")
    a = _sized(section.a, "a", (order, order))
    b = _sized(section.b, "b", (order, None))
    if not order:  # a static gain: only D says how many inputs it has
        b = np.zeros((0, max(map(len, section.d), default=0)))
    shape = (len(c), b.shape[1])
    d = _sized(section.d, "d", shape) if section.d else np.zeros(shape)
    tell = np.zeros((order, len(c)))
    if section.anti_windup:
        tell = _sized(section.anti_windup, ANTI_WINDUP, tell.shape)
    every = n_links * n_patches
    if not section.inputs and not section.outputs and shape == (n_patches, n_patches):
        groups = n_links  # the same controller for each link
    else:
        groups = 1
        inputs, outputs = (
            _ports(names, count, n_links, n_patches, kind)
            for names, count, kind in (
                (section.inputs, shape[1], "inputs"),
                (section.outputs, shape[0], "outputs"),
            )
        )
        columns, rows = np.eye(every)[inputs], np.eye(every)[:, outputs]
        b, c, d, tell = b @ columns, rows @ c, rows @ d @ columns, tell @ rows.T
    radius = _radius(a)
    if not radius <= UNSTABLE:
        raise StudyError(
            f"state_space.a: an unstable controller, with a pole of modulus {radius:.9g}; allowed: "
            "1 at most"
        )
    try:
        form = modal_form(a, np.hstack([b, tell]) if section.anti_windup else b, c)
    except IllConditionedError as error:
        raise StudyError(f"state_space.a: {error}") from None
    size = every // groups
    system = StateSpace(
        state=form.state,
        enter=form.enter[..., :size],
        leave=form.leave,
        direct=d.reshape(size, size),
        anti_windup=form.enter[..., size:] if section.anti_windup else None,
    )
    return StateSpace(
        *(None if part is None else np.repeat(part[None], groups, axis=0) for part in system)
    )


def _radius(a: np.ndarray) -> float:
    """Largest modulus of the poles, NaN where none are found."""
    try:
        return float(np.abs(np.linalg.eigvals(a)).max(initial=0.0))
    except np.linalg.LinAlgError:
        return float("nan")


def _sized(
    rows: tuple[tuple[float, ...], ...], name: str, shape: tuple[int, int | None]
) -> np.ndarray:
    """A matrix of that many rows and columns; None: any number."""
    path = f"state_space.{name}"
    widths = {len(row) for row in rows}
    if len(widths) > 1:
        raise StudyError(
            f"{path}: rows of {min(widths)} to {max(widths)} entries; expected a matrix"
        )
    matrix = np.array(rows, float).reshape(len(rows), max(widths, default=0))
    largest = np.abs(matrix).max(initial=0.0)
    if not largest <= LARGEST:
        raise StudyError(f"{path}: an entry of size {largest:g}; allowed: up to {LARGEST:g}")
    expected = shape[0], matrix.shape[1] if shape[1] is None else shape[1]
    if matrix.shape != expected:
        size = " x ".join("any" if x is None else str(x) for x in shape)
        raise StudyError(
            f"{path}: {matrix.shape[0]} x {matrix.shape[1]}; allowed: {size}, to fit state_space.c"
        )
    return matrix


def _ports(
    names: tuple[str, ...], count: int, n_links: int, n_patches: int, kind: str
) -> list[int]:
    """Places of a controller's inputs or outputs among all sensors or actuators."""
    path = f"state_space.{kind}"
    kinds = {"sensor": OUTPUTS["sensor"]} if kind == "inputs" else {"actuator": INPUTS["actuator"]}
    if not names:
        every = n_links * n_patches
        if count != every:
            matrix = "b has columns" if kind == "inputs" else "c has rows"
            raise StudyError(
                f"{path}: missing, and state_space.{matrix}: {count}; allowed without names: "
                f"{every}, link by link, or {n_patches} both ways, the same for each link"
            )
        return list(range(every))
    if len(names) != count:
        raise field_error(path, names, f"{count} names, one for each of the controller's {kind}")
    signals = [parse_signal(name, kinds, n_patches, np.ones(n_links), path) for name in names]
    places = [signal.row(n_patches, ()) for signal in signals]
    if len(set(places)) < len(places):
        raise field_error(path, names, "different names")
    return places
