"""Designs over their environments, on made-up results of two gains, two masses, two stiffnesses."""

import numpy as np
import pytest

from studies.errors import StudyError
from studies.sweeps.environments import environments_text, over_environments
from studies.sweeps.say import report_of
from studies.sweeps.show import best_cases, case_rows, is_ranked, margin_warning, ranked_cases
from tests.studies.sweeps.test_sweep_tables import made_up, of_links, of_stations

#: In the order of the cases: gain outermost, then the mass, then the stiffness.
RMS = np.array([1.0, 4.0, 2.0, 3.0, 2.5, 2.6, 3.5, 2.0]) * 1e-6
MARGINS = np.array([9.0, 3.0, 5.0, 4.0, 6.0, 7.0, 1.5, 8.0])
VOLTS = np.array([10.0, 20.0, 30.0, 40.0, 5.0, 6.0, 7.0, 8.0])
AXES = {"gain": [0.5, 1.0], "load.mass": [0.0, 0.1], "frequency_error": [-0.05, 0.05]}


def swept(over="worst", names=("load.mass", "frequency_error"), codes=None, **changes):
    arrays = {
        "residual_rms": of_stations(RMS),
        "peak_voltage": of_links(VOLTS),
        "gain_margin": MARGINS,
    }
    sweep = {"axes": AXES, "environments": list(names), "over": over}
    return made_up(sweep, codes=codes, **(arrays | changes))


def test_cases_that_differ_in_environments_are_one_design():
    assert swept().designs.tolist() == [0, 0, 0, 0, 1, 1, 1, 1]
    assert swept(names=["load.mass"]).designs.tolist() == [0, 1, 0, 1, 2, 3, 2, 3]
    assert swept(names=["link.stiffness_factor"]).designs.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert swept(names=[]).designs.tolist() == list(range(8))


@pytest.mark.parametrize(
    ("over", "by", "wanted"),
    [
        ("worst", "residual_rms", (4.0, 3.5)),
        ("mean", "residual_rms", (2.5, 2.65)),
        (1.0, "residual_rms", (4.0, 3.5)),
        (0.75, "residual_rms", (3.0, 2.6)),
        (0.5, "residual_rms", (2.0, 2.5)),
        (0.01, "residual_rms", (1.0, 2.0)),
        ("worst", "-residual_rms", (1.0, 2.0)),
        ("worst", "gain_margin", (3.0, 1.5)),
        (0.5, "gain_margin", (5.0, 7.0)),
    ],
)
def test_values_over_environments(over, by, wanted):
    scale = 1e-6 if "rms" in by else 1.0
    found = over_environments(swept(over), by)
    np.testing.assert_allclose(found, scale * np.repeat(wanted, 4), rtol=1e-12)


def test_designs_rank_by_them_under_the_case_that_has_them():
    assert ranked_cases(swept(), "residual_rms").tolist() == [6, 1]
    assert ranked_cases(swept("mean"), "residual_rms").tolist() == [2, 5]  # 2.0, 2.6: nearest
    assert ranked_cases(swept(0.5), "residual_rms").tolist() == [2, 4]
    # what the table says are the design's figures, not the case's
    table = best_cases(swept(), "residual_rms")
    assert table.index.tolist() == [6, 1]
    np.testing.assert_allclose(table["residual_rms"], [3.5e-6, 4e-6])
    np.testing.assert_allclose(table["peak_voltage"], [8.0, 40.0])
    np.testing.assert_allclose(table["gain_margin"], [1.5, 3.0])
    heads = case_rows(swept(), np.array([6, 1]), ["residual_rms"]).heads
    assert "worst residual_rms [µm]" in heads and "worst gain_margin" in heads
    assert "2 designs, each by the worst of its 4 environments" in environments_text(swept())
    assert "smallest 1.5" in margin_warning(swept(), np.array([4]))  # in another environment


def test_a_design_fails_in_one_environment():
    codes = [0, 0, 0, 0, 0, 0, 3, 0]
    assert ranked_cases(swept(codes=codes), "residual_rms").tolist() == [1]
    assert is_ranked(swept(codes=codes), "residual_rms")
    lost = swept(codes=[3, *codes[1:]])
    assert not is_ranked(lost, "residual_rms")
    assert report_of(lost).result[0] == "no design has, in each of its environments, residual_rms"
    assert ranked_cases(swept(), "residual_rms", "gain_margin > 2").tolist() == [1]
    with pytest.raises(StudyError, match="no design with status ok meets it in each of its env"):
        ranked_cases(swept(), "residual_rms", "gain_margin > 3.5")
    missing = np.where(np.arange(8) == 1, np.nan, RMS)
    assert ranked_cases(swept(residual_rms=of_stations(missing)), "residual_rms").tolist() == [6]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"names": ["load.mas"]},
            "load.mas.; allowed: .*; did you mean .load.mass",
        ),
        ({"names": ["machine.platform_mass"]}, "sweep.environments = 'machine.platform_mass'"),
        ({"over": "median"}, "sweep.over"),
        ({"over": 0.0}, "sweep.over"),
        ({"over": 1.5}, "sweep.over"),
    ],
)
def test_what_is_no_environment(changes, message):
    with pytest.raises(StudyError, match=message):
        swept(**changes)
