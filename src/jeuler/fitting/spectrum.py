"""The spectrum of a measured column: even or uneven sampling, gaps, a million rows."""

from __future__ import annotations

import numpy as np

PADDING = 4  # frequencies a line's width, 1 / span
REFINED = 64  # frequencies looked at around a line
REFINED_ROWS = 20_000
FIRST_LINE = 0.4  # cycles in the whole record: what is slower is a trend


def seen_samples(times: np.ndarray, column: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and values where there is a value, each time once (repeated stamps averaged), the mean taken off."""
    seen = np.isfinite(column)
    t, x = times[seen], column[seen]
    if len(t) and not (np.diff(t) > 0).all():
        t, index, counts = np.unique(t, return_inverse=True, return_counts=True)
        x = np.bincount(index, x) / counts
    return t, x - (x.mean() if len(x) else 0.0)


def power_spectrum(times: np.ndarray, column: np.ndarray, span: float) -> tuple[np.ndarray, np.ndarray]:
    """Angular frequencies, rad/s, a quarter of a line's width apart, and the power of a column there.

    The FFT of the linear interpolation on as many even times as there are samples, twice that where they are uneven.
    Time and memory grow as N log N.
    """
    t, x = seen_samples(times, column)
    even = np.ptp(np.diff(t)) <= 0.5 * np.median(np.diff(t)) if len(t) > 2 else True
    count = len(t) if even else 2 * len(t)
    grid = np.linspace(t[0], t[-1], count)
    step = (t[-1] - t[0]) / (count - 1)
    size = _fast_size(int(np.ceil(PADDING * max(span / step, count))))
    power = np.abs(np.fft.rfft(np.interp(grid, t, x), size)) ** 2 / count**2
    frequencies = 2 * np.pi * np.arange(len(power)) / (size * step)
    highest = np.pi / step if even else np.pi / (2 * step)
    keep = (frequencies >= 2 * np.pi * FIRST_LINE / span) & (frequencies <= highest)
    return frequencies[keep], power[keep]


def periodogram(t: np.ndarray, x: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """The Lomb-Scargle periodogram: what a sine of each frequency takes of the sum of squares, for uneven sampling.

        P = ((x . c)^2 / (c . c) + (x . s)^2 / (s . s)) / 2,  c = cos(w (t - tau)), s = sin(w (t - tau)), c . s = 0

    Source: J. D. Scargle, Astrophysical Journal 263, 835, 1982, equation 10.
    """
    phase = frequencies[:, None] * (t - t[0])
    shift = np.arctan2(np.sin(2 * phase).sum(axis=1), np.cos(2 * phase).sum(axis=1))[:, None] / 2
    cosine, sine = np.cos(phase - shift), np.sin(phase - shift)
    tiny = 1e-12 * len(t)
    return (
        (cosine @ x) ** 2 / np.maximum((cosine**2).sum(axis=1), tiny)
        + (sine @ x) ** 2 / np.maximum((sine**2).sum(axis=1), tiny)
    ) / 2


def refined_line(times: np.ndarray, columns: list[np.ndarray], omega: float, span: float) -> float:
    """The frequency near omega at which sines take most of the columns, by least squares at 64 frequencies."""
    width = 2 * np.pi / span
    low = max(omega - width / 2, width * FIRST_LINE)
    frequencies = np.linspace(low, omega + width / 2, REFINED)
    explained = sum(_explained(*_averaged(*seen_samples(times, column), omega), frequencies) for column in columns)
    return float(frequencies[np.argmax(explained)])


def strong_lines(times: np.ndarray, column: np.ndarray, most: int = 4) -> list[tuple[float, float]]:
    """Lines that stand out of one column's spectrum: angular frequency, rad/s, and amplitude; strongest first.

    A line is a sine taken off by least squares, in a window that makes a decaying oscillation one line; the next is
    looked for in what is left, at least three widths from the others.
    """
    t, x = seen_samples(times, column)
    if len(t) < 8 or np.ptp(x) == 0:
        return []
    span = t[-1] - t[0]
    window = np.interp(t, t[0] + span * np.linspace(0, 1, 201), np.hanning(201))
    x = (x - (window @ x) / window.sum()) * window
    frequencies, power = power_spectrum(t, x, span)
    level = np.sqrt(power)
    noise = np.median(level) if len(level) else 0.0
    found: list[tuple[float, float]] = []
    width, free = 2 * np.pi / span, frequencies > 2 * np.pi * 1.5 / span
    while len(found) < most and free.any():
        k = int(np.argmax(np.where(free, level, 0)))
        strongest = found[0][1] if found else 4 * level[k]
        if level[k] < 8 * noise or 4 * level[k] < 0.05 * strongest:
            break
        left, right = _valley(level, k)
        apart = all(abs(frequencies[k] - omega) > 3 * width for omega, _ in found)
        if apart and 0 < k < len(level) - 1 and level[k] >= 2 * max(level[left], level[right]):
            found.append((float(frequencies[k]), float(4 * level[k])))
        free[left : right + 1] = False
    return found


def _valley(level: np.ndarray, k: int) -> tuple[int, int]:
    """How far a line reaches to both sides: to where the spectrum is a thousandth of it or rises again."""
    floor = level[k] * 1e-3
    left = k
    while left > 0 and level[left - 1] > floor and level[left - 1] <= 1.3 * level[left]:
        left -= 1
    right = k
    while right < len(level) - 1 and level[right + 1] > floor and level[right + 1] <= 1.3 * level[right]:
        right += 1
    return left, right


def _fast_size(least: int) -> int:
    """The least 2^a 3^b 5^c that is not smaller: an FFT of such a size is fast. (To import scipy.fft takes 0.1 s.)"""
    odd = (3**b * 5**c for b in range(41) for c in range(28))
    return min(factor << max(0, -(-least // factor) - 1).bit_length() for factor in odd if factor < 2 * least)


def _averaged(t: np.ndarray, x: np.ndarray, omega: float) -> tuple[np.ndarray, np.ndarray]:
    """Blocks of samples averaged, where there are very many and the blocks stay far below a period."""
    if len(t) <= REFINED_ROWS:
        return t, x
    samples_a_period = len(t) * 2 * np.pi / omega / (t[-1] - t[0])
    block = int(min(len(t) // REFINED_ROWS, samples_a_period // 20))
    return block_means(t, block), block_means(x, block)


def block_means(x: np.ndarray, block: int) -> np.ndarray:
    """Means of blocks of rows; NaN only where all of a block is NaN. What is left over at the end is dropped."""
    if block < 2:
        return x
    parts = x[: len(x) // block * block].reshape(-1, block, *x.shape[1:])
    seen = np.isfinite(parts)
    counts = seen.sum(axis=1)
    return np.where(counts > 0, np.where(seen, parts, 0).sum(axis=1) / np.maximum(counts, 1), np.nan)


def _explained(t: np.ndarray, x: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """How much of the sum of squares of x a constant, a cosine and a sine of each frequency take."""
    taken = []
    for omega in frequencies:
        basis = np.stack([np.cos(omega * (t - t[0])), np.sin(omega * (t - t[0])), np.ones_like(t)])
        product = basis @ x
        taken.append(product @ np.linalg.lstsq(basis @ basis.T, product, rcond=1e-12)[0])
    return np.array(taken)
