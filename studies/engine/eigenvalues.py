"""Eigenvalues of real matrices, several at a time: NumPy's own hold Python's lock meanwhile."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

#: Matrices whose largest entry is below this, or above its inverse, are scaled first: the LAPACK of
#: SciPy 1.17 takes them for smaller or larger than they are.
SMALLEST = 1e-100

_INT, _CHAR = ctypes.POINTER(ctypes.c_int), ctypes.c_char_p


def eigenvalues(matrix: np.ndarray) -> np.ndarray:
    """Eigenvalues by LAPACK's dgeev, as `numpy.linalg.eigvals` of one real matrix.

    Args:
        matrix: (n, n).

    Returns:
        Complex, (n,).

    Raises:
        LinAlgError: not a real square matrix, an entry is not finite, or the algorithm does not
            converge.

    Example:
        >>> eigenvalues(np.array([[0.0, 1.0], [-4.0, 0.0]]))
        array([0.+2.j, 0.-2.j])
    """
    matrix = np.asarray(matrix)
    if matrix.ndim != 2 or len(matrix) != matrix.shape[1] or not np.isrealobj(matrix):
        raise np.linalg.LinAlgError(f"{matrix.dtype} of {matrix.shape}: not a real square matrix")
    if not np.isfinite(matrix).all():
        raise np.linalg.LinAlgError("Array must not contain infs or NaNs")
    n, size = len(matrix), float(np.abs(matrix).max(initial=0.0))
    if size and not SMALLEST < size < 1 / SMALLEST:
        return size * eigenvalues(matrix / size)
    own = np.array(matrix, float, order="F")  # which is overwritten
    real, imaginary = np.empty(n), np.empty(n)
    fault = _dgeev(own, real, imaginary, np.empty(_work_size(n)))
    if fault:
        raise np.linalg.LinAlgError("Eigenvalues did not converge")
    return real + 1j * imaginary


@cache
def _work_size(n: int) -> int:
    """Numbers of working storage that dgeev likes best."""
    best = np.empty(1)
    _dgeev(np.empty((n, n), order="F"), np.empty(n), np.empty(n), best, is_query=True)
    return max(int(best[0]), 3 * n, 1)


def _dgeev(
    matrix: np.ndarray,
    real: np.ndarray,
    imaginary: np.ndarray,
    work: np.ndarray,
    is_query: bool = False,
) -> int:
    n, one = ctypes.c_int(len(matrix)), ctypes.c_int(1)
    size, info = ctypes.c_int(-1 if is_query else len(work)), ctypes.c_int(0)
    unused = ctypes.c_double()
    _lapack("dgeev")(
        b"N",
        b"N",
        n,
        matrix.ctypes.data,
        ctypes.c_int(max(len(matrix), 1)),
        real.ctypes.data,
        imaginary.ctypes.data,
        ctypes.byref(unused),
        one,
        ctypes.byref(unused),
        one,
        work.ctypes.data,
        size,
        info,
    )
    return info.value


@cache
def _lapack(name: str) -> Callable[..., Any]:
    """A function of SciPy's LAPACK, called without Python's lock."""
    from scipy.linalg import cython_lapack

    api = ctypes.pythonapi
    api.PyCapsule_GetName.restype = ctypes.c_char_p
    api.PyCapsule_GetName.argtypes = [ctypes.py_object]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    capsule = cython_lapack.__pyx_capi__[name]
    address = api.PyCapsule_GetPointer(capsule, api.PyCapsule_GetName(capsule))
    array, number = ctypes.c_void_p, _INT
    return ctypes.CFUNCTYPE(
        None,
        *(_CHAR, _CHAR, number, array, number, array, array),
        *(array, number, array, number, array, number, number),
    )(address)
