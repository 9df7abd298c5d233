"""A table as a file holds it, before anybody says what its columns mean."""

from __future__ import annotations

import dataclasses

import numpy as np

Line = tuple[int, str]  # its number in the file, and its text


@dataclasses.dataclass(frozen=True)
class Table:
    """Named columns of numbers.

    Attributes:
      source: the name of the file.
      names: the columns' names, each different and none empty, (column,).
      units: what a row of units says of each column, "" where nothing, (column,).
      values: (row, column), NaN = missing. Dates and times of day are seconds from the first row's midnight.
      text: the columns that hold text and no numbers (NaN in values).
      dates: the columns that hold dates or times of day.
      lines: line number in the file of each row, (row,), from 1; empty where there are no lines.
      notes: what was noticed while reading, as sentences.
    """

    source: str
    names: list[str]
    units: list[str]
    values: np.ndarray
    text: frozenset[int] = frozenset()
    dates: frozenset[int] = frozenset()
    lines: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros(0, int))
    notes: tuple[str, ...] = ()

    def where(self, row: int) -> str:
        """The place of a row in words."""
        return f"line {self.lines[row]}" if len(self.lines) else f"row {row + 1}"


def named(given: list[str], first: str = "") -> list[str]:
    """Column names, every one different and none empty."""
    names: list[str] = []
    taken: set[str] = set()
    for k, name in enumerate(given):
        name = "".join(c for c in name if c.isprintable()) or (first if k == 0 and first else f"column{k + 1}")
        while name in taken:
            name = f"{name}_{k + 1}"
        taken.add(name)
        names.append(name)
    return names


def counted(count: int, thing: str) -> str:
    """A count and what is counted: 1 gap, 2 gaps."""
    return f"{count} {thing}" if count == 1 else f"{count} {thing}s"


def listed(names: list[str], most: int = 12, longest: int = 60) -> str:
    """Names for a message: the first ones, long ones cut, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(name[:longest] for name in names[:most]) + more
