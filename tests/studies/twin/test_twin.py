"""The twin in Exudyn: its machine, its loop, and the command without the extra."""

from __future__ import annotations

import json
import sys
from functools import partial
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
import scipy.integrate

from jaxmodel.beam import BASES, by_link
from jaxmodel.piezo import actuator_constant, sensor_constant
from jaxmodel.static import static_bending
from jaxmodel.stretch import find_stretch
from studies.documents import schema
from studies.engine.preflight import check_run
from studies.engine.stability import loop_report
from studies.errors import StudyError
from studies.fitting.realisation import ringing_poles
from studies.reference.tables import BARE, frequencies
from studies.results.document import json_text
from studies.study.cases import as_arrays, build_case, build_structure
from studies.study.spec import Study
from studies.twin import compare, margin, plan, say
from studies.twin import run as twin_run
from studies.twin.chain import close_chain
from studies.twin.electronics import SensorFilter
from studies.twin.loop import _Stepper
from studies.twin.machine import describe_machine
from studies.twin.mesh import damping_matrix, held_modes, mesh_link
from studies.twin.multibody import Settings, build_model
from studies.twin.plan import SignalPath
from studies.twin.reading import Reader
from studies.twin.verb import twin
from tests.jobs import quiet_job
from tests.studies.test_cli import refused, run

HOME = np.array([0.0, 0.0, np.pi / 6])
#: Links that lengthen, no two alike.
LENGTHENING = {
    "link__stretch": True,
    "link__stretch_damping": 0.02,
    "link__length": (0.2, 0.21, 0.19),
    "link__thickness": (2e-3, 2.2e-3, 1.8e-3),
    "patches__thickness": (1e-4, 2e-4, 3e-4),
    "patches__centers": ((0.05, 0.10, 0.15), (0.055, 0.105, 0.15), (0.045, 0.095, 0.145)),
}


def needs_exudyn() -> None:
    pytest.importorskip("exudyn", reason="Exudyn is not installed: pip install '.[twin]'")


def machine_of(**fields):
    return describe_machine(*check_run(Study().change(**BARE | fields)))


def test_mesh_has_nodes_at_patch_ends_and_modes_of_a_pinned_beam():
    link = machine_of(patches__centers=(0.047, 0.101, 0.16)).links[0]
    mesh = mesh_link(link, 40)
    np.testing.assert_allclose(mesh.x[mesh.sensor_nodes], link.sensor_ends, atol=1e-12)
    np.testing.assert_allclose(mesh.x[mesh.actuator_nodes], link.actuator_ends, atol=1e-12)
    assert mesh.x[mesh.middle] == pytest.approx(0.1)
    omega, _ = held_modes(mesh, (0.0, 0.0))
    exact = (np.arange(1, 6) * np.pi / 0.2) ** 2 * np.sqrt(70e9 * 0.01 * 0.002**3 / 12 / 0.055)
    np.testing.assert_allclose(omega[:5], exact, rtol=2e-5)


@pytest.mark.parametrize(
    "fields",
    [
        {"link__basis": "pinned_pinned"},
        {"link__basis": "loaded"},
        {"link__basis": "loaded", "patches__actuators": "both faces"},
        {"link__basis": "loaded", "patches__sensor": "strain_gauge"},
        {"link__basis": "loaded", "link__stretch": False},
    ],
)
def test_patches_by_other_arithmetic_are_those_of_the_model(fields):
    structure, case = check_run(Study().change(**LENGTHENING | fields))
    machine = describe_machine(structure, case)
    expected = _model_patches(structure, case)
    rows = [_twin_patches(link) for link in machine.links]
    if not structure.has_stretch:
        assert all(link.push == link.membrane == link.retardation == 0 for link in machine.links)
        rows, expected = [x[:3] for x in rows], expected[:3]
    for found, wanted in zip(zip(*rows, strict=True), expected, strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-12, atol=1e-14 * np.abs(wanted).max())


@partial(jax.jit, static_argnums=0)
def _model_patches(structure, case):
    """Constants of patches, slopes per voltage, stiffness in tension and what `Stretch` says."""
    beam, patches, damping = case.machine.beam, case.machine.patches, case.machine.damping
    has_patches = BASES[structure.basis].has_patches
    lambda_s, lambda_a = (
        jnp.broadcast_to(constant(beam, patches), 3)
        for constant in (sensor_constant, actuator_constant)
    )
    links = by_link(beam, patches, jnp.zeros((1,)))[:2]
    slope, _ = jax.vmap(lambda b, p: static_bending(b, p, jnp.zeros(1), has_patches))(*links)
    own = find_stretch(beam, patches, damping, has_patches)
    return (
        lambda_s,
        lambda_a,
        slope * lambda_a[:, None, None],
        own.stiffness,
        own.damping,
        own.free,
        own.volts * own.strain,
        own.volts[:, :, None] * own.local,
    )


def _twin_patches(link):
    """The same of the twin's drawing."""
    sections = link.sections
    left = np.append(0.0, sections.right[:-1])
    size, middle = sections.right - left, (sections.right + left) / 2
    seen, driven = (
        (x[:, :1] < middle) & (middle < x[:, 1:]) for x in (link.sensor_ends, link.actuator_ends)
    )
    stiffness = 1 / np.sum(size / sections.axial)
    return (
        link.sensor_constant,
        link.actuator_constant,
        seen * size / sections.bending @ sections.moment.T,
        stiffness,
        link.retardation * stiffness,
        link.push * driven @ (size / sections.axial),
        -link.membrane * seen @ (size / sections.axial),
        -link.membrane * link.push * (seen * size / sections.axial) @ driven.T,
    )


def test_a_sensor_reads_bending_less_what_it_lengthens_and_actuators_push_their_ends_apart():
    """Of a straight link that lies askew, lengthened by 1 per mille, or bent to an arc."""
    machine = machine_of(**LENGTHENING, link__basis="loaded")
    machine = machine._replace(links=machine.links[:1])
    (link,), mesh = machine.links, mesh_link(machine.links[0], 20)
    along = np.array([0.6, 0.8])
    pushed = {}
    model = SimpleNamespace(
        meshes=(mesh,),
        link_start=(0,),
        patch_loads=({node: (2 * node, 2 * node + 1) for node in range(len(mesh.x))},),
        system=SimpleNamespace(SetLoadParameter=lambda load, _, size: pushed.update({load: size})),
    )

    def reader(place, slope):
        model.reference = np.concatenate([place, slope], axis=1).ravel()
        return Reader(model, machine)

    slope = np.broadcast_to(along, (len(mesh.x), 2))
    lengthened = reader(1.001 * mesh.x[:, None] * along, slope)
    size = np.diff(link.sensor_ends)[:, 0]
    np.testing.assert_allclose(lengthened.voltages()[0], -link.membrane * 1e-3 * size, rtol=1e-9)
    turn = 1e-3 * mesh.x
    arc = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    bent = reader(np.stack([np.sin(turn), 1 - np.cos(turn)], axis=1) / 1e-3, arc)
    np.testing.assert_allclose(bent.voltages()[0], link.sensor_constant * 1e-3 * size, rtol=1e-5)

    volts = np.array([[1.0, -2.0, 3.0]])
    lengthened.put_voltages(volts)
    force = np.array([pushed[2 * node] for node in range(len(mesh.x))])
    moment = np.array([pushed[2 * node + 1] for node in range(len(mesh.x))])
    middle = (mesh.x[1:] + mesh.x[:-1]) / 2
    covers = (link.actuator_ends[:, :1] < middle) & (middle < link.actuator_ends[:, 1:])
    tension = -np.cumsum(force[:-1, :2] @ along)  # that holds what is left of a cut
    np.testing.assert_allclose(tension, link.push * volts[0] @ covers, atol=1e-12)
    assert np.abs(force[:, :2] @ [-0.8, 0.6]).max() < 1e-12 * np.abs(force).max()
    piece = np.searchsorted(link.sections.right, middle)
    inside = volts[0] @ link.sections.moment[:, piece]
    np.testing.assert_allclose(-np.cumsum(moment[:-1, 2]), inside, atol=1e-14)


def test_damping_holds_the_ratios_and_leaves_rigid_motion_alone():
    link = machine_of(link__damping_ratio=(0.01, 0.02, 0.005)).links[0]
    mesh = mesh_link(link, 20)
    matrix = damping_matrix(mesh, link)
    omega, shapes = held_modes(mesh, (0.0, 0.0))
    modal = shapes.T @ matrix @ shapes
    np.testing.assert_allclose(
        np.diag(modal)[:4] / (2 * omega[:4]), [0.01, 0.02, 0.005, 0.005], rtol=1e-9
    )
    line = np.stack([0.3 + 2.0 * mesh.x, np.full_like(mesh.x, 2.0)], axis=1).ravel()
    assert np.abs(matrix @ line).max() < 1e-12 * np.abs(matrix).max()


def test_free_machine_has_the_frequencies_of_another_finite_element_model():
    needs_exudyn()
    machine = machine_of()
    rho = close_chain(machine, HOME)[0]
    model = build_model(
        machine,
        HOME,
        lambda i, t, position, rate: 2e4 * (rho[i] - position),
        Settings(n_elements=40, axial_factor=100.0),
    )
    expected = frequencies("sliders_on_springs_2e4_N_per_m")
    square, _ = model.system.ComputeODE2Eigenvalues(computeComplexEigenvalues=False)
    frequency = np.sqrt(np.sort(np.abs(square))[: len(expected)]) / (2 * np.pi)
    np.testing.assert_allclose(frequency, expected, rtol=1e-5)


SHORT = {
    "run__duration": 0.1,
    "motion__waypoints": ((0.0, 0.0, HOME[2]), (0.0, 0.01, HOME[2])),
    "metrics__residual_delay": 0.0,
    "metrics__residual_length": 0.04,
}
#: The links of our model do not stretch; steps of 25 us.
STIFF = Settings(axial_factor=1000.0, n_steps=4)
#: All that the twin supports beyond the default study.
EVERYTHING = {
    "link__basis": "loaded",
    "control__basis": "loaded",
    "link__length": (0.2, 0.21, 0.19),
    "link__joint_inertia_c": 2e-6,
    "link__damping_ratio": (0.01, 0.02),
    "patches__centers": ((0.05, 0.1, 0.15), (0.055, 0.105, 0.15), (0.045, 0.095, 0.145)),
    "shaper__kind": "zv",
    "motion__move_time": 0.04,
    "control__gain_factor": 0.3,
    "electronics__amplifier_hz": 5000.0,
    "electronics__sensor_highpass_hz": 2.0,
    "electronics__adc_noise": 1e-4,
    "drive__kind": "computed_torque",
    "drive__coulomb_friction": 0.5,
    "drive__friction_speed": 0.01,
    "drive__viscous_friction": 3.0,
    "drive__ripple": 0.5,
    "drive__pulse_force": (5.0, 0.0, -3.0),
    "drive__pulse_start": 0.0505,
    "load__mass": 0.1,
    "load__inertia": 5e-5,
    "load__offset": (0.01, -0.02),
    "load__wrench": (2.0, -1.0, 0.02),
    "load__pulse": (0.0, 10.0, 0.0),
    "load__pulse_start": 0.0552,
}


def differences(study, settings, machine=None):
    """Of mid-span without and with control, and of voltages, all links together [1]."""
    bench, ours = compare.TwinBench(study, settings), compare.our_runs(study)
    bench.machine = bench.machine if machine is None else machine
    pairs = [compare.pair(run, bench.run(k == 0)) for k, run in enumerate(ours)]
    window = compare.in_window(bench.plan)
    found = compare.cause("", pairs[1], pairs[0], window)
    return np.array([found.free, found.controlled, found.voltage])


def test_a_move_is_the_same_in_both_models_and_a_wrong_machine_is_noticed():
    needs_exudyn()
    study = Study().change(**BARE | SHORT)
    found = differences(study, STIFF)
    assert np.all(found < [2e-3, 1e-3, 4e-3]), found
    machine = compare.TwinBench(study, STIFF).machine
    softer = tuple(
        link._replace(sections=link.sections._replace(bending=0.99 * link.sections.bending))
        for link in machine.links
    )
    wrong = differences(study, STIFF, machine._replace(links=softer))
    assert np.all(wrong > [1e-2, 4e-3, 4e-3]), wrong


def test_everything_a_study_can_have_is_in_the_twin():
    needs_exudyn()
    found = differences(Study().change(**BARE | SHORT | EVERYTHING), STIFF)
    assert np.all(found < 1e-2), found


@pytest.mark.parametrize("highpass", [0.0, 300.0])
def test_filters_are_stepped_exactly_where_signals_are_straight(highpass):
    corner, step = 2 * np.pi * 2000.0, 2.5e-5
    path = SignalPath(
        period=1e-4,
        antialias=corner,
        highpass=highpass,
        lag=0.0,
        adc_gain=1.0,
        adc_bias=0.0,
        adc_step=1.0,
        adc_top=1.0,
        adc_noise=0.0,
    )
    grid = step * np.arange(41)
    signal = np.interp(grid, [0.0, 5e-4, 1e-3], [1.0, 3.0, -2.0])

    def rates(t, x):
        u = np.interp(t, [0.0, 5e-4, 1e-3], [1.0, 3.0, -2.0])
        s, z, rate = x
        pull = corner**2 * (u - s - z) - np.sqrt(2.0) * corner * rate
        return [highpass * (u - s), rate, pull]

    start = [1.0, 0.0, 0.0] if highpass else [0.0, 1.0, 0.0]
    exact = scipy.integrate.solve_ivp(
        rates, (0, 1e-3), start, t_eval=grid, rtol=1e-10, atol=1e-12, max_step=step / 4
    )
    own = SensorFilter(path, step, (1,))
    own.settle(signal[:1])
    found = [own.present[0], *(own.advance(signal[k : k + 1])[0] for k in range(1, 41))]
    np.testing.assert_allclose(found, exact.y[1], atol=1e-7)


def test_ringing_tells_close_poles_apart():
    poles = 2 * np.pi * np.array([-1.0 + 114j, -1.5 + 115j, -30 + 135j, 2.0 + 1199j])
    shapes = np.random.default_rng(0).normal(size=(4, 9))
    time = 1e-4 * np.arange(1200)
    signals = (np.exp(np.outer(time, poles)) @ shapes).real
    found = np.log(ringing_poles(signals, 300, 1e-8)) * 1e4
    found = found[found.imag > 0]
    np.testing.assert_allclose(np.sort_complex(found[:4]), np.sort_complex(poles), rtol=1e-5)
    assert found[0] == pytest.approx(poles[3], rel=1e-6)  # what grows is left at the end


def test_without_exudyn_one_sentence_says_what_to_install(capsys, monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "exudyn", None)
    message = refused(capsys, "twin", "paper", "--out", tmp_path / "out")
    assert (
        message.strip()
        == "studies: studies twin: Exudyn is missing: install flexlink-studies[twin]"
    )
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"run__model": "ked"}, "run.model"),
        ({"run__smooth": True}, "run.smooth"),
        ({"link__basis": "pinned_free", "link__shortening": False}, "link.basis"),
        ({"initial__modal": ((1e-6,), (), ())}, "initial.modal"),
        ({"initial__load_deflection": (1e-6, 0.0, 0.0)}, "initial.load_deflection"),
        ({"patches__hysteresis": 0.1}, "patches.hysteresis"),
    ],
)
def test_what_the_twin_cannot_repeat_is_refused(fields, named):
    with pytest.raises(StudyError, match=f"{named} = .*allowed: .*studies twin"):
        compare.check_supported(Study().change(**fields))


def test_steps_of_the_integrator_are_as_asked_or_about_ten_microseconds(monkeypatch):
    asked = []

    def begin(structure, case):
        asked.append(structure.substeps)  # one for the reference, two of the integrator
        raise StopIteration

    monkeypatch.setattr(plan, "_begin", begin)
    structure, case = build_structure(Study()), build_case(Study())
    for settings in (Settings(), Settings(n_steps=4)):
        with pytest.raises(StopIteration):
            plan.plan_run(structure, case, settings, 0.1)
    assert asked == [5, 2]


def test_each_link_has_the_damping_ratios_of_its_own_modes():
    ratios = ((0.01, 0.02), (0.03,), (0.04, 0.05))
    study = Study().change(link__damping_ratio=ratios)
    links = describe_machine(build_structure(study), as_arrays(build_case(study))).links
    for link, wanted in zip(links, ratios, strict=True):
        assert link.damping.ratio.shape[0] == link.damping.count.size == 1
        count = int(link.damping.count[0])
        assert tuple(link.damping.ratio[0, :count]) == wanted


def test_a_run_that_ends_with_its_motion_is_refused():
    study = Study().change(
        run__duration=0.121, metrics__residual_delay=0.0, metrics__residual_length=5e-4
    )
    with pytest.raises(StudyError, match=r"run.duration = .*at least"):
        compare.TwinBench(study, STIFF)


def test_runs_are_compared_after_the_reference_trajectory():
    plan = SimpleNamespace(
        command_end=0.06, n_samples=1000, electronics=SimpleNamespace(period=1e-4)
    )
    assert compare.in_window(plan) == slice(600, 1000)


def signals(deflection, volts):
    """Four samples in which each link has its own number."""
    rows = [np.tile(x, (4, 1)) for x in (deflection, np.zeros(3))]
    return SimpleNamespace(
        deflection=rows[0], pose_error=rows[1], voltage=np.full((4, 3, 2), volts)
    )


def test_each_quantity_has_a_row_for_each_link_and_one_for_all():
    runs = compare.BothRuns(
        *(
            compare.BothModels(
                signals(size * np.array([3e-6, 4e-6, 0.0]), 5.0 * size),
                signals(size * np.array([6e-6, 8e-6, 0.0]), 4.0 * size),
            )
            for size in (1.0, 10.0)
        )
    )
    plan = SimpleNamespace(rho=np.zeros((4, 3)), pose=np.zeros(3))
    result = SimpleNamespace(plan=plan, runs=runs, window=slice(1, 4))
    rows = {name: cells for name, *cells in say.gap_rows(result)}
    bent = "mid-span deflection, "
    assert rows[f"{bent}link 2, without control"] == ["4 µm", "8 µm", "4 µm", "50 %"]
    assert rows[f"{bent}link 2, with control"] == ["40 µm", "80 µm", "40 µm", "50 %"]
    together = [f"{x / 3**0.5:.4g} µm" for x in (5.0, 10.0, 5.0)]
    assert rows[f"{bent}all together, without control"] == [*together, "50 %"]
    assert rows["voltage, link 1, with control"] == ["50 V", "40 V", "10 V", "25 %"]
    assert "voltage, link 1, without control" not in rows


@pytest.mark.parametrize(
    ("grows", "is_confirmed"),
    [
        (lambda factor: factor > 2, True),
        (lambda factor: True, False),
        (lambda factor: False, False),
    ],
)
def test_a_margin_by_growth_is_confirmed_on_both_sides(monkeypatch, grows, is_confirmed):
    """Of a made-up loop whose pole crosses at twice the gains."""

    class Search:
        runs = 2

        def __init__(self, *arguments):
            pass

        def pole(self, factor, near):
            return complex(10 * (factor - 2), 2000 * np.pi)

        def is_growing(self, factor, duration):
            return grows(factor)

    monkeypatch.setattr(margin, "_Search", Search)
    found = margin.margin_by_growth(None, None, None, 1.9)
    assert found.is_confirmed is is_confirmed
    np.testing.assert_allclose([found.margin, found.frequency], [2.0, 1000.0], rtol=1e-12)


def test_voltages_change_in_the_middle_of_the_step_at_the_sample():
    """A step ends at a sample with the mean of the commands before and after it."""
    put = []
    stepper = SimpleNamespace(
        plan=SimpleNamespace(electronics=SimpleNamespace(lag=0.0), wrench=np.zeros(3)),
        reader=SimpleNamespace(put_voltages=put.append),
        now=1.0,
        next=3.0,
    )
    for part in range(4):
        _Stepper._put_loads(stepper, 5, part)
    assert put == [2.0, 1.0]


@pytest.mark.parametrize("stretch", [False, True])
def test_each_change_has_the_differences_without_and_with_control(monkeypatch, stretch):
    """Of made-up runs: the twin's motion is 2 times ours without control, 5 times with it.

    The twin's links are stiffened in tension where the model's keep their length.
    """

    def signals(size):
        return compare.RunSignals(*(np.full((4, 3, *more), size) for more in ((), (), (1,))))

    class Bench(SimpleNamespace):
        def __init__(self, study, settings):
            plan = SimpleNamespace(
                command_end=0.0, n_samples=4, n_steps=1, electronics=SimpleNamespace(period=1.0)
            )
            super().__init__(study=study, settings=settings, plan=plan)

        def run(self, is_controlled):
            return signals(5.0 if is_controlled else 2.0)

    monkeypatch.setattr(compare, "TwinBench", Bench)
    monkeypatch.setattr(compare, "pair", compare.BothModels)
    study = Study().change(
        link__modes=compare.MOST_MODES, link__stretch=stretch, electronics__adc_noise=1e-4
    )
    ours, bench = signals(1.0), Bench(study, STIFF)
    free, controlled = (compare.BothModels(ours, bench.run(x)) for x in (False, True))
    found = compare.causes(bench, (ours, ours), compare.BothRuns(free, controlled))
    stiffened = [] if stretch else ["twin: links 1000 times stiffer in tension"]
    assert [x.text for x in found if "tension" in x.text] == stiffened
    assert len(found) == 3 + len(stiffened)
    np.testing.assert_allclose(
        [(x.free, x.controlled, x.voltage) for x in found], [[0.5, 0.8, 0.8]] * len(found)
    )


def test_the_command_writes_report_figure_and_numbers(tmp_path, capsys, monkeypatch):
    needs_exudyn()
    study, job = Study().change(**BARE | SHORT), quiet_job(tmp_path, twin_run.PHASES)
    settings = STIFF._replace(n_elements=10, n_steps=8)
    result = twin_run.compared_with_twin(study, job, settings, has_changes=False)
    document = json.loads((tmp_path / "twin.json").read_text())
    jsonschema.validate(document, schema("twin"))
    assert document == json.loads(json_text(say.twin_document(result)))
    assert document["growth"]["is_confirmed"]
    assert document["growth"]["margin"] == pytest.approx(3.70, rel=0.01)
    ours, theirs = (document[name] for name in ("damping_ratio", "twin_damping_ratio"))
    np.testing.assert_allclose(theirs, ours, rtol=0.02)
    page = (tmp_path / "report.html").read_text()
    assert "mid-span deflection, link 1, with control" in page and "data:image/png" in page

    monkeypatch.setattr(twin_run, "compared_with_twin", lambda *_: result)
    capsys.readouterr()
    assert json.loads(run(capsys, "twin", "paper", "--json")[1]) == document
    code, printed, _ = run(capsys, "twin", "paper")
    assert code == 0 and document["verdict"] in printed and "gain margin" in printed


#: A machine whose links have little in common.
THREE = {
    "control__gain_factor": 0.5,
    "link__length": (0.2, 0.21, 0.19),
    "link__thickness": (2e-3, 2.2e-3, 1.8e-3),
    "patches__centers": ((0.05, 0.10, 0.15), (0.055, 0.105, 0.15), (0.045, 0.095, 0.145)),
}


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("fields", "deflection", "voltage"),
    [
        # slower loops have signals so small that rounding of the ADC decides 0.6 % of them
        ({"motion__move_time": 0.03}, 2.5e-3, 4e-3),
        ({"motion__move_time": 0.05}, 2.5e-3, 1e-2),
        ({"motion__move_time": 0.05, **THREE}, 3e-3, 1e-2),
    ],
)
def test_the_square_is_the_same_in_both_models(fields, deflection, voltage, tmp_path):
    needs_exudyn()
    study = Study().change(**BARE, run__duration=0.5, metrics__residual_length=0.1, **fields)
    result = twin(study, tmp_path, progress=False)
    changes = {one.text: one for one in result.causes}
    found = changes["as they are"]
    assert found.controlled < deflection and found.voltage < voltage
    # most of it is that links of our model do not stretch, or the ADC's rounding
    assert changes["twin: links 1000 times stiffer in tension"].controlled < 1e-3
    assert changes["both: an ADC that hardly rounds"].voltage < 4e-3
    assert result.growth.is_confirmed
    assert result.growth.margin == pytest.approx(float(result.loop.gain_margin), rel=1e-2)


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("basis", ["pinned_pinned", "loaded"])
def test_gain_margins_of_links_that_lengthen_are_the_same_in_both_models(basis):
    needs_exudyn()
    study = Study().change(link__stretch=True, link__basis=basis)
    predicted = margin_of(study)
    bench = compare.TwinBench(study, Settings(n_steps=20))
    arguments = study, bench.machine, bench.plan, predicted, bench.settings
    found = margin.margin_by_growth(*arguments)
    assert found.is_confirmed
    assert found.margin == pytest.approx(predicted, rel=0.01)
    # what patches do along the links halves it
    assert predicted < 0.6 * margin_of(study.change(link__stretch=False))


@pytest.mark.long
def test_a_move_of_links_that_lengthen_is_the_same_and_wrong_patches_are_noticed():
    needs_exudyn()
    study = Study().change(**SHORT, link__stretch=True, run__substeps=4)
    found = differences(study, Settings())
    assert np.all(found < [2e-3, 2e-3, 5e-3]), found
    machine = compare.TwinBench(study).machine
    for fault in ({"membrane": -machine.links[0].membrane}, {"push": 0.0}):
        links = tuple(link._replace(**fault) for link in machine.links)
        wrong = differences(study, Settings(), machine._replace(links=links))
        assert np.all(wrong[1:] > 0.02), fault


def margin_of(study):
    """By the linearised loop of the model."""
    waypoint = np.asarray(study.motion.waypoints[0])
    report = loop_report(build_structure(study), build_case(study), waypoint)
    return float(report.gain_margin)
