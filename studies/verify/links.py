"""Links and patches: closed forms of beams, quadrature of mode shapes, laminate theory, statics."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import brentq

from jaxmodel.beam import BASES, ModalBasis, build_basis
from jaxmodel.case import Case
from jaxmodel.loop import Loop
from jaxmodel.parameters import Beam, Patches
from jaxmodel.piezo import VACUUM_PERMITTIVITY
from studies.engine.programs import kept_jit
from studies.study.held_link import first_frequency, laminate_stiffness
from studies.study.spec import Study
from studies.verify.prepared import prepared
from studies.verify.rows import Assumption, largest, worst, worst_relative

#: Gauss points between patch ends: products of two shapes of 24 half-waves are exact to rounding.
_POINTS = 40


class Segment(NamedTuple):
    """A link between two neighbouring patch ends, counted by hand."""

    left: float  # [m]
    right: float
    sensors: tuple[int, ...]  # that cover it
    actuators: tuple[int, ...]
    line_mass: float  # [kg/m]
    stiffness: float  # E I about the neutral axis of its layers [N m2]
    axial: float  # E A of its layers [N]
    axis: float  # that axis, from the link's mid-plane towards the actuators [m]


def check_links(study: Study) -> list[Assumption]:
    """Frequencies, integrals of shapes, piezo constants and statics of the study's links."""
    structure, case, (loop, *_) = prepared(study)
    kind = structure.basis
    integrals, signals, statics, axial = [], [], [], []
    each, own = np.shape(case.machine.patches.center), study.patches
    factors = [np.broadcast_to(x, each) for x in (own.actuator_factor, own.sensor_factor)]
    for i in range(structure.n_links):
        beam, patches = _one(case.machine.beam, i), _one(case.machine.patches, i)
        beam = beam._replace(length=float(beam.length))
        sections = _sections(beam, patches, BASES[kind].has_patches)
        x, line = _gauss(sections)
        edges = np.concatenate([_ends(patches, part) for part in ("sensor", "actuator")], axis=None)
        basis, shape, slope = jax.tree.map(
            np.asarray, _shapes(kind, structure.n_modes, beam, patches, np.append(x, edges))
        )
        integrals.append(_integrals(basis, beam, shape[: x.size], slope[: x.size], x, line))
        beside = slope[x.size :].reshape(2, 2, -1, structure.n_modes)
        believed = _constants(beam, patches)
        bends = beside[:, 1] - beside[:, 0]
        gain = _opposite_gain(patches, sections, believed) if structure.has_stretch else 0.0
        constants, membrane = (
            [factor[i] * x for factor, x in zip(factors, pair, strict=True)]
            for pair in (believed, _membrane(beam, patches, believed))
        )
        signals.append(_signals(loop, i, constants, bends, basis, gain))
        statics.append(_statics(loop, i, sections, (*constants, *membrane), gain))
        if structure.has_stretch:
            axial.append(_elongation(loop, i, sections, membrane))
    return [
        _frequencies(study, loop, case),
        Assumption(
            assumption="modal masses, couplings and shortening of the links",
            against="Gauss quadrature of the shapes",
            source="Meirovitch 1967",
            difference=worst(*integrals),
            allowed=1e-9,
        ),
        Assumption(
            assumption="volts per bending and force per volt of the patches",
            against="laminate theory, layer by layer, and the shapes' slopes",
            source="Crawley and Anderson 1990",
            difference=worst(*signals),
            allowed=1e-7,
        ),
        Assumption(
            assumption="static bending by the patches, all modes",
            against="moments integrated over the link",
            source="Timoshenko and Gere 1961",
            difference=worst(*statics),
            allowed=1e-9,
            left_out="" if study.link.static_correction else "link.static_correction is off",
        ),
        Assumption(
            assumption="elongation of the links: stiffness, inertia, patches' forces and volts",
            against="sections in series, layer by layer",
            source="Timoshenko and Gere 1961",
            difference=worst(*axial) if axial else 0.0,
            allowed=1e-9,
            left_out="" if axial else "link.stretch is off",
        ),
    ]


def _one(tree: Any, i: int) -> Any:
    """Link i's data of parameters that hold for one or all links."""
    return jax.tree.map(lambda x: np.asarray(x)[i] if np.ndim(x) else np.asarray(x), tree)


@kept_jit(static_argnums=(0, 1))
def _shapes(kind: str, n_modes: int, beam: Beam, patches: Patches, x: Any) -> Any:
    """A link's basis; shapes Y_j(x) and slopes Y_j'(x), by differentiation of the shapes."""
    patches = patches._replace(center=patches.center[None])

    def at(x: Any) -> Any:
        basis = build_basis(kind, beam, patches, n_modes, x)
        tip = 0.0 if basis.tip is None else basis.tip[0]
        return basis.deflection_at[0] + (x / beam.length)[:, None] * tip, basis

    shape, slope, basis = jax.jvp(at, (x,), (jnp.ones_like(x),), has_aux=True)
    return basis, shape, slope


def _frequencies(study: Study, loop: Loop, case: Case) -> Assumption:
    """Of the plant's modes, against the closed form of their basis."""
    kind, source = study.link.basis, "Timoshenko, Young and Weaver 1974"
    omega, beam = loop.omega, case.machine.beam
    if kind == "loaded":
        found, wanted = omega[:, 0] / (2 * np.pi), first_frequency(study, with_patches=True)
        return Assumption(
            assumption=f"frequencies of the links ({kind})",
            against="Stodola's iteration with the patches' mass and stiffness, mode 1",
            source=source,
            difference=worst_relative(found, wanted),
            allowed=2e-4,
        )
    order = np.arange(1, omega.shape[1] + 1)
    roots = order * np.pi if kind == "pinned_pinned" else _pinned_free(omega.shape[1])
    root = np.sqrt(
        beam.youngs_modulus * beam.stiffness_factor * beam.thickness**2 / (12 * beam.density)
    )
    wanted = np.broadcast_to(root / beam.length**2, len(omega))[:, None] * roots**2
    law = "(j pi)^2 sqrt(E I/(rhoA L^4))" if kind == "pinned_pinned" else "tan kL = tanh kL"
    return Assumption(
        assumption=f"frequencies of the links ({kind})",
        against=law,
        source=source,
        difference=worst_relative(omega, wanted),
        allowed=1e-9,
    )


def _pinned_free(count: int) -> np.ndarray:
    """Roots of tan kL = tanh kL."""

    def excess(x: float) -> float:
        return float(np.sin(x) - np.tanh(x) * np.cos(x))

    middle = [(j + 0.25) * np.pi for j in range(1, count + 1)]
    return np.array([brentq(excess, x - 0.5, x + 0.5, xtol=1e-14, rtol=1e-14) for x in middle])


def _ends(patches: Patches, part: str) -> np.ndarray:
    """Left and right ends of all sensors or actuators [m], (2, K)."""
    half = float(getattr(patches, f"{part}_length")) / 2
    return np.stack([np.asarray(patches.center) - half, np.asarray(patches.center) + half])


def _sections(beam: Beam, patches: Patches, has_patches: bool) -> list[Segment]:
    """A link cut at all patch ends; `has_patches`: with their mass and stiffness."""
    sensor, actuator = _ends(patches, "sensor"), _ends(patches, "actuator")
    cuts = np.unique(np.concatenate([[0.0, beam.length], *sensor, *actuator]).round(12))
    mass = float(beam.density * beam.width * beam.thickness)
    ceramic = float(patches.density * patches.width * patches.thickness) * has_patches
    core = float(beam.youngs_modulus * beam.width * beam.thickness)
    skin = float(patches.youngs_modulus * patches.width * patches.thickness)
    arm, found = float(beam.thickness + patches.thickness) / 2, []
    for left, right in pairwise(map(float, cuts)):
        middle = (left + right) / 2
        over = [
            tuple(np.flatnonzero((ends[0] < middle) & (middle < ends[1])).tolist())
            for ends in (sensor, actuator)
        ]
        ceramics = 0 if patches.is_gauge else len(over[0])
        count = len(over[1]) if patches.is_paired else ceramics, len(over[1])
        layers = count if has_patches else (0, 0)
        axial = (core + skin * sum(layers)) * float(beam.stiffness_factor)
        line_mass = mass + ceramic * sum(count)
        found.append(
            Segment(
                left=left,
                right=right,
                sensors=over[0],
                actuators=over[1],
                line_mass=line_mass,
                stiffness=_stiffness(beam, patches, layers),
                axial=axial,
                axis=skin * arm * (layers[1] - layers[0]) / (core + skin * sum(layers)),
            )
        )
    return found


def _stiffness(beam: Beam, patches: Patches, count: tuple[int, int]) -> float:
    """E I about the neutral axis of the layers: patches below, link, patches above [N m2]."""
    core = float(beam.youngs_modulus * beam.width * beam.thickness)
    skin = float(patches.youngs_modulus * patches.width * patches.thickness)
    bare, piezo = float(beam.thickness), float(patches.thickness)
    return float(laminate_stiffness(core, bare, skin, piezo, *count) * beam.stiffness_factor)


def _gauss(sections: list[Segment]) -> tuple[np.ndarray, np.ndarray]:
    """Gauss points over a link [m], and weights without and with the line mass [m], [kg]."""
    node, weight = np.polynomial.legendre.leggauss(_POINTS)
    half = np.array([(s.right - s.left) / 2 for s in sections])[:, None]
    middle = np.array([(s.right + s.left) / 2 for s in sections])[:, None]
    line = np.array([s.line_mass for s in sections])[:, None]
    return (middle + half * node).ravel(), np.stack(
        [(half * weight).ravel(), (half * weight * line).ravel()]
    )


def _integrals(
    basis: ModalBasis,
    beam: Beam,
    shape: np.ndarray,
    slope: np.ndarray,
    x: np.ndarray,
    weights: np.ndarray,
) -> float:
    """Largest difference of an integral of the shapes, over the largest entry of its kind."""
    plain, heavy = weights
    total, first = heavy.sum(), float(heavy @ x)
    joint = np.array([beam.joint_inertia_b, beam.joint_inertia_c], float)
    ends = np.stack([_at_end(slope, x, 0.0), _at_end(slope, x, beam.length)])
    differences = [
        largest(basis.mass[0], np.diagonal((shape.T * heavy) @ shape + (ends.T * joint) @ ends)),
        # of symmetric links some of these are zero
        np.abs(basis.b[0] - heavy @ shape) / total,
        np.abs(basis.c[0] - (heavy * x) @ shape - joint @ ends) / first,
        largest(basis.link_mass[0], total),
        largest(basis.first_moment[0], first),
        largest(basis.inertia[0], heavy @ x**2 + joint.sum()),
        largest(basis.end_slope[0], ends.T),
    ]
    if basis.shortening is not None:
        mixed = 0.0 if basis.mixed_shortening is None else basis.mixed_shortening[0]
        found = np.diag(basis.shortening[0]) + mixed
        differences.append(largest(found, (slope.T * plain) @ slope))
    if basis.inward is not None:
        # what lies beyond a point: everything less what lies before it
        beyond = total - _before(x, weights, 0), first - _before(x, weights, 1)
        spread = basis.inward, basis.centrifugal
        for matrix, weight in zip(spread, beyond, strict=True):
            assert matrix is not None
            differences.append(largest(matrix[0], (slope.T * (plain * weight)) @ slope))
    return worst(*differences)


def _at_end(slope: np.ndarray, x: np.ndarray, end: float) -> np.ndarray:
    """Slopes at an end of the link, from the polynomial through the nearest Gauss points."""
    near = np.argsort(np.abs(x - end))[:8]
    return np.array(
        [np.polynomial.Polynomial.fit(x[near] - end, row, 7)(0.0) for row in slope[near].T]
    )


def _before(x: np.ndarray, weights: np.ndarray, power: int) -> np.ndarray:
    """int_0^x rhoA xi^power dxi at the Gauss points: rhoA is constant from cut to cut."""
    plain, heavy = weights
    line = (heavy / plain).reshape(-1, _POINTS)
    points = x.reshape(-1, _POINTS)
    width = plain.reshape(-1, _POINTS).sum(axis=1)
    right = np.cumsum(width)
    left = right - width
    n = power + 1
    whole = line[:, 0] * (right**n - left**n) / n
    partial = line * (points**n - left[:, None] ** n) / n
    return (np.concatenate([[0.0], np.cumsum(whole)[:-1]])[:, None] + partial).ravel()


def _constants(beam: Beam, patches: Patches) -> tuple[float, float]:
    """Moment per volt [N m/V] and volts per slope difference [V/rad], by summing layers."""
    thick, piezo = float(beam.thickness), float(patches.thickness)
    stiff, core = float(patches.youngs_modulus), float(beam.youngs_modulus)
    width, arm = float(patches.width), (thick + piezo) / 2
    # an actuator alone on its face bends the pair about the neutral axis of both
    skin = stiff * width * piezo
    axis = skin * arm / (skin + core * float(beam.width) * thick)
    per_field = stiff * abs(float(patches.d31)) / piezo  # stress per volt [Pa/V]
    actuator = per_field * width * piezo * (2 * arm if patches.is_paired else arm - axis)
    if patches.is_gauge:  # strain of the bare face, by a bridge and its amplifier
        strain = _sensor_arm(beam, patches) / float(patches.sensor_length)
        return actuator, float(patches.bridge * patches.gauge_factor) * strain
    # under a sensor both faces are covered, so the neutral axis is the link's middle
    coupling = float(patches.d31) ** 2 * stiff
    permittivity = VACUUM_PERMITTIVITY * float(patches.relative_permittivity) - coupling
    charge = stiff * abs(float(patches.d31)) * width * arm  # per slope difference [C]
    capacitance = permittivity * width * float(patches.sensor_length) / piezo
    return actuator, charge / capacitance


def _sensor_arm(beam: Beam, patches: Patches) -> float:
    """Distance of a sensor's strain from the neutral axis [m]."""
    thick, piezo = float(beam.thickness), float(patches.thickness)
    if not patches.is_gauge:
        return (thick + piezo) / 2
    skin = float(patches.youngs_modulus * patches.width) * piezo
    core = float(beam.youngs_modulus * beam.width) * thick
    return thick / 2 + (0 if patches.is_paired else skin * (thick + piezo) / 2 / (skin + core))


def _membrane(beam: Beam, patches: Patches, constants: tuple[float, float]) -> tuple[float, float]:
    """Push [N/V] of an actuator, none of a pair, and volts per elongation [V/m]."""
    strained = float(patches.youngs_modulus) * abs(float(patches.d31)) * float(patches.width)
    return strained * (1 - float(patches.is_paired)), -constants[1] / _sensor_arm(beam, patches)


def _opposite_gain(
    patches: Patches, sections: list[Segment], constants: tuple[float, float]
) -> float:
    """Share by which an actuator's moment is larger under its sensor [1]."""
    if patches.is_paired:
        return 0.0
    push = float(patches.youngs_modulus * patches.width) * abs(float(patches.d31))
    axes = [s.axis for s in sections if s.sensors and s.actuators]
    alone = [s.axis for s in sections if s.actuators and not s.sensors]
    if not axes or not alone or not any(alone):  # bare links: the same moment everywhere
        return 0.0
    return push * (alone[0] - axes[0]) / constants[0]


def _signals(
    loop: Loop,
    i: int,
    constants: list[np.ndarray],
    bends: np.ndarray,
    basis: ModalBasis,
    gain: float,
) -> float:
    """What the loop's sensors see and its actuators do, against constants times slopes."""
    actuator, sensor = constants
    modes = basis.mass.shape[1]
    sees = largest(loop.sensor[i][:, :modes], sensor[:, None] * bends[0])
    pushes = bends[1] + gain * bends[0]
    does = largest(loop.actuator[i][:modes].T, actuator[:, None] * pushes / basis.mass[0])
    return worst(sees, does)


def _statics(
    loop: Loop,
    i: int,
    sections: list[Segment],
    constants: tuple[np.ndarray, ...],
    gain: float,
) -> float:
    """Held voltages: sensors by all modes, against moments integrated over the link.

    Links that lengthen are free of tension; constants are those of `_constants` and `_membrane`
    times the factors of each patch, (K,).
    """
    if loop.left_out is None:
        return 0.0
    actuator, sensor, force, membrane = constants
    wanted = np.zeros_like(loop.left_out.sensor[i])
    for section in sections:
        width = section.right - section.left
        for k in section.sensors:
            for m in section.actuators:
                bent = sensor[k] * actuator[m] * (1 + gain)
                wanted[k, m] += bent * width / section.stiffness
                if loop.plant.stretch is not None:
                    wanted[k, m] += membrane[k] * force[m] * width / section.axial
    stiffness = loop.plant.stiffness[i] / loop.plant.modal_mass[i]
    modal = (loop.sensor[i] / stiffness) @ loop.actuator[i]
    return largest(modal + loop.left_out.sensor[i], wanted)


def _elongation(loop: Loop, i: int, sections: list[Segment], constants: list[np.ndarray]) -> float:
    """Stiffness, inertia, forces and volts of a link's elongation, section by section."""
    assert loop.plant.stretch is not None
    (force, membrane), scale = constants, float(loop.plant.stretch[i])
    soft = np.array([(s.right - s.left) / s.axial for s in sections])
    ends = np.append(0.0, np.cumsum(soft)) / soft.sum()
    squares = (ends[1:] ** 2 + ends[1:] * ends[:-1] + ends[:-1] ** 2) / 3
    mass = np.sum([s.line_mass * (s.right - s.left) for s in sections] * squares)
    count = loop.sensor.shape[1]
    over = np.zeros((2, count, len(sections)))
    for n, section in enumerate(sections):
        over[0, list(section.sensors), n] = over[1, list(section.actuators), n] = 1.0
    seen, pushed = over @ soft / soft.sum()
    own = float(loop.plant.modal_mass[i])
    return worst(
        largest(loop.plant.stiffness[i, -1] / scale**2, 1 / soft.sum()),
        largest(own / scale**2, mass),
        largest(loop.sensor[i, :, -1] / scale, membrane * seen),
        np.abs(loop.actuator[i, -1] * own / scale - force * pushed).max() / max(*force, 1e-9),
    )
