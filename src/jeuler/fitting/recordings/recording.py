"""A recording understood: one clock, the columns that belong to it, in SI units."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np

from jeuler.fitting.recordings.clock import Sampling, restarts, sampling
from jeuler.fitting.recordings.columns import Column, describe, find_index
from jeuler.fitting.recordings.table import Table, listed
from jeuler.fitting.recordings.units import file_quantity

LARGEST = 1e60


@dataclasses.dataclass(frozen=True)
class Recording:
    """One run.

    Attributes:
      source: the file.  run: its label, "1", "2", ...
      clock: the time column.  times: (row,), s.  rows: where they stand in the table, (begin, end).
      columns: the other columns of the run.  values: (row, column), in SI units where the unit is known.
      left_out: (name, reason) of the clocks that were not taken.
      notes: what was noticed, as sentences.  warnings: what may be wrong, as sentences with what to do.
    """

    source: str
    run: str
    clock: Column
    times: np.ndarray
    rows: tuple[int, int]
    columns: tuple[Column, ...]
    values: np.ndarray
    left_out: tuple[tuple[str, str], ...]
    notes: tuple[str, ...]
    warnings: tuple[str, ...]

    @property
    def sampling(self) -> Sampling:
        """How the clock runs."""
        return sampling(self.times)


def understand(
    table: Table, time: str | None = None, units: dict[str, str] | None = None, ordered: bool = True
) -> list[Recording]:
    """The runs of a table: those side by side, each with its clock, and those stacked, where the clock starts again.

    ``ordered``: whether times that go back otherwise are refused.
    """
    columns = find_index(describe(table, units or {}), table)
    notes, warnings = list(table.notes), []
    hinted = [
        c.name for c in columns if c.name.lower() in ("x", "y", "z") and c.quantity == file_quantity(table.source)
    ]
    if hinted and not any(c.unit for c in columns if c.name in hinted):
        notes.append(f"The file's name says that {listed(hinted)} hold the {file_quantity(table.source)}.")
    if time is not None:
        clock = columns[_find_name(table, time)]
        clock = clock if clock.quantity == "time" else dataclasses.replace(clock, quantity="time", factor=1.0, unit="")
        others = [column for column in columns if column.index != clock.index]
        groups = [(clock, others, _second_clocks(others))]
    else:
        groups = _groups(table, columns)
        if not any(column.quantity == "time" for column in columns):
            warnings.append(
                f"No column is named as a time: the first, {groups[0][0].name!r}, was taken, in s. "
                "Say which with --time."
            )
    found: list[Recording] = []
    for clock, members, left_out in groups:
        found += _runs(table, clock, members, left_out, ordered)
    if not found:
        raise ValueError(f"{table.source}: no rows with a time")
    labels = [recording.run for recording in found]
    if len(set(labels)) < len(labels) or "" in labels:
        labels = [str(k + 1) for k in range(len(found))]
    return [
        dataclasses.replace(r, run=label, notes=(*notes, *r.notes), warnings=(*warnings, *r.warnings))
        for r, label in zip(found, labels, strict=True)
    ]


def _find_name(table: Table, name: str) -> int:
    if name in table.names:
        return table.names.index(name)
    raise ValueError(
        f"{table.source}: no column {name!r} for the time, the columns are {listed(table.names)}; "
        f"a name with blanks needs quotes"
    )


def _second_clocks(columns: list[Column]) -> list[tuple[str, str]]:
    return [(column.name, "a second clock") for column in columns if column.quantity == "time"]


Group = tuple[Column, list[Column], list[tuple[str, str]]]


def _groups(table: Table, columns: list[Column]) -> list[Group]:
    """Each clock with the columns that follow it up to the next one (or lead up to it, where the last is a clock)."""
    clocks = [column for column in columns if column.quantity == "time"]
    if not clocks:
        first = next((c for c in columns if c.quantity != "text"), columns[0])
        clock = dataclasses.replace(first, quantity="time", factor=1.0)
        return [(clock, [column for column in columns if column.index != first.index], [])]
    backwards = columns[-1].quantity == "time" and columns[0].quantity != "time"
    ordered = columns[::-1] if backwards else columns
    groups: list[tuple[list[Column], list[Column]]] = []
    leading: list[Column] = []
    for column in ordered:
        if column.quantity == "time" and (not groups or any(_is_data(member) for member in groups[-1][1])):
            groups.append(([column], []))
        elif column.quantity == "time":
            groups[-1][0].append(column)
        elif groups:
            groups[-1][1].append(column)
        else:
            leading.append(column)
    groups[0][1][:0] = leading
    if len(groups) > 1 and not any(_is_data(member) for member in groups[-1][1]):
        idle = groups.pop()
        groups[-1][0].extend(idle[0])
        groups[-1][1].extend(idle[1])
    merged = _same_clocks(table, groups)
    found: list[Group] = []
    for candidates, members in merged:
        clock = max(candidates, key=lambda c: _fitness(table, c))
        others = [candidate for candidate in candidates if candidate is not clock]
        members = sorted(members, key=lambda c: c.index)
        found.append((clock, members, _second_clocks(others)))
    return found


def _is_data(column: Column) -> bool:
    return column.quantity not in ("time", "index", "text")


def _same_clocks(
    table: Table, groups: list[tuple[list[Column], list[Column]]]
) -> list[tuple[list[Column], list[Column]]]:
    """Groups whose clocks hold the same values and whose names tell no different runs are one."""
    merged = groups[:1]
    for clocks, members in groups[1:]:
        before = merged[-1][0][0]
        a, b = table.values[:, before.index] * before.factor, table.values[:, clocks[0].index] * clocks[0].factor
        if before.run == clocks[0].run and np.array_equal(a, b, equal_nan=True):
            merged[-1] = (merged[-1][0] + clocks, merged[-1][1] + members)
        else:
            merged.append((clocks, members))
    return merged


def _fitness(table: Table, column: Column) -> tuple[bool, bool, int]:
    """How good a clock is: no step back and steps that are mostly above 0; a known unit; the first of equals."""
    values = table.values[:, column.index]
    steps = np.diff(values[np.isfinite(values)])
    return bool(len(steps) and (steps >= 0).all() and (steps > 0).mean() > 0.5), column.unit != "date", -column.index


def _runs(
    table: Table, clock: Column, members: list[Column], left_out: list[tuple[str, str]], ordered: bool
) -> list[Recording]:
    """The runs of one clock."""
    raw = table.values[:, clock.index]
    values = table.values[:, [column.index for column in members]]
    if len(members) + 1 + len(left_out) < len(table.names):  # side by side: runs end where their cells do
        there = np.flatnonzero(np.isfinite(raw) | np.isfinite(values).any(axis=1))
        last = there[-1] + 1 if len(there) else 0
    else:
        last = len(raw)
    lost = np.flatnonzero(np.isnan(raw[:last]))
    if lost.size:
        raise ValueError(
            f"{table.source}: {table.where(lost[0])}: column {clock.index + 1} ({clock.name[:60]}): the time is missing"
        )
    if not last:
        return []
    times = raw[:last] * clock.factor
    values = values[:last] * np.array([1.0 if np.isnan(c.factor) else c.factor for c in members])
    since = np.median(np.abs(times)) > 1e8  # since 1970, or a date
    if since:
        times = (raw[:last] - raw[0]) * clock.factor
    if ordered:
        _refuse_senseless(table, members, values)
    back = restarts(times)
    if back is None and ordered:
        row = int(np.flatnonzero(np.diff(times) < 0)[0]) + 1
        raise ValueError(
            f"{table.source}: {table.where(row)}: column {clock.index + 1} ({clock.name[:60]}): the time goes back "
            f"from {raw[row - 1]:.10g} to {raw[row]:.10g}; times must increase"
        )
    bounds = [0, *(back or []), last]
    warnings = []
    step = float(np.median(np.diff(times))) if last > 1 else 0.0
    if not clock.unit and step >= 1:
        warnings.append(
            f"The time column {clock.name!r} has no unit: its steps of {step:g} are taken as seconds. "
            f"If they are milliseconds, give --unit {clock.name}=ms."
        )
    notes = ("The times are counted from the first row.",) if since or clock.unit == "date" else ()
    if len(bounds) > 2:
        places = ", ".join(table.where(row) for row in bounds[1:-1][:6])
        notes = (*notes, f"The clock starts again at {places}: {len(bounds) - 1} runs.")
    return [
        Recording(
            source=table.source,
            run=clock.run if len(bounds) == 2 else (f"{clock.run}.{k + 1}" if clock.run else str(k + 1)),
            clock=clock,
            times=times[begin:end] - (times[begin] if clock.unit == "date" else 0.0),
            rows=(begin, end),
            columns=tuple(members),
            values=values[begin:end],
            left_out=tuple(left_out),
            notes=notes,
            warnings=tuple(warnings),
        )
        for k, (begin, end) in enumerate(itertools.pairwise(bounds))
    ]


def _refuse_senseless(table: Table, members: list[Column], values: np.ndarray) -> None:
    """One ValueError for a cell whose square no computer holds: no measurement is so large, but damage is."""
    rows, columns = np.nonzero(np.abs(values) > LARGEST)
    if rows.size:
        column = members[columns[0]]
        raise ValueError(
            f"{table.source}: {table.where(rows[0])}: column {column.index + 1} ({column.name[:60]}): "
            f"{values[rows[0], columns[0]]:g} is larger than any measurement; a damaged cell?"
        )


def longest(recordings: list[Recording]) -> Recording:
    """The run with the most rows; the first of equals."""
    return max(recordings, key=lambda recording: len(recording.times))
