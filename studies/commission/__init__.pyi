from .run import Commissioned, run_commission
from .spec import MeasuredSpec, load_measured

__all__ = ["Commissioned", "MeasuredSpec", "load_measured", "run_commission"]
