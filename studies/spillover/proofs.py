"""Proofs of stability: for every number of modes, and for a whole box of machines.

Bounds and cells are those of `jaxmodel.zero_exclusion`; this module brings a design there and back.
"""

from __future__ import annotations

import time

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.beam import BASES
from jaxmodel.branch_and_bound import Cells, exclude_zeros, start_cells
from jaxmodel.controller import Controller, linear_parts
from jaxmodel.drives import DRIVES
from jaxmodel.modal_loop import ModalLoop, modal_loop
from jaxmodel.sampled_loop import RADIUS_TOLERANCE, delayed_loop
from jaxmodel.zero_exclusion import prepare_exclusion
from studies.engine.controller import FixedController
from studies.engine.eigenvalues import eigenvalues
from studies.engine.programs import kept_jit
from studies.engine.stability import gain_margin
from studies.results.labelled import Labelled, derived, told, unwritten
from studies.space.machines import BOX
from studies.spillover.plants import (
    LARGEST,
    LoopBuilder,
    PlantVariant,
    pad_channels,
    plant_structure,
)
from studies.study.margin import margin_text
from studies.threads import serial_blas

#: Basis whose modes beyond the known ones are bounded in closed form.
SINES = "pinned_pinned"
#: Modes of a link that are known one by one.
KNOWN = 200
#: Shares of the margin of the base modes that are tried one after the other [1].
SHARES = (0.3, 0.6, 0.8, 0.9, 0.93, 0.95, 0.96, 0.97, 0.98, 0.99)
#: Slices of the unit circle to begin with; cells at most for a share, and for a box.
SLICES, SHARE_CELLS, BOX_CELLS = 256, 30_000, 1_000_000
#: Smallest cells: nu over the highest [1], stiffness [1], delay [samples], payload [kg], gain over
#: the largest [1].
SMALLEST = np.array([2e-6, 1e-5, 1e-3, 1e-3, 1e-3])


class AllModes(Labelled):
    """Gain margins that hold for every number of modes from `n_base` on."""

    margin: float = told("proven: common gain factor, all smaller ones stable [1]")
    base_margin: float = told("of the plant with `n_base` modes, by eigenvalues [1]")
    n_base: int = told("modes per link")
    fault: str = told("why there is no proof, empty otherwise", default="")


class ProvenBox(Labelled):
    """What is known of all machines of a box, see `BOX`."""

    ranges: tuple[tuple[float, float], ...] = told("of stiffness [1], delay [samples], load [kg]")
    undecided: float = told("share of the box's volume [1]")
    has_all_modes: bool = told("holds for every number of modes from `n_base` on")
    n_base: int = told("modes per link")
    cells: int = told("of frequency and box that were evaluated")
    seconds: float = unwritten()
    unstable: tuple[float, float, float] | None = told(
        "an unstable machine, as `ranges`; null: none found", default=None
    )
    fault: str = told("why nothing is known", default="")

    @derived("", "whether no machine of the box is unstable")
    def is_proven(self) -> bool:
        return not self.fault and self.undecided == 0


class Proofs(Labelled):
    """What holds for more than single plants."""

    all_modes: AllModes = told("for every number of modes")
    box: ProvenBox = told("for a box of machines")

    @derived("", "the same in a sentence each")
    def statements(self) -> tuple[str, str]:
        return proof_texts(self)


def proof_texts(proofs: Proofs) -> tuple[str, str]:
    """What is proven, in a sentence each: for every number of modes, and for the box."""
    modes = proofs.all_modes
    if modes.margin > 0:
        first = (
            f"proven for every number of modes from {modes.n_base} on: stable with all gains "
            f"scaled by up to {margin_text(modes.margin, 3)} ({modes.n_base} modes alone: "
            f"{margin_text(modes.base_margin, 3)})"
        )
    else:
        reason = modes.fault or "undecided already for small gains"
        first = f"not proven for every number of modes: {reason}"
    return first, _box_text(proofs.box)


def machine_text(machine: tuple[float, float, float]) -> str:
    """A machine of the box in words.

    Args:
        machine: factor on the links' stiffness [1], extra delay [samples], more payload [kg].
    """
    stiffness, delay, payload = machine
    samples = "sample" if delay == 1 else "samples"
    return (
        f"stiffness x {stiffness:.4g}, {delay:.3g} {samples} of extra delay, {payload:.3g} kg "
        "more payload"
    )


def _box_text(box: ProvenBox) -> str:
    (low, high), (_, delay), (_, payload) = box.ranges
    what = (
        f"stiffness of the links x {low:g} to {high:g}, 0 to {delay:g} samples of extra delay, "
        f"0 to {payload:g} kg more payload"
    )
    modes = (
        f"every number of modes from {box.n_base} on"
        if box.has_all_modes
        else (f"{box.n_base} modes per link")
    )
    if box.fault:
        return f"nothing proven for {what}: {box.fault}"
    if box.unstable is not None:
        return f"UNSTABLE machine in the box ({what}): {machine_text(box.unstable)}"
    if box.is_proven:
        return f"proven: no unstable machine for {what} ({modes})"
    share = max(100 * box.undecided, 1e-3)
    return f"undecided on {share:.2g} % of the box ({what}; {modes}), proven on the rest"


def prove(design: FixedController, seconds: float = 60.0) -> Proofs:
    """Prove what can be proven of a design's controller, whose coefficients stay.

    Args:
        design: with its controller.
        seconds: for the box at most, after compilation.
    """
    laws = [pad_channels(part, design.n_patches) for _, part in linear_parts(design.controller)]
    with serial_blas():
        each = [prove_all_modes(design, law) for law in laws]
        boxes = [prove_box(design, law, seconds / len(laws)) for law in laws]
    return Proofs(min(each, key=lambda one: one.margin), max(boxes, key=_weakness))


def _weakness(box: ProvenBox) -> tuple[bool, bool, float]:
    return box.unstable is not None, bool(box.fault), box.undecided


def prove_all_modes(design: FixedController, law: Controller) -> AllModes:
    """Largest gain factor up to which every number of modes is stable.

    Shares of the base modes' margin are proven one after the other, so that all smaller factors
    are included.

    Args:
        design: with its plant.
        law: see `pad_channels`.
    """
    builder = LoopBuilder(design)
    plant = PlantVariant(SINES, LARGEST)
    fault = builder.fault(plant) or _not_covered(design)
    if fault:
        return AllModes(0.0, np.nan, LARGEST, fault)
    base = gain_margin(builder.loop(plant, law).poles)
    if base == 0:
        return AllModes(0.0, base, LARGEST, "unstable with its base modes")
    try:
        setup = prepare_exclusion(
            collect(design, law, SINES, KNOWN), LARGEST, (1.0, 1.0), _payload(design, 0.0), True
        )
    except ValueError as error:
        return AllModes(0.0, base, LARGEST, str(error))
    proven = 0.0
    for share in SHARES:
        gains = np.array([_payload(design, 0.0)[0], proven * base, share * base])
        ranges = np.array([[1.0, 1.0], [0.0, 0.0], [gains[0], gains[0]], gains[1:]])
        cells = start_cells(setup, ranges, SLICES)
        smallest = SMALLEST * [cells.high[-1, 0], 1, 1, 1, base]
        found = exclude_zeros(setup, cells, smallest, SHARE_CELLS, stops_at_first=True)
        if len(found.undecided.low):
            break
        proven = share
    return AllModes(proven * base, base, LARGEST)


def _payload(design: FixedController, more: float) -> tuple[float, float]:
    own = float(design.case.machine.masses.payload_mass)
    return own, own + more


def _not_covered(design: FixedController) -> str:
    """What the return difference of `modal_loop` has no form for, "" for nothing."""
    if design.structure.has_delay:
        return "it covers a delay of one sample alone (electronics.delay, unmodelled_delay)"
    if DRIVES[design.structure.drive].is_sampled:
        return (
            f"it covers drives in continuous time alone (drive.kind = {design.structure.drive!r})"
        )
    if design.structure.has_drive_lag:
        return "it covers motors that follow at once (drive.lag)"
    return ""


def prove_box(design: FixedController, law: Controller, seconds: float) -> ProvenBox:
    """Zero exclusion over `BOX`, from one stable machine of it.

    Args:
        design: with its plant.
        law: see `pad_channels`.
        seconds: at most, after compilation.
    """
    basis = design.study.link.basis
    has_tail = basis == SINES
    nothing = ProvenBox(
        ranges=BOX, undecided=1.0, has_all_modes=has_tail, n_base=LARGEST, cells=0, seconds=0.0
    )
    if fault := _not_covered(design):
        return nothing.replace(fault=fault)
    if not BASES[basis].is_on_chord:
        return nothing.replace(fault=f"{basis}: its modes move the far ends of the links")
    if design.structure.has_wrench and not has_tail:
        return nothing.replace(fault=f"{basis} under a steady load: its modes change")
    if design.structure.has_wrench and design.structure.has_stretch:
        return nothing.replace(fault="links under a steady load: softer ones are longer at rest")
    radius = SpectralRadius(design, law, basis)
    corners = [(e, d, m) for e in BOX[0] for d in BOX[1] for m in BOX[2]]
    e, d, m = (sum(ends) / 2 for ends in BOX)
    for machine in ((e, d, m), *corners):
        if radius(*machine) > 1 + RADIUS_TOLERANCE:
            return nothing.replace(unstable=machine)
    try:
        loop = collect(design, law, basis, KNOWN if has_tail else LARGEST)
        setup = prepare_exclusion(loop, LARGEST, BOX[0], _payload(design, BOX[2][1]), has_tail)
    except ValueError as error:
        return nothing.replace(fault=str(error))
    ranges = np.array([*BOX[:2], _payload(design, BOX[2][1]), (1.0, 1.0)])
    cells = start_cells(setup, ranges, SLICES)
    smallest = SMALLEST * [cells.high[-1, 0], 1, 1, 1, 1]
    start = time.monotonic()
    found = exclude_zeros(
        setup, cells, smallest, BOX_CELLS, lambda: time.monotonic() - start > seconds
    )
    box = nothing.replace(
        undecided=volume(found.undecided, ranges[:3]),
        cells=found.evaluated,
        seconds=time.monotonic() - start,
    )
    return box.replace(unstable=_counterexample(found.undecided, radius, ranges))


def _counterexample(
    cells: Cells, radius: SpectralRadius, ranges: np.ndarray, most: int = 24
) -> tuple[float, float, float] | None:
    """An unstable machine in the middle of undecided cells, if one of a few is."""
    if not len(cells.low):
        return None
    for k in np.unique(np.linspace(0, len(cells.low) - 1, most).astype(int)):
        stiffness, delay, payload = (cells.low[k] + cells.high[k])[1:4] / 2
        machine = (float(stiffness), float(delay), float(payload - ranges[2, 0]))
        if radius(*machine) > 1 + RADIUS_TOLERANCE:
            return machine
    return None


def volume(cells: Cells, ranges: np.ndarray, steps: int = 64) -> float:
    """Share of a box in which some frequency is undecided [1], rounded up to a grid.

    Args:
        cells: undecided ones.
        ranges: low and high of stiffness, delay and payload, one row each.
        steps: of the grid along each.
    """
    grid = np.zeros((steps,) * len(ranges), bool)
    width = ranges[:, 1] - ranges[:, 0]
    first = np.floor((cells.low[:, 1:4] - ranges[:, 0]) / width * steps + 1e-9).astype(int)
    last = np.ceil((cells.high[:, 1:4] - ranges[:, 0]) / width * steps - 1e-9).astype(int)
    for a, b in np.unique(np.stack([first, last], axis=1), axis=0):
        grid[a[0] : b[0], a[1] : b[1], a[2] : b[2]] = True
    return float(grid.mean())


def collect(design: FixedController, law: Controller, basis: str, n_modes: int) -> ModalLoop:
    """The loop of a design's plant in NumPy arrays.

    Args:
        design: with its plant.
        law: see `pad_channels`.
        basis: of the plant.
        n_modes: modes per link.
    """
    structure, case, pose = plant_structure(design, basis, n_modes), design.case, _home(design)
    case = case._replace(
        initial=case.initial._replace(modal=np.zeros((structure.n_links, n_modes))),
        n_modes=jnp.asarray(n_modes),
    )
    law = jax.tree.map(jnp.asarray, law._replace(feedback=law.feedback.without_rivals()))
    return jax.tree.map(np.asarray, _modal_loop(structure, case, pose, law))


_modal_loop = kept_jit(static_argnums=0)(modal_loop)
_delayed_loop = kept_jit(static_argnums=0)(delayed_loop)


def _home(design: FixedController) -> np.ndarray:
    return np.array(design.study.motion.waypoints[0], float)


class SpectralRadius:
    """Spectral radius of single machines of the box, by eigenvalues."""

    def __init__(self, design: FixedController, law: Controller, basis: str) -> None:
        law = law._replace(feedback=law.feedback.without_rivals())
        self._law = jax.tree.map(jnp.asarray, law)
        self._structure = plant_structure(design, basis, LARGEST)
        self._case = design.case._replace(
            initial=design.case.initial._replace(
                modal=np.zeros((design.structure.n_links, LARGEST))
            ),
            n_modes=jnp.asarray(LARGEST),
        )
        self._pose = _home(design)

    def __call__(self, stiffness: float, delay: float, payload: float) -> float:
        machine = self._case.machine
        beam = machine.beam._replace(stiffness_factor=stiffness * machine.beam.stiffness_factor)
        masses = machine.masses._replace(payload_mass=payload + machine.masses.payload_mass)
        case = self._case._replace(machine=machine._replace(beam=beam, masses=masses))
        matrix = _delayed_loop(
            self._structure, case, self._pose, self._law, jnp.asarray(float(delay))
        )
        return float(np.abs(eigenvalues(np.asarray(matrix))).max())
