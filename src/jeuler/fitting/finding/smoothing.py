"""What smoothing and noise in the forces do to the springs of the weak form, and samples too far apart for it.

The forces are read from smoothed tracks, which noise and smoothing both change: an error of ks, kd and rest length that
no covariance of the accelerations knows. It is measured: the smoothed tracks are taken for the truth, moved by the
springs that were found; noise is put on them, they are smoothed again, and the springs solved for again, with the
forces of these tracks and with the true ones. Both solutions see the same noise of the accelerations, so that their
difference is the error of the forces alone.
"""

from __future__ import annotations

import numpy as np

from jeuler.fitting.finding.equations import Motion, normal_equations
from jeuler.fitting.finding.selection import Selection, solved
from jeuler.fitting.finding.tracked import Tracked
from jeuler.fitting.smooth import Tracks

CHANCE = 1e-4  # of taking white noise for a motion
MISSING = 0.2  # share of the accelerations


def force_errors(task: Tracked, found: Selection) -> np.ndarray:
    """By how much ks, rest length and kd change by errors of the forces, (3, spring)."""
    motion, pairs = task.motion, task.pairs[found.chosen]
    tracks = motion.tracks
    seen = at_samples(task)
    noise = motion.sigma * np.random.default_rng(0).normal(size=seen.shape)
    noise[:, np.isinf(task.mass)] = 0
    again = Motion.of(task.times, np.where(np.isfinite(task.positions), seen + noise, np.nan), motion.sigma)
    if again is None:
        return np.zeros((3, len(pairs)))
    moving = np.isfinite(task.mass)
    half_width = motion.half_width(moving)
    stiffness = np.zeros(len(task.mass))
    np.add.at(stiffness, pairs.ravel(), np.repeat(found.values[:, 0], 2))
    stiffness = np.where(moving, stiffness / np.where(moving, task.mass, 1), 0)
    pull = _pull(tracks, pairs, found.values)
    values = []
    for used in (again.tracks, tracks):
        made = Motion(used, again.measured - tracks.position, motion.sigma)
        normal = normal_equations(made, pairs, task.mass, -pull, half_width, stiffness)
        ks, length_force, kd = solved(normal, found.terms).T
        with np.errstate(all="ignore"):
            values.append(np.stack([ks, np.where(ks > 0, length_force / ks, 0), kd]))
    return values[0] - values[1]


def at_samples(task: Tracked) -> np.ndarray:
    """The smoothed tracks at the times of the samples, (time, particle, dim), m."""
    times, x = task.motion.tracks.times, task.motion.tracks.position
    after = np.clip(np.searchsorted(times, task.times), 1, len(times) - 1)
    part = ((task.times - times[after - 1]) / (times[after] - times[after - 1]))[:, None, None]
    return x[after - 1] * (1 - part) + x[after] * part


def _pull(tracks: Tracks, pairs: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Of the springs on each particle, (fine, particle, dim), N."""
    i, j = pairs.T
    d, dv = (a[:, i] - a[:, j] for a in (tracks.position, tracks.velocity))
    r = np.linalg.norm(d, axis=-1, keepdims=True)
    u = d / np.where(r > 0, r, 1)
    ks, length_force, kd = values.T[:, :, None]
    each = -ks * d + (length_force - kd * np.sum(dv * u, axis=-1, keepdims=True)) * u
    total = np.zeros_like(tracks.position)
    for k in range(len(pairs)):
        total[:, i[k]] += each[:, k]
        total[:, j[k]] -= each[:, k]
    return total


def motion_left(task: Tracked, curve: np.ndarray) -> float | None:
    """The angular frequency of a motion that is in the tracks and not in a curve, rad/s; None where there is none.

    There is one where what the curve leaves has more power at a frequency than white noise has but by a chance of
    `CHANCE`, and the accelerations there are a fifth of the curve's or more.

    Args:
      curve: at the times of the tracks, (time, particle, dim), m.
    """
    from scipy.stats import gamma

    moving = np.isfinite(task.mass) & np.isfinite(task.positions).all(axis=(0, 2))
    if not moving.any():
        return None
    kept = _detrended(curve[:, moving])
    left = _detrended(task.positions[:, moving] - curve[:, moving])
    omega = 2 * np.pi * np.fft.rfftfreq(len(task.times), task.motion.tracks.spacing)[1:-1]
    power = _power(left)
    upper = power[len(power) // 2 :]  # smoothing leaves little noise below
    white = np.median(upper) / gamma.median(left.shape[1])
    tone = len(power) * gamma.sf(power / max(white, 1e-300), left.shape[1]) < CHANCE
    missing, there = np.sum((omega**4 * (power - white * left.shape[1]))[tone]), np.sum(omega**4 * _power(kept))
    if missing <= MISSING**2 * there:
        return None
    return float(omega[np.argmax(np.where(tone, power, 0))])


def _detrended(x: np.ndarray) -> np.ndarray:
    """Less a straight line, under a window: a drift has no frequency, (time, column)."""
    columns, line = x.reshape(len(x), -1), np.linspace(-1, 1, len(x))[:, None]
    columns = columns - columns.mean(axis=0)
    columns = columns - line * (line * columns).sum(axis=0) / (line**2).sum()
    return columns * np.hanning(len(x))[:, None]


def _power(x: np.ndarray) -> np.ndarray:
    """Of all columns, at the frequencies between 0 and the highest."""
    return (np.abs(np.fft.rfft(x, axis=0)[1:-1]) ** 2).sum(axis=1)
