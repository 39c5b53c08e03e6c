"""Program that turns a MAT file on standard input into an NPZ file on standard output.

Damaged files can crash SciPy's reader, compiled code, so `studies.study.matlab` runs it here.
"""

import resource
import sys
from io import BytesIO
from typing import Any

import numpy as np
import scipy

#: Address space [bytes].
MEMORY = 2**33


def numbers_and_texts(variables: dict[str, Any]) -> dict[str, np.ndarray]:
    """Variables that are numbers or texts, cells of texts included; the others are left out."""
    arrays = {name: x for name, x in variables.items() if isinstance(x, np.ndarray)}
    texts = {
        name: np.array([str(np.ravel(cell)[0]) for cell in x.ravel() if np.size(cell)])
        for name, x in arrays.items()
        if x.dtype == object
    }
    return {name: x for name, x in (arrays | texts).items() if x.dtype.kind in "biufcU"}


def main() -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        arrays = numbers_and_texts(scipy.io.loadmat(BytesIO(sys.stdin.buffer.read())))
        packed = BytesIO()
        np.savez(packed, allow_pickle=False, **arrays)
    except NotImplementedError:
        sys.exit("a file of MATLAB 7.3; save it with -v7")
    except Exception as error:  # of any kind, for a damaged file
        sys.exit(str(error) or "damaged")
    sys.stdout.buffer.write(packed.getbuffer())


if __name__ == "__main__":
    main()
