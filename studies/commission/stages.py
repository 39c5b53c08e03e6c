"""The stages, each in its own folder and as its own command makes it; they meet in their files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich.console import Console

from studies.commission.machines import Possible, unknown_to_controller
from studies.commission.spec import MeasuredSpec, tuning_section
from studies.engine.design import Design, load_design
from studies.export.run import FAILED, export_design
from studies.export.run import REPORT as VERIFICATION
from studies.export.targets import TARGETS
from studies.fitting.run import DATA, DOCUMENT, STUDY, run_fit
from studies.publish import REPORT
from studies.reading import open_hdf5, read_json
from studies.spillover.run import DOCUMENT as CERTIFICATE
from studies.spillover.run import spillover_design
from studies.study.spec import Study, load_study
from studies.tuning.folder import PROGRESS
from studies.tuning.run import run_tuning
from studies.tuning.spec import parse_tuning


class Stage(NamedTuple):
    """One stage of a commissioning."""

    name: str  # of its folder
    text: str
    page: str  # its report
    last: tuple[str, ...]  # files of which one is written at its end
    make: Callable[[MeasuredSpec, Path, Console], None]  # in the folder of all stages

    def is_done(self, out: Path) -> bool:
        """Whether the folder holds its answer."""
        return any((out / self.name / file).is_file() for file in self.last)


def _fit(measured: MeasuredSpec, out: Path, console: Console) -> None:
    run_fit(measured.fit, out / "fit", console)


def _tune(measured: MeasuredSpec, out: Path, console: Console) -> None:
    study, folder = fitted_study(out), out / "tune"
    columns = unknown_to_controller(possible_machines(out), study)
    indexed = [name for name in columns if name.startswith("link.stiffness_factor[")]
    if indexed:  # one number for all links so far
        whole = tuple(np.broadcast_to(study.link.stiffness_factor, 3).tolist())
        study = study.change(link__stiffness_factor=whole)
    data = study.model_dump() | {"tune": tuning_section(measured, study, columns)}
    run_tuning(parse_tuning(data), folder, (folder / PROGRESS).is_file(), console)


def _certify(measured: MeasuredSpec, out: Path, console: Console) -> None:
    margin = measured.commission.gain_margin
    spillover_design(tuned_design(out), out / "certificate", margin, console)


def _export(measured: MeasuredSpec, out: Path, console: Console) -> None:
    wanted = measured.commission
    export_design(
        tuned_design(out),
        wanted.target,
        out / "firmware",
        console=console,
        dac_bits=wanted.dac_bits if TARGETS[wanted.target].has_dac else None,
        pil=wanted.processor or None,
    )


#: In their order.
STAGES = (
    Stage(
        name="fit",
        text="fit the model to the measurements",
        page=REPORT,
        last=(DOCUMENT,),
        make=_fit,
    ),
    Stage(
        name="tune",
        text="tune on machines that the data leave possible",
        page=REPORT,
        last=(REPORT,),
        make=_tune,
    ),
    Stage(
        name="certificate",
        text="certify on plants that differ from the model",
        page=REPORT,
        last=(CERTIFICATE,),
        make=_certify,
    ),
    Stage(
        name="firmware",
        text="export, compare, emulate",
        page=VERIFICATION,
        last=(VERIFICATION, FAILED),
        make=_export,
    ),
)


def fit_document(out: Path) -> dict[str, Any]:
    """`fit.json` of a commissioning."""
    return dict(read_json(out / "fit" / DOCUMENT))


def certificate_document(out: Path) -> dict[str, Any]:
    """`certificate.json` of a commissioning."""
    return dict(read_json(out / "certificate" / CERTIFICATE))


def fitted_study(out: Path) -> Study:
    """The study with the fitted numbers."""
    return load_study(out / "fit" / STUDY)


def tuned_design(out: Path) -> Design:
    """The tuned study."""
    return load_design(out / "tune")


def possible_machines(out: Path) -> Possible:
    """Machines that the data leave possible."""
    with open_hdf5(out / "fit" / DATA) as file:
        names = tuple(file["number"].asstr()[:].tolist())
        return Possible(names, np.asarray(file["machine"]))


def is_verified(out: Path) -> bool:
    """Whether the firmware's comparisons all agreed."""
    return (out / "firmware" / VERIFICATION).is_file()
