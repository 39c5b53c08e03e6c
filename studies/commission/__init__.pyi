from .findings import CommissionFindings
from .run import run_commission
from .spec import MeasuredSpec, load_measured

__all__ = ["CommissionFindings", "MeasuredSpec", "load_measured", "run_commission"]
