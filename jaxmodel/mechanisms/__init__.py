"""Mechanisms, one folder each; `contract` defines what a mechanism is.

One in `MECHANISMS` can be selected by `machine.kind` in a study file. To add one, write a folder
like `rrr` and add its `Mechanism` to the list below; from outside the package, use
`MECHANISMS.add`.
"""

from jaxmodel.mechanisms.check import check_mechanism
from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.five_bar import FIVE_BAR
from jaxmodel.mechanisms.prrr import PRRR
from jaxmodel.mechanisms.rrr import RRR
from jaxmodel.table import Table

MECHANISMS: Table[Mechanism] = Table("mechanism", [PRRR, RRR, FIVE_BAR], check_mechanism)
