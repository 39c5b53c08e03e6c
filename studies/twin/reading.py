"""Reading the twin's signals from its coordinates, and putting voltages on it."""

from __future__ import annotations

import numpy as np

from studies.twin.chain import rotation
from studies.twin.machine import MachineData, PlatformPoint
from studies.twin.multibody import Model


class Reader:
    """Signals of a model at the last instant that was read."""

    def __init__(self, model: Model, machine: MachineData) -> None:
        self._model, self._machine = model, machine
        self._now = model.reference
        self._spans = [
            slice(start, start + 4 * len(mesh.x))
            for start, mesh in zip(model.link_start, model.meshes, strict=True)
        ]
        self._put: dict[int, tuple[float, ...]] = {}

    def read(self) -> None:
        """Take all coordinates of the present instant."""
        data = self._model.system.systemData
        self._now = self._model.reference + data.GetODE2Coordinates()

    def _nodes(self, i: int) -> np.ndarray:
        """x, y, x', y' of the nodes of a link, (nodes, 4)."""
        return self._now[self._spans[i]].reshape(-1, 4)

    def deflection(self) -> np.ndarray:
        """Of mid-span from the chord between the joints, to the left of it [m], (n,)."""
        out = np.zeros(len(self._model.meshes))
        for i, mesh in enumerate(self._model.meshes):
            place = self._nodes(i)[:, :2]
            chord, at = place[-1] - place[0], place[mesh.middle] - place[0]
            out[i] = (chord[0] * at[1] - chord[1] * at[0]) / np.hypot(*chord)
        return out

    def voltages(self) -> np.ndarray:
        """Of the sensors [V], (n, K): bent by the slopes at their ends, lengthened between them."""
        rows = []
        for i, (mesh, link) in enumerate(zip(self._model.meshes, self._machine.links, strict=True)):
            place, slope = np.split(self._nodes(i)[mesh.sensor_nodes], 2, axis=2)  # (K, 2, 2)
            longer = np.hypot(*(place[:, 1] - place[:, 0]).T) - np.diff(mesh.x[mesh.sensor_nodes]).T
            left, right = slope[:, 0], slope[:, 1]
            sine = left[:, 0] * right[:, 1] - left[:, 1] * right[:, 0]
            cosine = np.sum(left * right, axis=1)
            bent = link.sensor_constant * np.arctan2(sine, cosine)
            rows.append(link.factors[0] * (bent - link.membrane * longer[0]))
        return np.stack(rows)

    def pose(self) -> np.ndarray:
        """Of the platform's reference point, (x, y, phi) or (x, y) [m, m, rad]."""
        start, platform = self._model.platform_start, self._machine.platform
        place = self._now[start : start + 2]
        if isinstance(platform, PlatformPoint):
            return np.array(place)
        phi = self._now[start + 2]
        return np.array([*place - rotation(phi) @ platform.center, phi])

    def put_voltages(self, voltage: np.ndarray) -> None:
        """Moments of the actuators, and pairs of forces along them at their ends, from now on.

        Args:
            voltage: [V], (n, K).
        """
        for i, (mesh, link) in enumerate(zip(self._model.meshes, self._machine.links, strict=True)):
            volts, force = link.factors[1] * voltage[i], np.zeros((len(mesh.x), 2))
            moment = volts @ mesh.moment
            place = self._nodes(i)[mesh.actuator_nodes, :2]  # (K, 2, 2)
            along = place[:, 1] - place[:, 0]
            along *= (link.push * volts / np.hypot(*along.T))[:, None]
            np.add.at(force, mesh.actuator_nodes, np.stack([-along, along], axis=1))
            for node, (push, turn) in self._model.patch_loads[i].items():
                self._set(push, [*force[node].tolist(), 0.0])
                self._set(turn, [0.0, 0.0, float(moment[node])])

    def put_wrench(self, wrench: np.ndarray) -> None:
        """Force on the platform's reference point and, unless it is a point, moment [N, N, N m]."""
        force, *moments = self._model.platform_loads
        self._set(force, [wrench[0], wrench[1], 0.0])
        for moment in moments:
            self._set(moment, [0.0, 0.0, wrench[2]])

    def _set(self, load: int, vector: list[float]) -> None:
        if self._put.get(load) != (size := tuple(vector)):
            self._model.system.SetLoadParameter(load, "loadVector", vector)
            self._put[load] = size
