"""Samples of the parameters, as probable as the data and what is known beforehand make them.

Before the data, every place between the bounds is as likely as any other, on the scale of the
bounds, unless mean and sigma say more.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import scipy

from studies.errors import StudyError
from studies.fitting.problem import Problem
from studies.fitting.statistics import Answer

#: Chains; steps that are thrown away while their length adapts: this share, and this many at least.
CHAINS, WARM_UP, WARM_STEPS = 4, 0.25, 50
#: Least eigenvalue of a precision over its largest [1].
NARROW = 1e-14
#: Share of steps that are best accepted [1] (Roberts and Rosenthal 1998).
ACCEPTED = 0.574


class Posterior(NamedTuple):
    """Samples of all chains, one after another."""

    places: np.ndarray  # between the bounds [1], (n, p)
    values: np.ndarray  # in the study's units, (n, p)
    reduction: np.ndarray  # by how much longer chains may still shrink their scatter [1], (p,)
    effective: np.ndarray  # independent samples they are worth, (p,)

    @property
    def is_settled(self) -> bool:
        """Whether the chains agree."""
        return bool(np.all(self.reduction < 1.05))


class Shape(NamedTuple):
    """A normal distribution about as wide as the posterior, of the places' logits v.

    In them the bounds are at infinity: u = 1/(1 + exp(-v)).
    """

    middle: np.ndarray  # (p,)
    root: np.ndarray  # of the covariance, (p, p)

    def draw(self, count: int, seed: int) -> np.ndarray:
        """Places between the bounds, (n, p)."""
        z = np.random.default_rng(seed).normal(size=(count, len(self.middle)))
        return np.asarray(scipy.special.expit(self.middle + z @ self.root.T))

    def log_density(self, u: np.ndarray) -> np.ndarray:
        """Logarithm of the density of places between the bounds, (n, p), up to a constant."""
        v = scipy.special.logit(u)
        z = np.linalg.solve(self.root, (v - self.middle).T)
        return -0.5 * np.sum(z**2, axis=0) - np.sum(_log_width(v), axis=1)


def shape(answer: Answer) -> Shape:
    """Shape of the posterior, from the model's derivatives at the optimum."""

    def cost(v: np.ndarray) -> tuple[float, np.ndarray]:
        u = scipy.special.expit(v)
        away = u - answer.place
        pull = answer.information @ away
        value = answer.gradient @ away + 0.5 * away @ pull - np.sum(_log_width(v))
        return float(value), (answer.gradient + pull) * u * (1 - u) - (1 - 2 * u)

    start = scipy.special.logit(np.clip(answer.place, 0.02, 0.98))
    middle = scipy.optimize.minimize(cost, start, jac=True, method="BFGS").x
    u = scipy.special.expit(middle)
    width = u * (1 - u)
    # the second derivatives of u by v, times the slope of the cost by u, which the width balances
    bend = (1 - 2 * u) ** 2 + 2 * width
    precision = width[:, None] * answer.information * width + np.diag(bend)
    size, axes = np.linalg.eigh(precision)
    size = np.maximum(size, NARROW * size.max())  # beyond the digits there are
    return Shape(middle, axes / np.sqrt(size))


def _log_width(v: np.ndarray) -> np.ndarray:
    """Logarithm of du/dv."""
    return -np.logaddexp(0, v) - np.logaddexp(0, -v)


def sample(problem: Problem, about: Shape, count: int, seed: int) -> Posterior:
    """Draw from the posterior by BlackJAX's Metropolis-adjusted Langevin algorithm.

    Args:
        problem: what was fitted.
        about: where chains start, and how far they step.
        count: samples, of all chains.
        seed: of the chains.

    Raises:
        StudyError: BlackJAX is not installed.
    """
    blackjax = load_blackjax()
    import jax
    import jax.numpy as jnp

    density, kernel = log_density(problem, about), blackjax.mala.build_kernel()
    rng = np.random.default_rng(seed)
    size, each = len(about.middle), -(-count // CHAINS)
    warm, chains = max(int(WARM_UP * each), min(WARM_STEPS, 5 * each)), []
    for _ in range(CHAINS):
        step, draws = 0.9 * size ** (-1 / 3), []
        state = blackjax.mala.init(jnp.asarray(rng.normal(size=size)), density)
        for k in range(warm + each):
            key = jax.random.key(int(rng.integers(2**31)))
            state, info = kernel(key, state, density, step)
            if k < warm:
                step *= float(np.exp((float(info.acceptance_rate) - ACCEPTED) / np.sqrt(1 + k)))
            else:
                draws.append(np.asarray(state.position))
        chains.append(draws)
    walked = np.array(chains)  # (chains, n, p)
    places = scipy.special.expit(about.middle + walked.reshape(-1, size) @ about.root.T)[:count]
    logits = walked @ about.root.T
    return Posterior(
        places=places,
        values=problem.free.values(places),
        # one number comes without its axis
        reduction=np.reshape(blackjax.diagnostics.potential_scale_reduction(logits), size),
        effective=np.reshape(blackjax.diagnostics.effective_sample_size(logits), size),
    )


def load_blackjax() -> Any:
    """BlackJAX, which is an extra.

    Raises:
        StudyError: it is not installed.
    """
    try:
        import blackjax
    except ImportError:
        raise StudyError(
            "fit.samples: drawing samples needs blackjax; install the extra 'posterior'"
        ) from None
    return blackjax


def log_density(problem: Problem, about: Shape) -> Any:
    """Logarithm of the posterior, by standard normal numbers (p,) that `about` turns into logits.

    A function that JAX differentiates, but does not compile.
    """
    import jax
    import jax.numpy as jnp

    def both(z: Any) -> tuple[float, np.ndarray]:
        v = about.middle + about.root @ np.asarray(z)
        u = scipy.special.expit(v)
        try:
            parts = problem.parts(problem.free.values(u), True)
        except (StudyError, np.linalg.LinAlgError):
            return -np.inf, np.zeros(len(v))
        residual = problem.stacked(parts)
        slope = -residual @ problem.stacked_slopes(parts, u) * u * (1 - u) + 1 - 2 * u
        value = -0.5 * float(residual @ residual) + float(np.sum(_log_width(v)))
        return value, slope @ about.root

    @jax.custom_vjp
    def density(z: Any) -> Any:
        return jnp.asarray(both(z)[0])

    def forward(z: Any) -> tuple[Any, Any]:
        value, slope = both(z)
        return jnp.asarray(value), jnp.asarray(slope)

    density.defvjp(forward, lambda slope, along: (along * slope,))
    return density
