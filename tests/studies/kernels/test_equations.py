"""Structure of JAX's programs as the kernels read it, on any version of JAX, and what replaces
kernels where it cannot be read."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from studies.engine import executor, function, steps
from studies.engine.batched import batched
from studies.engine.executor import Executor
from studies.engine.function import STEPPERS
from studies.errors import NoKernelError, NoKernelWarning
from studies.kernels import bridge, graph
from studies.kernels.equations import call_of, literal, scan_of, trace
from tests.bare import bare
from tests.canonical import study_of, text_of
from tests.studies.kernels.test_kernel import RELEASED, check_equal, smallest, translated
from tests.studies.kernels.test_tangents import LAYOUT, N_PARAMETERS, place
from tests.studies.test_cli import run
from tests.sweeps import narrow_blocks


def scanned(x, c, reverse):
    """A scan with constants, carry, rows and results, the constants in another function."""
    table = np.arange(3.0)

    @jax.jit
    def weighted(carry, row):
        return 0.5 * carry + c[0] * row + table[1]

    def body(carry, row):
        carry = weighted(carry, row)
        return carry, carry * row

    last, rows = jax.lax.scan(body, x[0], x, reverse=reverse)
    return rows + last


@pytest.mark.parametrize("reverse", [False, True])
def test_scans_are_unrolled_in_their_order(reverse):
    out, wanted = translated(lambda x, c: scanned(x, c, reverse), (4, 3))
    np.testing.assert_allclose(out, wanted, atol=1e-14 * np.abs(wanted).max(), rtol=0)
    other = translated(lambda x, c: scanned(x, c, not reverse), (4, 3))[1]
    assert np.abs(other - wanted).max() > 1e-3


def test_operands_of_a_scan_are_counted():
    traced, _ = trace(lambda x, c: scanned(x, c, True), jnp.ones((4, 3)), jnp.ones((4, 3)))
    (scan,) = [x for x in map(scan_of, traced.equations) if x is not None]
    assert (scan.n_carry, scan.length, scan.is_reversed) == (1, 4, True)
    assert len(scan.body.inputs) == scan.n_constants + 2 and len(scan.body.outputs) == 2


def described(**counts):
    """A scan as some version of JAX describes it."""
    body = jax.make_jaxpr(lambda c, s, x: (s + c, x))(1.0, 2.0, 3.0)
    params = {"jaxpr": body, "length": 5, "reverse": False, **counts}
    return SimpleNamespace(primitive=SimpleNamespace(name="scan"), params=params)


@pytest.mark.parametrize(
    "counts",
    [
        {"num_consts": 1, "num_carry": 1},  # to JAX 0.11
        {"ft_in": SimpleNamespace(unpack=lambda: ([None], [None], [None]))},  # from JAX 0.12 on
    ],
)
def test_both_descriptions_of_a_scan(counts):
    scan = scan_of(described(**counts))
    assert (scan.n_constants, scan.n_carry, scan.length) == (1, 1, 5)


@pytest.mark.parametrize(
    "counts",
    [{}, {"num_consts": 1}, {"ft_in": 3}, {"ft_in": SimpleNamespace(unpack=lambda: ([], []))}],
)
def test_an_unknown_description_is_no_kernel(counts):
    with pytest.raises(NotImplementedError, match=f"JAX {jax.__version__} describes it"):
        scan_of(described(**counts))


def test_calls_constants_and_literals():
    """Functions under jit, remat and with own derivatives; called twice, one stays one."""
    table = np.arange(3.0)

    @jax.jit
    def twice(x):
        return x * table + 2.0

    @jax.custom_jvp
    def bent(x):
        return jnp.tanh(x)

    bent.defjvp(lambda x, t: (jnp.tanh(*x), 2 * t[0]))
    traced, shape = trace(lambda x: jax.checkpoint(bent)(twice(twice(x))), jnp.ones(3))
    inner = [x for x in map(call_of, traced.equations) if x is not None]
    assert len(inner) == 3 and inner[0].source is inner[1].source
    assert inner[0].source is not inner[2].source
    assert shape.shape == (3,) and traced.shapes == [(3,)] and traced.is_real
    known = [literal(x) for call in inner for eq in call.equations for x in eq.invars]
    known += [x for call in (traced, *inner) for _, x in call.constants]
    known = [np.asarray(x) for x in known if x is not None]
    assert any(x.shape == () and x == 2.0 for x in known)
    out, wanted = translated(lambda x, c: jax.checkpoint(bent)(twice(x)) * c, (2, 3))
    np.testing.assert_allclose(out, wanted, rtol=1e-15)


# --- without a kernel, the scan -------------------------------------------------------------------


def unknown(equation):
    """What a future JAX might do to `scan_of`, `call_of` or the rest of a graph."""
    raise KeyError("num_consts")


@pytest.fixture
def no_structure(monkeypatch):
    """A JAX whose programs cannot be read."""
    monkeypatch.setattr(graph, "scan_of", unknown)
    monkeypatch.setattr(function, "_FUNCTIONS", {})


def test_errors_of_a_graph_name_the_version(no_structure):
    with pytest.raises(NoKernelError, match=rf"JAX {jax.__version__} .*KeyError: 'num_consts'"):
        translated(lambda x, c: x * c, (3,))


SWEEP = """
[sweep]
metrics = ["residual_rms"]
[sweep.axes]
gain = [0.2, 0.4]
"""


@pytest.mark.long  # in short: executors are named, below
def test_a_sweep_runs_by_the_scan_and_says_so(capsys, tmp_path, no_structure):
    path = tmp_path / "small.toml"
    path.write_text(text_of(bare(RELEASED)) + SWEEP)
    with narrow_blocks(16):
        code, text, errors = run(capsys, "sweep", path, "--out", tmp_path / "out")
    assert code == 0 and "2/2 cases" in text and "Traceback" not in text + errors
    (line,) = [x for x in text.splitlines() if x.startswith("executor: ")]
    assert line.startswith("executor: XLA scan (JAX") and "KeyError: 'num_consts'" in line


@pytest.mark.long
def test_the_results_are_those_of_the_kernel(no_structure, monkeypatch):
    structure, cases = smallest(LAYOUT.size)
    runs = Executor(structure, LAYOUT)
    found = runs.start(cases).wait()
    assert runs.name.startswith("XLA scan (")
    monkeypatch.undo()
    wanted = Executor(structure, LAYOUT)
    check_equal(found, wanted.start(cases).wait())
    assert wanted.name == STEPPERS["kernel"] and STEPPERS["scan"] in runs.name


@pytest.mark.long  # in short: the same way to a function that is made up, below
def test_gradients_without_a_kernel(no_structure):
    structure, cases = smallest(LAYOUT.size, run__smooth=True)
    runs = Executor(structure, LAYOUT, place=place)
    with pytest.warns(NoKernelWarning, match="XLA's scan runs instead"):
        runs.differentiate(cases, np.full((LAYOUT.size, N_PARAMETERS), 0.9))
    assert runs.name.startswith("XLA scan (") and runs.compile_time > 0


def test_gradients_are_those_of_the_scan_where_kernels_fail(monkeypatch):
    """They fail when they are compiled for derivatives, the first time that they are traced."""

    def failing(free, own, is_differentiated):
        assert is_differentiated
        raise NoKernelError("an operation that kernels do not know")

    def made(structure, build, free, own, shared, kind, is_many):
        scan = SimpleNamespace(linearise=lambda free, own: ({"free": free}, None))
        return scan if kind == "scan" else SimpleNamespace(compile=failing)

    monkeypatch.setattr(executor, "block_function", made)
    structure, cases = smallest(LAYOUT.size)
    runs, free = Executor(structure, LAYOUT, place=place), np.full((LAYOUT.size, 4), 0.9)
    with pytest.warns(NoKernelWarning, match="XLA's scan runs instead"):
        found = runs.differentiate(cases, free)
    np.testing.assert_array_equal(found.result["free"], free)
    assert runs.name == "XLA scan (an operation that kernels do not know)"
    assert runs.compile_time > 0


def test_batched_without_a_kernel(no_structure):
    """Made, if not run: as the scan that the results above are of."""
    run_batch = batched(study_of(RELEASED), ("control.gain_factor",))
    with pytest.warns(NoKernelWarning, match="XLA's scan runs instead"):
        found = jax.eval_shape(run_batch, np.array([[0.1], [0.5]]))
    assert found.status.shape == (2,)


def halved(constants, row, state):
    return jax.tree.map(lambda x: 0.5 * x + constants + row, state)


def stepped(steps, given):
    """Three steps over five lanes."""
    return steps(halved, given, np.ones((3,)), np.arange(5.0), 3)


def stepped_once(steps, given):
    return steps(halved, given, np.ones((1,)), np.arange(5.0), 1)


def test_steps_over_lanes_without_a_kernel(monkeypatch):
    given = np.linspace(0.1, 1, 5)
    wanted = steps.program_of_steps(stepped, [], given)(given)
    steps._PROGRAMS.clear()

    def failing(*_):
        raise NoKernelError("LLVM cannot compile the traced kernel: unknown processor")

    monkeypatch.setattr(bridge, "kept_kernel", failing)
    bridge._HANDLERS.clear()
    bridge._KERNELS.clear()
    with pytest.warns(NoKernelWarning, match="unknown processor; XLA's scan runs instead"):
        found = steps.program_of_steps(stepped, [], given)(given)
    steps._PROGRAMS.clear()
    np.testing.assert_allclose(found, wanted, rtol=1e-15)
    np.testing.assert_allclose(found[0], 0.5**3 * 0 + 1.1 * (1 + 0.5 + 0.25), rtol=1e-15)


def test_kernels_that_were_thrown_away_are_made_again(monkeypatch):
    """A program is kept, and which kernels it needs, but not these."""
    given, made, original = np.linspace(0.1, 1, 5), [], bridge.kept_kernel

    def traced_again(name, make):
        made.append(make())
        return original(name, make)

    monkeypatch.setattr(bridge, "kept_kernel", traced_again)
    monkeypatch.setattr(steps, "is_keeping", lambda: True)
    monkeypatch.setattr(steps, "kept_data", lambda names, make, module: make())
    bridge._KERNELS.clear()
    found = steps.program_of_steps(stepped_once, [], given)(given)
    steps._PROGRAMS.clear()
    np.testing.assert_allclose(found, 1 + given + np.arange(5.0) / 2, rtol=1e-14)
    assert len(made) == 1
