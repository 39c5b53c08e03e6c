"""The traced kernel against the scan: the same step, the same results."""

import hashlib
from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.trigonometry import sine_cosine
from studies.bench.works import METRICS, WORKS
from studies.engine.executor import CaseLeaves, Executor, executor_text
from studies.engine.function import STEPPERS, block_function
from studies.engine.plan import Layout, chunk_cases, local_layout, plan_groups
from studies.engine.programs import environment
from studies.errors import NoKernelError
from studies.kernels import compilation, cpu, llvm, native
from studies.kernels.compilation import ObjectCache
from studies.kernels.traced import InputLeaf, trace_loop
from studies.space.table import build_table
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from tests.bare import paper_study
from tests.canonical import HOME, study_of
from tests.sweeps import MIXED, small_spec

LAYOUT = Layout(devices=2, blocks=1, lanes=16)
ALL_SORTS = {
    "method": "random",
    "count": 32,
    "axes": {
        "placement": {"kind": "per_link"},
        "plant_modes": [2, 3],
        "controlled_modes": [1, 2, 3],
        "link_subsets": "all",
        "gain": {"from": 0.01, "to": 0.1},
        "shaper": ["none", "zv"],
        "initial.load_deflection[0]": [0.0, 0.0, 0.0, 0.03],
        "drive.kp": {"from": 1e4, "to": 3e4},
        "machine.platform_mass": {"from": 0.2, "to": 0.3},
        "electronics.sensor_highpass_hz": [0.0, 24.0],
        "electronics.amplifier_hz": [0.0, 500.0, 5e3],
    },
}


def both(spec):
    """Results of the same cases by kernel and by scan."""
    table = build_table(spec)
    group = plan_groups(table, np.arange(len(table)), local_layout)[0]
    cases = chunk_cases(table, np.arange(len(table)), group.structure, LAYOUT.size)
    return [
        Executor(group.structure, LAYOUT, kind=kind).start(cases).wait()
        for kind in ("kernel", "scan")
    ]


def check_equal(fast, reference):
    np.testing.assert_array_equal(fast.status, reference.status)
    for a, b in zip(jax.tree.leaves(fast), jax.tree.leaves(reference), strict=True):
        assert np.array_equal(np.isnan(a), np.isnan(b))
        size = np.nanmax(np.abs(b), initial=1e-300)
        assert np.nanmax(np.abs(a - b), initial=0.0) <= 1e-9 * size


#: Everything that the first one leaves out: another law, noise, friction, several steps a sample.
OTHER_SORTS = {
    "link": {"modes": 2, "basis": "pinned_free"},
    "control": {"law": "srf", "velocity_gain": [1e-6, 2e-6, 1e-6]},
    "electronics": {"adc_noise": 0.01, "sensor_highpass_hz": 5.0, "amplifier_hz": 2e3},
    "drive": {
        "coulomb_friction": 0.5,
        "friction_speed": 0.05,
        "kind": "computed_torque",
        "kd": 6e3,
    },
}


#: What bends moves every point inwards; direct terms pass the amplifier and the high-pass.
HEAVY = {
    "link": {"modes": 2, "axial_inertia": "distributed"},
    "electronics": {"sensor_highpass_hz": 5.0, "amplifier_hz": 2e3},
    "machine": {"joint_friction": 1e-4, "joint_friction_speed": 0.1},
    "drive": {"lag": 1e-3},
}
#: Faces of ceramics that links bend and draw.
AS_THEY_ARE = {"link": {"modes": 2, "basis": "loaded", "stretch": True}}
STIFFNESSES = {"method": "random", "count": 32, "axes": {"drive.kp": {"from": 1e4, "to": 2e4}}}


@pytest.mark.parametrize(
    ("sweep", "sections"),
    [
        # in short: every operation is translated, below, and a loop as a function, in test_batched
        pytest.param(
            ALL_SORTS,
            {"metrics": {"residual_delay": 0.0, "residual_length": 0.004}},
            marks=pytest.mark.long,
        ),
        pytest.param(STIFFNESSES, HEAVY, marks=pytest.mark.long),
        pytest.param(STIFFNESSES, AS_THEY_ARE, marks=pytest.mark.long),
        pytest.param(STIFFNESSES, OTHER_SORTS, marks=pytest.mark.long),
    ],
    ids=[
        "mixed sampled cases",
        "distributed inertia, amplifier, joints that rub, motors that lag",
        "patches as they are",
        "strain rate, noise, friction, steps",
    ],
)
def test_kernel_equals_scan(sweep, sections):
    fast, reference = both(small_spec(sweep, **sections))
    assert np.sum(reference.status == status.OK) >= 8
    if sweep is ALL_SORTS:  # cases that stop are frozen alike
        assert status.DIVERGED in reference.status
    check_equal(fast, reference)


def test_odd_numbers_of_cases_fill_whole_vectors():
    """In single precision a vector holds 16 cases; fewer lanes would write beyond the arrays."""
    for real, unit in ((True, 8), (False, 16)):
        with jax.enable_x64(real):
            table = build_table(small_spec(MIXED))
            for count in (1, 3, 9, 40):
                group = plan_groups(table, np.arange(count), local_layout)[0]
                assert group.layout.lanes % unit == 0 and group.layout.size >= count
    loop = trace_loop(
        lambda constants, row, state: [state[0] + row[0]],
        [],
        [InputLeaf((), False)],
        [InputLeaf((), True)],
        np.float32,
    )
    kernel = cpu.build_kernel(loop)
    with pytest.raises(ValueError, match=f"lanes = 3; allowed: multiples of {kernel.width}"):
        kernel.run([np.zeros(1, np.float32), np.zeros(3, np.float32)], 1, 3)


#: Few samples of a released link, for what any machine shows.
RELEASED = {
    "title": "released",
    "run": {"duration": 0.002},
    "link": {"modes": 1},
    "control": {"modes": 1, "feedback": "ideal"},
    "initial": {"modal": [[1e-6]] * 3},
    "motion": {"waypoints": [HOME]},
    "shaper": {"kind": "none"},
    "metrics": {"residual_delay": 0.0, "residual_length": 0.001},
}


def smallest(size, **fields):
    """Structure and cases of `RELEASED`."""
    study = study_of(RELEASED, **fields)
    structure = build_structure(study)._replace(metrics=("residual_rms",))
    gains = np.linspace(0.1, 0.5, size)
    return structure, build_cases(study, {"control.gain_factor": gains}, structure)


def test_without_llvmlite_the_scan_runs(monkeypatch):
    structure, cases = smallest(LAYOUT.size)
    assert Executor(structure, LAYOUT).name == STEPPERS["kernel"]
    for module in (llvm, native):
        monkeypatch.setattr(module, "binding", None)
    native.this_processor.cache_clear()
    executor = Executor(structure, LAYOUT)
    assert executor.name == STEPPERS["scan"]
    assert np.all(np.isin(executor.start(cases).wait().status, status.FINISHED))
    assert "needs llvmlite" in executor_text() and len(environment()) > 8
    native.this_processor.cache_clear()


# --- the translation itself -----------------------------------------------------------------------


def translated(function, shape, dtype=np.float64, lanes=16):
    """Result of one application of `x -> function(x, c)` by kernel and by JAX, lanes last."""
    rng = np.random.default_rng(0)
    x = rng.normal(size=(*shape, lanes)).astype(dtype) * 2
    c = rng.normal(size=shape).astype(dtype)
    loop = trace_loop(
        lambda constants, row, state: [function(state[0], constants[0]) + 0 * row[0][0]],
        [c],
        [InputLeaf((1,), False)],
        [InputLeaf(shape, True)],
        dtype,
    )
    out = x.copy()
    cpu.build_kernel(loop).run([np.zeros((1, 1), dtype), out], 1, lanes)
    return out, np.asarray(reference(function)(x, c))


@cache
def reference(function):
    """Of whole vectors, by JAX."""
    return jax.jit(jax.vmap(function, (-1, None), -1))


def every_operation(x, c, bend=jnp.tanh):
    """All kinds of operations that a step may use."""
    a = jnp.where(x > c, jnp.sqrt(jnp.abs(x)), jnp.minimum(x, c) / (2 + c * c))
    a = a + jnp.clip(x, -0.5, 0.5) * jnp.round(x) - jnp.maximum(x, 0.25) ** 3 + bend(x)
    sine, cosine = sine_cosine(x)
    mixed = jnp.concatenate([a[1:], a[:1]]) + jnp.sum(x, axis=0) * jnp.max(x * c)
    flag = (x < 0) & (c > 0) | ~(x <= 1)
    odd = jnp.where(flag, jnp.sign(x), 0.0) + jnp.any(flag, axis=0)
    return mixed + sine * cosine + odd + x[:, :1] * c[None, 0] * jnp.isfinite(x)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_every_operation_is_translated(dtype):
    with jax.enable_x64(dtype == np.float64):
        out, wanted = translated(every_operation, (3, 4), dtype)
    scale = np.abs(wanted).max()
    assert np.abs(out - wanted).max() < 50 * np.finfo(dtype).eps * scale
    assert scale > 1


def test_not_a_number_goes_through_limits():
    """A limit must not hide a number that is none, or a case that went bad would look fine."""

    def limited(x, c):
        return jnp.clip(jnp.maximum(x * jnp.nan, c), -1.0, 1.0)

    out, wanted = translated(limited, (2,))
    assert np.isnan(wanted).all() and np.isnan(out).all()


def test_unknown_operation_is_named():
    with pytest.raises(NoKernelError, match="'cumsum'"):
        translated(lambda x, c: jnp.cumsum(x), (3,))


def test_code_is_kept_and_damage_is_noticed(tmp_path, monkeypatch):
    """The second compilation reads the first one's code; a spoilt file is compiled anew."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    taken = []
    take = ObjectCache.take
    monkeypatch.setattr(ObjectCache, "take", lambda *x: taken.append(take(*x)) or taken[-1])
    first = translated(every_operation, (3, 4))[0]
    (file,) = tmp_path.glob("kernel-*")
    whole = file.read_bytes()
    np.testing.assert_array_equal(translated(every_operation, (3, 4))[0], first)
    file.write_bytes(whole[:-1] + b"x")
    np.testing.assert_array_equal(translated(every_operation, (3, 4))[0], first)
    assert [code is not None for code in taken] == [False, True, False]
    assert file.read_bytes() == whole


def test_only_the_users_own_code_is_taken_from_the_cache(tmp_path, monkeypatch):
    """Neither code with a hash of its own, nor another entry, nor one under another key."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    kept = ObjectCache("kernel", "a")
    kept.keep(b"code")
    assert ObjectCache("kernel", "a").take() == b"code"
    (entry,) = tmp_path.glob("kernel-*")
    whole = entry.read_bytes()
    entry.write_bytes(hashlib.sha256(b"evil").hexdigest().encode() + b"\nevil")
    assert ObjectCache("kernel", "a").take() is None
    ObjectCache("kernel", "b").keep(b"other")
    (other,) = set(tmp_path.glob("kernel-*")) - {entry}
    entry.write_bytes(other.read_bytes())
    assert ObjectCache("kernel", "a").take() is None
    entry.write_bytes(whole)
    assert ObjectCache("kernel", "a").take() == b"code"
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    (tmp_path / "key").chmod(0o644)  # a key that others have read is replaced
    compilation._key.cache_clear()
    assert ObjectCache("kernel", "a").take() is None
    assert (tmp_path / "key").stat().st_mode & 0o777 == 0o600
    ObjectCache("kernel", "a").keep(b"code")
    assert ObjectCache("kernel", "a").take() == b"code"


# --- other processors -----------------------------------------------------------------------------

#: Features that this processor goes without, as older ones do; by bytes of the vectors.
WITHOUT = {64: (), 32: ("avx512",), 16: ("avx", "fma", "f16c", "vaes", "vpclmul")}


@pytest.fixture(params=WITHOUT)
def processor(request, monkeypatch):
    """Code for vectors of 64, 32 and 16 bytes, as far as this processor runs it."""
    found = native.this_processor().without(*WITHOUT[request.param])
    if found.vector_bytes != request.param:
        pytest.skip(f"needs vectors of {request.param} bytes")
    monkeypatch.setattr(native, "this_processor", lambda: found)
    return found


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_operations_on_any_processor(processor, dtype):
    with jax.enable_x64(dtype == np.float64):
        out, wanted = translated(every_operation, (3, 4), dtype)
    assert np.abs(out - wanted).max() < 50 * np.finfo(dtype).eps * np.abs(wanted).max()


def test_a_frozen_lane_stays_where_it_was(processor):
    """Each of some lanes at a sample of its own; its neighbours go on."""

    def step(constants, row, state):
        x, code = state
        after = x * 1.01 + row[0]
        code = jnp.where((code == 0) & (after > 2.0), 1.0, code)
        return [jnp.where(code == 0, after, x), code]

    leaf = InputLeaf((), True)
    loop = trace_loop(step, [], [InputLeaf((), False)], [leaf, leaf], np.float64)
    start, n_steps = np.linspace(0.1, 1.9, 16), 100
    start[::3] = -5.0  # these never freeze
    row = np.linspace(0, 1e-3, n_steps)
    x, code = start.copy(), np.zeros(16)
    cpu.build_kernel(loop).run([row, x, code], n_steps, 16)
    wanted, stopped = start.copy(), np.zeros(16, bool)
    ends = set()
    for k in range(n_steps):
        after = wanted * 1.01 + row[k]
        ends |= {k} if np.any((after > 2.0) & ~stopped) else set()
        stopped |= after > 2.0
        wanted = np.where(stopped, wanted, after)
    assert len(ends) > 5 and stopped.any() and not stopped.all()
    np.testing.assert_array_equal(code, stopped)
    np.testing.assert_allclose(x, wanted, rtol=1e-12)


def four_times(constants, row, state):
    """A function that is called four times, with one argument the same in every call."""

    @jax.jit
    def rate(x, push):
        turned = every_operation(x, constants[0], jnp.abs)
        return turned / (1 + turned * turned) + push * constants[1], x[0] + push

    (x,) = state
    one, low = rate(x, row[0])
    two, _ = rate(x + 0.1 * one, row[0])
    three, _ = rate(x + 0.1 * two, jnp.zeros(()))  # a known 0, which other calls do not have
    four, _ = rate(x + 0.2 * three, row[0])
    return [x + 0.01 * (one + 2 * two + 2 * three + four) + 1e-3 * low]


def leave_nothing_but_nan_on_the_stack(lanes):
    """So that what a kernel reads before it is written shows."""
    loop = trace_loop(
        lambda constants, row, state: [state[0] * row[0]],
        [],
        [InputLeaf((), False)],
        [InputLeaf((400,), True)],
        np.float64,
    )
    cpu.build_kernel(loop).run([np.ones(1), np.full((400, lanes), np.nan)], 1, lanes)


@pytest.mark.parametrize("directions", [0, 2])
def test_routines_are_what_they_replace(processor, directions):
    rng, shape, lanes = np.random.default_rng(2), (2, 2), 16
    given = [rng.normal(size=shape), rng.normal(size=lanes)]
    arguments = (
        [given[0], InputLeaf((), True)],
        [InputLeaf((), True)],
        [InputLeaf(shape, True)],
        np.float64,
        directions,
    )
    plain = trace_loop(four_times, *arguments)
    called = trace_loop(four_times, *arguments, has_routines=True)
    assert sum(node.operation == "call" for node in called.order) == 4 and len(called.bodies) == 1
    x = rng.normal(size=(*shape, lanes))
    along = [rng.normal(size=(directions, *shape, lanes))] * (directions > 0)
    row, found = rng.normal(size=(5, lanes)), []
    for loop in (plain, called):
        own = [x.copy(), *(part.copy() for part in along)]
        kernel = cpu.build_kernel(loop)
        leave_nothing_but_nan_on_the_stack(lanes)
        kernel.run([given[1], row, *own], 5, lanes)
        found.append(own)
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    assert np.abs(found[0][0] - x).max() > 1e-3


def test_code_for_arm():
    """Written and compiled, if not run: vectors of two, no masks, small numbers become 0."""
    binding = llvm.binding
    binding.initialize_all_targets()
    binding.initialize_all_asmprinters()
    leaf = InputLeaf((3,), True)
    loop = trace_loop(
        lambda constants, row, state: [state[0] * 0.5 + row[0]],
        [],
        [InputLeaf((), False)],
        [leaf],
        np.float64,
    )
    processor = native.Processor("generic", "+neon", "aarch64-unknown-linux-gnu")
    writer = cpu.write_loop(loop, processor)
    assert writer.width == 2
    machine = binding.Target.from_triple(processor.triple).create_target_machine(opt=3)
    text = machine.emit_assembly(binding.parse_assembly(str(writer.module)))
    assert "FPCR" in text and "fmla" in text and ".2d" in text


# --- guards against slow code, which tests cannot time --------------------------------------------


@cache
def workload(work):
    """The function of a block of a workload."""
    study = paper_study().change(**WORKS[work])
    structure = build_structure(study)._replace(metrics=METRICS.get(work, ()))
    gains = np.linspace(0.1, 0.5, LAYOUT.size)
    leaves, tree = jax.tree.flatten(build_cases(study, {"control.gain_factor": gains}, structure))
    is_own = tuple(len(leaf) > 1 for leaf in leaves)
    own = [x[: LAYOUT.lanes] for x, yes in zip(leaves, is_own, strict=True) if yes]
    shared = [x[0] for x, yes in zip(leaves, is_own, strict=True) if not yes]
    return block_function(structure, CaseLeaves(tree, is_own), (), own, shared, "kernel")


#: Operations, with some room, as docs/performance.md has them.
MOST = {"W0": 3630, "W1": 4680}


@pytest.mark.parametrize("work", ["W0", pytest.param("W1", marks=pytest.mark.long)])
def test_a_sample_takes_no_more_operations_than_it_should(work):
    found = workload(work).operations
    assert found.pop("read") < 700
    calls = found.pop("call", 0), found.pop("result", 0)
    # routines work out for every call what only some of them want
    room = 1.04 if any(calls) else 1.0
    assert 0.8 * MOST[work] < sum(found.values()) < room * MOST[work]
    assert calls in ((0, 0), (4, calls[1]))
    # four evaluations of the plant: a root and two reciprocals per link, three in the solution
    # and, where all metrics are accumulated, one per link for `ringing_time`, one for the stretch
    assert found["sqrt"] == 12 and found["reciprocal"] == {"W0": 36, "W1": 40}[work]


#: Kinds of x86 processors with the features that kernels ask for, and the most bytes of a sample's
#: code, routines included: what exceeds the instruction cache runs at half the speed.
CODE = {
    ("x86-64-v4", "+avx2,+fma,+avx512f,+avx512vl,+avx512bw,+avx512dq"): {"W0": 49e3, "W1": 98e3},
    ("x86-64-v3", "+avx2,+fma"): {"W0": 26e3, "W1": 82e3},
}


@pytest.mark.parametrize("kind", CODE)
@pytest.mark.parametrize("work", ["W0", pytest.param("W1", marks=pytest.mark.long)])
def test_code_of_a_sample_is_as_small_as_it_should_be(work, kind):
    triple = native.this_processor().triple
    if not triple.startswith("x86_64"):
        pytest.skip("needs an x86 processor")
    processor = native.Processor(*kind, triple)
    arguments = workload(work).loop_arguments()
    loop = trace_loop(*arguments, np.float64, 0, not processor.has_masks)
    code = native.machine_code(str(cpu.write_loop(loop, processor).module), processor, 3)
    sections = native.binding.ObjectFileRef.from_data(code).sections()
    size = sum(section.size() for section in sections if section.is_text())
    assert 0.8 * CODE[kind][work] < size < CODE[kind][work]


# --- quick code first, fast code later ------------------------------------------------------------


def test_a_kernel_is_upgraded_and_gives_the_same_numbers(tmp_path, monkeypatch):
    """Once it has run for a while, by a process of its own; both versions are kept."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    monkeypatch.setattr(cpu, "_effort", lambda: 3)
    loop = trace_loop(
        lambda constants, row, state: [state[0] * 0.9 + jnp.sqrt(row[0]) / (1 + state[0] ** 2)],
        [],
        [InputLeaf((), True)],
        [InputLeaf((3,), True)],
        np.float64,
    )
    row, found = np.linspace(0.1, 2.0, 80).reshape(5, 16), []
    kernel = cpu.build_kernel(loop)
    assert not kernel.is_best and len(list(tmp_path.glob("kernel-*"))) == 1
    for after in (1e9, 0.0, 0.0):
        monkeypatch.setattr(cpu, "UPGRADE_AFTER", after)
        found.append(np.linspace(-1, 1, 48).reshape(3, 16))
        kernel.run([row, found[-1]], 5, 16)
        if after == 0.0:
            cpu._UPGRADES._thread.join(60.0)
    assert kernel.is_best and len(kernel._engines) == 2
    np.testing.assert_array_equal(found[0], found[2])
    assert len(list(tmp_path.glob("kernel-*"))) == 2
    assert cpu.build_kernel(loop).is_best  # found in the cache
    with cpu.full_effort():
        assert cpu.build_kernel(loop).is_best


def test_a_failed_upgrade_leaves_the_first_version(monkeypatch):
    monkeypatch.setattr(native.sys, "executable", "/nothing/there")
    assert native.machine_code_apart("", native.this_processor(), 3) is None
    monkeypatch.undo()
    assert native.machine_code_apart("no module", native.this_processor(), 3) is None


def test_numbers_that_all_calls_share_are_written_once(processor):
    """Also where they come from another routine; tangents are left to `test_tangents`."""

    def step(constants, row, state):
        wide = jax.jit(lambda x: polynomial(x, 30))
        twice = jax.jit(lambda x, y: polynomial(x, 30) * y + jnp.sum(y * y))
        same = wide(row[0]) + wide(row[0] * 0.5)  # of this sample, the same in all calls below
        first = twice(state[0], same * jnp.ones(3))
        return [0.1 * twice(0.1 * first, same * jnp.ones(3)) + constants[0]]

    def polynomial(x, terms):
        total = 1.0 + 0 * x
        for n in range(terms, 0, -1):
            total = total * x * (0.3 / n) + 1.0
        return total

    leaves = [InputLeaf((), True)], [InputLeaf((), True)], [InputLeaf((3,), True)], np.float64
    loops = [trace_loop(step, *leaves, has_routines=x) for x in (False, True)]
    assert len(loops[1].bodies) == 2 and not loops[0].bodies
    assert any(
        node.place[0] == "shared"
        for body in loops[1].bodies.values()
        for node in body.order
        if node.operation == "read"
    )
    rng, found = np.random.default_rng(3), []
    constant, row, x = rng.normal(size=16), rng.normal(size=(4, 16)), rng.normal(size=(3, 16))
    for loop in loops:
        found.append(x.copy())
        leave_nothing_but_nan_on_the_stack(16)
        cpu.build_kernel(loop).run([constant, row, found[-1]], 4, 16)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-12)
    assert np.abs(found[0] - x).max() > 1e-3


def test_a_record_holds_every_kind_of_number():
    """What stays the same over a run, what is known, and what a sample brings."""
    one = [InputLeaf((), True)]
    loop = trace_loop(lambda c, row, x: [x[0] * c[0] + row[0]], one, one, one, np.float64)
    constant, brought = (
        next(x for x in loop.order if x.place == (kind, 0)) for kind in ("constant", "input")
    )
    loop = loop._replace(
        leaves=loop.leaves | {"record": [InputLeaf((3,), True)]}, records=(constant, 2.0, brought)
    )
    rng = np.random.default_rng(0)
    same, row, record = rng.normal(size=16), rng.normal(size=(4, 16)), np.full((4, 3, 16), np.nan)
    cpu.build_kernel(loop).run([same, row, np.zeros(16), record], 4, 16)
    wanted = [np.tile(same, (4, 1)), np.full((4, 16), 2.0), row]
    np.testing.assert_array_equal(record, np.stack(wanted, axis=1))


def test_an_upgraded_kernel_is_found_by_the_next_process(tmp_path, monkeypatch):
    """Under its name, so that it is neither traced nor run slowly again."""
    monkeypatch.setattr(compilation, "cache_folder", lambda: str(tmp_path))
    monkeypatch.setattr(cpu, "_effort", lambda: 3)
    made = []

    def make():
        made.append(1)
        leaves = [], [], [InputLeaf((2,), True)]
        return trace_loop(lambda _, row, state: [state[0] * 0.5 + 1.0], *leaves, np.float64)

    kernel = cpu.kept_kernel("halves", make)
    assert not kernel.is_best and not cpu.kept_kernel("halves", make).is_best
    kernel.upgrade(is_apart=False)
    assert cpu.kept_kernel("halves", make).is_best
    assert len(made) == 1
