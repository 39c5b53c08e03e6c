"""Structure of JAX's programs as the kernels read it, on any version of JAX, and what replaces
kernels where it cannot be read."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from studies.engine import batched as batched_module
from studies.engine import function, lanes, plan
from studies.engine.executor import Executor
from studies.engine.function import STEPPERS
from studies.errors import NoKernelError, NoKernelWarning
from studies.kernels import cpu, graph
from studies.kernels.equations import call_of, literal, scan_of, trace
from tests.studies.engine import test_batched
from tests.studies.kernels.test_kernel import check_equal, translated
from tests.studies.kernels.test_tangents import LAYOUT, chunk, place  # noqa: F401 (a fixture)
from tests.studies.sweeps.test_sweep_commands import toml_of
from tests.studies.test_cli import run


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


def test_a_sweep_runs_by_the_scan_and_says_so(capsys, tmp_path, monkeypatch, no_structure):
    monkeypatch.setattr(plan, "LANES", 8)
    monkeypatch.setattr(plan, "LARGEST_CHUNK", 16)
    path = tmp_path / "small.toml"
    path.write_text(toml_of(SWEEP))
    code, text, errors = run(capsys, "sweep", path, "--out", tmp_path / "out")
    assert code == 0 and "2/2 cases" in text and "Traceback" not in text + errors
    (line,) = [x for x in text.splitlines() if x.startswith("executor: ")]
    assert line.startswith("executor: XLA scan (JAX") and "KeyError: 'num_consts'" in line


def test_the_results_are_those_of_the_kernel(chunk, no_structure, monkeypatch):  # noqa: F811
    structure, cases, _ = chunk
    executor = Executor(structure, LAYOUT)
    found = executor.start(cases).wait()
    assert executor.name.startswith("XLA scan (")
    monkeypatch.undo()
    wanted = Executor(structure, LAYOUT)
    check_equal(found, wanted.start(cases).wait())
    assert wanted.name == STEPPERS["kernel"] and STEPPERS["scan"] in executor.name


def test_gradients_without_a_kernel(chunk, no_structure):  # noqa: F811
    structure, cases, parameters = chunk
    # unoptimised, a scan takes its time for each sample, forward and back
    executor = Executor(structure._replace(n_steps=20), LAYOUT, place=place)
    with pytest.warns(NoKernelWarning, match="XLA's scan runs instead"):
        executor.differentiate(cases, parameters)
    assert executor.name.startswith("XLA scan (") and executor.compile_time > 0


def test_batched_without_a_kernel(no_structure):
    parameters = np.array([[0.5, 0.05, 0.0], [1.0, 0.05, 0.0]])
    run_batch = batched_module.batched(test_batched.STUDY, test_batched.NAMES)
    with pytest.warns(NoKernelWarning, match="XLA's scan runs instead"):
        found = jax.jit(run_batch)(parameters)
    assert (np.asarray(found.status) == 0).all()


def halved(constants, row, state):
    return jax.tree.map(lambda x: 0.5 * x + constants + row, state)


def test_steps_over_lanes_without_a_kernel(monkeypatch):
    given = np.linspace(0.1, 1, 5), np.ones((3,)), np.arange(5.0), 3
    wanted = lanes.run_steps(halved, *given)
    lanes._runner.cache_clear()

    def failing(*_):
        raise NoKernelError("LLVM cannot compile the traced kernel: unknown processor")

    monkeypatch.setattr(cpu, "kept_kernel", failing)
    with pytest.warns(NoKernelWarning, match="unknown processor; XLA's scan runs instead"):
        found = lanes.run_steps(halved, *given)
    lanes._runner.cache_clear()
    np.testing.assert_allclose(found, wanted, rtol=1e-15)
