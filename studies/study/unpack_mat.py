"""Program that turns a MAT file on standard input into an NPZ file on standard output.

Its argument names a struct whose fields are meant; every name in the NPZ file begins with _.

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


def fields_of(variables: dict[str, Any], struct: str) -> dict[str, Any]:
    """Fields of one of them."""
    record = variables.get(struct)
    if not isinstance(record, np.ndarray) or record.dtype.names is None or record.size != 1:
        raise ValueError(f"has no struct {struct}")
    return {name: record.ravel()[0][name] for name in record.dtype.names}


def main() -> None:
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    try:
        variables, packed = scipy.io.loadmat(BytesIO(sys.stdin.buffer.read())), BytesIO()
        if sys.argv[1:]:
            variables = fields_of(variables, sys.argv[1])
        arrays = numbers_and_texts(variables)
        # no name is an argument's
        np.savez(packed, allow_pickle=False, **{f"_{name}": x for name, x in arrays.items()})
    except NotImplementedError:
        sys.exit("a file of MATLAB 7.3; save it with -v7")
    except Exception as error:  # of any kind, for a damaged file
        sys.exit(str(error) or "damaged")
    sys.stdout.buffer.write(packed.getbuffer())


if __name__ == "__main__":
    main()
