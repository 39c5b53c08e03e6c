"""The machine of a commissioning, by finite elements of another code."""

import numpy as np
import pytest

from studies.fitting.measurements import make_bench, make_measurements
from studies.fitting.spec import parse_fit
from tests import commissions
from tests.elements import margin_on_elements, response_of_elements
from tests.fits import write
from tests.studies.twin.test_twin import needs_exudyn

FREQUENCY = np.linspace(40.0, 560.0, 27)
SIGNALS = [
    ("actuator 1.2", "sensor 1.2"),
    ("actuator 2.1", "sensor 2.3"),
    ("actuator 1.2", "sensor 2.2"),
    ("command 1", "motor 1"),
    ("command 1", "motor 3"),
    ("slider 2", "accelerometer 1 at 0.1"),
    ("slider 2", "accelerometer 3 at 0.1 to 30"),
]


@pytest.mark.parametrize("seed", [3, 4])
def test_responses_of_a_machine_are_those_of_its_finite_elements(seed, tmp_path):
    """Machines drawn at random, off home; within 2 % of the largest value, in phase and size."""
    needs_exudyn()
    true, one = commissions.true_study(seed), np.ones(len(FREQUENCY))
    write(tmp_path, "response.csv", frequency_hz=FREQUENCY, real=one, imag=one)
    entry = {"kind": "response", "pose": commissions.POSE, "file": "response.csv", "sigma": 1.0}
    entries = [entry | {"input": source, "output": output} for source, output in SIGNALS]
    free = {"link.damping_ratio": {"from": 1e-4, "to": 0.1}}
    spec = parse_fit(true.model_dump() | {"fit": {"free": free, "data": entries}}, tmp_path)
    models = make_measurements(spec, make_bench(spec))
    wanted = response_of_elements(
        true, commissions.POSE, [model.signals for model in models], FREQUENCY
    )
    for model, elements in zip(models, wanted, strict=True):
        found, _ = model.predict(np.array([true.link.damping_ratio]), False)
        elements = elements * (2j * np.pi * FREQUENCY) ** model._order
        assert np.abs(found - elements).max() < 0.02 * np.abs(elements).max(), model.signals


def test_margins_of_a_machine_are_those_of_its_finite_elements():
    needs_exudyn()
    true = commissions.true_study(3)
    found = margin_on_elements(true, true)
    assert commissions.margin_on(true, true) == pytest.approx(found, rel=3e-3)
