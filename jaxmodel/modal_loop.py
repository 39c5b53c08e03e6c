"""The sampled loop as modes, rigid part and controller, with its uncertain numbers kept apart.

The stiffness of all links, an extra delay of the commands, the payload and a factor on all gains
may vary over ranges; the controller's coefficients do not. `jaxmodel.zero_exclusion` reads it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from jaxmodel.case import Case, Structure
from jaxmodel.controller import Controller, linear_law
from jaxmodel.discs import Disc
from jaxmodel.lazy import jnp
from jaxmodel.parameters import Array, Num
from jaxmodel.piezo import patch_ends
from jaxmodel.prepare import prepare, stretch_of
from jaxmodel.sampled_response import assembled, plant_response
from jaxmodel.stretch import held_voltage


class ModalLoop(NamedTuple):
    """One machine about rest with sine modes, and its controller; R modes a link, K patches.

    Modal masses are 1. Of the law, x[k+1] = A x[k] + B (y, v)[k] and m[k] = C x[k] + D (y, v)[k]
    with sensor voltages y, voltages on the actuators v[k+1] = m[k], U = 3 K each. The rigid part
    has p coordinates: the pose, and the elongations of links that lengthen.
    """

    mass: Num[Array, "p p"]  # of the rigid part without payload
    payload_mass: Num[Array, "p p"]  # what each kilogram of payload adds to it [1/kg]
    payload: Num[Array, ""]  # of the study [kg]
    damping: Num[Array, "p p"]  # of the drive
    stiffness: Num[Array, "p p"]
    # of the links along themselves, in proportion to their stiffness
    axial_damping: Num[Array, "p p"]
    axial_stiffness: Num[Array, "p p"]
    omega: Num[Array, "links R"]  # of the modes without axial force [rad/s]
    spring: Num[Array, "links R"]  # by axial forces, over omega^2 [1]
    zeta: Num[Array, "links R"]  # damping ratios [1]
    exponent: Num[Array, ""]  # p of zeta ~ omega^p beyond the R modes [1]
    enter: Num[Array, "links p R"]  # force on the rigid part per modal acceleration
    leave: Num[Array, "links p R"]  # inertia force on a mode per acceleration of the rigid part
    push: Num[Array, "p U"]  # force on the rigid part per actuator voltage
    read: Num[Array, "U p"]  # sensor voltages per rigid coordinate
    sensor: Num[Array, "links K R"]  # sensor voltages per modal coordinate
    actuator: Num[Array, "links R K"]  # on the modes per actuator voltage
    # what |sensor| and |actuator| over the mode's number never exceed
    steepest: tuple[Num[Array, "links K"], Num[Array, "links K"]]
    # sensor voltage per voltage of links that keep their length [V/V]
    held: Num[Array, "links K K"]
    # it and the static one of all modes [V/V]; None: no correction
    exact: Num[Array, "links K K"] | None
    law: tuple[Array, Array, Array, Array]  # A, B, C, D
    period: Num[Array, ""]  # T [s]
    antialias: Num[Array, ""]  # [rad/s]
    highpass: Num[Array, ""] | None  # [rad/s], None if there is none
    lag: Num[Array, ""] | None  # of the amplifiers [s], None if there are none


def modal_loop(structure: Structure, case: Case, pose: Array, law: Controller) -> ModalLoop:
    """Collect it.

    Args:
        structure: static choices with basis "pinned_pinned", law "srf" (a channel for each patch)
            and as many modes as are to be known one by one.
        case: the numbers.
        pose: where to linearise, at rest under the steady load [m, m, rad], (3,).
        law: the controller, without rival channels.

    Returns:
        ModalLoop.
    """
    loop = prepare(structure, case).loop
    response = plant_response(structure, case, loop, pose)
    rigid = assembled(response)
    masses = case.machine.masses
    heavier = masses._replace(payload_mass=masses.payload_mass + 1.0)
    other = case._replace(machine=case.machine._replace(masses=heavier))
    more = assembled(plant_response(structure, other, prepare(structure, other).loop, pose)).mass
    square = loop.omega**2
    exact = None
    if structure.has_static_correction:
        by_modes = jnp.einsum("ikr,irl->ikl", response.sensor / square[:, None], response.actuator)
        exact = response.direct + by_modes
    added = more - rigid.mass
    links, patches, _ = response.sensor.shape
    size, stretch = len(added), stretch_of(structure, case)
    push = read = jnp.zeros((links, patches))
    along, held = jnp.zeros((2, links)), jnp.zeros_like(response.direct)
    if stretch is not None:
        push, read = response.push, response.read
        along, held = jnp.stack([stretch.damping, stretch.stiffness]), held_voltage(stretch)
    own = np.eye(links, size, size - links)  # elongations come last
    axial = jnp.einsum("ip,ai,iq->apq", own, along, own)
    return ModalLoop(
        mass=rigid.mass - masses.payload_mass * added,
        payload_mass=added,
        payload=jnp.asarray(masses.payload_mass),
        damping=rigid.damping - axial[0],
        stiffness=rigid.stiffness - axial[1],
        axial_damping=axial[0],
        axial_stiffness=axial[1],
        omega=loop.omega,
        spring=response.square / square - 1,
        zeta=response.decay / (2 * loop.omega),
        exponent=jnp.asarray(case.machine.damping.exponent),
        enter=rigid.enter,
        leave=rigid.leave,
        push=jnp.einsum("ip,ik->pik", own, push).reshape(size, -1),
        read=jnp.einsum("ip,ik->ikp", own, read).reshape(-1, size),
        sensor=response.sensor,
        actuator=response.actuator,
        steepest=_steepest_slopes(case, response.sensor, response.actuator),
        held=held,
        exact=exact,
        law=linear_law(law),
        period=jnp.asarray(case.electronics.period),
        antialias=jnp.asarray(case.electronics.antialias),
        highpass=case.electronics.sensor_highpass if structure.has_sensor_highpass else None,
        lag=case.electronics.amplifier_lag if structure.has_amplifier else None,
    )


def _steepest_slopes(case: Case, sensor: Array, actuator: Array) -> tuple[Array, Array]:
    """2 pi lambda/L of sensors and actuators: the slope of sin(j pi x/L) is at most j pi/L."""
    patches, length = case.machine.patches, jnp.asarray(case.machine.beam.length)
    wave = jnp.arange(1, sensor.shape[2] + 1) * np.pi
    length = jnp.broadcast_to(length, (len(sensor),))[:, None]

    def steepest(response: Array, patch: Array) -> Array:
        ends = patch_ends(jnp.asarray(patches.center), jnp.reshape(jnp.asarray(patch), (-1, 1)))
        cosine = [jnp.cos(wave * (end / length)[:, :, None]) for end in ends]
        slope = wave * (cosine[1] - cosine[0])
        # both are one constant times the other
        constant = jnp.sum(jnp.abs(response), axis=2) / jnp.sum(jnp.abs(slope), axis=2)
        return 2 * np.pi * constant

    by_patch = jnp.swapaxes(actuator, 1, 2)
    return steepest(sensor, patches.sensor_length), steepest(by_patch, patches.actuator_length)


class LawPoles(NamedTuple):
    """A law by partial fractions: C (z - A)^-1 B + D = leave diag(1/(z - pole)) enter + D."""

    pole: np.ndarray  # (n,)
    enter: np.ndarray  # (n, 6 K)
    leave: np.ndarray  # (3 K, n)
    direct: np.ndarray  # (3 K, 6 K)


def law_poles(law: tuple[np.ndarray, ...]) -> LawPoles:
    """Partial fractions of A, B, C, D.

    Raises:
        ValueError: a law without a well-conditioned set of eigenvectors.
    """
    a, b, c, d = (np.asarray(x) for x in law)
    pole, vector = np.linalg.eig(a)
    if len(pole) and np.linalg.cond(vector) > 1e9:
        raise ValueError("the controller has poles too close together for partial fractions")
    poles = LawPoles(pole, np.linalg.solve(vector, b.astype(complex)), c @ vector, d)
    used = (np.abs(poles.leave).sum(axis=0) > 0) & (np.abs(poles.enter).sum(axis=1) > 0)
    return LawPoles(pole[used], poles.enter[used], poles.leave[:, used], d)


def law_response(law: LawPoles, omega: Disc, period: float) -> Disc:
    """The law from (sensor voltages, applied voltages) to commands, (cells, U, 2 U).

    A first-order change exactly, the second by the distance from the poles.

    Args:
        law: by partial fractions.
        omega: intervals [rad/s], (cells,).
        period: T [s].
    """
    z = np.exp(1j * omega.mid * period)
    step = np.minimum(omega.rad * period, 2.0)
    apart = z[:, None] - law.pole
    distance = np.abs(apart)
    slack = distance - step[:, None]
    safe = np.where(slack > 0, slack, 1.0)
    second = np.where(slack > 0, step[:, None] ** 2 / (distance**2 * safe), np.inf)
    mid = (law.leave / apart[:, None]) @ law.enter + law.direct
    slope = (law.leave / apart[:, None] ** 2) @ law.enter
    used = np.where(np.isfinite(second), second, 0.0)
    rad = np.abs(slope) * step[:, None, None]
    rad = rad + (np.abs(law.leave) * used[:, None]) @ np.abs(law.enter)
    is_lost = ~np.all(np.isfinite(second), axis=1)
    return Disc(mid, np.where(is_lost[:, None, None], np.inf, rad))
