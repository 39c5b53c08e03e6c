"""Attribution as a cooperative game whose players are controlled links, or links and modes.

A game is an array of values over all subsets: axis of length 2^n, player p is in subset number s
where bit p of s is set. The value is the vibration that controlling that subset removes. Use mean
squares: those of uncoupled modes add up, so any remaining interaction is coupling.
"""

from __future__ import annotations

import numpy as np


def dividends(value: np.ndarray) -> np.ndarray:
    """What each subset adds to all its parts together, d(S) = sum over T in S (-1)^|S-T| v(T).

    Args:
        value: of every subset, (..., 2^n).

    Returns:
        Harsanyi dividends in the unit of the value, (..., 2^n); v(S) is their sum over all T in S.
    """
    count = _players(value)
    result = np.array(value, float)
    for player in range(count):
        halves = result.reshape(*result.shape[:-1], -1, 2, 2**player)
        halves[..., 1, :] -= halves[..., 0, :]
    return result


def shapley(value: np.ndarray) -> np.ndarray:
    """Shapley shares: each dividend split evenly among those who earn it (Shapley 1953).

    Args:
        value: of every subset, (..., 2^n).

    Returns:
        Share of every player in the unit of the value, (..., n); their sum is v(all) - v(none).
    """
    member, size = _members(_players(value))
    return dividends(value) @ (member / np.maximum(size, 1)[:, None])


def interaction(value: np.ndarray) -> np.ndarray:
    """Shapley interaction index of pairs, sum over S with both of d(S)/(|S| - 1).

    Positive where two players achieve more together than separately (Grabisch and Roubens 1999).

    Args:
        value: of every subset, (..., 2^n).

    Returns:
        In the unit of the value, (..., n, n), symmetric; zero on the diagonal.
    """
    count = _players(value)
    member, size = _members(count)
    weighted = dividends(value) / np.maximum(size - 1, 1)
    pairs = np.einsum("...s,sp,sq->...pq", weighted, member, member)
    return pairs * (1 - np.eye(count))


def effects(residual: np.ndarray) -> np.ndarray:
    """Change of each residual when one player alone is controlled, as in Table 1.

    Args:
        residual: of every subset, (2^n, k), k residuals each.

    Returns:
        Relative change against no control [1], (n, k).
    """
    alone = residual[2 ** np.arange(_players(residual[:, 0]))]
    return alone / residual[0] - 1


def _players(value: np.ndarray) -> int:
    count = int(value.shape[-1]).bit_length() - 1
    if 2**count != value.shape[-1]:
        raise ValueError(f"{value.shape[-1]} values; allowed: 2^n, one per subset of n players")
    return count


def _members(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Which players each subset has, (2^n, n), and how many, (2^n,)."""
    member = (np.arange(2**count)[:, None] >> np.arange(count)) & 1
    return member.astype(float), member.sum(axis=1)
