"""The file of a commissioning: a fit, what is wanted of the controller, and what it runs on.

`[fit]` is that of `studies fit`. `[tune]`, as of `studies tune`, may be left out or name only what
differs from the default; its machines are those of the fit. `[commission]` is described here.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

from jaxmodel.laws import LAWS
from jaxmodel.metrics import METRICS
from studies.errors import StudyError, field_error, nearest
from studies.export.firmware.boards import BOARDS
from studies.export.run import DAC_BITS
from studies.export.targets import TARGETS
from studies.fitting.spec import FitSpec, parse_fit
from studies.laws.candidates import RATIOS, law_candidate
from studies.space.machines import MISMATCHES
from studies.study.files import find_spec, read_toml
from studies.study.paths import parse_section
from studies.study.spec import Section, Study, described
from studies.tuning.spec import Tune, parse_tuning

#: Its section.
SECTION = "commission"
#: Starting points and iterations of a tuning, machines it is tuned on and judged on.
STARTS, ITERATIONS, TUNED_ON, JUDGED_ON = 16, 60, 3, 12
#: Factor by which a tuning keeps more than the required gain margin, beside what possible machines
#: differ by.
RESERVE = 1.02
#: How much larger the gain of patches is on some plants of a certificate, whose sensors and
#: actuators are longer than in the model [1].
LOUDER = max(x.sensor * x.actuator for x in MISMATCHES)


class Commission(Section):
    """What is wanted, and for which processor."""

    target: str = described("c-fixed", "-", "of studies export: c or c-fixed")
    processor: str = described(
        "", "-", "emulated one that runs the code, as studies export --pil; empty: none"
    )
    dac_bits: int = described(DAC_BITS, "1", "resolution of the DAC, for c-fixed", ge=4, le=16)
    gain_margin: float = described(
        2.0, "1", "least gain margin on every machine that the data leave possible", gt=1, le=16
    )


class MeasuredSpec(NamedTuple):
    """What a commissioning starts from."""

    fit: FitSpec
    tune: dict[str, Any]  # section [tune] as written
    commission: Commission
    data: dict[str, Any]  # the whole file

    @property
    def keeps_motion(self) -> bool:
        """Whether `[tune]` says something of the file's motion, so that no other one will do."""
        tune = self.tune
        free = {name.partition(".")[0] for name in tune.get("free", {})}
        timed = (METRICS.keys() - {"peak_voltage"}) & tune.get("limits", {}).keys()
        has_scenarios = bool(tune.get("scenarios", {}).get("each"))
        return "objective" in tune or has_scenarios or bool(timed or free & {"motion", "shaper"})

    @property
    def measures_gains(self) -> bool:
        """Whether voltages of sensors for voltages of actuators are among the data."""
        ends = [(getattr(x, "input", ""), getattr(x, "output", "")) for x in self.fit.entries]
        return any(
            source.startswith("actuator") and output.startswith("sensor") for source, output in ends
        )

    @property
    def study(self) -> Study:
        """The design before anything was measured."""
        return self.fit.study


def load_measured(path: str | Path) -> MeasuredSpec:
    """Read a file of a commissioning.

    Raises:
        StudyError: unreadable, not TOML, or not valid.
    """
    return parse_measured(read_toml(path), find_spec(path).parent)


def parse_measured(data: dict[str, Any], folder: str | Path = ".") -> MeasuredSpec:
    """Validate a dictionary as a commissioning.

    Args:
        data: sections of a study, `fit`, and optionally `tune` and `commission`.
        folder: where the files of the data are.

    Raises:
        StudyError: first fault found, with field, value, allowed range and unit.
    """
    rest = {name: value for name, value in data.items() if name not in ("tune", SECTION)}
    fit = parse_fit(rest, folder)
    written = data.get(SECTION, {})
    commission = parse_section(Commission, written, SECTION)
    targets = [name for name, x in TARGETS.items() if x.has_pil]
    _check_name("target", commission.target, targets)
    if commission.processor:
        _check_name("processor", commission.processor, list(BOARDS))
    control = fit.study.control
    if control.feedback != "sampled":
        raise field_error("control.feedback", control.feedback, "'sampled' for a controller")
    tune = data.get("tune", {})
    parse_section(Tune, tune, "tune")
    if "machines" in tune.get("scenarios", {}):
        raise StudyError("tune.scenarios.machines: not allowed here; they are those of the fit")
    measured = MeasuredSpec(fit=fit, tune=tune, commission=commission, data=data)
    # what a tuning refuses is said before anything is fitted
    parse_tuning(fit.study.model_dump() | {"tune": tuning_section(measured, fit.study, {})})
    return measured


def _check_name(field: str, value: str, allowed: list[str]) -> None:
    if value not in allowed:
        name = f"{SECTION}.{field}"
        raise field_error(name, value, ", ".join(allowed), hint=nearest(value, allowed))


def certified_margin(measured: MeasuredSpec) -> float:
    """Gain margin required on every plant of the certificate [1].

    Some of them have longer patches, and so louder ones, which measured gains exclude.
    """
    margin = measured.commission.gain_margin
    return max(margin / LOUDER, 1.05) if measured.measures_gains else margin


def tuning_section(
    measured: MeasuredSpec,
    study: Study,
    machines: dict[str, list[float]],
    spread: float = 1.0,
) -> dict[str, Any]:
    """Section [tune] for a fitted study.

    Args:
        measured: what was asked for.
        study: the fitted one.
        machines: that the data leave possible, by field.
        spread: gain margin of the fitted machine over the least one of possible machines [1].
    """
    written = measured.tune
    default = {
        "free": written["free"] if "free" in written else _own_free(study),
        "objective": {"residual_rms": 1.0},
        "starts": STARTS,
        "iterations": ITERATIONS,
    }
    margin = RESERVE * spread * LOUDER * certified_margin(measured)
    limits = {"gain_margin": margin} | written.get("limits", {})
    scenarios = {"count": TUNED_ON, "check": JUDGED_ON} | written.get("scenarios", {})
    if machines:
        scenarios["machines"] = machines
    else:
        scenarios["count"] = 1
    return default | written | {"limits": limits, "scenarios": scenarios}


def _own_free(study: Study) -> dict[str, Any]:
    """The gain and the filters of a study's law, as [tune.free]."""
    own = law_candidate(study, LAWS[study.control.law])
    return {name: x for name, x in own.free.items() if not name.startswith(RATIOS)}
