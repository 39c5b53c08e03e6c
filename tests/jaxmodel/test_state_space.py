"""Controllers from files: modal form, the loop, margins, sweeps, and what is refused."""

import json
import re
import zipfile
from io import BytesIO

import jax
import numpy as np
import pytest
from scipy.io import savemat

from jaxmodel.controller import read_back
from jaxmodel.state_space import (
    IllConditionedError,
    StateSpace,
    dense,
    modal_form,
)
from studies.cli import main
from studies.engine.blocks import responses
from studies.engine.controller import arrange, fixed_controller
from studies.engine.executor import Executor
from studies.engine.margins import judge_loops
from studies.engine.plan import chunk_cases, local_layout, plan_groups
from studies.engine.preflight import preflight
from studies.engine.runs import run_study
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.export.c_fixed import fixed_source
from studies.export.c_floating import floating_source
from studies.export.document import controller_of as controller_in
from studies.export.document import document
from studies.export.fixed import check_error, rail_samples
from studies.export.fixed_blocks import design_integers
from studies.export.floating import respond as respond_floating
from studies.export.in_the_loop import replay
from studies.export.integers import respond as respond_fixed
from studies.export.run import DAC_BITS
from studies.export.verify import DOUBLE, _limits, compare_values, load_code
from studies.space.machines import ModelMismatch
from studies.space.spec import parse_sweep
from studies.space.table import build_table
from studies.spillover.certificate import certify
from studies.study.spec import load_study
from studies.study.template import study_template
from tests.bare import parse_study
from tests.canonical import MACHINE as SHORT
from tests.exports import needs_compiler
from tests.jaxmodel.kept import arrays, without_run

PERIOD = 1e-4


def random_system(order, ports, seed=0, gain=0.01):
    """A stable controller."""
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(order, order))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max(initial=1e-9)
    b, c = rng.normal(size=(order, ports)), gain * rng.normal(size=(ports, order))
    return a, b, c, gain * rng.normal(size=(ports, ports))


def study_with(path, **changes):
    """A short study with a controller from a file."""
    control = {"law": "state_space"} | changes.pop("control", {})
    section = {"file": str(path)} | changes.pop("state_space", {})
    return parse_study(SHORT | {"control": control, "state_space": section} | changes)


@pytest.fixture(scope="module")
def thirty(tmp_path_factory):
    """A controller of order 30 for 9 sensors and 9 actuators: its matrices, file and study."""
    matrices = random_system(30, 9)
    path = tmp_path_factory.mktemp("system") / "thirty.npz"
    np.savez(path, **dict(zip("ABCD", matrices, strict=True)), dt=PERIOD)
    return matrices, path, study_with(path)


def stepped(matrices, volts, limit):
    """Commands by the matrices themselves, (T, 9)."""
    a, b, c, d = matrices
    x, rows = np.zeros(len(a)), []
    for y in volts:
        rows.append(np.clip(c @ x + d @ y, -limit, limit))
        x = a @ x + b @ y
    return np.array(rows)


def controller_of(study):
    return preflight(*arrays(study)).controller


def assert_code_is_the_controller(study):
    """On random codes, in C to 1e-12, in fixed point bit for bit with its integer model."""
    exported, compiler = fixed_controller(study), needs_compiler()
    top, step = int(exported.controller.adc_top), float(exported.controller.adc_step)
    codes = np.random.default_rng(2).integers(1, top, (300, 3, 3))
    wanted = np.asarray(replay(exported.controller, codes))
    assert np.abs(wanted).max() > 1
    source = floating_source(exported, "own", ["a test"])
    with load_code(exported, source, "own", compiler, np.float64, np.float64) as code:
        volts, faults = code.respond(codes * step)
    largest, _ = _limits(exported, codes)
    check = compare_values("", volts, wanted, DOUBLE, largest)
    assert check.is_met and not faults.any(), check
    signals = respond_floating(exported.channels, exported.controller, codes)
    fixed, _ = design_integers(exported, signals, DAC_BITS)
    check_error(exported, fixed.error, fixed.wires.dac_step)
    model = respond_fixed(fixed, codes, rail_samples(1 / PERIOD))
    source = fixed_source(exported, fixed, "own", ["a test"], "")
    with load_code(exported, source, "own", compiler, np.uint16, np.int32) as code:
        found, faults = code.respond(codes)
    assert not model.limited.any() and not faults.any()
    np.testing.assert_array_equal(found, model.codes)


@pytest.mark.parametrize("order", [0, 1, 5, 12])
def test_modal_form_has_the_same_transfer_function(order):
    a, b, c, _ = random_system(order, 3, seed=order)
    form = modal_form(a, b, c)
    system = StateSpace(form.state[None], form.enter[None], form.leave[None], np.zeros((1, 3, 3)))
    a2, b2, c2, _ = dense(system)
    z = np.exp(0.7j)

    def transfer(a, b, c):
        return c @ np.linalg.solve(z * np.eye(len(a)) - a, b)

    np.testing.assert_allclose(transfer(a2, b2, c2), transfer(a, b, c), rtol=1e-11, atol=1e-15)


def test_equal_poles_that_are_coupled_have_no_modal_form():
    a = np.array([[0.5, 1.0], [0.0, 0.5]])
    with pytest.raises(IllConditionedError, match=r"poles 0\.5.* and 0\.5.* are too close"):
        modal_form(a, np.ones((2, 1)), np.ones((1, 2)))
    modal_form(0.5 * np.eye(2), np.ones((2, 1)), np.ones((1, 2)))  # equal, but not coupled


def test_impulse_responses_are_those_of_the_matrices():
    rng = np.random.default_rng(0)
    shapes = (1, 3, 2, 2), (1, 3, 2, 4), (1, 4, 3, 2), (1, 4, 4)
    system = StateSpace(*(0.4 * rng.normal(size=shape) for shape in shapes))
    a, b, c, d = dense(system)
    found = responses(system, 0, 20)
    powers = [np.linalg.matrix_power(a, k) for k in range(19)]
    wanted = np.stack([d, *(c @ p @ b for p in powers)], axis=2)
    np.testing.assert_allclose(found.command, wanted, atol=1e-13)
    kicked = np.stack([np.zeros_like(c), *(c @ p for p in powers)], axis=2)
    np.testing.assert_allclose(found.kicked.reshape(4, 6, 20), kicked, atol=1e-13)


def test_order_30_in_the_loop_is_direct_stepping(thirty):
    """Of 9 sensors and 9 actuators, ADC and limit included, to 1e-11."""
    matrices, _, study = thirty
    controller = controller_of(study)
    codes = np.random.default_rng(1).integers(0, 4096, (3000, 3, 3)).astype(float)
    found = np.asarray(replay(controller, codes)).reshape(-1, 9)
    volts = np.asarray(read_back(controller, codes)).reshape(-1, 9)
    limit = float(controller.voltage_limit)
    wanted = stepped(matrices, volts, limit)
    assert 1 < np.abs(wanted).max() <= limit
    np.testing.assert_allclose(found, wanted, atol=1e-11 * np.abs(wanted).max())


def test_links_without_control_neither_see_nor_act(thirty):
    matrices, path, _ = thirty
    study = study_with(path, control={"links": [True, False, True], "gain_factor": 0.3})
    controller = controller_of(study)
    codes = np.random.default_rng(1).integers(0, 4096, (300, 3, 3)).astype(float)
    volts = np.asarray(read_back(controller, codes))
    on = np.array([1.0, 0.0, 1.0])[:, None]
    wanted = stepped(matrices, (volts * on).reshape(-1, 9), 1e9) * 0.3
    wanted = wanted.reshape(-1, 3, 3) * on
    np.testing.assert_allclose(replay(controller, codes), wanted, atol=1e-12)


def test_gains_and_sensors_scale_the_system():
    rng = np.random.default_rng(3)
    shapes = (3, 2, 2, 2), (3, 2, 2, 3), (3, 3, 2, 2), (3, 3, 3)
    system = StateSpace(*(0.4 * rng.normal(size=shape) for shape in shapes))
    left, right = rng.normal(size=(2, 3, 3))
    a, b, c, d = dense(system)
    a2, b2, c2, d2 = dense(jax.tree.map(np.asarray, system.amplified(left).with_sensors(right)))
    rows, columns = np.diag(left.ravel()), np.diag(right.ravel())
    for found, wanted in ((a2, a), (b2, b @ columns), (c2, rows @ c), (d2, rows @ d @ columns)):
        np.testing.assert_allclose(found, wanted, atol=1e-14)


def test_one_link_s_controller_serves_each_link(tmp_path):
    """Without names, as many ports as a link has patches; the same as all links written out."""
    a, b, c, d = random_system(4, 3)
    np.savez(tmp_path / "one.npz", a=a, b=b, c=c, d=d, dt=PERIOD)
    whole = {k: np.kron(np.eye(3), x) for k, x in zip("abcd", (a, b, c, d), strict=True)}
    # poles of three equal links: no eigenvectors of their own, but no coupling either
    np.savez(tmp_path / "all.npz", **whole, dt=PERIOD)
    codes = np.random.default_rng(1).integers(0, 4096, (300, 3, 3)).astype(float)
    one, every = (
        np.asarray(replay(controller_of(study_with(tmp_path / f"{name}.npz")), codes))
        for name in ("one", "all")
    )
    np.testing.assert_allclose(one, every, atol=1e-11)


@pytest.fixture(scope="module")
def margins(thirty):
    """Structure, cases and layout of two gains in a sweep, and the run of the latter alone."""
    study = thirty[2]
    data = {k: v for k, v in study.model_dump().items() if v}
    table = build_table(parse_sweep(data | {"sweep": {"axes": {"gain": [0.3, 1.0]}}}))
    group = plan_groups(table, np.arange(2), local_layout)[0]
    structure = group.structure._replace(metrics=("residual_rms", "peak_voltage"))
    return structure, chunk_cases(table, group.rows, structure, group.layout.size), group.layout


def test_a_batch_s_margins_are_those_of_single_loops(thirty, margins):
    study = thirty[2]
    alone = loop_report(*without_run(study), np.array(study.motion.waypoints[0]))
    assert alone.is_stable and 1 < alone.gain_margin < 60
    two = jax.tree.map(lambda x: x[:2], margins[1])
    found = judge_loops(margins[0], two).gain_margin
    np.testing.assert_allclose(found, alone.gain_margin / np.array([0.3, 1.0]), rtol=1e-3)


@pytest.mark.long  # in short: all operations of a loop, in test_delay
def test_kernel_is_scan(thirty, margins):
    structure, cases, layout = margins
    one, other = (
        Executor(structure, layout, kind=name).start(cases).wait() for name in ("kernel", "scan")
    )
    np.testing.assert_array_equal(one.status, 0)
    for name in structure.metrics:
        np.testing.assert_allclose(other.metrics[name], one.metrics[name], rtol=1e-9)
    found = run_study(thirty[2], has_record=False)
    assert found.loop.is_stable and found.loop.gain_margin > 1


def test_code_of_a_system(thirty):
    assert_code_is_the_controller(thirty[2])


def test_code_of_some_links_with_feedthrough(tmp_path):
    a, b, c, d = random_system(4, 3)
    np.savez(tmp_path / "one.npz", a=a, b=b, c=c, d=d, dt=PERIOD)
    control = {"links": [False, True, True], "feedthrough_factor": 0.5}
    study = study_with(tmp_path / "one.npz", control=control)
    exported = fixed_controller(study)
    assert list(exported.channels.link) == [1, 2]
    assert_code_is_the_controller(study)
    described = document(exported, "")
    assert np.shape(described.numbers["state_matrix"].value) == (3, 2, 2, 2)
    codes = np.random.default_rng(2).integers(1, 4095, (300, 3, 3))
    again, wanted = controller_in(described), np.asarray(replay(exported.controller, codes))
    found = respond_floating(arrange(again[0], described.law), again[0], codes).command
    np.testing.assert_allclose(found, wanted, atol=DOUBLE * np.abs(wanted).max())


@pytest.mark.long  # in short: the code of each kind of system on random codes
@pytest.mark.parametrize("kind", ["links", "limits", "static"])
def test_export_is_verified(tmp_path, capsys, kind):
    fields = dict(zip("ABCD", random_system(4, 3), strict=True))
    changes = {"control": {"links": [False, True, True], "feedthrough_factor": 0.5}}
    if kind == "limits":
        fields, changes = told_of_limits(), {"electronics": {"voltage_limit": 2.0}}
    elif kind == "static":
        fields, changes = {"D": 5 * fields["D"]}, {}
    np.savez(tmp_path / "x.npz", **fields, dt=PERIOD)
    (tmp_path / "study.toml").write_text(study_template(study_with(tmp_path / "x.npz", **changes)))
    for target in ("json", "c", "c-fixed"):
        main(["export", str(tmp_path / "study.toml"), "--target", target, "--out", str(tmp_path)])
        assert "comparisons agree" in capsys.readouterr().out


def told_of_limits():
    """Matrices of a controller that is told of limits."""
    a, b, c, d = random_system(4, 9, gain=0.3)
    tell = 0.05 * np.random.default_rng(5).normal(size=(4, 9))
    assert np.abs(np.linalg.eigvals(a - tell @ c)).max() < 1
    return {"A": a, "B": b, "C": c, "D": d, "anti_windup": tell}


@pytest.mark.parametrize("end", [".npz", ".json"])
def test_limits_are_told_where_the_file_says_how(tmp_path, end):
    """x_(k+1) = A x + B y + E (v - u), in the loop and in exported code."""
    matrices = told_of_limits()
    a, b, c, d, tell = matrices.values()
    path = tmp_path / f"one{end}"
    if end == ".npz":
        np.savez(path, **matrices, dt=PERIOD)
    else:
        path.write_text(
            json.dumps({"dt": PERIOD} | {name: x.tolist() for name, x in matrices.items()})
        )
    study = study_with(path, electronics={"voltage_limit": 2.0})
    controller = controller_of(study)
    rng = np.random.default_rng(1)
    codes = rng.integers(0, 4096, (200, 3, 3)).astype(float)
    x, wanted, most = np.zeros(4), [], 0.0
    for code in codes:
        y = np.ravel(read_back(controller, code))
        u = c @ x + d @ y
        v = np.clip(u, -2, 2)
        x = a @ x + b @ y + tell @ (v - u)
        most = max(most, np.abs(u).max())
        wanted.append(v.reshape(3, 3))
    assert most > 4
    np.testing.assert_allclose(replay(controller, codes), wanted, atol=1e-10)
    if end == ".json":
        assert_code_is_the_controller(study)


def test_formats_and_names(tmp_path):
    """JSON, NPZ and MAT say the same; names say where ports are; a written study needs no file."""
    a, b, c, d = random_system(3, 2)
    ports = {"inputs": ["sensor 2.1", "sensor 1.3"], "outputs": ["actuator 3.2", "actuator 1.1"]}
    fields = {"A": a, "B": b, "C": c, "D": d, "dt": PERIOD}
    as_lists = {k: np.asarray(x).tolist() for k, x in fields.items()}
    (tmp_path / "x.json").write_text(json.dumps(as_lists | ports))
    np.savez(tmp_path / "x.npz", **fields, **ports)
    savemat(tmp_path / "x.mat", fields | {k: np.array(x, object) for k, x in ports.items()})
    found = [study_with(tmp_path / f"x.{end}").state_space for end in ("json", "npz", "mat")]
    assert found[0].a == found[1].a == found[2].a
    assert found[0].inputs == found[1].inputs == found[2].inputs == tuple(ports["inputs"])
    system = jax.tree.map(np.asarray, arrays(study_with(tmp_path / "x.mat"))[1].control.system)
    assert np.abs(dense(system)[3][7, 3]) == pytest.approx(abs(d[0, 0]))
    text = study_template(study_with(tmp_path / "x.npz"))
    (tmp_path / "x.npz").unlink()
    (tmp_path / "study.toml").write_text(text)
    assert load_study(tmp_path / "study.toml").state_space.a == found[0].a


REFUSED = {
    "unstable": ({"a": 1.2 * np.eye(4)}, {}, "an unstable controller, with a pole of modulus 1.2"),
    "wrong size": ({"b": np.ones((3, 3))}, {}, "state_space.b: 3 x 3; allowed: 4 x any"),
    "not square": ({"a": np.ones((4, 3))}, {}, "state_space.a: 4 x 3; allowed: 4 x 4"),
    "wrong d": ({"d": np.ones((3, 2))}, {}, "state_space.d: 3 x 2; allowed: 3 x 3"),
    "another time": ({"dt": 2e-4}, {}, "state_space.sample_time = 0.0002; allowed: 0.0001, that"),
    "no time": ({"dt": None}, {}, "state_space.sample_time: missing (in a file: dt,"),
    "no entry": ({"dt": []}, {}, "dt has 0 entries; expected 1 [s]"),
    "three axes": ({"a": np.zeros((4, 4, 4))}, {}, "A has 3 dimensions; expected 2"),
    "400 digits": ({"b": [[10**400] * 3] * 4}, {}, "state_space.b"),
    "large": ({"b": np.full((4, 3), 1e308)}, {}, "state_space.b: an entry of size 1e+308; allowed"),
    "ragged": ({"c": [[1.0], [1.0, 2.0]]}, {}, "expected real numbers"),
    "too many states": (
        {"a": np.zeros((501, 501)), "b": np.zeros((501, 3)), "c": np.zeros((3, 501))},
        {},
        "state_space.c: 501 states; allowed: up to 500",
    ),
    "nan": ({"c": np.full((3, 4), np.nan)}, {}, "state_space.c"),
    "text": ({"a": [["x"]]}, {}, "expected real numbers"),
    "no output": ({"c": None}, {}, "has no C; expected A, B, C, D and dt"),
    "coupled": ({"a": np.eye(4, k=1) + 0.5 * np.eye(4)}, {}, "no well-conditioned modal form"),
    "odd ports": (
        {"b": np.ones((4, 5)), "d": np.ones((3, 5))},
        {},
        "state_space.inputs: missing, and state_space.b has columns: 5",
    ),
    "no sensor": ({"inputs": ["sensor 1.1", "sensor 1.2", "sensor 4.1"]}, {}, "links 1 to 3"),
    "twice": ({"inputs": ["sensor 1.1"] * 3}, {}, "different names"),
    "no file": (None, {"file": "none.json"}, "none.json cannot be read (No such file"),
    "no format": (None, {"file": "x.csv"}, "allowed: a file .json, .npz, .mat"),
    "nothing": (None, {"file": ""}, "state_space.file: missing"),
}


@pytest.mark.parametrize("fault", REFUSED)
def test_bad_controllers_are_answered(tmp_path, fault):
    changed, section, said = REFUSED[fault]
    a, b, c, d = random_system(4, 3)
    fields = {"a": a, "b": b, "c": c, "d": d, "dt": PERIOD} | (changed or {})
    fields = {k: getattr(x, "tolist", lambda x=x: x)() for k, x in fields.items() if x is not None}
    if "inputs" in fields:
        fields["outputs"] = ["actuator 1.1", "actuator 1.2", "actuator 1.3"]
    (tmp_path / "x.json").write_text(json.dumps(fields))
    with pytest.raises(StudyError, match=re.escape(said)):
        study_with(tmp_path / "x.json", state_space=section)


def test_a_damaged_file_is_named(tmp_path):
    for name in ("x.json", "x.npz", "x.mat"):
        (tmp_path / name).write_bytes(b"\x00garbage")
        with pytest.raises(StudyError, match=f"state_space.file: .*{name} cannot be read"):
            study_with(tmp_path / name)


@pytest.mark.parametrize("end", ["npz", "mat"])
def test_complex_matrices_are_refused_unless_they_are_real(tmp_path, end):
    save = savemat if end == "mat" else lambda path, fields: np.savez(path, **fields)
    fields = dict(zip("abcd", random_system(4, 3), strict=True)) | {"dt": PERIOD}
    save(tmp_path / f"x.{end}", fields | {"d": fields["d"] * (1 + 0j)})
    assert study_with(tmp_path / f"x.{end}").state_space.d == tuple(map(tuple, fields["d"]))
    save(tmp_path / f"x.{end}", fields | {"d": fields["d"] * (1 + 1e-9j)})
    with pytest.raises(StudyError, match="D = .*expected real numbers"):
        study_with(tmp_path / f"x.{end}")


def test_mat_files_keep_single_inputs_and_outputs(tmp_path):
    a, b, c, d = random_system(3, 1)
    fields = {"A": a, "B": b, "C": c, "D": d, "Ts": PERIOD}
    savemat(tmp_path / "x.mat", fields | {"inputs": "sensor 2.1", "outputs": "actuator 2.3"})
    section = study_with(tmp_path / "x.mat").state_space
    assert np.shape(section.b) == (3, 1) and np.shape(section.c) == (1, 3)
    assert section.inputs == ("sensor 2.1",) and section.outputs == ("actuator 2.3",)


def test_a_mat_file_that_crashes_the_reader_is_damaged(tmp_path):
    """A matrix whose numbers claim to be a matrix: SciPy's reader ends by a segmentation fault."""
    a, b, c, d = random_system(3, 3)
    savemat(tmp_path / "x.mat", {"A": a, "B": b, "C": c, "D": d, "dt": PERIOD})
    content = bytearray((tmp_path / "x.mat").read_bytes())
    assert content[176] == 9  # miDOUBLE
    content[176] = 14  # miMATRIX
    (tmp_path / "x.mat").write_bytes(content)
    with pytest.raises(StudyError, match=r"state_space.file: .*x.mat cannot be read \(damaged\)"):
        study_with(tmp_path / "x.mat")


def test_packed_files_are_not_unpacked_beyond_their_limit(tmp_path):
    """By the archive's directory, by its arrays' headers."""
    with zipfile.ZipFile(tmp_path / "x.npz", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a.npy", bytes(2**26 + 1), compresslevel=1)
    with pytest.raises(StudyError, match="unpacks to more than 64 MiB"):
        study_with(tmp_path / "x.npz")
    header = BytesIO()
    fields = {"descr": "<f8", "fortran_order": False, "shape": (10**6, 10**6)}
    np.lib.format.write_array_header_1_0(header, fields)
    with zipfile.ZipFile(tmp_path / "x.npz", "w") as archive:
        archive.writestr("a.npy", header.getvalue())
    with pytest.raises(StudyError, match=r"an array of shape \(1000000, 1000000\) in 0 bytes"):
        study_with(tmp_path / "x.npz")


def test_a_static_gain_is_a_controller(tmp_path):
    """In every format, with A, B, C of order 0 or D alone; as D on the read-back voltages."""
    d = 0.1 * np.random.default_rng(0).normal(size=(3, 3))
    empty = {"A": np.zeros((0, 0)), "B": np.zeros((0, 3)), "C": np.zeros((3, 0))}
    fields = {"D": d, "dt": PERIOD}
    np.savez(tmp_path / "x.npz", **fields, **empty)
    savemat(tmp_path / "x.mat", fields | empty)
    whole = {"A": [], "B": [], "C": [[], [], []], "D": d.tolist(), "dt": PERIOD}
    (tmp_path / "x.json").write_text(json.dumps(whole))
    (tmp_path / "d.json").write_text(json.dumps({"D": d.tolist(), "dt": PERIOD}))
    names = ("x.npz", "x.mat", "x.json", "d.json")
    first, *others = (study_with(tmp_path / name).state_space for name in names)
    assert all(other.model_copy(update={"file": first.file}) == first for other in others)
    study = parse_study(study_with(tmp_path / "x.json").model_dump())  # as a study keeps it
    controller = controller_of(study)
    codes = np.random.default_rng(1).integers(0, 4096, (30, 3, 3)).astype(float)
    volts = np.asarray(read_back(controller, codes))
    np.testing.assert_allclose(replay(controller, codes), volts @ d.T, atol=1e-12)


def test_a_static_gain_has_a_margin_and_code(tmp_path):
    d = 0.05 * np.random.default_rng(0).normal(size=(3, 3))
    (tmp_path / "d.json").write_text(json.dumps({"D": d.tolist(), "dt": PERIOD}))
    study = study_with(tmp_path / "d.json")
    pose = np.array(study.motion.waypoints[0])
    margin, twice = (
        loop_report(*without_run(study_with(tmp_path / "d.json", control={"gain_factor": f})), pose)
        for f in (1.0, 2.0)
    )
    assert twice.gain_margin == pytest.approx(margin.gain_margin / 2, rel=1e-3)
    assert_code_is_the_controller(study_with(tmp_path / "d.json", control={"gain_factor": 20.0}))


def test_ideal_feedback_has_no_controller_of_this_kind(thirty):
    with pytest.raises(StudyError, match="control.feedback = 'ideal'; allowed: 'sampled' or"):
        study_with(thirty[1], control={"feedback": "ideal"})


def test_it_is_certified_with_its_delay(tmp_path):
    """On plants that differ from the study's; beside all laws."""
    a, b, c, d = random_system(2, 3, gain=0.05)
    np.savez(tmp_path / "one.npz", a=a, b=b, c=c, d=d, dt=PERIOD)
    study = study_with(tmp_path / "one.npz", electronics={"delay": 1.5})
    found = certify(study, bases=("pinned_pinned",), sizes=(6,), mismatches=(ModelMismatch(),))
    report, other = (
        loop_report(*without_run(x), np.array(study.motion.waypoints[0]), n_modes=6)
        for x in (study, study.change(electronics__delay=1.25))
    )
    assert report.gain_margin < 60
    np.testing.assert_allclose(found.gain_margin[0, 0, 0], report.gain_margin, rtol=2e-4)
    np.testing.assert_allclose(found.spectral_radius[0, 0, 0], report.spectral_radius, rtol=1e-9)
    assert abs(other.gain_margin / report.gain_margin - 1) > 0.02
