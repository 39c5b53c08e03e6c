"""Poles of a loop from how it rings: eigensystem realisation of its recorded signals."""

from __future__ import annotations

import numpy as np

#: Singular values below this share of the largest are noise [1].
NOISE = 1e-6
#: Block rows of the Hankel matrix [samples].
DEPTH = 60


def ringing_poles(signals: np.ndarray, depth: int = DEPTH, noise: float = NOISE) -> np.ndarray:
    """Discrete poles in a free response, by amplitude at its end.

    The signals' Hankel matrix H_0 = U S V^t, shifted H_1: A = S^-1/2 U^t H_1 V S^-1/2 (Juang and
    Pappa 1985).

    Args:
        signals: from some sample after the last excitation on, (T, n).
        depth: samples in a block column.
        noise: see `NOISE`.

    Returns:
        poles per sample [1], those of the largest amplitude at the end first.
    """
    count = len(signals) - depth
    rows = np.stack([signals[k : k + count] for k in range(depth + 1)])  # (depth + 1, count, n)
    before = rows[:-1].transpose(0, 2, 1).reshape(-1, count)
    after = rows[1:].transpose(0, 2, 1).reshape(-1, count)
    left, size, right = np.linalg.svd(before, full_matrices=False)
    kept = size > noise * size[0]
    left, size, right = left[:, kept], size[kept], right[kept]
    transition = (left.T @ after @ right.T) / size
    value, vector = np.linalg.eig(transition)
    course = np.linalg.lstsq(vector, (size[:, None] * right).astype(complex), rcond=None)[0]
    weight = np.linalg.norm(vector, axis=0) * np.abs(course[:, -1])
    return value[np.argsort(-weight)]
