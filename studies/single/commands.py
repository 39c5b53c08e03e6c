"""The commands for single runs: simulate, replay, modes."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from studies.config import start
from studies.errors import field_error
from studies.options import Case, Design, HasReport, Precision
from studies.publish import announce
from studies.results.document import AsJson, print_document


def add_commands(app: typer.Typer, console: Console) -> None:
    """Add the commands to the command line."""

    @app.command()
    def simulate(
        study: Annotated[Path, typer.Argument(help="study file (TOML) or ready-made design")],
        out: Annotated[Path | None, typer.Option(help="HDF5 file for the trajectories")] = None,
        report: HasReport = False,
        margins: Annotated[
            bool, typer.Option("--margins", help="also disk, phase and delay margin of the loop")
        ] = False,
        precision: Precision = "float64",
        as_json: AsJson = False,
    ) -> None:
        """Run one study and print its metrics; with --out, also save full trajectories."""
        start(precision)
        from studies.engine.runs import uncontrolled_twin
        from studies.show.report import print_report
        from studies.single.run import simulate as simulate_study
        from studies.single.say import say

        run = simulate_study(study, out, report, margins)
        if as_json:
            from studies.single.documents import run_document

            print_document(run_document(run, uncontrolled_twin(run)))
        else:
            print_report(say(run, uncontrolled_twin(run)), console)
            _print_files(out, report, console)
        if run.status:
            sys.exit(1)

    @app.command()
    def replay(
        design: Design,
        case: Case = None,
        out: Annotated[Path | None, typer.Option(help="HDF5 file for the trajectories")] = None,
        report: HasReport = False,
    ) -> None:
        """Rerun one case of a sweep with full trajectories; compare with the sweep's results."""
        start()
        from studies.single.run import replay as replay_case
        from studies.study.labels import describe

        rerun = replay_case(design, case, out, report)
        console.print(f"{rerun.run.study.title}: {describe(rerun.run.status)}")
        for note in rerun.notes:
            console.print(note)
        _print_files(out, report, console)
        if not rerun.agrees:
            sys.exit(1)

    @app.command()
    def modes(
        study: Annotated[
            Path | None,
            typer.Argument(
                help="study file or ready-made design; default: the paper's machine, undamped"
            ),
        ] = None,
        pose: Annotated[
            str | None,
            typer.Option(
                help="x and y in m and, of a rigid body, phi in rad, with commas between them, as "
                "in 0,0.01,0.5236; default: the first pose"
            ),
        ] = None,
        kp: Annotated[
            float | None, typer.Option(help="drive stiffness [N/m], 0 = free drives")
        ] = None,
        kd: Annotated[float | None, typer.Option(help="drive damping [N s/m]")] = None,
        damping: Annotated[float | None, typer.Option(help="structural damping ratio [1]")] = None,
        locked: Annotated[
            bool | None, typer.Option("--locked", help="hold the actuated joints")
        ] = None,
        basis: Annotated[str | None, typer.Option(help="modal basis of the links")] = None,
        n_modes: Annotated[int | None, typer.Option("--modes", help="modes per link")] = None,
        as_json: AsJson = False,
    ) -> None:
        """Natural frequencies and damping ratios of the assembled machine."""
        start()
        from studies.engine.modes import machine_modes
        from studies.show.report import print_report
        from studies.single.modes import say
        from studies.study.spec import load_study

        result = machine_modes(
            None if study is None else load_study(study),
            pose=None if pose is None else _numbers("--pose", pose),
            kp=kp,
            kd=kd,
            damping=damping,
            locked=locked,
            basis=basis,
            n_modes=n_modes,
        )
        if as_json:
            print_document(result)
            return
        if study is None:
            console.print(
                "the paper's machine without damping; with it: studies modes paper", soft_wrap=True
            )
        print_report(say(result), console)

    @app.command()
    def plant(
        design: Design,
        out: Annotated[Path, typer.Option(help="NPZ, MAT or JSON file")],
        case: Case = None,
    ) -> None:
        """Write the sampled linear plant of a design, for a controller designed elsewhere."""
        start()
        from studies.engine.design import load_design
        from studies.single.plant import plant_of, write_system

        found = plant_of(load_design(design, case).study)
        write_system(found, out)
        console.print(
            f"{len(found.a)} states, {len(found.inputs)} actuators to {len(found.outputs)} "
            f"sensors, {1e6 * found.sample_time:g} µs a sample; written: {out}",
            soft_wrap=True,
        )


def _numbers(option: str, written: str) -> tuple[float, ...]:
    """Numbers with commas between them."""
    try:
        return tuple(map(float, written.split(",")))
    except ValueError:
        raise field_error(option, written, "numbers with commas between them") from None


def _print_files(out: Path | None, has_report: bool, console: Console) -> None:
    if out is not None:
        console.print(f"written: {out}", soft_wrap=True)
    if out is not None and has_report:
        announce(console, out.with_suffix(".html"))
