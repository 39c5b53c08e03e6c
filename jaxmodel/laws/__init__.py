"""Control laws, one file each; `contract` defines what a law is.

In: a `Case` and the controller's model of the machine. Out: coefficients of the sampled
controller. A law in `LAWS` can be selected by `control.law` in a study file, swept, tuned,
certified and exported. To add one, write a file like `imsc` and add its `Law` to the list below;
from outside the package, use `LAWS.add`.
"""

from __future__ import annotations

from jaxmodel.case import Structure
from jaxmodel.laws.contract import Law, check_law
from jaxmodel.laws.imsc import IMSC
from jaxmodel.laws.lqg import LQG
from jaxmodel.laws.lqr import LQR
from jaxmodel.laws.modified_imsc import MODIFIED_IMSC
from jaxmodel.laws.observer import OBSERVER
from jaxmodel.laws.ppf import PPF
from jaxmodel.laws.srf import SRF
from jaxmodel.laws.state_space import STATE_SPACE
from jaxmodel.table import Table

LAWS: Table[Law] = Table(
    "law", [IMSC, SRF, LQR, MODIFIED_IMSC, PPF, OBSERVER, LQG, STATE_SPACE], check_law
)


def is_modal(structure: Structure) -> bool:
    """Whether channels are modes."""
    return LAWS[structure.law].channel == "mode"


def n_channels(structure: Structure) -> int:
    """Number of signals the estimator processes, per link."""
    count = {"mode": structure.n_controlled, "patch": structure.n_patches, "none": 0}
    return count[LAWS[structure.law].channel]
