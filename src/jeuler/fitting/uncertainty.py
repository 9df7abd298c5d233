"""How well the data determine what was fitted: covariance from the Jacobian and the residuals at the best point.

Residuals of real recordings are correlated in time, and independent noise is the wrong model for them: for noise
e_k = 0.9 e_(k-1) + white, errors by the usual formula are 3 to 4 times too small. Here the noise is an autoregressive
process whose order is chosen by an information criterion, and the covariance is that of least squares under such noise.
Why this way: block bootstraps and the kernels of econometrics (Newey-West) cut the correlation off after some lags and
cover too little when it is long; a generalised least squares fit would move the best point, and the user asked for
least squares. Residuals are more alike white noise than the noise was, as the fit follows it; their autocovariances are
corrected for that.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from jeuler.fitting.factors import namespace, singular
from jeuler.fitting.least_squares import column_norms

MOST_LAGS = 8
LARGE = 2**22  # numbers in a Jacobian beyond which a bound on the correlation's effect must do
Series = tuple[tuple[int, int], ...]  # (times, channels) of each part of the residual vector


class Directions(NamedTuple):
    """The singular value decomposition of the Jacobian with its columns scaled to norm one.

    Attributes:
      norms: of the columns, (n,).
      values: singular values, (k,).
      vectors: right singular vectors, (n, k).
      seen: which of them change the residual beyond rounding, (k,).
      left: the left singular vectors, (m, k); None where they were not computed.
    """

    norms: Any
    values: Any
    vectors: Any
    seen: Any
    left: Any

    def null(self) -> np.ndarray:
        """Directions of the parameters that change nothing, (n, k)."""
        if self.seen.all() and len(self.seen) == len(self.norms):
            return np.zeros((len(self.norms), 0))
        vectors = self.vectors[:, self.seen]
        _, _, vt = np.linalg.svd(vectors.T, full_matrices=True)
        return vt[vectors.shape[1] :].T / self.norms[:, None]


class Uncertainty(NamedTuple):
    """What the residual and the Jacobian say about the errors.

    Attributes:
      covariance: of the parameters for correlated noise, (n, n); within what is determined.
      white: the same for independent noise.
      blind: which parameters take part in a direction that does not change the residual, (n,).
      autocorrelation: of the residual at lag one, corrected for the fit, ().
      variance: of the weighted noise, ().
      directions: of the Jacobian.
      inverse: of J^T J, where that was computed, (n, n).
    """

    covariance: Any
    white: Any
    blind: Any
    autocorrelation: Any
    variance: Any
    directions: Directions
    inverse: Any = None


def directions(jacobian: Any, precision: float) -> Directions:
    """The directions of the parameters, and which of them the residual sees.

    Args:
      jacobian: d residual / d parameter, (m, n).
      precision: the unit roundoff of what computed it; a simulation's is taken as 2,000 times that.
    """
    xp = namespace(jacobian)
    norms = column_norms(jacobian)
    norms = xp.where(norms > 0, norms, 1)
    left, values, vectors = singular(jacobian / norms)
    seen = values > 2e3 * precision * xp.max(values, initial=0)
    return Directions(norms, values, vectors, seen, left)


def uncertainty(
    jacobian: Any,
    residual: Any,
    curvature: Any,
    counted: Any,
    series: Series,
    precision: float,
    absolute: bool,
    fixed: int = 0,
) -> Uncertainty:
    """Covariance of the parameters, for noise that is correlated along each series and for noise that is not.

        C = A^-1 J^T S J A^-1,   A = J^T diag(curvature) J,   S the autocovariances of the noise

    Args:
      jacobian: of the weighted residual, (m, n).
      residual: weighted, and cut by a robust loss, (m,).
      curvature: second derivative of half the loss, (m,); ones for squares.
      counted: which residuals count, (m,).
      series: the parts of the residual vector, each (time, channel).
      precision: unit roundoff of the residual's arithmetic.
      absolute: True where the weights are 1 / sigma and sigma is to be believed.
      fixed: how many rows at the end are of variance 1 and independent of all others, as those of priors are.
    Source: G. A. F. Seber, C. J. Wild, Nonlinear Regression, 1989, ch. 6; K. J. Worsley et al., A general statistical
      analysis for fMRI data, NeuroImage 15, 2002, app. A.3 (the correction of the autocovariances).
    """
    xp = namespace(jacobian)
    m, n = jacobian.shape
    d = directions(jacobian, precision)
    rank = xp.sum(d.seen)
    freedom = xp.sum(counted) - rank
    half = d.vectors * xp.where(d.seen, 1 / xp.where(d.seen, d.values, 1), 0) / d.norms[:, None]  # J = Q S V^T
    basis = d.left if xp is np and d.seen.all() else xp.where(d.seen, d.left, 0)
    shape = _inverse(basis.T @ _times(curvature, basis, xp), d.seen, xp)  # (Q^T diag(curvature) Q)^-1
    lags = _lags(series, n, m)
    some = slice(0, m - fixed)
    gamma = autocovariances(residual[some], counted[some], basis[some], series, lags, xp)
    enough = freedom > 0
    variance = xp.sum(residual**2) / xp.where(enough, freedom, 1)
    size = 1.0 if absolute else variance
    white = half @ shape @ (basis.T @ basis) @ shape @ half.T * size
    noise = autoregression(gamma, xp.sum(counted), xp)
    if xp is np and noise.order == 0:
        return with_covariances(white, white, gamma, enough, d, n, absolute, variance, xp)
    unit = 1 / xp.where(gamma[0] > 0, gamma[0], 1) if absolute else 1.0
    meat = unit * _through(basis[some], noise, series, xp) + basis[m - fixed :].T @ basis[m - fixed :]
    correlated = half @ shape @ meat @ shape @ half.T
    influence = None if basis.size > LARGE else basis @ (half @ shape).T
    known = 0.0 if influence is None else gamma[0] * xp.sum(influence[m - fixed :] ** 2, axis=0)
    influence = None if influence is None else influence[some]
    by_phi, share = _sensitivity(influence, known, n, noise, series, xp)
    wider = _student(by_phi, share, noise, xp.sum(counted), xp)
    correlated = correlated * wider[:, None] * wider[None, :]
    use = xp.all(xp.isfinite(correlated)) & enough & (noise.order > 0)
    correlated = xp.where(use, correlated, white)
    return with_covariances(correlated, white, gamma, enough, d, n, absolute, variance, xp)


def with_covariances(
    correlated: Any, white: Any, gamma: Any, enough: Any, d: Directions, n: int, absolute: bool, variance: Any, xp: Any
) -> Uncertainty:
    """The two covariances, what is blind, and the correlation from one sample to the next."""
    if not absolute:  # as many unknowns as data: nothing is left over to tell the noise from
        nothing = xp.where(xp.eye(n, dtype=bool), xp.inf, 0.0)
        white, correlated = (xp.where(enough, c, nothing) for c in (white, correlated))
    silent = 1 - xp.sum(xp.where(d.seen, d.vectors, 0) ** 2, axis=1)
    rho = xp.asarray(0.0)
    if len(gamma) > 1:
        rho = xp.where(gamma[0] > 0, gamma[1] / xp.where(gamma[0] > 0, gamma[0], 1), 0.0)
    # blind: what takes part in a direction that nothing shows
    return Uncertainty(correlated, white, silent > 1e-6, xp.clip(rho, -1, 1), variance, d)


def _times(curvature: Any, basis: Any, xp: Any) -> Any:
    """diag(curvature) Q; Q itself for squares."""
    return basis if xp is np and (curvature == 1).all() else curvature[:, None] * basis


def _inverse(matrix: Any, seen: Any, xp: Any) -> Any:
    """The inverse over the directions that are seen, 0 elsewhere."""
    both = seen[:, None] & seen[None, :]
    filled = xp.where(both, matrix, xp.eye(len(seen), dtype=matrix.dtype))
    good = xp.all(xp.isfinite(filled)) & (xp.linalg.det(filled) != 0)
    filled = xp.where(good, filled, xp.eye(len(seen), dtype=matrix.dtype))
    return xp.where(both, xp.linalg.inv(filled), 0)


def _lags(series: Series, n: int, m: int) -> int:
    """How many lags the series are long enough for; 0 where nothing can be said."""
    longest = max((times for times, _ in series), default=0)
    most = 2 if m * n > LARGE else MOST_LAGS
    return max(0, min(most, (m - n - 2) // 5, longest // 5))


def parts_of(x: Any, series: Series) -> list[Any]:
    """A vector (m, ...) as its series, each (time, channel, ...)."""
    parts, start = [], 0
    for times, channels in series:
        parts.append(x[start : start + times * channels].reshape(times, channels, *x.shape[1:]))
        start += times * channels
    return parts


def both_sides(x: Any, lag: int, xp: Any) -> Any:
    """The sum of x ``lag`` samples later and earlier, 0 beyond the ends, along the first axis."""
    if lag == 0:
        return x
    if lag >= len(x):
        return xp.zeros_like(x)
    nothing = xp.zeros_like(x[:lag])
    return xp.concatenate([x[lag:], nothing]) + xp.concatenate([nothing, x[:-lag]])


def autocovariances(residual: Any, counted: Any, basis: Any, series: Series, lags: int, xp: Any) -> Any:
    """Autocovariances of the noise at lags 0 to ``lags`` from those of the residual, M noise with M = I - Q Q^T.

    E[r^T U_h r] = sum_j gamma_j tr(U_h M V_j M), solved for gamma; U and V shift by h and j samples.
    """
    kept, mask = parts_of(xp.where(counted, residual, 0), series), parts_of(xp.where(counted, 1.0, 0.0), series)
    if basis.shape[0] > 50 * basis.shape[1] and basis.size > LARGE // 4:  # then a factor will do
        plain = [_inner(kept, [both_sides(r, h, xp) for r in kept], xp) / (2 if h else 1) for h in range(lags + 1)]
        pairs = [_inner(mask, [both_sides(r, h, xp) for r in mask], xp) / (2 if h else 1) for h in range(lags + 1)]
        return xp.stack([xp.asarray(a) for a in plain]) / (xp.stack([xp.asarray(a) for a in pairs]) - basis.shape[1])
    shifted = [parts_of(basis, series)]
    shifted += [[both_sides(q, h, xp) for q in shifted[0]] for h in range(1, lags + 1)]
    half = [1.0, *[0.5] * lags]
    seen = [half[h] * _inner(kept, [both_sides(r, h, xp) for r in kept], xp) for h in range(lags + 1)]
    pairs = [half[h] * _inner(mask, [both_sides(r, h, xp) for r in mask], xp) for h in range(lags + 1)]
    flat = basis.shape[1]
    within = [
        sum(a.reshape(-1, flat).T @ b.reshape(-1, flat) for a, b in zip(shifted[0], y, strict=True)) for y in shifted
    ]
    rows = []
    for h in range(lags + 1):
        row = []
        for j in range(lags + 1):
            cross = half[h] * _inner(shifted[h], shifted[j], xp)
            row.append((pairs[h] if h == j else 0.0) - 2 * cross + half[h] * xp.sum(within[h] * within[j].T))
        rows.append(xp.stack([xp.asarray(x) for x in row]))
    matrix, right = xp.stack(rows), xp.stack([xp.asarray(x) for x in seen])
    regular = xp.abs(xp.linalg.det(matrix / xp.maximum(xp.max(xp.abs(matrix)), 1e-30))) > 1e-30
    matrix = xp.where(regular, matrix, xp.eye(lags + 1))
    plain = right / xp.maximum(xp.sum(counted), 1)
    gamma = xp.where(regular, xp.linalg.solve(matrix, xp.where(regular, right, plain)), plain)
    return xp.where(gamma[0] > 0, gamma, plain)


def _inner(a: list[Any], b: list[Any], xp: Any) -> Any:
    return sum(xp.sum(x * y) for x, y in zip(a, b, strict=True))


class Noise(NamedTuple):
    """An autoregressive process: e_k = sum_i phi_i e_(k-i) + innovation."""

    coefficients: Any  # (lags,), 0 beyond the order
    innovation: Any  # its variance
    order: Any
    spread: Any  # covariance of the coefficients times the number of data, (lags, lags)

    def spectrum(self, length: int, xp: Any) -> tuple[Any, Any]:
        """S at the frequencies of ``rfft``, times their share of the whole; and d log S / d phi, (frequency, lag)."""
        steps = np.arange(1, len(self.coefficients) + 1)
        turn = xp.asarray(np.exp(-2j * np.pi * np.outer(np.fft.rfftfreq(length), steps)))
        filtered = 1 - turn @ self.coefficients
        share = np.full(length // 2 + 1, 2.0 / length)
        share[[0, -1]] = 1.0 / length
        return self.innovation / xp.abs(filtered) ** 2 * share, 2 * (turn / filtered[:, None]).real


def autoregression(gamma: Any, count: Any, xp: Any) -> Noise:
    """The autoregressive process of these autocovariances, of the order that Schwarz's criterion takes.

    Source: P. J. Brockwell, R. A. Davis, Time Series: Theory and Methods, 1991, sect. 5.2 (Durbin-Levinson), 9.3.
    """
    lags, spread = len(gamma) - 1, gamma[0]
    phi: list[Any] = []
    found, left, scores = [xp.zeros(lags)], [spread], [count * xp.log(xp.maximum(spread, 1e-300))]
    for k in range(1, lags + 1):
        top = gamma[k] - sum(phi[i] * gamma[k - 1 - i] for i in range(k - 1))
        reflection = xp.clip(top / xp.where(spread > 0, spread, 1), -0.985, 0.985)
        phi = [*[phi[i] - reflection * phi[k - 2 - i] for i in range(k - 1)], reflection]
        spread = spread * (1 - reflection**2)
        found.append(xp.stack([*map(xp.asarray, phi), *[xp.asarray(0.0)] * (lags - k)]))
        left.append(spread)
        scores.append(count * xp.log(xp.maximum(spread, 1e-300)) + k * xp.log(xp.maximum(count, 2.0)))
    order = xp.argmin(xp.stack([xp.asarray(score) for score in scores]))
    innovation = xp.stack([xp.asarray(x) for x in left])[order]
    within = np.arange(lags) < order
    both = within[:, None] & within[None, :]
    toeplitz = xp.asarray(gamma)[np.abs(np.subtract.outer(np.arange(lags), np.arange(lags)))]
    toeplitz = xp.where(both, toeplitz, xp.eye(lags) * xp.where(gamma[0] > 0, gamma[0], 1))
    spread = xp.where(both, xp.linalg.inv(toeplitz) * innovation, 0)
    return Noise(xp.stack(found)[order], innovation, order, spread)


def _length(times: int) -> int:
    """Of a Fourier transform long enough for the noise to be forgotten between the end and the start."""
    return 1 << int(np.ceil(np.log2(2 * times + 256)))


def _through(basis: Any, noise: Noise, series: Series, xp: Any) -> Any:
    """Q^T S Q for this noise, by its spectrum. Of a very large Jacobian only a bound: the largest of the spectrum."""
    if basis.size > LARGE:
        share, _ = noise.spectrum(4096, xp)
        return xp.max(share[1:-1]) * 2048 * (basis.T @ basis)
    total = 0.0
    for q in parts_of(basis, series):
        share, _ = noise.spectrum(_length(len(q)), xp)
        for channel in range(q.shape[1]):
            transformed = xp.fft.rfft(q[:, channel], n=_length(len(q)), axis=0)
            total = total + (xp.conj(transformed).T @ (share[:, None] * transformed)).real
    return total


def _sensitivity(influence: Any, known: Any, n: int, noise: Noise, series: Series, xp: Any) -> Any:
    """d log variance / d phi of each parameter, (n, lags), from what each residual adds to it, (m, n);
    and the share of it that is of the noise and not of priors, (n,)."""
    if influence is None:
        return xp.zeros((n, len(noise.coefficients))), xp.ones(n)
    variance, slope = known, 0.0
    for g in parts_of(influence, series):
        share, by_phi = noise.spectrum(_length(len(g)), xp)
        power = sum(xp.abs(xp.fft.rfft(g[:, c], n=_length(len(g)), axis=0)) ** 2 for c in range(g.shape[1]))
        variance = variance + share @ power
        slope = slope + power.T @ (share[:, None] * by_phi)
    variance = xp.where(variance > 0, variance, 1)
    return slope / variance[:, None], 1 - known / variance


def _student(sensitivity: Any, share: Any, noise: Noise, count: Any, xp: Any) -> Any:
    """How much wider an error must be for its 95 % to be 1.96 of it, as the noise itself is only estimated.

    The logarithm of a variance has the variance 2 / (degrees of freedom); Student's quantile by Cornish and Fisher.
    """
    spread = xp.einsum("ik,kl,il->i", sensitivity, noise.spread, sensitivity) / xp.maximum(count, 1)
    freedom = xp.clip(2 / (spread + 2 * share**2 / xp.maximum(count, 1) + 1e-30), 3.0, 1e9)
    z = 1.959964
    t = z + (z**3 + z) / (4 * freedom) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * freedom**2)
    return t / z
