"""Free parameters of a design: their names, bounds and scale, and how they get into its numbers.

A free field is a number of the study file, an entry of a list, or a list, each of whose entries is
then free by itself. `placement` stands for several numbers: patch centres on the link and without
overlap, for any numbers in [0, 1].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Literal

import jax.numpy as jnp
import numpy as np

from jaxmodel.numbers import Numbers
from jaxmodel.parameters import Array
from studies.errors import StudyError, field_error, shown_name
from studies.space.axes import Range
from studies.space.free import (
    Free,
    FreeNumbers,
    Place,
    Placing,
    check_twice,
    join_numbers,
    plain_numbers,
)
from studies.study.consistency import patch_centers, patch_pitch
from studies.study.paths import Parts, parse_section
from studies.study.section import DESIGN, Section, described
from studies.study.spec import Study

#: Free name that stands for several numbers.
PLACEMENT = "placement"
#: Fields that it sets or relies on.
DECIDED = ("patches.", "link.length")


def writes(number: Free) -> tuple[str, ...]:
    """Fields of the study that a free parameter sets."""
    return ("patches.centers",) if number.key == PLACEMENT else (number.name,)


def free_numbers(
    written: Mapping[str, object], study: Study, parts: Sequence[Parts] = ()
) -> FreeNumbers:
    """Free parameters from what the file says.

    Args:
        written: ranges by name, from `[tune.free]`.
        study: the initial design.
        parts: laws and drives whose parameters can be free; (): those of the study.

    Raises:
        StudyError: nothing free, unknown name, bad bounds, a start outside them.
    """
    if not written:
        raise field_error("tune.free", {}, "one free field or more")
    fields: list[tuple[list[Free], Place]] = []
    for name, bounds in written.items():
        path = f"tune.free.{shown_name(name)}"
        if name == PLACEMENT:
            fields.append(_placement(bounds, study, path))
        else:
            fields.append(plain_numbers(name, bounds, study, path, (DESIGN,), (PLACEMENT,), parts))
    free = join_numbers(fields)
    check_twice(free.numbers, "tune.free")
    _check_decided(free.numbers)
    if study.control.has_poles:
        poles = "damping" if study.control.damping != () else "pole_decay"
        for number in free.numbers:
            if number.key.startswith(("control.velocity_gain", "control.position_gain")):
                raise StudyError(
                    f"tune.free.{number.key}: control.{poles} decides the gains: free that instead"
                )
    return free


def _check_decided(numbers: Sequence[Free]) -> None:
    """No field can be moved on which the placement relies."""
    if not any(number.key == PLACEMENT for number in numbers):
        return
    for number in numbers:
        if number.key.startswith(DECIDED):
            raise StudyError(f"tune.free.{number.key}: {PLACEMENT} is free too and decides it")


class FreePlacement(Section):
    """Patches whose places are free, in order and without overlap."""

    kind: Literal["same", "per_link"] = described(..., "-", "on all links, or on each")


def _placement(bounds: object, study: Study, path: str) -> tuple[list[Free], Place]:
    kind = parse_section(FreePlacement, bounds, path).kind
    centers, pitch, length = (
        patch_centers(study),
        patch_pitch(study),
        study.each_link(study.link.length),
    )
    links, count = (1 if kind == "same" else study.n_links), centers.shape[1]
    if links == 1:  # room on all links
        pitch, length = pitch.max(keepdims=True), length.min(keepdims=True)
    free = length - count * pitch
    if np.any(free <= 0):
        raise field_error(path, bounds, f"a link longer than its {count} patches")
    numbers = []
    for i in range(links):
        gaps = np.diff([0.0, *(np.sort(centers[i]) - pitch[i] * (np.arange(count) + 0.5))])
        starts = _shares(gaps / free[i])
        numbers += [
            Free(f"placement[{i}][{k}]", Range(0.0, 1.0, 0, False), float(starts[k]), PLACEMENT)
            for k in range(count)
        ]
    return numbers, Placing(_place_patches, (links, tuple(pitch)))


def _shares(gaps: np.ndarray) -> np.ndarray:
    """Numbers for which `_place_patches` leaves these gaps, as shares of the free length."""
    left, shares = 1.0, []
    for k, gap in enumerate(gaps):
        kept = np.clip(1 - gap / left, 0.0, 1.0) if left > 0 else 1.0
        shares.append(1 - kept ** (len(gaps) - k))
        left -= gap
    return np.array(shares)


def _place_patches(
    links: int, pitches: tuple[float, ...], numbers: Numbers, values: Array
) -> Numbers:
    """Place patches one by one, each after a gap that is its share of the remaining free length.

    Of k gaps to come, a number v takes 1 - (1 - v)^(1/k): equal numbers are drawn evenly from all
    placements.
    """
    pitch, length = jnp.asarray(pitches), numbers["link.length"]
    count = values.shape[0] // links
    left = (jnp.min(length) if links == 1 else length) - count * pitch
    begin, centers = jnp.zeros((links,), values.dtype), []
    is_kept = jnp.isnan(jnp.sum(values))  # nan would spoil derivatives
    shares = jnp.reshape(jnp.where(jnp.isnan(values), 1.0, values), (links, count))
    for k in range(count):
        # the root has no slope at 0, where no free length is left
        kept = jnp.maximum(1 - shares[:, k], 1e-12) ** (1 / (count - k))
        begin, left = begin + left * (1 - kept), left * kept
        centers.append(begin + pitch * (k + 0.5))
    center = jnp.broadcast_to(jnp.stack(centers, axis=-1), (*length.shape, count))
    return numbers | {"patches.centers": jnp.where(is_kept, numbers["patches.centers"], center)}
