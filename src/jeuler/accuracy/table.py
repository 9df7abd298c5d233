"""The table that work_precision returns, and what is read off it: order, roundoff floor, Pareto front."""

from __future__ import annotations

import csv
import io
import math
import os
from collections.abc import Iterator
from typing import Any

import numpy as np

from jeuler._core import checks
from jeuler._core.component import result
from jeuler._core.describe import table, text_table
from jeuler._core.files import write_text
from jeuler.accuracy.markdown import markdown

NAN = math.nan
EMPTY_ROW: dict[str, Any] = {
    "problem": "",
    "method": "",
    "dtype": "",
    "dt": NAN,
    "rtol": NAN,
    "atol": NAN,
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
    "stability_limit": NAN,
    "reference_error": NAN,
    "t0": NAN,
    "t1": NAN,
    "reason": "",
}


@result
class Summary:
    """What the rows of one method in one precision say together.

    Attributes:
      problem, method, dtype: whose rows.
      order: slope of log error against log dt, from the points above the floor; NaN with fewer than two.
      roundoff_floor: the error below which more steps do not get; NaN if the sweep did not reach it.
      floor_dt: the dt at which more steps stop helping, s; NaN if the sweep did not reach it.
      stability_limit: largest stable dt at the initial state, s; inf if none, 0.0 if no dt is, NaN if unknown.
    """

    problem: str
    method: str
    dtype: str
    order: float
    roundoff_floor: float
    floor_dt: float
    stability_limit: float


@result
class WorkPrecision:
    """Error against seconds and evaluations, one row a run; ``a + b`` has the rows of both.

    Where two tables have a run in common (problem, method, precision, dt or tolerances), the sum has that of the
    second. Tables of one problem must agree on its interval and on its exact end state; give others a name,
    ``work_precision(problem=...)``.

    Attributes:
      rows: a list of dictionaries, ready for ``pandas.DataFrame(table.rows)``: problem, method, dtype, dt (s; NaN for
        adaptive runs), rtol and atol (NaN for fixed steps), num_steps, evaluations (of f, in that precision),
        compile_seconds (of the program that all dts of a method share), run_seconds (every repeat), run_seconds_min,
        run_seconds_median; error_final, error_max, error_l2 (norm of the error at t1, largest over the run, root mean
        square over it) and each with _relative; gradient_error, gradient_error_relative, gradient_compile_seconds,
        gradient_seconds, gradient_seconds_min, gradient_seconds_median, gradient_bytes (temporary memory); pareto (no
        other row of the problem is both faster and more accurate); stability_limit (largest stable dt of the method at
        the initial state, s), reference_error (how far the reference itself may be trusted at t1; errors below say
        nothing), t0, t1; reason (why a row has no errors; empty if it has).
    Example:
      >>> import jeuler
      >>> def table_of(steps):
      ...     return jeuler.work_precision(lambda t, y, args: -y, 1.0, t1=1.0, dts=[0.1, 0.01, 0.001], steps=steps,
      ...         reference=lambda t: 2.718281828459045**-t, repeats=1, problem="decay")
      >>> table = table_of({"Euler": jeuler.euler_step})
      >>> [(row["num_steps"], round(row["error_final_relative"], 4)) for row in table.rows]
      [(10, 0.0522), (100, 0.005), (1000, 0.0005)]
      >>> round(table.summary[0].order, 1), round(table.stability_limits["Euler"], 6)
      (1.0, 2.0)
      >>> [summary.method for summary in (table + table_of({"Heun": jeuler.heun_step})).summary]
      ['Euler', 'Heun']

    Source: E. Hairer, G. Wanner, Solving Ordinary Differential Equations II, 1996, sect. IV.10.
    """

    rows: list[dict[str, Any]]

    def __add__(self, other: Any) -> WorkPrecision:
        if not isinstance(other, WorkPrecision):
            return NotImplemented
        for problem in self.problems:
            _check_same(problem, self.where(problem=problem).rows, other.where(problem=problem).rows)
        rows = {_key(row): dict(row) for row in (*self.rows, *other.rows)}
        both = list(rows.values())
        mark_pareto(both)
        return WorkPrecision(both)

    def where(self, **wanted: Any) -> WorkPrecision:
        """The table of the rows that have these values, or one of a list of values: ``table.where(method="RK4")``.

        The Pareto marks stay those of the whole.
        """
        for name in wanted:
            if name not in EMPTY_ROW:
                raise ValueError(f"where takes columns of the table, {', '.join(EMPTY_ROW)}; got {name!r}")
        allowed = {name: value if isinstance(value, (list, tuple)) else [value] for name, value in wanted.items()}
        return WorkPrecision([row for row in self.rows if all(row[name] in allowed[name] for name in allowed)])

    def front(self, against: str = "seconds", error: str = "final") -> list[dict[str, Any]]:
        """The rows that no other of their problem beats in both cost and error, whatever the precision.

        against: "seconds" or "evaluations"; error: "final", "max", "l2" or "gradient".
        """
        name = "gradient" if error == "gradient" else "run"
        cost = f"{name}_seconds_min" if against == "seconds" else against
        size = "gradient_error" if error == "gradient" else f"error_{error}"
        of_each = ([row for row in self.rows if row["problem"] == problem] for problem in self.problems)
        return [row for rows in of_each for row in best_of(rows, cost, size)]

    @property
    def problems(self) -> list[str]:
        """The names of the problems, in the order of the rows."""
        return list(dict.fromkeys(row["problem"] for row in self.rows))

    @property
    def dtypes(self) -> list[str]:
        """The precisions, in the order of the rows."""
        return list(dict.fromkeys(row["dtype"] for row in self.rows))

    @property
    def stability_limits(self) -> dict[str, float]:
        """Largest stable dt of each method at the initial state, s, of a table of one problem."""
        self._only_problem("stability_limits")
        return {row["method"]: row["stability_limit"] for row in self.rows}

    @property
    def reference_error(self) -> float:
        """How far the reference may be trusted at t1, of a table of one problem."""
        self._only_problem("reference_error")
        return max((row["reference_error"] for row in self.rows), default=NAN)

    @property
    def interval(self) -> tuple[float, float]:
        """(t0, t1), s, of a table of one problem."""
        self._only_problem("interval")
        return self.rows[0]["t0"], self.rows[0]["t1"]

    def _only_problem(self, what: str) -> None:
        if len(self.problems) != 1:
            raise ValueError(
                f"{what} is that of one problem, got {self.problems}; write table.where(problem=...).{what}"
            )

    def series(self) -> Iterator[tuple[tuple[str, str, str], list[dict[str, Any]]]]:
        """(problem, method, dtype), and its fixed-step rows from coarse to fine."""
        for key in dict.fromkeys((row["problem"], row["method"], row["dtype"]) for row in self.rows):
            own = [r for r in self.rows if (r["problem"], r["method"], r["dtype"]) == key and math.isfinite(r["dt"])]
            yield key, sorted(own, key=lambda row: -row["dt"])

    @property
    def summary(self) -> list[Summary]:
        """Order, floor and stability limit of each method in each precision."""
        found = []
        for key, rows in self.series():
            limit = rows[0]["stability_limit"] if rows else NAN
            rows = [row for row in rows if row["error_final"] > row["reference_error"]]
            dt = np.array([row["dt"] for row in rows])
            error = np.array([row["error_final"] for row in rows])
            relative = np.array([row["error_final_relative"] for row in rows])
            floor, floor_dt = roundoff_floor(dt, error)
            order = fitted_order(dt, error, relative, floor, floor_dt)
            found.append(Summary(*key, order, floor, floor_dt, limit))
        return found

    def to_csv(self, path: str | os.PathLike[str]) -> None:
        """Write every row, every column; repeats separated by spaces. `from_csv` reads it back."""
        text = io.StringIO(newline="")
        writer = csv.DictWriter(text, list(EMPTY_ROW))
        writer.writeheader()
        for row in self.rows:
            writer.writerow({k: " ".join(map(repr, v)) if isinstance(v, tuple) else v for k, v in row.items()})
        write_text(path, text.getvalue())

    @classmethod
    def from_csv(cls, path: str | os.PathLike[str]) -> WorkPrecision:
        """The table that `to_csv` wrote, every number as it was."""
        with open(path, newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            if list(reader.fieldnames or []) != list(EMPTY_ROW):
                raise ValueError(
                    f"{os.fspath(path)} must have the columns that WorkPrecision.to_csv writes, "
                    f"{', '.join(EMPTY_ROW)}; got {checks.shown(reader.fieldnames)}"
                )
            rows = []
            for line, cells in enumerate(reader, 2):
                try:
                    rows.append({name: _read(cells[name], empty) for name, empty in EMPTY_ROW.items()})
                except (TypeError, ValueError) as error:
                    raise ValueError(f"{os.fspath(path)}, line {line}: {error}") from None
        return cls(rows)

    def to_markdown(self) -> str:
        """One line a method and dt (or tolerance); each precision has its columns. Bold: on the Pareto front."""
        return markdown(self)

    def _repr_html_(self) -> str:
        return table("WorkPrecision", *self._cells())

    def __repr__(self) -> str:
        return text_table("WorkPrecision", *self._cells())

    def _cells(self) -> tuple[list[list[str]], list[str]]:
        lines = (line.removeprefix("|").removesuffix("|").split("|") for line in self.to_markdown().splitlines())
        head, _, *rows = ([cell.strip("* ") for cell in cells] for cells in lines)
        return rows, head

    def plot(self, ax: Any = None, *, against: Any = ("seconds", "dt"), error: str = "final") -> Any:
        """Errors, logarithmic, each method labelled at its line.

        Args:
          ax: None makes a figure with a row of axes for each problem and precision; or one axes for each of
            ``against``, all in them.
          against: "seconds", "evaluations" or "dt", or several of them.
          error: the one at the end, "final", the largest, "max", the root mean square, "l2", or that of the gradient,
            "gradient", whose seconds are then those of the gradient.
        Returns: the axes drawn on, an array with a column for each of ``against``, or as given.
        """
        from jeuler.plotting.accuracy import plot_work_precision

        return plot_work_precision(self, ax, against=against, error=error)


def _key(row: dict[str, Any]) -> tuple[Any, ...]:
    """What tells a run from others; NaN as None, which is equal to itself."""
    size = (None if math.isnan(row[name]) else row[name] for name in ("dt", "rtol", "atol"))
    return row["problem"], row["method"], row["dtype"], *size


def _read(cell: str, empty: Any) -> Any:
    """A cell of the file, of the type that the column has."""
    if isinstance(empty, tuple):
        return tuple(map(float, cell.split()))
    if isinstance(empty, bool):
        if cell not in ("True", "False"):
            raise ValueError(f"expected True or False, got {cell!r}")
        return cell == "True"
    return type(empty)(cell)


def _check_same(problem: str, rows: list[dict[str, Any]], others: list[dict[str, Any]]) -> None:
    """One ValueError if rows under one name are of different problems, as the interval or the exact end state tells."""
    name = f"problem {problem!r}" if problem else "the problem without a name"
    hint = "give the other one a name, work_precision(problem=...)"
    intervals = {(row["t0"], row["t1"]) for row in (*rows, *others)}
    if len(intervals) > 1:
        raise ValueError(f"{name} must have one interval (t0, t1), got {sorted(intervals)}; {hint}")
    sizes = [
        row["error_final"] / row["error_final_relative"]
        for row in (*rows, *others)
        if math.isfinite(row["error_final"]) and 0 < row["error_final_relative"] < math.inf
    ]
    if others and sizes and max(sizes) > min(sizes) * (1 + 1e-6):
        raise ValueError(
            f"{name} must have one exact end state and one norm, got ends of size {min(sizes):.8g} and "
            f"{max(sizes):.8g}; {hint}"
        )


def mark_pareto(rows: list[dict[str, Any]]) -> None:
    """Mark the rows that no other row of the problem beats in both error and seconds."""
    for row in rows:
        row["pareto"] = False
    for row in WorkPrecision(rows).front():
        row["pareto"] = True


def best_of(rows: list[dict[str, Any]], cost: str, error: str) -> list[dict[str, Any]]:
    """The rows that no other beats in both error and cost. An error of over 100 % is no result.

    Nor is an error at the end that is below that of the reference.
    """
    best, found = math.inf, []
    able = [r for r in rows if math.isfinite(r[error]) and not r[f"{error}_relative"] > 1 and r[cost] > 0]
    if error != "gradient_error":
        able = [row for row in able if row["error_final"] >= row["reference_error"]]
    for row in sorted(able, key=lambda row: (row[cost], row[error])):
        if row[error] < best:
            found.append(row)
            best = row[error]
    return found


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
