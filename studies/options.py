"""Arguments and options that more than one command has."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, TypeAlias

import typer

Design: TypeAlias = Annotated[
    Path, typer.Argument(help="study file, ready-made design, folder of a tuning or sweep")
]
Case: TypeAlias = Annotated[
    str | None, typer.Option(help="case of a sweep (number or id:...) or family of a tuning")
]
SweepFile: TypeAlias = Annotated[
    Path, typer.Argument(help="sweep file (TOML) or name of a ready-made one")
]
Out: TypeAlias = Annotated[Path, typer.Option(help="folder for the results")]
MaybeOut: TypeAlias = Annotated[Path | None, typer.Option(help="folder for the results")]
Resume: TypeAlias = Annotated[
    bool, typer.Option("--resume", help="go on with what is in this folder, if anything")
]
Quiet: TypeAlias = Annotated[bool, typer.Option("--quiet", help="print no progress")]
Pdf: TypeAlias = Annotated[bool, typer.Option("--pdf", help="also write the figures as PDF")]
HasReport: TypeAlias = Annotated[
    bool, typer.Option("--report", help="also write a report with figures, HTML")
]
Explore: TypeAlias = Annotated[
    bool, typer.Option("--explore", help="also write explorer.html, to look at everything")
]
Precision: TypeAlias = Annotated[str, typer.Option(help="float64 or float32")]
#: Of the commands that look for the smallest change that breaks a design.
Tolerance: TypeAlias = Annotated[
    list[str] | None,
    typer.Option(
        help="NAME=VALUE, one unit of a kind of change that may break a design: stiffness, "
        "damping, payload, patch, delay, actuator, sensor, joint_inertia; 0: it does not change"
    ),
]
