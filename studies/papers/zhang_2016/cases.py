"""The cases of the paper's sections 4 and 5, and how they run: two passes of one compiled batch.

First pass: no control. Its modal energies give the controlled cases of section 4 the ratios (24) of
their own uncontrolled counterparts, as in the paper; section 5 takes the ratios that it prints.
Second pass: the controlled cases. They differ only in numbers, so one program, compiled once for a
fixed number of cases, runs all cases of a machine: XLA's scan, since a kernel would take longer to
trace than the scan takes for these few cases (docs/performance.md).
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.loop import Record
from jaxmodel.simulate import RunResult
from studies.engine.batches import run_batches
from studies.engine.frame import SharedFrame, frame_of
from studies.engine.preflight import check_run
from studies.engine.programs import kept_jit
from studies.engine.runs import judged_status, run_study
from studies.engine.stability import LoopFigures, loop_report
from studies.study.files import READY
from studies.study.spec import Study, load_study

#: The paper's move and a faster one that leaves vibration to suppress [s].
MOVES = {"paper": 0.1, "fast": 0.04}


#: Move and shaper of the cases that are compared with the paper's numbers, on every machine.
COMPARED = ("fast", "none")


SHAPERS = ("ei", "none")


OFF, ALL, TWO, ONE = (False,) * 3, (True,) * 3, (True, True, False), (True, False, False)


#: The paper's ratios (26), simulation.
PAPER_RATIOS = ((1.0, 0.345, 0.045), (1.0, 0.304, 0.041), (1.0, 0.321, 0.038))


#: The paper's ratios (27), experiment, two modes.
EXPERIMENT_RATIOS = ((1.0, 0.312, 0.0), (1.0, 0.412, 0.0), (1.0, 0.355, 0.0))


#: Ratios that control only mode 1, as in the paper's comparison experiments.
FIRST_MODE = ((1.0, 0.0, 0.0),) * 3


#: Ratios that do not depend on a run.
GIVEN_RATIOS = {
    "paper (26)": PAPER_RATIOS,
    "paper (27)": EXPERIMENT_RATIOS,
    "mode 1 only": FIRST_MODE,
}


#: Structural damping that would explain the decay the paper sees without control [1].
HIGH_DAMPING = 0.05


class PaperCase(NamedTuple):
    """One case, by its distinguishing settings."""

    name: str
    move: str  # key of MOVES
    shaper: str
    modes: int  # modes separated by the modal filter, 3 in section 4, 2 in section 5
    links: tuple[bool, ...] = OFF  # controlled
    ratio_from: str = "none"  # "own run", a key of GIVEN_RATIOS, "none"
    gain_factor: float = 1.0  # on the machine's gains
    feedback: str = "sampled"
    estimator: str = "modal_phase"
    damping_ratio: float | None = None  # of the links; None: the machine's

    @property
    def counterpart(self) -> tuple[Any, ...]:
        """What a controlled case shares with the uncontrolled one that supplies its ratios."""
        return self.move, self.shaper, self.modes, self.damping_ratio

    @property
    def is_controlled(self) -> bool:
        return any(self.links)

    @property
    def is_compared(self) -> bool:
        """With the paper's numbers, on every machine."""
        return (self.move, self.shaper) == COMPARED and not self.is_extra

    @property
    def is_extra(self) -> bool:
        """Outside the grid of moves, shapers, modes and links."""
        return not self.name.startswith(f"{self.move}-{self.shaper}-")

    @property
    def links_text(self) -> str:
        """Controlled links in words."""
        return "+".join(str(i + 1) for i in range(3) if self.links[i]) or "none"


class PaperRuns(NamedTuple):
    """Everything computed for one machine; leading axis of arrays: cases."""

    study: Study
    frame: SharedFrame
    cases: list[PaperCase]
    result: RunResult
    status: np.ndarray  # codes; UNSTABLE if the linearised sampled loop is, (n,)
    ratio: np.ndarray  # gains of the modes over that of mode 1 [1], (n, 3, C)
    loops: dict[str, LoopFigures]  # by case name, if the loop was linearised
    link_hz: np.ndarray  # frequencies of each link between held ends [Hz], (3, C)

    @property
    def record(self) -> Record:
        """Trajectories, which every run here keeps."""
        assert self.result.record is not None
        return self.result.record

    def where(self, **fields: Any) -> int:
        """Index of the first case with these values."""
        for k, case in enumerate(self.cases):
            if all(getattr(case, field) == value for field, value in fields.items()):
                return k
        raise KeyError(fields)


def fitted_study() -> Study:
    """The machine fitted to the paper's measurements, `studies/specs/paper_fitted.toml`."""
    return load_study(READY / "paper_fitted.toml")


def paper_cases() -> list[PaperCase]:
    """All cases, uncontrolled ones first."""
    off, on = [], []
    for move in MOVES:
        for shaper in SHAPERS:
            for modes in (3, 2):
                stem, same = f"{move}-{shaper}-{modes}modes", (move, shaper, modes)
                off.append(PaperCase(f"{stem}-off", *same))
                for links, label in ((ALL, "links123"), (TWO, "links12"), (ONE, "links1")):
                    experiment = "paper (27)" if links == ALL else "mode 1 only"
                    source = "own run" if modes == 3 else experiment
                    on.append(PaperCase(f"{stem}-{label}", *same, links, source))
    off.append(PaperCase("damped-off", "fast", "none", 3, damping_ratio=HIGH_DAMPING))
    fast = partial(PaperCase, move="fast", shaper="none", modes=3, links=ALL)
    on += [
        fast("damped-links123", ratio_from="own run", damping_ratio=HIGH_DAMPING),
        fast("weak", ratio_from="own run", gain_factor=0.02),
        # the paper's gains are twice the nominal machine's
        fast("paper-gains-own-ratios", ratio_from="own run", gain_factor=2.0),
        fast("paper-ratios", ratio_from="paper (26)"),
        fast("paper-preset", ratio_from="paper (26)", gain_factor=2.0),
        fast("difference", ratio_from="paper (26)", gain_factor=2.0, estimator="difference"),
        fast("ideal", ratio_from="paper (26)", gain_factor=2.0, feedback="ideal"),
    ]
    return off + on


#: Cases whose linearised sampled loop is also judged (seconds each).
JUDGED = (
    "fast-none-3modes-links123",
    "damped-links123",
    "weak",
    "paper-gains-own-ratios",
    "paper-ratios",
    "paper-preset",
    "difference",
)


def case_study(base: Study, case: PaperCase, ratio: np.ndarray | None = None) -> Study:
    """The study of one case; ratio (3, C) as in (24), or the paper's."""
    damping = base.link.damping_ratio if case.damping_ratio is None else case.damping_ratio
    rows = PAPER_RATIOS if ratio is None else tuple(tuple(map(float, row)) for row in ratio)
    return base.change(
        title=case.name,
        motion__move_time=MOVES[case.move],
        shaper__kind=case.shaper,
        link__damping_ratio=damping,
        control__modes=3,  # upper bound; `build_paper_case` sets how many are separated
        control__links=case.links,
        control__ratios=rows,
        control__gain_factor=case.gain_factor * base.control.gain_factor,
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


def run_cases(base: Study, cases: list[PaperCase], say: Callable[[str], object]) -> PaperRuns:
    """Run the paper's cases.

    Args:
        base: the machine; move, shaper and control come from the cases.
        cases: including the uncontrolled counterparts of all controlled ones.
        say: called with what is done next.

    Returns:
        PaperRuns, cases in the order: uncontrolled, controlled, ideal feedback.

    Raises:
        StudyError: as `check_run`.
    """
    say("checking the cases")
    off = [case for case in cases if not case.is_controlled]
    on = [case for case in cases if case.is_controlled and case.feedback == "sampled"]
    ideal = [case for case in cases if case.feedback == "ideal"]
    # a program of its own, compiled on the second core while the first one runs the batches
    with ThreadPoolExecutor(1) as side:
        ideal_runs = [side.submit(_run_ideal, base, case, say) for case in ideal]
        built = [build_paper_case(base, case) for case in off]
        structure = built[0][0]
        frame = frame_of(structure, built[0][1])
        results = [run_batches(structure, [arrays for _, arrays in built], say)]
        energy_ratio = results[0].metrics.energy_ratio
        by_counterpart = {case.counterpart: energy_ratio[k] for k, case in enumerate(off)}
        ratios = [_ratio(case, by_counterpart) for case in on]
        arrays = [build_paper_case(base, case, r)[1] for case, r in zip(on, ratios, strict=True)]
        results += [run_batches(structure, arrays, say)] if arrays else []
        loops = _judge(structure, {c.name: a for c, a in zip(on, arrays, strict=True)}, base, say)
        results += [run.result() for run in ideal_runs]
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
        link_hz=np.asarray(link_hz(structure, built[0][1])),
    )


@kept_jit(static_argnums=0)
def link_hz(structure: Structure, case: Case) -> Any:
    """Frequencies of each link between held ends [Hz], (3, C)."""
    return find_bases(structure, case).plant_omega / (2 * jnp.pi)


def _run_ideal(base: Study, case: PaperCase, say: Callable[[str], object]) -> RunResult:
    """A case with ideal feedback, as a batch of one."""
    say("simulating ideal feedback")
    result = run_study(case_study(base, case), has_loop=False).result
    return jax.tree.map(lambda x: np.asarray(x)[None], result)


def _ratio(case: PaperCase, by_counterpart: dict[tuple[Any, ...], np.ndarray]) -> np.ndarray:
    if case.ratio_from == "own run":
        return by_counterpart[case.counterpart]
    return np.array(GIVEN_RATIOS[case.ratio_from])


def _judge(
    structure: Structure, arrays: dict[str, Case], base: Study, say: Callable[[str], object]
) -> dict[str, LoopFigures]:
    """Linearised sampled loops of the JUDGED cases at home."""
    loops = {}
    for name in [name for name in JUDGED if name in arrays]:
        say("judging the linearised sampled loop")
        loops[name] = loop_report(structure, arrays[name], np.array(base.motion.waypoints[0]))
    return loops
