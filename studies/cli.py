"""The command line. A command ends with exit code 0, or with 2 and one message; no traceback."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table
from typer.exceptions import Abort, TyperException

from studies.atlas.commands import add_commands as add_atlas
from studies.config import configure, start
from studies.errors import StudyError, field_error
from studies.export.commands import add_commands as add_export
from studies.spillover.commands import add_commands as add_spillover
from studies.sweeps.commands import add_commands
from studies.tuning.commands import add_commands as add_tuning

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
#: Columns of tables where nobody watches; a terminal's own width otherwise.
FILE_WIDTH = 240
is_watched = sys.stdout.isatty() or "COLUMNS" in os.environ
console = Console(
    highlight=False,
    markup=False,  # a unit in brackets is no markup
    width=None if is_watched else FILE_WIDTH,
)


REPORT_HELP = "write a report with figures, Markdown and HTML, beside it"

#: Exit code after Ctrl-C.
INTERRUPTED = 130


def main(arguments: list[str] | None = None) -> None:
    """Entry point of the `studies` command."""
    try:
        if app(args=arguments, standalone_mode=False) == INTERRUPTED:
            raise KeyboardInterrupt
    except (StudyError, TyperException) as error:
        text = error.format_message() if isinstance(error, TyperException) else str(error)
        if text:  # none where help has been printed for want of a command
            print(f"studies: {text}", file=sys.stderr)
        sys.exit(2)
    except (KeyboardInterrupt, Abort):
        print("studies: interrupted", file=sys.stderr)
        sys.exit(INTERRUPTED)
    except Exception as error:
        from studies.extensions import blamed

        if not (reason := blamed(error)):
            raise
        print(f"studies: {reason}", file=sys.stderr)
        sys.exit(2)


@app.callback()
def prepare(
    own: Annotated[
        list[str] | None,
        typer.Option(
            "--with",
            help="Python file or module with laws, metrics, sweep methods or export targets of "
            "your own",
        ),
    ] = None,
) -> None:
    """Parameter studies of a planar 3-PRR manipulator with flexible links."""
    if own:
        configure()  # before any JAX operation of these files
        from studies.extensions import extend

        for module in own:
            extend(module)


@app.command()
def paper(
    out: Annotated[Path, typer.Option(help="folder for data, figures and report")],
    precision: Annotated[str, typer.Option(help="float64 or float32")] = "float64",
) -> None:
    """Run the paper's study: data, counterparts of its figures, report beside its numbers."""
    start(precision)
    from studies.paper.run import run_paper

    run_paper(out, console)


@app.command()
def simulate(
    study: Annotated[Path, typer.Argument(help="study file (TOML) or ready design")],
    out: Annotated[Path, typer.Option(help="HDF5 file to write")],
    report: Annotated[bool, typer.Option("--report", help=REPORT_HELP)] = False,
    precision: Annotated[str, typer.Option(help="float64 or float32")] = "float64",
) -> None:
    """Run one study with full trajectories."""
    start(precision)
    from studies.engine.runs import run_study
    from studies.show.run_report import check_results, settling_text, write_results
    from studies.space.spec import ready_spec
    from studies.study.labels import describe
    from studies.study.margin import caution, margin_text
    from studies.study.spec import load_study

    spec = load_study(ready_spec(study))
    check_results(out, report)
    run = run_study(spec)
    written = write_results(out, run, report)
    metrics = run.result.metrics
    console.print(f"status: {describe(run.status)}")
    table = Table("link", "residual rms, worst station [um]", "settling [ms]", "peak voltage [V]")
    for i in range(3):
        table.add_row(
            str(i + 1),
            f"{1e6 * metrics.residual_rms[i].max():.4g}",
            settling_text(run, i),
            f"{metrics.peak_voltage[i]:.4g}",
        )
    console.print(table)
    if run.loop is not None:
        margin = margin_text(run.loop.gain_margin)
        console.print(f"gain margin of the linearised sampled loop: {margin}")
        warning = caution(run.loop.gain_margin)
        if warning:
            console.print(f"[bold red]{warning}[/]", soft_wrap=True, markup=True)
    console.print(written, soft_wrap=True)


@app.command()
def replay(
    design: Annotated[Path, typer.Argument(help="study file, folder of a tuning or a sweep")],
    case: Annotated[str | None, typer.Option(help="number, or id: and digits of its id")] = None,
    out: Annotated[Path | None, typer.Option(help="HDF5 file for the trajectories")] = None,
    report: Annotated[bool, typer.Option("--report", help=REPORT_HELP)] = False,
) -> None:
    """Run one case of a sweep again with full trajectories, and compare with what it found."""
    start()
    from studies.engine.design import deviation, load_design
    from studies.engine.runs import run_study
    from studies.show.run_report import check_results, write_results
    from studies.study.labels import describe

    if report and out is None:
        raise StudyError("--report: is written beside the trajectories; name their file by --out")
    found = load_design(design, case)
    if out is not None:
        check_results(out, report)
    run = run_study(found.study)
    console.print(f"{found.study.title}: {describe(run.status)}")
    notes = []
    if found.stored:
        difference, name = deviation(run, found.stored)
        notes = [
            f"sweep: {describe(int(found.stored['status']))}; largest difference of a metric "
            f"{difference:.1e} of its size{f' ({name})' if name else ''}"
        ]
        console.print(*notes)
    if out is not None:
        console.print(write_results(out, run, report, notes), soft_wrap=True)


@app.command()
def modes(
    study: Annotated[
        Path | None,
        typer.Argument(help="study file or ready design; default: the paper's machine, undamped"),
    ] = None,
    pose: Annotated[
        tuple[float, float, float] | None,
        typer.Option(help="x [m] y [m] phi [rad]; default: the first"),
    ] = None,
    kp: Annotated[
        float | None, typer.Option(help="drive stiffness [N/m], 0 = free sliders")
    ] = None,
    kd: Annotated[float | None, typer.Option(help="drive damping [N s/m]")] = None,
    damping: Annotated[float | None, typer.Option(help="structural damping ratio [1]")] = None,
    locked: Annotated[bool | None, typer.Option("--locked", help="hold the sliders")] = None,
    basis: Annotated[str | None, typer.Option(help="modal basis of the links")] = None,
    n_modes: Annotated[int | None, typer.Option("--modes", help="modes per link")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Natural frequencies and damping ratios of the assembled machine."""
    start()
    from studies.engine.modes import machine_modes
    from studies.space.spec import ready_spec
    from studies.study.spec import load_study

    found = machine_modes(
        None if study is None else load_study(ready_spec(study)),
        pose=pose,
        kp=kp,
        kd=kd,
        damping=damping,
        locked=locked,
        basis=basis,
        n_modes=n_modes,
    )
    if as_json:
        text = {
            "frequencies_hz": found.frequency.tolist(),
            "damping_ratios": found.damping_ratio.tolist(),
        }
        print(json.dumps(text))
        return
    table = Table("mode", "frequency [Hz]", "damping ratio [1]")
    for k, (f, z) in enumerate(zip(found.frequency, found.damping_ratio, strict=True)):
        table.add_row(str(k + 1), f"{f:.4f}", f"{z:.5f}")
    console.print(table)


@app.command()
def bench(
    what: Annotated[str, typer.Argument(help="runs, or peers: W0 by other means")] = "runs",
    work: Annotated[str, typer.Option(help="W0, W1, W8, grad or sweep; default: W1")] = "",
    executor: Annotated[
        str, typer.Option(help="kernel, scan or gpu; default: the fastest one")
    ] = "",
    batch: Annotated[
        int, typer.Option(min=0, max=2**20, help="cases of a chunk; 0: a good number")
    ] = 0,
    cases: Annotated[int, typer.Option(min=0, help="cases of the sweep; 0: 100,000")] = 0,
    precision: Annotated[str, typer.Option(help="float64 or float32")] = "float64",
    as_json: Annotated[bool, typer.Option("--json", help="print JSON")] = False,
) -> None:
    """Measure speed and memory on this machine."""
    if what not in ("runs", "peers"):
        raise field_error("bench", what, "'runs' or 'peers'")
    _check_bench(what, work, executor, batch, cases, precision)
    start(precision)
    from studies.bench.works import bench_runs, bench_sweep

    progress = Console(file=sys.stderr, highlight=False, markup=False)
    if what == "peers":
        _bench_peers(progress, as_json)
        return
    if work == "sweep":
        found = bench_sweep(cases or SWEEP_CASES, progress)
    elif work == "grad":
        from studies.bench.gradients import bench_gradients

        found = bench_gradients(executor, batch)
    else:
        found = bench_runs(work or "W1", executor, batch)
    if as_json:
        print(json.dumps(found))
        return
    table = Table(show_header=False)
    for name, value in found.items():
        parts = value if isinstance(value, dict) else {"": value}
        for part, number in parts.items():
            table.add_row(f"{name} {part}".strip(), str(number))
    console.print(table)


#: Cases of `bench --work sweep`.
SWEEP_CASES = 100_000


def _check_bench(
    what: str, work: str, executor: str, batch: int, cases: int, precision: str
) -> None:
    """Refuse options that would be ignored."""
    if what == "peers":
        given = {"--work": work, "--executor": executor, "--batch": batch, "--cases": cases}
        given["--precision"] = "" if precision == "float64" else precision
        reason = "with peers, which do W0 in double precision"
    elif work == "sweep":
        given, reason = {"--executor": executor, "--batch": batch}, "with --work sweep"
    else:
        given, reason = {"--cases": cases}, "but with --work sweep"
    for name, value in given.items():
        if value:
            raise StudyError(f"{name} {value}: not allowed {reason}; leave it out")


def _bench_peers(progress: Console, as_json: bool) -> None:
    from studies.bench.peers import bench_peers

    rows = bench_peers(progress.print)
    if as_json:
        print(json.dumps([row._asdict() for row in rows]))
        return
    table = Table("W0 by", "configurations/s", "error [share of the largest rms]", "times slower")
    for row in rows:
        table.add_row(
            row.peer, f"{row.configs_per_s:.3g}", f"{row.error:.1e}", f"{row.times_slower:.3g}"
        )
    console.print(table)


@app.command()
def init(
    out: Annotated[Path | None, typer.Argument(help="file to write; default: print it")] = None,
) -> None:
    """Write a commented study file with every field and its default."""
    from studies.store import replacing
    from studies.study.template import study_template

    if out is None:
        print(study_template(), end="")
        return
    if out.exists():
        raise StudyError(f"{out}: exists already; name a new file")
    with replacing(out) as temporary:
        temporary.write_text(study_template(), encoding="utf-8")
    console.print(f"written: {out}", soft_wrap=True)


@app.command()
def info() -> None:
    """Versions, devices, precision, compilation cache."""
    start()
    from studies.config import info as facts

    table = Table(show_header=False)
    for name, value in facts().items():
        table.add_row(name, str(value))
    console.print(table)


add_commands(app, console)
add_tuning(app, console)
add_export(app, console)
add_atlas(app, console)
add_spillover(app, console)


if __name__ == "__main__":
    main()
