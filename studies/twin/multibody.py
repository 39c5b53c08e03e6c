"""The machine in Exudyn: links of ANCF cables, sliders, platform, joints, patches.

Only this module needs Exudyn, and imports it when a model is built. Nothing of this project's
dynamics is used: links are cables with large rotations that bend and stretch, closed to a machine
by joints with constraint forces.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from studies.errors import StudyError
from studies.twin.machine import MachineData
from studies.twin.mesh import Mesh, damping_matrix, mesh_link

MISSING = "studies twin: Exudyn is missing: install flexlink-studies[twin]"

#: Force of the motors and everything else along the guide [N] of slider i at time t [s], from rho
#: [m] and rho' [m/s]: f(i, t, rho, rho').
SliderForce = Callable[[int, float, float, float], float]


class Settings(NamedTuple):
    """Resolution of the twin."""

    n_elements: int = 20  # per link, at least
    axial_factor: float = 1.0  # on E A of the links [1]
    n_steps: int = 0  # of the integrator in a sample, even; 0: of about `STEP`


DEFAULT = Settings()
#: Length of a step [s].
STEP = 1e-5


class Model(NamedTuple):
    """An assembled machine in Exudyn, and where its coordinates are."""

    exudyn: Any  # the module
    system: Any  # Exudyn's MainSystem
    container: Any  # its SystemContainer, which must outlive it
    meshes: tuple[Mesh, ...]
    reference: np.ndarray  # reference values of all coordinates
    link_start: tuple[int, ...]  # first coordinate of each link: x, y, x', y' node by node
    slider_start: tuple[int, ...]  # coordinate of each slider, rho minus its start
    platform_start: int  # first of (x, y, phi)
    rho_start: np.ndarray  # [m], (3,)
    moments: tuple[dict[int, int], ...]  # load number of each node with a patch end, by link
    platform_loads: tuple[int, int]  # numbers of force and moment at the reference point
    platform_center: np.ndarray  # see `machine.PlatformBody`


def load_exudyn() -> Any:
    """The module.

    Raises:
        StudyError: it is not installed.
    """
    try:
        import exudyn
    except ImportError:
        raise StudyError(MISSING) from None
    return exudyn


def close_chain(machine: MachineData, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Straight links of a machine at a pose.

    Args:
        machine: the machine.
        pose: (x, y, phi) of the platform [m, m, rad], (3,).

    Returns:
        (rho [m], (3,); B and C of each link [m], (3, 2, 2)).
    """
    turn = _rotation(pose[2])
    rho, ends = np.zeros(3), np.zeros((3, 2, 2))
    for i, (guide, link) in enumerate(zip(machine.guides, machine.links, strict=True)):
        joint = pose[:2] + turn @ machine.platform.joints[i]
        away = joint - guide.start
        along = guide.direction @ away
        across = away - along * guide.direction
        rho[i] = along - np.sqrt(link.length**2 - across @ across)
        ends[i] = guide.start + rho[i] * guide.direction, joint
    return rho, ends


def _rotation(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def build_model(
    machine: MachineData,
    pose: np.ndarray,
    force: SliderForce | None,
    settings: Settings = DEFAULT,
) -> Model:
    """Assemble the machine at rest with straight links.

    Args:
        machine: what to build.
        pose: of the platform [m, m, rad], (3,).
        force: on the sliders; None: they are free.
        settings: resolution.

    Raises:
        StudyError: Exudyn is missing.
    """
    exudyn = load_exudyn()
    items = import_module("exudyn.itemInterface")

    container = exudyn.SystemContainer()
    system = container.AddSystem()
    rho, ends = close_chain(machine, pose)
    meshes = tuple(mesh_link(link, settings.n_elements) for link in machine.links)
    body, platform_loads = _add_platform(system, items, machine, pose)
    nodes, sliders, moments = [], [], []
    for i, mesh in enumerate(meshes):
        own = _add_link(system, items, machine, mesh, i, ends[i], settings.axial_factor)
        slider = _add_slider(system, items, machine, i, own[0])
        if force is not None and not machine.is_locked:
            _add_drive(system, items, i, slider, force, rho[i])
        joint = system.AddMarker(items.MarkerNodePosition(nodeNumber=own[-1]))
        place = machine.platform.joints[i] - machine.platform.center
        at = system.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[*place, 0]))
        system.AddObject(items.ObjectJointRevolute2D(markerNumbers=[at, joint]))
        nodes.append(own)
        sliders.append(slider)
        moments.append(_add_moments(system, items, mesh, own))
    system.Assemble()

    def start(node: int) -> int:
        return int(system.GetNodeODE2Index(node))

    return Model(
        exudyn=exudyn,
        system=system,
        container=container,
        meshes=meshes,
        reference=_coordinates(exudyn, system, exudyn.ConfigurationType.Reference),
        link_start=tuple(start(own[0]) for own in nodes),
        slider_start=tuple(map(start, sliders)),
        platform_start=start(system.GetObject(body)["nodeNumber"]),
        rho_start=rho,
        moments=tuple(moments),
        platform_loads=platform_loads,
        platform_center=machine.platform.center,
    )


def _coordinates(exudyn: Any, system: Any, configuration: Any) -> np.ndarray:
    return np.array(system.systemData.GetODE2Coordinates(configuration))


def _add_platform(
    system: Any, items: Any, machine: MachineData, pose: np.ndarray
) -> tuple[int, tuple[int, int]]:
    """The rigid platform, with its node at the centre of mass: body and its two loads."""
    platform = machine.platform
    center = pose[:2] + _rotation(pose[2]) @ platform.center
    node = system.AddNode(items.NodeRigidBody2D(referenceCoordinates=[*center, pose[2]]))
    body = system.AddObject(
        items.ObjectRigidBody2D(mass=platform.mass, inertia=platform.inertia, nodeNumber=node)
    )
    at = system.AddMarker(
        items.MarkerBodyRigid(bodyNumber=body, localPosition=[*-platform.center, 0])
    )
    force = system.AddLoad(items.LoadForceVector(markerNumber=at, loadVector=[0, 0, 0]))
    moment = system.AddLoad(items.LoadTorqueVector(markerNumber=at, loadVector=[0, 0, 0]))
    return body, (force, moment)


def _add_link(
    system: Any,
    items: Any,
    machine: MachineData,
    mesh: Mesh,
    i: int,
    ends: np.ndarray,
    axial_factor: float,
) -> list[int]:
    """Nodes of a link, from B to C, with its cables, damping and joint inertia."""
    link = machine.links[i]
    along = (ends[1] - ends[0]) / link.length
    nodes = [
        system.AddNode(
            items.NodePoint2DSlope1(referenceCoordinates=[*(ends[0] + x * along), *along])
        )
        for x in mesh.x
    ]
    for k, size in enumerate(np.diff(mesh.x)):
        system.AddObject(
            items.ObjectANCFCable2D(
                nodeNumbers=nodes[k : k + 2],
                length=size,
                massPerLength=mesh.line_mass[k],
                bendingStiffness=mesh.bending[k],
                axialStiffness=axial_factor * mesh.axial[k],
                useReducedOrderIntegration=True,
            )
        )
    damping = np.kron(damping_matrix(mesh, link), np.eye(2))
    mass = np.zeros_like(damping)
    # of a slope vector, whose length hardly changes: J/2 |r''|^2 is the energy of its turning
    for at, inertia in zip((2, len(mass) - 2), link.joint_inertia, strict=True):
        mass[at : at + 2, at : at + 2] = inertia * np.eye(2)
    system.AddObject(
        items.ObjectGenericODE2(nodeNumbers=nodes, massMatrix=mass, dampingMatrix=damping)
    )
    return nodes


def _add_slider(system: Any, items: Any, machine: MachineData, i: int, first: int) -> int:
    """A mass with one coordinate, along which it takes the first node of its link."""
    guide = machine.guides[i]
    slider = system.AddNode(
        items.NodeGenericODE2(
            referenceCoordinates=[0.0],
            initialCoordinates=[0.0],
            initialCoordinates_t=[0.0],
            numberOfODE2Coordinates=1,
        )
    )
    system.AddObject(
        items.ObjectGenericODE2(nodeNumbers=[slider], massMatrix=[[guide.slider_mass]])
    )
    own, node = (
        system.AddMarker(items.MarkerNodeCoordinates(nodeNumber=x)) for x in (slider, first)
    )
    position = np.eye(2, 4)  # of the coordinates x, y, x', y'; markers include reference values
    start = np.array(system.GetNode(first)["referenceCoordinates"])[:2]
    system.AddObject(
        items.ObjectConnectorCoordinateVector(
            markerNumbers=[own, node],
            scalingMarker0=guide.direction[:, None],
            scalingMarker1=position,
            offset=start,
        )
    )
    if machine.is_locked:
        held = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=slider, coordinate=0))
        fixed = system.AddNode(items.NodePointGround())
        still = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=fixed, coordinate=0))
        system.AddObject(items.ObjectConnectorCoordinate(markerNumbers=[still, held]))
    return slider


def _add_drive(
    system: Any,
    items: Any,
    i: int,
    slider: int,
    force: SliderForce,
    rho: float,
) -> None:
    own = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=slider, coordinate=0))
    fixed = system.AddNode(items.NodePointGround())
    still = system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=fixed, coordinate=0))

    def resistance(
        mbs: Any, t: float, item: int, u: float, v: float, k: float, d: float, offset: float
    ) -> float:
        return -force(i, t, rho + u, v)

    system.AddObject(
        items.ObjectConnectorCoordinateSpringDamper(
            markerNumbers=[still, own], springForceUserFunction=resistance
        )
    )


def _add_moments(system: Any, items: Any, mesh: Mesh, nodes: list[int]) -> dict[int, int]:
    """A moment, zero for now, at each end of an actuator."""
    loads = {}
    for node in np.unique(mesh.actuator_nodes):
        marker = system.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[node]))
        loads[int(node)] = system.AddLoad(
            items.LoadTorqueVector(markerNumber=marker, loadVector=[0, 0, 0])
        )
    return loads
