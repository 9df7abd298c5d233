"""Sparse linear least squares with unknowns that must not be negative."""

from __future__ import annotations

from typing import Any

import numpy as np

MOST_TURNS = 60
DENSE = 500  # unknowns up to which singular values are given
SAMPLE = 12  # of more unknowns than that, those of which the error is computed: a solution for each
UNSEEN = 1e-9  # a column shorter than this share of the longest says nothing


def nonnegative_least_squares(
    matrix: Any, right: np.ndarray, positive: np.ndarray
) -> tuple[np.ndarray, float, np.ndarray | None]:
    """x that minimises |A x - b|^2 with x >= 0 where ``positive``, by exchanging blocks of what is held at 0.

    Args:
      matrix: A, sparse, (row, n).
      right: b, (row,).
      positive: (n,).
    Returns: x, NaN where A has no column to speak of; the median over the unknowns of standard error over size; the
      singular values of A with its columns scaled to one, for up to 500 unknowns.
    Source: J. Kim, H. Park, Fast nonnegative matrix factorization: an active-set-like method and comparisons, 2011.
    """
    from scipy.sparse import diags

    norms = np.sqrt(np.asarray(matrix.multiply(matrix).sum(axis=0)).ravel())
    seen = norms > UNSEEN * norms.max(initial=0)
    scaled = (matrix @ diags(1 / np.where(seen, norms, 1))).tocsc()[:, seen]
    gram, slope = (scaled.T @ scaled).tocsc(), scaled.T @ right
    x, inverse = _exchange(gram, slope, positive[seen])
    freedom = max(len(right) - len(x), 1)
    noise = float(np.sqrt(np.sum((scaled @ x - right) ** 2) / freedom))
    free = x != 0
    with np.errstate(all="ignore"):
        relative = noise * inverse[free] / np.abs(x[free])
    values = None
    if gram.shape[0] <= DENSE:
        values = np.sqrt(np.maximum(np.linalg.eigvalsh(gram.toarray())[::-1], 0))
    full = np.full(len(norms), np.nan)
    full[seen] = x / norms[seen]
    error = float(np.median(relative)) if free.any() else np.inf
    return full, error if np.isfinite(error) else np.inf, values


def _exchange(gram: Any, slope: np.ndarray, positive: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Block principal pivoting; and the roots of the diagonal of the inverse, roughly, for the errors."""
    from scipy.sparse import identity

    n = len(slope)
    ridge = 1e-12 * identity(n, format="csc")
    gram = (gram + ridge).tocsc()
    held = np.zeros(n, bool)
    fewest, patience = n + 1, 3
    x = np.zeros(n)
    for _ in range(MOST_TURNS):
        free = np.flatnonzero(~held)
        factor = _factor(gram[free][:, free]) if len(free) else None
        x = np.zeros(n)
        if factor is not None:
            x[free] = factor.solve(slope[free])
        dual = gram @ x - slope
        wrong = positive & ((~held & (x < 0)) | (held & (dual < -1e-12 * np.abs(slope).max(initial=0))))
        count = int(wrong.sum())
        if not count:
            break
        if count < fewest:
            fewest, patience = count, 3
        elif patience > 0:
            patience -= 1
        else:
            wrong = np.arange(n) == np.flatnonzero(wrong)[-1]
        held ^= wrong
    x = np.where(positive, np.maximum(x, 0), x)
    return x, _inverse_diagonal(factor, free, n)


def _factor(gram: Any) -> Any:
    """Of a symmetric, positive definite matrix, without pivots: the order of its pattern fills in the least."""
    from scipy.sparse.linalg import splu

    return splu(gram, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def _inverse_diagonal(factor: Any, free: np.ndarray, n: int) -> np.ndarray:
    """Roots of the diagonal of the inverse: exact for few unknowns, of a sample of columns for many."""
    root = np.ones(n)
    if factor is None:
        return root
    sample = free if len(free) <= DENSE else free[:: len(free) // SAMPLE]
    position = {k: place for place, k in enumerate(free)}
    rhs = np.zeros((len(free), len(sample)))
    places = np.array([position[k] for k in sample])
    rhs[places, np.arange(len(sample))] = 1
    diagonal = factor.solve(rhs)[places, np.arange(len(sample))]
    values = np.sqrt(np.maximum(diagonal, 0))
    root[:] = float(np.median(values))
    root[sample] = values
    return root
