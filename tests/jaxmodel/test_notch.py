"""Notch filters of the links."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.signal

from jaxmodel.notch import advance_notch, design_notch, notch_response
from jaxmodel.simulate import simulate
from studies.engine.controller import check_codable
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.study.cases import build_structure
from tests.bare import paper_study, parse_study
from tests.jaxmodel import kept
from tests.jaxmodel.kept import loop_at, nominal_of
from tests.jaxmodel.test_onset import BASE, HOME, onset_is_at_the_margin

POSE, PERIOD = np.array(HOME), 1e-4
NOTCHES = {
    "notch_hz": [1830.0, 0.0, 2900.0],
    "notch_depth": [0.1, 0.5, 0.0],
    "notch_width": [0.3, 0.2, 0.1],
}


def arrays(**control):
    study = parse_study({**BASE, "link": {"modes": 2}, "control": {**NOTCHES, **control}})
    return kept.arrays(study)


def by_scipy(hertz, depth, width):
    """The analogue filter by SciPy's bilinear transform, prewarped at its frequency."""
    omega = 2 * np.pi * hertz
    above, below = [1, depth * width * omega, omega**2], [1, width * omega, omega**2]
    return scipy.signal.bilinear(above, below, fs=omega / (2 * np.tan(omega * PERIOD / 2)))


def test_coefficients_are_scipys():
    notch = design_notch(arrays()[1].control, PERIOD)
    for link in (0, 2):
        above, below = by_scipy(*(NOTCHES[name][link] for name in NOTCHES))
        found = [float(x[link]) for x in notch]
        np.testing.assert_allclose(found[:3], above, rtol=1e-11)
        np.testing.assert_allclose(found[3:], below[1:], rtol=1e-11)
    assert [float(x[1]) for x in notch] == [1, 0, 0, 0, 0]
    z = np.exp(2j * np.pi * np.array(NOTCHES["notch_hz"]) * PERIOD)
    gain = np.abs(notch_response(notch, z))
    np.testing.assert_allclose(gain, [0.1, 1.0, 0.0], atol=1e-12)


def test_samples_are_scipys():
    notch = design_notch(arrays()[1].control, PERIOD)
    voltage = np.random.default_rng(0).normal(size=(60, 3, 3))
    state, found = (jnp.zeros((3, 3)),) * 2, []
    for sample in voltage:
        state, after = advance_notch(notch, state, sample)
        found.append(after)
    for link in (0, 2):
        above, below = by_scipy(*(NOTCHES[name][link] for name in NOTCHES))
        wanted = scipy.signal.lfilter(above, below, voltage[:, link], axis=0)
        np.testing.assert_allclose(np.array(found)[:, link], wanted, atol=1e-12)
    np.testing.assert_array_equal(np.array(found)[:, 1], voltage[:, 1])


def test_matrices_have_the_loop_through_the_filter():
    """The same notch on all links is a factor of every path: det of both by SciPy's response."""
    same = {"notch_hz": [1830.0] * 3, "notch_depth": [0.1] * 3, "notch_width": [0.3] * 3}
    structure, case = arrays(**same)
    assert structure.has_notch
    without = case.control._replace(notch=np.zeros(3))
    filtered, plain = (
        jax.tree.map(np.asarray, loop_at(structure, case._replace(control=control), POSE))
        for control in (case.control, without)
    )

    def ratio(loop, z, factor):
        eye = np.eye(len(loop.open))
        parts = (eye * z - loop.open - factor * loop.feedback, eye * z - loop.open)
        (sign, size), (other, least) = map(np.linalg.slogdet, parts)
        return sign / other * np.exp(size - least)

    for hertz in (114.4, 1000.0, 1830.0, 4000.0):
        z = np.exp(2j * np.pi * hertz * PERIOD)
        above, below = by_scipy(1830.0, 0.1, 0.3)
        passed = np.polyval(above, z) / np.polyval(below, z)
        assert ratio(filtered, z, 1.0) == pytest.approx(ratio(plain, z, passed), rel=1e-8)


@pytest.mark.parametrize("k_p", [0.0, 100.0])
def test_poles_are_placed_behind_the_filter(k_p):
    structure, case = arrays(pole_decay=150.0, pole_frequency_hz=[[110.0 + k_p / 50]] * 3)
    wanted, matrices = nominal_of(structure, case)
    z = np.exp(np.asarray(wanted) * PERIOD)
    for link, mode in np.ndindex(*z.shape):
        poles = np.linalg.eigvals(matrices[link, mode])
        assert np.abs(poles - z[link, mode]).min() < 1e-8


@pytest.mark.long
def test_a_run_grows_beyond_the_margin_behind_a_filter():
    study = parse_study({**BASE, "control": {**NOTCHES, "notch_hz": [1200.0] * 3}})
    onset_is_at_the_margin(study)
    plain = parse_study(BASE)
    with_it, without = (
        loop_report(*kept.arrays(x), POSE, n_modes=4).gain_margin for x in (study, plain)
    )
    assert abs(with_it / without - 1) > 0.01


@pytest.mark.long  # in short: among all parts of a run, in test_hysteresis
def test_slopes_of_a_run_are_those_of_differences():
    """Of residual vibration, by frequency, depth and width of a link's filter."""
    study = parse_study(
        {
            **BASE,
            "link": {"modes": 2},
            "run": {"duration": 0.01, "smooth": True},
            "metrics": {"residual_delay": 0.0, "residual_length": 0.005},
            "control": {**NOTCHES, "notch_hz": [300.0, 0.0, 2900.0]},
        }
    )
    structure, case = kept.arrays(study)
    structure = structure._replace(has_noise=False, metrics=("residual_rms",))
    names = ("notch", "notch_depth", "notch_width")
    sizes = np.array([case.control._asdict()[name][0] for name in names])

    def residual(shares):
        changed = {
            name: jnp.asarray(getattr(case.control, name)).at[0].multiply(1 + share)
            for name, share in zip(names, shares, strict=True)
        }
        result = simulate(structure, case._replace(control=case.control._replace(**changed)))
        return 1e6 * jnp.sum(result.metrics.residual_rms)

    assert np.all(sizes > 0)
    slope = np.asarray(jax.jit(jax.jacfwd(residual))(np.zeros(3)))
    function, step = jax.jit(residual), 1e-4
    wanted = [(function(by) - function(-by)) / (2 * step) for by in step * np.eye(3)]
    np.testing.assert_allclose(slope, wanted, rtol=1e-4)


def test_what_cannot_be_exported_is_said():
    with pytest.raises(StudyError, match=r"control.notch_hz = .*exports have no notch filters"):
        check_codable(parse_study({"control": NOTCHES}))
    assert not build_structure(paper_study()).has_notch
