"""Mechanisms: one folder each, `contract` says what is in it."""

from jaxmodel.mechanisms.contract import Mechanism
from jaxmodel.mechanisms.five_bar import FIVE_BAR
from jaxmodel.mechanisms.prrr import PRRR
from jaxmodel.mechanisms.rrr import RRR

#: By name.
MECHANISMS: dict[str, Mechanism] = {x.name: x for x in (PRRR, RRR, FIVE_BAR)}
