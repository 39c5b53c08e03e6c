from .compiler import find_compiler
from .verify import reference_run

__all__ = [
    "find_compiler",
    "reference_run",
]
