"""A few cases of one structure with their trajectories, in batches that share one compilation."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.simulate import RunResult, simulate
from studies.engine.programs import kept_jit

#: Cases per call of the compiled program; the last batch is filled up with copies.
BATCH = 8


@kept_jit(static_argnums=0)
def _simulate_batch(structure: Structure, cases: Case) -> RunResult:
    return jax.vmap(lambda case: simulate(structure, case, True))(cases)


def run_batches(structure: Structure, cases: list[Case], say: Callable[[str], object]) -> RunResult:
    """Run cases, `BATCH` at a time, with trajectories.

    Args:
        structure: of all of them.
        cases: one or more.
        say: called with what is done next.

    Returns:
        RunResult of NumPy arrays, (cases, ...).
    """
    parts = []
    for start in range(0, len(cases), BATCH):
        batch = cases[start : start + BATCH]
        say(f"simulating {len(batch)} cases")
        filled = batch + [batch[-1]] * (BATCH - len(batch))
        result = _simulate_batch(structure, jax.tree.map(lambda *x: jnp.stack(x), *filled))
        parts.append(jax.tree.map(lambda x: np.asarray(x)[: len(batch)], result))  # noqa: B023
    return jax.tree.map(lambda *x: np.concatenate(x), *parts)
