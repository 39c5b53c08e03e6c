"""The verbs of one machine: `simulate`, `modes`, `plant`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from studies.result import in_folder
from studies.verbs import check_file, verb

if TYPE_CHECKING:
    from studies.engine.modes import NamedModes
    from studies.single.plant import NamedSystem
    from studies.single.run import Simulation
    from studies.study.spec import Study


@verb
def simulate(
    what: Study | str | Path,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    report: bool = False,
    margins: bool = False,
) -> Simulation:
    """Run one study with full trajectories; a case of a sweep is compared with what that found.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: HDF5 file for the trajectories.
        case: case of a sweep (number or id:...) or family of a tuning.
        report: also write a report with figures, HTML, next to that file.
        margins: also disk, phase and delay margin of the loop.

    Returns:
        The run, and the same without control; `is_good`: whether it ended well and as in the sweep.

    Raises:
        StudyError: a fault of the study, or a file that cannot be written.

    Example:
        >>> simulate("paper").run.result.metrics.residual_rms  # doctest: +SKIP
    """
    from studies.config import require_configured
    from studies.single.run import simulated

    require_configured()
    return simulated(what, out, case, report, margins)


@verb
def modes(
    what: Study | str | Path | None = None,
    out: str | Path | None = None,
    *,
    pose: Sequence[float] | None = None,
    kp: float | None = None,
    kd: float | None = None,
    damping: float | None = None,
    locked: bool | None = None,
    basis: str | None = None,
    n_modes: int | None = None,
) -> NamedModes:
    """Natural frequencies and damping ratios of the assembled machine.

    Args:
        what: study, its file or ready-made design; default: the paper's machine, undamped.
        out: JSON file for the modes.
        pose: x and y in m and, of a rigid body, phi in rad, with commas between them, as in
            0,0.01,0.5236; default: the first pose.
        kp: drive stiffness [N/m], 0 = free drives.
        kd: drive damping [N s/m].
        damping: structural damping ratio [1].
        locked: hold the actuated joints.
        basis: modal basis of the links.
        n_modes: modes per link.

    Returns:
        Natural modes, ascending in frequency, and what holds their energy.

    Raises:
        StudyError: a value out of range, or a pose out of reach.

    Example:
        >>> modes("paper", pose=(0.0, 0.01, 0.5236)).names  # doctest: +SKIP
    """
    from studies.config import require_configured
    from studies.engine.design import as_design
    from studies.engine.modes import machine_modes
    from studies.publish import replacing
    from studies.results.document import json_text

    require_configured()
    check_file(out, ".json")
    study, place = None if what is None else as_design(what).study, pose and tuple(pose)
    found = machine_modes(
        study,
        pose=place,
        kp=kp,
        kd=kd,
        damping=damping,
        locked=locked,
        basis=basis,
        n_modes=n_modes,
    )
    if out is not None:
        with replacing(out) as temporary:
            temporary.write_text(json_text(found), encoding="utf-8")
    return in_folder(found, None if out is None else Path(out))


@verb
def plant(
    what: Study | str | Path,
    out: str | Path | None = None,
    *,
    case: int | str | None = None,
    controller: bool = False,
) -> NamedSystem:
    """Write the sampled linear plant of a design, for a controller designed elsewhere.

    Args:
        what: study, its file, ready-made design, folder of a tuning or sweep.
        out: NPZ, MAT or JSON file, with the names that [state_space] reads.
        case: case of a sweep (number or id:...) or family of a tuning.
        controller: its controller instead, of any law that does not switch.

    Returns:
        The system between commands and sensors, over one sample.

    Raises:
        StudyError: nothing is sampled, the study cannot run, or the file cannot be written.

    Example:
        >>> plant("paper").inputs[0]  # doctest: +SKIP
        'actuator 1.1'
    """
    from studies.config import require_configured
    from studies.engine.design import as_design
    from studies.single.plant import controller_of, plant_of, write_system
    from studies.study.state_space import FORMATS

    require_configured()
    check_file(out, *FORMATS)
    study = as_design(what, case).study
    found = controller_of(study) if controller else plant_of(study)
    if out is not None:
        write_system(found, out)
    return in_folder(found, None if out is None else Path(out))
