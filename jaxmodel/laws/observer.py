"""IMSC with Luenberger observers instead of modal filters (the paper's refs [23]-[25]).

Every controlled mode has its own observer on the sampled, delayed plant (`link_model`): it predicts
mode, filters and what the commands do to them, and is corrected by the modal filter's residual. The
poles of its mode are placed: same frequency, more damping. Those of its filters stay. Feedback is
the study's modal control, (20)-(24), of the estimates, free of the estimator's lag.
"""

from __future__ import annotations

from functools import reduce

from jaxmodel.case import Case, Structure
from jaxmodel.laws.contract import Feedback, Known, Law, Parameter, modal_gains
from jaxmodel.laws.link_model import DAMPING, compensated, link_model
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array


def corrections(structure: Structure, case: Case, known: Known, state: Array) -> Array:
    """Corrections of each mode's own states by its residual in z, (3, C, s), s = 4 or 5.

    Ackermann's formula for the predictor, L = phi(F) O^-1 e_s, and M = F^-1 L for the corrector.

    Args:
        structure, case, known: of the law.
        state: F of each link, (3, n, n).
    """
    electronics, count = case.electronics, structure.n_controlled
    size = 5 if structure.has_sensor_highpass else 4
    period = electronics.period
    filters = [electronics.antialias * jnp.sqrt(0.5) * (-1 + 1j)]
    zeta = jnp.asarray(case.control.parameters["observer_damping"])[:, None]
    wanted = known.omega * (-zeta + 1j * jnp.sqrt(1 - zeta**2))
    last = jnp.exp(-electronics.sensor_highpass * period)

    def one(f: Array, mode: Array) -> Array:
        eye = jnp.eye(size)

        def pair(x: Array, pole: Array) -> Array:
            z = jnp.exp(pole * period)
            return x @ (f @ f - 2 * jnp.real(z) * f + jnp.real(z * jnp.conj(z)) * eye)

        phi = reduce(pair, [mode, *filters], f - last * eye if size == 5 else eye)
        rows = [eye[2]]
        for _ in range(size - 1):
            rows.append(rows[-1] @ f)
        predictor = phi @ jnp.linalg.solve(jnp.stack(rows), eye[-1])
        return jnp.linalg.solve(f, predictor)

    own = jnp.arange(size) * count
    blocks = jnp.stack(
        [state[:, (own + j)[:, None], (own + j)[None]] for j in range(count)], axis=1
    )
    return jax.vmap(jax.vmap(one))(blocks, wanted)


def design(structure: Structure, case: Case, known: Known) -> Feedback:
    """Observers of all modes, and the study's modal gains."""
    model = link_model(structure, case, known)
    count, n = structure.n_controlled, model.state.shape[1]
    root = jnp.sqrt(known.modal_mass)
    own = corrections(structure, case, known, model.state)  # (3, C, s)
    seen = (known.omega * root)[..., None] * known.observer  # residual in z~ per volt, (3, C, K)
    parts = [own[:, :, k, None] * seen for k in range(own.shape[2])]
    correct = jnp.concatenate(parts, axis=1)  # (3, s C, K)
    correct = jnp.pad(correct, ((0, 0), (0, n - correct.shape[1]), (0, 0)))
    velocity, position = modal_gains(case, known)
    forces = (position / (known.omega * root), velocity / root)
    gain = jnp.concatenate([known.synthesizer * x[:, None] for x in forces], axis=2)
    gain = jnp.pad(gain, ((0, 0), (0, 0), (0, n - 2 * count)))
    return compensated(structure, case, model, gain, correct)


OBSERVER = Law(
    "observer",
    "IMSC with observers",
    "none",
    design,
    parameters=(
        Parameter(
            "observer_damping", 0.3, "1", "damping ratio of the observer's modes", 0.01, 0.99
        ),
        DAMPING,
    ),
)
