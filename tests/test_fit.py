"""Fits to measurements: derivatives, uncertainty, what cannot be told, and bad data."""

import numpy as np
import pytest

from studies.fitting.bench import modes_of
from studies.fitting.kinds.modes import TWO_PI, pair_modes
from tests.fits import (
    FIGURES,
    MAGNITUDE,
    MODES,
    REDUCTION,
    RESPONSE,
    SPECTRUM,
    TRACE,
    blank,
    made,
    spec_of,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = tmp_path_factory.mktemp("data")
    blank(found)
    return found


def measured_modes(bench, one, values):
    """The model's own modes as if they were measured."""
    plant = bench.plant(one._pose, values, False)
    modes = modes_of(np.asarray(plant.value.state))
    frequency = np.abs(modes.pole) / TWO_PI
    bending = np.flatnonzero(frequency > 60)[: len(one._measured.frequency)]
    return one._measured._replace(
        frequency=frequency[bending],
        damping=(-modes.pole.real / np.abs(modes.pole))[bending],
        shapes=(np.asarray(plant.value.sensor) @ modes.shape[:, bending]).T,
    )


def fourth_order(f, x, step):
    def along(d):
        return (f(x - 2 * d) - 8 * f(x - d) + 8 * f(x + d) - f(x + 2 * d)) / 12

    return np.stack([along(step * e) / step for e in np.diag(x)], axis=1) / x


ENTRIES = {
    "modes": MODES,
    "response": RESPONSE,
    "magnitude": MAGNITUDE,
    "spectrum": SPECTRUM,
    "trace": TRACE,
    "figures": FIGURES,
    "reduction": REDUCTION,
}


@pytest.mark.parametrize("kind", ENTRIES)
def test_derivatives_of_every_kind(folder, kind):
    """Against central differences of fourth order, each column within 1e-5 of its size."""
    bench, (one,), values = made(spec_of(folder, ENTRIES[kind]))
    if kind == "modes":
        one._measured = measured_modes(bench, one, values * 1.001)
    found = one.residual(values, True)
    wanted = fourth_order(lambda x: one.residual(x, False).value, values, 1e-4)
    size = np.abs(wanted).max(axis=0)
    assert np.all(size > 0)
    assert np.max(np.abs(found.slope - wanted) / size) < 1e-5


def test_modes_are_paired_by_shape(folder):
    """Three nearly equal modes, measured in another order and mixed with noise."""
    bench, (one,), values = made(spec_of(folder, MODES))
    truth = measured_modes(bench, one, values)
    order = [2, 0, 1, 5, 3, 4]
    noise = np.random.default_rng(0).normal(size=(6, 9)) * 0.03 * np.abs(truth.shapes).max()
    mixed = truth._replace(frequency=truth.frequency[order], shapes=truth.shapes[order] + noise)
    plant = bench.plant(one._pose, values, False)
    modes = modes_of(np.asarray(plant.value.state))
    pairs = pair_modes(mixed, modes, np.asarray(plant.value.sensor))
    frequency = np.abs(modes.pole[pairs.mode]) / TWO_PI
    np.testing.assert_allclose(frequency, mixed.frequency, rtol=1e-9)
    assert np.ptp(truth.frequency[:3]) < 0.02 * truth.frequency[0] and pairs.likeness.min() > 0.9
