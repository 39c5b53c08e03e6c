"""From studies to the arrays of the model: `Structure` (static) and `Case` (traced)."""

from __future__ import annotations

from functools import partial
from typing import TypeVar

import jax
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.numbers import case_of, in_working_precision, is_used, structure_of
from studies.study.consistency import patch_centers
from studies.study.fields import Columns, Fields
from studies.study.numbers import one_study
from studies.study.paths import field_value
from studies.study.spec import Study

Tree = TypeVar("Tree")  # a Case, or numbers


def build_structure(study: Study, columns: Columns | None = None) -> Structure:
    """Static part of a study, or of many that differ in some fields: sizes of the largest case.

    Args:
        study: validated study.
        columns: values of the fields that differ, one per case (see `studies.study.fields`).
    """
    fields, n_patches = Fields(study, columns), patch_centers(study).shape[1]
    sizes = {
        "n_modes": int(fields.numbers("link.modes").max()),
        "n_controlled": min(int(fields.numbers("control.modes").max()), n_patches),
        "n_patches": n_patches,
    }
    return structure_of(
        partial(field_value, study), sizes, lambda name: is_used(name, fields.numbers(name))
    )


def build_case(study: Study) -> Case:
    """Traced part of a study, as NumPy numbers and arrays in SI units."""
    structure = build_structure(study)
    return case_of(structure, one_study(study, structure))


def as_arrays(case: Tree) -> Tree:
    """Every leaf as an array of the working precision (integers stay integers)."""
    # converted by NumPy and put there by JAX, without compiling anything
    arrays: Tree = jax.device_put(in_working_precision(as_numpy(case)))
    return arrays


def as_numpy(case: Tree) -> Tree:
    """Every leaf as a NumPy array: results can be unpickled where JAX is not to start yet."""
    arrays: Tree = jax.tree.map(np.asarray, case)
    return arrays
