"""Random designs for proofs, and their eigenvalues with very many modes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import scipy.sparse.linalg

from jaxmodel import sampled_loop
from jaxmodel.linear import linearise, resting
from jaxmodel.loop import coordinate_omega
from jaxmodel.loop_figures import HIGHEST
from jaxmodel.prepare import prepare
from studies.engine.controller import fixed_controller
from studies.engine.stability import gain_margin
from studies.errors import StudyError
from studies.spillover.plants import LoopBuilder, PlantVariant, pad_channels, plant_structure
from studies.spillover.proofs import collect
from tests.bare import paper_study

ONE_MOVE = paper_study().change(link__modes=3, motion__waypoints=paper_study().motion.waypoints[:2])


def random_design(seed):
    """A design with patches, links, damping, electronics and law drawn at random.

    Its gains are such that the plant with 12 modes has a gain margin from 1.2 to 4.
    """
    rng = np.random.default_rng(seed)
    for _ in range(100):
        try:
            design = fixed_controller(_random_study(rng))
            law = pad_channels(design.controller, design.n_patches)
            loop = LoopBuilder(design).loop(PlantVariant("pinned_pinned", 12), law)
            margin = gain_margin(loop.poles)
            if not 0 < margin < HIGHEST:
                continue
            factor = margin / rng.uniform(1.2, 4.0) * design.study.control.gain_factor
            return fixed_controller(design.study.change(control__gain_factor=float(factor)))
        except StudyError:  # patches overlap, ...
            continue
    raise AssertionError("no design can run")


def _random_study(rng):
    rate = float(rng.choice([10e3, 20e3]))
    law = str(rng.choice(["imsc", "imsc", "srf"]))
    changes = {"control__modes": int(rng.integers(2, 4))} if law == "imsc" else {}
    return ONE_MOVE.change(
        control__law=law,
        patches__centers=tuple(np.sort(rng.uniform(0.02, 0.18, 3)).round(4).tolist()),
        electronics__sample_rate_hz=rate,
        electronics__antialias_hz=float(rate * rng.uniform(0.12, 0.3)),
        link__thickness=float(rng.uniform(1.5e-3, 3e-3)),
        link__damping_ratio=float(10 ** rng.uniform(-2.3, -1.5)),
        motion__waypoints=((*rng.uniform(-0.01, 0.01, 2).tolist(), float(np.pi / 6)),),
        **changes,
    )


def many_modes_loop(design, n_modes):
    """Open loop and what the gains add with that many modes a link, (m, m) each.

    Plant and filters are discretised by eigenvectors, in coordinates of one size (q omega_j, q'),
    in which very high modes cost no digits.
    """
    law = pad_channels(design.controller, design.n_patches)
    a, b, c, d = collect(design, law, "pinned_pinned", 12).law
    structure = plant_structure(design, "pinned_pinned", n_modes)
    case = design.case._replace(
        initial=design.case.initial._replace(modal=np.zeros((3, n_modes))),
        n_modes=jnp.asarray(n_modes),
    )
    pose = np.array(design.study.motion.waypoints[0], float)
    state, enters, filtered, omega = (np.asarray(x) for x in _analogue(structure, case, pose))
    n, inputs, period = len(state), len(d), float(case.electronics.period)
    scale = np.ones(n)
    rates = 6 + omega.size
    scale[6:rates] = 1 / omega.ravel()
    corner, filters = float(case.electronics.antialias), rates + omega.size
    scale[filters:] = np.repeat([1.0, corner], inputs)[: n - filters]
    scale[3:6] = 100.0
    rate, shape = np.linalg.eig(state / scale[:, None] * scale)
    inward = np.linalg.inv(shape)
    transition = ((shape * np.exp(rate * period)) @ inward).real
    share = np.expm1(rate * period) / rate
    exact = np.hstack([transition, ((shape * share) @ (inward @ (enters / scale[:, None]))).real])
    y = np.zeros((inputs, n))
    y[np.arange(inputs), filtered] = scale[filtered]
    by_law = np.block([[b[:, :inputs] @ y, b[:, inputs:], a]])
    after = np.block([[d[:, :inputs] @ y, d[:, inputs:], c]])
    plant = np.hstack([exact, np.zeros((n, len(a)))])
    size = n + inputs + len(a)
    without = np.vstack([plant, np.zeros((inputs, size)), by_law])
    gains = np.vstack([np.zeros((n, size)), after, np.zeros((len(a), size))])
    return without, gains


@partial(jax.jit, static_argnums=0)
def _analogue(structure, case, pose):
    loop = prepare(structure, case).loop
    plant = linearise(structure, loop, pose, resting(structure, case))
    whole = sampled_loop.analogue_plant(structure, plant, case)
    inputs = whole.enters.shape[1] - 3
    filtered = jnp.arange(whole.state.shape[0])[whole.filtered]
    return whole.state, whole.enters[:, :inputs], filtered, coordinate_omega(loop)


def spectral_radius(matrix):
    """Largest modulus, by Arnoldi's method."""
    value = scipy.sparse.linalg.eigs(
        matrix,
        k=24,
        ncv=150,
        return_eigenvectors=False,
        tol=1e-10,
        maxiter=3000,
        v0=np.random.default_rng(0).normal(size=len(matrix)),
    )
    return float(np.abs(value).max())
