"""The work-precision figure: error against seconds, and error against dt."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

LINE = {"float64": "-", "float32": "--", "adaptive": ":"}


def plot_work_precision(table: Any, ax: Any = None) -> Any:
    """Draw a `WorkPrecision` table: each method a line with its name at the end.

    Left, relative error at t1 against the least seconds of a run, the Pareto front ringed; right, against dt, with
    the roundoff floor as a level line where the sweep reached it and the stability limit as a mark on the axis.

    Args:
      table: what `work_precision` returned.
      ax: None makes a figure with both; one axes takes error against seconds; a pair takes both.
    Returns: the axes drawn on, one or a pair.
    """
    if ax is None:
        _, ax = plt.subplots(1, 2, figsize=(13, 6), constrained_layout=True, sharey=True)
    pair = isinstance(ax, (tuple, list, np.ndarray))
    left, right = ax if pair else (ax, None)
    methods = list(dict.fromkeys(row["method"] for row in table.rows))
    colour = {method: plt.get_cmap("tab10" if len(methods) <= 10 else "tab20")(i) for i, method in enumerate(methods)}
    several = len({row["dtype"] for row in table.rows}) > 1
    labels: dict[Any, list] = {left: [], right: []}
    for method in methods:
        for dtype in dict.fromkeys(row["dtype"] for row in table.rows):
            own = [r for r in table.rows if (r["method"], r["dtype"]) == (method, dtype) and _drawable(r)]
            fixed = sorted((r for r in own if math.isfinite(r["dt"])), key=lambda r: -r["dt"])
            adaptive = sorted((r for r in own if math.isfinite(r["tolerance"])), key=lambda r: -r["tolerance"])
            name = f"{method}, {dtype}" if several else method
            for rows, style in ((fixed, LINE[dtype]), (adaptive, LINE["adaptive"])):
                if not rows:
                    continue
                label = name if rows is fixed else f"{name}, adaptive"
                for axes, column in ((left, "run_seconds_min"), (right, "dt")):
                    if axes is None or (axes is right and rows is adaptive):
                        continue
                    x, y = [r[column] for r in rows], [r["error_final_relative"] for r in rows]
                    axes.loglog(x, y, style, marker="o", markersize=3, color=colour[method], linewidth=1.2)
                    labels[axes].append((x[-1], y[-1], label, colour[method]))
            if right is not None:
                _limits(right, table, method, dtype, colour[method])
    front = [r for r in table.rows if r["pareto"] and _drawable(r)]
    left.loglog(
        [r["run_seconds_min"] for r in front],
        [r["error_final_relative"] for r in front],
        "o",
        markersize=9,
        markerfacecolor="none",
        markeredgecolor="0.3",
        markeredgewidth=0.8,
    )
    left.set(xlabel="seconds for one run", ylabel="relative error at the end")
    left.set_title("rings: no other run is both faster and more accurate", fontsize=9, color="0.3")
    if right is not None:
        right.set(xlabel="dt, s")
        right.set_title("triangles: largest stable dt; level lines: roundoff floor", fontsize=9, color="0.3")
        right.invert_xaxis()
    for axes in (left, right):
        if axes is not None:
            axes.grid(True, which="major", color="0.9", linewidth=0.6)
            axes.spines[["top", "right"]].set_visible(False)
            label_ends(axes, labels[axes])
    return ax


def _drawable(row: dict) -> bool:
    return row["error_final_relative"] > 0 and math.isfinite(row["error_final_relative"])


def _limits(axes: Any, table: Any, method: str, dtype: str, colour: Any) -> None:
    """The roundoff floor and the stability limit of one method, if the sweep came near them."""
    (summary,) = [s for s in table.summary if (s.method, s.dtype) == (method, dtype)]
    size = [r["error_final"] / r["error_final_relative"] for r in table.rows if _drawable(r)]
    dts = [r["dt"] for r in table.rows if math.isfinite(r["dt"])]
    if math.isfinite(summary.roundoff_floor) and size:
        level = summary.roundoff_floor / size[0]
        axes.hlines(level, min(dts), summary.floor_dt, color=colour, linewidth=0.8, linestyle=(0, (1, 2)))
    if 0 < summary.stability_limit < math.inf and min(dts) / 4 < summary.stability_limit < max(dts) * 4:
        transform = axes.get_xaxis_transform()
        axes.plot(summary.stability_limit, 0.985, "v", color=colour, markersize=6, transform=transform, clip_on=False)


def label_ends(axes: Any, labels: list[tuple[float, float, str, Any]]) -> None:
    """Write each label to the right of its point, moved up or down until none covers another."""
    axes.margins(x=0.03)
    axes.figure.canvas.draw()
    low, high = axes.get_xlim()
    inverted = low > high
    spread = (max(low, high) / min(low, high)) ** (0.42 if len(labels) > 8 else 0.3)
    axes.set_xlim((low, high / spread) if inverted else (low, high * spread))
    height = axes.get_window_extent().height
    step = 11 * axes.figure.dpi / 72  # pixels a line of text takes
    points = sorted(((*axes.transData.transform((x, y)), label, colour) for x, y, label, colour in labels), key=lambda p: p[1])
    base = axes.get_window_extent().y0
    placed: list[tuple[float, float]] = []
    for x, y, label, colour in points:
        at = min(max(y, base), base + height)
        while any(abs(at - other) < step and abs(x - x_other) < 14 * step for x_other, other in placed):
            at += step / 4
        placed.append((x, at))
        to_data = axes.transData.inverted().transform
        axes.annotate(
            label,
            xy=to_data((x, y)),
            xytext=to_data((x + 10, at)),
            color=colour,
            fontsize=8,
            va="center",
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5, "shrinkA": 0, "shrinkB": 1},
        )
