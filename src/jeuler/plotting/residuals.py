"""What a fit leaves behind and how far it is to be trusted: residual, correlation of errors, net, loss."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from jeuler.plotting.fits import COLORS, in_unit

MOST_NAMES = 40  # parameters whose names are written beside a correlation matrix
MOST_NUMBERS = 10  # parameters whose correlations are written as numbers


def plot_residual(times: Any, residual: Any, *, names: tuple[str, ...] | None = None, unit: str = "m") -> Figure:
    """Draw a residual over time, its autocorrelation, and its amplitude spectrum.

        rho(k) = sum_i r_i r_{i+k} / sum_i r_i^2,   white noise of n samples: |rho| < 1.96 / sqrt(n) in 95 of 100

    Lags and spectrum are of the residual interpolated linearly to even times.

    Args:
      times: (time,), s.
      residual: (time, column); NaN = not observed.
      names: one label a column.
      unit: of the residual.
    Returns: the matplotlib figure, three panels.
    Raises: ValueError, if the shapes do not agree.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import plot_residual
      >>> t = np.linspace(0, 1, 50)
      >>> len(plot_residual(t, np.sin(9 * t)[:, None]).axes)
      3

    Source: G. E. P. Box, G. M. Jenkins, Time Series Analysis, 1976, ch. 2 (the band of white noise).
    """
    times, residual = np.asarray(times, float), np.asarray(residual, float)
    if residual.ndim != 2 or len(residual) != len(times):
        raise ValueError(f"residual must be (time, column) with {len(times)} times, got {residual.shape}")
    figure = plt.figure(figsize=(8, 4.6), layout="constrained")
    panels = figure.subplot_mosaic([["over", "over"], ["lags", "lines"]])
    band = 0.0
    for k, column in enumerate(residual.T):
        seen = np.isfinite(column)
        if seen.sum() < 4 or np.ptp(times[seen]) == 0:
            continue
        color = COLORS[k % len(COLORS)]
        label = names[k] if names else f"column {k + 1}"
        panels["over"].plot(times[seen], column[seen], ".", color=color, markersize=3, alpha=0.7, label=label)
        step, even = evenly(times[seen], column[seen])
        rho = autocorrelation(even)[: max(len(even) // 4, 2)]
        panels["lags"].plot(step * np.arange(len(rho)), rho, color=color, linewidth=1.2)
        amplitude = 2 * np.abs(np.fft.rfft(even - even.mean()))[1:] / len(even)
        panels["lines"].plot(np.fft.rfftfreq(len(even), step)[1:], amplitude, color=color, linewidth=1.0)
        band = max(band, 1.96 / np.sqrt(seen.sum()))
    panels["lags"].axhspan(-band, band, color="0.87", zorder=0)
    panels["over"].axhline(0, color="0.3", linewidth=0.8)
    panels["over"].set(xlabel="time [s]", ylabel=in_unit("data − fit", unit))
    panels["lags"].set(xlabel="lag [s]", ylabel="autocorrelation", title="grey: white noise (95 %)")
    panels["lines"].set(xlabel="frequency [Hz]", ylabel=in_unit("amplitude", unit), title="spectrum")
    if residual.shape[1] <= len(COLORS) and panels["over"].lines[:-1]:
        panels["over"].legend(fontsize=8, ncols=3, loc="upper right", framealpha=0.9)
    for axis in panels.values():
        axis.spines[["top", "right"]].set_visible(False)
        axis.title.set_fontsize(9)
    return figure


def evenly(times: np.ndarray, values: np.ndarray) -> tuple[float, np.ndarray]:
    """The step of as many evenly spaced times, and the values interpolated to them."""
    even = np.linspace(times[0], times[-1], len(times))
    return float(even[1] - even[0]), np.interp(even, times, values)


def autocorrelation(values: np.ndarray) -> np.ndarray:
    """rho(k) for every lag k, by the transform of the padded sequence; 1 and zeros for a sequence of zeros."""
    n = len(values)
    power = np.abs(np.fft.rfft(values, 2 * n)) ** 2
    lagged = np.fft.irfft(power)[:n]
    return lagged / lagged[0] if lagged[0] > 0 else np.eye(1, n)[0]


def plot_correlation(names: Any, correlation: Any) -> Figure:
    """Draw the correlation matrix of the parameters' errors, from -1 (blue) over 0 (white) to 1 (red).

        corr_ij = cov_ij / sqrt(cov_ii cov_jj)

    Args:
      names: of the parameters, (n,).
      correlation: (n, n); NaN, where a parameter has no error, is grey.
    Returns: the matplotlib figure.
    Raises: ValueError, if the shapes do not agree.
    Example:
      >>> from jeuler.plotting import plot_correlation
      >>> figure = plot_correlation(["ks", "kd"], [[1.0, -0.2], [-0.2, 1.0]])
    """
    names, correlation = list(names), np.asarray(correlation, float)
    if correlation.shape != (len(names), len(names)):
        raise ValueError(f"correlation must be ({len(names)}, {len(names)}), got {correlation.shape}")
    size = min(max(2.8, 0.5 * len(names) + 1.8), 7)
    figure, axis = plt.subplots(figsize=(size + 1.2, size), layout="constrained")
    colors = plt.get_cmap("RdBu_r").with_extremes(bad="0.8")
    picture = axis.imshow(np.ma.masked_invalid(correlation), cmap=colors, vmin=-1, vmax=1)
    figure.colorbar(picture, ax=axis, label="correlation", shrink=0.8)
    ticks = range(len(names)) if len(names) <= MOST_NAMES else []
    axis.set_xticks(ticks, [names[k] for k in ticks], rotation=90, fontsize=8)
    axis.set_yticks(ticks, [names[k] for k in ticks], fontsize=8)
    for i, j in np.argwhere(np.isfinite(correlation)) if len(names) <= MOST_NUMBERS else []:
        dark = abs(correlation[i, j]) > 0.6
        text = f"{correlation[i, j]:.2f}".replace("-0.00", "0.00")
        axis.text(j, i, text, ha="center", va="center", fontsize=8, color="white" if dark else "black")
    return figure


def plot_net(position: Any, edges: Any, values: Any, *, label: str = "ks [N/m]", pinned: Any = None) -> Figure:
    """Draw a net of springs, each in the colour of its value.

    Positions in space are seen along the direction in which the net is thinnest, positions on a line from its side.

    Args:
      position: (particle, dim), m.
      edges: (spring, 2), indices of particles.
      values: (spring,); NaN is grey.
      label: of the values, with their unit.
      pinned: (particle,), boolean: drawn as squares.
    Returns: the matplotlib figure.
    Raises: ValueError, if the shapes do not agree.
    Example:
      >>> from jeuler.plotting import plot_net
      >>> figure = plot_net([[0.0, 0.0], [1.0, 0.0], [0.5, 1.0]], [[0, 1], [1, 2]], [20.0, 30.0])
    """
    position, edges, values = np.asarray(position, float), np.asarray(edges, int), np.asarray(values, float)
    if position.ndim != 2 or edges.shape != (len(values), 2):
        raise ValueError(
            f"edges must be (spring, 2) with {len(values)} springs and position (particle, dim), "
            f"got {edges.shape} and {position.shape}"
        )
    flat = _in_a_plane(position)
    figure, axis = plt.subplots(figsize=(6, 4.2), layout="constrained")
    width = float(np.clip(60 / np.sqrt(max(len(edges), 1)), 1.0, 4.0))
    colors = plt.get_cmap("viridis").with_extremes(bad="0.7")
    lines = LineCollection(flat[edges].tolist(), cmap=colors, linewidths=width, array=np.ma.masked_invalid(values))
    axis.add_collection(lines)
    held = np.zeros(len(position), bool) if pinned is None else np.asarray(pinned, bool)
    axis.plot(*flat[~held].T, "o", color="0.2", markersize=width + 1)
    axis.plot(*flat[held].T, "s", color="0.2", markersize=width + 3)
    figure.colorbar(lines, ax=axis, label=label)
    axis.set_aspect("equal", adjustable="datalim")
    axis.margins(0.08)
    axis.autoscale_view()
    axis.set_axis_off()
    return figure


def _in_a_plane(position: np.ndarray) -> np.ndarray:
    """Positions as (particle, 2)."""
    count, dim = position.shape
    if dim == 1:
        return np.concatenate([position, np.zeros((count, 1))], axis=1)
    if dim == 2:
        return position
    away = position - position.mean(axis=0)
    _, _, axes = np.linalg.svd(away, full_matrices=False)
    return away @ axes[:2].T


def plot_history(history: Any) -> Figure:
    """Draw the loss after each iteration.

    Args:
      history: (iteration,).
    Returns: the matplotlib figure.
    Example:
      >>> from jeuler.plotting import plot_history
      >>> figure = plot_history([1.0, 0.1, 0.02])
    """
    history = np.asarray(history, float)
    figure, axis = plt.subplots(figsize=(6, 2.6), layout="constrained")
    axis.plot(1 + np.arange(len(history)), history, "o-", color=COLORS[0], markersize=3, linewidth=1.2)
    if (history > 0).all() and len(history):
        axis.set_yscale("log")
    axis.set(xlabel="iteration", ylabel="loss")
    axis.xaxis.set_major_locator(MaxNLocator(integer=True))
    axis.spines[["top", "right"]].set_visible(False)
    return figure
