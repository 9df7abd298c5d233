"""A table from text: any separator, points or commas in numbers, names, units, titles."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np

from jeuler.fitting.recordings.cells import MISSING, moment, number, shown
from jeuler.fitting.recordings.layout import DECIMAL_COMMAS, Layout, find_layout, is_comment, split
from jeuler.fitting.recordings.loggers import table_of_labels, without_stamps
from jeuler.fitting.recordings.table import Line, Table, counted, listed, named

DAY = 86_400.0


def read_text(source: str, text: str, skip: int = 0, notes: tuple[str, ...] = ()) -> Table:
    """The table in a text; ``skip``: how many lines at its top to leave out."""
    comments, lines = _lines(source, text, skip)
    lines = without_stamps(table_of_labels(lines))
    if not lines:
        raise ValueError(f"{source}: no data, expected rows of a time and at least one value")
    layout = find_layout(source, lines, comments)
    body = lines[layout.begin :]
    among = [number for number, _ in comments if body and number > body[0][0]]
    if among:
        notes = (*notes, f"{counted(len(among), 'comment')} among the data left out, the first at line {among[0]}.")
    if not body:
        raise ValueError(f"{source}: line {lines[0][0]}: only names and no numbers, expected rows of numbers")
    names = named(layout.names or [""] * layout.width, "" if layout.names else "t")
    found = _fast_values(body, layout)
    dates: frozenset[int] = frozenset()
    if found is None:
        found, dates = _careful_values(source, body, layout, names)
    numbers = np.array([line[0] for line in body])
    return Table(source, names, layout.units, found, layout.text, dates, numbers, (*notes, *layout.notes))


def _lines(source: str, text: str, skip: int) -> tuple[list[Line], list[Line]]:
    """Comments, and the other lines that are not blank, with their numbers from 1."""
    if "\r" in text:
        text = text.replace("\r\n", "\n").replace("\r", "\n")
    numbered: list[Line] = [line for line in enumerate(text.split("\n"), 1) if line[1] and not line[1].isspace()]
    if skip:
        numbered = [line for line in numbered if line[0] > skip]
    if '"' in text:
        numbered = _whole_quotes(source, numbered)
    if not any(mark in text for mark in ("#", "%", "//")):
        return [], numbered
    comments = [line for line in numbered if is_comment(line[1])]
    return comments, [line for line in numbered if not is_comment(line[1])] if comments else numbered


def _whole_quotes(source: str, lines: list[Line], most: int = 20) -> list[Line]:
    """Lines that end inside a quoted cell joined with the next ones."""
    whole: list[Line] = []
    k = 0
    while k < len(lines):
        number, text = lines[k]
        k += 1
        if '"' in text and not is_comment(text) and text.count('"') % 2:
            parts = [text]
            while "".join(parts).count('"') % 2:
                if k == len(lines) or len(parts) > most:
                    column = text.count(",", 0, text.rindex('"')) + 1
                    raise ValueError(f"{source}: line {number}: column {column}: a quote that is not closed")
                parts.append(lines[k][1])
                k += 1
            text = " ".join(parts)
        whole.append((number, text))
    return whole


def _fast_values(body: list[Line], layout: Layout) -> np.ndarray | None:
    """All cells at once, where every one is a plain number; None where that is not so."""
    separator, width = layout.separator, layout.width
    texts = [text for _, text in body]
    joined = "\n".join(texts)
    if layout.text or '"' in joined or "_" in joined or not joined.isascii():
        return None
    if separator == " ":
        rows = [text.split() for text in texts]
        if any(len(row) != width for row in rows):
            return None
        flat = list(itertools.chain.from_iterable(rows))
    else:
        if any(text.count(separator) != width - 1 for text in texts):
            return None
        flat = separator.join(texts).split(separator)
    if separator != "," and "," in joined:
        if "." in joined:
            return None
        flat = [cell.replace(",", ".") for cell in flat]
    try:
        values = np.array(list(map(float, flat)))
    except ValueError:
        return None
    return None if np.isinf(values).any() else values.reshape(-1, width)


def _careful_values(
    source: str, body: list[Line], layout: Layout, names: list[str]
) -> tuple[np.ndarray, frozenset[int]]:
    """Cell by cell: missing ones, dates, decimal commas; an error with line and column for what is none of these."""
    width = layout.width
    rows = [_row(source, line, layout, names) for line in body]
    columns = list(zip(*rows, strict=True))
    point = any("." in cell and "," not in cell and _is_number(cell) for cell in itertools.chain.from_iterable(rows))
    values = np.full((len(rows), width), np.nan)
    moments: dict[int, list[tuple[int | None, float | None] | None]] = {}
    for k in range(width):
        if k in layout.text:
            continue
        first = next((cell for cell in columns[k] if cell.lower() not in MISSING), "")
        if moment(first) is not None:
            moments[k] = _moments(source, body, k, names[k], columns[k])
        else:
            values[:, k] = _numbers(source, body, k, names[k], columns[k], comma=not point)
    for k in moments:
        values[:, k] = _clock_values(moments[k], moments.get(k - 1))
    return values, frozenset(moments)


def _row(source: str, line: Line, layout: Layout, names: list[str]) -> list[str]:
    cells = split(source, line, layout.separator)
    while len(cells) > layout.width and not cells[-1]:
        cells = cells[:-1]  # a separator at the end of the line
    if len(cells) != layout.width:
        hint = ""
        if layout.separator == "," and len(cells) == 2 * layout.width:
            hint = DECIMAL_COMMAS
        raise ValueError(
            f"{source}: line {line[0]}: {counted(len(cells), 'cell')}, expected {layout.width}: {listed(names)}{hint}"
        )
    return cells


def _is_number(cell: str) -> bool:
    try:
        return not math.isnan(number(cell))
    except ValueError:
        return False


def _numbers(
    source: str, body: list[Line], k: int, name: str, cells: Sequence[str], comma: bool
) -> list[float] | np.ndarray:
    values = []
    for row, cell in enumerate(cells):
        try:
            values.append(number(cell, comma))
        except ValueError:
            mixed = "; other cells have decimal points, so the comma is ambiguous" if "," in cell and not comma else ""
            raise ValueError(
                f"{source}: line {body[row][0]}: column {k + 1} ({name[:60]}): "
                f"expected a number, got {shown(cell)}{mixed}"
            ) from None
    return values


def _moments(
    source: str, body: list[Line], k: int, name: str, cells: Sequence[str]
) -> list[tuple[int | None, float | None] | None]:
    found: list[tuple[int | None, float | None] | None] = []
    for row, cell in enumerate(cells):
        if cell.lower() in MISSING:
            found.append(None)
            continue
        told = moment(cell)
        if told is None:
            raise ValueError(
                f"{source}: line {body[row][0]}: column {k + 1} ({name[:60]}): "
                f"expected a date or a time of day, got {shown(cell)}"
            )
        found.append(told)
    return found


def _clock_values(
    moments: list[tuple[int | None, float | None] | None],
    before: list[tuple[int | None, float | None] | None] | None,
) -> np.ndarray:
    """Seconds from the midnight before the first row; times of day take the dates of the column before, if any."""
    days = np.array([np.nan if m is None or m[0] is None else m[0] for m in moments])
    seconds = np.array([np.nan if m is None else (m[1] or 0.0) for m in moments])
    if np.isnan(days).all() and before is not None and all(m is None or m[1] is None for m in before):
        days = np.array([np.nan if m is None or m[0] is None else m[0] for m in before])
    if not np.isnan(days).all():
        return (days - days[np.flatnonzero(~np.isnan(days))[0]]) * DAY + seconds
    seen = np.flatnonzero(~np.isnan(seconds))
    midnights = np.cumsum(np.diff(seconds[seen], prepend=seconds[seen[:1]]) < -DAY / 2)
    seconds[seen] += midnights * DAY
    return seconds
