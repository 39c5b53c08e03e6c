"""The kernel for graphics processors, as far as a machine without one can show it.

The code of one case is compiled for this processor and stands in for the launch, so everything but
the launch itself runs: tracing, instructions, memory addresses, preparation and judgement.
"""

import ctypes
import re
import shutil
import subprocess
from functools import partial

import jax
import numpy as np
import pytest

from jaxmodel import status
from jaxmodel.judge import judge
from studies import config
from studies.bench.works import METRICS, WORKS
from studies.engine import function
from studies.engine.executor import Executor, executor_text
from studies.engine.function import stepper
from studies.engine.plan import Layout
from studies.engine.steps import kernel_steps
from studies.kernels import bridge, gpu, llvm, native
from studies.kernels.differentiable import DifferentiableLoop
from studies.kernels.traced import InputLeaf, trace_loop
from studies.study.cases import build_structure
from studies.study.numbers import build_cases
from tests.bare import paper_study
from tests.studies.kernels.test_kernel import check_equal, every_operation, smallest

LAYOUT = Layout(devices=1, blocks=2, lanes=gpu.BLOCK)


def rehearsed(call, arrays):
    """Stands in for a launch: the same code, one case after the other on this CPU."""
    native.initialise()
    loop, lanes = call.make(), call.lanes
    module = gpu.ThreadWriter(loop, call.n_steps, lanes).write()
    target = llvm.binding.Target.from_default_triple().create_target_machine(jit=True, opt=3)
    parsed = llvm.binding.parse_assembly(str(module))
    gpu.optimise(parsed, target)
    engine = llvm.binding.create_mcjit_compiler(parsed, target)
    prototype = ctypes.CFUNCTYPE(
        None, ctypes.c_int64, *[ctypes.c_void_p] * (len(arrays) + len(call.shapes))
    )
    case = prototype(engine.get_function_address("case"))

    def on_host(*arrays):
        given = [np.array(x, loop.dtype, order="C") for x in arrays]
        last = [np.empty(shape.shape, loop.dtype) for shape in call.shapes]
        for k in range(lanes):
            case(k, *(x.ctypes.data for x in (*given, *last)))
        assert engine
        return tuple(last)

    return list(jax.pure_callback(on_host, tuple(call.shapes), *arrays, vmap_method="sequential"))


def work(name, size=LAYOUT.size):
    """Structure and cases of a workload over its first move."""
    study = paper_study().change(
        **{**WORKS[name], "link__modes": 2},
        run__duration=0.06,
        motion__move_time=0.03,
        motion__waypoints=paper_study().motion.waypoints[:2],
        metrics__residual_length=0.01,
        metrics__residual_delay=0.002,
    )
    structure = build_structure(study)._replace(metrics=METRICS.get(name, ()))
    force = np.zeros((size, 3))
    force[3] = 1e6  # a case that is thrown off its course
    cases = build_cases(study, {"control.gain_factor": np.linspace(0.1, 0.5, size)}, structure)
    return structure, cases._replace(drive=cases.drive._replace(pulse_force=force))


@pytest.mark.long  # in short: what is written for the device is valid, below
@pytest.mark.parametrize("name", ["W1", "W0"])
def test_gpu_executor_equals_the_traced_kernel(name, monkeypatch):
    monkeypatch.setattr(gpu.GpuCall, "__call__", rehearsed)
    structure, cases = work(name)
    executor = Executor(structure, LAYOUT, kind="gpu")
    found = executor.start(cases).wait()
    assert executor.name == "GPU kernel" and executor.compile_time > 0
    wanted = Executor(structure, LAYOUT, kind="kernel").start(cases).wait()
    assert set(wanted.status) == {status.OK, status.DIVERGED}
    check_equal(found, wanted)
    rms = wanted.metrics.residual_rms[wanted.status == status.OK]
    assert rms.min() > 0 and rms.max() > 1.001 * rms.min()


def test_gradients_equal_those_of_the_traced_kernel(monkeypatch):
    """Forward and reverse, in several pieces of the run, the last one shorter."""
    monkeypatch.setattr(gpu.GpuCall, "__call__", rehearsed)
    monkeypatch.setattr(gpu.GpuCall, "RECORD", 2**14)
    random, lanes, n = np.random.default_rng(1), gpu.BLOCK, 25
    shape = (3, 4)
    constants = [InputLeaf((3,), True, True)]
    inputs = [InputLeaf((2,), True, True)]

    def step(constants, row, state):
        (x,), (c,), (u,) = state, constants, row
        return [0.9 * x + c[:, None] * x * u[0] / (1 + x * x) + u[1]]

    def value(kind, leaves):
        given = step, constants, inputs, [InputLeaf(shape, True)], np.float64, n, lanes, kind
        loop = DifferentiableLoop(*given)
        return jax.jit(jax.value_and_grad(lambda x: (loop(x)[0] ** 2).sum()))(leaves)

    leaves = [
        random.normal(size=(3, lanes)),
        random.normal(size=(n, 2, lanes)),
        random.normal(size=(*shape, lanes)),
    ]
    found, wanted = (value(kind, leaves) for kind in (gpu.GpuCall, bridge.CpuCall))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11 * np.abs(b).max())
        assert np.abs(b).max() > 0


@pytest.mark.long
def test_loops_are_judged_as_on_cores(monkeypatch):
    monkeypatch.setattr(gpu.GpuCall, "__call__", rehearsed)
    study = paper_study().change(link__modes=2)
    structure = build_structure(study)
    gains = {"control.gain_factor": np.geomspace(0.1, 3.0, 5)}
    cases = jax.tree.map(
        lambda x: np.broadcast_to(x, (5, *x.shape[1:])), build_cases(study, gains, structure)
    )
    found, wanted = (
        jax.jit(partial(judge, structure, steps=partial(kernel_steps, kind, [])))(cases)
        for kind in (gpu.GpuCall, bridge.CpuCall)
    )
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9)
    assert found.is_known.all() and np.ptp(found.gain_margin) > 0


def test_without_the_call_target_the_scan_runs(monkeypatch):
    """Here XLA knows no call of PTX."""
    monkeypatch.setattr(function, "_FUNCTIONS", {})
    structure, cases = smallest(LAYOUT.size)
    executor = Executor(structure, LAYOUT, kind="gpu")
    assert executor.start(cases).wait().status[0] == status.OK
    assert "(the GPU kernel failed: " in executor.name


def test_what_sweeps_run_with_is_said(monkeypatch):
    assert "traced kernel, vectors of" in executor_text()
    monkeypatch.setattr("studies.engine.executor.processor", lambda: "cuda")
    assert executor_text() == "GPU kernel"
    monkeypatch.setattr("studies.engine.executor.is_available", lambda: False)
    assert "needs llvmlite" in executor_text()


def test_it_is_chosen_on_a_graphics_processor(monkeypatch):
    structure, _ = smallest(1)
    monkeypatch.setattr(function, "processor", lambda: "cuda")
    assert stepper(structure) == "gpu"
    assert stepper(structure._replace(substeps=100)) == "scan"
    assert config.processor() == "cpu"


@pytest.fixture(scope="module")
def every_loop():
    """A loop with every kind of operation but tanh, which friction alone needs."""
    return trace_loop(
        lambda constants, row, state: [
            every_operation(state[0], constants[0], lambda x: x) + row[0][0] * constants[1]
        ],
        [InputLeaf((3, 4), True), np.ones(1)],
        [InputLeaf((1,), False)],
        [InputLeaf((3, 4), True)],
        np.float64,
    )


def test_every_operation_becomes_ptx(every_loop):
    """In registers: the state is read once before the loop and written once after it."""
    text = gpu.write_ptx(every_loop, 100, 4 * gpu.BLOCK)
    assert ".visible .entry run(" in text
    assert len(re.findall(r"ld\.global", text)) == 12 + 12 + 1
    assert len(re.findall(r"st\.global", text)) == 12
    assert not re.search(r"\.local|call", text)
    for instruction in ("fma.rn.f64", "sqrt.rn.f64", "rcp.rn.f64", "selp.f64", "cvt.rni.f64"):
        assert instruction in text.replace("b64", "f64"), instruction


def test_the_call_is_lowered_for_cuda(every_loop):
    """What JAX hands to XLA: the target's name, the program and the sizes of the launch."""
    lanes = 4 * gpu.BLOCK
    run = gpu.GpuCall.of_loop(every_loop, 100, lanes)
    shapes = [(3, 4, lanes), (100, 1), (3, 4, lanes)]
    arrays = [jax.ShapeDtypeStruct(shape, np.float64) for shape in shapes]
    text = jax.jit(run).trace(arrays).lower(lowering_platforms=("cuda",)).as_text()
    assert f"@{gpu.TARGET}(" in text and 'kernel_type = "ptx"' in text
    assert f"block_x = {gpu.BLOCK} : i32" in text and "grid_x = 4 : i32" in text


@pytest.mark.skipif(shutil.which("ptxas") is None, reason="needs ptxas of the CUDA toolkit")
def test_ptx_is_valid(every_loop, tmp_path):
    source = tmp_path / "run.ptx"
    source.write_text(gpu.write_ptx(every_loop, 100, 4 * gpu.BLOCK))
    subprocess.run(
        ["ptxas", "-arch=sm_90", source, "-o", tmp_path / "run.cubin"], check=True, timeout=120
    )
