from .cases import as_arrays, build_case, build_structure

__all__ = ["as_arrays", "build_case", "build_structure"]
