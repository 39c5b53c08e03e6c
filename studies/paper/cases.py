"""The cases of the paper's sections 4 and 5, and how they run: two passes of one compiled batch.

First pass: no control. Its modal energies give every controlled case the ratios (24) of its own
uncontrolled counterpart, as in the paper. Second pass: the controlled cases. They differ only in
numbers, so one program, compiled once for a fixed number of cases, runs them all.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.loop import Record
from jaxmodel.simulate import Result
from studies.engine.batches import BATCH, Tell, run_batches
from studies.engine.frame import SharedFrame, frame_of
from studies.engine.runs import check_run, judged_status, run_study
from studies.engine.stability import LoopReport, loop_report
from studies.study.spec import Flags, Study

#: Executor. A kernel would take longer to trace than the scan takes for these few cases
#: (docs/performance.md).
EXECUTOR = "XLA scan, with trajectories"


#: The paper's move and a faster one that leaves vibration to suppress [s].
MOVES = {"paper": 0.1, "fast": 0.05}


SHAPERS = ("ei", "none")


OFF, ALL, TWO, ONE = (False,) * 3, (True,) * 3, (True, True, False), (True, False, False)


#: The paper's velocity gains of mode 1 [N s/m].
PAPER_GAINS = (3.1, 3.5, 3.4)


#: The paper's ratios (26), simulation.
PAPER_RATIOS = ((1.0, 0.345, 0.045), (1.0, 0.304, 0.041), (1.0, 0.321, 0.038))


#: Ratios that control only mode 1, as in the paper's comparison experiments.
FIRST_MODE = ((1.0, 0.0, 0.0),) * 3


#: Structural damping that would explain the decay the paper sees without control [1].
HIGH_DAMPING = 0.05


class PaperCase(NamedTuple):
    """One case, by its distinguishing settings."""

    name: str
    move: str  # key of MOVES
    shaper: str
    modes: int  # modes separated by the modal filter, 3 in section 4, 2 in section 5
    links: Flags = OFF  # controlled
    ratio_from: str = "none"  # "own run", "paper (26)", "mode 1 only", "none"
    gain_factor: float = 0.5  # on the paper's gains; the default design has half of them
    feedback: str = "sampled"
    estimator: str = "modal_phase"
    damping_ratio: float = 0.01  # of the links

    @property
    def counterpart(self) -> tuple[Any, ...]:
        """What a controlled case shares with the uncontrolled one that supplies its ratios."""
        return self.move, self.shaper, self.modes, self.damping_ratio

    @property
    def is_controlled(self) -> bool:
        return any(self.links)

    @property
    def is_extra(self) -> bool:
        """Outside the grid of moves, shapers, modes and links."""
        return not self.name.startswith(f"{self.move}-{self.shaper}-")

    @property
    def links_text(self) -> str:
        """Controlled links in words."""
        return "+".join(str(i + 1) for i in range(3) if self.links[i]) or "none"


class EnergyRatio(NamedTuple):
    """Ratios (24) of an uncontrolled run, in one basis."""

    move: str
    shaper: str
    basis: str
    ratio: np.ndarray  # (3, C)


class PaperRuns(NamedTuple):
    """Everything the paper's study computed; leading axis of arrays: cases."""

    study: Study
    frame: SharedFrame
    cases: list[PaperCase]
    result: Result
    status: np.ndarray  # codes; UNSTABLE if the linearised sampled loop is, (n,)
    ratio: np.ndarray  # gains of the modes over that of mode 1 [1], (n, 3, C)
    loops: dict[str, LoopReport]  # by case name, if the loop was linearised
    energy_ratio: list[EnergyRatio]

    @property
    def record(self) -> Record:
        """Trajectories, which every run here keeps."""
        assert self.result.record is not None
        return self.result.record

    def where(self, **wanted: Any) -> int:
        """Index of the first case with these values."""
        for k, case in enumerate(self.cases):
            if all(getattr(case, field) == value for field, value in wanted.items()):
                return k
        raise KeyError(wanted)


def paper_cases() -> list[PaperCase]:
    """All cases, uncontrolled ones first."""
    off, on = [], []
    for move in MOVES:
        for shaper in SHAPERS:
            for modes in (3, 2):
                stem, same = f"{move}-{shaper}-{modes}modes", (move, shaper, modes)
                off.append(PaperCase(f"{stem}-off", *same))
                for links, label in ((ALL, "links123"), (TWO, "links12"), (ONE, "links1")):
                    is_comparison = modes == 2 and links != ALL
                    source = "mode 1 only" if is_comparison else "own run"
                    on.append(PaperCase(f"{stem}-{label}", *same, links, source))
    off.append(PaperCase("damped-off", "fast", "none", 3, damping_ratio=HIGH_DAMPING))
    fast = partial(PaperCase, move="fast", shaper="none", modes=3, links=ALL)
    on += [
        fast("damped-links123", ratio_from="own run", damping_ratio=HIGH_DAMPING),
        fast("weak", ratio_from="own run", gain_factor=0.01),
        fast("paper-gains-own-ratios", ratio_from="own run", gain_factor=1.0),
        fast("paper-ratios", ratio_from="paper (26)"),
        fast("paper-preset", ratio_from="paper (26)", gain_factor=1.0),
        fast("difference", ratio_from="paper (26)", gain_factor=1.0, estimator="difference"),
        fast("ideal", ratio_from="paper (26)", gain_factor=1.0, feedback="ideal"),
    ]
    return off + on


#: Cases whose linearised sampled loop is also judged (seconds each).
JUDGED = (
    "fast-none-3modes-links123",
    "damped-links123",
    "paper-gains-own-ratios",
    "paper-ratios",
    "paper-preset",
    "difference",
)


def case_study(base: Study, case: PaperCase, ratio: np.ndarray | None = None) -> Study:
    """The study of one case; ratio (3, C) as in (24), or the paper's."""
    rows = PAPER_RATIOS if ratio is None else tuple(tuple(map(float, row)) for row in ratio)
    return base.change(
        title=case.name,
        motion__move_time=MOVES[case.move],
        shaper__kind=case.shaper,
        link__damping_ratio=case.damping_ratio,
        control__modes=3,  # upper bound; `build_paper_case` sets how many are separated
        control__links=case.links,
        control__velocity_gain=PAPER_GAINS,
        control__ratios=rows,
        control__gain_factor=case.gain_factor,
        control__feedback=case.feedback,
        electronics__estimator=case.estimator,
    )


def build_paper_case(
    base: Study, case: PaperCase, ratio: np.ndarray | None = None
) -> tuple[Structure, Case]:
    """Arrays of one case, checked. Raises StudyError as `check_run` does."""
    structure, arrays = check_run(case_study(base, case, ratio))
    count = jnp.asarray(case.modes, arrays.control.n_active.dtype)
    return structure, arrays._replace(control=arrays.control._replace(n_active=count))


def run_cases(base: Study, cases: list[PaperCase], tell: Tell) -> PaperRuns:
    """Run the paper's cases.

    Args:
        base: the machine; move, shaper and control come from the cases.
        cases: including the uncontrolled counterparts of all controlled ones.
        tell: called with progress messages.

    Returns:
        PaperRuns, cases in the order: uncontrolled, controlled, ideal feedback.

    Raises:
        StudyError: as `check_run`.
    """
    tell("checking the cases", 0.0)
    off = [case for case in cases if not case.is_controlled]
    on = [case for case in cases if case.is_controlled and case.feedback == "sampled"]
    ideal = [case for case in cases if case.feedback == "ideal"]
    # separate programs, compiled on the second core while the first one runs the batches
    with ThreadPoolExecutor(1) as side:
        free = side.submit(_pinned_free_ratios, base, off, tell)
        ideal_runs = [side.submit(_run_ideal, base, case, tell) for case in ideal]
        built = [build_paper_case(base, case) for case in off]
        structure = built[0][0]
        frame = frame_of(structure, built[0][1])
        results = [run_batches(structure, [arrays for _, arrays in built], tell)]
        energy_ratio = results[0].metrics.energy_ratio
        by_counterpart = {case.counterpart: energy_ratio[k] for k, case in enumerate(off)}
        ratios = [_ratio(case, by_counterpart) for case in on]
        arrays = [build_paper_case(base, case, r)[1] for case, r in zip(on, ratios, strict=True)]
        results += [run_batches(structure, arrays, tell)] if arrays else []
        loops = _judge(structure, {c.name: a for c, a in zip(on, arrays, strict=True)}, base, tell)
        results += [run.result() for run in ideal_runs]
        rows = [
            EnergyRatio(case.move, case.shaper, structure.controller_basis, energy_ratio[k])
            for k, case in enumerate(off)
            if case.modes == 3 and not case.is_extra
        ] + free.result()
    result = jax.tree.map(lambda *x: np.concatenate(x), *results)
    ordered = off + on + ideal
    gains = np.array([*(0 * energy_ratio), *ratios, *(np.array(PAPER_RATIOS) for _ in ideal)])
    codes = np.array(result.status)
    for k, case in enumerate(ordered):
        if case.name in loops:
            codes[k] = judged_status(int(codes[k]), loops[case.name])
    return PaperRuns(
        study=base,
        frame=frame,
        cases=ordered,
        result=result,
        status=codes,
        ratio=gains,
        loops=loops,
        energy_ratio=rows,
    )


def _run_ideal(base: Study, case: PaperCase, tell: Tell) -> Result:
    """A case with ideal feedback, as a batch of one."""
    tell("simulating ideal feedback", 0.0)
    result = run_study(case_study(base, case), has_loop=False).result
    tell("simulated ideal feedback", 1.0)
    return jax.tree.map(lambda x: np.asarray(x)[None], result)


def _ratio(case: PaperCase, by_counterpart: dict[tuple[Any, ...], np.ndarray]) -> np.ndarray:
    if case.ratio_from == "own run":
        return by_counterpart[case.counterpart]
    return np.array(PAPER_RATIOS if case.ratio_from == "paper (26)" else FIRST_MODE)


def _judge(
    structure: Structure, arrays: dict[str, Case], base: Study, tell: Tell
) -> dict[str, LoopReport]:
    """Linearised sampled loops of the JUDGED cases at home."""
    loops = {}
    for name in [name for name in JUDGED if name in arrays]:
        tell("judging the linearised sampled loop", 0.0)
        loops[name] = loop_report(structure, arrays[name], np.array(base.motion.waypoints[0]))
        tell("judged the linearised sampled loop", 1.0)
    return loops


def _pinned_free_ratios(base: Study, off: list[PaperCase], tell: Tell) -> list[EnergyRatio]:
    """Ratios (24) of the unshaped uncontrolled runs in the paper's own coordinates."""
    rows = []
    study = base.change(control__basis="pinned_free")
    for case in _unshaped(off):
        tell("modal energies in pinned-free coordinates", 0.0)
        run = run_study(case_study(study, case), has_record=False, has_loop=False)
        rows.append(
            EnergyRatio(case.move, case.shaper, "pinned_free", run.result.metrics.energy_ratio)
        )
        tell("modal energies in pinned-free coordinates", 1.0)
    return rows


def _unshaped(off: list[PaperCase]) -> list[PaperCase]:
    return [case for case in off if case.shaper == "none" and case.modes == 3 and not case.is_extra]


def work_of(cases: list[PaperCase]) -> int:
    """Number of steps that `run_cases` reports for these cases."""
    off = [case for case in cases if not case.is_controlled]
    ideal = sum(case.feedback == "ideal" for case in cases)
    batches = -(-len(off) // BATCH) - (-(len(cases) - len(off) - ideal) // BATCH)
    return batches + ideal + len(_unshaped(off)) + sum(case.name in JUDGED for case in cases)
