"""Some machines as whole simulations: nonlinear, sampled, with converters and delay."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from studies.engine.batches import ProgressCallback, run_batches
from studies.engine.preflight import check_run
from studies.papers.rrr_2016.energies import LINKS, NONE, PLUCKED, free_energies
from studies.papers.rrr_2016.machines import MachineSample, one_study
from studies.study.spec import Study

#: Pluck of a link's first mode [m], and how long its vibration is followed [s].
PLUCK, FOLLOWED = 1e-5, 1.5
#: Modes per link.
MODES = 3


class Confirmed(NamedTuple):
    """Of one machine, with link 1 controlled; shape (3,): links."""

    linear: np.ndarray  # reduction after plucks of all links, linear plant, ideal feedback [1]
    simulated: np.ndarray  # the same, simulated [1]
    linear_ratio: float  # coupling ratio from link 1 to links 2 and 3, linear plant [1]
    simulated_ratio: float  # simulated [1]


def confirm(machines: MachineSample, k: int, on_progress: ProgressCallback) -> Confirmed:
    """Simulate a machine with plucked links, without control and with link 1 controlled.

    Args:
        machines: the sample.
        k: of the machine.
        on_progress: called with progress messages.

    Raises:
        StudyError: it cannot run.
    """
    study = one_study(machines, k)
    built = [
        check_run(_plucked(study, link, is_on)) for is_on in (False, True) for link in range(3)
    ]
    structure = built[0][0]._replace(substeps=max(one.substeps for one, _ in built))
    result = run_batches(structure, [case for _, case in built], on_progress)
    assert result.record is not None
    bending = np.asarray(result.record.chord_deflection_stations)[..., 0]
    energy = np.sum(bending**2, axis=1).reshape(2, 3, 3)  # by control, plucked link, link
    rows = {name: column[k : k + 1] for name, column in machines.columns.items()}
    linear = free_energies(machines.study, rows, machines.poses[k : k + 1], MODES)
    value = np.swapaxes(linear.value[0, :2, LINKS, PLUCKED], 1, 2)
    return Confirmed(
        linear=_reduction(value),
        simulated=_reduction(energy),
        linear_ratio=_ratio(value[NONE]),
        simulated_ratio=_ratio(energy[NONE]),
    )


def _plucked(study: Study, link: int, is_on: bool) -> Study:
    modal = [[PLUCK if i == link else 0.0] for i in range(3)]
    return study.change(
        initial__modal=modal,
        control__links=(is_on, False, False),
        control__modes=1,
        link__modes=MODES,
        metrics__stations=(0.5,),
        metrics__residual_delay=0.0,
        metrics__residual_length=FOLLOWED / 2,
        run__duration=FOLLOWED,
    )


def _reduction(energy: np.ndarray) -> np.ndarray:
    """Of each link, from energies by control, plucked link and link, (3,)."""
    off, on = energy.sum(axis=1)
    return 1 - np.sqrt(on / off)


def _ratio(energy: np.ndarray) -> float:
    """Coupling ratio from link 1, energies by plucked link and link."""
    return float(np.sqrt(np.mean(energy[0, 1:] / energy[0, 0])))
