"""LQG: a Kalman filter estimates the modes of each link, a linear quadratic regulator damps them.

Both are designed on the sampled plant as the controller believes it: modes, drained patches,
anti-alias filter, amplifiers, hold, and the sample of delay. In the model, each mode is in
coordinates whose squares are energies, sqrt(m) omega q and sqrt(m) q', and so are its filters.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Structure
from jaxmodel.laws.contract import Feedback, Known, Law, Parameter, masked_system
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array
from jaxmodel.riccati import filter_gain, regulator_gain
from jaxmodel.state_space import StateSpace


class LinkModel(NamedTuple):
    """One link over a sample: x_(k+1) = F x + G u + W f, y = C x; x ends with the last command."""

    state: Array  # F, (n, n)
    enter: Array  # G, (n, K)
    drive: Array  # W, state per modal force held over the sample [sqrt(J)/N], (n, C)
    sensor: Array  # C [V/sqrt(J)], (K, n)
    energy: Array  # diagonal of the modes' energy, 1 for their two states, (n,)


def link_model(structure: Structure, case: Case, known: Known) -> LinkModel:
    """The model of each link; leading axis 3.

    Args:
        structure: static choices; electronics that exist are part of the model.
        case: the numbers.
        known: what the controller knows.
    """
    on = known.mask * case.control.mode_mask
    zeta = jnp.asarray(case.control.parameters["model_damping"])
    given = known.omega, jnp.sqrt(known.modal_mass), known.sensor, known.actuator, on, zeta

    def one(*of_link: Array) -> LinkModel:
        return _one_link(structure, case, *of_link)

    return jax.vmap(one)(*given)


def _one_link(
    structure: Structure,
    case: Case,
    omega: Array,
    root_mass: Array,
    sensor: Array,
    actuator: Array,
    on: Array,
    zeta: Array,
) -> LinkModel:
    electronics, n_modes, n_patches = case.electronics, omega.size, actuator.shape[1]
    names = ["q", "rate", "z", "z_rate"]
    names += ["s"] if structure.has_sensor_highpass else []
    sizes = [n_modes] * len(names) + ([n_patches] if structure.has_amplifier else [])
    names += ["volts"] if structure.has_amplifier else []
    begin = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
    at = {name: slice(begin[k], begin[k + 1]) for k, name in enumerate(names)}
    n, eye, corner = begin[-1], jnp.eye(n_modes), electronics.antialias
    a = jnp.zeros((n, n), omega.dtype)
    a = a.at[at["q"], at["rate"]].set(jnp.diag(omega)).at[at["rate"], at["q"]].set(-jnp.diag(omega))
    a = a.at[at["rate"], at["rate"]].set(-2 * zeta * jnp.diag(omega))
    a = a.at[at["z"], at["z_rate"]].set(corner * eye).at[at["z_rate"], at["z"]].set(-corner * eye)
    a = a.at[at["z_rate"], at["q"]].set(corner * eye)
    a = a.at[at["z_rate"], at["z_rate"]].set(-jnp.sqrt(2.0) * corner * eye)
    if "s" in at:
        a = a.at[at["z_rate"], at["s"]].set(-corner * eye)
        a = a.at[at["s"], at["q"]].set(electronics.sensor_highpass * eye)
        a = a.at[at["s"], at["s"]].set(-electronics.sensor_highpass * eye)
    bend = (on / root_mass)[:, None] * actuator
    enter = jnp.zeros((n, n_patches), omega.dtype)
    if "volts" in at:
        lag = jnp.maximum(electronics.amplifier_lag, electronics.period / 100)
        a = a.at[at["rate"], at["volts"]].set(bend)
        a = a.at[at["volts"], at["volts"]].set(-jnp.eye(n_patches) / lag)
        enter = enter.at[at["volts"]].set(jnp.eye(n_patches) / lag)
    else:
        enter = enter.at[at["rate"]].set(bend)
    drive = jnp.zeros((n, n_modes), omega.dtype).at[at["rate"]].set(jnp.diag(on / root_mass))
    held = jnp.concatenate([a, enter, drive], axis=1)
    held = jnp.pad(held, ((0, held.shape[1] - n), (0, 0)))
    exact = jax.scipy.linalg.expm(held * electronics.period)[:n]
    seen = jnp.zeros((n_patches, n), omega.dtype)
    seen = seen.at[:, at["z"]].set(sensor * on / (omega * root_mass))
    last = ((0, n_patches), (0, 0))
    return LinkModel(
        state=jnp.pad(exact[:, : n + n_patches], last),
        enter=jnp.concatenate([jnp.zeros_like(enter), jnp.eye(n_patches)]),
        drive=jnp.pad(exact[:, n + n_patches :], last),
        sensor=jnp.pad(seen, ((0, 0), (0, n_patches))),
        energy=jnp.pad(jnp.tile(on, 2), (0, n + n_patches - 2 * n_modes)),
    )


def design(structure: Structure, case: Case, known: Known) -> Feedback:
    """Regulator and filter of every link; `control.gain_factor` multiplies the regulator's gain."""
    given = case.control.parameters
    weights = (jnp.asarray(given[x]) for x in ("voltage_weight", "disturbance", "sensor_noise"))
    model = link_model(structure, case, known)

    def one(model: LinkModel, weight: Array, force: Array, noise: Array) -> tuple[Array, ...]:
        eye = jnp.eye(model.enter.shape[1])
        gain = regulator_gain(model.state, model.enter, jnp.diag(model.energy), weight * eye)
        gain = gain * case.control.gain_factor
        shaken = force * model.drive
        correct = filter_gain(model.state, model.sensor, shaken @ shaken.T, noise**2 * eye)
        after = model.state - model.enter @ gain
        kept = jnp.eye(len(model.energy)) - correct @ model.sensor
        return after @ kept, after @ correct, -gain @ kept, -gain @ correct

    a, b, c, d = jax.vmap(one)(model, *weights)
    system = StateSpace(state=a[:, None], enter=b[:, None], leave=c[:, :, None], direct=d)
    return masked_system(structure, case, system)


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
        Parameter("model_damping", 0.01, "1", "damping ratio of the modes in the model", 1e-4, 0.5),
    ),
    has_position=False,
)
