"""The public slider crank with a flexible rod, see `studies.reference.slider_crank`."""

import numpy as np
import pytest

from studies.reference.slider_crank import ROWS, figures

#: What q1, q2 and the peak of q1 may differ by.
TOLERANCE = {"none": (2e-6, 2e-6, 2e-4), "distributed": (1e-3, 1e-3, 1e-3)}


@pytest.mark.parametrize("shortening", ROWS)
def test_rod_bends_as_independent_codes_have_it(shortening):
    assert np.all(np.abs(figures(shortening) / ROWS[shortening] - 1) < TOLERANCE[shortening])


def test_lumping_costs_what_the_manual_says():
    """docs/theory.md, section 3: 0.3 % of the peak, 2 % of mode 2."""
    found = figures("lumped") / ROWS["distributed"] - 1
    np.testing.assert_allclose(found, (1.50e-3, -2.08e-2, 3.4e-3), rtol=0.03)
