"""The modal bases of a case: of the real links, and of the controller's nominal model of them."""

from __future__ import annotations

from typing import NamedTuple

from jaxmodel.beam import ModalBasis, build_basis, held_frequency, map_modes, mask_modes
from jaxmodel.case import Case, Structure
from jaxmodel.lazy import compiled, jnp
from jaxmodel.parameters import Array, Num


class Bases(NamedTuple):
    """Bases of the links and of the controller's model."""

    plant: ModalBasis  # R modes
    at_load: Num[Array, "links R"]  # deflection of the plant's modes at the static load [1]
    plant_omega: Num[Array, "links C"]  # frequencies of the links between held ends [rad/s]
    model: ModalBasis  # the controller's model, max(R, C) modes
    believed_omega: Num[Array, "links C"]  # what its filters and shaper are designed for [rad/s]


@compiled("structure")
def find_bases(structure: Structure, case: Case) -> Bases:
    """Bases of plant and controller.

    The controller's model has nominal stiffness; frequencies in the case (measured, perhaps)
    replace its own. It includes patches and joint inertia only in basis `loaded`.

    Args:
        structure: static choices; bases and sizes are read.
        case: the numbers.

    Example:
        >>> find_bases(*paper_case({"link.modes": 2})).plant_omega.shape
        (3, 3)
    """
    beam, patches, n = case.machine.beam, case.machine.patches, structure.n_controlled
    belief, factor = beam._replace(stiffness_factor=1.0), beam.stiffness_factor
    size = max(structure.n_modes, n)
    load = jnp.broadcast_to(case.initial.load_station, (case.machine.n_links, 1))
    stations = jnp.concatenate([station_places(case), load], axis=1)
    both = structure.basis, structure.controller_basis
    plant = build_basis(both[0], beam, patches, size, stations)
    if both[0] == both[1]:
        model = _with_stiffness(plant, jnp.broadcast_to(1 / factor, (case.machine.n_links,)))
    else:
        model = build_basis(both[1], belief, patches, size, stations)
    own = held_frequency(both[1], belief, model)[:, :n]
    written = case.control.omega
    is_there = (jnp.arange(structure.n_modes) < case.n_modes).astype(plant.mass.dtype)
    cut = _first_modes(plant, structure.n_modes)
    return Bases(
        plant=mask_modes(_without_load(cut), is_there),
        at_load=cut.deflection_at[:, -1] * is_there,
        plant_omega=held_frequency(both[0], beam, plant)[:, :n],
        model=_without_load(model),
        believed_omega=jnp.where(written > 0, written, own),
    )


def station_places(case: Case) -> Array:
    """Where the chord deflection of each link is taken, from the actuated joint [m], (3, S)."""
    length = jnp.broadcast_to(case.machine.beam.length, (case.machine.n_links,))
    return length[:, None] * case.windows.stations


def _without_load(basis: ModalBasis) -> ModalBasis:
    """Without the last station, where a static load acts."""
    return basis._replace(
        deflection_at=basis.deflection_at[:, :-1],
        static_deflection=basis.static_deflection[:, :-1],
    )


def _with_stiffness(basis: ModalBasis, factor: Array) -> ModalBasis:
    """The same links with this factor on their stiffness, which changes no shape."""
    return basis._replace(
        stiffness=basis.stiffness * factor[:, None],
        static_slope=basis.static_slope / factor[:, None, None],
        static_deflection=basis.static_deflection / factor[:, None, None],
    )


def _first_modes(basis: ModalBasis, n: int) -> ModalBasis:
    """A basis with its first n modes."""
    cut = map_modes(basis, lambda x: x[..., :n], lambda x: x[:, :n], lambda x: x[:, :n, :n])
    return cut._replace(mass=basis.mass[:, :n], stiffness=basis.stiffness[:, :n])
