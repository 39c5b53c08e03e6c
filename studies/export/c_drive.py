"""C99 of a sampled drive in floating point, from the same functions as the loop.

`DriveLaw.force` and `update` are traced to elementary operations for one slider, each of which
becomes a line of C: whatever is arithmetic of one slider, a drive of a user's own too, is exported.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Drive, Structure
from jaxmodel.controller import soft_limit
from jaxmodel.drive import Reference, drive_step
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import SliderError, resting_drive
from jaxmodel.mechanisms import MECHANISMS
from jaxmodel.prepare import prepare
from studies.engine.controller import FixedController
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.export.c_text import Source, array, exact, plain, real
from studies.export.compiler import library
from studies.show.pages import render

#: Samples of the random motion by which the code is compared.
SAMPLES = 4000


class DriveCode(NamedTuple):
    """A sampled drive as C."""

    source: Source
    name: str  # of its files, and prefix of its functions
    drive: Drive  # NumPy arrays
    structure: Structure
    period: float  # [s]


def drive_code(exported: FixedController, name: str, origin: list[str]) -> DriveCode | None:
    """The drive of a study in C; None if it is not sampled.

    Args:
        exported: the study.
        name: prefix of the controller's functions.
        origin: lines that say where the numbers come from.

    Raises:
        StudyError: the law of the drive does what this file has no C for.
    """
    law = DRIVES[exported.structure.drive]
    if not law.is_sampled:
        return None
    structure = exported.structure._replace(is_smooth=False, is_linear=False)
    drive = jax.tree.map(np.asarray, _drive_of(structure._replace(n_steps=1), exported.case))
    period, constants = float(exported.case.electronics.period), _Constants(drive)
    one = tuple(jnp.zeros(()) for _ in range(4))

    def force(memory: Any, e: Any, rate: Any, applied: Any, *numbers: Any) -> Any:
        error = SliderError(e, rate)
        return law.force(constants.filled(numbers), memory if law.update else None, error, False)

    def update(memory: Any, e: Any, rate: Any, applied: Any, *numbers: Any) -> Any:
        assert law.update is not None
        error = SliderError(e, rate)
        return law.update(constants.filled(numbers), memory, error, applied, jnp.asarray(period))

    inputs = ["s->memory[i]", "error[i]", "error_rate[i]", "applied", *constants.names]
    numbers = [jnp.zeros(())] * len(constants.names)

    def lines(function: Callable[..., Any], result: str) -> list[str]:
        try:
            traced = jax.make_jaxpr(function)(*one, *numbers)
            return _Lines(result[0]).write(traced, inputs, result)
        except (KeyError, TypeError, ValueError) as error:
            raise StudyError(
                f"drive.kind = {law.name!r}: no C for it ({error}); allowed: drives that are "
                "elementary arithmetic of one slider, or --target json"
            ) from None

    values = {
        "name": f"{name}_drive",
        "NAME": f"{name}_drive".upper(),
        "origin": [plain(line) for line in origin],
        "text": plain(law.text),
        "rate": exact(1 / period),
        "limit": array(drive.force_limit),
        "constants": [(x, array(value)) for x, value in constants.arrays.items()],
        "force": lines(force, "force"),
        "memory": lines(update, "memory") if law.update else [],
        "n_links": structure.n_links,
        "machine": MECHANISMS[structure.mechanism].text,
    }
    files = (render(f"export/templates/drive.{end}", **values) for end in ("h", "c"))
    return DriveCode(
        source=Source(*files),
        name=f"{name}_drive",
        drive=drive,
        structure=structure,
        period=period,
    )


@kept_jit(static_argnums=0)
def _drive_of(structure: Structure, case: Any) -> Drive:
    return prepare(structure, case).loop.drive


class _Constants:
    """Numbers of a drive as C arrays of three, and back."""

    def __init__(self, drive: Drive) -> None:
        self._drive = drive
        own = {f"own_{x}": value for x, value in drive.parameters.items()}
        given = {x: getattr(drive, x) for x in ("kp", "kd", "force_limit")}
        self.arrays = given | own
        self.names = [f"{x}[i]" for x in self.arrays]

    def filled(self, numbers: tuple[Any, ...]) -> Drive:
        """The drive with traced numbers of one slider."""
        named = dict(zip(self.arrays, numbers, strict=True))
        own = {x.removeprefix("own_"): v for x, v in named.items() if x.startswith("own_")}
        given = {x: v for x, v in named.items() if not x.startswith("own_")}
        return self._drive._replace(parameters=own, **given)


#: C of each elementary operation, from the C of its operands.
_C = {
    "add": "{0} + {1}",
    "sub": "{0} - {1}",
    "mul": "{0} * {1}",
    "div": "{0} / {1}",
    "neg": "-{0}",
    "max": "{0} > {1} ? {0} : {1}",
    "min": "{0} < {1} ? {0} : {1}",
    "abs": "{0} < R(0.0) ? -{0} : {0}",
    "sign": "R(({0} > R(0.0)) - ({0} < R(0.0)))",
    "square": "{0} * {0}",
    "sqrt": "R(sqrt({0}))",
    "tanh": "R(tanh({0}))",
    "exp": "R(exp({0}))",
    "log": "R(log({0}))",
    "sin": "R(sin({0}))",
    "cos": "R(cos({0}))",
    "pow": "R(pow({0}, {1}))",
    "gt": "R({0} > {1})",
    "ge": "R({0} >= {1})",
    "lt": "R({0} < {1})",
    "le": "R({0} <= {1})",
    "select_n": "{0} != R(0.0) ? {2} : {1}",
    "convert_element_type": "R({0})",
    "copy": "{0}",
    "stop_gradient": "{0}",
}
#: Those that hold a traced function, and where.
_CALLS = {
    "jit": "jaxpr",
    "pjit": "jaxpr",
    "custom_jvp_call": "call_jaxpr",
    "closed_call": "call_jaxpr",
}


class _Lines:
    """Lines of C of a traced function of numbers."""

    def __init__(self, prefix: str) -> None:
        self._prefix = prefix
        self._lines: list[str] = []

    def write(self, traced: Any, inputs: list[str], result: str) -> list[str]:
        """Lines that end by assigning `result`; KeyError: an operation without C."""
        (value,) = self._walk(traced, inputs)
        return [*self._lines, f"const real {result} = {value};"]

    def _walk(self, traced: Any, inputs: list[str]) -> list[str]:
        body = traced.jaxpr
        names = dict(zip(body.invars, inputs, strict=True))
        names |= {x: real(value) for x, value in zip(body.constvars, traced.consts, strict=True)}

        def text(atom: Any) -> str:
            return real(atom.val) if hasattr(atom, "val") else names[atom]

        for equation in body.eqns:
            operands, kind = [text(x) for x in equation.invars], equation.primitive.name
            if any(x.aval.shape for x in equation.outvars):
                raise ValueError(f"{kind} makes an array")
            if kind in _CALLS:
                results = self._walk(equation.params[_CALLS[kind]], operands)
            elif kind == "integer_pow":
                power = equation.params["y"]
                if power < 1:
                    raise KeyError(f"integer_pow {power}")
                results = [self._kept(" * ".join([operands[0]] * power))]
            else:
                results = [self._kept(_C[kind].format(*operands))]
            names |= dict(zip(equation.outvars, results, strict=True))
        return [text(x) for x in body.outvars]

    def _kept(self, expression: str) -> str:
        name = f"{self._prefix}{len(self._lines)}"
        self._lines.append(f"const real {name} = {expression};")
        return name


def compare_drive(code: DriveCode, compiler: list[str]) -> tuple[float, float]:
    """Largest difference of the C code from the drive in JAX, over the largest force [1].

    A random motion of the actuated joints that also reaches the limit of the motors.

    Args:
        code: from `drive_code`.
        compiler: command.

    Returns:
        in double precision; in single precision.
    """
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.normal(size=(3, SAMPLES, code.structure.n_links)), axis=1) / np.sqrt(
        SAMPLES
    )
    size = np.array([1e-3, 0.2, 0.7 * float(code.drive.force_limit.min())])
    e, rate, forward = walk * np.array(size)[:, None, None]
    wanted = np.asarray(_respond(code.structure, code.drive, code.period, e, rate, forward))
    differences = []
    for kind in (np.float64, np.float32):
        found = _run(code, compiler, kind, e, rate, forward)
        differences.append(float(np.abs(found - wanted).max() / np.abs(wanted).max()))
    return differences[0], differences[1]


@kept_jit(static_argnums=0)
def _respond(
    structure: Structure, drive: Drive, period: float, e: Any, rate: Any, forward: Any
) -> Any:
    """Feedback of the drive after each sample of errors and feed-forward, (T, n)."""
    still = jnp.zeros(structure.n_links, e.dtype)

    def one(state: Any, inputs: Any) -> Any:
        e, rate, forward = inputs
        applied = soft_limit(forward + state.force, drive.force_limit, False) - forward
        wanted = Reference(e, rate, None, still)
        after = drive_step(structure, drive, period, state, wanted, still, still, applied)
        return after, after.force

    start = resting_drive(DRIVES[structure.drive], still)
    return jax.lax.scan(one, start, (e, rate, forward))[1]


def _run(code: DriveCode, compiler: list[str], kind: type, *signals: np.ndarray) -> np.ndarray:
    """Feedback of the compiled drive after each sample, (T, n)."""
    inputs: list[np.ndarray] = [np.ascontiguousarray(x, kind) for x in signals]
    found = np.empty_like(inputs[0])
    with library(code.source, code.name, compiler, kind) as loaded:
        state = ctypes.create_string_buffer(2 * code.structure.n_links * 8)
        getattr(loaded, f"{code.name}_init")(state)
        step = getattr(loaded, f"{code.name}_step")
        for k in range(len(found)):
            step(state, *(ctypes.c_void_p(x[k].ctypes.data) for x in (*inputs, found)))
    return found
