"""Study files: what is refused and in which words, and that a study survives being written."""

import tomllib

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from studies import Study, StudyError
from studies.reading import read_json
from studies.study.explain import allowed_values
from studies.study.spec import load_study, paper_study, parse_study
from studies.study.template import STARTERS, starter_template, study_template, toml_value
from studies.verify.prepared import prepared
from tests.canonical import MACHINE, study_of

REFUSED = [
    # unknown or misspelt
    ('tilte = "x"', "tilte = 'x': unknown field; did you mean 'title'?"),
    ("[contol]\nmodes = 2", "contol = {'modes': 2}: unknown field; did you mean 'control'?"),
    ("[control]\ngain_facter = 1", "gain_facter = 1: unknown field; did you mean 'control.gain_fa"),
    ("gain_factor = 1", "gain_factor = 1: unknown field; did you mean 'control.gain_factor'?"),
    ("[control]\nsample_rate = 1", "unknown field; did you mean 'electronics.sample_rate_hz'?"),
    ("sample_rate = 1", "unknown field; did you mean 'electronics.sample_rate_hz'?"),
    ("[link]\nplatform_mas = 1", "unknown field; did you mean 'machine.platform_mass'?"),
    (
        "[drive]\nzzzz = 1",
        "drive.zzzz = 1: unknown field; allowed: in [drive]: kind, kinds, kp, kd, force",
    ),
    ('"" = 1', " = 1: unknown field; allowed: at the top: title, run, machine"),
    (
        '[control]\nlaw = "imcs"',
        "or 'state_space', or one of your own with studies --with FILE.py; did you mean 'imsc'?",
    ),
    ('[shaper]\nkind = "EI"', "'ei2' or 'ei3'; did you mean 'ei'?"),
    # wrong type
    (
        '[run]\nduration = "0.8"',
        "run.duration = '0.8'; allowed: a finite number > 0 and <= 100 [s]",
    ),
    ("[drive]\nkd = true", "drive.kd = true; allowed: a finite number >= 0 and <= 100000 [N s/m]"),
    ("[control]\nmodes = 2.5", "control.modes = 2.5; allowed: a whole number >= 1 and <= 12 [1]"),
    ("[control]\nmodes = true", "control.modes = true; allowed: a whole number"),
    ("[run]\nsmooth = 1", "run.smooth = 1; allowed: true or false"),
    ("[run]\nduration = 1979-05-27", "run.duration = 1979-05-27; allowed: a finite number"),
    ("title = 3", "title = 3; allowed: text of at most 200 characters"),
    ("link = 3", "link = 3; allowed: a section with fields basis, modes, shortening"),
    ("[[run]]\nduration = 1", "run = [{'duration': 1}]; allowed: a section with fields duration"),
    ("[run.duration]\nx = 1", "run.duration = {'x': 1}; allowed: a finite number"),
    (
        '[motion]\nmove_time = "a"',
        "move_time = 'a'; allowed: a finite number >= 0.0001 and <= 100,",
    ),
    ("[control]\nlinks = [1, 2, 3]", "control.links.0 = 1; allowed: true or false"),
    ("[control]\nratios = [1, 2, 3]", "control.ratios.0 = 1; allowed: a list of finite numbers"),
    # out of range
    ("[run]\nduration = -1", "run.duration = -1; allowed: a finite number > 0 and <= 100 [s]"),
    ("[run]\nduration = nan", "run.duration = nan; allowed: a finite number"),
    ("[run]\nduration = inf", "run.duration = inf; allowed: a finite number"),
    (f"[run]\nduration = 1{'0' * 400}", "0 ...; allowed: a finite number > 0"),
    ("[link]\nmodes = 17", "link.modes = 17; allowed: a whole number >= 1 and <= 16 [1]"),
    ("[link]\nmodes = 99999999999999999999", "link.modes = 99999999999999999999; allowed: a whole"),
    ("[control]\nmodes = 0", "control.modes = 0; allowed: a whole number >= 1 and <= 12 [1]"),
    ("[motion]\nmove_time = 0", "motion.move_time = 0; allowed: a finite number >= 0.0001"),
    ("[motion]\nmove_time = nan", "motion.move_time = nan; allowed"),
    ("[control]\nvelocity_gain = [1e300, 1, 1]", "control.velocity_gain.0 = 1e+300; allowed"),
    (
        "[shaper]\nfrequencies_hz = [0]",
        "shaper.frequencies_hz.0 = 0; allowed: a finite number >= 0",
    ),
    ("[motion]\nwaypoints = [[0, 0, 1e300]]", "motion.waypoints.0.2 = 1e+300; allowed: a finite"),
    ("[patches]\nd31 = 0.0", "patches.d31 = 0.0; allowed: 4.85e-16 to 4.85e-10 in size"),
    # lists of the wrong length or nesting
    (
        "[motion]\nwaypoints = []",
        "motion.waypoints = []; allowed: 1 to 100 lists, each of 3 finite",
    ),
    (
        "[motion]\nwaypoints = [[0, 0]]",
        "motion.waypoints.0 = [0, 0]; allowed: 3 finite numbers, ea",
    ),
    (
        "[motion]\nwaypoints = [[0, 0, 0, 0]]",
        "waypoints.0 = [0, 0, 0, 0]; allowed: 3 finite number",
    ),
    ("[motion]\nmove_time = []", "motion.move_time = []; allowed: one number, or 4 of them"),
    ("[motion]\ndwell = [1, 2]", "motion.dwell = [1.0, 2.0]; allowed: one number, or 4 of them"),
    ("[control]\nlinks = [true]", "control.links = [true]; allowed: 3 values true or false"),
    (
        "[control]\nratios = [[1]]",
        "control.ratios = [[1]]; allowed: 3 lists, each of finite numbers",
    ),
    (
        "[control]\nmode_mask = [[true, true, true, true], [], []]",
        "allowed: at most 3 entries per link",
    ),
    (
        "[initial]\nmodal = [[0.001]]",
        "initial.modal = [[0.001]]; allowed: an empty list, or 3 lists",
    ),
    ("[shaper]\nfrequencies_hz = [1, 2, 3, 4]", "= [1, 2, 3, 4]; allowed: 0 to 3 finite numbers"),
    ("[electronics]\nlowpass_ratio = []", "lowpass_ratio = []; allowed: 1 or more finite numbers"),
    ("[metrics]\nstations = []", "metrics.stations = []; allowed: 1 to 20 finite numbers [1]"),
    (
        "[patches]\ncenters = []",
        "patches.centers = []; allowed: one list of centres, or one a link",
    ),
    (
        "[patches]\ncenters = [[]]",
        "patches.centers = [[]]; allowed: a list of finite numbers, or 3",
    ),
    ("[patches]\ncenters = [[[0.05]]]", "allowed: a list of finite numbers, or 3 lists, each of"),
    (
        "[patches]\ncenters = [0.05, [0.1]]",
        "allowed: a list of finite numbers, or 3 lists, each of",
    ),
    ("[patches]\ncenters = [[0.05], [0.05], [0.05, 0.1]]", "or one a link of equal length [m]"),
    # fields that do not fit each other
    (
        "[control]\nmodes = 4",
        "control.modes = 4; allowed: 1 to 3, the number of patch pairs of a l",
    ),
    (
        "[patches]\ncenters = [0.05, 0.05]",
        "allowed: centres at least 0.03 apart, so that no patche",
    ),
    ("[patches]\ncenters = [0.01, 0.05, 0.15]", "allowed: 0.015 to 0.185, so that no patch leaves"),
    (
        "[patches]\nactuator_length = 0.5",
        "patches.actuator_length = 0.5; allowed: at most link.len",
    ),
    (
        '[drive]\nlocked = true\n[link]\nbasis = "pinned_free"',
        "link.basis = 'pinned_free'; allowed: pinned_pinned or loaded, where drive.locked is true",
    ),
    (
        '[link]\nbasis = "pinned_pinned"\njoint_inertia_b = 1e-5',
        "allowed: loaded, where a joint has rotary inertia",
    ),
    (
        "[metrics]\nstations = [1.3]",
        "= 1.3; allowed: between 0 and 1, exclusive: fractions of each",
    ),
    (
        "[initial]\nload_station = 0.5\nload_deflection = [1e-5, 0.0, 0.0]",
        "initial.load_station = 0.5; allowed: between 0 and link.len",
    ),
    (
        "[electronics]\nantialias_hz = 5e3",
        "antialias_hz = 5000.0; allowed: below half the sample r",
    ),
    ("[electronics]\nsensor_highpass_hz = 6e3", "sensor_highpass_hz = 6000.0; allowed: below half"),
    ("[electronics]\namplifier_hz = 1e-320", "allowed: 0 (no limit) or 1 and more [Hz]"),
    ("[control]\nfrequencies_hz = [241.3, 92.5]", "allowed: rising from mode to mode [Hz]"),
    (
        "[control]\nfrequencies_hz = [[90.0], [114.0, 114.0], [90.0]]",
        "allowed: rising from mode to",
    ),
    ("[link]\nmodes = 2\ndamping_ratio = [0.01, 0.02, 0.03]", "at most link.modes = 2 entries"),
    (
        "[load]\npulse = [0, 5, 0]\npulse_start = 0.9",
        "load.pulse_start = 0.9; allowed: below run.dur",
    ),
    ("[shaper]\nfrequencies_hz = [6e3]", "allowed: below half the sample rate, 5000 [Hz]"),
    ("[patches]\nwidth = 0.5", "patches.width = 0.5; allowed: at most link.width = 0.01 [m]"),
    ('[run]\n"du\\nration" = 1', "'run.du\\nration' = 1: unknown field"),
    (f"{'x' * 9999} = 1", "x ... = 1: unknown field"),
    ("[run]\nduration = 100\nsubsteps = 50", "run.duration = 100.0; allowed: up to 4 at"),
]


@pytest.mark.parametrize(("text", "words"), REFUSED, ids=[text[:40] for text, _ in REFUSED])
def test_a_bad_study_is_refused_in_one_clear_line(tmp_path, text, words):
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(StudyError) as caught:
        load_study(tmp_path / "bad.toml")
    message = str(caught.value)
    assert words in message
    assert "\n" not in message and len(message) < 420


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"[run", "not valid TOML"),
        (b"[run]\nseed = 1\nseed = 2", "not valid TOML"),
        (b"a = " + b"[" * 5000, "not valid TOML"),
        (b"[run]\nseed = " + b"9" * 5000, "not valid TOML"),
        (b"\x89HDF\r\n\xff\x00", "not UTF-8 text"),
        (b"title = '\x00'", "not valid TOML"),
    ],
    ids=["open", "twice", "deep", "digits", "binary", "NUL"],
)
def test_what_is_no_toml_names_the_file(tmp_path, content, words):
    (tmp_path / "bad.toml").write_bytes(content)
    with pytest.raises(StudyError, match=rf"study file .*bad\.toml: .*{words}"):
        load_study(tmp_path / "bad.toml")


def test_missing_file_and_folder_are_refused(tmp_path):
    with pytest.raises(StudyError, match=r"none\.toml: cannot be read \(No such file"):
        load_study(tmp_path / "none.toml")
    with pytest.raises(StudyError, match=r"cannot be read \(a folder"):
        load_study(tmp_path)


def test_change_takes_numpy_and_refuses_unknown_names():
    study = Study().change(
        control__gain_factor=np.float64(0.25),
        run__seed=np.int64(3),
        patches__centers=np.tile([0.04, 0.1, 0.16], (3, 1)),
    )
    assert (study.control.gain_factor, study.run.seed) == (0.25, 3)
    assert study.patches.centers == ((0.04, 0.1, 0.16),) * 3
    assert Study().control.gain_factor == 1.0
    with pytest.raises(StudyError, match="contrl.*did you mean 'control'"):
        study.change(contrl__gain_factor=1.0)
    with pytest.raises(StudyError, match="title is not a section"):
        study.change(title__x=1.0)


def test_an_empty_file_and_the_template_are_the_default_study():
    assert parse_study({}) == Study()
    assert parse_study(tomllib.loads(study_template())) == Study()
    assert parse_study(tomllib.loads(starter_template())) == Study()


def test_equal_studies_have_equal_hashes():
    """Tables of laws' own fields, too, in any order; 0.0 and -0.0 are equal."""
    laws = {"ppf": {"filter_damping": 0.2}, "lqg": {"model_damping": 0.02}}
    own = parse_study({"control": {"laws": laws}, "load": {"wrench": [0.0, 0.0, 0.0]}})
    laws = dict(reversed(laws.items()))
    assert {own: 1}[parse_study({"control": {"laws": laws}, "load": {"wrench": [-0.0] * 3}})] == 1
    assert hash(own.control) != hash(Study().control) and len({own, Study(), Study()}) == 2


def test_a_byte_order_mark_is_no_text(tmp_path):
    """Windows' editor puts one in front."""
    text = '\ufefftitle = "µ"\n'
    (tmp_path / "study.toml").write_text(text, encoding="utf-8")
    assert load_study(tmp_path / "study.toml").title == "µ"
    (tmp_path / "a.json").write_text('\ufeff{"a": 1}', encoding="utf-8")
    assert read_json(tmp_path / "a.json") == {"a": 1}


def test_the_file_to_start_from_has_few_fields_each_with_its_unit():
    text = starter_template()
    data, lines = tomllib.loads(text), text.splitlines()
    sections = {k: v for k, v in data.items() if k != "title"}
    assert ["title", *(f"{k}.{x}" for k, v in sections.items() for x in v)] == list(STARTERS)
    assert data["electronics"].keys() == {"sample_rate_hz", "voltage_limit"}
    assert 20 <= sum(bool(line) for line in lines) <= 35
    for name in STARTERS:
        k, line = next(
            (k, x) for k, x in enumerate(lines) if x.startswith(f"{name.split('.')[-1]} =")
        )
        note = line.partition("  # ")[2] or lines[k - 1].removeprefix("# ")
        assert note.endswith("]") or name in ("title", "shaper.kind"), line
    assert "--all" in lines[-1]


def test_the_template_explains_every_field():
    lines = study_template().splitlines()
    fields = [k for k, line in enumerate(lines) if " = " in line and line[0] not in "#["]
    names = [lines[k].split(" = ")[0] for k in fields]
    expected = ["title"]
    for _, section in list(Study())[1:]:
        expected += type(section).model_fields
    assert names == expected
    assert all(lines[k - 1].startswith("# ") and "; " in lines[k - 1] for k in fields)


def test_the_paper_study_is_the_paper_square():
    study = paper_study()
    assert study.link.modes == 8 and study.control.modes == 3
    assert study.link == Study().link and study.control == Study().control
    # no more than half of the paper's, which leave no margin with patches as they are
    assert np.all(2 * np.array(study.control.velocity_gain) < [3.1, 3.5, 3.4])
    np.testing.assert_allclose(
        np.array(study.motion.waypoints)[:, :2] * 1e3, [[0, 0], [0, 10], [10, 10], [10, 0], [0, 0]]
    )


def test_allowed_values_in_words():
    assert allowed_values(tuple[float, ...]) == "a list of finite numbers"
    assert allowed_values(tuple[bool, bool, bool]) == "3 values true or false"
    both = allowed_values(float | tuple[float, ...])
    assert both == "a finite number, or a list of finite numbers"


@given(
    st.one_of(
        st.text(st.characters(codec="utf-8"), max_size=30),
        st.floats(allow_nan=False, allow_infinity=False),
        st.integers(-(10**18), 10**18),
        st.lists(st.lists(st.booleans(), max_size=3), max_size=3),
    )
)
@settings(max_examples=100, deadline=None)
def test_toml_values_read_back(value):
    back = tomllib.loads(f"x = {toml_value(value)}")["x"]
    assert back == value and type(back) is type(value)


def _numbers(low, high):
    return st.floats(low, high, allow_subnormal=False)


STUDIES = st.fixed_dictionaries(
    {
        "title": st.text(st.characters(codec="utf-8", min_codepoint=1), max_size=20),
        "run__duration": _numbers(0.1, 100),
        "run__smooth": st.booleans(),
        "link__basis": st.sampled_from(["pinned_pinned", "pinned_free", "loaded"]),
        "link__modes": st.integers(1, 16),
        "link__damping_ratio": _numbers(0, 0.5),
        "motion__waypoints": st.lists(
            st.tuples(_numbers(-1, 1), _numbers(-1, 1), _numbers(-4, 4)), min_size=1, max_size=5
        ),
        "motion__move_time": _numbers(0.001, 10),
        "control__links": st.tuples(st.booleans(), st.booleans(), st.booleans()),
        "control__velocity_gain": st.tuples(*[_numbers(-1e9, 1e9)] * 3),
        "control__ratios": st.lists(st.lists(_numbers(-1, 1), max_size=4), min_size=3, max_size=3),
        "shaper__frequencies_hz": st.lists(_numbers(0.1, 4999), max_size=3),
        "metrics__stations": st.lists(_numbers(0.001, 0.999), min_size=1, max_size=4),
        "run__seed": st.integers(0, 10**9),
    }
)


@given(STUDIES)
@settings(max_examples=40, deadline=None)
def test_a_study_survives_being_written(fields):
    study = Study().change(**fields)
    assert parse_study(tomllib.loads(study_template(study))) == study


@pytest.mark.parametrize("data", [None, [], 1, "x", {"sweep": {}}])
def test_what_is_no_study_is_refused(data):
    with pytest.raises(StudyError):
        parse_study(data)


def test_damping_by_mode_and_link_reaches_the_plant():
    measured = [[0.02, 0.01], [0.03], [0.01, 0.02]]
    study = study_of(MACHINE, link__damping_ratio=measured, link__damping_law="stiffness")
    plant = prepared(study)[2].loop.plant
    zeta = plant.damping / (2 * np.sqrt(plant.stiffness * plant.modal_mass[:, None]))
    np.testing.assert_allclose(zeta[0, :3], [0.02, 0.01, 0.01 * 9 / 4], rtol=1e-9)
    np.testing.assert_allclose(zeta[1, :3], [0.03, 0.12, 0.27], rtol=1e-9)
    assert study.link.first_damping == 0.02
    for bad, words in ((((0.01,), (0.02,)), "3 lists"), ((), "at least one number")):
        with pytest.raises(StudyError, match=f"link.damping_ratio.*{words}"):
            paper_study().change(link__damping_ratio=bad)
