"""Pole placement: asked poles are obtained on the nominal link, gains follow in closed form."""

from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel.bases import find_bases
from jaxmodel.case import Case
from jaxmodel.nominal_loop import nominal_loop
from jaxmodel.prepare import design_controller
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study, parse_study

#: Axes of a batch of poles, all else shared.
N = 200


def study_with(law: str = "imsc", decay: object = 100.0, **changes: object) -> Study:
    control = {"law": law, "pole_decay": decay} | changes.pop("control", {})
    return parse_study({"control": control, "link": {"modes": 3}} | changes)


def nearest_poles(asked: np.ndarray, matrix: np.ndarray, period: float) -> np.ndarray:
    """Of every mode, the loop's eigenvalue nearest to the asked one, as s [1/s]."""
    found = np.empty_like(asked)
    for link, mode in np.ndindex(*asked.shape):
        block = matrix[link, mode if matrix.shape[1] > 1 else 0]
        z = np.linalg.eigvals(block)
        at = np.argmin(np.abs(z - np.exp(asked[link, mode] * period)))
        found[link, mode] = np.log(z[at]) / period
    return found


def random_poles(case: Case, rng: np.random.Generator, omega: np.ndarray) -> Case:
    """Decays from an eighth of structural damping to a third of omega, frequencies within 20 %."""
    decay = omega * np.exp(rng.uniform(np.log(0.002), np.log(0.3), omega.shape))
    frequency = omega * rng.uniform(0.85, 1.2, omega.shape)
    return case._replace(control=case.control._replace(pole_decay=decay, pole_frequency=frequency))


@pytest.mark.parametrize(
    ("law", "changes"),
    [
        ("imsc", {}),
        (
            "imsc",
            {
                "electronics": {"sensor_highpass_hz": 3.0, "amplifier_hz": 3000.0},
                "control": {"feedthrough_factor": 0.6},
            },
        ),
        ("observer", {"electronics": {"amplifier_hz": 3000.0}}),
    ],
)
def test_random_poles_are_obtained_on_the_nominal_link(law, changes):
    """200 sets of nine, to 1e-9 of their size."""
    study = study_with(law, **changes)
    structure, case = build_structure(study), as_arrays(build_case(study))
    omega = np.asarray(jax.jit(partial(_omega, structure))(case))
    rng = np.random.default_rng(1)
    run = jax.jit(partial(nominal_loop, structure))
    worst = 0.0
    for _ in range(N):
        asked, matrix = map(np.asarray, run(random_poles(case, rng, omega)))
        found = nearest_poles(asked, matrix, float(case.electronics.period))
        worst = max(worst, np.max(np.abs(found - asked) / np.abs(asked)))
    assert worst < 1e-9


def _omega(structure, case):
    return find_bases(structure, case).believed_omega


def _gains(structure, case):
    law = design_controller(structure, case, find_bases(structure, case)).controller
    return law.velocity_gain, law.position_gain
