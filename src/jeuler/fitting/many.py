"""Errors of hundreds to thousands of unknowns: from the Gram matrix of the Jacobian, where its factors take too long.

A singular value decomposition of 26,000 rows and 2,000 columns takes minutes, its Gram matrix seconds. What that costs:
directions that change the residual by less than a millionth of what the strongest does count as not determined.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jeuler.fitting.evaluate import Evaluate
from jeuler.fitting.least_squares import column_norms
from jeuler.fitting.uncertainty import (
    MOST_LAGS,
    Directions,
    Noise,
    Series,
    Uncertainty,
    autoregression,
    both_sides,
    parts_of,
    with_covariances,
)

MOST_ERRORS = 3_000  # unknowns up to which a fit computes all errors by itself
MOST_BYTES = 2**29  # of their Jacobian
WORST = 1e10  # condition of the Gram matrix up to which its inverse is taken as it is
UNSEEN = 1e-12  # share of its largest eigenvalue below which one is rounding
SIGNS = 100_000  # random signs that estimate a trace over all residuals
LONGEST = 2_000  # samples of a series for which the covariance of its noise is factored


def uncertainty_of_many(
    jacobian: np.ndarray,
    residual: np.ndarray,
    curvature: np.ndarray,
    counted: np.ndarray,
    series: Series,
    absolute: bool,
    fixed: int = 0,
) -> Uncertainty:
    """As `uncertainty`, from A = J^T diag(curvature) J itself."""
    m, n = jacobian.shape
    norms = column_norms(jacobian)
    norms = np.where(norms > 0, norms, 1)
    squares = bool((curvature == 1).all())
    gram = (jacobian.T if squares else jacobian.T * curvature) @ jacobian / norms / norms[:, None]
    inverse, d = _inverse_of(gram, norms)
    plain = inverse / norms / norms[:, None]
    rank = int(np.sum(d.seen))
    freedom = int(np.sum(counted)) - rank
    enough = freedom > 0
    variance = float(np.sum(residual**2)) / max(freedom, 1)
    plain_gram = gram if squares else jacobian.T @ jacobian / norms / norms[:, None]
    by_squares = inverse if squares else _inverse_of(plain_gram, norms)[0]
    size = (1.0 if absolute else variance) / norms / norms[:, None]
    white = size * (inverse if squares else inverse @ plain_gram @ inverse)

    def left_over(z: np.ndarray) -> np.ndarray:
        """What a least-squares fit leaves of residuals z, (m, k)."""
        return z - jacobian @ ((by_squares @ (jacobian.T @ z / norms[:, None])) / norms[:, None])

    some = slice(0, m - fixed)
    gamma = autocovariances_by_signs(residual, counted, left_over, series, n, fixed=fixed)
    noise = autoregression(gamma, np.sum(counted), np)
    if noise.order == 0 or not enough:
        found = with_covariances(white, white, gamma, enough, d, n, absolute, variance, np)
        return found._replace(inverse=plain)
    unit = 1 / gamma[0] if absolute and gamma[0] > 0 else 1.0
    filtered = coloured(jacobian[some], noise, series)
    meat = unit * (filtered.T @ filtered) + jacobian[m - fixed :].T @ jacobian[m - fixed :]
    half = inverse / norms[:, None]
    correlated = half @ (meat / norms / norms[:, None]) @ half.T
    found = with_covariances(correlated, white, gamma, enough, d, n, absolute, variance, np)
    return found._replace(inverse=plain)


def _inverse_of(gram: np.ndarray, norms: np.ndarray) -> tuple[np.ndarray, Directions]:
    """The inverse of a Gram matrix over the directions that are seen, and these."""
    n = len(gram)
    everything = np.ones(n, bool)
    try:
        np.linalg.cholesky(gram)
        inverse = np.linalg.inv(gram)
        if np.linalg.norm(gram) * np.linalg.norm(inverse) <= WORST:
            return inverse, Directions(norms, np.ones(n), np.eye(n), everything, None)
    except np.linalg.LinAlgError:
        pass
    values, vectors = np.linalg.eigh(gram)
    seen = values > UNSEEN * values.max(initial=0)
    inverse = (vectors[:, seen] / values[seen]) @ vectors[:, seen].T
    return inverse, Directions(norms, np.sqrt(np.maximum(values, 0)), vectors, seen, None)


def autocovariances_by_signs(
    residual: np.ndarray,
    counted: np.ndarray,
    left_over: Callable[[np.ndarray], np.ndarray],
    series: Series,
    n: int,
    *,
    fixed: int,
    most_lags: int = MOST_LAGS,
    least: int = 4,
) -> np.ndarray:
    """As `autocovariances` for n unknowns, with traces estimated by random signs z:

    tr(U_h M V_j M) = E[(M U_h z)^T V_j M z]

    Source: M. F. Hutchinson, A stochastic estimator of the trace of the influence matrix, 1990.
    """
    m, longest = len(residual), max((times for times, _ in series), default=0)
    lags = max(0, min(most_lags, (m - n - 2) // 5, longest // 5))
    some = slice(0, m - fixed)
    kept = np.where(counted, residual, 0)[some, None]
    probes = int(np.clip(SIGNS // m, least, 64))
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(m, probes)) * counted[:, None]
    signs[m - fixed :] = 0

    def shifted(x: np.ndarray, h: int) -> np.ndarray:
        found = np.zeros_like(x)
        moved = [both_sides(part, h, np).reshape(-1, x.shape[1]) for part in parts_of(x[some], series)]
        found[some] = np.concatenate(moved) * counted[some, None]
        return found

    moved = [shifted(signs, h) for h in range(lags + 1)]
    left, *lefts = np.split(left_over(np.concatenate([signs, *moved], axis=1)), lags + 2, axis=1)
    rows, seen = [], []
    for h, mine in enumerate(lefts):
        half = 0.5 if h else 1.0
        rows.append([half * float(np.sum(mine * shifted(left, j))) / probes for j in range(lags + 1)])
        whole = np.zeros((m, 1))
        whole[some] = kept
        seen.append(half * float(np.sum(kept * shifted(whole, h)[some])))
    try:
        gamma = np.linalg.solve(np.array(rows), np.array(seen))
    except np.linalg.LinAlgError:
        gamma = np.zeros(lags + 1)
    return gamma if gamma[0] > 0 else np.array(seen) / max(np.sum(counted), 1)


def coloured(values: np.ndarray, noise: Noise, series: Series) -> np.ndarray:
    """L^T X along each series, for the covariance L L^T of the noise: X^T S X is then a Gram matrix, (m, k)."""
    from scipy.linalg import toeplitz
    from scipy.signal import lfilter

    found = []
    for part in parts_of(values, series):
        times = len(part)
        flat = part.reshape(times, -1)
        if times <= LONGEST:
            share, _ = noise.spectrum(4 * times + 1024, np)
            share = share * (2 * times + 512)
            share[[0, -1]] *= 2
            factor = np.linalg.cholesky(toeplitz(np.fft.irfft(share)[:times]))
            out = factor.T @ flat
        else:  # L as the filter itself: what differs is the first samples
            feedback = np.concatenate([[1.0], -np.asarray(noise.coefficients)])
            out = lfilter([np.sqrt(noise.innovation)], feedback, flat[::-1], axis=0)[::-1]
        found.append(out.reshape(-1, *values.shape[1:]))
    return np.concatenate(found) if found else values


def weighted_jacobian(evaluate: Evaluate, x: np.ndarray, data: Any, weights: np.ndarray) -> np.ndarray:
    """The Jacobian of the weighted residual, (m, n); rows of weight 0 are 0, whatever the residual is there."""
    with np.errstate(all="ignore"):
        jacobian = evaluate.at(x, data)[1]()
        jacobian[weights == 0] = 0
        jacobian *= weights[:, None]
    return jacobian
