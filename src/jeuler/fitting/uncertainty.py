"""How well the data determine what was fitted: covariance from the Jacobian at the best point."""

from __future__ import annotations

import numpy as np


def covariance(jacobian: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the unknowns for independent, equal noise in each residual, and which are not determined.

        C = s^2 (J^T J)^-1,   s^2 = sum r^2 / (m - n)

    An unknown that takes part in a direction which does not change the residual (to roundoff) is not determined: its
    variance is inf and its covariances are 0. The others' are computed with such directions left out.

    Args:
      jacobian: d residual / d unknown, (m, n).
      residual: at the best point, (m,).
    Returns: the covariance (n, n) and a boolean mask (n,), True where not determined.
    Source: G. A. F. Seber, C. J. Wild, Nonlinear Regression, 1989, sect. 2.1.2 and 5.1.
    """
    noise = 1e3 * np.finfo(jacobian.dtype).eps  # the roundoff of a simulation is far above that of one operation
    jacobian, residual = np.asarray(jacobian, float), np.asarray(residual, float)
    m, n = jacobian.shape
    norms = np.linalg.norm(jacobian, axis=0)
    silent = norms <= noise * norms.max(initial=0)
    scaled = jacobian / np.where(silent, 1, norms)
    scaled[:, silent] = 0
    values, vectors = np.linalg.eigh(scaled.T @ scaled)
    null = values <= max(noise**2, 1e-14 * n)
    participation = np.sqrt(np.sum(vectors[:, null] ** 2, axis=1))
    undetermined = silent | (participation > 1e-3)
    inverse = (vectors[:, ~null] / values[~null]) @ vectors[:, ~null].T
    inverse /= np.outer(np.where(silent, 1, norms), np.where(silent, 1, norms))
    freedom = m - int(np.sum(~null))
    if freedom <= 0:  # as many unknowns as data: nothing is left over to tell the noise from
        return np.diag(np.full(n, np.inf)), undetermined
    result = inverse * np.sum(residual**2) / freedom
    result[undetermined, :] = 0
    result[:, undetermined] = 0
    result[undetermined, undetermined] = np.inf
    return result, undetermined
