"""The smallest change of a machine that makes a design unstable, in numbers and in words."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxmodel.beam import BASES
from jaxmodel.case import Case, Structure
from jaxmodel.changes import MachineChange, changed_loop
from jaxmodel.controller import Controller, linear_parts
from jaxmodel.delay import LONGEST as LONGEST_DELAY
from jaxmodel.delay import true_delay
from jaxmodel.judge import with_margin_modes
from jaxmodel.laws.srf import SRF
from jaxmodel.parameters import Array
from studies.engine.controller import FixedController
from studies.engine.host_loop import SampledLoop, name_motion
from studies.engine.nearest import Loops, nearest_unstable
from studies.engine.programs import kept_jit
from studies.errors import StudyError
from studies.results.breaking import BreakingChange, ChangedNumber
from studies.space.machines import TOLERANCES
from studies.threads import serial_blas

#: Largest logarithm of a factor: twenty times as much, or as little [1].
MOST = 3.0
#: Largest share of the platform's mass that is taken off [1].
LIGHTER = 0.5
#: Smaller parts are not counted [tolerances].
SMALL = 0.1


def smallest_change(
    design: FixedController, tolerances: MachineChange = TOLERANCES
) -> BreakingChange:
    """The smallest change of a design's machine with which its controller is unstable.

    The norm is Euclidean, each number in units of its tolerance; the controller stays as designed
    for the nominal machine, linearised at rest at the first way-point with `MARGIN_MODES` plant
    modes. Patches stay on their links and apart, the delay grows up to `delay.LONGEST`. Of a law
    whose channels act one at a time: the smallest over them, each judged alone.

    Args:
        design: with its controller.
        tolerances: one unit of each kind of change.

    Raises:
        StudyError: the loop is not finite.
    """
    structure, case = _machine(design)
    pose = np.array(design.study.motion.waypoints[0], float)
    unit, lower, upper = (
        np.asarray(ravel_pytree(x)[0]) for x in _limits(structure, case, tolerances)
    )
    found, units = [], tolerances._asdict()
    with serial_blas():
        for _, law in linear_parts(design.controller):
            law = law._replace(feedback=law.feedback.without_rivals())
            one = _ChangedLoops(structure, case, pose, law, unit)
            x = nearest_unstable(Loops(one.matrix, one.slope, lower, upper))
            distance = np.inf if x is None else float(np.linalg.norm(x))
            found.append((distance, x, one))
    distance, x, one = min(found, key=lambda entry: entry[0])
    if x is None:
        zero = one.unpack(np.zeros_like(unit))
        return BreakingChange(distance, zero, parts=(), breaking="", tolerances=units)
    change = one.unpack(unit * x)
    return BreakingChange(
        distance=distance,
        change=change,
        parts=_parts(change, one.unpack(x)),
        breaking=one.breaking(x),
        tolerances=units,
    )


def _machine(design: FixedController) -> tuple[Structure, Case]:
    """The design's machine, without what only the design of its controller depends on."""
    structure, case = with_margin_modes(design.structure, design.case)
    return structure._replace(law=SRF.name, has_poles=False), case


class _ChangedLoops:
    """The loops of a design's machine with changes, in units of tolerances."""

    def __init__(
        self, structure: Structure, case: Case, pose: np.ndarray, law: Controller, unit: np.ndarray
    ) -> None:
        self._case, self._unit = case, unit
        shape = MachineChange(*(np.zeros(x) for x in _shapes(structure)))
        self._unravel = ravel_pytree(shape)[1]
        self._fixed = structure, case, pose, law
        if not np.all(np.isfinite(self.matrix(np.zeros_like(unit)))):
            raise StudyError("the linearised loop is not finite: nothing to judge")

    def unpack(self, x: np.ndarray) -> MachineChange:
        change: MachineChange = jax.tree.map(np.asarray, self._unravel(jnp.asarray(x)))
        return change

    def matrix(self, x: np.ndarray) -> np.ndarray:
        return np.asarray(_transition(*self._fixed, self.unpack(self._unit * x))[0])

    def slope(self, x: np.ndarray, weight: np.ndarray) -> np.ndarray:
        slope = _pull(*self._fixed, self.unpack(self._unit * x), weight)
        return self._unit * np.asarray(ravel_pytree(slope)[0])

    def breaking(self, x: np.ndarray) -> str:
        """What is unstable at x."""
        matrix, omega = map(np.asarray, _transition(*self._fixed, self.unpack(self._unit * x)))
        poles = np.linalg.eigvals(matrix)
        loop = SampledLoop(
            open=matrix,
            feedback=np.zeros_like(matrix),
            mode_poles=np.full((0, self._fixed[0].n_links), np.nan),
            omega=omega,
            has_stretch=self._fixed[0].has_stretch,
            is_drive=np.arange(len(matrix)) < 2 * self._fixed[0].n_pose,
            period=float(self._case.electronics.period),
        )
        return name_motion(loop, 1.0, complex(poles[np.argmax(np.abs(poles))]))


@kept_jit(static_argnums=0)
def _transition(
    structure: Structure, case: Case, pose: Array, law: Controller, change: MachineChange
) -> tuple[Array, Array]:
    return changed_loop(structure, case, pose, law, change)


@kept_jit(static_argnums=0)
def _pull(
    structure: Structure,
    case: Case,
    pose: Array,
    law: Controller,
    change: MachineChange,
    weight: Array,
) -> MachineChange:
    """Derivative of sum(weight * matrix) by the change."""

    def weighed(change: MachineChange) -> Array:
        return jnp.sum(weight * changed_loop(structure, case, pose, law, change)[0])

    return jax.grad(weighed)(change)


def _shapes(structure: Structure) -> MachineChange:
    """Of the fields of a change."""
    links = (structure.n_links,)
    patches = (*links, structure.n_patches)
    return MachineChange(
        stiffness=links,
        damping=links,
        payload=(),
        patch=patches,
        delay=(),
        actuator=patches,
        sensor=patches,
        joint_inertia=links,
    )


def _limits(
    structure: Structure, case: Case, unit: MachineChange
) -> tuple[MachineChange, MachineChange, MachineChange]:
    """Units of all entries, and their smallest and largest values in them."""
    machine = case.machine
    mass = float(machine.masses.platform_mass + np.asarray(machine.masses.payload_mass))
    towards_b, towards_c = _free_way(structure, case)
    inertia = np.broadcast_to(machine.beam.joint_inertia_c, structure.n_links)
    heaviest = np.inf if BASES[structure.basis].has_joints else 0.0
    ends = MachineChange(
        stiffness=(-MOST, MOST),
        damping=(-MOST, MOST),
        payload=(-LIGHTER * mass, np.inf),
        patch=(-towards_b, towards_c),
        delay=(0.0, LONGEST_DELAY - float(true_delay(case.electronics))),
        actuator=(-MOST, MOST),
        sensor=(-MOST, MOST),
        joint_inertia=(-inertia * (heaviest > 0), heaviest),
    )

    def spread(x: Array, shape: tuple[int, ...]) -> np.ndarray:
        return np.array(np.broadcast_to(np.asarray(x, float), shape))

    def in_units(k: int) -> MachineChange:
        return MachineChange(
            *(
                spread(end[k] / one, shape) if one > 0 else np.zeros(shape)
                for end, one, shape in zip(ends, unit, _shapes(structure), strict=True)
            )
        )

    units = MachineChange(*map(spread, unit, _shapes(structure)))
    return units, in_units(0), in_units(1)


def _free_way(structure: Structure, case: Case) -> tuple[np.ndarray, np.ndarray]:
    """How far each pair of patches can move towards B and towards C [m], (n, K) each.

    Half of the gap to a neighbour, so that no two meet, and all of that to an end of the link.
    """
    patches, length = (
        case.machine.patches,
        np.broadcast_to(case.machine.beam.length, structure.n_links),
    )
    longer = np.maximum(patches.sensor_length, patches.actuator_length)
    half = np.broadcast_to(longer / 2, structure.n_links)[:, None]
    center = np.asarray(patches.center)
    order = np.argsort(center, axis=1)
    rising = np.take_along_axis(center, order, axis=1)
    between = (np.diff(rising, axis=1) - 2 * half) / 2
    first, last = rising[:, :1] - half, length[:, None] - rising[:, -1:] - half
    ways = []
    for gaps in ([first, between], [between, last]):
        way = np.empty_like(center)
        np.put_along_axis(way, order, np.maximum(np.concatenate(gaps, axis=1), 0.0), axis=1)
        ways.append(way)
    return ways[0], ways[1]


def _parts(change: MachineChange, size: MachineChange) -> tuple[ChangedNumber, ...]:
    """The numbers that change, with the largest first."""
    parts = []
    for name, value, own in zip(MachineChange._fields, change, size, strict=True):
        for at in np.ndindex(value.shape):
            if abs(own[at]) >= SMALL:
                what, how = _words(name, at, float(value[at]))
                parts.append(ChangedNumber(what, f"{what} {how}".strip(), float(own[at])))
    return tuple(sorted(parts, key=lambda part: -abs(part.size)))


#: What a relative change is one of; the others have words of their own.
_RELATIVE = {"stiffness": "E", "damping": "damping", "actuator": "actuator", "sensor": "sensor"}


def _words(name: str, at: tuple[int, ...], value: float) -> tuple[str, str]:
    """What changes, and how."""
    place = "".join(f"{k + 1} of " for k in at[1:]) + "".join(f"link {k + 1}" for k in at[:1])
    if name in _RELATIVE:
        joint = " " if name in ("actuator", "sensor") else " of "
        return f"{_RELATIVE[name]}{joint}{place}", f"{100 * np.expm1(value):+.2g} %"
    if name == "patch":
        return f"patch {place}", f"{1e3 * abs(value):.2g} mm towards {'C' if value > 0 else 'B'}"
    if name == "payload":
        return "platform", f"{abs(value):.2g} kg {'heavier' if value > 0 else 'lighter'}"
    if name == "delay":
        return "delay", f"{value:.2g} samples late"
    return f"J_C of {place}", f"{value:+.2g} kg m2"
