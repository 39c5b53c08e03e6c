"""A study in words: what moves the machine, and who is controlled."""

from __future__ import annotations

import numpy as np

from jaxmodel.laws import LAWS
from studies.show.units import count_text, span
from studies.study.consistency import patch_centers
from studies.study.spec import Study


def motion_text(study: Study) -> str:
    """What moves the machine, in words."""
    motion, load, drive = study.motion, study.load, study.drive
    points = np.array(motion.waypoints, float)[:, :2]
    count = len(points) - 1
    moving = "the platform at rest"
    if count:
        longest = 1e3 * np.linalg.norm(np.diff(points, axis=0), axis=1).max()
        times = np.atleast_1d(motion.move_time)
        span = f"{1e3 * times.min():.4g}" + (
            f" to {1e3 * times.max():.4g}" if np.ptp(times) else ""
        )
        shaper = "no shaper" if study.shaper.kind == "none" else f"shaper {study.shaper.kind}"
        moves = f"{count} move{'s' if count > 1 else ''} of {'up to ' if count > 1 else ''}"
        moving = f"{moves}{longest:.4g} mm in {span} ms{' each' if count > 1 else ''}, {shaper}"
    disturbances = [
        f"a pulse of {', '.join(f'{x:g}' for x in force)} {unit} on the {where}"
        for force, unit, where in (
            (drive.pulse_force, "N", "actuated joints"),
            (load.pulse, "N or N m", "platform"),
        )
        if any(force)
    ]
    if drive.ripple:
        disturbances.append(f"force ripple of {drive.ripple:g} N rms")
    if any(study.initial.load_deflection) or any(map(any, study.initial.modal)):
        disturbances.append("links bent at the start")
    return ", ".join([moving, *disturbances])


def machine_text(study: Study) -> str:
    """Links and patches, in words."""
    lengths = f"links of {span(1e3 * study.each_link(study.link.length))} mm"
    pairs = patch_centers(study).shape[1]
    return f"{lengths}, {count_text(pairs, 'patch pair')} each" if pairs else lengths


def baseline_text(study: Study) -> str:
    """A machine, its motion and its control, in words."""
    return "; ".join((machine_text(study), motion_text(study), control_text(study)))


def control_text(study: Study) -> str:
    """What is controlled and how, in words."""
    control = study.control
    links = [str(i + 1) for i, is_on in enumerate(control.links) if is_on]
    if control.feedback == "none" or not links:
        return "no link controlled"
    law = LAWS[control.law]
    modes = f" of {count_text(control.modes, 'mode')}" if law.channel == "mode" else ""
    return (
        f"{law.text}{modes} on link{'s' if len(links) > 1 else ''} {', '.join(links)}, "
        f"{control.feedback} feedback, gain factor {control.gain_factor:g}"
    )
