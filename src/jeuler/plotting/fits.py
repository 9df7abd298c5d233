"""The picture of a fit: data and model over time, and what is left between them."""

from __future__ import annotations

from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

COLORS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")  # Okabe-Ito, safe for colour-blind eyes


def plot_fit(
    times: Any,
    observed: Any,
    predicted: Any,
    *,
    names: tuple[str, ...] | None = None,
    curve: tuple[Any, Any] | None = None,
    title: str = "",
    unit: str = "m",
) -> Figure:
    """Draw data, fit and residual.

        residual_k = observed_k - predicted_k

    Args:
      times: (time,), s.
      observed: (time, column); NaN = not observed.
      predicted: the model at the same times, (time, column).
      names: one label a column.
      curve: times and values of a finer curve to draw for the model, (t,) and (t, column); None joins ``predicted``.
      title: above the figure.
      unit: of the values.
    Returns: the matplotlib figure: data and fit above, residual below, on one time axis.
    Raises: ValueError, if the shapes do not agree.
    Example:
      >>> import numpy as np
      >>> from jeuler.plotting import plot_fit
      >>> t = np.linspace(0, 1, 20)
      >>> figure = plot_fit(t, np.sin(6 * t)[:, None], np.sin(6.1 * t)[:, None], names=("x",))
      >>> len(figure.axes)
      2

    Source: W. S. Cleveland, The Elements of Graphing Data, 1985, ch. 1 (show the residuals).
    """
    times, observed, predicted = (np.asarray(x, float) for x in (times, observed, predicted))
    if observed.shape != predicted.shape or observed.ndim != 2 or len(times) != len(observed):
        raise ValueError(
            f"observed and predicted must both have shape (time, column) with {len(times)} times, "
            f"got {observed.shape} and {predicted.shape}"
        )
    curve_times, curve_values = (times, predicted) if curve is None else map(np.asarray, curve)
    figure, (above, below) = plt.subplots(
        2, 1, figsize=(8, 5.2), sharex=True, height_ratios=(2.4, 1), layout="constrained"
    )
    residual = observed - predicted
    for k in range(observed.shape[1]):
        if not np.isfinite(observed[:, k]).any():
            continue
        color, name = COLORS[k % len(COLORS)], names[k] if names else f"column {k + 1}"
        above.plot(curve_times, curve_values[:, k], color=color, linewidth=1.4, label=f"{name}, fit")
        above.plot(
            times, observed[:, k], "o", color=color, markersize=3, alpha=0.45, markeredgewidth=0, label=f"{name}, data"
        )
        below.plot(times, residual[:, k], "o", color=color, markersize=2.2, alpha=0.6, markeredgewidth=0)
    rms = float(np.sqrt(np.nanmean(residual**2)))
    below.axhline(0, color="0.3", linewidth=0.8)
    below.axhspan(-rms, rms, color="0.85", zorder=0)
    below.annotate(
        f"RMS {rms:.3g} {unit}".rstrip(), (0.995, 0.04), xycoords="axes fraction", ha="right", va="bottom", fontsize=9
    )
    above.set_ylabel(in_unit("position", unit))
    below.set_ylabel(in_unit("data − fit", unit))
    below.set_xlabel("time [s]")
    above.legend(loc="upper right", fontsize=8, ncols=2, framealpha=0.9)
    above.set_title(title, fontsize=10)
    for axis in (above, below):
        axis.spines[["top", "right"]].set_visible(False)
    return figure


def in_unit(words: str, unit: str) -> str:
    """The label of an axis; a reading without a unit has none."""
    return f"{words} [{unit}]" if unit else words


def plain_text(text: str) -> str:
    """A name to be drawn as it is: each $ escaped, which would start mathematics, and no control characters."""
    return "".join(c for c in text if c.isprintable()).replace("$", r"\$")
