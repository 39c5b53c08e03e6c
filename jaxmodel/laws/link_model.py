"""The sampled plant in the nominal model of a controller with an observer, link by link.

Modes at their assembled frequencies, drained patches, anti-alias filter, amplifiers and hold, exact
over a sample, and the delay that the controller knows. Sensors answer to all other modes at once
(`jaxmodel.static`). Each mode is in coordinates whose squares are energies,
sqrt(m) omega q and sqrt(m) q', and so are its filters. States: all q, all rates, all z, all rates
of z, all s if patches are drained; of each patch the voltages on their way to the sensors and, if
there are amplifiers, on the actuators; commands of the last sample, after older ones if the delay
is not one sample.
"""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.case import Case, Electronics, Structure
from jaxmodel.delay import LONGEST, CommandChange, command_change
from jaxmodel.exponential import exponential
from jaxmodel.laws.contract import NominalModel, system_feedback
from jaxmodel.lazy import jax, jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.state_space import StateSpace
from jaxmodel.table import Parameter

#: Field of laws with such a model.
DAMPING = Parameter(
    "model_damping", 0.01, "1", "damping ratio of the modes in the model", 1e-4, 0.5
)


class LinkModel(NamedTuple):
    """One link over a sample: x_(k+1) = F x + G u + W f, y = C x; x ends with the last command."""

    state: Num[Array, "n n"]  # F
    enter: Num[Array, "n K"]  # G
    drive: Num[Array, "n C"]  # W, state per modal force held over the sample [sqrt(J)/N]
    sensor: Num[Array, "K n"]  # C [V/sqrt(J)]
    energy: Num[Array, "n"]  # diagonal of the modes' energy, 1 for their two states
    met: Num[Array, "n n"]  # what the next command meets when it arrives, of x
    held: Num[Array, "n K"]  # state by a command on the actuators for a whole sample


def link_model(structure: Structure, case: Case, nominal: NominalModel) -> LinkModel:
    """The model of each link; leading axis `links`.

    Args:
        structure: static choices; electronics that exist are part of the model.
        case: the numbers.
        nominal: the model the controller is designed for.
    """
    on = nominal.mask * case.control.mode_mask
    zeta = jnp.asarray(case.control.parameters["model_damping"])
    off = (nominal.mask - on) / (nominal.modal_mass * nominal.omega**2)
    direct = nominal.feedthrough + jnp.einsum(
        "ikc,ic,icl->ikl", nominal.sensor, off, nominal.actuator
    )
    root_mass = jnp.sqrt(nominal.modal_mass)
    arguments = nominal.omega, root_mass, nominal.sensor, nominal.actuator, direct, on, zeta

    def one(*of_link: Array) -> LinkModel:
        return _one_link(structure, case, *of_link)

    return jax.vmap(one)(*arguments)


def mode_models(
    structure: Structure,
    case: Case,
    nominal: NominalModel,
    zeta: Array,
    direct: Array | float = 0.0,
) -> LinkModel:
    """The nominal link seen through one mode: from modal force [N] to modal coordinate [m].

    Args:
        structure, case, nominal: as for `link_model`.
        zeta: damping ratio of each mode [1], (3, C).
        direct: what all other modes show in its coordinate at once [m/N], (3, C).

    Returns:
        LinkModel of every mode, leading axes (3, C), with one patch in place of K.
    """
    one = jnp.ones((1, 1))

    def single(omega: Array, root_mass: Array, zeta: Array, direct: Array) -> LinkModel:
        each = omega[None], root_mass[None], one, one, direct[None, None], jnp.ones((1,)), zeta
        return _one_link(structure, case, *each)

    shape = nominal.omega.shape
    zeta, direct = jnp.broadcast_to(zeta, shape), jnp.broadcast_to(direct, shape)
    root_mass = jnp.sqrt(nominal.modal_mass)
    return jax.vmap(jax.vmap(single))(nominal.omega, root_mass, zeta, direct)


def layout(structure: Structure, n_modes: int, n_patches: int) -> dict[str, slice]:
    """Where each kind of state is in the model; "last" are the commands of the last sample."""
    has_drain = structure.has_sensor_highpass
    of_modes = ["q", "rate", "z", "z_rate"] + ["s"] * has_drain
    of_patches = ["direct_z", "direct_z_rate"] + ["direct_s"] * has_drain
    of_patches += ["volts"] * structure.has_amplifier
    of_patches += [f"older_{k}" for k in range(structure.has_delay * (LONGEST - 1))] + ["last"]
    sizes = [n_modes] * len(of_modes) + [n_patches] * len(of_patches)
    begin = [sum(sizes[:k]) for k in range(len(sizes) + 1)]
    return {name: slice(*begin[k : k + 2]) for k, name in enumerate(of_modes + of_patches)}


def _one_link(
    structure: Structure,
    case: Case,
    omega: Array,
    root_mass: Array,
    sensor: Array,
    actuator: Array,
    direct: Array,
    on: Array,
    zeta: Array,
) -> LinkModel:
    electronics, n_modes, n_patches = case.electronics, omega.size, actuator.shape[1]
    at = layout(structure, n_modes, n_patches)
    n, eye, corner = _first_command(at), jnp.eye(n_modes), electronics.antialias
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
    a, shown = _direct_path(a, at, electronics)
    enter = jnp.zeros((n, n_patches), omega.dtype)
    if "volts" in at:
        lag = jnp.maximum(electronics.amplifier_lag, electronics.period / 100)
        a = a.at[at["rate"], at["volts"]].set(bend).at[:, at["volts"]].add(shown)
        a = a.at[at["volts"], at["volts"]].set(-jnp.eye(n_patches) / lag)
        enter = enter.at[at["volts"]].set(jnp.eye(n_patches) / lag)
    else:
        enter = (enter + shown).at[at["rate"]].set(bend)
    drive = jnp.zeros((n, n_modes), omega.dtype).at[at["rate"]].set(jnp.diag(on / root_mass))
    between = jnp.concatenate([a, enter, drive], axis=1)
    between = jnp.pad(between, ((0, between.shape[1] - n), (0, 0)))
    seen = jnp.zeros((n_patches, n), omega.dtype)
    seen = seen.at[:, at["z"]].set(sensor * on / (omega * root_mass))
    seen = seen.at[:, at["direct_z"]].set(direct)
    moves = _moves(structure, electronics, between, n, n_patches)
    size, more = at["last"].stop, ((0, at["last"].stop - n), (0, 0))
    return LinkModel(
        state=moves.state,
        enter=moves.enter,
        drive=jnp.pad(moves.whole[:, n + n_patches :], more),
        sensor=jnp.pad(seen, ((0, 0), (0, size - n))),
        energy=jnp.pad(jnp.tile(on, 2), (0, size - 2 * n_modes)),
        met=moves.met,
        held=jnp.pad(moves.whole[:, n : n + n_patches], more),
    )


def _first_command(at: dict[str, slice]) -> int:
    """Where commands begin in the model's state."""
    begin: int = at.get("older_0", at["last"]).start
    return begin


class _Moves(NamedTuple):
    """A link over a sample."""

    whole: Num[Array, "m m+K+C"]  # with everything held, of m states without commands
    state: Num[Array, "n n"]  # with the commands that it has, see `LinkModel`
    enter: Num[Array, "n K"]
    met: Num[Array, "n n"]


def _moves(
    structure: Structure, electronics: Electronics, between: Array, n: int, n_patches: int
) -> _Moves:
    """Modes and electronics, x' = `between` (x, u, f), with commands after their delay."""
    period, eye = electronics.period, jnp.eye(n_patches)
    inputs = slice(n, n + n_patches)
    if not structure.has_delay:
        whole = exponential(between, period)[:n]
        state = jnp.pad(whole[:, : n + n_patches], ((0, n_patches), (0, 0)))
        enter = jnp.concatenate([jnp.zeros((n, n_patches), whole.dtype), eye])
        return _Moves(whole, state, enter, state)
    change = command_change(electronics.delay)
    first, second = (
        exponential(between, share * period)[:n] for share in (change.share, 1 - change.share)
    )
    free = second[:, :n] @ first
    newest, last, *older = (
        a * free[:, inputs] + b * second[:, inputs]
        for a, b in zip(change.before, change.after, strict=True)
    )
    whole = jnp.concatenate([free[:, :n], free[:, n:] + second[:, n:]], axis=1)
    above = jnp.concatenate([free[:, :n], *older[::-1], last], axis=1)
    # commands move on by one place, oldest first
    queue = jnp.eye(LONGEST * n_patches, k=n_patches, dtype=whole.dtype)
    state = jnp.concatenate([above, jnp.pad(queue, ((0, 0), (n, 0)))])
    enter = jnp.concatenate([newest, jnp.zeros(((LONGEST - 1) * n_patches, n_patches)), eye])
    return _Moves(whole, state, enter, _met(state, first, change, n, n_patches))


def _met(state: Array, first: Array, change: CommandChange, n: int, n_patches: int) -> Array:
    """What u_k meets after its delay: whole samples without it, and the part until it changes."""
    arriving = jnp.concatenate(
        [share * jnp.eye(n_patches) for share in (*change.before[:0:-1],)], axis=1
    )
    part = jnp.concatenate([first[:, :n], first[:, n : n + n_patches] @ arriving], axis=1)
    part = jnp.pad(part, ((0, len(state) - n), (0, 0)))
    met, power = part * change.before[1], state
    for samples in change.before[2:]:
        met, power = met + samples * (part @ power), state @ power
    return met


def _direct_path(a: Array, at: dict[str, slice], electronics: Electronics) -> tuple[Array, Array]:
    """The drain and filter that voltages pass on their way to the sensors, and how they enter."""
    n_patches = at["direct_z"].stop - at["direct_z"].start
    eye, corner, drain = jnp.eye(n_patches), electronics.antialias, electronics.sensor_highpass
    z, rate = at["direct_z"], at["direct_z_rate"]
    a = a.at[z, rate].set(corner * eye).at[rate, z].set(-corner * eye)
    a = a.at[rate, rate].set(-jnp.sqrt(2.0) * corner * eye)
    shown = jnp.zeros((a.shape[0], n_patches), a.dtype).at[rate].set(corner * eye)
    if "direct_s" in at:
        s = at["direct_s"]
        a = a.at[rate, s].set(-corner * eye).at[s, s].set(-drain * eye)
        shown = shown.at[s].set(drain * eye)
    return a, shown


def compensated(
    structure: Structure, case: Case, model: LinkModel, gain: Array, correct: Array
) -> StateSpace:
    """u = -K x of an observer's state x, corrected with the sample at hand.

    It predicts with the command as it is limited.

    Args:
        structure, case: of the law.
        model: of each link, leading axis `links`.
        gain: K, (3, K, n).
        correct: M of x + M (y - C x), (3, n, K).
    """
    kept = jnp.eye(model.state.shape[1]) - correct @ model.sensor
    after = model.state - model.enter @ gain
    system = StateSpace(
        state=(after @ kept)[:, None],
        enter=(after @ correct)[:, None],
        leave=-(gain @ kept)[:, :, None],
        direct=-(gain @ correct),
        anti_windup=model.enter[:, None],
    )
    return system_feedback(structure, case, system)
