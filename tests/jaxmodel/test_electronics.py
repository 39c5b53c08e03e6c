"""Drained patches and amplifiers of finite bandwidth."""

import jax
import numpy as np
import pytest

from jaxmodel.electronics import design_amplifier, measurement_chain
from jaxmodel.piezo import sensor_capacitance
from studies.engine.stability import loop_report
from studies.study.cases import as_arrays, build_case
from tests.bare import paper_study
from tests.jaxmodel.kept import arrays, simulated

HERTZ = 2 * np.pi
STUDY = paper_study().change(electronics__sensor_highpass_hz=24.0, electronics__amplifier_hz=800.0)
MODES = HERTZ * np.array([114.4, 457.6, 1029.5])


def electronics(**changes):
    study = paper_study().change(**{f"electronics__{name}": x for name, x in changes.items()})
    return as_arrays(build_case(study)).electronics


def test_patch_into_one_megohm_is_a_high_pass_of_24_hz():
    capacitance = float(sensor_capacitance(build_case(STUDY).machine.patches)[0])
    assert capacitance == pytest.approx(6.68e-9, rel=1e-3)
    corner = 1 / (1e6 * capacitance) / HERTZ
    assert corner == pytest.approx(23.8, abs=0.1)
    drained = measurement_chain(MODES, electronics(sensor_highpass_hz=corner))
    shift = np.degrees(np.angle(drained / measurement_chain(MODES, electronics())))
    np.testing.assert_allclose(shift, np.degrees(np.arctan(HERTZ * corner / MODES)), rtol=1e-9)
    assert shift[0] == pytest.approx(11.8, abs=0.1)


def test_amplifier_is_a_first_order_lag():
    slowed = measurement_chain(MODES, electronics(amplifier_hz=800.0))
    ratio = slowed / measurement_chain(MODES, electronics())
    np.testing.assert_allclose(ratio, 1 / (1 + 1j * MODES / (HERTZ * 800)), rtol=1e-12)


@pytest.mark.parametrize("rate", [1e-6, 1e-2, 0.5, 0.999, 1.001, 3.0, 30.0, 1e3])
def test_course_of_the_amplifier_has_the_moments_of_its_exponential(rate):
    found = jax.jit(design_amplifier)(1e-4, 1e-4 / rate)
    start, middle, end = np.asarray(found.course)
    parabola = np.polynomial.Polynomial(
        [start, 4 * middle - 3 * start - end, 2 * start + 2 * end - 4 * middle]
    )
    # exact on the exponential's own scale, and beyond it there is nothing left
    nodes, weights = np.polynomial.legendre.leggauss(60)
    length = min(1.0, 40 / rate)
    s, w = length * (nodes + 1) / 2, length * weights / 2
    for k in range(3):
        moment = (parabola * np.polynomial.Polynomial.basis(k)).integ()(1)
        assert moment == pytest.approx(np.sum(w * s**k * np.exp(-rate * s)), abs=1e-13)
    assert found.left == pytest.approx(np.exp(-rate), rel=1e-9)


RELEASED = {
    "run__duration": 0.02,
    "link__modes": 2,
    "run__smooth": True,
    "electronics__adc_bits": 32,
    "motion__waypoints": ((0.0, 0.0, np.pi / 6),),
    "shaper__kind": "none",
    "initial__modal": ((1e-7,), (), ()),
}


@pytest.mark.long  # in short: mixed batches, in test_batch
def test_without_electronics_a_mixed_batch_changes_nothing():
    """Cases with corner and lag 0 among others, the links bent at the start."""
    study = paper_study().change(**RELEASED | {"run__smooth": False, "run__duration": 0.01})
    structure, case = arrays(study)
    assert not structure.has_sensor_highpass and not structure.has_amplifier
    mixed = structure._replace(has_sensor_highpass=True, has_amplifier=True)
    alone, among = (simulated(one, case, True).record for one in (structure, mixed))
    for name in ("modal_coordinate", "actuator_voltage", "sensor_voltage"):
        wanted = np.asarray(getattr(alone, name))
        size = np.abs(wanted).max()
        assert size > 0
        np.testing.assert_allclose(getattr(among, name), wanted, atol=1e-10 * size)


@pytest.mark.parametrize("lag", [1e-4, 0.99e-4])
def test_course_has_a_slope_by_the_lag(lag):
    """Also where series and closed form meet, lag = step."""
    step = 1e-9
    before, after = (np.asarray(_course(lag + k * step)[0]) for k in (-1, 1))
    np.testing.assert_allclose(_course(lag)[1], (after - before) / (2 * step), rtol=1e-5)


@jax.jit
def _course(lag):
    """Over a sample, and its slope by the lag."""
    return jax.jvp(lambda x: design_amplifier(1e-4, x).course, (lag,), (1.0,))


def test_estimates_stay_exact_with_known_electronics():
    """The loop damps mode 1 as well with electronics that its design knows as without."""

    study = STUDY.change(control__gain_factor=0.1, electronics__amplifier_hz=2000.0)
    structure = arrays(study)[0]  # which has both, also where corner and lag are 0

    def damping(study):
        case = arrays(study)[1]
        return loop_report(structure, case, np.array([0.0, 0.0, np.pi / 6])).damping_ratio[0].min()

    plain = damping(paper_study().change(control__gain_factor=0.1))
    known = damping(study)
    assert known == pytest.approx(plain, rel=0.1)
