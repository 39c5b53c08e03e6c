"""The gain margin is what it is said to be: runs decay just below that gain factor and grow above.

`control.gain_factor` times the printed margin is where the loop becomes unstable, for every law.
Here runs with the real step, without limits of converters and actuators, tell where it does.
"""

from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel.bases import find_bases
from jaxmodel.case import Case, Structure
from jaxmodel.prepare import design_controller
from jaxmodel.simulate import simulate
from jaxmodel.state_space import dense
from studies.engine.stability import loop_report
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study, parse_study

HOME = (0.0, 0.0, 0.5235987755982988)
WITHIN = 0.05  # of the printed margin
FLOOR = 1e-4  # [V]
LIMIT = 1e4  # [V]
BASE = {
    "run": {"duration": 0.4},
    "link": {"modes": 4},
    "motion": {"waypoints": [HOME]},
    "shaper": {"kind": "none"},
    "initial": {"load_deflection": (1e-5, 1e-5, -1e-5)},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.1},
    # no limits: what grows goes on growing
    "electronics": {
        "adc_bits": 32,
        "adc_range": 100.0,
        "conditioner_bias": 50.0,
        "conditioner_gain": 0.1,
        "voltage_limit": LIMIT,
    },
}
#: Three designs of each law: other gains or weights, sample rates, electronics.
FAST = {"sample_rate_hz": 20_000.0, "antialias_hz": 4_000.0}
SLOW = {"sample_rate_hz": 6_000.0}
REAL = {"amplifier_hz": 3_000.0, "sensor_highpass_hz": 2.0}
DESIGNS = {
    "imsc": [{}, {"electronics": FAST}, {"control": {"pole_decay": 150.0}, "electronics": REAL}],
    "modified_imsc": [{}, {"electronics": FAST}, {"control": {"pole_decay": 150.0}}],
    "srf": [
        {"control": {"velocity_gain": (5e-4,) * 3}},
        {"control": {"velocity_gain": (5e-4,) * 3}, "electronics": FAST},
        {"control": {"velocity_gain": (2e-4, 3e-4, 4e-4)}, "electronics": REAL},
    ],
    "lqr": [
        {},
        {"electronics": FAST},
        {"control": {"laws": {"lqr": {"control_weight": 1e-5}}}, "electronics": REAL},
    ],
    "ppf": [{}, {"electronics": FAST}, {"control": {"velocity_gain": (0.5, 1.0, 1.5)}}],
    "observer": [
        {},
        {"electronics": SLOW},
        {"control": {"pole_decay": 100.0}, "electronics": REAL},
    ],
    "lqg": [
        {},
        {"electronics": SLOW},
        {"control": {"laws": {"lqg": {"voltage_weight": 1e-8}}}, "electronics": REAL},
    ],
}


def study_of(law: str, design: dict) -> Study:
    sections = {name: {**BASE.get(name, {}), **values} for name, values in design.items()}
    control = {"law": law, **design.get("control", {})}
    if law == "srf":  # what grows there grows slowly
        sections["run"] = {"duration": 2.0}
    return parse_study({**BASE, **sections, "control": control})


@partial(jax.jit, static_argnums=0)
def _run(structure, case, factor):
    control = case.control._replace(gain_factor=factor)
    found = simulate(structure, case._replace(control=control), has_record=True)
    return found.record.actuator_voltage


def grows(structure, case, factor: float) -> bool:
    """Whether voltages reach the actuators' limit, thousands of times the first ones.

    Or grow in the last third of the run, above what the converters round.
    """
    voltage = np.asarray(_run(structure, case, factor))
    if np.abs(voltage).max() >= LIMIT:
        return True
    size = np.sqrt(np.mean(voltage**2, axis=(1, 2)))
    tenth = len(size) // 10
    late = size[-tenth:].mean()
    return late > FLOOR and late > size[-4 * tenth : -3 * tenth].mean()


def arrays(study: Study) -> tuple[Structure, Case]:
    return build_structure(study), as_arrays(build_case(study))


def onset_is_at_the_margin(study: Study) -> None:
    """Decays at 0.95 and grows at 1.05 of the printed margin."""
    structure, case = arrays(study)
    margin = loop_report(structure, case, np.array(HOME), n_modes=4).gain_margin
    assert 1 < margin < 1e3
    factor = study.control.gain_factor * margin
    assert not grows(structure, case, (1 - WITHIN) * factor), margin
    assert grows(structure, case, (1 + WITHIN) * factor), margin


@pytest.mark.parametrize("law", ["imsc", "observer", "lqg"])
def test_runs_grow_beyond_the_printed_margin(law):
    """Of the law's first design with the paper's square's first pose."""
    onset_is_at_the_margin(study_of(law, DESIGNS[law][0]))


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "k"), [(law, k) for law, designs in DESIGNS.items() for k in range(len(designs))]
)
def test_runs_of_every_law_grow_beyond_the_printed_margin(law, k):
    onset_is_at_the_margin(study_of(law, DESIGNS[law][k]))


@pytest.mark.long
@pytest.mark.parametrize("k", range(3))
def test_runs_of_a_given_system_grow_beyond_the_printed_margin(k):
    """An LQG design handed in as matrices, with another gain factor."""
    design = DESIGNS["lqg"][k]
    structure, case = arrays(study_of("lqg", design))
    law = jax.jit(lambda c: design_controller(structure, c, find_bases(structure, c)).controller)
    a, b, c, d = dense(jax.tree.map(np.asarray, law(case).feedback))
    rate = design.get("electronics", {}).get("sample_rate_hz", 10_000.0)
    section = {
        "sample_time": 1 / rate,
        **{name: np.asarray(x).tolist() for name, x in zip("abcd", (a, b, c, d), strict=True)},
    }
    given = {"control": {"gain_factor": 0.5}, "state_space": section}
    onset_is_at_the_margin(study_of("state_space", {**design, **given}))
