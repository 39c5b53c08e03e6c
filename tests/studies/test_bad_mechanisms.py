"""Mechanisms of a user's that break their contract: each is refused when its file is loaded."""

import re

import numpy as np
import pytest

from jaxmodel.laws import LAWS
from jaxmodel.mechanisms import MECHANISMS, check_mechanism
from jaxmodel.mechanisms.carriers import Rail
from jaxmodel.table import Parameter
from studies.errors import StudyError
from studies.extensions import extend
from tests import gantry
from tests.studies.test_cli import refused

GOOD = gantry.mechanisms[0]._replace(name="bad")
HEIGHT, MASS = GOOD.parameters
OTHERS = [("name", None), ("name", 3), ("text", None), ("home", None), ("home", "ab")]


def built(change=lambda geometry: geometry, mass=lambda mass: mass):
    """The gantry with another geometry or mass."""

    def build(own, machine, xp):
        geometry, near_mass = gantry.build(own, machine, xp)
        return change(geometry), mass(near_mass)

    return {"build": build}


def leg(**methods):
    """The gantry with other methods of its legs."""
    kind = type("Other", (gantry.Carriages,), methods)

    def legs(self, xp):
        return kind(xp.asarray(self.sign), xp.asarray(self.height))

    return built(lambda g: type("Other", (gantry.Gantry,), {"legs": legs})(*g))


def other(**methods):
    return built(lambda g: type("Other", (gantry.Gantry,), methods)(*g))


def scaled(self, *given):
    near = gantry.Carriages.near(self, *given)
    return near._replace(root_squared=1.1 * near.root_squared)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        *(({leaf: value}, f"{leaf}") for leaf, value in OTHERS),
        ({"home": (0.0, float("nan"))}, "home = (0.0, nan); expected 2 finite numbers"),
        ({"home": ("0", "0.14")}, "home = ('0', '0.14'); expected 2 finite numbers [m, m, rad]"),
        ({"home": (0.0, 0.14, 0.0)}, "expected 2 finite numbers"),
        ({"n_links": None}, "n_links = None, n_pose = 2; allowed: 3 and 3"),
        ({"reads": "joint_radius"}, "reads = 'joint_radius'; expected a tuple of names"),
        ({"parameters": None}, "parameters = None; expected a tuple of Parameter"),
        ({"parameters": (HEIGHT._replace(default=None), MASS)}, "None in Parameter"),
        ({"parameters": (HEIGHT._replace(name=3), MASS)}, "3 in Parameter"),
        ({"parameters": (Parameter("x", 0.0, "m", "x", -1.0, 1.0),)}, "KeyError: 'rail_height'"),
        ({"build": None}, "build = None; expected a function"),
        ({"build": lambda own, machine, xp: None}, "build returns = None; expected a geometry"),
        ({"build": lambda own: None}, "build: TypeError"),
        (built(lambda g: None), "geometry = None; expected a NamedTuple"),
        (built(lambda g: (g.sign, g.height)), "expected a NamedTuple"),
        (built(lambda g: g._replace(height=np.nan * g.height)), "height of its geometry"),
        (built(mass=lambda m: -m), "expected 1 or 2 finite numbers >= 0 [kg]"),
        (built(mass=lambda m: np.nan * m), "finite numbers >= 0 [kg]"),
        (built(mass=lambda m: "heavy"), "mass with the near joints = 'heavy'"),
        (built(mass=lambda m: np.ones(3)), "expected 1 or 2 finite"),
        (other(legs=None), "Other has no method legs"),
        (other(legs=lambda self, xp: None), "legs = None; expected a NamedTuple"),
        (other(size=lambda self: -1.0), "size = -1.0; expected a finite number > 0 [m]"),
        (other(arms=lambda self, xp: 0.1), "arms = 0.1; expected None for a point"),
        (other(carriers=lambda *_: ()), "carriers = (); expected 2 of Rail and Crank"),
        (other(carriers=lambda *_: [Rail] * 2), "expected 2 of Rail and Crank"),
        (leg(near=None), "Other has no method near"),
        (leg(misplaced=None), "Other has no method misplaced"),
        (leg(near=lambda *_: None), "near at home = None; expected a Near"),
        (leg(near=lambda *_: 1 / 0), "ZeroDivisionError: division by zero"),
        (leg(near=scaled), "near at home: root and across make links of"),
    ],
)
def test_a_bad_mechanism_is_refused_where_it_is_loaded(changes, message):
    check_mechanism(GOOD)
    with pytest.raises(StudyError, match=re.escape(message)):
        extend(mechanisms=[GOOD._replace(**changes)])
    assert "bad" not in MECHANISMS


def test_the_line_that_fails_is_named(tmp_path, capsys):
    own = tmp_path / "bad_lines.py"
    own.write_text(
        "from jaxmodel.mechanisms.contract import Mechanism\n"
        "def build(own, machine, xp):\n"
        "    return machine['wheel'], 1.0\n"
        "mechanisms = [Mechanism('bad', 'bad', 2, 2, (0.0, 0.2), build)]\n"
    )
    said = refused(capsys, "--with", own, "modes")
    assert "mechanism 'bad': build, line 3: KeyError: 'wheel'" in said


def test_every_part_has_a_text_as_its_name():
    with pytest.raises(StudyError, match="law None: expected a text as its name"):
        extend(laws=[LAWS["imsc"]._replace(name=None)])
