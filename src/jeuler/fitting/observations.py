"""What was measured: checked, placed among the steps of a run, and the scales that a fit takes from it."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np

from jeuler._core import checks


def checked_observations(
    times: Any,
    positions: Any,
    shape: tuple[int, ...],
    t0: float,
    name: str = "positions",
    meaning: str = "(time, particle, dim)",
) -> tuple[np.ndarray, Any]:
    """Times and targets as float64 NumPy arrays, checked; ``name`` is what the user calls the targets."""
    times = checks.reals("times", times, "numbers of shape (time,), s")
    targets: Any = checks.reals(name, positions, f"numbers of shape {meaning}")
    if times.ndim != 1 or not len(times):
        raise ValueError(f"times must have shape (time,) with at least one time, got {times.shape}")
    if targets.shape != (len(times), *shape):
        raise ValueError(f"{name} must have shape {meaning} = {(len(times), *shape)}, got {targets.shape}")
    if not np.isfinite(times).all():
        raise ValueError(f"times must be finite, got {times[~np.isfinite(times)][0]}; drop those rows")
    falls = np.flatnonzero(np.diff(times) < 0)
    if falls.size:
        k = falls[0]
        raise ValueError(f"times must not decrease, got {times[k]} then {times[k + 1]} at {k + 1}; sort the rows")
    if times[0] < t0:
        raise ValueError(
            f"times must lie in the simulated span, which begins at t0 = {t0} s, got {times[0]}; "
            f"pass t0, the time of the state, or drop the rows before it"
        )
    if times[0] == times[-1]:
        raise ValueError(f"times must hold at least two different times, got only {times[0]:g} s; record for longer")
    if checks.is_traced(targets):
        return times, targets
    if np.isinf(targets).any():
        raise ValueError(f"{name} must be finite, or NaN where not observed, got inf")
    if not np.isfinite(targets).any():
        raise ValueError(f"{name} must have at least one finite value, got none: nothing was observed")
    return times, targets


def place_in_steps(times: np.ndarray, t0: float, dt: float, num_steps: int) -> tuple[np.ndarray, np.ndarray]:
    """The step interval of each time and the place in it, from 0 to 1."""
    steps = (times - t0) / dt
    interval = np.clip(np.floor(steps).astype(int), 0, num_steps - 1)
    return interval, steps - interval


def horizons(times: np.ndarray) -> list[np.ndarray]:
    """Weights of the observations for a time horizon that doubles from a sixteenth of the span to a half."""
    weights = [(times <= times[-1] * share).astype(float) for share in (1 / 16, 1 / 8, 1 / 4, 1 / 2)]
    counts = [0.0, *(w.sum() for w in weights)]
    return [w for w, before in zip(weights, counts, strict=False) if w.sum() > before and w.sum() < len(times)]


def amplitude_of(targets: np.ndarray) -> float:
    """Root mean square of the motion about its mean, m."""
    seen = np.isfinite(targets)
    mean = np.nansum(targets, axis=0) / np.maximum(seen.sum(axis=0), 1)
    rms = float(np.sqrt(np.mean((targets - mean)[seen] ** 2)))
    return rms if rms > 0 else 1.0


def speed_of(times: np.ndarray, targets: np.ndarray) -> float:
    """Root mean square speed over a fiftieth of the samples, so that noise does not pass for speed, m/s."""
    lag = max(1, len(times) // 50)
    if len(times) <= lag:
        return 1.0
    span = np.maximum(times[lag:] - times[:-lag], 1e-300)[:, None, None]
    quotients = (targets[lag:] - targets[:-lag]) / span
    rms = float(np.sqrt(np.nanmean(quotients**2))) if np.isfinite(quotients).any() else 0.0
    return rms if np.isfinite(rms) and rms > 0 else 1.0


def variance_of(columns: np.ndarray, weights: np.ndarray) -> float | None:
    """Sum of squares of (time, column) data about the mean of each column, weighted; None where nothing moves."""
    seen = np.isfinite(columns) & (weights > 0)
    mean = np.sum(np.where(seen, columns, 0), axis=0) / np.maximum(seen.sum(axis=0), 1)
    total = float(np.sum(np.where(seen, (columns - mean) * weights, 0) ** 2))
    return total if total > 0 else None


def noise_of(times: np.ndarray, columns: np.ndarray, weights: np.ndarray) -> float | None:
    """Standard deviation of the noise, from what of 7 neighbouring samples no polynomial of fifth order describes.

    It is an upper bound where the motion is sampled less than some ten times a period. None where there are too few
    samples, or two at one time.
    """
    width, kept, squares = 7, 0, 0.0
    for column, weight in zip(columns.T, weights.T, strict=True):
        seen = np.isfinite(column) & (weight > 0)
        contrast = _contrast(np.asarray(times[seen], float).tobytes(), width)
        if contrast is None:
            continue
        left = np.sum(contrast * np.lib.stride_tricks.sliding_window_view((column * weight)[seen], width), axis=1)
        squares, kept = squares + float(np.sum(left**2)), kept + len(left)
    return float(np.sqrt(squares / kept)) if kept and squares > 0 else None


@functools.lru_cache(maxsize=8)  # most columns were seen at the same times
def _contrast(seen_at: bytes, width: int) -> np.ndarray | None:
    """Weights of neighbouring samples, orthogonal to all polynomials of less than the highest degree, of norm one."""
    times = np.frombuffer(seen_at)
    if len(times) < width + 2 or (np.diff(times) <= 0).any():
        return None
    windows = np.lib.stride_tricks.sliding_window_view(times, width)
    place = (windows - windows.mean(axis=1, keepdims=True)) / np.ptp(windows, axis=1)[:, None]
    contrast = 1 / np.prod(place[:, :, None] - place[:, None, :] + np.eye(width), axis=2)  # the divided difference
    return np.asarray(contrast / np.linalg.norm(contrast, axis=1, keepdims=True))
