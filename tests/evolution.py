"""A reference for searches: CMA-ES after Hansen, The CMA evolution strategy: a tutorial (2016)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np


def cma_es(
    cost: Callable[[np.ndarray], float], start: np.ndarray, sigma: float, count: int, seed: int
) -> np.ndarray:
    """The best point seen among `count` evaluations of a cost, from a start and a step size."""
    rng, n = np.random.default_rng(seed), len(start)
    size = 4 + int(3 * np.log(n))
    weight = np.log((size + 1) / 2) - np.log(np.arange(1, size // 2 + 1))
    weight /= weight.sum()
    mu = 1 / np.sum(weight**2)
    c_sigma = (mu + 2) / (n + mu + 5)
    d_sigma = 1 + 2 * max(0.0, np.sqrt((mu - 1) / (n + 1)) - 1) + c_sigma
    c_c = (4 + mu / n) / (n + 4 + 2 * mu / n)
    c_1 = 2 / ((n + 1.3) ** 2 + mu)
    c_mu = min(1 - c_1, 2 * (mu - 2 + 1 / mu) / ((n + 2) ** 2 + mu))
    expected = np.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n**2))
    mean, covariance = np.array(start, float), np.eye(n)
    path_sigma, path_c = np.zeros(n), np.zeros(n)
    best, least = mean, np.inf
    for generation in range(1, count // size + 1):
        scale, basis = np.linalg.eigh(covariance)
        scale = np.sqrt(np.maximum(scale, 1e-20))
        step = rng.normal(size=(size, n)) * scale @ basis.T
        costs = np.array([cost(mean + sigma * y) for y in step])
        order = np.argsort(costs)
        if costs[order[0]] < least:
            best, least = mean + sigma * step[order[0]], costs[order[0]]
        step = step[order[: len(weight)]]
        move = weight @ step
        mean = mean + sigma * move
        path_sigma = (1 - c_sigma) * path_sigma + np.sqrt(c_sigma * (2 - c_sigma) * mu) * (
            basis @ ((move @ basis) / scale)
        )
        size_sigma = np.linalg.norm(path_sigma)
        is_short = size_sigma / np.sqrt(1 - (1 - c_sigma) ** (2 * generation)) < (
            (1.4 + 2 / (n + 1)) * expected
        )
        path_c = (1 - c_c) * path_c + is_short * np.sqrt(c_c * (2 - c_c) * mu) * move
        late = (1 - is_short) * c_c * (2 - c_c)
        covariance = (
            (1 - c_1 - c_mu + c_1 * late) * covariance
            + c_1 * np.outer(path_c, path_c)
            + c_mu * (step.T * weight) @ step
        )
        sigma *= np.exp(c_sigma / d_sigma * (size_sigma / expected - 1))
    return best
