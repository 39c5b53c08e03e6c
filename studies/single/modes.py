"""What natural modes tell: frequency, damping and what moves, of each."""

from __future__ import annotations

from typing import Any

import numpy as np

from studies import show  # whose `figures` load Matplotlib when they are needed
from studies.engine.modes import NamedModes
from studies.show.listing import Rows
from studies.show.report import Report, chapter, drawing

#: Modes in the figure.
MOST = 12
HEADS = ["mode", "frequency [Hz]", "damping ratio [1]", "share of its energy"]


def say(modes: NamedModes) -> Report:
    """What natural modes tell, on a console and in a notebook."""
    rows = [
        [str(x.mode), f"{x.frequency:.4f}", f"{x.damping_ratio:.5f}", x.description]
        for x in modes.modes
    ]
    shown = chapter("Modes", Rows(HEADS, rows), drawing(_bars, modes, name="modes"))
    return Report("Natural modes of the machine", [], "", "", [], [shown], {})


def _bars(modes: NamedModes) -> Any:
    """Energy of the lowest modes, by what holds it."""
    figure, ax = show.figures.one_panel(2.0)
    shares = np.array([*modes.link_share.sum(axis=2).T, modes.drive_share])[:, :MOST]
    shares = 100 * np.nan_to_num(shares)
    for k, share in enumerate(shares):
        name = f"link {k + 1}" if k < len(shares) - 1 else "drive"
        place, base = np.arange(len(share)), shares[:k].sum(axis=0)
        ax.bar(place, share, bottom=base, color=show.figures.SERIES[k], label=name)
    ax.set_xticks(place, [f"{f:.0f}" for f in modes.frequency[:MOST]])
    ax.set(xlabel="frequency [Hz]", ylabel="energy [%]")
    show.figures.legend_above(figure, ax)
    return figure
