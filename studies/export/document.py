"""The JSON file of a controller: its study, and every number with its unit, axes and meaning."""

from __future__ import annotations

import json
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxmodel.channels import Channels
from jaxmodel.controller import Controller, Feedback
from jaxmodel.estimator import KINDS, Estimator
from jaxmodel.laws import LAWS
from jaxmodel.shaper import Taps
from jaxmodel.state_space import StateSpace
from studies import config
from studies.engine.controller import FixedController, fixed_controller
from studies.errors import StudyError, shown
from studies.reading import read_json
from studies.study.choices import OneOf
from studies.study.spec import Study, parse_study

FORMAT = "flexlink-controller"
#: Allowed differences of numbers recomputed on another machine: relative to themselves, and to the
#: largest one in their table.
ROUNDING, CANCELLED = 1e-9, 1e-12


class DocumentPart(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, allow_inf_nan=False)


#: A number, or lists of them to any depth in use.
Three = list[list[list[float]]]
Nested = float | list[float] | list[list[float]] | Three | list[Three]


class Quantity(DocumentPart):
    """Numbers and their meaning; `value` is nested as `axes` says, a single number not at all."""

    value: Nested
    unit: str = Field(description="SI symbol, 1 for none", min_length=1)
    axes: list[str] = Field(description="meaning of each level of nesting")
    meaning: str = Field(description="in words", min_length=1)


class Masks(DocumentPart):
    """What is controlled."""

    links: list[bool] = Field(description="per link", min_length=2, max_length=3)
    modes: list[list[bool]] = Field(
        description="per link and mode (or patch)", min_length=2, max_length=3
    )


class Document(DocumentPart):
    """A controller: what happens once per sample, in the order of `steps`."""

    format: Literal["flexlink-controller"]
    format_version: Literal[1]
    title: str
    case_id: str = Field(description="id of the case in its sweep; empty if there is none")
    study_hash: str = Field(description="SHA-256 of the study below as compact sorted JSON")
    versions: dict[str, str]
    law: Annotated[str, OneOf(lambda: LAWS)]
    estimator: Annotated[str, OneOf(lambda: KINDS)]
    order: str = Field(description="how wires of sensors and actuators are numbered")
    steps: list[str] = Field(description="the arithmetic of one sample, in words")
    masks: Masks
    numbers: dict[str, Quantity]
    study: dict[str, Any] = Field(description="the complete study, as a study file holds it")


ORDER = (
    "wire = patches_per_link * (link - 1) + patch, from 1; patches counted from the actuated joint"
)
STEPS = [
    "for each link by itself; memory, w1, w2 and the last command are 0 at the start",
    "sensor = (adc_code * adc_step - conditioner_bias) / conditioner_gain",
    "sensor = sensor - feedthrough @ command of the last sample",
    "signal = modal_filter @ sensor",
    "high = high_pass_b0 * signal + memory; memory = high_pass_b1 * signal - high_pass_a1 * high",
    "w = high - low_pass_a1 * w1 - low_pass_a2 * w2",
    "velocity = sum of velocity_numerator * (w, w1, w2); position likewise; then w2 = w1, w1 = w",
    "force = -velocity_gain * velocity - position_gain * (position + position_direct * signal)",
    "command = synthesizer @ force, limited to +-voltage_limit; it goes out at the next sample",
    "a sensor that is not a number, is out of range or 10 ms at one end of it: all commands "
    "0, until started again",
    "reference: shaped pose = sum over taps of shaper_weight * pose shaper_delay samples ago",
]
#: An extra step before the synthesizer if channels of a link act one at a time.
RIVALS = (
    "energy = (rival_frequency * (position + position_direct * signal))^2 + velocity^2; of the "
    "channels of a link with rival_frequency above 0 the force is 0 where another has more energy"
)
#: Instead of the steps from `signal` to `command`, for a controller without channels.
SYSTEMS = (
    "for each link by itself if there are three systems, with all links together if there is one; "
    "state and the last command are 0 at the start",
    "wanted = output_matrix @ state + direct @ sensor; then state = state_matrix @ state + "
    "input_matrix @ sensor, where state_matrix stands for its blocks on the diagonal",
    "command = wanted, limited to +-voltage_limit; it goes out at the next sample",
)
TOLD = "then state = state + anti_windup @ (command - wanted)"
_LINK, _PATCH = "link", "patch"


def study_hash(study: Study) -> str:
    """SHA-256 of a study's values."""
    text = json.dumps(study.model_dump(mode="json"), sort_keys=True, separators=(",", ":"))
    return sha256(text.encode()).hexdigest()


def document(exported: FixedController, case_id: str = "") -> Document:
    """The document of a controller; case_id: of the case in its sweep."""
    study, controller = exported.study, exported.controller
    facts = config.info()
    kept = (config.PACKAGE, "python", "jax", "jaxlib", "numpy")
    return Document(
        format="flexlink-controller",
        format_version=1,
        title=study.title,
        case_id=case_id,
        study_hash=study_hash(study),
        versions={name: str(facts[name]) for name in kept},
        law=study.control.law,
        estimator=study.electronics.estimator,
        order=ORDER,
        steps=_steps(controller.feedback),
        masks=Masks(
            links=[k in exported.channels.link for k in range(exported.n_links)],
            modes=_acting(exported).tolist(),
        ),
        numbers=_numbers(exported),
        study=json.loads(json.dumps(study.model_dump(mode="json"))),
    )


def _acting(exported: FixedController) -> np.ndarray:
    """Channels that act, (n, C); a linear system has none."""
    feedback = exported.controller.feedback
    if isinstance(feedback, StateSpace):
        return np.zeros((exported.n_links, 0), bool)
    return feedback.acting


def _steps(feedback: Feedback) -> list[str]:
    if isinstance(feedback, StateSpace):
        told = [] if feedback.anti_windup is None else [TOLD]
        return [SYSTEMS[0], *STEPS[1:3], *SYSTEMS[1:], *told, *STEPS[9:]]
    return STEPS if feedback.rival_omega is None else [*STEPS[:8], RIVALS, *STEPS[8:]]


def _numbers(exported: FixedController) -> dict[str, Quantity]:
    """Every number of the controller, by name."""
    controller, electronics = exported.controller, exported.study.electronics
    if isinstance(controller.feedback, StateSpace):
        of_feedback = _of_system(controller.feedback)
    else:
        of_feedback = _of_channels(exported, controller.feedback)
    return {
        "sample_rate": _one(electronics.sample_rate_hz, "Hz", "how often a sample is taken"),
        "antialias": _one(
            electronics.antialias_hz,
            "Hz",
            "corner of the analogue second-order Butterworth filter before the ADC",
        ),
        "adc_bits": _one(float(electronics.adc_bits), "1", "resolution of the ADC"),
        "adc_step": _one(controller.adc_step, "V", "one code at the ADC's input"),
        "adc_top": _one(controller.adc_top, "1", "highest code"),
        "conditioner_gain": _one(controller.adc_gain, "1", "ADC volt per sensor volt"),
        "conditioner_bias": _one(controller.adc_bias, "V", "at the ADC for a sensor at rest"),
        "feedthrough": _one(
            controller.feedthrough,
            "1",
            "sensor volts that an actuator volt causes by modes that are not controlled",
            [_LINK, _PATCH, "actuator"],
        ),
        **of_feedback,
        "voltage_limit": _one(controller.voltage_limit, "V", "of every actuator, +-"),
        "shaper_weight": _one(
            exported.taps.weight, "1", "of each tap of the input shaper", ["tap"]
        ),
        "shaper_delay": _one(
            exported.taps.sample.astype(float), "1", "of each tap [samples]", ["tap"]
        ),
    }


def _one(value: Any, unit: str, meaning: str, axes: list[str] | None = None) -> Quantity:
    return Quantity(value=np.asarray(value).tolist(), unit=unit, axes=axes or [], meaning=meaning)


def _of_system(system: StateSpace) -> dict[str, Quantity]:
    """The systems of a controller without channels."""
    block = ["system", "block"]
    return {
        "state_matrix": _one(system.state, "1", "A in blocks", [*block, "to", "from"]),
        "input_matrix": _one(system.enter, "1", "B, state per volt", [*block, "to", "sensor"]),
        "output_matrix": _one(
            system.leave, "1", "C, volts per state", ["system", "actuator", "block", "from"]
        ),
        "direct": _one(system.direct, "1", "D", ["system", "actuator", "sensor"]),
        **(
            {}
            if system.anti_windup is None
            else {
                "anti_windup": _one(
                    system.anti_windup,
                    "1",
                    "E, state per volt that a limit adds to a command",
                    [*block, "to", "actuator"],
                )
            }
        ),
    }


def _of_channels(exported: FixedController, feedback: Channels) -> dict[str, Quantity]:
    """Filters, sections and gains of the channels."""
    estimator, position = feedback.estimator, feedback.position_gain
    to_signal, from_force = ("m/V", "V/N") if exported.is_modal else ("1", "1")
    on_rate, on_value = ("N s/m", "N/m") if exported.is_modal else ("s", "1")
    shape = feedback.velocity_gain.shape
    is_phase = exported.study.electronics.estimator == "modal_phase"
    # the section that differentiates turns the signal into a rate: the last one of modal_phase
    rate = "1" if is_phase else "1/s"
    last = "1/s" if is_phase else "1"

    channel = exported.channels.kind
    each_axes = [_LINK, channel]

    def each(value: Any, unit: str, meaning: str) -> Quantity:
        return _one(np.broadcast_to(value, shape), unit, meaning, each_axes)

    return {
        "modal_filter": _one(
            feedback.filter,
            to_signal,
            "channel signal of each sensor voltage",
            [*each_axes, _PATCH],
        ),
        "channel_frequency": each(exported.frequency, "Hz", "the velocity estimate is exact there"),
        "high_pass_b0": each(estimator.first[0], rate, "first section, numerator"),
        "high_pass_b1": each(estimator.first[1], rate, "first section, numerator of z^-1"),
        "high_pass_a1": each(estimator.first[2], "1", "first section, denominator of z^-1"),
        "low_pass_a1": each(estimator.denominator[0], "1", "second section, denominator of z^-1"),
        "low_pass_a2": each(estimator.denominator[1], "1", "second section, denominator of z^-2"),
        "velocity_numerator": _one(
            np.stack([np.broadcast_to(x, shape) for x in estimator.velocity], axis=2),
            last,
            "second section, numerator of the velocity",
            [*each_axes, "power of z^-1"],
        ),
        "position_numerator": _one(
            np.stack([np.broadcast_to(x, shape) for x in estimator.position], axis=2),
            "1",
            "second section, numerator of the position",
            [*each_axes, "power of z^-1"],
        ),
        "position_direct": each(estimator.direct, "1", "share of the signal in the position"),
        "velocity_gain": each(feedback.velocity_gain, on_rate, "k_d, masks and factors put in"),
        "position_gain": each(
            0.0 if position is None else position, on_value, "k_p, masks and factors put in"
        ),
        **(
            {}
            if feedback.rival_omega is None
            else {
                "rival_frequency": each(
                    feedback.rival_omega,
                    "rad/s",
                    "above 0: of the channels of a link with one only "
                    "those of highest energy act, (rival_frequency position)^2 + velocity^2",
                )
            }
        ),
        "synthesizer": _one(
            feedback.synthesizer,
            from_force,
            "voltages of a channel's force",
            [_LINK, _PATCH, channel],
        ),
    }


def controller_of(document: Document) -> tuple[Controller, Taps]:
    """Controller and shaper built only from a document's numbers."""
    number = {name: np.array(entry.value) for name, entry in document.numbers.items()}
    is_system = "state_matrix" in number
    controller = Controller(
        feedback=_system_of(number) if is_system else _channels_of(number),
        feedthrough=number["feedthrough"],
        voltage_limit=number["voltage_limit"],
        adc_gain=number["conditioner_gain"],
        adc_bias=number["conditioner_bias"],
        adc_step=number["adc_step"],
        adc_top=number["adc_top"],
        adc_noise=np.zeros(()),
    )
    return controller, Taps(number["shaper_weight"], number["shaper_delay"].astype(int))


def _system_of(number: dict[str, np.ndarray]) -> StateSpace:
    return StateSpace(
        state=number["state_matrix"],
        enter=number["input_matrix"],
        leave=number["output_matrix"],
        direct=number["direct"],
        anti_windup=number.get("anti_windup"),
    )


def _channels_of(number: dict[str, np.ndarray]) -> Channels:
    velocity, position = (
        tuple(np.moveaxis(number[f"{name}_numerator"], 2, 0)) for name in ("velocity", "position")
    )
    return Channels(
        filter=number["modal_filter"],
        synthesizer=number["synthesizer"],
        estimator=Estimator(
            first=(number["high_pass_b0"], number["high_pass_b1"], number["high_pass_a1"]),
            denominator=(number["low_pass_a1"], number["low_pass_a2"]),
            velocity=velocity,
            position=position,
            direct=number["position_direct"],
        ),
        velocity_gain=number["velocity_gain"],
        position_gain=number["position_gain"],
        rival_omega=number.get("rival_frequency"),
    )


def schema() -> dict[str, Any]:
    """JSON schema (2020-12) of a document."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Document.model_json_schema(),
    }


def to_json(part: Document) -> str:
    """A document as text; numbers keep all their digits."""
    return json.dumps(part.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n"


def read_document(path: Path) -> Document:
    """Read what `to_json` wrote.

    Raises:
        StudyError: unreadable, or not such a document; names the first wrong entry.
    """
    try:
        data = read_json(path)
    except OSError as error:
        raise StudyError(f"{path}: cannot be read ({error.strerror})") from None
    except ValueError as error:
        raise StudyError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(data, dict) or data.get("format") != FORMAT:
        raise StudyError(
            f"{path}: not a controller; allowed: a file of studies export --target json"
        )
    try:
        return Document.model_validate(data)
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(entry) for entry in first["loc"])
        raise StudyError(f"{path}: {where} = {shown(first['input'])}: {first['msg']}") from None


def import_study(path: str | Path) -> Study:
    """The study of a document, after checking that it reproduces the document's numbers.

    Raises:
        StudyError: unreadable, not a document, changed by hand.
    """
    path = Path(path)
    imported = read_document(path)
    try:
        study = parse_study(imported.study)
    except StudyError as error:
        raise StudyError(f"{path}: study: {error}") from None
    if study_hash(study) != imported.study_hash:
        raise StudyError(
            f"{path}: study was changed after the export; allowed: the study as exported (change a "
            "study file and export it again)"
        )
    expected = document(fixed_controller(study), imported.case_id)
    for field in ("title", "law", "estimator", "masks"):
        text, allowed = getattr(imported, field), getattr(expected, field)
        if text != allowed:
            raise StudyError(
                f"{path}: {field} = {shown(text)}; allowed: {shown(allowed)}, {_AS_STUDY}"
            )
    for name in sorted(set(expected.numbers) | set(imported.numbers)):
        if name not in imported.numbers or name not in expected.numbers:
            fault = "missing" if name in expected.numbers else "unknown"
            raise StudyError(f"{path}: numbers.{name}: {fault}")
        _check_equal(path, name, imported.numbers[name], expected.numbers[name])
    return study


_AS_STUDY = "which its study gives; change the study and export it again"


def _check_equal(path: Path, name: str, imported: Quantity, expected: Quantity) -> None:
    """Reject numbers that the study does not reproduce."""
    for label in ("unit", "axes"):
        text, allowed = getattr(imported, label), getattr(expected, label)
        if text != allowed:
            raise StudyError(
                f"{path}: numbers.{name}.{label} = {shown(text)}; allowed: {shown(allowed)}"
            )
    try:
        values, own = np.array(imported.value, float), np.array(expected.value, float)
    except ValueError:  # lists of unequal length
        raise StudyError(f"{path}: numbers.{name}: not a table of numbers") from None
    if values.shape != own.shape:
        raise StudyError(
            f"{path}: numbers.{name} has shape {values.shape}; allowed: {own.shape}, as its study"
        )
    size = np.abs(own).max(initial=0.0)
    # a non-finite number also differs
    wrong = ~(np.abs(values - own) <= ROUNDING * np.abs(own) + CANCELLED * size)
    if np.any(wrong):
        at = tuple(int(k) for k in np.argwhere(wrong)[0])
        raise StudyError(
            f"{path}: numbers.{name}{list(at) if at else ''} = {values[at]:.9g}; allowed: "
            f"{own[at]:.9g} [{expected.unit}], {_AS_STUDY}"
        )
