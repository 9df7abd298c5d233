"""A work-precision table as Markdown."""

from __future__ import annotations

import math
from typing import Any


def markdown(table: Any) -> str:
    """One line a problem, method and dt (or tolerance); each precision has its columns."""
    dtypes, several = table.dtypes, len(table.problems) > 1
    gradient = any(math.isfinite(row["gradient_error"]) for row in table.rows)
    columns = ["relative error", "seconds", *(["gradient error", "gradient seconds", "MiB"] if gradient else [])]
    head = [*(["problem"] if several else []), "method", "dt, s", "steps", "evaluations"]
    head += [f"{column}, {dtype}" for dtype in dtypes for column in columns]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    grid: dict[tuple[Any, ...], dict[str, dict[str, Any]]] = {}
    for row in table.rows:
        key = row["problem"], row["method"], _size(row)
        grid.setdefault(key, {})[row["dtype"]] = row
    for key, by_dtype in grid.items():
        cells = [*(key if several else key[1:]), *(_counts(by_dtype, what) for what in ("num_steps", "evaluations"))]
        for dtype in dtypes:
            cells += _cells(by_dtype.get(dtype, {"reason": "-"}), gradient, len(columns))
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines)


def _size(row: dict[str, Any]) -> str:
    if math.isfinite(row["dt"]):
        return f"{row['dt']:.3g}"
    if row["rtol"] == row["atol"]:
        return f"tolerance {row['rtol']:.0e}"
    return f"rtol {row['rtol']:.0e}, atol {row['atol']:.0e}"


def _counts(by_dtype: dict[str, dict[str, Any]], what: str) -> str:
    """A count, or one for each precision where they differ."""
    counts = [row[what] for row in by_dtype.values()]
    return " / ".join(f"{n:,}" if n >= 0 else "-" for n in dict.fromkeys(counts))


def _cells(row: dict[str, Any], gradient: bool, width: int) -> list[str]:
    """Error and seconds of one run."""
    if row["reason"]:
        return [row["reason"], *[""] * (width - 1)]
    error = f"{row['error_final_relative']:.1e}"
    cells = [f"**{error}**" if row["pareto"] else error, f"{row['run_seconds_min']:.2e}"]
    if gradient:
        cells += [f"{row['gradient_error_relative']:.1e}", f"{row['gradient_seconds_min']:.2e}"]
        cells += [f"{row['gradient_bytes'] / 2**20:.2f}"]
    return cells
