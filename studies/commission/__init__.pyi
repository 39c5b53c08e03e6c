from .findings import CommissionFindings
from .spec import MeasuredSpec, load_measured
from .verb import commission

__all__ = ["CommissionFindings", "MeasuredSpec", "commission", "load_measured"]
