"""The exported controller, compiled, as a function of voltages at the ADC's input."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from studies.engine.controller import fixed_controller
from studies.errors import StudyError
from studies.export.c_floating import floating_source
from studies.export.compiler import NO_COMPILER, find_compiler
from studies.export.verify import load_code
from studies.study.spec import Study
from studies.twin.loop import Law

_NAME = "flexlink"


def check_compiler() -> list[str]:
    """Command of the C compiler.

    Raises:
        StudyError: there is none.
    """
    compiler = find_compiler()
    if not compiler:
        raise StudyError(f"studies twin: {NO_COMPILER}")
    return compiler


@contextmanager
def exported_law(study: Study, factor: float = 1.0) -> Iterator[Law]:
    """The C code that `studies export --target c` writes, in double precision.

    Args:
        study: whose controller.
        factor: on the loop gain, beside `control.gain_factor` [1].

    Raises:
        StudyError: no controller to export, no compiler, or a sensor that the code takes for a
            broken one.
    """
    study = study.change(control__gain_factor=factor * study.control.gain_factor)
    exported, compiler = fixed_controller(study), check_compiler()
    source = floating_source(exported, _NAME, [study.title])
    with load_code(exported, source, _NAME, compiler, np.float64, np.float64) as code:
        code.begin()

        def law(level: np.ndarray) -> np.ndarray:
            volts, fault = code.step(level)
            if fault:
                raise StudyError(
                    f"studies twin: the exported controller takes sensor {fault} for a broken one; "
                    "allowed: motions that do not hold a sensor at an end of the ADC's range"
                )
            return volts.reshape(level.shape)

        yield law
