"""What each column of a table is: its quantity, unit, axis, run, and why it is taken so."""

from __future__ import annotations

import dataclasses
import math

import numpy as np

from jeuler.fitting.recordings.table import Table
from jeuler.fitting.recordings.units import SI, axis_of, file_quantity, quantity_of, split_run, split_unit, unit_of

EPOCHS = ((1e17, 1e-9, "ns"), (1e14, 1e-6, "us"), (1e11, 1e-3, "ms"))  # since 1970, by size


@dataclasses.dataclass(frozen=True)
class Column:
    """One column as understood.

    Attributes:
      name: as in the file.  index: its place in the table.
      quantity: "time", "position", "velocity", "acceleration", "angle", "index", "absolute", ... or "" if not known.
      unit: as the file (or the user) has it, "" if none.  factor: from it to SI; NaN where the scale is not known.
      axis: "x", "y", "z" or "".  marker: what tells one particle from another, "".  run: the run in its name, "".
      told: whether name, unit or user told the quantity.
    """

    name: str
    index: int
    quantity: str
    unit: str
    factor: float
    axis: str
    marker: str
    run: str
    told: bool

    @property
    def si(self) -> str:
        """The unit that values are converted to; that of the file where it has no known scale."""
        return self.unit if math.isnan(self.factor) else SI.get(self.quantity, self.unit)


def describe(table: Table, units: dict[str, str]) -> list[Column]:
    """The columns of a table, by their names and units; ``units``: what the user says of some, by name."""
    found = []
    for k, name in enumerate(table.names):
        base, run = split_run(name)
        unit = units.get(name) or split_unit(base)[1] or table.units[k].strip("[]() ")
        by_name, by_unit = quantity_of(name), unit_of(unit) if unit else None
        if unit and by_unit is None and name in units:
            raise ValueError(
                f"--unit: the unit {unit!r} of {name!r} is not known; known are s, ms, m, mm, m/s^2, rad, ..."
            )
        if by_name == "time" and by_unit and by_unit[0] != "time" and name in units:
            raise ValueError(
                f"--unit: {unit!r} is a unit of {by_unit[0]}, and {name!r} is a time; write {name}=ms, say"
            )
        if by_name == "position" and not unit and name.lower() in ("x", "y", "z"):
            by_name = file_quantity(table.source) or by_name
        quantity, factor = _quantity("" if name in units else by_name, by_unit, unit)
        if quantity == "index" and not _counts(table.values[:, k]):
            quantity = ""
        if name.lower() in ("millis", "micros", "ms", "us") and not unit:
            unit = {"mi": "ms" if "millis" in name.lower() else "us"}.get(name.lower()[:2], name.lower())
            quantity, factor = unit_of(unit) or ("time", 1.0)
        if base.lower().startswith("gf") and by_name == "acceleration" and not unit:
            unit, factor = "g", 9.80665
        if k in table.text:
            quantity = "text"
        elif k in table.dates:
            quantity, unit, factor = "time", "date", 1.0
        elif quantity == "time" and not unit:
            unit, factor = _epoch(table.values[:, k])
        axis, marker = axis_of(name)
        found.append(Column(name, k, quantity, unit, factor, axis, marker, run, bool(by_name or by_unit)))
    return found


def _quantity(by_name: str, by_unit: tuple[str, float] | None, unit: str) -> tuple[str, float]:
    """The unit decides, unless the name says that the column is of another sort: an uncertainty, |a|, a mass in g."""
    if by_unit is None:
        return by_name, 1.0
    quantity, factor = by_unit
    if by_name == "mass" and unit.strip().lower() == "g":
        return "mass", 1e-3
    if by_name in ("uncertainty", "absolute", "index"):
        return by_name, factor
    if quantity == "time" and by_name not in ("", "time"):
        return by_name, factor
    return quantity, factor


def _counts(values: np.ndarray) -> bool:
    """Whether values are 0, 1, 2, ... or 1, 2, 3, ... or another count by one."""
    seen = values[np.isfinite(values)]
    return len(seen) > 1 and bool((np.diff(seen) == 1).all())


def _epoch(values: np.ndarray) -> tuple[str, float]:
    """Milli-, micro- or nanoseconds where times without a unit are as large as those since 1970 are."""
    seen = values[np.isfinite(values)]
    largest = float(np.median(np.abs(seen))) if len(seen) else 0.0
    return next(((unit, factor) for size, factor, unit in EPOCHS if largest > size), ("", 1.0))


def find_index(columns: list[Column], table: Table) -> list[Column]:
    """Columns with the unnamed one that counts the rows called an index, where another column is a time."""
    has_time = any(column.quantity == "time" for column in columns)
    return [
        dataclasses.replace(column, quantity="index")
        if has_time and not column.told and column.name.startswith("column") and _counts(table.values[:, column.index])
        else column
        for column in columns
    ]
