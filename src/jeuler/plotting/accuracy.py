"""The work-precision figure: error against seconds, and error against dt."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

WORST = 3.0  # relative errors above this are off the figure


def plot_work_precision(table: Any, ax: Any = None) -> Any:
    """Draw a `WorkPrecision` table: each method a line with its name beside it.

    Left, relative error at t1 against the least seconds of a run, the Pareto front ringed, adaptive runs
    dotted; right, against dt, with the roundoff floor as a level line where the sweep reached it and the
    largest stable dt as a triangle. One such row of axes for each precision.

    Args:
      table: what `work_precision` returned.
      ax: None makes a figure; one axes takes error against seconds, a pair takes both, of all precisions.
    Returns: the axes drawn on: (precision, 2), or as given.
    Example:
      >>> import jeuler
      >>> from jeuler.plotting import plot_work_precision
      >>> table = jeuler.work_precision(lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1, 0.01],
      ...     steps={"Euler": jeuler.euler_step}, reference=lambda t: 2.718281828459045**-t, repeats=1)
      >>> axes = plot_work_precision(table)
      >>> axes.shape, axes[0, 1].get_xlabel()
      ((1, 2), 'dt, s')

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.10.
    """
    dtypes = list(dict.fromkeys(row["dtype"] for row in table.rows))
    if ax is None:
        _, ax = plt.subplots(
            len(dtypes), 2, figsize=(13, 5.2 * len(dtypes)), layout="constrained", sharey=True, squeeze=False
        )
        labels = [_draw(pair, table, [dtype]) for pair, dtype in zip(ax, dtypes, strict=True)]
        for pair, own_labels, dtype in zip(ax, labels, dtypes, strict=True):
            _finish(pair, own_labels)
            pair[0].set_title(f"{dtype}: rings mark runs that none beats in both time and error", fontsize=9)
            pair[1].set_title(f"{dtype}: triangles, largest stable dt; dotted level, roundoff floor", fontsize=9)
    else:
        axes = ax if isinstance(ax, (tuple, list, np.ndarray)) else (ax,)
        _finish(axes, _draw(axes, table, dtypes))
    return ax


def _draw(axes: Any, table: Any, dtypes: list[str]) -> list[list[Any]]:
    methods = list(dict.fromkeys(row["method"] for row in table.rows))
    colours = plt.get_cmap("tab10" if len(methods) <= 10 else "tab20")
    labels: list[list[Any]] = [[] for _ in axes]
    for index, method in enumerate(methods):
        for dtype in dtypes:
            own = [r for r in table.rows if (r["method"], r["dtype"]) == (method, dtype) and _drawable(r)]
            name = method if len(dtypes) == 1 else f"{method}, {dtype}"
            _lines(axes, own, name, colours(index), labels)
            if len(axes) == 2:
                _limits(axes[1], table, method, dtype, colours(index))
    front = [r for r in table.rows if r["pareto"] and r["dtype"] in dtypes and _drawable(r)]
    x, y = ([r[column] for r in front] for column in ("run_seconds_min", "error_final_relative"))
    axes[0].loglog(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor="0.3", markeredgewidth=0.8)
    axes[0].set(xlabel="time of one run", ylabel="relative error at the end")
    if len(axes) == 2:
        axes[1].set(xlabel="dt, s")
        axes[1].invert_xaxis()
    return labels


def _finish(axes: Any, labels: list[list[Any]]) -> None:
    """What needs the final limits of the axes: the labels, last."""
    for each, own_labels in zip(axes, labels, strict=True):
        each.grid(True, which="major", color="0.92", linewidth=0.6)
        each.spines[["top", "right"]].set_visible(False)
        if each is axes[0]:
            _seconds(each.xaxis)
        label_ends(each, own_labels)


def _seconds(axis: Any) -> None:
    """Ticks as 10 us, 1 ms: also at 2 and 5 where the axis has less than two decades."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(EngFormatter(unit="s", sep="\N{NO-BREAK SPACE}"))
    axis.set_minor_formatter(NullFormatter())


def _lines(axes: Any, rows: list[dict[Any, Any]], name: str, colour: Any, labels: list[list[Any]]) -> None:
    """One method in one precision: its fixed steps as a line, its tolerances as a dotted one."""
    fixed = sorted((r for r in rows if math.isfinite(r["dt"])), key=lambda r: -r["dt"])
    adaptive = sorted((r for r in rows if math.isfinite(r["tolerance"])), key=lambda r: -r["tolerance"])
    runs = [
        (0, fixed, "run_seconds_min", "-", name),
        (0, adaptive, "run_seconds_min", ":", f"{name}, adaptive"),
    ]
    if len(axes) == 2:
        runs.append((1, fixed, "dt", "-", name))
    for place, own, column, style, label in runs:
        if own:
            x, y = [r[column] for r in own], [r["error_final_relative"] for r in own]
            axes[place].loglog(x, y, style, marker="o", markersize=3, color=colour, linewidth=1.2)
            labels[place].append((x[-1], y[-1], label, colour))


def _drawable(row: dict[Any, Any]) -> bool:
    return 0 < row["error_final_relative"] < WORST


def _limits(axes: Any, table: Any, method: str, dtype: str, colour: Any) -> None:
    """The roundoff floor and the stability limit of one method, if the sweep came near them."""
    summaries = [s for s in table.summary if (s.method, s.dtype) == (method, dtype)]
    scales = [r["error_final_relative"] / r["error_final"] for r in table.rows if _drawable(r)]
    dts = [r["dt"] for r in table.rows if math.isfinite(r["dt"])]
    for summary in summaries:
        if math.isfinite(summary.roundoff_floor) and scales:
            level = summary.roundoff_floor * scales[0]
            axes.hlines(level, min(dts), summary.floor_dt, color=colour, linewidth=1.0, linestyle=(0, (1, 2)))
        if 0 < summary.stability_limit < math.inf and min(dts) / 4 < summary.stability_limit < max(dts) * 4:
            where = axes.get_xaxis_transform()
            axes.plot(
                summary.stability_limit,
                0.985,
                "v",
                color=colour,
                markersize=6,
                transform=where,
                clip_on=False,
            )


def axes_or_new(ax: Any, size: tuple[float, float] = (7, 4.2)) -> Any:
    """The axes given, or those of a new figure."""
    if ax is None:
        _, ax = plt.subplots(figsize=size, layout="constrained")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def label_ends(axes: Any, labels: list[tuple[float, float, str, Any]]) -> None:
    """Write the labels in a column beside the axes, in the order of the points, each joined to its own by a thin line.

    labels: x, y (data), text, colour.
    """
    axes.figure.draw_without_rendering()
    low, high = axes.get_window_extent().y0, axes.get_window_extent().y1
    line = min(13 * axes.figure.dpi / 72, (high - low) / max(1, len(labels)))
    ends = sorted(((axes.transData.transform((x, y))[1], x, y, text, colour) for x, y, text, colour in labels))
    heights = [max(end[0], low + line * i) for i, end in enumerate(ends)]
    for i in range(1, len(heights)):
        heights[i] = max(heights[i], heights[i - 1] + line)
    top = high
    for i in reversed(range(len(heights))):
        top = heights[i] = min(heights[i], top)
        top -= line
    for height, (_, x, y, text, colour) in zip(heights, ends, strict=True):
        axes.annotate(
            text,
            xy=(x, y),
            xytext=(1.04, (height - low) / (high - low)),
            textcoords="axes fraction",
            color=colour,
            fontsize=8,
            va="center",
            annotation_clip=False,
            arrowprops={
                "arrowstyle": "-",
                "color": colour,
                "linewidth": 0.4,
                "alpha": 0.6,
                "shrinkA": 0,
                "relpos": (0, 0.5),
            },
        )
