"""A study prepared once for all checks: they share one compiled program."""

from __future__ import annotations

from typing import Any

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.prepare import Prepared, prepare
from studies.engine.programs import kept_jit
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study


@kept_jit(static_argnums=0)
def _prepare(structure: Structure, case: Case) -> Any:
    return prepare(structure, case)


def prepared(study: Study) -> tuple[Structure, Case, Prepared]:
    """A study's structure and case, and what `jaxmodel.prepare` makes of them, NumPy arrays."""
    structure, case = build_structure(study), as_arrays(build_case(study))
    return structure, case, jax.tree.map(np.asarray, _prepare(structure, case))
