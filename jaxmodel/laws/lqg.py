"""LQG: of each link, a Kalman filter of its modes, and a regulator that damps them."""

from __future__ import annotations

from jaxmodel.case import Case, Structure
from jaxmodel.laws.bending import BENDING, bent, walk
from jaxmodel.laws.contract import Law, NominalModel
from jaxmodel.laws.link_model import DAMPING, LinkModel, compensated, link_model
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array
from jaxmodel.riccati import filter_gain, regulator_gain
from jaxmodel.state_space import StateSpace
from jaxmodel.table import Parameter


def design(structure: Structure, case: Case, nominal: NominalModel) -> StateSpace:
    """Regulator and filter of every link."""
    parameters = case.control.parameters
    weights = (
        jnp.asarray(parameters[x]) for x in ("voltage_weight", "disturbance", "sensor_noise")
    )
    weight, force, noise = weights
    model = link_model(structure, case, nominal)
    wide = bent(case, model)
    patches, n = model.sensor.shape[1:]
    eye = jnp.eye(patches)

    def regulate(model: LinkModel, weight: Array) -> Array:
        return regulator_gain(model.state, model.enter, jnp.diag(model.energy), weight * eye)

    def correct(model: LinkModel, force: Array, change: Array, noise: Array) -> Array:
        shaken = force * model.drive
        slow = change**2 * (jnp.arange(model.state.shape[0]) >= n)
        return filter_gain(
            model.state, model.sensor, shaken @ shaken.T + jnp.diag(slow), noise**2 * eye
        )

    gain = wide.relative(jax.vmap(regulate)(model, weight))
    correction = jax.vmap(correct)(wide.model, force, walk(case, force), noise)
    return compensated(structure, case, wide.model, gain, correction)


LQG = Law(
    "lqg",
    "LQG",
    "none",
    design,
    parameters=(
        Parameter(
            "voltage_weight",
            3e-8,
            "J/V2",
            "weight of the squared voltages against the modes' energy",
            1e-14,
            1e-2,
        ),
        Parameter(
            "disturbance",
            3e-4,
            "N",
            "rms of the modal forces that the filter expects, new at every sample",
            1e-6,
            1e4,
        ),
        Parameter(
            "sensor_noise", 5e-3, "V", "rms of the sensors' noise that it expects", 1e-6, 1e2
        ),
        BENDING,
        DAMPING,
    ),
    has_position=False,
)
