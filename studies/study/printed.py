"""Numbers printed in the paper and used by more than one feature."""

from __future__ import annotations

#: Table 1: PSD of mode 1 per link, uncontrolled, three links, first two, first only; no unit given.
TABLE_1 = ((66.34, 36.51, 37.40, 38.28), (61.51, 35.11, 34.92, 60.59), (58.60, 33.80, 57.52, 59.14))
