"""What a control law is: how its channels are formed and fed back, and its parameters.

A law turns the numbers of a case into the feedback of the one sampled controller
(`jaxmodel.controller`), before `control.gain_factor`. Either `Channels`: channel signals
y = `filter` V_s, estimates of their rates and values, channel forces, V_a = `synthesizer` f. Per
link; shapes (3, C, ...) with C channels. Or `StateSpace`, a linear system from sensors to
actuators, see `system_feedback`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

from jaxmodel.case import Case, Structure
from jaxmodel.channels import Channels
from jaxmodel.control import force_gains
from jaxmodel.controller import Feedback
from jaxmodel.estimator import Estimator, design_estimator
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.state_space import StateSpace
from jaxmodel.table import Parameter, PartError, check_parameters

#: What a channel is: a controlled mode, or a patch pair; "none" for a linear system without them.
Channel = Literal["mode", "patch", "none"]


class NominalModel(NamedTuple):
    """What a law can use: the controller's model of the machine."""

    # modal filter pinv(lambda_s Phi_s^t) of the controlled modes [m/V]
    observer: Num[Array, "links C K"]
    synthesizer: Num[Array, "links K C"]  # pinv(lambda_a Phi_a), voltages from modal forces [V/N]
    sensor: Num[Array, "links K C"]  # lambda_s Phi_s^t, voltages of modal coordinates [V/m]
    actuator: Num[Array, "links C K"]  # lambda_a Phi_a, modal forces of voltages [N/V]
    omega: Num[Array, "links C"]  # frequencies of the assembled links [rad/s]
    damping_ratio: Num[Array, "links C"]  # of the same modes without control [1]
    modal_mass: Num[Array, "links C"]  # [kg]
    mask: Num[Array, "C"]  # 1 for controlled modes, at most as many as patches
    feedthrough: Num[Array, "links K K"]  # sensor volts per actuator volt by all other modes [V/V]


class Law(NamedTuple):
    """A control law."""

    name: str  # in study files
    text: str  # in reports
    channel: Channel
    design: Callable[[Structure, Case, NominalModel], Feedback]
    parameters: tuple[Parameter, ...] = ()
    # position gains count always; False: they are zero, and cost nothing, where
    # `control.position_gain` is
    has_position: bool = True
    # gains by mode can follow from `control.damping` or `control.pole_decay`
    places_poles: bool = False
    # the channels of a link act one at a time, so each is judged by itself
    is_switching: bool = False


def check_law(law: Law) -> None:
    """Raise PartError if the description of a law is invalid."""
    place = f"law {law.name!r}"
    if law.channel not in get_args(Channel):
        raise PartError(f"{place}: channel = {law.channel!r}; allowed: 'mode', 'patch' or 'none'")
    if not callable(law.design):
        raise PartError(f"{place}: design = {law.design!r}; expected a function")
    check_parameters(place, law.parameters)


def check_feedback(
    law: Law, feedback: Feedback, n_links: int, n_channels: int, n_patches: int
) -> None:
    """Raise PartError unless a law returned feedback of the right kind and shapes."""
    kind = StateSpace if law.channel == "none" else Channels
    if not isinstance(feedback, kind):
        raise PartError(
            f"law {law.name!r}: design returns {feedback!r}; expected {kind.__name__}, as its "
            f"channel = {law.channel!r} says"
        )
    for name, shape in _shapes(feedback, n_links, n_channels, n_patches).items():
        value = getattr(feedback, name)
        if jnp.shape(value) != shape:
            raise PartError(
                f"law {law.name!r}: {name} has shape {jnp.shape(value)}; expected {shape}"
            )
        if jnp.iscomplexobj(value):
            raise PartError(f"law {law.name!r}: {name} is complex; expected real numbers")


def _shapes(
    feedback: Feedback, n_links: int, n_channels: int, n_patches: int
) -> dict[str, tuple[int, ...]]:
    if isinstance(feedback, Channels):
        return {
            "filter": (n_links, n_channels, n_patches),
            "synthesizer": (n_links, n_patches, n_channels),
            "velocity_gain": (n_links, n_channels),
            "position_gain": (n_links, n_channels),
        }
    groups, n, b = jnp.shape(feedback.state)[:3]
    groups = 1 if groups == 1 else n_links
    size = n_links * n_patches // groups
    shapes = {
        "state": (groups, n, b, b),
        "enter": (groups, n, b, size),
        "leave": (groups, size, n, b),
        "direct": (groups, size, size),
    }
    if feedback.anti_windup is not None:
        shapes["anti_windup"] = (groups, n, b, size)
    return shapes


def acting_channels(case: Case, nominal: NominalModel) -> Array:
    """1 for channels that act, 0 for the others, (3, C)."""
    control = case.control
    links = jnp.asarray(control.link_mask)[:, None]
    return links * jnp.asarray(control.mode_mask) * nominal.mask


def study_gains(case: Case, nominal: NominalModel) -> tuple[Array, Array]:
    """The study's velocity [N s/m] and position gains [N/m] by mode, ratios (24), (3, C) each."""
    control, on = case.control, acting_channels(case, nominal)
    velocity, position = (
        on * force_gains(first, control.ratio, nominal.modal_mass, control.is_per_mass)
        for first in (control.velocity_gain, control.position_gain)
    )
    return velocity, position


def study_estimator(case: Case, nominal: NominalModel) -> Estimator:
    """The study's estimator of modal velocities and positions."""
    electronics = case.electronics
    return design_estimator(
        nominal.omega, electronics, electronics.lowpass_ratio, electronics.lowpass_zeta
    )


def system_feedback(structure: Structure, case: Case, system: StateSpace) -> StateSpace:
    """Feedback by a linear system, of controlled links only."""
    mask = jnp.asarray(case.control.link_mask)[:, None] * jnp.ones((1, structure.n_patches))
    return system.with_sensors(mask).amplified(mask)


def modal_feedback(
    case: Case,
    nominal: NominalModel,
    velocity: Array,
    position: Array,
    estimator: Estimator | None = None,
    rival_omega: Array | None = None,
) -> Channels:
    """Feedback of modes: modal filter and synthesizer around the gains of each mode.

    Args:
        case: the numbers.
        nominal: the model the controller is designed for.
        velocity: gains [N s/m], (3, C).
        position: gains [N/m], (3, C).
        estimator: of modal velocities and positions; None: that of the study.
        rival_omega: see `Channels`.
    """
    return Channels(
        filter=nominal.observer,
        synthesizer=nominal.synthesizer,
        estimator=study_estimator(case, nominal) if estimator is None else estimator,
        velocity_gain=velocity,
        position_gain=position,
        rival_omega=rival_omega,
    )
