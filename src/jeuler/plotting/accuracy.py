"""The work-precision figure: error against seconds, evaluations or dt."""

from __future__ import annotations

import math
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.ticker import EngFormatter, LogLocator, NullFormatter

WORST = 3.0  # relative errors above this are off the figure
COSTS = {"seconds": "time of one run", "evaluations": "evaluations of f", "dt": "dt, s"}
ERRORS = {
    "final": "relative error at the end",
    "max": "largest relative error",
    "l2": "relative error, root mean square",
    "gradient": "relative error of the gradient",
}
NOTES = {
    "seconds": "rings mark runs that none beats in both time and error",
    "evaluations": "rings mark runs that none beats in both evaluations and error",
    "dt": "triangles, largest stable dt; dotted level, roundoff floor",
}


def plot_work_precision(table: Any, ax: Any = None, *, against: Any = ("seconds", "dt"), error: str = "final") -> Any:
    """Draw a `WorkPrecision` table: each method a line with its name beside it, adaptive runs dotted.

    Against seconds (the least of a run) and evaluations the Pareto front is ringed; against dt, the roundoff floor is
    a level line where the sweep reached it, and the largest stable dt a triangle. One row of axes for each problem and
    precision.

    Args:
      table: what `work_precision` returned.
      ax: None makes a figure; otherwise one axes for each of ``against``, which take all problems and precisions.
      against: "seconds", "evaluations", "dt", or several of them, a column of axes each.
      error: "final", "max", "l2" or "gradient".
    Returns: the axes drawn on: (problem and precision, len(against)), or as given.
    Raises: ValueError for other words, or another number of axes.
    Example:
      >>> import jeuler
      >>> from jeuler.plotting import plot_work_precision
      >>> table = jeuler.work_precision(lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1, 0.01],
      ...     steps={"Euler": jeuler.euler_step}, reference=lambda t: 2.718281828459045**-t, repeats=1)
      >>> axes = plot_work_precision(table, against=("evaluations", "dt"))
      >>> axes.shape, axes[0, 0].get_xlabel(), axes[0, 1].get_xlabel()
      ((1, 2), 'evaluations of f', 'dt, s')

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.10.
    """
    against = (against,) if isinstance(against, str) else tuple(against)
    wrong = [x for x in against if x not in COSTS]
    if wrong or not against:
        raise ValueError(f"against must be of {', '.join(map(repr, COSTS))}, got {wrong[0] if wrong else against!r}")
    if error not in ERRORS:
        raise ValueError(f"error must be one of {', '.join(map(repr, ERRORS))}, got {error!r}")
    groups = list(dict.fromkeys((row["problem"], row["dtype"]) for row in table.rows))
    if ax is None:
        size = 6.5 * len(against), 5.2 * len(groups)
        _, ax = plt.subplots(len(groups), len(against), figsize=size, layout="constrained", sharey="row", squeeze=False)
        rows = [
            (line, table.where(problem=problem, dtype=dtype)) for line, (problem, dtype) in zip(ax, groups, strict=True)
        ]
        labels = [[_draw(each, own, x, error) for each, x in zip(line, against, strict=True)] for line, own in rows]
        for line, own_labels, (problem, dtype) in zip(ax, labels, groups, strict=True):
            line[0].set_ylabel(ERRORS[error])
            for each, x, ends in zip(line, against, own_labels, strict=True):
                each.set_title(f"{f'{problem}, ' * bool(problem)}{dtype}: {NOTES[x]}", fontsize=9)
                _finish(each, x, ends)
        return ax
    axes = list(ax) if isinstance(ax, (tuple, list, np.ndarray)) else [ax]
    against = against[: len(axes)]
    if len(axes) != len(against):
        raise ValueError(f"ax must be one axes for each of against={against}, got {len(axes)}")
    axes[0].set_ylabel(ERRORS[error])
    for each, x, ends in [(each, x, _draw(each, table, x, error)) for each, x in zip(axes, against, strict=True)]:
        _finish(each, x, ends)
    return ax


def _draw(axes: Any, table: Any, against: str, error: str) -> list[Any]:
    """The lines of all methods against one cost; where their labels belong."""
    methods = list(dict.fromkeys(row["method"] for row in table.rows))
    colours = plt.get_cmap("tab10" if len(methods) <= 10 else "tab20")
    cost, size = _columns(against, error)
    labels: list[Any] = []
    for problem, method, dtype in dict.fromkeys((r["problem"], r["method"], r["dtype"]) for r in table.rows):
        own = table.where(problem=problem, method=method, dtype=dtype)
        rows = [row for row in own.rows if 0 < row[size] < WORST and row[cost] > 0]
        extra = [problem] * (len(table.problems) > 1) + [dtype] * (len(table.dtypes) > 1)
        colour = colours(methods.index(method) % colours.N)
        labels += _lines(axes, rows, cost, size, ", ".join([method, *extra]), colour)
        if against == "dt" and error == "final":
            _limits(axes, own, colour)
    if against != "dt":
        for problem in table.problems:
            best = table.where(problem=problem).front(against, error)
            x, y = ([row[column] for row in best if row[size] > 0] for column in (cost, size))
            axes.loglog(x, y, "o", markersize=9, markerfacecolor="none", markeredgecolor="0.3", markeredgewidth=0.8)
    axes.set(xlabel=COSTS[against], xscale="log", yscale="log")
    if against == "dt":
        axes.invert_xaxis()
    return labels


def _columns(against: str, error: str) -> tuple[str, str]:
    """The columns of a table that are drawn."""
    if error == "gradient":
        return {"seconds": "gradient_seconds_min"}.get(against, against), "gradient_error_relative"
    return {"seconds": "run_seconds_min"}.get(against, against), f"error_{error}_relative"


def _finish(axes: Any, against: str, labels: list[Any]) -> None:
    """What needs the final limits of the axes: the labels, last."""
    axes.grid(True, which="major", color="0.92", linewidth=0.6)
    axes.spines[["top", "right"]].set_visible(False)
    if against == "seconds":
        _seconds(axes.xaxis)
    label_ends(axes, labels)


def _seconds(axis: Any) -> None:
    """Ticks as 10 us, 1 ms: also at 2 and 5 where the axis has less than two decades."""
    low, high = axis.get_view_interval()
    axis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 100 * low else (1,)))
    axis.set_major_formatter(EngFormatter(unit="s", sep="\N{NO-BREAK SPACE}"))
    axis.set_minor_formatter(NullFormatter())


def _lines(axes: Any, rows: list[dict[Any, Any]], cost: str, size: str, name: str, colour: Any) -> list[Any]:
    """One method in one precision: its fixed steps as a line, its tolerances as a dotted one; where labels belong."""
    labels = []
    fixed = sorted((r for r in rows if math.isfinite(r["dt"])), key=lambda r: -r["dt"])
    adaptive = sorted((r for r in rows if math.isfinite(r["rtol"])), key=lambda r: (-r["rtol"], -r["atol"]))
    for own, style, label in ((fixed, "-", name), (adaptive, ":", f"{name}, adaptive")):
        if own:
            x, y = [row[cost] for row in own], [row[size] for row in own]
            axes.loglog(x, y, style, marker="o", markersize=3, color=colour, linewidth=1.2)
            labels.append((x[-1], y[-1], label, colour))
    return labels


def _limits(axes: Any, own: Any, colour: Any) -> None:
    """The roundoff floor and the stability limit of one method, if the sweep came near them."""
    scales = [r["error_final_relative"] / r["error_final"] for r in own.rows if 0 < r["error_final_relative"] < WORST]
    dts = [r["dt"] for r in own.rows if math.isfinite(r["dt"])]
    for summary in own.summary:
        if math.isfinite(summary.roundoff_floor) and scales:
            level = summary.roundoff_floor * scales[0]
            axes.hlines(level, min(dts), summary.floor_dt, color=colour, linewidth=1.0, linestyle=(0, (1, 2)))
        limit = summary.stability_limit
        if dts and 0 < limit < math.inf and min(dts) / 4 < limit < max(dts) * 4:
            where = axes.get_xaxis_transform()
            axes.plot(limit, 0.985, "v", color=colour, markersize=6, transform=where, clip_on=False)


def axes_or_new(ax: Any, size: tuple[float, float] = (7, 4.2)) -> Any:
    """The axes given, or those of a new figure."""
    if ax is None:
        _, ax = plt.subplots(figsize=size, layout="constrained")
    ax.spines[["top", "right"]].set_visible(False)
    return ax


def label_ends(axes: Any, labels: list[Any]) -> None:
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
