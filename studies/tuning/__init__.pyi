from .run import make_evaluator

__all__ = [
    "make_evaluator",
]
