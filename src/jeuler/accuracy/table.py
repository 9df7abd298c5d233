"""The table that work_precision returns, and what is read off it: order, roundoff floor, Pareto front."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from jeuler._core.component import result
from jeuler._core.describe import table

NAN = math.nan
EMPTY_ROW: dict[str, Any] = {
    "method": "",
    "dtype": "",
    "dt": NAN,
    "tolerance": NAN,
    "num_steps": -1,
    "evaluations": -1,
    "compile_seconds": NAN,
    "run_seconds": (),
    "run_seconds_min": NAN,
    "run_seconds_median": NAN,
    "error_final": NAN,
    "error_final_relative": NAN,
    "error_max": NAN,
    "error_max_relative": NAN,
    "error_l2": NAN,
    "error_l2_relative": NAN,
    "gradient_error": NAN,
    "gradient_error_relative": NAN,
    "gradient_compile_seconds": NAN,
    "gradient_seconds": (),
    "gradient_seconds_min": NAN,
    "gradient_seconds_median": NAN,
    "gradient_bytes": -1,
    "pareto": False,
    "reason": "",
}


@result
class Summary:
    """What the rows of one method in one precision say together.

    Attributes:
      method, dtype: whose rows.
      order: slope of log error against log dt, from the points above the floor; NaN with fewer than two.
      roundoff_floor: the error below which more steps do not get; NaN if the sweep did not reach it.
      floor_dt: the dt at which more steps stop helping, s; NaN if the sweep did not reach it.
      stability_limit: largest stable dt at the initial state, s; inf if none, 0.0 if no dt is, NaN if unknown.
    """

    method: str
    dtype: str
    order: float
    roundoff_floor: float
    floor_dt: float
    stability_limit: float


@result
class WorkPrecision:
    """Error against seconds, one row a run.

    Attributes:
      rows: a list of dictionaries, ready for ``pandas.DataFrame(table.rows)``: method, dtype, dt (s; NaN for
        adaptive runs), tolerance (NaN for fixed steps), num_steps, evaluations (of f), compile_seconds,
        run_seconds (every repeat), run_seconds_min, run_seconds_median; error_final, error_max, error_l2
        (Euclidean norm over the state; at t1, largest over the saved times, root mean square over them) and
        each with _relative; gradient_error, gradient_error_relative, gradient_compile_seconds,
        gradient_seconds, gradient_seconds_min, gradient_seconds_median, gradient_bytes (temporary memory);
        pareto (no other row is both faster and more accurate); reason (why a row is NaN; empty if it is not).
      stability_limits: largest stable dt of each method at the initial state, s.
      reference_error: how far the reference itself may be trusted at t1; errors below say nothing.
      interval: (t0, t1), s.
    Example:
      >>> import jeuler
      >>> table = jeuler.work_precision(lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1, 0.01, 0.001],
      ...     steps={"Euler": jeuler.euler_step}, reference=lambda t: 2.718281828459045**-t, repeats=1)
      >>> [(row["num_steps"], round(row["error_final_relative"], 4)) for row in table.rows]
      [(10, 0.0522), (100, 0.005), (1000, 0.0005)]
      >>> round(table.summary[0].order, 1), round(table.stability_limits["Euler"], 6)
      (1.0, 2.0)

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.10.
    """

    rows: list[dict[str, Any]]
    stability_limits: dict[str, float]
    reference_error: float
    interval: tuple[float, float]

    def series(self) -> Iterator[tuple[str, str, list[dict[str, Any]]]]:
        """(method, dtype, its fixed-step rows from coarse to fine)."""
        for method, dtype in dict.fromkeys((row["method"], row["dtype"]) for row in self.rows):
            own = [r for r in self.rows if (r["method"], r["dtype"]) == (method, dtype) and math.isfinite(r["dt"])]
            yield method, dtype, sorted(own, key=lambda row: -row["dt"])

    @property
    def summary(self) -> list[Summary]:
        """Order, floor and stability limit of each method in each precision."""
        found = []
        for method, dtype, rows in self.series():
            least = self.reference_error
            rows = [row for row in rows if math.isfinite(row["error_final"]) and row["error_final"] > least]
            dt = np.array([row["dt"] for row in rows])
            error = np.array([row["error_final"] for row in rows])
            relative = np.array([row["error_final_relative"] for row in rows])
            floor, floor_dt = roundoff_floor(dt, error)
            order = fitted_order(dt, error, relative, floor, floor_dt)
            limit = self.stability_limits.get(method, NAN)
            found.append(Summary(method, dtype, order, floor, floor_dt, limit))
        return found

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write every row, every column; repeats separated by spaces."""
        with open(path, "w", newline="") as file:
            writer = csv.DictWriter(file, list(EMPTY_ROW))
            writer.writeheader()
            for row in self.rows:
                writer.writerow({k: " ".join(map(repr, v)) if isinstance(v, tuple) else v for k, v in row.items()})

    def to_markdown(self) -> str:
        """One line a method and dt (or tolerance); each precision has its columns. Bold: on the Pareto front."""
        dtypes = list(dict.fromkeys(row["dtype"] for row in self.rows))
        gradient = any(math.isfinite(row["gradient_error"]) for row in self.rows)
        columns = [
            "relative error",
            "seconds",
            *(["gradient error", "gradient seconds", "MiB"] if gradient else []),
        ]
        head = ["method", "dt, s", "steps", "evaluations"] + [f"{c}, {d}" for d in dtypes for c in columns]
        lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
        grid: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
        for row in self.rows:
            fixed = math.isfinite(row["dt"])
            key = row["method"], f"{row['dt']:.3g}" if fixed else f"tolerance {row['tolerance']:.0e}"
            grid.setdefault(key, {})[row["dtype"]] = row
        for (method, size), by_dtype in grid.items():
            first = next(iter(by_dtype.values()))
            cells = [method, size, _count(first["num_steps"]), _count(first["evaluations"])]
            for dtype in dtypes:
                row = by_dtype.get(dtype, {"reason": "-"})
                if row["reason"]:
                    cells += [row["reason"], *[""] * (len(columns) - 1)]
                    continue
                error = f"{row['error_final_relative']:.1e}"
                cells += [f"**{error}**" if row["pareto"] else error, f"{row['run_seconds_min']:.2e}"]
                if gradient:
                    cells += [f"{row['gradient_error_relative']:.1e}", f"{row['gradient_seconds_min']:.2e}"]
                    cells += [f"{row['gradient_bytes'] / 2**20:.2f}"]
            lines.append("| " + " | ".join(cells) + " |")
        return "\n".join(lines)

    def _repr_html_(self) -> str:
        lines = (line.removeprefix("|").removesuffix("|").split("|") for line in self.to_markdown().splitlines())
        head, _, *rows = ([cell.strip("* ") for cell in cells] for cells in lines)
        return table("WorkPrecision", rows, head)

    def plot(self, ax: Any = None) -> Any:
        """Error against seconds and error against dt, logarithmic, each method labelled at its line.

        Args:
          ax: None makes a figure with both; one axes takes error against seconds; a pair takes both.
        Returns: the axes drawn on, a matplotlib axes or a pair of them.
        """
        from jeuler.plotting.accuracy import plot_work_precision

        return plot_work_precision(self, ax)


def _count(n: int) -> str:
    return f"{n:,}" if n >= 0 else "-"


def mark_pareto(rows: list[dict[str, Any]], reference_error: float = 0.0) -> None:
    """Mark the rows that no other row beats in both error and seconds; an error of over 100 % is no result.

    Nor is one below that of the reference.
    """
    for row in rows:
        row["pareto"] = False
    best = math.inf
    known = [row for row in rows if math.isfinite(row["error_final"]) and row["error_final"] >= reference_error]
    able = [row for row in known if not row["error_final_relative"] > 1]
    for row in sorted(able, key=lambda row: (row["run_seconds_min"], row["error_final"])):
        if row["error_final"] < best:
            row["pareto"], best = True, row["error_final"]


def roundoff_floor(dt: np.ndarray, error: np.ndarray) -> tuple[float, float]:
    """The error at which halving dt no longer takes a third off it, and that dt; NaN where that never happens.

    dt falls. The floor begins at the largest dt for which every dt of half its size or less has at least 2/3 of its
    error.
    """
    for i in range(len(dt)):
        finer = error[dt <= dt[i] / 2 * (1 + 1e-6)]
        if finer.size and np.all(finer >= error[i] * 2 / 3):
            return float(error[i:].min()), float(dt[i])
    return NAN, NAN


def fitted_order(
    dt: np.ndarray, error: np.ndarray, relative: np.ndarray, floor: float = NAN, floor_dt: float = NAN
) -> float:
    """Least-squares slope of log error over log dt from the finest four points that are above the floor.

    Above the floor: dt > floor_dt and four times the floor; and not beyond 30 % relative error, where no power law
    holds.
    """
    use = np.isfinite(error) & (error > 0) & ~(relative > 0.3)
    if math.isfinite(floor):
        use &= (dt > floor_dt) & (error > 4 * floor)
    dt, error = dt[use][-4:], error[use][-4:]
    if len(dt) < 2:
        return NAN
    return float(np.polyfit(np.log(dt), np.log(error), 1)[0])
