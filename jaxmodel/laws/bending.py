"""Quasi-static bending as a disturbance state of an observer: estimated, and not acted upon.

A move bends the links with the acceleration of the reference: a modal force d that changes slowly,
and a bending X d that follows it at once. Feedback that takes this for vibration spends its volts
on it. So an observer has a further state for each mode, d_(k+1) = a d_k + disturbance, and the
regulator feeds back x - X d, the vibration about the bent link (disturbance accommodation, Johnson
1971). The frequency that separates both is a parameter of the law.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case
from jaxmodel.laws.link_model import LinkModel
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.table import Parameter

#: Corner of the model of the force over `bending_hz` [1]: behind drained patches, which show
#: nothing at rest, a force that stays for ever could not be observed.
LEAK = 0.01

#: Field of laws with such a state.
BENDING = Parameter(
    "bending_hz",
    120.0,
    "Hz",
    "frequency below which modal forces count as those of the move, whose bending is left alone",
    0.1,
    1e3,
)


class BentModel(NamedTuple):
    """A link model with the slow modal forces as last states, leading axis `links`."""

    model: LinkModel  # of n + C states
    compliance: Num[Array, "links n C"]  # X, state about which the link vibrates per modal force

    def relative(self, gain: Array) -> Array:
        """K of u = -K (x - X d) as a gain of all states, (3, K, n + C)."""
        return jnp.concatenate([gain, -gain @ self.compliance], axis=2)


def force_decay(case: Case) -> Array:
    """a of d_(k+1) = a d_k of each link [1], (3,)."""
    corner = 2 * jnp.pi * jnp.asarray(case.control.parameters["bending_hz"])
    return jnp.exp(-LEAK * corner * case.electronics.period)


def bent(case: Case, model: LinkModel) -> BentModel:
    """Add the slow modal forces to the model of each link.

    Args:
        case: the numbers.
        model: leading axis `links`.

    Returns:
        BentModel; X = (I - F)^-1 W, at rest under a force that stays.
    """
    n, count = model.drive.shape[1:]
    kept = force_decay(case)[:, None, None] * jnp.eye(count)
    below = jnp.concatenate([jnp.zeros((len(kept), count, n)), kept], axis=2)
    above = jnp.concatenate([model.state, model.drive], axis=2)
    more = ((0, 0), (0, count), (0, 0))
    wide = LinkModel(
        state=jnp.concatenate([above, below], axis=1),
        enter=jnp.pad(model.enter, more),
        drive=jnp.pad(model.drive, more),
        sensor=jnp.pad(model.sensor, ((0, 0), (0, 0), (0, count))),
        energy=jnp.pad(model.energy, ((0, 0), (0, count))),
        met=jnp.pad(model.met, ((0, 0), (0, count), (0, count))),
        held=jnp.pad(model.held, more),
    )
    compliance = jnp.linalg.solve(jnp.eye(n) - model.state, model.drive)
    return BentModel(wide, compliance)


def walk(case: Case, force: Array) -> Array:
    """rms change per sample of the slow modal forces [N], (3,).

    Their spectrum meets that of independent forces of rms `force` at `bending_hz`:
    force 2 pi f T.

    Args:
        case: the numbers.
        force: rms of the modal forces that are new at every sample [N], (3,).
    """
    corner = 2 * jnp.pi * jnp.asarray(case.control.parameters["bending_hz"])
    return force * corner * case.electronics.period
