"""Tracks as smooth curves: splines at the level of the noise, and where they can be trusted."""

from __future__ import annotations

import warnings
from typing import Any, NamedTuple

import numpy as np

from jeuler.fitting.observations import noise_of

FINER = 4  # points of the fine grid in the time between two samples
FEWEST = 9  # samples of a track


class Tracks(NamedTuple):
    """Positions and velocities of all particles on a fine grid.

    Attributes:
      times: of the grid, equally spaced, (fine,), s.
      position, velocity: (fine, particle, dim), m and m/s; 0 where a particle is not known.
      known: whether a particle is known there, (fine, particle).
      spacing: the time between two samples, s.
    """

    times: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    known: np.ndarray
    spacing: float


def smoothed(times: np.ndarray, targets: np.ndarray) -> Tracks | None:
    """Smoothing splines of fifth degree through (time, particle, dim) data; None where there are too few samples."""
    from scipy.interpolate import splev, splrep

    distinct = np.concatenate([[True], np.diff(times) > 0])
    times, targets = times[distinct], targets[distinct]
    if len(times) < FEWEST:
        return None
    spacing = float(np.median(np.diff(times)))
    count = int(np.clip((times[-1] - times[0]) / spacing, 8, 20_000)) * FINER + 1
    grid = np.linspace(times[0], times[-1], count)
    shape = (count, *targets.shape[1:])
    position, velocity = np.zeros(shape), np.zeros(shape)
    known = np.zeros(shape[:2], bool)
    complete = np.isfinite(targets).all(axis=2)
    for particle in range(shape[1]):
        seen = complete[:, particle]
        if seen.sum() < FEWEST:
            continue
        t, known[:, particle] = times[seen], _near_samples(grid, times[seen], spacing)
        for d in range(shape[2]):
            x = targets[seen, particle, d]
            sigma = noise_of(t, x[:, None], np.ones((len(x), 1))) or 0.0
            sigma = max(sigma, 1e-8 * float(np.ptp(x)))
            with warnings.catch_warnings():  # exact data cannot be met to their rounding: as good as it gets will do
                warnings.simplefilter("ignore", RuntimeWarning)
                curve = splrep(t, x, k=5, s=len(x) * sigma**2 * 0.9)
            position[:, particle, d], velocity[:, particle, d] = splev(grid, curve), splev(grid, curve, der=1)
    return Tracks(grid, position, velocity, known, spacing) if known.any() else None


def _near_samples(grid: np.ndarray, t: np.ndarray, spacing: float) -> np.ndarray:
    """Whether a time lies between two samples that are not far apart."""
    k = np.clip(np.searchsorted(t, grid, side="right"), 1, len(t) - 1)
    return (t[k] - t[k - 1] <= 3 * spacing) & (grid >= t[0]) & (grid <= t[-1])


def bumps(grid: np.ndarray, half_width: float) -> tuple[Any, Any, Any]:
    """Bumps (1 - z^2)^4 that overlap by half, their second derivatives, and 1 where they are not 0: sparse, (bump,
    fine).

    Each row is multiplied by the step of the grid, so that a product with it is an integral.
    """
    from scipy.sparse import csr_matrix

    step = grid[1] - grid[0]
    first, last = grid[0] + half_width, grid[-1] - half_width
    count = int(np.floor((last - first) / (half_width / 2) + 1e-9)) + 1 if last >= first else 0
    centres = np.linspace(first, last, count) if count > 1 else np.array([(first + last) / 2] * count)
    low = np.searchsorted(grid, centres - half_width, side="right")
    high = np.searchsorted(grid, centres + half_width, side="left")
    ends = np.concatenate([[0], np.cumsum(high - low)])
    columns = np.arange(ends[-1]) + np.repeat(low - ends[:-1], high - low)
    z = (grid[columns] - np.repeat(centres, high - low)) / half_width
    c = 1 - z**2
    second = 48 * z**2 * c**2 - 8 * c**3
    row = np.repeat(np.arange(count), high - low)
    second = _exact_for_parabolas(second, c**4, z, row, count) / half_width**2
    shape = count, len(grid)
    return tuple(csr_matrix((x, columns, ends), shape) for x in (c**4 * step, second * step, np.ones_like(z)))


def _exact_for_parabolas(
    second: np.ndarray, bump: np.ndarray, z: np.ndarray, row: np.ndarray, count: int
) -> np.ndarray:
    """The second derivatives, changed by a little so that their sums with 1, z and z^2 are 0, 0 and twice the bump's.

    So where the origin lies, and how fast all moves, does not pass for an acceleration.
    """

    def moment(values: np.ndarray, power: int) -> np.ndarray:
        return np.bincount(row, values * z**power, count)

    wrong = np.stack([moment(second, 0), moment(second, 1), moment(second, 2) - 2 * moment(bump, 0)], axis=1)
    matrix = np.stack([np.stack([moment(bump, i + j) for j in range(3)], axis=1) for i in range(3)], axis=1)
    change = np.linalg.solve(matrix, wrong[..., None])[..., 0]
    return second - bump * sum(change[row, k] * z**k for k in range(3))
