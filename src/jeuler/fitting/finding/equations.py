"""The equation of motion in weak form over candidate pairs, weighted by the noise of the positions.

    integral of w'' x_i  =  1/m_i sum_j integral of w (-ks d + ks L u - kd (dv . u) u),   d = x_i - x_j,  u = d / |d|

With bumps w that overlap, white noise of the positions makes the left-hand sides of neighbouring bumps correlated: each
particle's rows are multiplied by the inverse root of their covariance, so that sums of squares are in units of it.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from jeuler.fitting.smooth import FEWEST, FINER, Tracks, bumps, smoothed

TERMS = ("ks", "ks L", "kd")
SMOOTH = 4.0  # half-width of a bump times the highest angular frequency of the motion
NARROWEST = 4.0  # samples
KEPT = 0.995  # share of the accelerations' power below that frequency
EVEN = 0.5  # of the usual time between samples: what lies closer is not interpolated
ABOVE = 2.0  # times the power of the noise: what is below is not counted as motion


@dataclasses.dataclass(frozen=True)
class Motion:
    """Tracks of the particles, smoothed for the forces and as measured for the accelerations.

    Attributes:
      tracks: smoothed.
      measured: interpolation of the positions on the same grid, (fine, particle, dim).
      sigma: standard deviation of the noise, m.
    """

    tracks: Tracks
    measured: np.ndarray
    sigma: float

    @classmethod
    def of(cls, times: np.ndarray, positions: np.ndarray, sigma: float) -> Motion | None:
        """None where there are too few samples."""
        from scipy.interpolate import make_interp_spline

        tracks = smoothed(times, positions)
        if tracks is None:
            return None
        measured = tracks.position.copy()
        distinct = np.concatenate([[True], np.diff(times) > 0])
        t, x = times[distinct], positions[distinct]
        if np.diff(t).min() < EVEN * tracks.spacing:  # a curve through two noisy points close together swings out
            return cls(tracks, measured, sigma)
        complete = np.isfinite(x).all(axis=2)
        whole = complete.all(axis=0)
        if whole.any():
            measured[:, whole] = make_interp_spline(t, x[:, whole], k=5)(tracks.times)
        for particle in np.flatnonzero(~whole & (complete.sum(axis=0) >= FEWEST)):
            seen = complete[:, particle]
            measured[:, particle] = make_interp_spline(t[seen], x[seen, particle], k=5)(tracks.times)
        return cls(tracks, measured, sigma)

    def half_width(self, moving: np.ndarray) -> float:
        """Of bumps that let the accelerations of the moving particles pass, s."""
        t, x = self.tracks.times, self.measured[:, moving & self.tracks.known.any(axis=0)]
        step, span = t[1] - t[0], t[-1] - t[0]
        x = (x - x.mean(axis=0)).reshape(len(t), -1)
        line = np.linspace(-1, 1, len(t))[:, None]
        x = x - line * (line * x).sum(axis=0) / (line**2).sum()
        omega = 2 * np.pi * np.fft.rfftfreq(len(t), step)
        window = np.hanning(len(t))
        power = (np.abs(np.fft.rfft(x * window[:, None], axis=0)) ** 2).mean(axis=1)
        above = power - ABOVE * self.sigma**2 * FINER * np.sum(window**2)
        power = np.where(omega * self.tracks.spacing < np.pi, np.maximum(above, 0), 0) * omega**4
        total = np.cumsum(power)
        highest = omega[np.searchsorted(total, KEPT * total[-1])] if total[-1] > 0 else 0.0
        wanted = SMOOTH / highest if highest > 0 else np.inf
        return float(np.clip(wanted, NARROWEST * self.tracks.spacing, max(span / 6, NARROWEST * self.tracks.spacing)))


@dataclasses.dataclass(frozen=True)
class Normal:
    """The normal equations over all terms of all candidates: |y|^2 - 2 c x + x G x.

    Attributes:
      gram: G, sparse, (3 pair, 3 pair); the terms of a pair follow one another.
      slope: c, (3 pair,).
      square: |y|^2, what there is without a spring.
      rows: how many numbers y has.
      seen: whether a particle's equation of motion is among them, (particle,).
    """

    gram: Any
    slope: np.ndarray
    square: float
    rows: int
    seen: np.ndarray


def normal_equations(
    motion: Motion,
    pairs: np.ndarray,
    mass: np.ndarray,
    known_force: np.ndarray,
    half_width: float,
    stiffness: np.ndarray,
) -> Normal:
    """Summed over the particles that can move.

    Args:
      pairs: candidates, (pair, 2).
      mass: (particle,), inf = pinned.
      known_force: what other forces do, (fine, particle, dim), N.
      half_width: of the bumps, s.
      stiffness: of all springs that end at each particle, over its mass, (particle,), 1/s^2: noise in the position is
        noise in their force.
    """
    from scipy.sparse import coo_matrix

    bump, second, inside = bumps(motion.tracks.times, half_width)
    unknown = inside @ (~motion.tracks.known).astype(float) > 0  # (bump, particle)
    size = len(TERMS) * len(pairs)
    slope, square, rows = np.zeros(size), 0.0, 0
    seen = np.zeros(len(mass), bool)
    blocks: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    left, right = ((m @ m.T).tocsc() * (FINER * motion.sigma**2) for m in (second, bump))
    for particle in np.flatnonzero(np.isfinite(mass)).tolist():
        own = np.flatnonzero((pairs == particle).any(axis=1))
        others = pairs[own].sum(axis=1) - particle
        used = ~unknown[:, particle] & ~unknown[:, others].any(axis=1)
        if used.sum() < 3 or not len(own):
            continue
        columns = _columns(motion.tracks, particle, others, bump[used]) / mass[particle]  # (bump, dim, term)
        y = _apply(second[used], motion.measured[:, particle])
        y = y - _apply(bump[used], known_force[:, particle]) / mass[particle]
        covariance = (left + stiffness[particle] ** 2 * right)[used][:, used]
        whitened = _whitened(covariance, np.concatenate([columns.reshape(len(y), -1), y], axis=1))
        matrix = whitened[:, : -y.shape[1]].reshape(-1, columns.shape[2])
        target = whitened[:, -y.shape[1] :].ravel()
        index = (len(TERMS) * own[:, None] + np.arange(len(TERMS))).ravel()
        block = matrix.T @ matrix
        blocks.append((block.ravel(), np.repeat(index, len(index)), np.tile(index, len(index))))
        slope[index] += matrix.T @ target
        square, rows, seen[particle] = square + float(target @ target), rows + len(target), True
    blocks.append((np.zeros(0), np.zeros(0, int), np.zeros(0, int)))
    values, at, to = (np.concatenate(x) for x in zip(*blocks, strict=True))
    gram = coo_matrix((values, (at, to)), shape=(size, size)).tocsr()
    return Normal(gram, slope, square, rows, seen)


def _columns(tracks: Tracks, particle: int, others: np.ndarray, bump: Any) -> np.ndarray:
    """Integrals of bump times the force on a particle per unit of each term, (bump, dim, 3 other)."""
    x, v = tracks.position, tracks.velocity
    d, dv = x[:, [particle]] - x[:, others], v[:, [particle]] - v[:, others]
    r = np.linalg.norm(d, axis=-1, keepdims=True)
    u = d / np.where(r > 0, r, 1)
    terms = np.stack([-d, u, -np.sum(dv * u, axis=-1, keepdims=True) * u], axis=2)  # (fine, other, term, dim)
    terms = terms.transpose(0, 3, 1, 2)
    return _apply(bump, terms).reshape(bump.shape[0], x.shape[2], -1)


def _apply(matrix: Any, field: np.ndarray) -> np.ndarray:
    """A sparse matrix times a field along its first axis."""
    return (matrix @ np.ascontiguousarray(field.reshape(len(field), -1))).reshape(-1, *field.shape[1:])


def _whitened(covariance: Any, columns: np.ndarray) -> np.ndarray:
    """The inverse of the Cholesky factor of a banded covariance, applied to columns."""
    from scipy.linalg import cholesky_banded, solve_banded

    coo = covariance.tocoo()
    width = int(np.abs(coo.row - coo.col).max(initial=0))
    banded = np.zeros((width + 1, covariance.shape[0]))
    lower = coo.row >= coo.col
    banded[coo.row[lower] - coo.col[lower], coo.col[lower]] = coo.data[lower]
    banded[0] *= 1 + 1e-10
    factor = cholesky_banded(banded, lower=True)
    return solve_banded((width, 0), factor, columns)
