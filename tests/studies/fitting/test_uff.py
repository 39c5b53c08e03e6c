"""UFF functions are taken for what their headers say."""

import re
import warnings

import numpy as np
import pytest

from studies.errors import DataWarning, StudyError
from tests.fits import HAMMER, RESPONSE, SPECTRUM, TRACE, spec_of

#: An acceleration over an excitation force, as a hammer test has it.
SHAKEN = HAMMER | {"file": "a.uff"}
UNITS = {8: "m", 11: "m/s", 12: "m/s2", 13: "N", 0: "NONE"}


def function(kind, values, numerator=12, denominator=13, unit=None, promised=None, even=1):
    """Text of a function of type 58 in single precision, from 20 Hz in steps of 0.5 Hz."""
    values, form = np.asarray(values), 5 if np.iscomplexobj(values) else 2
    numbers = np.column_stack([values.real, values.imag][: 1 + (form == 5)])
    if not even:
        abscissa = 20 + 0.5 * np.arange(len(values))
        abscissa[promised:] = 0.0
        numbers = np.column_stack([abscissa, numbers])
    rows = [
        "    -1\n    58\na\nb\nc\nd\ne",
        f"{kind:5d}{0:10d}{0:5d}{0:10d} {'link2':10s}{12:10d}{3:4d} {'link2':10s}{7:10d}{3:4d}",
        f"{form:10d}{promised or len(values):10d}{even:10d}{20.0:13.5e}{0.5:13.5e}{0.0:13.5e}",
    ]
    sides = [(18, "Hz"), (numerator, unit or UNITS[numerator]), (denominator, UNITS[denominator])]
    for data, label in (*sides, (0, "NONE")):
        rows.append(f"{data:10d}{0:5d}{0:5d}{0:5d} {'axis':20s} {label:20s}")
    flat = [f"{x:13.5e}" for x in numbers.ravel()]
    rows += ["".join(flat[k : k + 6]) for k in range(0, len(flat), 6)]
    return "\n".join([*rows, "    -1\n"])


COHERENCE = function(6, [0.999] * 3, 0)
RESPONSES = [1 + 2j, 3 - 1j, 0.5 + 0j]
WITH_ZERO = [*RESPONSES, 0j]


def read(folder, entry, *functions, name="value"):
    (folder / "a.uff").write_text("".join(functions))
    spec = spec_of(folder, entry | {"file": entry["file"].replace("response.csv", "a.uff")})
    return spec.entries[0].reader(spec, "fit.data[0]")(name, is_real=False)


def test_functions_of_other_types_are_skipped_and_named(tmp_path):
    with pytest.warns(DataWarning, match=r"function 2 is read; function 1 is of type 6 \(coher"):
        found = read(tmp_path, SHAKEN, COHERENCE, function(4, RESPONSES))
    assert found.tolist() == RESPONSES
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # one that is asked for
        found = read(tmp_path, SHAKEN | {"file": "a.uff::2"}, COHERENCE, function(0, RESPONSES))
    assert found.tolist() == RESPONSES
    with pytest.warns(DataWarning, match="function 2 is read"):
        spectrum = SPECTRUM | {"file": "a.uff", "output": "accelerometer 2 at 0.1"}
        assert read(tmp_path, spectrum, COHERENCE, function(9, [1.0, 2.0])).tolist() == [1, 2]


@pytest.mark.parametrize("file", ["a.uff", "a.uff::1"])
def test_a_file_without_such_a_function_is_refused(tmp_path, file):
    said = r"function 1 is of type 6 \(coherence\).*'response' takes type 4 \(frequency response\)"
    with pytest.raises(StudyError, match=said):
        read(tmp_path, SHAKEN | {"file": file}, COHERENCE)


@pytest.mark.parametrize(
    "entry, numerator, denominator, said",
    [
        (SHAKEN | {"quantity": "velocity"}, 12, 13, "quantity = 'velocity'; allowed: acceleration"),
        (SHAKEN, 8, 13, "fit.data[0].quantity = 'acceleration'; allowed: displacement [m], as the"),
        (SHAKEN, 12, 8, "fit.data[0].input = 'hammer 2 at 0.1'; allowed: displacement [m]"),
        (
            SHAKEN | {"output": "accelerometer 2 at 0.1", "quantity": "displacement"},
            11,
            13,
            "fit.data[0].output = 'accelerometer 2 at 0.1'; allowed: velocity [m/s], as the header "
            "of function 1 of a.uff says",
        ),
        (RESPONSE, 12, 0, "quantity = 'displacement'; allowed: acceleration [m/s^2]"),
        (RESPONSE, 0, 0, None),
        (SHAKEN, 12, 0, None),
    ],
)
def test_a_header_with_another_quantity_is_refused(tmp_path, entry, numerator, denominator, said):
    text = function(4, RESPONSES, numerator, denominator)
    if said is None:
        assert read(tmp_path, entry, text).tolist() == RESPONSES
        return
    with pytest.raises(StudyError, match=re.escape(said)):
        read(tmp_path, entry, text)


def test_a_header_with_another_unit_is_named(tmp_path):
    with pytest.warns(DataWarning, match=r"gives the unit 'mm/s\^2'; taken for m/s\^2"):
        read(tmp_path, SHAKEN, function(4, RESPONSES, unit="mm/s^2"))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read(tmp_path, SHAKEN, function(4, RESPONSES, unit="m/s^2"))
        trace = TRACE | {"file": "a.uff", "output": "slider 1"}
        read(tmp_path, trace, function(1, [1.0, 2.0], 8, 0))


@pytest.mark.parametrize("even", [0, 1])
def test_a_last_line_may_be_filled_with_zeros(tmp_path, even):
    text = function(4, WITH_ZERO, promised=3, even=even)
    assert read(tmp_path, SHAKEN, text).tolist() == RESPONSES
    np.testing.assert_array_equal(read(tmp_path, SHAKEN, text, name="frequency_hz"), [20, 20.5, 21])
    for wrong in ([*RESPONSES, 1j], [*WITH_ZERO, 0j, 0j, 0j, 0j, 0j]):
        with pytest.raises(StudyError, match="promises 3 points and has"):
            read(tmp_path, SHAKEN, function(4, wrong, promised=3, even=even))
    with pytest.raises(StudyError, match="promises 4 points and has 3"):
        read(tmp_path, SHAKEN, function(4, RESPONSES, promised=4, even=even))
