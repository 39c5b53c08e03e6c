"""Figures of sweeps say what they leave out; made-up results."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.collections import LineCollection

from jaxmodel import status
from studies.sweeps.explore import _conditions, _warnings
from studies.sweeps.plots import MOST_LINES, plot
from studies.sweeps.sensitivity import failure_causes
from studies.sweeps.show import case_rows, left_out_text
from tests.studies.sweeps.test_sweep_tables import MARGINS, made_up, of_stations, usual

UNSTABLE, SATURATED = status.UNSTABLE, status.SATURATED


def texts(figure):
    """All that a figure says, outside its ticks."""
    ax = figure.axes[0]
    title = figure.get_suptitle().replace("\n", " ")
    return title, *(ax.get_title(loc=where) for where in ("left", "right"))


def lines_of(figure, color=None):
    found = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 1]
    return [x for x in found if color is None or x.get_color() == color]


# --- explorer -------------------------------------------------------------------------------------


def test_an_explorer_warns_of_the_cases_that_it_selects_at_first():
    """Cases with small margins are not among them if any case has enough."""
    low = usual(gain_margin=np.where(MARGINS < 6, 1.2, MARGINS))
    assert _conditions(low, "residual_rms") == {"gain_margin": 2.0}
    assert _warnings(low, "residual_rms") == ()
    none = usual(gain_margin=np.full(8, 1.2))
    assert _conditions(none, "residual_rms") == {}
    (warning,) = _warnings(none, "residual_rms")
    assert warning.startswith("CAUTION: 8 of these 8 cases have a gain margin below 2")


# --- lines of medians -----------------------------------------------------------------------------

GAINS, PLACES = [0.5, 1.0, 4.0, 8.0], [1e4, 2e4, 3e4, 4e4]
#: Higher gains vibrate less, where they do not break the loop: in 0, 1, 3 and 4 of 4 places.
CODES = np.array([[0, 0, 0, 0], [0, 0, 0, 10], [0, 10, 10, 10], [10, 10, 10, 10]])


def broken():
    rms = np.outer(1 / np.array(GAINS), [1.0, 1.1, 1.2, 1.3]) * 1e-6
    axes = {"gain": GAINS, "drive.kp": PLACES}
    return made_up(axes, CODES.ravel(), residual_rms=of_stations(rms.ravel()))


@pytest.mark.parametrize("hue", [None, "drive.kp"])
def test_medians_of_survivors_show_how_many_are_left_out(hue):
    assert UNSTABLE == 10
    figure = plot(broken(), "gain", "residual_rms", hue)
    found = [x for x in figure.axes[0].collections if isinstance(x, LineCollection)]
    (bars,) = [x for x in found if len(x.get_segments()) == len(GAINS)]
    heights = {segment[1][0]: segment[1][1] for segment in bars.get_segments()}
    assert heights == dict(zip(GAINS, [0.0, 0.25, 0.75, 1.0], strict=True))
    above, left, right = texts(figure)
    assert "8 of 16 cases are left out (8 linearised sampled loop unstable)" in above
    assert left == "grey: share left out of the medians, up to 100 %"
    assert hue or right == "median, smallest to largest of 1 to 4 cases"


def test_values_of_a_text_without_survivors_keep_their_place():
    codes = [0, 0, 5, 5]
    axes = {"shaper": ["zv", "zvd"], "drive.kp": [1e4, 2e4]}
    data = made_up(axes, codes, residual_rms=of_stations([1e-6, 2e-6, 1e-6, 1e-6]))
    ax = plot(data, "shaper", "residual_rms").axes[0]
    assert [x.get_text() for x in ax.get_xticklabels()] == ["zv", "zvd"]
    assert ax.get_title(loc="left").endswith("up to 100 %")


def test_medians_of_all_cases_have_no_shade():
    data = made_up({"gain": GAINS}, residual_rms=of_stations(np.ones(4) * 1e-6))
    above, left, _ = texts(plot(data, "gain", "residual_rms"))
    assert (above, left) == ("", "")


def test_cases_left_out_have_their_own_reasons():
    """Not "unstable or failed", where all of them saturated."""
    data = made_up(
        {"gain": GAINS}, [0, 0, SATURATED, SATURATED], residual_rms=of_stations(np.ones(4))
    )
    for figure in (plot(data, "gain", "residual_rms"), plot(data, None, "residual_rms")):
        assert texts(figure)[0] == "2 of 4 cases are left out (2 actuators saturated too often)"
    data.variables["residual_rms"].data[0] = np.nan
    left = np.array([True, False, True, True])
    assert left_out_text(data, left) == "2 actuators saturated too often; 1 without a value"


# --- parallel coordinates -------------------------------------------------------------------------


def test_lines_that_cannot_be_drawn_are_counted():
    axes = {"gain": GAINS, "drive.kp": [1e4, 2e4]}
    data = made_up(axes, residual_rms=of_stations(np.arange(1.0, 9.0) * 1e-6))
    data["control.gain_factor"][[1, 5]] = np.nan
    figure = plot(data, None, "residual_rms")
    assert texts(figure)[0] == "2 not drawn, without a value of control.gain_factor"
    drawn = [x for x in lines_of(figure) if np.isfinite(x.get_ydata()).all()]
    assert len({tuple(x.get_ydata()) for x in drawn}) == 6


def test_lines_beyond_the_most_are_counted(monkeypatch):
    monkeypatch.setattr("studies.sweeps.plots.MOST_LINES", 3)
    data = made_up({"gain": GAINS}, residual_rms=of_stations(np.arange(1.0, 5.0) * 1e-6))
    assert texts(plot(data, None, "residual_rms"))[0] == "the 1 largest are not drawn"
    assert MOST_LINES == 3000


def test_an_axis_of_lists_has_a_place_for_each_list():
    lists = [[2.0, 2.0, 2.0], [4.0, 3.0, 3.0]]
    data = made_up(
        {"electronics.lowpass_ratio": lists, "gain": GAINS},
        residual_rms=of_stations(np.arange(1.0, 9.0) * 1e-6),
    )
    ax = plot(data, None, "residual_rms").axes[0]
    names = [x.get_text() for x in ax.get_xticklabels()]
    assert names == ["electronics.lowpass_ratio", "control.gain_factor", "residual_rms [µm]"]
    assert {"[2, 2, 2]", "[4, 3, 3]"} <= {x.get_text() for x in ax.texts}


def test_an_axis_of_too_many_lists_is_named():
    lists = [[2.0 + k / 10, 2.0, 2.0] for k in range(13)]
    axes = {"electronics.lowpass_ratio": lists, "gain": [1.0, 2.0]}
    data = made_up(axes, residual_rms=of_stations(np.arange(1.0, 27.0) * 1e-6))
    figure = plot(data, None, "residual_rms")
    assert texts(figure)[0] == "no axis for electronics.lowpass_ratio: too many lists"


# --- switches -------------------------------------------------------------------------------------

LINKS = [[True, True, True], [True, False, True], [False, False, False]]


def switched():
    rms = of_stations(np.arange(1.0, 4.0) * 1e-6)
    return made_up({"control.links": LINKS}, [0, 0, UNSTABLE], residual_rms=rms)


def test_subsets_of_links_are_named_where_lists_of_switches_vary():
    data = switched()
    assert data["link_subsets"].tolist() == ["1+2+3", "1+3", "none"]
    rows = case_rows(data, np.arange(2), ["residual_rms"])
    assert "link_subsets" in rows.heads and "control.links" not in rows.heads
    assert [row[rows.heads.index("link_subsets")] for row in rows.rows] == ["1+2+3", "1+3"]
    assert {cause.name for cause in failure_causes(data)} == {"link_subsets"}


@pytest.mark.parametrize("x", ["control.links", "link_subsets"])
def test_subsets_of_links_are_plotted_by_name(x):
    ax = plot(switched(), x, "residual_rms").axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["1+2+3", "1+3", "none"]


def test_a_switch_is_on_or_off():
    ax = plot(switched(), "control.links[1]", "residual_rms").axes[0]
    assert [t.get_text() for t in ax.get_xticklabels()] == ["on", "off"]
    plt.close("all")
