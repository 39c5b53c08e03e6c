"""Where the residual window begins if a study leaves it open: when the drives have settled.

A move leaves the drive's own tracking error behind, which bends the links while it settles. That
vibration says nothing of the links or of their control, so by default the window waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from jaxmodel.case import Drive
from jaxmodel.drive import LAG
from jaxmodel.drives import DRIVES
from jaxmodel.drives.contract import SliderError, drive_force
from studies.errors import StudyError, field_error
from studies.study.geometry import far_joints, machine_geometry
from studies.study.held_link import link_inertia
from studies.study.spec import AUTO, Study

#: The field.
DELAY = "metrics.residual_delay"
#: What is left of the drive's slowest motion when it counts as settled [1].
SETTLED = 0.02
#: The window begins on a multiple of this [s].
GRID = 1e-3
#: Fields that move the end of the path, or of the disturbances.
PATH = ("motion.move_time", "motion.dwell", "motion.waypoints")
PULSE_TIMES = (
    "drive.pulse_start",
    "drive.pulse_length",
    "load.pulse_start",
    "load.pulse_length",
)
#: Cosine of a link's angle to the path, at least, where a pose is out of reach [1].
FLATTEST = 0.045
#: A drive that takes longer never settles [s].
LONGEST = 100.0


def residual_delay(study: Study) -> float:
    """Start of the residual window after the end of the shaped command [s].

    `metrics.residual_delay` as given; for "auto" the time in which the drive settles, counted from
    the later of the path's end and the disturbances' end, rounded up to a millisecond. 0 where
    nothing moves the sliders.

    Args:
        study: validated study.

    Returns:
        inf for "auto" with a drive that never settles: such a study can be analysed, but not run.

    Example:
        >>> residual_delay(Study())
        0.026
    """
    delay = study.metrics.residual_delay
    if delay != AUTO:
        return float(delay)
    moves = len(study.motion.waypoints) - 1
    ends = _disturbance_ends(study)
    if study.drive.locked or (moves == 0 and not ends):
        return 0.0
    path = sum(_total(x, moves) for x in (study.motion.move_time, study.motion.dwell))
    wait = max([0.0, *(end - path for end in ends)]) + settling_time(study)
    return round(math.ceil(wait / GRID - 1e-6) * GRID, 9) if wait < LONGEST else math.inf


def with_window(study: Study) -> Study:
    """The study with a number for `metrics.residual_delay`.

    What varies a study (a sweep, a tuning, a fit) begins with this, so that all its cases have one
    window: a case whose drive settles later must not be measured later.

    Raises:
        StudyError: "auto" with a drive that never settles.
    """
    delay = residual_delay(study)
    if math.isinf(delay):
        raise never_settles(study)
    return study.change(metrics__residual_delay=delay)


def with_own_window(study: Study, data: Mapping[str, Any]) -> Study:
    """A study that came of `with_window` with its own window: that of another drive is another.

    Args:
        study: what became of it.
        data: sections of the file, as written.
    """
    return study.change(metrics__residual_delay=AUTO) if _is_open(data) else study


def _is_open(data: Mapping[str, Any]) -> bool:
    """Whether a file leaves the window open."""
    return bool(data.get("metrics", {}).get("residual_delay", AUTO) == AUTO)


def never_settles(study: Study) -> StudyError:
    """What to say where the residual window would have to wait for ever."""
    drive, wait = study.drive, settling_time(study)
    name, value, unit = ("kd", drive.kd, "N s/m") if drive.kp > 0 else ("kp", drive.kp, "N/m")
    if drive.lag > 0:
        name, value, unit = "lag", drive.lag, "s"
    duration = f"takes {wait:.3g} s" if math.isfinite(wait) else "never does"
    return field_error(
        f"drive.{name}",
        value,
        f"a drive that settles within {LONGEST:g} s with metrics.residual_delay = 'auto', which "
        f"waits for it (with drive.kp = {drive.kp:g} N/m, drive.kd = {drive.kd:g} N s/m and this "
        f"load it {duration}); or give metrics.residual_delay in s",
        unit,
    )


def check_varied(data: Mapping[str, Any], study: Study, names: Iterable[str]) -> None:
    """Check that one window suits all cases of what varies a study.

    The baseline's window waits for the baseline's disturbances, not for those of other cases.

    Args:
        data: sections of the file, as written.
        study: the baseline.
        names: fields, or entries of fields, that vary.

    Raises:
        StudyError: "auto" while the motion moves against a disturbance, or the other way round.
    """
    if not _is_open(data):
        return
    fields = {name.partition("[")[0] for name in names}
    has_pulse = bool(_disturbance_ends(study))
    if has_pulse:
        wrong = fields & {*PATH, *PULSE_TIMES}
    else:
        wrong = fields & {"drive.pulse_force", "load.pulse"}
    if wrong:
        raise field_error(
            DELAY,
            AUTO,
            f"a number where {', '.join(sorted(wrong))} varies, so that each case has its "
            "disturbance before the window or within it, as you want",
            "s",
        )


def settling_time(study: Study) -> float:
    """Time in which the drive's slowest motion decays to SETTLED [s].

    Returns:
        inf if a pole has no decay.
    """
    decay = float(np.min(-np.real(drive_poles(study))))
    return math.log(1 / SETTLED) / decay if decay > 0 else math.inf


def drive_poles(study: Study) -> np.ndarray:
    """Poles of the drives [1/s], (n,).

    They are those of the machine with rigid links at the last way-point, its drives held by
    k_p and k_d (and viscous friction): with the inertia M of the pose and the sliders' rates J X',
    each lambda of J^T J v = lambda M v is a mode s^2 + lambda k_d s + lambda k_p = 0, and of higher
    order where the drive remembers or its motor follows late. Where the drives differ from slider
    to slider, each is taken for all.
    """
    inertia, rates = rigid_machine(study)
    # both are scaled by M^(-1/2), which keeps the problem symmetric
    half = np.linalg.inv(np.linalg.cholesky(inertia))
    scale = np.linalg.eigvalsh(half @ rates.T @ rates @ half.T)
    drives = np.unique(_drive_slopes(study), axis=0)
    late = study.drive.lag, study.drive.viscous_friction
    return np.concatenate([_poles(drive, s, *late) for drive in drives for s in scale])


#: Deviation at which a drive is linearised: a power of two, so that proportional ones are exact.
_SMALL = 2.0**-40


def _drive_slopes(study: Study) -> np.ndarray:
    """Derivatives at rest by e, e' and the memory, of F_fb and of the memory's rate, (n, 2, 3)."""
    written, law = study.drive, DRIVES[study.drive.kind]
    own = {
        x.name: study.each_link(written.kinds.get(law.name, {}).get(x.name, x.default))
        for x in law.parameters
    }
    names = [x for x in Drive._fields if x not in ("parameters", "is_locked")]
    drive = Drive(
        parameters=own,
        is_locked=np.zeros(()),
        **{name: study.each_link(getattr(written, name)) for name in names},
    )
    period, zero = 1 / study.electronics.sample_rate_hz, np.zeros(study.n_links)
    slopes = np.zeros((study.n_links, 2, 3))
    for k in range(3 if law.update else 2):
        e, rate, memory = (_SMALL * np.ones(study.n_links) if k == j else zero for j in range(3))
        error = SliderError(e, rate)
        force = np.asarray(drive_force(law, drive, memory if law.update else None, error, True))
        slopes[:, 0, k] = force / _SMALL
        if law.update:
            after = np.asarray(law.update(drive, memory, error, force, np.asarray(period)))
            slopes[:, 1, k] = (after - memory) / (_SMALL * period)
    return slopes


def _poles(slopes: np.ndarray, scale: float, lag: float, viscous: float) -> np.ndarray:
    """Poles of e'' = -scale (F_fb + viscous e') under `_drive_slopes` of a slider [1/s]."""
    feedback, own = slopes
    if not np.any(own) and lag == 0:
        return np.roots([1.0, scale * (feedback[1] + viscous), scale * feedback[0]])
    n = len(own)
    state = np.zeros((n + len(LAG),) * 2)  # e, e', memory, and the states of a motor
    state[0, 1], state[1, 1], state[n - 1, :n] = 1.0, -scale * viscous, own
    used = np.arange(n if np.any(own) else n - 1)
    if lag == 0:
        state[1, :n] -= scale * feedback
    else:
        used, late = np.r_[used, n : len(state)], np.array(LAG) / lag
        state[1, n], state[n:, n:] = -scale, late[:, :-1]
        state[n:, :n] = late[:, -1:] * feedback
    return np.linalg.eigvals(state[np.ix_(used, used)])


def rigid_machine(study: Study) -> tuple[np.ndarray, np.ndarray]:
    """Inertia of the machine with rigid links at its last way-point, and its drives' rates.

    Args:
        study: validated study.

    Returns:
        M of the pose (x, y, phi) [kg, kg m, kg m2], (p, p); J = d rho / d pose [1, 1, m], (n, p).
    """
    link, pose = study.link, study.motion.waypoints[-1]
    geometry, near_mass = machine_geometry(study)
    length = study.each_link(link.length)
    far, joint = far_joints(geometry, pose, study.n_links)
    # an unreachable pose has a message of its own
    near = geometry.legs(np).near(*far.T, length**2, (FLATTEST * length) ** 2, np)
    u = np.stack([near.x, near.y], axis=1)
    n = np.stack([-u[:, 1], u[:, 0]], axis=1)
    sine, cosine = near.across / length, near.root / length
    by_height = np.einsum("ij,ijk->ik", n, joint)
    turn = by_height / (length * cosine)[:, None]
    rates = np.einsum("ij,ijk->ik", u, joint) + (sine / cosine)[:, None] * by_height
    mass, moment, turning = link_inertia(study)
    carried = near_mass + mass
    coupling = moment * sine
    inertia = np.einsum("i,ij,ik->jk", carried, rates, rates)
    inertia += np.einsum("i,ij,ik->jk", turning, turn, turn)
    mixed = np.einsum("i,ij,ik->jk", coupling, rates, turn)
    inertia += _platform(study, pose) - mixed - mixed.T
    return inertia, rates


def _platform(study: Study, pose: tuple[float, ...]) -> np.ndarray:
    """Inertia of platform and payload about the reference point, (p, p)."""
    machine, load = study.machine, study.load
    mass = (machine.platform_mass + load.mass) * np.eye(2)
    if len(pose) == 2:
        return mass
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    offset = np.array([[cosine, -sine], [sine, cosine]]) @ np.array(load.offset)
    mixed = load.mass * np.array([[-offset[1]], [offset[0]]])
    turning = machine.platform_inertia + load.inertia + load.mass * offset @ offset
    return np.block([[mass, mixed], [mixed.T, np.array([[turning]])]])


def _disturbance_ends(study: Study) -> list[float]:
    """When each disturbance ends [s]."""
    pulses = (
        (study.drive.pulse_force, study.drive.pulse_start, study.drive.pulse_length),
        (study.load.pulse, study.load.pulse_start, study.load.pulse_length),
    )
    return [start + length for force, start, length in pulses if any(force)]


def _total(times: float | tuple[float, ...], count: int) -> float:
    return sum(times[:count]) if isinstance(times, tuple) else count * times
