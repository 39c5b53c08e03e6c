"""The machine in Exudyn: links of ANCF cables, rails, cranks, platform, joints, patches.

Only this module needs Exudyn, and imports it when a model is built. Nothing of this project's
dynamics is used: links are cables with large rotations that bend and stretch, closed to a machine
by joints with constraint forces.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, NamedTuple

import numpy as np

from jaxmodel.mechanisms.carriers import Carrier, Rail
from studies.errors import StudyError
from studies.twin.chain import close_chain, lever, rotation
from studies.twin.machine import MachineData, PlatformBody, PlatformPoint
from studies.twin.mesh import Mesh, damping_matrix, mesh_link

MISSING = "studies twin: Exudyn is missing: install flexlink-studies[twin]"

#: Force of motor i and everything else along the path of joint B [N] at time t [s], from rho [m]
#: and rho' [m/s]: f(i, t, rho, rho').
DriveForce = Callable[[int, float, float, float], float]


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
    carrier_start: tuple[int, ...]  # coordinate of each carrier, zero at the start
    levers: np.ndarray  # way of B over that coordinate, see `chain.lever`, (n,)
    platform_start: int  # first of (x, y, phi), or of (x, y)
    # numbers of the loads, force and moment, of each node with a patch end, by link
    patch_loads: tuple[dict[int, tuple[int, int]], ...]
    platform_loads: tuple[int, ...]  # of force and, unless it is a point, moment at its reference


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


def build_model(
    machine: MachineData,
    pose: np.ndarray,
    force: DriveForce | None,
    settings: Settings = DEFAULT,
) -> Model:
    """Assemble the machine at rest with straight links.

    Args:
        machine: what to build.
        pose: of the platform, (x, y, phi) or (x, y) [m, m, rad].
        force: on the carriers; None: they are free.
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
    levers = np.array([lever(carrier) for carrier in machine.carriers])
    platform = _add_platform(system, items, machine, pose)
    nodes, carriers, patch_loads = [], [], []
    for i, mesh in enumerate(meshes):
        own = _add_link(system, items, machine, mesh, i, ends[i], settings.axial_factor)
        carrier = _add_carrier(system, items, machine.carriers[i], ends[i, 0], own[0])
        if machine.is_locked:
            _hold(system, items, carrier)
        elif force is not None:
            _add_drive(system, items, i, carrier, force, rho[i], levers[i])
        joint = system.AddMarker(items.MarkerNodePosition(nodeNumber=own[-1]))
        system.AddObject(items.ObjectJointRevolute2D(markerNumbers=[platform.joints[i], joint]))
        nodes.append(own)
        carriers.append(carrier)
        patch_loads.append(_add_patch_loads(system, items, mesh, own))
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
        carrier_start=tuple(map(start, carriers)),
        levers=levers,
        platform_start=start(platform.node),
        patch_loads=tuple(patch_loads),
        platform_loads=platform.loads,
    )


def _coordinates(exudyn: Any, system: Any, configuration: Any) -> np.ndarray:
    return np.array(system.systemData.GetODE2Coordinates(configuration))


class _Platform(NamedTuple):
    """A platform in Exudyn."""

    node: int
    joints: list[int]  # marker of each joint C
    loads: tuple[int, ...]  # force, and moment unless it is a point


def _add_platform(system: Any, items: Any, machine: MachineData, pose: np.ndarray) -> _Platform:
    if isinstance(machine.platform, PlatformPoint):
        return _add_point(system, items, machine.platform, pose, len(machine.links))
    return _add_body(system, items, machine.platform, pose)


def _add_point(
    system: Any, items: Any, platform: PlatformPoint, pose: np.ndarray, count: int
) -> _Platform:
    node = system.AddNode(items.NodePoint2D(referenceCoordinates=pose))
    system.AddObject(items.ObjectMassPoint2D(mass=platform.mass, nodeNumber=node))
    at = system.AddMarker(items.MarkerNodePosition(nodeNumber=node))
    force = system.AddLoad(items.LoadForceVector(markerNumber=at, loadVector=[0, 0, 0]))
    return _Platform(node, count * [at], (force,))


def _add_body(system: Any, items: Any, platform: PlatformBody, pose: np.ndarray) -> _Platform:
    """The rigid platform, with its node at the centre of mass, loaded at its reference point."""
    center = pose[:2] + rotation(pose[2]) @ platform.center
    node = system.AddNode(items.NodeRigidBody2D(referenceCoordinates=[*center, pose[2]]))
    body = system.AddObject(
        items.ObjectRigidBody2D(mass=platform.mass, inertia=platform.inertia, nodeNumber=node)
    )
    joints = [
        system.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[*place, 0]))
        for place in platform.joints - platform.center
    ]
    at = system.AddMarker(
        items.MarkerBodyRigid(bodyNumber=body, localPosition=[*-platform.center, 0])
    )
    force = system.AddLoad(items.LoadForceVector(markerNumber=at, loadVector=[0, 0, 0]))
    moment = system.AddLoad(items.LoadTorqueVector(markerNumber=at, loadVector=[0, 0, 0]))
    return _Platform(node, joints, (force, moment))


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
                axialDamping=link.retardation * axial_factor * mesh.axial[k],
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


def _add_carrier(system: Any, items: Any, carrier: Carrier, near: np.ndarray, first: int) -> int:
    """Node of a slider or a crank, with one coordinate, that carries the first node of its link.

    near: B at the start [m], (2,).
    """
    node = system.AddNode(items.Node1D(referenceCoordinates=[0.0]))
    if isinstance(carrier, Rail):
        arm, axis = 0.0, carrier.direction
        add, inertia = items.ObjectMass1D, {"mass": carrier.mass}
    else:
        arm, axis = carrier.length, (near - carrier.pivot) / carrier.length
        add, inertia = items.ObjectRotationalMass1D, {"inertia": carrier.inertia}
    axes = np.eye(3)
    axes[:2, :2] = [[axis[0], -axis[1]], [axis[1], axis[0]]]
    body = system.AddObject(
        add(
            nodeNumber=node,
            referencePosition=[*near - arm * axis, 0.0],
            referenceRotation=axes,
            **inertia,
        )
    )
    at = system.AddMarker(items.MarkerBodyPosition(bodyNumber=body, localPosition=[arm, 0.0, 0.0]))
    joint = system.AddMarker(items.MarkerNodePosition(nodeNumber=first))
    system.AddObject(items.ObjectJointRevolute2D(markerNumbers=[at, joint]))
    return int(node)


def _hold(system: Any, items: Any, node: int) -> None:
    """Keep a carrier where it is."""
    system.AddObject(items.ObjectConnectorCoordinate(markerNumbers=_to_ground(system, items, node)))


def _add_drive(
    system: Any,
    items: Any,
    i: int,
    node: int,
    force: DriveForce,
    rho: float,
    arm: float,
) -> None:
    """The force of drive i on its carrier's coordinate u, from `rho` + `arm` u."""

    def resistance(
        mbs: Any, t: float, item: int, u: float, v: float, k: float, d: float, offset: float
    ) -> float:
        return -arm * force(i, t, rho + arm * u, arm * v)

    system.AddObject(
        items.ObjectConnectorCoordinateSpringDamper(
            markerNumbers=_to_ground(system, items, node), springForceUserFunction=resistance
        )
    )


def _to_ground(system: Any, items: Any, node: int) -> list[int]:
    """Markers of the ground and of a carrier's coordinate."""
    return [
        system.AddMarker(items.MarkerNodeCoordinate(nodeNumber=x, coordinate=0))
        for x in (system.AddNode(items.NodePointGround()), node)
    ]


def _add_patch_loads(
    system: Any, items: Any, mesh: Mesh, nodes: list[int]
) -> dict[int, tuple[int, int]]:
    """A force and a moment, zero for now, at each end of an actuator or sensor."""
    loads = {}
    for node in np.unique([mesh.actuator_nodes, mesh.sensor_nodes]).tolist():
        at = system.AddMarker(items.MarkerNodePosition(nodeNumber=nodes[node]))
        turned = system.AddMarker(items.MarkerNodeRigid(nodeNumber=nodes[node]))
        loads[node] = (
            system.AddLoad(items.LoadForceVector(markerNumber=at, loadVector=[0, 0, 0])),
            system.AddLoad(items.LoadTorqueVector(markerNumber=turned, loadVector=[0, 0, 0])),
        )
    return loads
