"""Measured trajectories from text files, as labs and phones export them."""

from __future__ import annotations

import csv
import os
import re
from typing import NamedTuple

import numpy as np

from jeuler._core.describe import object_table, summary

MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "--"}


class Trajectory(NamedTuple):
    """Times and columns of a file.

    Attributes:
      times: the time column, (row,), as the file has it.
      columns: every other column by name, in the file's order, (row,) each; NaN = missing cell.
    Example:
      >>> import numpy as np, jeuler
      >>> swing = jeuler.Trajectory(np.array([0.0, 0.1]), {"x": np.array([1.0, 0.9])})
      >>> times, columns = swing
      >>> columns["x"].tolist()
      [1.0, 0.9]
    """

    times: np.ndarray
    columns: dict[str, np.ndarray]

    def __repr__(self) -> str:
        return summary(self)

    def _repr_html_(self) -> str:
        return object_table(self)


def read_trajectory(path: str | os.PathLike[str], *, time: str | None = None) -> Trajectory:
    """Read times and columns from a CSV or TSV file.

    Commas, semicolons, tabs or blanks separate; header names or none (a ``# columns: t,x`` comment names them too);
    lines that begin with # are comments; decimal commas where the comma does not separate; an empty cell, nan or NA
    is missing.

    Args:
      path: the file.
      time: name of the time column; None takes the column named t or time, or else the first.
    Returns: `Trajectory`, ``times`` and ``columns``, float64.
    Raises: ValueError, one line with file, line and column, for what cannot be read; OSError, if there is no file.
    Example:
      >>> import pathlib, tempfile, jeuler
      >>> path = pathlib.Path(tempfile.mkdtemp()) / "swing.csv"
      >>> _ = path.write_text("time;x\\n0,0;1,5\\n0,1;\\n")
      >>> times, columns = jeuler.read_trajectory(path)
      >>> times.tolist(), columns["x"].tolist()
      ([0.0, 0.1], [1.5, nan])

    Source: RFC 4180 for quotes; the rest is what spreadsheets and phone apps write.
    """
    name = os.fspath(path)
    comments, lines = _lines(name)
    if not lines:
        raise ValueError(f"{name}: no data, expected rows of a time and at least one value")
    separator = _separator([line for _, line in lines[:50]])
    rows = [(number, _cells(line, separator)) for number, line in lines]
    header: list[str] | None = None
    while rows and not any(_is_number(cell) for cell in rows[0][1]):
        if header is None:
            header = rows[0][1]
        rows = rows[1:]
    if not rows:
        raise ValueError(f"{name}: line {lines[0][0]}: only names and no numbers, expected rows of numbers")
    width = len(rows[0][1]) if header is None else len(header)
    if width < 2:
        raise ValueError(
            f"{name}: line {rows[0][0]}: one column, expected a time and at least one value, "
            f"separated by commas, semicolons, tabs or blanks"
        )
    names = _names(header or _commented_names(comments, width), width)
    table = np.array([_numbers(name, number, cells, names) for number, cells in rows])
    clock = _time_column(name, names, time)
    lost = np.flatnonzero(np.isnan(table[:, clock]))
    if lost.size:
        raise ValueError(f"{name}: line {rows[lost[0]][0]}: column {clock + 1} ({names[clock]}): the time is missing")
    columns = {names[k]: table[:, k] for k in range(width) if k != clock}
    return Trajectory(table[:, clock], columns)


def _lines(name: str) -> tuple[list[str], list[tuple[int, str]]]:
    """Comment texts, and the other lines that are not blank with their numbers from 1."""
    with open(name, "rb") as file:
        raw = file.read()
    if b"\0" in raw:
        raise ValueError(f"{name}: not a text file; save it as comma-separated text (CSV) in UTF-8")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    numbered = [(number, line.strip("\r\n")) for number, line in enumerate(text.splitlines(), start=1)]
    comments = [line.lstrip()[1:].strip() for _, line in numbered if line.lstrip().startswith("#")]
    return comments, [(n, line) for n, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _separator(lines: list[str]) -> str:
    """The first of semicolon, tab, comma that most lines have; else blanks."""
    for candidate in (";", "\t", ","):
        if sum(candidate in line for line in lines) > len(lines) / 2:
            return candidate
    return " "


def _cells(line: str, separator: str) -> list[str]:
    if separator == " ":
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]


def _number(cell: str) -> float:
    """The value of a cell; ValueError if it is not a finite number."""
    if cell.lower() in MISSING:
        return float("nan")
    if "," in cell and "." not in cell:
        cell = cell.replace(",", ".")
    if "_" in cell or not np.isfinite(value := float(cell)):
        raise ValueError
    return value


def _is_number(cell: str) -> bool:
    try:
        return not np.isnan(_number(cell))
    except ValueError:
        return False


def _numbers(name: str, line: int, cells: list[str], names: list[str]) -> list[float]:
    while len(cells) > len(names) and not cells[-1]:
        cells = cells[:-1]  # a separator at the end of the line
    if len(cells) != len(names):
        raise ValueError(f"{name}: line {line}: {len(cells)} cells, expected {len(names)}: {', '.join(names)}")
    values = []
    for k, cell in enumerate(cells):
        try:
            values.append(_number(cell))
        except ValueError:
            raise ValueError(
                f"{name}: line {line}: column {k + 1} ({names[k]}): expected a number, got {cell!r}"
            ) from None
    return values


def _commented_names(comments: list[str], width: int) -> list[str] | None:
    """Names from a comment such as ``# columns: t_s,x_m``, if it has as many as the table is wide."""
    for comment in comments:
        found = re.match(r"columns?\s*:\s*(.*)", comment, re.IGNORECASE)
        names = re.split(r"[,;\s]+", found.group(1).strip()) if found else []
        if len(names) == width:
            return names
    return None


def _names(header: list[str] | None, width: int) -> list[str]:
    """Column names, every one different and none empty."""
    given = header or [""] * width
    names: list[str] = []
    for k, name in enumerate(given):
        name = name or ("t" if k == 0 and header is None else f"column{k + 1}")
        names.append(name if name not in names else f"{name}_{k + 1}")
    return names


def _time_column(name: str, names: list[str], time: str | None) -> int:
    if time is not None:
        if time not in names:
            raise ValueError(f"{name}: no column {time!r} for the time, the columns are {', '.join(names)}")
        return names.index(time)
    for k, column in enumerate(names):
        if re.match(r"(t|time)\b|t_", column.strip().lower()):
            return k
    return 0
