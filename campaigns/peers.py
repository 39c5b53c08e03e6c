"""`python -m campaigns.peers`: W0 with other solvers, how this program's speed compares.

All of them integrate the same cases: the drive's reference at start, middle and end of each sample,
voltages from modal velocities, rms deflection in the residual window. Their accuracy is measured
against this program's own scan at an eighth of the step, and reported with their speed.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

from jaxmodel.bases import station_places
from jaxmodel.beam import build_basis
from jaxmodel.case import Case, Structure
from jaxmodel.drive import Reference
from jaxmodel.loop import PlantState, ideal_voltage, plant_rates
from jaxmodel.simulate import Start, begin
from studies import config
from studies.bench.works import build_work, make_layout, timed
from studies.engine.executor import Executor
from studies.engine.plan import Layout
from studies.kernels.cpu import full_effort
from studies.kernels.llvm import is_available
from studies.reference import lagrangian as reference
from studies.study.cases import as_arrays
from studies.study.spec import paper_study

#: Sample period of W0, and step of the peers with a constant step [s].
PERIOD = 1e-4
#: Number of runs; the median counts.
REPEATS = 3
#: Steps of the reference per step of the peers.
FINER = 8
#: Tolerances of `solve_ivp` that make it as accurate as the others, relative and absolute [m].
TOLERANCES = (1e-7, 1e-11)


KERNEL, C = "this program, traced kernel", "hand-written C"


class Work(NamedTuple):
    """W0 for a number of cases."""

    structure: Structure
    cases: Case  # leading axis: 1 or the number of cases
    layout: Layout

    def first(self, n: int) -> Case:
        """The first n cases, all leaves with that leading axis."""
        wide = (
            np.broadcast_to(x, (self.layout.size, *x.shape[1:]))
            for x in jax.tree.leaves(self.cases)
        )
        return as_arrays(jax.tree.unflatten(jax.tree.structure(self.cases), [x[:n] for x in wide]))


class PeerRow(NamedTuple):
    """Measurements of a peer."""

    peer: str
    configs_per_s: float  # [1/s]
    error: float  # largest one of a residual rms, over the largest residual rms [1]
    times_slower: float  # than the fastest peer


class Peer(NamedTuple):
    """One way to do the work."""

    name: str
    n_cases: int  # enough to time it, few enough to wait for
    run: Callable[[], Any]  # residual rms (n_cases, 3, S)

    def finish(self) -> np.ndarray:
        """Run it and wait for the result."""
        return np.asarray(self.run())


def make_work(is_short: bool = False) -> Work:
    """W0 with varied gains.

    Args:
        is_short: only one move and 20 ms after it, to check that all agree.
    """
    short = {
        "run__duration": 0.15,
        "motion__waypoints": paper_study().motion.waypoints[:2],
        "metrics__residual_length": 0.02,
    }
    layout = make_layout(8 * len(jax.local_devices()) if is_short else 0)
    return Work(*build_work("W0", layout, **(short if is_short else {})), layout)


def bench_peers(
    report: Callable[[str], None], is_short: bool = False, repeats: int = REPEATS
) -> list[PeerRow]:
    """Speed and error of every peer that can run here, fastest first.

    Args:
        report: called with a line on progress or on what is left out.
        is_short: see `make_work`.
        repeats: number of runs; the median counts.
    """
    config.require_configured()
    work = make_work(is_short)
    finer = work.structure._replace(substeps=FINER)
    exact = Executor(finer, work.layout, kind="scan").start(work.cases).wait().metrics.residual_rms
    rows: list[PeerRow] = []
    peers = find_peers(work, report)
    for peer in peers:
        report(f"{peer.name}: {peer.n_cases} cases")
        rms, timing = timed(peer.finish, repeats)
        exact_rms = exact[: peer.n_cases]
        error = float(np.max(np.abs(rms - exact_rms)) / np.max(exact_rms))
        speed = peer.n_cases / timing.seconds
        rows.append(PeerRow(peer.name, speed, error, 1.0))
    kernel, c = (next((p for p in peers if p.name.startswith(x)), None) for x in (KERNEL, C))
    if kernel and c:
        wall, processor = speed_ratio(kernel.finish, c.finish, repeats)
        report(
            f"kernel over C, alternated {repeats} times on {config.processor_text()}: {wall:.2f} "
            f"by time, {processor:.2f} by processor time"
        )
    rows.sort(key=lambda row: -row.configs_per_s)
    best = rows[0].configs_per_s
    return [row.replace(times_slower=best / row.configs_per_s) for row in rows]


def speed_ratio(
    one: Callable[[], Any], other: Callable[[], Any], rounds: int
) -> tuple[float, float]:
    """How much faster one is than the other: medians over rounds of both, back to back.

    Args:
        one, other: to run.
        rounds: of each.

    Returns:
        (by time, by processor time).
    """
    ratios = []
    for _ in range(rounds):
        times = []
        for run in (other, one):
            wall, processor = time.perf_counter(), time.process_time()
            run()
            times.append((time.perf_counter() - wall, time.process_time() - processor))
        ratios.append([a / b for a, b in zip(*times, strict=True)])
    wall_ratio, processor_ratio = np.median(ratios, axis=0)
    return float(wall_ratio), float(processor_ratio)


def find_peers(work: Work, report: Callable[[str], None]) -> list[Peer]:
    """Peers that can run here; `report` is told about the others."""
    size = work.layout.size

    def own(kind: str) -> Callable[[], Any]:
        stepper = Executor(work.structure, work.layout, kind=kind)
        return lambda: stepper.start(work.cases).wait().metrics.residual_rms

    peers = [
        Peer("this program, XLA scan", size, own("scan")),
        Peer("closed form, SciPy solve_ivp (DOP853)", 1, by_scipy(work)),
        Peer("autodiff Lagrangian, RK4 in a scan, vmap", 8, by_lagrangian(work, 8)),
    ]
    if is_available():
        peers.append(Peer(KERNEL, size, own("kernel")))
    else:
        report("no traced kernel: it needs the package llvmlite")
    try:
        peers.append(Peer("closed form, diffrax Tsit5, vmap", 8, by_diffrax(work, 8)))
    except ImportError:
        report("no diffrax: install flexlink-studies[peers]")
    compiler = shutil.which("gcc") or shutil.which("clang")
    if compiler:
        width, run = best_c(work, compiler)
        peers.append(Peer(f"{C}, RK4, vectors of {width}", size, run))
    else:
        report("no hand-written C: needs gcc or clang")
    return peers


# --- closed form with other integrators ----------------------------------------------------------


def _slopes(structure: Structure, start: Start, time: Any, state: PlantState) -> PlantState:
    """Time derivative of the plant; the reference is a parabola over each sample."""
    k = jnp.clip(jnp.floor(time / PERIOD + 1e-9).astype(int), 0, structure.n_steps - 1)
    x = time / PERIOD - k
    weights = jnp.array([(1 - x) * (1 - 2 * x), 4 * x * (1 - x), x * (2 * x - 1)])
    inputs = start.inputs
    reference_input = Reference(
        weights @ inputs.rho[k], weights @ inputs.rho_rate[k], None, inputs.disturbance[k]
    )
    rates = plant_rates(
        structure, start.loop, state, reference_input, jnp.zeros((3, 3))
    ).acceleration
    plant = start.loop.plant
    own = (plant.stiffness * state.q + plant.damping * state.q_rate) / plant.modal_mass[:, None]
    return PlantState(
        pose=state.pose_rate,
        pose_rate=rates.pose,
        q=state.q_rate,
        q_rate=rates.coupling - own,
        z=None,
        z_rate=None,
    )


def _rms(start: Start, q: Any) -> Any:
    """Residual rms from modal coordinates at all samples, (n, 3, R)."""
    weight = start.inputs.window.is_residual
    deflection = jnp.einsum("isr,nir->nis", start.loop.deflection_at, q)
    return jnp.sqrt(jnp.einsum("n,nis->is", weight, deflection**2) / jnp.sum(weight))


def by_diffrax(work: Work, n: int) -> Callable[[], Any]:
    """diffrax with a constant step of one sample."""
    import diffrax

    structure, cases = work.structure, work.first(n)

    def one(case: Case) -> Any:
        start = begin(structure, case)
        count = structure.n_steps
        solution = diffrax.diffeqsolve(
            diffrax.ODETerm(lambda t, y, _: _slopes(structure, start, t, y)),
            diffrax.Tsit5(),
            0.0,
            count * PERIOD,
            PERIOD,
            start.state.plant,
            saveat=diffrax.SaveAt(ts=PERIOD * jnp.arange(count), fn=lambda t, y, _: y.q),
            stepsize_controller=diffrax.ConstantStepSize(),
            max_steps=count + 2,
        )
        return _rms(start, solution.ys)

    return partial(jax.jit(jax.vmap(one)), cases)


def by_scipy(work: Work) -> Callable[[], Any]:
    """SciPy's integrator, adaptive steps, slopes compiled by JAX."""
    from scipy.integrate import solve_ivp

    structure = work.structure
    case = jax.tree.map(lambda x: x[0], work.first(1))
    start = jax.jit(begin, static_argnums=0)(structure, case)
    flat, whole = ravel_pytree(start.state.plant)

    @jax.jit
    def slope(time: Any, y: Any) -> Any:
        return ravel_pytree(_slopes(structure, start, time, whole(y)))[0]

    def run() -> Any:
        times = PERIOD * np.arange(structure.n_steps)
        solution = solve_ivp(
            lambda t, y: np.asarray(slope(t, y)),
            (0.0, times[-1]),
            np.asarray(flat),
            "DOP853",
            times,
            rtol=TOLERANCES[0],
            atol=TOLERANCES[1],
        )
        return _rms(start, jax.vmap(whole)(jnp.asarray(solution.y.T)).q)[None]

    return run


# --- plain equations ------------------------------------------------------------------------------


def by_lagrangian(work: Work, n: int) -> Callable[[], Any]:
    """Accelerations from the Lagrangian by automatic differentiation, classical Runge-Kutta."""
    structure, cases = work.structure, work.first(n)

    def one(case: Case) -> Any:
        start, machine = begin(structure, case), case.machine
        basis = build_basis(
            structure.basis, machine.beam, machine.patches, structure.n_modes, station_places(case)
        )
        if not structure.is_distributed:
            basis = basis._replace(inward=None, centrifugal=None)
        loop = start.loop
        mass, drive = loop.plant.modal_mass[:, None], loop.drive

        def slope(at: reference.RigidState, references: tuple[Any, ...]) -> reference.RigidState:
            rho, rho_rate = references
            place = partial(reference.close, machine, basis)
            (now, _), (rate, _) = jax.jvp(place, (at.pose, at.q), (at.pose_rate, at.q_rate))
            force = drive.kp * (rho - now) + drive.kd * (rho_rate - rate)
            force = jnp.clip(force, -drive.force_limit, drive.force_limit)
            voltage = ideal_voltage(structure, loop, at.q, at.q_rate)
            modal = mass * jnp.einsum("irk,ik->ir", loop.actuator, voltage)
            loads = reference.Loads(force, modal)
            pose, q = reference.by_lagrangian(machine, basis, at, loads)
            return reference.RigidState(at.pose_rate, pose, at.q_rate, q)

        def body(at: reference.RigidState, references: tuple[Any, ...]) -> tuple[Any, ...]:
            points = [(references[0][k], references[1][k]) for k in range(3)]
            return reference.rk4_step(slope, at, PERIOD, points), at.q

        plant = start.state.plant
        first = reference.RigidState(plant.pose, plant.pose_rate, plant.q, plant.q_rate)
        kept: Any = jax.lax.scan(body, first, (start.inputs.rho, start.inputs.rho_rate))[1]
        return _rms(start, kept)

    return partial(jax.jit(jax.vmap(one)), cases)


# --- C --------------------------------------------------------------------------------------------


#: Cases in a vector of the C program: what registers of 16, 32 and 64 bytes hold.
WIDTHS = (2, 4, 8)


def best_c(work: Work, compiler: str) -> tuple[int, Callable[[], Any]]:
    """The C program with the vectors that suit this processor best, and their width."""
    runs = {width: by_c(work, compiler, width) for width in WIDTHS}
    seconds = {width: timed(run, 1)[1].seconds for width, run in runs.items()}
    width = min(seconds, key=lambda width: seconds[width])
    return width, runs[width]


def by_c(work: Work, compiler: str, width: int) -> Callable[[], Any]:
    """`w0.c` with vectors of so many cases, a thread for every device."""
    structure = work.structure
    each = jax.jit(jax.vmap(partial(_ideal, structure)))(work.first(work.layout.size))
    start = jax.jit(begin, static_argnums=0)(structure, jax.tree.map(lambda x: x[0], work.first(1)))
    plant, drive, n = start.loop.plant, start.loop.drive, structure.n_steps
    fields = (
        plant.legs.ux,
        plant.legs.uy,
        plant.joint_cos,
        plant.joint_sin,
        plant.legs.s0,
        plant.legs.h0,
        plant.length,
        plant.slider_link_mass,
        plant.tip_mass,
        plant.inertia,
        plant.platform_mass,
        plant.platform_inertia,
        plant.modal_mass,
        plant.stiffness,
        plant.damping,
        plant.b,
        plant.c,
        plant.shortening,
        start.loop.actuator,
        start.loop.deflection_at,
        *(np.broadcast_to(x, (3,)) for x in (drive.kp, drive.kd, drive.force_limit)),
        start.loop.controller.voltage_limit,
    )
    machine = np.concatenate([np.ravel(x) for x in fields])
    inputs = np.ascontiguousarray(np.stack([start.inputs.rho, start.inputs.rho_rate], axis=2))
    weight = np.asarray(start.inputs.window.is_residual)
    pose = np.asarray(start.state.plant.pose)
    home = np.array([*pose, pose[2], np.sin(pose[2]), np.cos(pose[2])])
    gains = [_align(g.T) for g in np.asarray(each).reshape(-1, width, 27)]
    function = _compile(compiler, width)
    pool = ThreadPoolExecutor(len(jax.local_devices()))

    def group(gain: np.ndarray) -> np.ndarray:
        square = _align(np.zeros((9, width)))
        arrays = (inputs, weight, home, gain, square)
        function(machine.ctypes.data, n, ctypes.c_double(PERIOD), *(x.ctypes.data for x in arrays))
        return square.T.reshape(width, 3, 3)

    def run() -> Any:
        return np.sqrt(np.concatenate(list(pool.map(group, gains))) / weight.sum())

    return run


def _ideal(structure: Structure, case: Case) -> Any:
    """Voltages of modal velocities [V s/m], (3, K, R)."""
    ideal = begin(structure, case).loop.ideal
    assert ideal is not None
    return ideal[0]


def _align(array: np.ndarray) -> np.ndarray:
    """A copy aligned to 64 bytes."""
    room = np.empty(array.size + 8)
    skip = -room.ctypes.data % 64 // 8
    copy = room[skip : skip + array.size].reshape(array.shape)
    copy[...] = array
    return copy


def _compile(compiler: str, width: int) -> Any:
    """The function `run` of `w0.c`."""
    source = Path(__file__).with_name("w0.c")
    with tempfile.TemporaryDirectory() as folder:
        library = Path(folder) / "w0.so"
        subprocess.run(
            [
                compiler,
                "-O3",
                "-march=native",
                f"-DWIDTH={width}",
                "-ffp-contract=fast",
                "-fno-math-errno",
                "-Wno-psabi",
                "-shared",
                "-fPIC",
                "-o",
                str(library),
                str(source),
            ],
            check=True,
            capture_output=True,
            timeout=120,
        )
        function = ctypes.CDLL(str(library)).run
    address = ctypes.c_void_p
    function.argtypes = [address, ctypes.c_long, ctypes.c_double, *[address] * 5]
    function.restype = None
    return function


if __name__ == "__main__":
    config.configure()
    with full_effort():
        for row in bench_peers(print):
            print(
                f"{row.peer}: {row.configs_per_s:.3g} configurations/s, error {row.error:.1e}, "
                f"{row.times_slower:.3g} times slower"
            )
