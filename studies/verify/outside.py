"""The model beside figures of others: a public benchmark, the paper's machine in finite elements.

These rows do not depend on the study: they check the code that all studies run through.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.defaults import HOME
from jaxmodel.linear import linearise, natural_modes
from jaxmodel.prepare import prepare
from jaxmodel.simulate import simulate
from studies.engine.programs import kept_jit
from studies.engine.stability import loop_report
from studies.reference import slider_crank, tables
from studies.reference.tables import BARE
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study, paper_study
from studies.verify.rows import Assumption, largest, worst_relative

_FE = "independent finite elements 2025"


def check_outside(_: Study) -> list[Assumption]:
    """Slider crank, frequencies, free response, fast move, closed loop."""
    return [*_crank(), *_frequencies(), _release(), *_fast_move(), *_closed_loop()]


def _crank() -> list[Assumption]:
    """Both rows of the benchmark: with the rod's ends at their distance, and inextensible."""
    # the first one's published peak is that of its output's instants
    how = {"none": ("rod of constant chord", 2, 5e-6), "distributed": ("inextensible rod", 3, 1e-3)}
    return [
        Assumption(
            assumption=f"slider crank with a flexible rod: {text}",
            against="bending at 0.1 s"
            + (" and its peak" if count > 2 else "")
            + ", by other codes",
            source="Simeon 1996 (IVPTestset)",
            difference=worst_relative(
                slider_crank.figures(name)[:count], slider_crank.ROWS[name][:count]
            ),
            allowed=allowed,
        )
        for name, (text, count, allowed) in how.items()
    ]


@cache
def _undamped() -> Study:
    changes = {"control__feedback": "none", "shaper__kind": "none"}
    return paper_study().change(**BARE, **changes, link__modes=8, link__damping_ratio=0.0)


@kept_jit(static_argnums=0)
def _linear(structure: Structure, case: Case, pose: np.ndarray) -> Any:
    return linearise(structure, prepare(structure, case).loop, pose)


def _frequencies() -> list[Assumption]:
    """Natural frequencies at home with sliders locked, free, and on springs."""
    rows, springs = [], "sliders_on_springs_2e4_N_per_m"
    for name, changes in tables.HELD.items():
        study = _undamped().change(drive__kd=0.0, **changes)
        plant = _linear(build_structure(study), as_arrays(build_case(study)), np.array(HOME))
        found = natural_modes(jax.tree.map(np.asarray, plant)).frequency
        wanted = tables.frequencies(name)
        held = "sliders on springs of 20 kN/m" if name == springs else name.replace("_", " ")
        found = found[found > 1][: len(wanted)]
        rows.append(
            Assumption(
                assumption=f"natural frequencies, {held}",
                against="cable elements, 48 a link",
                source=_FE,
                difference=worst_relative(found, wanted) if len(found) == len(wanted) else np.inf,
                allowed=3e-5,
            )
        )
    return rows


_simulate = kept_jit(static_argnums=(0, 2))(simulate)


def _record(study: Study) -> Any:
    """Trajectories of a run, NumPy arrays."""
    result = _simulate(build_structure(study), as_arrays(build_case(study)), True)
    return jax.tree.map(np.asarray, result.record)


def _release() -> Assumption:
    """Link 1 bent by a force at mid-span and released."""
    time, wanted = tables.free_response()
    study = _undamped().change(
        drive__locked=True,
        run__duration=0.0501,
        motion__waypoints=((0.0, 0.0, HOME[2]),),
        initial__load_station=0.1,
        initial__load_deflection=(5e-5, 0.0, 0.0),
        metrics__stations=(0.5,),
    )
    record = _record(study)
    at = np.round(time / 1e-4).astype(int)
    return Assumption(
        assumption="free vibration of a bent link",
        against="mid-span for 50 ms, cable elements",
        source=_FE,
        difference=largest(record.chord_deflection_stations[at, 0, 0], wanted),
        allowed=1e-3,
    )


def _fast_move() -> list[Assumption]:
    """Square of 10 mm in 0.05 s a move: bending on the way and residual vibration, platform."""
    given = tables.fast_move()
    study = _undamped().change(
        drive__kd=60.0,
        motion__move_time=0.05,
        run__duration=0.3001,
        metrics__stations=(0.5,),
        metrics__residual_delay=0.0,
        metrics__residual_length=0.1,
    )
    record = _record(study)
    at = np.round(given.time / 1e-4).astype(int)
    bent, pose = record.chord_deflection_stations[at, :, 0], record.pose[at]
    after = given.time >= 0.2
    rest = np.sqrt(np.mean((bent - given.deflection)[after] ** 2))
    return [
        Assumption(
            assumption="bending of the links in fast moves (geometric stiffening)",
            against="mid-spans, cable elements, 10 mm in 0.05 s",
            source=_FE,
            difference=largest(bent, given.deflection),
            allowed=1e-3,
        ),
        Assumption(
            assumption="residual vibration after fast moves",
            against="the same, rms of the difference over rms",
            source=_FE,
            difference=float(rest / np.sqrt(np.mean(given.deflection[after] ** 2))),
            allowed=5e-3,
        ),
        Assumption(
            assumption="platform in fast moves, on its drive",
            against="the same, over 10 mm",
            source=_FE,
            difference=float(np.abs(pose - given.pose)[:, :2].max() / 0.01),
            allowed=1e-3,
        ),
    ]


def _closed_loop() -> list[Assumption]:
    """Margin and damping of bare links under half the paper's gains."""
    study = paper_study().change(**BARE, link__modes=12)
    structure, case = build_structure(study), as_arrays(build_case(study))
    loop = loop_report(structure, case, np.array(HOME), 1)
    margin, hertz, damping = tables.LOOP
    return [
        Assumption(
            assumption="closed loop: gain margin and the frequency at which it breaks",
            against="the exported C controller around cable elements",
            source=_FE,
            difference=worst_relative((loop.gain_margin, loop.breaking_frequency), (margin, hertz)),
            allowed=2e-3,
        ),
        Assumption(
            assumption="closed loop: damping of the three modes 1",
            against="the same",
            source=_FE,
            difference=worst_relative(np.sort(loop.damping_ratio[0]), np.sort(damping)),
            allowed=5e-3,
        ),
    ]
